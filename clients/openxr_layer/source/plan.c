/* What the application submits, and whether it can be filtered. */
#include "plan.h"

#include "graphics.h"
#include "log.h"

static bool is_inside(const swapchain *chain, const XrSwapchainSubImage *part) {
    const XrRect2Di *r = &part->imageRect;
    return r->offset.x >= 0 && r->offset.y >= 0 && r->extent.width > 0 &&
           r->extent.height > 0 &&
           (int64_t)r->offset.x + r->extent.width <= chain->info.width &&
           (int64_t)r->offset.y + r->extent.height <= chain->info.height &&
           part->imageArrayIndex < chain->info.arraySize;
}

static bool is_color(const swapchain *chain) {
    return chain->format && chain->format->wire;
}

static bool is_depth(const swapchain *chain) {
    return chain->format && !chain->format->wire;
}

const XrCompositionLayerDepthInfoKHR *depth_of(const void *next) {
    for (const XrBaseInStructure *at = next; at; at = at->next)
        if (at->type == XR_TYPE_COMPOSITION_LAYER_DEPTH_INFO_KHR)
            return (const XrCompositionLayerDepthInfoKHR *)at;
    return NULL;
}

/* Find the images of a layer; false if it cannot be filtered. */
static bool plan_views(session *at, plan *p) {
    for (int eye = 0; eye < WIRE_EYES; ++eye) {
        swapchain *color = find_swapchain(p->layer->views[eye].subImage.swapchain);
        if (!color || color->session != at) return false;
        p->color[eye] = color;
        color->unused_releases = 0;
    }
    for (int eye = 0; eye < WIRE_EYES; ++eye) {
        const XrCompositionLayerProjectionView *view = p->layer->views + eye;
        const swapchain *color = p->color[eye];
        if (!is_color(color) || color->format != p->color[0]->format) {
            LOG_ONCE(&at->reported, REASON_FORMAT,
                     "images of format 0x%llx are not filtered; supported: %s, the same "
                     "for both eyes",
                     (long long)color->info.format, at->api->formats);
            return false;
        }
        if (!is_inside(color, &view->subImage)) {
            LOG_ONCE(&at->reported, REASON_RECTANGLE, "a view extends beyond its image");
            return false;
        }
        if (!color->has_copy) return false;
        const XrCompositionLayerDepthInfoKHR *info = depth_of(view->next);
        swapchain *depth = info ? find_swapchain(info->subImage.swapchain) : NULL;
        if (!depth || depth->session != at) continue;
        depth->unused_releases = 0;
        if (!is_depth(depth) || !depth->has_copy ||
            !is_inside(depth, &info->subImage))
            continue;
        p->depth[eye] = depth;
        p->depth_info[eye] = info;
    }
    return true;
}

/* Find the quads above the projection, up to the first layer of another kind.  They hide
 * what is below them and are drawn into the projection.  If the projection is blended with
 * the layers below it, quads are left alone. */
static void plan_quads(session *at, const XrFrameEndInfo *info, plan *p) {
    if (at->link.leaves_quads ||
        p->layer->layerFlags & XR_COMPOSITION_LAYER_BLEND_TEXTURE_SOURCE_ALPHA_BIT)
        return;
    for (uint32_t i = p->index + 1; i < info->layerCount; ++i) {
        const XrCompositionLayerQuad *quad = (const void *)info->layers[i];
        if (!quad || quad->type != XR_TYPE_COMPOSITION_LAYER_QUAD) return;
        swapchain *chain = find_swapchain(quad->subImage.swapchain);
        if (!chain || chain->session != at) return;
        chain->unused_releases = 0;
        /* A quad that is not filtered may hide those above it. */
        if (p->quad_count == WIRE_QUADS || !is_color(chain) || !chain->has_copy ||
            !is_inside(chain, &quad->subImage) || !(quad->size.width > 0) ||
            !(quad->size.height > 0) ||
            (int64_t)quad->subImage.imageRect.extent.width *
                    quad->subImage.imageRect.extent.height > WIRE_QUAD_PIXELS)
            return;
        p->quads[p->quad_count++] = (planned_quad){.layer = quad, .chain = chain};
    }
}

/* Find the first projection layer that can be filtered. */
bool make_plan(session *at, const XrFrameEndInfo *info, plan *p) {
    for (uint32_t i = 0; i < info->layerCount && i < MAX_LAYERS; ++i) {
        const XrCompositionLayerBaseHeader *layer = info->layers[i];
        if (!layer || layer->type != XR_TYPE_COMPOSITION_LAYER_PROJECTION) continue;
        *p = (plan){.layer = (const XrCompositionLayerProjection *)layer, .index = i};
        if (p->layer->viewCount != WIRE_EYES || !p->layer->views) {
            LOG_ONCE(&at->reported, REASON_VIEWS,
                     "layers of %u views are not filtered; supported: two",
                     p->layer->viewCount);
        } else if (!find_reference_space(layer->space, &p->space)) {
            LOG_ONCE(&at->reported, REASON_SPACE,
                     "layers in the space of a controller are not filtered");
        } else if (plan_views(at, p)) {
            plan_quads(at, info, p);
            return true;
        }
    }
    return false;
}


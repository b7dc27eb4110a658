/* Frames on their way to the helper and back, and the layers that show them. */
#include <stdlib.h>
#include <string.h>

#include "layer.h"
#include "log.h"

#define NS_PER_MS UINT64_C(1000000)
#define ALIGN(bytes) (((bytes) + 63) & ~(size_t)63)

/* The projection layer of a frame that is to be filtered. */
typedef struct {
    const XrCompositionLayerProjection *layer;
    uint32_t index;
    space_kind kind;
    swapchain *color[WIRE_EYES], *depth[WIRE_EYES]; /* depth: NULL without */
    const XrCompositionLayerDepthInfoKHR *depth_info[WIRE_EYES];
} plan;

/* What the application submits --------------------------------------------------------- */

static bool is_inside(const swapchain *chain, const XrSwapchainSubImage *part) {
    const XrRect2Di *r = &part->imageRect;
    return r->offset.x >= 0 && r->offset.y >= 0 && r->extent.width > 0 &&
           r->extent.height > 0 &&
           (int64_t)r->offset.x + r->extent.width <= chain->info.width &&
           (int64_t)r->offset.y + r->extent.height <= chain->info.height &&
           part->imageArrayIndex < chain->info.arraySize;
}

static const XrCompositionLayerDepthInfoKHR *depth_of(const void *next) {
    for (const XrBaseInStructure *at = next; at; at = at->next)
        if (at->type == XR_TYPE_COMPOSITION_LAYER_DEPTH_INFO_KHR)
            return (const XrCompositionLayerDepthInfoKHR *)at;
    return NULL;
}

/* Find the images of a layer; false if it goes out as it is. */
static bool plan_views(session *at, plan *p) {
    for (int eye = 0; eye < WIRE_EYES; ++eye) {
        const XrCompositionLayerProjectionView *view = p->layer->views + eye;
        swapchain *color = p->color[eye] = find_swapchain(view->subImage.swapchain);
        if (!color || color->session != at) return false;
        color->unused_releases = 0;
        if (!swapchain_can_copy(color) || is_depth_format(color->info.format) ||
            color->info.format != p->color[0]->info.format) {
            LOG_ONCE(&at->told, SAID_FORMAT,
                     "images of format 0x%llx are not filtered; supported: SRGB8_ALPHA8, "
                     "RGBA8, RGB10_A2, RGBA16, RGBA16F, the same for both eyes",
                     (long long)color->info.format);
            return false;
        }
        if (!is_inside(color, &view->subImage)) {
            LOG_ONCE(&at->told, SAID_RECTANGLE, "a view extends beyond its image");
            return false;
        }
        if (!color->has_copy) return false;
        const XrCompositionLayerDepthInfoKHR *info = depth_of(view->next);
        swapchain *depth = info ? find_swapchain(info->subImage.swapchain) : NULL;
        if (!depth || depth->session != at) continue;
        depth->unused_releases = 0;
        if (!is_depth_format(depth->info.format) || !depth->has_copy ||
            !is_inside(depth, &info->subImage))
            continue;
        p->depth[eye] = depth;
        p->depth_info[eye] = info;
    }
    return true;
}

/* Find the first projection layer that can be filtered. */
static bool make_plan(session *at, const XrFrameEndInfo *info, plan *p) {
    for (uint32_t i = 0; i < info->layerCount && i < MAX_LAYERS; ++i) {
        const XrCompositionLayerBaseHeader *layer = info->layers[i];
        if (!layer || layer->type != XR_TYPE_COMPOSITION_LAYER_PROJECTION) continue;
        *p = (plan){.layer = (const XrCompositionLayerProjection *)layer, .index = i};
        if (p->layer->viewCount != WIRE_EYES || !p->layer->views) {
            LOG_ONCE(&at->told, SAID_VIEWS,
                     "layers of %u views are not filtered; supported: two",
                     p->layer->viewCount);
        } else if (!find_space_kind(layer->space, &p->kind) ||
                   p->kind.type == XR_REFERENCE_SPACE_TYPE_VIEW) {
            LOG_ONCE(&at->told, SAID_SPACE,
                     "layers that are fixed to the head or to a controller are not "
                     "filtered");
        } else if (plan_views(at, p)) {
            return true;
        }
    }
    return false;
}

/* Spaces of the layer's own -------------------------------------------------------------- */

static bool is_same_kind(const space_kind *a, const space_kind *b) {
    return a->type == b->type && !memcmp(&a->pose, &b->pose, sizeof a->pose);
}

static XrSpace create_space(session *at, const space_kind *kind) {
    XrReferenceSpaceCreateInfo info = {.type = XR_TYPE_REFERENCE_SPACE_CREATE_INFO,
                                       .referenceSpaceType = kind->type,
                                       .poseInReferenceSpace = kind->pose};
    XrSpace made = XR_NULL_HANDLE;
    if (XR_FAILED(at->own->CreateReferenceSpace(at->handle, &info, &made)))
        return XR_NULL_HANDLE;
    return made;
}

/* The application may destroy its space while a frame in it is filtered. */
static XrSpace own_space(session *at, const space_kind *kind) {
    const unsigned limit = sizeof at->own_spaces / sizeof *at->own_spaces;
    for (unsigned i = 0; i < at->own_space_count && i < limit; ++i)
        if (is_same_kind(at->own_kinds + i, kind)) return at->own_spaces[i];
    XrSpace made = create_space(at, kind);
    if (!made) return XR_NULL_HANDLE;
    unsigned i = at->own_space_count++ % limit;
    if (at->own_spaces[i]) at->own->DestroySpace(at->own_spaces[i]);
    at->own_spaces[i] = made;
    at->own_kinds[i] = *kind;
    return made;
}

static void locate_head(session *at, const space_kind *kind, XrTime time,
                        wire_frame *frame) {
    if (!at->view_space) {
        const space_kind view = {XR_REFERENCE_SPACE_TYPE_VIEW, {.orientation.w = 1.0f}};
        at->view_space = create_space(at, &view);
    }
    XrSpace base = own_space(at, kind);
    XrSpaceLocation found = {.type = XR_TYPE_SPACE_LOCATION};
    const XrSpaceLocationFlags needed = XR_SPACE_LOCATION_ORIENTATION_VALID_BIT |
                                        XR_SPACE_LOCATION_POSITION_VALID_BIT;
    if (!at->view_space || !base ||
        XR_FAILED(at->own->LocateSpace(at->view_space, base, time, &found)) ||
        (found.locationFlags & needed) != needed)
        return;
    memcpy(frame->head, &found.pose.position, sizeof found.pose.position);
    memcpy(frame->head + 3, &found.pose.orientation, sizeof found.pose.orientation);
    frame->flags |= WIRE_HAS_HEAD;
}

/* To the helper --------------------------------------------------------------------------- */

static size_t place(wire_image *image, size_t start, const XrSwapchainSubImage *part,
                    size_t pixel_bytes) {
    image->start = start;
    image->width_px = (uint32_t)part->imageRect.extent.width;
    image->height_px = (uint32_t)part->imageRect.extent.height;
    return start + ALIGN(pixel_bytes * image->width_px * image->height_px);
}

/* Describe a frame; return the bytes of its images. */
static size_t describe(session *at, const plan *p, const XrFrameEndInfo *info, slot *to) {
    wire_frame *frame = &to->frame;
    *frame = (wire_frame){.kind = WIRE_FRAME,
                          .slot = (uint32_t)(to - at->slots),
                          .frame_id = at->next_frame++,
                          .display_time_ns = info->displayTime,
                          .color_format = wire_format_of(p->color[0]->info.format)};
    to->kind = p->kind;
    to->flags = p->layer->layerFlags;
    to->format = p->color[0]->info.format;
    if (to->flags & XR_COMPOSITION_LAYER_BLEND_TEXTURE_SOURCE_ALPHA_BIT)
        frame->flags |= WIRE_IS_BLENDED;
    size_t bytes = 0, pixel = frame->color_format == WIRE_LINEAR16F ? 8 : 4;
    for (int eye = 0; eye < WIRE_EYES; ++eye) {
        const XrCompositionLayerProjectionView *given = p->layer->views + eye;
        wire_view *view = frame->views + eye;
        memcpy(view->position_m, &given->pose.position, sizeof view->position_m);
        memcpy(view->orientation, &given->pose.orientation, sizeof view->orientation);
        memcpy(view->fov_rad, &given->fov, sizeof view->fov_rad);
        bytes = place(&view->color, bytes, &given->subImage, pixel);
    }
    for (int eye = 0; eye < WIRE_EYES; ++eye) {
        const XrCompositionLayerDepthInfoKHR *depth = p->depth_info[eye];
        wire_view *view = frame->views + eye;
        if (!depth) continue;
        bytes = place(&view->depth, bytes, &depth->subImage, sizeof(float));
        view->min_depth = depth->minDepth;
        view->max_depth = depth->maxDepth;
        view->near_m = depth->nearZ;
        view->far_m = depth->farZ;
    }
    return bytes;
}

static slot *find_slot(session *at, slot_state state) {
    for (uint32_t i = 0; i < at->link.slot_count; ++i)
        if (at->slots[i].state == state) return at->slots + i;
    return NULL;
}

static bool is_idle(const session *at) {
    for (uint32_t i = 0; i < at->link.slot_count; ++i)
        if (at->slots[i].state != SLOT_FREE) return false;
    return true;
}

/* Find a slot for a frame, with memory for its images. */
static slot *take_slot(session *at, const plan *p, const XrFrameEndInfo *info) {
    slot *to = find_slot(at, SLOT_FREE);
    if (!to) return NULL;
    size_t bytes = describe(at, p, info, to);
    /* New memory replaces all slots. */
    if (bytes > at->link.slot_bytes && !is_idle(at)) return NULL;
    if (!link_share(&at->link, bytes)) {
        if (at->link.is_welcome)
            LOG_ONCE(&at->told, SAID_MEMORY, "no shared memory for %zu bytes", bytes);
        return NULL;
    }
    to->begun_ns = now_ns();
    locate_head(at, &p->kind, info->displayTime, &to->frame);
    gaze_locate(at, info->displayTime, &to->frame);
    return to;
}

static uint8_t *memory_of(const session *at, const slot *of) {
    return at->link.memory + (size_t)(of - at->slots) * at->link.slot_bytes;
}

/* Begin to read the copies of a frame, in the layer's context. */
static void read_images(session *at, const plan *p, slot *to) {
    gl_context *gl = &at->gl;
    uint8_t *base = memory_of(at, to);
    if (!gl->is_software) {
        /* A buffer is read without waiting for the GPU. */
        if (to->is_read) gl->DeleteSync(to->is_read); /* of a helper that has ended */
        if (!to->pixels) gl->GenBuffers(1, &to->pixels);
        gl->BindBuffer(GL_PIXEL_PACK_BUFFER, to->pixels);
        if (to->pixels_bytes != at->link.slot_bytes) {
            to->pixels_bytes = at->link.slot_bytes;
            gl->BufferData(GL_PIXEL_PACK_BUFFER, (GLsizeiptr)to->pixels_bytes, NULL,
                           GL_STREAM_READ);
        }
        base = NULL;
    }
    for (int eye = 0; eye < WIRE_EYES; ++eye) {
        const wire_view *view = to->frame.views + eye;
        swapchain_read(p->color[eye], &p->layer->views[eye].subImage,
                       to->frame.color_format, base + view->color.start);
        if (p->depth[eye])
            swapchain_read(p->depth[eye], &p->depth_info[eye]->subImage, 0,
                           base + view->depth.start);
    }
    if (!gl->is_software) {
        gl->BindBuffer(GL_PIXEL_PACK_BUFFER, 0);
        to->is_read = gl->FenceSync(GL_SYNC_GPU_COMMANDS_COMPLETE, 0);
        gl->Flush();
    }
    to->state = SLOT_READING;
}

static size_t used_bytes(const wire_frame *frame) {
    size_t end = 0;
    for (int eye = 0; eye < WIRE_EYES; ++eye) {
        const wire_view *view = frame->views + eye;
        size_t pixel = frame->color_format == WIRE_LINEAR16F ? 8 : 4;
        size_t color = view->color.start +
                       pixel * view->color.width_px * view->color.height_px;
        size_t depth = view->depth.start +
                       sizeof(float) * view->depth.width_px * view->depth.height_px;
        if (color > end) end = color;
        if (depth > end) end = depth;
    }
    return end;
}

static void clear_counts(session *at) {
    at->frames = at->frames_filtered = at->frames_lapsed = 0;
    at->copy_ns = at->read_ns = at->upload_ns = at->other_ns = 0;
}

/* Send a frame whose images have been read, in the layer's context. */
static void send_read(session *at, slot *of, uint64_t limit_ns) {
    gl_context *gl = &at->gl;
    if (!gl->is_software) {
        GLenum state = gl->ClientWaitSync(of->is_read, GL_SYNC_FLUSH_COMMANDS_BIT, limit_ns);
        if (state == GL_TIMEOUT_EXPIRED) return;
        gl->DeleteSync(of->is_read);
        of->is_read = NULL;
        size_t bytes = used_bytes(&of->frame);
        gl->BindBuffer(GL_PIXEL_PACK_BUFFER, of->pixels);
        const void *found =
            gl->MapBufferRange(GL_PIXEL_PACK_BUFFER, 0, (GLsizeiptr)bytes, GL_MAP_READ_BIT);
        if (found) memcpy(memory_of(at, of), found, bytes);
        gl->UnmapBuffer(GL_PIXEL_PACK_BUFFER);
        gl->BindBuffer(GL_PIXEL_PACK_BUFFER, 0);
        if (!found) {
            of->state = SLOT_FREE;
            return;
        }
    }
    wire_frame *frame = &of->frame;
    frame->frames = at->frames;
    frame->frames_filtered = at->frames_filtered;
    frame->frames_lapsed = at->frames_lapsed;
    frame->copy_us = (uint32_t)(at->copy_ns / 1000);
    frame->read_us = (uint32_t)(at->read_ns / 1000);
    frame->upload_us = (uint32_t)(at->upload_ns / 1000);
    frame->other_us = (uint32_t)(at->other_ns / 1000);
    of->state = link_send(&at->link, frame) ? SLOT_SENT : SLOT_FREE;
    if (of->state != SLOT_FREE) clear_counts(at);
}

/* From the helper ---------------------------------------------------------------------------- */

static void receive(session *at) {
    wire_result result;
    link_connect(&at->link);
    while (link_receive(&at->link, &result)) {
        slot *of = at->slots + result.slot;
        if (of->state != SLOT_SENT || of->frame.frame_id != result.frame_id) continue;
        of->state = result.is_filtered ? SLOT_FILTERED : SLOT_FREE;
        if (!result.is_filtered) at->is_shown = false;
    }
    if (!at->link.is_lost) return;
    at->link.is_lost = at->is_shown = false;
    /* Counts are for each helper. */
    at->has_filtered = false;
    clear_counts(at);
    for (int i = 0; i < MAX_SLOTS; ++i) at->slots[i].state = SLOT_FREE;
}

/* Return the newest filtered frame; older ones are not shown. */
static slot *newest_filtered(session *at) {
    slot *newest = NULL;
    for (uint32_t i = 0; i < at->link.slot_count; ++i) {
        slot *of = at->slots + i;
        if (of->state != SLOT_FILTERED) continue;
        slot *older = !newest || newest->frame.frame_id < of->frame.frame_id ? newest : of;
        if (older) older->state = SLOT_FREE;
        if (older != of) newest = of;
    }
    return newest;
}

static bool create_image(session *at, own_image *image, const slot *of, int eye) {
    const wire_image *color = &of->frame.views[eye].color;
    if (image->handle && image->format == of->format &&
        image->width_px >= color->width_px && image->height_px >= color->height_px)
        return true;
    /* Sizes that change with the frame rate must not create a swapchain per frame. */
    uint32_t width_px = color->width_px, height_px = color->height_px;
    if (image->handle && image->format == of->format) {
        if (width_px < image->width_px) width_px = image->width_px;
        if (height_px < image->height_px) height_px = image->height_px;
    }
    if (image->handle) at->own->DestroySwapchain(image->handle);
    *image = (own_image){.format = of->format, .width_px = width_px, .height_px = height_px};
    XrSwapchainCreateInfo info = {.type = XR_TYPE_SWAPCHAIN_CREATE_INFO,
                                  .usageFlags = XR_SWAPCHAIN_USAGE_COLOR_ATTACHMENT_BIT |
                                                XR_SWAPCHAIN_USAGE_SAMPLED_BIT |
                                                XR_SWAPCHAIN_USAGE_TRANSFER_DST_BIT,
                                  .format = of->format,
                                  .sampleCount = 1,
                                  .width = width_px,
                                  .height = height_px,
                                  .faceCount = 1,
                                  .arraySize = 1,
                                  .mipCount = 1};
    if (XR_FAILED(at->own->CreateSwapchain(at->handle, &info, &image->handle))) {
        image->handle = XR_NULL_HANDLE;
        return false;
    }
    XrSwapchainImageOpenGLKHR found[MAX_IMAGES];
    for (int i = 0; i < MAX_IMAGES; ++i)
        found[i] = (XrSwapchainImageOpenGLKHR){.type = XR_TYPE_SWAPCHAIN_IMAGE_OPENGL_KHR};
    if (XR_FAILED(at->own->EnumerateSwapchainImages(
            image->handle, MAX_IMAGES, &image->image_count,
            (XrSwapchainImageBaseHeader *)found))) {
        at->own->DestroySwapchain(image->handle);
        image->handle = XR_NULL_HANDLE;
        return false;
    }
    for (uint32_t i = 0; i < image->image_count; ++i) image->images[i] = found[i].image;
    return true;
}

/* Acquire an image of the layer's own for each eye; false if the runtime still reads it. */
static bool acquire_images(session *at, const slot *of) {
    for (int eye = 0; eye < WIRE_EYES; ++eye) {
        own_image *image = at->images + eye;
        if (!create_image(at, image, of, eye)) {
            LOG_ONCE(&at->told, SAID_SWAPCHAIN,
                     "the runtime has no swapchain for filtered images");
            return false;
        }
        if (!image->is_acquired)
            image->is_acquired = XR_SUCCEEDED(
                at->own->AcquireSwapchainImage(image->handle, NULL, &image->index));
        const XrSwapchainImageWaitInfo at_once = {.type = XR_TYPE_SWAPCHAIN_IMAGE_WAIT_INFO,
                                                  .timeout = 0};
        if (image->is_acquired && !image->is_waited)
            image->is_waited =
                at->own->WaitSwapchainImage(image->handle, &at_once) == XR_SUCCESS;
        if (!image->is_waited) return false;
    }
    return true;
}

static void upload_images(session *at, const slot *of) {
    gl_context *gl = &at->gl;
    GLenum type = of->frame.color_format == WIRE_LINEAR16F ? GL_HALF_FLOAT : GL_UNSIGNED_BYTE;
    for (int eye = 0; eye < WIRE_EYES; ++eye) {
        const own_image *image = at->images + eye;
        const wire_image *color = &of->frame.views[eye].color;
        gl->BindTexture(GL_TEXTURE_2D, image->images[image->index]);
        gl->TexSubImage2D(GL_TEXTURE_2D, 0, 0, 0, (GLsizei)color->width_px,
                          (GLsizei)color->height_px, GL_RGBA, type,
                          memory_of(at, of) + color->start);
    }
    gl->BindTexture(GL_TEXTURE_2D, 0);
}

static void release_images(session *at, slot *of) {
    bool is_released = true;
    for (int eye = 0; eye < WIRE_EYES; ++eye) {
        own_image *image = at->images + eye;
        is_released &=
            XR_SUCCEEDED(at->own->ReleaseSwapchainImage(image->handle, NULL));
        image->is_acquired = image->is_waited = false;
    }
    of->state = SLOT_FREE;
    at->is_shown = is_released;
    at->shown = *of;
}

/* Both ways in one stay in the layer's context: upload a filtered frame, and read the
 * frame of a plan. */
static void exchange(session *at, const plan *p, slot *to, uint64_t limit_ns) {
    if (!at->link.is_welcome) return; /* its memory is gone */
    slot *filtered = newest_filtered(at);
    bool can_upload = filtered && acquire_images(at, filtered);
    if (!can_upload && !to && !find_slot(at, SLOT_READING)) return;
    gl_current before;
    if (!gl_enter(&at->gl, &before)) {
        LOG_ONCE(&at->told, SAID_OTHER_API,
                 "frames end with a context of another window system; not filtered");
        return;
    }
    uint64_t begun_ns = now_ns();
    if (can_upload) upload_images(at, filtered);
    uint64_t uploaded_ns = now_ns();
    if (to) read_images(at, p, to);
    uint64_t read_ns = now_ns();
    at->upload_ns += uploaded_ns - begun_ns;
    at->read_ns += read_ns - uploaded_ns;
    at->inside_ns += read_ns - begun_ns;
    for (slot *of; (of = find_slot(at, SLOT_READING));) {
        send_read(at, of, limit_ns);
        if (of->state == SLOT_READING) break;
    }
    gl_leave(&at->gl, &before, can_upload);
    if (can_upload) release_images(at, filtered);
}

void frames_begin(session *at) {
    if (!at->has_gl || at->gl.is_software) return;
    pthread_mutex_lock(&at->lock);
    if (find_slot(at, SLOT_READING)) exchange(at, NULL, NULL, 0);
    pthread_mutex_unlock(&at->lock);
}

/* Wait for the result of a frame, and upload it. */
static void await(session *at, const slot *of) {
    uint64_t id = of->frame.frame_id, end_ns = now_ns() + at->link.wait_ms * NS_PER_MS;
    while (of->state != SLOT_FREE && of->frame.frame_id == id && at->link.is_welcome) {
        uint64_t begun_ns = now_ns();
        if (begun_ns >= end_ns) return;
        if (of->state == SLOT_SENT) link_wait(&at->link, end_ns - begun_ns);
        receive(at);
        exchange(at, NULL, NULL, end_ns - begun_ns);
    }
}

/* What is shown -------------------------------------------------------------------------------- */

static bool is_shown_valid(const session *at, XrTime time) {
    if (!at->is_shown) return false;
    if (now_ns() - at->shown.begun_ns > at->link.max_age_ms * NS_PER_MS)
        return false;
    return !(at->shown.frame.display_time_ns < at->recentered && at->recentered <= time);
}

typedef struct {
    XrCompositionLayerProjection layer;
    XrCompositionLayerProjectionView views[WIRE_EYES];
} substitute;

static void set_substitute(session *at, const plan *p, XrSpace base, substitute *made) {
    made->layer = *p->layer;
    made->layer.layerFlags = at->shown.flags;
    made->layer.space = base;
    made->layer.views = made->views;
    for (int eye = 0; eye < WIRE_EYES; ++eye) {
        const wire_view *view = at->shown.frame.views + eye;
        XrCompositionLayerProjectionView *to = made->views + eye;
        *to = (XrCompositionLayerProjectionView){.type = p->layer->views[eye].type};
        memcpy(&to->pose.position, view->position_m, sizeof view->position_m);
        memcpy(&to->pose.orientation, view->orientation, sizeof view->orientation);
        memcpy(&to->fov, view->fov_rad, sizeof view->fov_rad);
        to->subImage.swapchain = at->images[eye].handle;
        to->subImage.imageRect.extent.width = (int32_t)view->color.width_px;
        to->subImage.imageRect.extent.height = (int32_t)view->color.height_px;
    }
}

/* Return a layer without depth, which the runtime does not take. */
static const XrCompositionLayerBaseHeader *without_depth(session *at, const void *layer) {
    const XrCompositionLayerProjection *given = layer;
    XrCompositionLayerProjection *made =
        malloc(sizeof *made + given->viewCount * sizeof *given->views);
    if (!made) return layer;
    XrCompositionLayerProjectionView *views = (void *)(made + 1);
    *made = *given;
    memcpy(views, given->views, given->viewCount * sizeof *views);
    made->views = views;
    for (uint32_t i = 0; i < given->viewCount; ++i) {
        const XrCompositionLayerDepthInfoKHR *depth = depth_of(views[i].next);
        if (!depth) continue;
        if ((const void *)depth != views[i].next)
            LOG_ONCE(&at->told, SAID_CHAIN,
                     "structures before the depth of a view are not passed on");
        views[i].next = depth->next;
    }
    return (const XrCompositionLayerBaseHeader *)made;
}

static XrResult pass_on(session *at, const XrFrameEndInfo *info,
                        const XrCompositionLayerBaseHeader **layers) {
    XrFrameEndInfo mine = *info;
    mine.layers = layers;
    bool is_owned[MAX_LAYERS] = {false};
    for (uint32_t i = 0; at->own->is_depth_stripped && i < info->layerCount; ++i) {
        const XrCompositionLayerProjection *layer = (const void *)layers[i];
        if (!layer || layer->type != XR_TYPE_COMPOSITION_LAYER_PROJECTION) continue;
        layers[i] = without_depth(at, layer);
        is_owned[i] = (const void *)layers[i] != layer;
    }
    XrResult result = at->own->EndFrame(at->handle, &mine);
    for (uint32_t i = 0; i < info->layerCount; ++i)
        if (is_owned[i]) free((void *)(uintptr_t)layers[i]);
    return result;
}

XrResult frames_end(session *at, const XrFrameEndInfo *info) {
    if (!at->has_gl || !info->layers || info->layerCount > MAX_LAYERS)
        return at->own->EndFrame(at->handle, info);
    const XrCompositionLayerBaseHeader *layers[MAX_LAYERS];
    for (uint32_t i = 0; i < info->layerCount; ++i) layers[i] = info->layers[i];
    substitute made;
    pthread_mutex_lock(&at->lock);
    uint64_t begun_ns = now_ns();
    at->inside_ns = 0;
    receive(at);
    plan p;
    if (!at->link.is_welcome) {
        LOG_ONCE(&at->told, SAID_NO_HELPER,
                 "no helper is connected; trying again every second");
    } else if (make_plan(at, info, &p)) {
        ++at->frames;
        slot *to = take_slot(at, &p, info);
        exchange(at, &p, to, at->link.wait_ms * NS_PER_MS);
        if (to && at->link.wait_ms) await(at, to);
        XrSpace base = is_shown_valid(at, info->displayTime)
                           ? own_space(at, &at->shown.kind)
                           : XR_NULL_HANDLE;
        at->has_filtered |= base != XR_NULL_HANDLE;
        at->frames_lapsed += at->has_filtered && !base;
        if (base) {
            ++at->frames_filtered;
            set_substitute(at, &p, base, &made);
            layers[p.index] = (const XrCompositionLayerBaseHeader *)&made.layer;
        }
        uint64_t added_ns = now_ns() - begun_ns;
        at->other_ns += added_ns > at->inside_ns ? added_ns - at->inside_ns : 0;
    }
    pthread_mutex_unlock(&at->lock);
    return pass_on(at, info, layers);
}

void frames_close(session *at) {
    if (!at->has_gl) return;
    gl_current before;
    bool is_current = gl_enter(&at->gl, &before);
    if (is_current) {
        for (int i = 0; i < MAX_SLOTS; ++i) {
            if (at->slots[i].pixels) at->gl.DeleteBuffers(1, &at->slots[i].pixels);
            if (at->slots[i].is_read) at->gl.DeleteSync(at->slots[i].is_read);
        }
        at->gl.DeleteFramebuffers(1, &at->gl.read_framebuffer);
        at->gl.DeleteFramebuffers(1, &at->gl.draw_framebuffer);
        gl_leave(&at->gl, &before, false);
    }
    for (int eye = 0; eye < WIRE_EYES; ++eye)
        if (at->images[eye].handle) at->own->DestroySwapchain(at->images[eye].handle);
    for (unsigned i = 0; i < sizeof at->own_spaces / sizeof *at->own_spaces; ++i)
        if (at->own_spaces[i]) at->own->DestroySpace(at->own_spaces[i]);
    if (at->view_space) at->own->DestroySpace(at->view_space);
    if (at->gaze_space) at->own->DestroySpace(at->gaze_space);
    gl_close(&at->gl);
    link_close(&at->link);
    at->has_gl = false;
}

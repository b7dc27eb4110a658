#include <stdlib.h>
#include <string.h>

#include "frames.h"
#include "gaze.h"
#include "graphics.h"
#include "log.h"
#include "plan.h"

#define NS_PER_MS UINT64_C(1000000)
#define MAX_RESULTS 4
#define ALIGN(bytes) (((bytes) + 63) & ~(size_t)63)

/* Spaces of the layer's own -------------------------------------------------------------- */

static bool is_same_space(const reference_space *a, const reference_space *b) {
    return a->type == b->type && !memcmp(&a->pose, &b->pose, sizeof a->pose);
}

static XrSpace create_space(session *at, const reference_space *kind) {
    XrReferenceSpaceCreateInfo info = {.type = XR_TYPE_REFERENCE_SPACE_CREATE_INFO,
                                       .referenceSpaceType = kind->type,
                                       .poseInReferenceSpace = kind->pose};
    XrSpace made = XR_NULL_HANDLE;
    if (XR_FAILED(at->instance->CreateReferenceSpace(at->handle, &info, &made)))
        return XR_NULL_HANDLE;
    return made;
}

/* The application may destroy its space while a frame in it is filtered. */
static XrSpace own_space(session *at, const reference_space *kind) {
    for (unsigned i = 0; i < at->space_count && i < MAX_SPACES; ++i)
        if (is_same_space(at->space_kinds + i, kind)) return at->spaces[i];
    XrSpace made = create_space(at, kind);
    if (!made) return XR_NULL_HANDLE;
    unsigned i = at->space_count++ % MAX_SPACES;
    if (at->spaces[i]) at->instance->DestroySpace(at->spaces[i]);
    at->spaces[i] = made;
    at->space_kinds[i] = *kind;
    return made;
}

/* Find the pose of a space; false if it is unknown. */
static bool locate(session *at, XrSpace wanted, XrSpace base, XrTime time, XrPosef *pose) {
    XrSpaceLocation found = {.type = XR_TYPE_SPACE_LOCATION};
    const XrSpaceLocationFlags needed = XR_SPACE_LOCATION_ORIENTATION_VALID_BIT |
                                        XR_SPACE_LOCATION_POSITION_VALID_BIT;
    if (!wanted || !base ||
        XR_FAILED(at->instance->LocateSpace(wanted, base, time, &found)) ||
        (found.locationFlags & needed) != needed)
        return false;
    *pose = found.pose;
    return true;
}

static void locate_head(session *at, XrSpace base, XrTime time, wire_frame *wire) {
    XrPosef pose;
    if (!at->view_space) {
        const reference_space view = {XR_REFERENCE_SPACE_TYPE_VIEW,
                                      {.orientation.w = 1.0f}};
        at->view_space = create_space(at, &view);
    }
    if (!locate(at, at->view_space, base, time, &pose)) return;
    memcpy(wire->head, &pose.position, sizeof pose.position);
    memcpy(wire->head + 3, &pose.orientation, sizeof pose.orientation);
    wire->flags |= WIRE_HAS_HEAD;
}

/* Rotate a vector by a unit quaternion. */
static XrVector3f rotated(XrQuaternionf q, XrVector3f v) {
    XrVector3f t = {2 * (q.y * v.z - q.z * v.y), 2 * (q.z * v.x - q.x * v.z),
                    2 * (q.x * v.y - q.y * v.x)};
    return (XrVector3f){v.x + q.w * t.x + q.y * t.z - q.z * t.y,
                        v.y + q.w * t.y + q.z * t.x - q.x * t.z,
                        v.z + q.w * t.z + q.x * t.y - q.y * t.x};
}

/* Return a pose, given in a space, in that space's base. */
static XrPosef composed(const XrPosef *space, const XrPosef *pose) {
    XrQuaternionf a = space->orientation, b = pose->orientation;
    XrVector3f moved = rotated(a, pose->position);
    return (XrPosef){{a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
                      a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x,
                      a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w,
                      a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z},
                     {space->position.x + moved.x, space->position.y + moved.y,
                      space->position.z + moved.z}};
}

/* Find where the quads of a plan are.  From one on that is nowhere, they are left. */
static void locate_quads(session *at, plan *p, XrSpace base, XrTime time) {
    for (unsigned i = 0; i < p->quad_count; ++i) {
        XrPosef space;
        if (!locate(at, p->quads[i].layer->space, base, time, &space)) p->quad_count = i;
        else p->quads[i].pose = composed(&space, &p->quads[i].layer->pose);
    }
}

/* To the helper --------------------------------------------------------------------------- */

static size_t place(wire_image *image, size_t start, const XrSwapchainSubImage *part,
                    size_t pixel_bytes) {
    image->start = start;
    image->width_px = (uint32_t)part->imageRect.extent.width;
    image->height_px = (uint32_t)part->imageRect.extent.height;
    return start + ALIGN(pixel_bytes * image->width_px * image->height_px);
}

static size_t pixel_bytes(const image_format *format) {
    return format->wire == WIRE_LINEAR16F ? 8 : 4;
}

static size_t describe_quad(app_frame *frame, unsigned index, const planned_quad *given,
                            size_t bytes) {
    const XrCompositionLayerQuad *layer = given->layer;
    wire_quad *quad = frame->wire.quads + index;
    frame->quads[index] = layer->subImage;
    memcpy(quad->position_m, &given->pose.position, sizeof quad->position_m);
    memcpy(quad->orientation, &given->pose.orientation, sizeof quad->orientation);
    quad->size_m[0] = layer->size.width;
    quad->size_m[1] = layer->size.height;
    quad->color_format = given->chain->format->wire;
    quad->flags = given->chain->format->flags;
    if (layer->layerFlags & XR_COMPOSITION_LAYER_BLEND_TEXTURE_SOURCE_ALPHA_BIT)
        quad->flags |= WIRE_IS_BLENDED;
    if (layer->layerFlags & XR_COMPOSITION_LAYER_UNPREMULTIPLIED_ALPHA_BIT)
        quad->flags |= WIRE_IS_UNPREMULTIPLIED;
    quad->eyes = layer->eyeVisibility == XR_EYE_VISIBILITY_LEFT    ? 1
                 : layer->eyeVisibility == XR_EYE_VISIBILITY_RIGHT ? 2
                                                                   : 3;
    return place(&quad->color, bytes, &layer->subImage, pixel_bytes(given->chain->format));
}

/* Describe a frame; return the bytes of its images. */
static size_t describe(session *at, const plan *p, const XrFrameEndInfo *info) {
    app_frame *frame = &at->frame;
    wire_frame *wire = &frame->wire;
    *frame = (app_frame){.begun_ns = now_ns(),
                         .space = p->space,
                         .flags = p->layer->layerFlags,
                         .format = p->color[0]->info.format};
    const image_format *format = p->color[0]->format;
    *wire = (wire_frame){.kind = WIRE_FRAME,
                         .frame_id = at->next_frame++,
                         .display_time_ns = info->displayTime,
                         .flags = format->flags,
                         .color_format = format->wire};
    if (frame->flags & XR_COMPOSITION_LAYER_BLEND_TEXTURE_SOURCE_ALPHA_BIT)
        wire->flags |= WIRE_IS_BLENDED;
    size_t bytes = 0;
    for (int eye = 0; eye < WIRE_EYES; ++eye) {
        const XrCompositionLayerProjectionView *given = p->layer->views + eye;
        wire_view *view = wire->views + eye;
        memcpy(view->position_m, &given->pose.position, sizeof view->position_m);
        memcpy(view->orientation, &given->pose.orientation, sizeof view->orientation);
        memcpy(view->fov_rad, &given->fov, sizeof view->fov_rad);
        bytes = place(&view->color, bytes, &given->subImage, pixel_bytes(format));
    }
    for (int eye = 0; eye < WIRE_EYES; ++eye) {
        const XrCompositionLayerDepthInfoKHR *depth = p->depth_info[eye];
        wire_view *view = wire->views + eye;
        if (!depth) continue;
        bytes = place(&view->depth, bytes, &depth->subImage, sizeof(float));
        view->min_depth = depth->minDepth;
        view->max_depth = depth->maxDepth;
        view->near_m = depth->nearZ;
        view->far_m = depth->farZ;
    }
    for (unsigned i = 0; i < p->quad_count; ++i)
        bytes = describe_quad(frame, i, p->quads + i, bytes);
    return bytes;
}

/* Begin a frame for the helper; false if it is busy or there is no memory. */
static bool begin_frame(session *at, plan *p, const XrFrameEndInfo *info) {
    if (at->frame.state != FRAME_NONE) return false;
    XrSpace base = own_space(at, &p->space);
    locate_quads(at, p, base, info->displayTime);
    size_t bytes = describe(at, p, info);
    if (!link_share(&at->link, bytes)) {
        if (at->link.is_accepted)
            LOG_ONCE(&at->reported, REASON_MEMORY, "no shared memory for %zu bytes", bytes);
        return false;
    }
    locate_head(at, base, info->displayTime, &at->frame.wire);
    gaze_locate(at, info->displayTime, &at->frame.wire);
    return true;
}

/* Begin to read the copies of a frame. */
static read_state read_images(session *at, const plan *p) {
    image_read reads[2 * WIRE_EYES + WIRE_QUADS];
    size_t count = 0;
    for (int eye = 0; eye < WIRE_EYES; ++eye) {
        const wire_view *view = at->frame.wire.views + eye;
        reads[count++] = (image_read){p->color[eye], &p->layer->views[eye].subImage,
                                      view->color.start};
        if (p->depth[eye])
            reads[count++] = (image_read){p->depth[eye], &p->depth_info[eye]->subImage,
                                          view->depth.start};
    }
    for (unsigned i = 0; i < p->quad_count; ++i)
        reads[count++] = (image_read){p->quads[i].chain, &p->quads[i].layer->subImage,
                                      at->frame.wire.quads[i].color.start};
    return at->api->begin_read(at, reads, count);
}

static void clear_counts(session *at) {
    at->frames = at->frames_filtered = at->frames_fallback = 0;
    at->copy_ns = at->read_ns = at->upload_ns = at->other_ns = 0;
}

static void send_frame(session *at) {
    wire_frame *wire = &at->frame.wire;
    wire->frames = at->frames;
    wire->frames_filtered = at->frames_filtered;
    wire->frames_fallback = at->frames_fallback;
    wire->copy_us = (uint32_t)(at->copy_ns / 1000);
    wire->read_us = (uint32_t)(at->read_ns / 1000);
    wire->upload_us = (uint32_t)(at->upload_ns / 1000);
    wire->other_us = (uint32_t)(at->other_ns / 1000);
    at->frame.state = link_send(&at->link, wire) ? FRAME_SENT : FRAME_NONE;
    if (at->frame.state == FRAME_SENT) clear_counts(at);
}

/* From the helper ---------------------------------------------------------------------------- */

static void receive(session *at) {
    wire_result result;
    link_connect(&at->link);
    /* One result is due; a helper that floods the socket does not stop the application. */
    for (int i = 0; i < MAX_RESULTS && link_receive(&at->link, &result); ++i) {
        if (at->frame.state != FRAME_SENT || at->frame.wire.frame_id != result.frame_id)
            continue;
        at->frame.state = result.is_filtered ? FRAME_FILTERED : FRAME_NONE;
        if (!result.is_filtered) at->is_shown = false;
    }
    if (!at->link.is_lost) return;
    at->link.is_lost = at->is_shown = false;
    at->frame.state = FRAME_NONE;
    /* Counts are for each helper. */
    at->has_filtered = false;
    clear_counts(at);
}

static void add_time(session *at, uint64_t *stage_ns, uint64_t begun_ns) {
    uint64_t spent_ns = now_ns() - begun_ns;
    *stage_ns += spent_ns;
    at->inside_ns += spent_ns;
}

/* Upload the filtered frame, if there is one. */
static void take_result(session *at) {
    if (!at->link.is_accepted || at->frame.state != FRAME_FILTERED ||
        !own_images_acquire(at))
        return;
    uint64_t begun_ns = now_ns();
    image_write writes[WIRE_EYES];
    for (int eye = 0; eye < WIRE_EYES; ++eye)
        writes[eye] = (image_write){at->images + eye, &at->frame.wire.views[eye].color};
    bool is_written = at->api->write(at, writes, WIRE_EYES);
    add_time(at, &at->upload_ns, begun_ns);
    own_images_release(at, is_written);
}

/* Read the images of a plan, and send those that have been read. */
static void give_frame(session *at, const plan *p, uint64_t limit_ns) {
    if (!at->link.is_accepted || (!p && at->frame.state != FRAME_READING)) return;
    uint64_t begun_ns = now_ns();
    read_state read = p ? read_images(at, p) : READ_BEGUN;
    if (read == READ_BEGUN) read = at->api->finish_read(at, limit_ns);
    add_time(at, &at->read_ns, begun_ns);
    at->frame.state = read == READ_FAILED ? FRAME_NONE : FRAME_READING;
    if (read == READ_DONE) send_frame(at);
}

void frames_begin(session *at) {
    if (!at->api) return;
    pthread_mutex_lock(&at->lock);
    give_frame(at, NULL, 0);
    pthread_mutex_unlock(&at->lock);
}

/* Wait for the result of a frame, and upload it. */
static void await_result(session *at) {
    uint64_t id = at->frame.wire.frame_id;
    uint64_t end_ns = now_ns() + at->link.wait_ms * NS_PER_MS;
    while (at->frame.state != FRAME_NONE && at->frame.wire.frame_id == id &&
           at->link.is_accepted) {
        uint64_t begun_ns = now_ns();
        if (begun_ns >= end_ns) return;
        if (at->frame.state == FRAME_SENT) link_wait(&at->link, end_ns - begun_ns);
        receive(at);
        give_frame(at, NULL, end_ns - begun_ns);
        take_result(at);
        /* The runtime still reads the images, until this frame has ended. */
        if (at->frame.state == FRAME_FILTERED) return;
    }
}

/* What is shown -------------------------------------------------------------------------------- */

static bool is_shown_valid(session *at, XrTime time) {
    return at->is_shown &&
           now_ns() - at->shown.begun_ns <= at->link.max_age_ms * NS_PER_MS &&
           !is_recentered_between(at, at->shown.wire.display_time_ns, time);
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
        const wire_view *view = at->shown.wire.views + eye;
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
            LOG_ONCE(&at->reported, REASON_NEXT_CHAIN,
                     "structures before the depth of a view are not passed on");
        views[i].next = depth->next;
    }
    return (const XrCompositionLayerBaseHeader *)made;
}

static XrResult pass_on(session *at, const XrFrameEndInfo *info,
                        const XrCompositionLayerBaseHeader **layers, uint32_t count) {
    XrFrameEndInfo mine = *info;
    mine.layers = layers;
    mine.layerCount = count;
    bool is_owned[MAX_LAYERS] = {false};
    for (uint32_t i = 0; at->instance->is_depth_stripped && i < count; ++i) {
        const XrCompositionLayerProjection *layer = (const void *)layers[i];
        if (!layer || layer->type != XR_TYPE_COMPOSITION_LAYER_PROJECTION || !layer->views)
            continue;
        layers[i] = without_depth(at, layer);
        is_owned[i] = (const void *)layers[i] != layer;
    }
    XrResult result = at->instance->EndFrame(at->handle, &mine);
    for (uint32_t i = 0; i < count; ++i)
        if (is_owned[i]) free((void *)(uintptr_t)layers[i]);
    return result;
}

/* Exchange frames with the helper; return the space of a frame to show, or none. */
static XrSpace exchange(session *at, plan *p, const XrFrameEndInfo *info) {
    ++at->frames;
    take_result(at); /* first, so that the helper gets this frame */
    if (begin_frame(at, p, info)) {
        give_frame(at, p, at->link.wait_ms * NS_PER_MS);
        if (at->link.wait_ms) await_result(at);
    } else {
        give_frame(at, NULL, 0);
    }
    if (!is_shown_valid(at, info->displayTime)) return XR_NULL_HANDLE;
    return own_space(at, &at->shown.space);
}

/* Whether the frame that is shown contains a layer. */
static bool is_in_shown(const session *at, const XrCompositionLayerBaseHeader *layer) {
    if (!layer || layer->type != XR_TYPE_COMPOSITION_LAYER_QUAD) return false;
    const XrSwapchainSubImage *part = &((const XrCompositionLayerQuad *)layer)->subImage;
    for (int i = 0; i < WIRE_QUADS; ++i) {
        const XrSwapchainSubImage *own = at->shown.quads + i;
        if (own->swapchain && own->swapchain == part->swapchain &&
            own->imageArrayIndex == part->imageArrayIndex &&
            own->imageRect.offset.x == part->imageRect.offset.x &&
            own->imageRect.offset.y == part->imageRect.offset.y)
            return true;
    }
    return false;
}

/* Remove the quads that are in the frame that is shown; return how many layers remain. */
static uint32_t without_quads(const session *at, const plan *p, uint32_t count,
                              const XrCompositionLayerBaseHeader **layers) {
    uint32_t kept = p->index + 1;
    for (uint32_t i = p->index + 1; i < count; ++i)
        if (!is_in_shown(at, layers[i])) layers[kept++] = layers[i];
    return kept;
}

XrResult frames_end(session *at, const XrFrameEndInfo *info) {
    if (!info->layers || info->layerCount > MAX_LAYERS)
        return at->instance->EndFrame(at->handle, info);
    const XrCompositionLayerBaseHeader *layers[MAX_LAYERS];
    uint32_t count = info->layerCount;
    for (uint32_t i = 0; i < count; ++i) layers[i] = info->layers[i];
    if (!at->api) return pass_on(at, info, layers, count);
    substitute made;
    plan p;
    pthread_mutex_lock(&at->lock);
    uint64_t begun_ns = now_ns();
    at->inside_ns = 0;
    receive(at);
    if (!at->link.is_accepted) {
        LOG_ONCE(&at->reported, REASON_NO_HELPER,
                 "no helper is connected; trying again every second");
    } else if (make_plan(at, info, &p)) {
        XrSpace base = exchange(at, &p, info);
        at->has_filtered |= base != XR_NULL_HANDLE;
        at->frames_fallback += at->has_filtered && !base;
        if (base) {
            ++at->frames_filtered;
            set_substitute(at, &p, base, &made);
            layers[p.index] = (const XrCompositionLayerBaseHeader *)&made.layer;
            count = without_quads(at, &p, count, layers);
        }
        at->other_ns += now_ns() - begun_ns - at->inside_ns;
    }
    pthread_mutex_unlock(&at->lock);
    return pass_on(at, info, layers, count);
}

void frames_close(session *at) {
    if (!at->api) return;
    at->api->finish(at);
    own_images_destroy(at);
    for (unsigned i = 0; i < MAX_SPACES; ++i)
        if (at->spaces[i]) at->instance->DestroySpace(at->spaces[i]);
    if (at->view_space) at->instance->DestroySpace(at->view_space);
    if (at->gaze_space) at->instance->DestroySpace(at->gaze_space);
    at->api->close(at);
    link_close(&at->link);
    at->api = NULL;
}

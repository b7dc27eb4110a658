/* The cases, and how a session goes; the options are described in driver.h. */
#include "driver.h"

#include <unistd.h>

static const struct plan CASES[] = {
    {"plain", "two swapchains, both drawn each frame", .release_every = 1},
    {"array", "one swapchain of two layers", .is_array = true},
    {"wide", "one image with both views side by side", .is_wide = true},
    {"offset", "views are parts of larger images", .has_offset = true},
    {"msaa4", "images of four samples", .samples = 4},
    {"reuse", "drawn once, submitted each frame", .release_every = -1},
    {"half-rate", "drawn every second frame", .release_every = 2},
    {"two-layers", "a second projection, blended by its alpha", .projections = 2},
    {"quad-below", "a quad under the projection", .quad = -1},
    {"quad-above", "a quad over the projection", .quad = 1},
    {"quad-locked", "a quad in a VIEW space over the projection", .quad = 1,
     .is_quad_locked = true},
    {"quad-alpha", "a quad over the projection, blended by its alpha", .quad = 1,
     .has_quad_alpha = true},
    {"view-locked", "the projection is in a VIEW space", .is_view_locked = true},
    {"action-space", "the projection is in a space of an action",
     .in_action_space = true},
    {"space-destroyed", "another space every 10 frames", .renews_space = true},
    {"mono", "one view, of PRIMARY_MONO", .is_mono = true},
    {"other-thread", "another thread releases and ends", .other_thread = true},
    {"no-context", "releases and ends without a context", .no_context = true},
    {"restart", "three sessions, one after the other", .sessions = 3},
    {"end-from-thread", "the frames run in a thread", .ends_from_thread = true},
    {"second-session", "another session beside and after", .second = true},
    {"poll", "waits of no time for the images", .never_waits = true},
    {"dynamic-size", "another size every 5 frames", .is_dynamic = true},
    {"growing", "a larger part of the image from frame 60 on", .is_growing = true},
    {"hidden", "frames 10 to 24 have no layer", .is_hidden = true},
    {"other-context", "an unrelated context is current in releases and ends",
     .other_context = true},
    {"ahead", "another thread acquires while this one releases", .acquires_ahead = true},
    {"fork", "a child process that does nothing, from frame 20 on", .forks = true},
    {"fov-flipped", "angleUp below angleDown", .is_flipped = true},
    {"alpha", "a projection blended by its alpha", .has_alpha = true},
    {"device-lost", "the layer's calls lose the Vulkan device", .loses_device = true},
    {"wrong-layout", "images are released in another layout", .breaks_layout = true},
    {"violation", "errors that the runtime must report", .violates = true},
    {"depth-constant", "nothing but 1", .depth = CONSTANT},
    {"depth-nan", "not a number (with Mesa: 0) in every second column",
     .depth = NOT_A_NUMBER},
    {"depth-swapped", "nearZ and farZ exchanged", .depth = SWAPPED},
    {"depth-zero-near", "nearZ is 0", .depth = ZERO_NEAR},
    {"depth-equal", "nearZ is farZ", .depth = EQUAL},
    {"depth-range", "minDepth above maxDepth, or maxDepth above 1", .depth = RANGE},
    {"depth-size", "half the resolution of the color", .depth = SIZE},
    {"depth-stale", "released in the first frame only", .depth = STALE},
    {"depth-rect", "part outside of the image", .depth = RECT},
    {"depth-garbage", "noise", .depth = GARBAGE},
    {"depth-other-array",
     "each view has the depth of the other, at twice or half the "
     "distance",
     .is_array = true, .depth = OTHER_ARRAY},
};

static const struct {
    const char *name;
    GLenum opengl;
    VkFormat vulkan;
} FORMATS[] = {
    {"SRGB8_ALPHA8", GL_SRGB8_ALPHA8, VK_FORMAT_R8G8B8A8_SRGB},
    {"RGBA8", GL_RGBA8, VK_FORMAT_R8G8B8A8_UNORM},
    {"BGRA8_SRGB", GL_NONE, VK_FORMAT_B8G8R8A8_SRGB},
    {"BGRA8", GL_NONE, VK_FORMAT_B8G8R8A8_UNORM},
    {"RGB10_A2", GL_RGB10_A2, VK_FORMAT_A2B10G10R10_UNORM_PACK32},
    {"RGBA16F", GL_RGBA16F, VK_FORMAT_R16G16B16A16_SFLOAT},
    {"D16", GL_DEPTH_COMPONENT16, VK_FORMAT_D16_UNORM},
    {"D24", GL_DEPTH_COMPONENT24, VK_FORMAT_X8_D24_UNORM_PACK32},
    {"D32F", GL_DEPTH_COMPONENT32F, VK_FORMAT_D32_SFLOAT},
    {"D24S8", GL_DEPTH24_STENCIL8, VK_FORMAT_D24_UNORM_S8_UINT},
    {"D32FS8", GL_DEPTH32F_STENCIL8, VK_FORMAT_D32_SFLOAT_S8_UINT},
    {"none", GL_NONE, VK_FORMAT_UNDEFINED},
};

enum {
    QUAD_PX = 64,
    OFFSET_X_PX = 40,
    OFFSET_Y_PX = 24,
    GROWN_FRAME = 60,
    HIDDEN_FRAME = 10,
    SHOWN_FRAME = 25,
    FORK_FRAME = 20,
    CHILD_S = 20,
};

struct options options = {.frames = 30,
                          .distance_m = 2,
                          .near_z = 0.1f,
                          .far_z = 100};

/* --- swapchains ------------------------------------------------------------------ */

struct chain {
    XrSwapchain handle;
    uint64_t images[8];
    bool is_color;
    uint32_t width, height, layers, samples, index;
    bool is_acquired, is_ahead; /* ahead: the next image is acquired */
    uint32_t next_index;
};

/* The images of one layer: a swapchain for each view, or one for all. */
struct images {
    struct chain color[2], depth[2];
    uint32_t chain_count, view_count;
    bool has_depth, has_alpha;
    int first_view; /* 2 for a quad */
};

struct session {
    XrSession handle;
    XrSpace space, view_space, action_space;
    XrSessionState state;
    bool is_running, is_leaving, is_over;
    struct images images[2], quad;
    uint32_t view_count;
    XrView views[2]; /* of the pictures in the swapchains */
    int frame;       /* shown so far */
    int timeouts;    /* of waits for an image */
    XrTime time;
    XrSpace layer_space;
    double acquire_ms, wait_ms, release_ms, end_ms;
    pthread_t waiter;
    pthread_mutex_t lock;
    pthread_cond_t changed;
    bool has_waiter, has_state, is_waiter_done;
    XrFrameState waited;
};

static XrInstance instance;
static XrSystemId the_system;
static XrViewConfigurationType view_type;
static bool has_depth_extension, has_gaze;
static XrActionSet action_set;
static XrAction pose_action;
static pthread_mutex_t tell_lock = PTHREAD_MUTEX_INITIALIZER;

static void make_chain(const struct session *session, struct chain *chain,
                       int64_t format, uint32_t width, uint32_t height, uint32_t layers,
                       uint32_t samples) {
    bool is_color = format == options.color_format;
    XrSwapchainCreateInfo info = {
        .type = XR_TYPE_SWAPCHAIN_CREATE_INFO,
        .usageFlags = XR_SWAPCHAIN_USAGE_SAMPLED_BIT |
                      (is_color ? XR_SWAPCHAIN_USAGE_COLOR_ATTACHMENT_BIT
                                : XR_SWAPCHAIN_USAGE_DEPTH_STENCIL_ATTACHMENT_BIT |
                                      XR_SWAPCHAIN_USAGE_TRANSFER_DST_BIT),
        .format = format,
        .sampleCount = samples,
        .width = width,
        .height = height,
        .faceCount = 1,
        .arraySize = layers,
        .mipCount = 1,
    };
    *chain = (struct chain){
        .is_color = is_color,
        .width = width,
        .height = height,
        .layers = layers,
        .samples = samples,
    };
    MUST(xrCreateSwapchain(session->handle, &info, &chain->handle));
    union {
        XrSwapchainImageOpenGLKHR opengl[8];
        XrSwapchainImageVulkanKHR vulkan[8];
    } found;
    for (int i = 0; i < 8; i++)
        if (options.vulkan)
            found.vulkan[i] =
                (XrSwapchainImageVulkanKHR){.type = XR_TYPE_SWAPCHAIN_IMAGE_VULKAN_KHR};
        else
            found.opengl[i] =
                (XrSwapchainImageOpenGLKHR){.type = XR_TYPE_SWAPCHAIN_IMAGE_OPENGL_KHR};
    uint32_t count;
    MUST(xrEnumerateSwapchainImages(chain->handle, 8, &count,
                                    (XrSwapchainImageBaseHeader *)&found));
    for (uint32_t i = 0; i < count; i++)
        chain->images[i] = options.vulkan ? (uint64_t)found.vulkan[i].image
                                          : found.opengl[i].image;
}

static void make_images(const struct session *session, struct images *images,
                        const struct plan *plan) {
    uint32_t width = options.width, height = options.height, divisor = 1;
    if (plan->is_wide) width *= session->view_count;
    if (plan->has_offset) width += 2 * OFFSET_X_PX, height += 2 * OFFSET_Y_PX;
    if (plan->depth == SIZE) divisor = 2;
    images->view_count = session->view_count;
    images->chain_count = plan->is_array || plan->is_wide ? 1 : session->view_count;
    images->has_depth = options.depth_format != 0;
    images->has_alpha = plan->has_alpha;
    uint32_t layers = plan->is_array ? session->view_count : 1;
    uint32_t samples = plan->samples ? plan->samples : 1;
    for (uint32_t i = 0; i < images->chain_count; i++) {
        make_chain(session, &images->color[i], options.color_format, width, height,
                   layers, samples);
        if (images->has_depth)
            make_chain(session, &images->depth[i], options.depth_format,
                       width / divisor, height / divisor, layers, samples);
    }
}

static void acquire(struct session *session, struct chain *chain) {
    XrSwapchainImageWaitInfo info = {
        .type = XR_TYPE_SWAPCHAIN_IMAGE_WAIT_INFO,
        .timeout = options.plan.never_waits ? 0 : XR_INFINITE_DURATION};
    if (chain->is_ahead)
        chain->index = chain->next_index;
    else
        MUST_TIMED(session->acquire_ms,
                   xrAcquireSwapchainImage(chain->handle, NULL, &chain->index));
    chain->is_ahead = false;
    while (MUST_TIMED(session->acquire_ms,
                      xrWaitSwapchainImage(chain->handle, &info)) == XR_TIMEOUT_EXPIRED)
        session->timeouts++;
    chain->is_acquired = true;
}

static void *acquire_ahead(void *given) {
    struct chain *chain = given;
    must(xrAcquireSwapchainImage(chain->handle, NULL, &chain->next_index),
         "xrAcquireSwapchainImage");
    chain->is_ahead = true;
    return NULL;
}

static void release(struct session *session, struct chain *chain) {
    if (!chain->is_acquired) return;
    pthread_t thread;
    /* Two calls that may use the queue are not made at the same time. */
    if (options.plan.acquires_ahead && options.vulkan) acquire_ahead(chain);
    else if (options.plan.acquires_ahead)
        pthread_create(&thread, NULL, acquire_ahead, chain);
    may_use_queue = true;
    MUST_TIMED(session->release_ms, xrReleaseSwapchainImage(chain->handle, NULL));
    may_use_queue = false;
    if (options.plan.acquires_ahead && !options.vulkan) pthread_join(thread, NULL);
    chain->is_acquired = false;
}

static XrSwapchainSubImage part_of(const struct plan *plan, const struct chain *chain,
                                   uint32_t view, int frame) {
    int width = (int)options.width, height = (int)options.height;
    XrSwapchainSubImage part = {.swapchain = chain->handle};
    if (chain->width == QUAD_PX) width = height = QUAD_PX;
    if (plan->is_wide) part.imageRect.offset.x = (int)view * width;
    if (plan->has_offset)
        part.imageRect.offset = (XrOffset2Di){OFFSET_X_PX, OFFSET_Y_PX};
    if (plan->is_dynamic) width -= 16 * (frame / 5 % 4), height -= 8 * (frame / 5 % 4);
    if (plan->is_growing && frame < GROWN_FRAME) width -= 48, height -= 24;
    if (chain->width < (uint32_t)width) width = (int)chain->width;
    if (chain->height < (uint32_t)height) height = (int)chain->height;
    part.imageRect.extent = (XrExtent2Di){width, height};
    part.imageArrayIndex = plan->is_array ? view : 0;
    return part;
}

static struct vulkan_target target_of(const struct chain *chain, uint32_t layer) {
    bool is_color = chain->is_color;
    return (struct vulkan_target){
        .image = (VkImage)chain->images[chain->index],
        .format = (VkFormat)(is_color ? options.color_format : options.depth_format),
        .layer = chain->layers > 1 ? layer : 0,
        .width = chain->width,
        .height = chain->height};
}

/* A shader cannot write what is no number: it is clamped after it.  Mesa also clamps
 * what is uploaded by OpenGL, and stores 0; other drivers store it.  Noise is drawn by
 * a shader, except with Vulkan. */
static void spoil_depth(const struct chain *chain, bool is_noise) {
    size_t count = (size_t)chain->width * chain->height;
    float *values = malloc(count * sizeof *values);
    for (size_t i = 0; i < count; i++)
        values[i] = is_noise ? (float)rand() / (float)RAND_MAX
                    : i % 2  ? NAN
                             : window_depth(options.distance_m);
    if (options.vulkan) {
        const struct vulkan_target target = target_of(chain, 0);
        copy_depth_with_vulkan(&target, values);
    } else {
        glBindTexture(GL_TEXTURE_2D, (GLuint)chain->images[chain->index]);
        glTexSubImage2D(GL_TEXTURE_2D, 0, 0, 0, (GLsizei)chain->width,
                        (GLsizei)chain->height, GL_DEPTH_COMPONENT, GL_FLOAT, values);
    }
    free(values);
}

static void attach_image(GLenum point, const struct chain *chain, uint32_t layer) {
    attach(point, chain ? (GLuint)chain->images[chain->index] : 0,
           chain && chain->layers > 1, layer);
}

static void draw_view(const struct plan *plan, const struct images *images,
                      uint32_t view, int frame) {
    const struct chain *color = &images->color[view % images->chain_count];
    const struct chain *depth = &images->depth[view % images->chain_count];
    float distance_m =
        options.distance_m * (plan->depth == OTHER_ARRAY && view ? 2 : 1);
    struct picture picture = {
        .frame = frame,
        .view = images->first_view + (int)view,
        .part = part_of(plan, color, view, frame).imageRect,
        .is_flipped = plan->is_flipped,
        .has_alpha = images->has_alpha,
        .has_noise = plan->depth == GARBAGE,
        .depth = plan->depth == CONSTANT ? 1 : window_depth(distance_m),
    };
    bool has_depth = images->has_depth && depth->is_acquired;
    if (options.vulkan) {
        const struct vulkan_target drawn = target_of(color, view);
        const struct vulkan_target behind = target_of(depth, view);
        draw_with_vulkan(&picture, &drawn, has_depth ? &behind : NULL);
        if (has_depth && (plan->depth == NOT_A_NUMBER || plan->depth == GARBAGE))
            spoil_depth(depth, plan->depth == GARBAGE);
        return;
    }
    bool is_apart = has_depth && depth->width != color->width; /* of another size */
    attach_image(GL_COLOR_ATTACHMENT0, color, view);
    attach_image(GL_DEPTH_ATTACHMENT, has_depth && !is_apart ? depth : NULL, view);
    draw_picture(&picture);
    if (is_apart) {
        attach_image(GL_COLOR_ATTACHMENT0, NULL, 0);
        attach_image(GL_DEPTH_ATTACHMENT, depth, view);
        draw_picture(&picture);
    }
    if (plan->depth == NOT_A_NUMBER && has_depth) spoil_depth(depth, false);
}

static void draw(struct session *session, const struct plan *plan,
                 struct images *images) {
    for (uint32_t i = 0; i < images->chain_count; i++) {
        acquire(session, &images->color[i]);
        if (images->has_depth && !(plan->depth == STALE && session->frame))
            acquire(session, &images->depth[i]);
    }
    if (options.check_state) set_usual_state();
    if (!options.vulkan) {
        glEnable(GL_DEPTH_TEST);
        glDepthFunc(GL_ALWAYS);
    }
    for (uint32_t i = 0; i < images->view_count; i++)
        draw_view(plan, images, i, session->frame);
    if (options.check_state) set_unusual_state();
}

static void release_images(struct session *session, struct images *images) {
    for (uint32_t i = 0; i < images->chain_count; i++) {
        release(session, &images->color[i]);
        release(session, &images->depth[i]);
    }
}

static void destroy_images(const struct images *images) {
    if (options.vulkan) forget_vulkan_views();
    for (uint32_t i = 0; i < images->chain_count; i++) {
        MUST(xrDestroySwapchain(images->color[i].handle));
        if (images->has_depth) MUST(xrDestroySwapchain(images->depth[i].handle));
    }
}

/* --- layers ---------------------------------------------------------------------- */

struct layers {
    XrCompositionLayerProjection projections[2];
    XrCompositionLayerProjectionView views[2][2];
    XrCompositionLayerDepthInfoKHR depths[2][2];
    XrCompositionLayerQuad quad;
    const XrCompositionLayerBaseHeader *list[3];
    uint32_t count;
};

static void describe_depth(XrCompositionLayerDepthInfoKHR *depth,
                           const struct plan *plan, const struct images *images,
                           uint32_t view, int frame) {
    const struct chain *chain = &images->depth[view % images->chain_count];
    *depth = (XrCompositionLayerDepthInfoKHR){
        .type = XR_TYPE_COMPOSITION_LAYER_DEPTH_INFO_KHR,
        .subImage = part_of(plan, chain, view, frame),
        .maxDepth = 1,
        .nearZ = options.near_z,
        .farZ = options.far_z,
    };
    switch (plan->depth) {
    case SWAPPED: depth->nearZ = options.far_z, depth->farZ = options.near_z; break;
    case ZERO_NEAR: depth->nearZ = 0; break;
    case EQUAL: depth->nearZ = depth->farZ = 1; break;
    case RANGE:
        depth->minDepth = frame % 2 ? 0 : 0.8f;
        depth->maxDepth = frame % 2 ? 1.5f : 0.2f;
        break;
    case RECT: depth->subImage.imageRect.offset.x = (int)chain->width / 2; break;
    case OTHER_ARRAY: depth->subImage.imageArrayIndex = 1 - view; break;
    default: break;
    }
}

static void describe_layers(struct session *session, struct layers *layers) {
    const struct plan *plan = &options.plan;
    const struct plan plain = {.has_alpha = true};
    memset(layers, 0, sizeof *layers);
    layers->quad = (XrCompositionLayerQuad){
        .type = XR_TYPE_COMPOSITION_LAYER_QUAD,
        .space = plan->is_quad_locked ? session->view_space : session->layer_space,
        .pose = {{0, 0, 0, 1}, {0, 0, -1}},
        .size = {0.3f, 0.3f},
    };
    if (plan->has_quad_alpha)
        layers->quad.layerFlags = XR_COMPOSITION_LAYER_BLEND_TEXTURE_SOURCE_ALPHA_BIT |
                                  XR_COMPOSITION_LAYER_UNPREMULTIPLIED_ALPHA_BIT;
    if (plan->quad)
        layers->quad.subImage = part_of(&plain, &session->quad.color[0], 0, 0);
    const void *quad = &layers->quad;
    if (plan->quad < 0) layers->list[layers->count++] = quad;
    int projections = plan->projections ? plan->projections : 1;
    for (int k = 0; k < projections; k++) {
        const struct plan *own = k ? &plain : plan;
        const struct images *images = &session->images[k];
        for (uint32_t i = 0; i < session->view_count; i++) {
            XrCompositionLayerProjectionView *view = &layers->views[k][i];
            view->type = XR_TYPE_COMPOSITION_LAYER_PROJECTION_VIEW;
            view->pose = session->views[i].pose;
            view->fov = session->views[i].fov;
            if (plan->is_flipped) {
                view->fov.angleUp = session->views[i].fov.angleDown;
                view->fov.angleDown = session->views[i].fov.angleUp;
            }
            const struct chain *color = &images->color[i % images->chain_count];
            view->subImage = part_of(own, color, i, session->frame);
            describe_depth(&layers->depths[k][i], own, images, i, session->frame);
            if (has_depth_extension && images->has_depth)
                view->next = &layers->depths[k][i];
        }
        layers->projections[k] = (XrCompositionLayerProjection){
            .type = XR_TYPE_COMPOSITION_LAYER_PROJECTION,
            .space = session->layer_space,
            .viewCount = session->view_count,
            .views = layers->views[k],
        };
        if (images->has_alpha)
            layers->projections[k].layerFlags =
                XR_COMPOSITION_LAYER_BLEND_TEXTURE_SOURCE_ALPHA_BIT |
                XR_COMPOSITION_LAYER_UNPREMULTIPLIED_ALPHA_BIT;
        layers->list[layers->count++] = (const void *)&layers->projections[k];
    }
    if (plan->quad > 0) layers->list[layers->count++] = quad;
}

/* --- frames ---------------------------------------------------------------------- */

static void tell_frame(const struct session *session, XrResult result) {
    pthread_mutex_lock(&tell_lock);
    printf("{\"frame\": %d, \"session\": %llu, \"display_time\": %lld, \"views\": [",
           session->frame, (unsigned long long)(uintptr_t)session->handle,
           (long long)session->time);
    for (uint32_t i = 0; i < session->view_count; i++) {
        const XrPosef *p = &session->views[i].pose;
        const XrFovf *f = &session->views[i].fov;
        const float numbers[] = {p->position.x,    p->position.y,    p->position.z,
                                 p->orientation.x, p->orientation.y, p->orientation.z,
                                 p->orientation.w, f->angleLeft,     f->angleRight,
                                 f->angleUp,       f->angleDown};
        printf("%s[", i ? ", " : "");
        for (int k = 0; k < 11; k++)
            printf("%s\"%a\"", k ? ", " : "", (double)numbers[k]);
        printf("]");
    }
    printf(
        "], \"acquire_ms\": %.3f, \"release_ms\": %.3f, \"end_frame_ms\": %.3f, "
        "\"end_frame\": \"%s\"}\n",
        session->acquire_ms, session->release_ms, session->end_ms, code_name(result));
    fflush(stdout);
    pthread_mutex_unlock(&tell_lock);
}

static XrResult end_frame(struct session *session, const struct layers *layers) {
    XrFrameEndInfo info = {
        .type = XR_TYPE_FRAME_END_INFO,
        .displayTime = session->time,
        .environmentBlendMode = XR_ENVIRONMENT_BLEND_MODE_OPAQUE,
        .layerCount = layers ? layers->count : 0,
        .layers = layers ? layers->list : NULL,
    };
    may_use_queue = true;
    XrResult result = TIMED(session->end_ms, xrEndFrame(session->handle, &info));
    may_use_queue = false;
    /* A runtime may refuse depth that is not valid. */
    if (!options.plan.depth) must(result, "xrEndFrame");
    return result;
}

static void release_and_end(struct session *session) {
    struct layers layers;
    for (int i = 0; i < 2; i++) release_images(session, &session->images[i]);
    release_images(session, &session->quad);
    describe_layers(session, &layers);
    if (options.plan.is_hidden && session->frame >= HIDDEN_FRAME &&
        session->frame < SHOWN_FRAME)
        layers.count = 0;
    tell_frame(session, end_frame(session, &layers));
}

/* The same with a context current that shares nothing with the session's. */
static void finish_in_other_context(struct session *session) {
    static struct context_handles other;
    struct context_handles ours = graphics.context;
    glFinish();
    if (!other.egl && !other.glx) other = new_context();
    graphics.context = other;
    make_current(true);
    release_and_end(session);
    GLenum error = glGetError();
    graphics.context = ours;
    make_current(true);
    if (error) fail("xrEndFrame", "it left an OpenGL error in the current context");
}

/* A child inherits all descriptors. */
static void fork_child(void) {
    fflush(stdout);
    if (fork()) return;
    close(STDOUT_FILENO); /* whoever reads them waits for their end */
    close(STDERR_FILENO);
    sleep(CHILD_S);
    _exit(0);
}

/* Release what was drawn, and submit it. */
static void finish_frame(struct session *session) {
    if (options.plan.forks && session->frame == FORK_FRAME) fork_child();
    if (options.plan.other_context) finish_in_other_context(session);
    else release_and_end(session);
}

static void *finish_in_thread(void *session) {
    make_current(true);
    finish_frame(session);
    make_current(false);
    return NULL;
}

static void *wait_in_thread(void *given) {
    struct session *session = given;
    pthread_mutex_lock(&session->lock);
    while (!session->is_waiter_done) {
        if (session->has_state) {
            pthread_cond_wait(&session->changed, &session->lock);
            continue;
        }
        pthread_mutex_unlock(&session->lock);
        XrFrameState state = {.type = XR_TYPE_FRAME_STATE};
        MUST(xrWaitFrame(session->handle, NULL, &state));
        pthread_mutex_lock(&session->lock);
        session->waited = state;
        session->has_state = true;
        pthread_cond_broadcast(&session->changed);
    }
    pthread_mutex_unlock(&session->lock);
    return NULL;
}

static XrFrameState wait_frame(struct session *session) {
    XrFrameState state = {.type = XR_TYPE_FRAME_STATE};
    if (!options.threads) {
        MUST_TIMED(session->wait_ms, xrWaitFrame(session->handle, NULL, &state));
        return state;
    }
    if (!session->has_waiter) {
        session->has_waiter = true;
        session->is_waiter_done = session->has_state = false;
        pthread_create(&session->waiter, NULL, wait_in_thread, session);
    }
    pthread_mutex_lock(&session->lock);
    while (!session->has_state) pthread_cond_wait(&session->changed, &session->lock);
    state = session->waited;
    session->has_state = false;
    pthread_cond_broadcast(&session->changed);
    pthread_mutex_unlock(&session->lock);
    return state;
}

/* End the thread that waits for frames; a frame that it waited for takes its course. */
static void end_waiter(struct session *session) {
    if (!session->has_waiter) return;
    pthread_mutex_lock(&session->lock);
    session->is_waiter_done = true;
    pthread_cond_broadcast(&session->changed);
    pthread_mutex_unlock(&session->lock);
    pthread_join(session->waiter, NULL);
    session->has_waiter = false;
    if (!session->has_state) return;
    MUST(xrBeginFrame(session->handle, NULL));
    session->time = session->waited.predictedDisplayTime;
    end_frame(session, NULL);
}

static XrSpace reference_space(const struct session *session,
                               XrReferenceSpaceType type) {
    XrReferenceSpaceCreateInfo info = {
        .type = XR_TYPE_REFERENCE_SPACE_CREATE_INFO,
        .referenceSpaceType = type,
        .poseInReferenceSpace = {{0, 0, 0, 1}, {0, 0, 0}}};
    XrSpace space;
    MUST(xrCreateReferenceSpace(session->handle, &info, &space));
    return space;
}

static void locate_views(struct session *session) {
    const struct plan *plan = &options.plan;
    session->layer_space = plan->is_view_locked    ? session->view_space
                           : plan->in_action_space ? session->action_space
                                                   : session->space;
    XrViewLocateInfo info = {.type = XR_TYPE_VIEW_LOCATE_INFO,
                             .viewConfigurationType = view_type,
                             .displayTime = session->time,
                             .space = session->layer_space};
    XrViewState state = {.type = XR_TYPE_VIEW_STATE};
    uint32_t count;
    for (int i = 0; i < 2; i++) session->views[i] = (XrView){.type = XR_TYPE_VIEW};
    MUST_TIMED(session->wait_ms, xrLocateViews(session->handle, &info, &state, 2,
                                               &count, session->views));
    for (int i = 0; i < 2; i++) /* without a location: at the origin */
        if (!(state.viewStateFlags & XR_VIEW_STATE_ORIENTATION_VALID_BIT))
            session->views[i].pose = (XrPosef){{0, 0, 0, 1}, {0, 0, 0}};
}

static void violate(struct session *session);

static void show_frame(struct session *session) {
    const struct plan *plan = &options.plan;
    session->acquire_ms = session->release_ms = session->end_ms = 0;
    XrFrameState state = wait_frame(session);
    session->time = state.predictedDisplayTime;
    MUST_TIMED(session->wait_ms, xrBeginFrame(session->handle, NULL));
    if (action_set) {
        XrActiveActionSet active = {.actionSet = action_set};
        XrActionsSyncInfo info = {.type = XR_TYPE_ACTIONS_SYNC_INFO,
                                  .countActiveActionSets = 1,
                                  .activeActionSets = &active};
        MUST(xrSyncActions(session->handle, &info));
    }
    if (!state.shouldRender || session->frame == options.frames) {
        end_frame(session, NULL);
        return;
    }
    if (plan->violates && session->frame == options.frames / 2) violate(session);
    int every = plan->release_every ? plan->release_every : 1;
    if (every < 0 ? !session->frame : session->frame % every == 0) {
        const struct plan plain = {.has_alpha = true};
        locate_views(session);
        draw(session, plan, &session->images[0]);
        if (plan->projections > 1) draw(session, &plain, &session->images[1]);
        if (plan->quad) draw(session, &plain, &session->quad);
    }
    if (plan->other_thread) {
        pthread_t other;
        make_current(false);
        pthread_create(&other, NULL, finish_in_thread, session);
        pthread_join(other, NULL);
        make_current(true);
    } else if (plan->no_context) {
        if (!options.vulkan) glFlush();
        make_current(false);
        finish_frame(session);
        make_current(true);
    } else {
        finish_frame(session);
    }
    session->frame++;
    if (plan->renews_space && session->frame % 10 == 0) {
        MUST(xrDestroySpace(session->space));
        session->space = reference_space(session, XR_REFERENCE_SPACE_TYPE_LOCAL);
    }
}

/* --- what no application may do -------------------------------------------------- */

static void tell_violation(const char *what, XrResult result) {
    printf("{\"violation\": \"%s\", \"code\": \"%s\"}\n", what, code_name(result));
}

/* Within a frame, do what is wrong, and go on as if it had not been tried. */
static void violate(struct session *session) {
    struct images *images = &session->images[0];
    struct chain never;
    struct layers right, wrong;
    XrFrameEndInfo info = {.type = XR_TYPE_FRAME_END_INFO,
                           .displayTime = session->time,
                           .environmentBlendMode = XR_ENVIRONMENT_BLEND_MODE_OPAQUE,
                           .layerCount = 1,
                           .layers = wrong.list};
    XrSpace gone = reference_space(session, XR_REFERENCE_SPACE_TYPE_LOCAL);
    MUST(xrDestroySpace(gone));
    make_chain(session, &never, options.color_format, options.width, options.height, 1,
               1);
    describe_layers(session, &right);
    right.list[0] = (const void *)&wrong.projections[0];
    right.projections[0].views = wrong.views[0];
    XrBaseInStructure unknown = {.type = (XrStructureType)1234567};
#define TRY(what, change) \
    wrong = right; \
    change; \
    tell_violation(what, xrEndFrame(session->handle, &info))
    TRY("rect", wrong.views[0][0].subImage.imageRect.offset.x = 1);
    TRY("array index", wrong.views[0][1].subImage.imageArrayIndex = 7);
    TRY("never released", wrong.views[0][0].subImage.swapchain = never.handle);
    TRY("space", wrong.projections[0].space = gone);
    TRY("pose", wrong.views[0][0].pose.orientation.w = 3);
    TRY("fov", wrong.views[0][0].fov.angleUp = NAN);
    TRY("view count", wrong.projections[0].viewCount = 1);
    TRY("chain", wrong.views[0][0].next = &unknown);
    TRY("flags", wrong.projections[0].layerFlags = 1 << 30);
    TRY("depth for color",
        wrong.views[0][0].subImage.swapchain = images->depth[0].handle);
    TRY("depth rect", wrong.depths[0][1].subImage.imageRect.offset.y = -1;
        wrong.views[0][1].next = &wrong.depths[0][1]);
    TRY("blend mode", info.environmentBlendMode = XR_ENVIRONMENT_BLEND_MODE_ADDITIVE);
    info.environmentBlendMode = XR_ENVIRONMENT_BLEND_MODE_OPAQUE;
    TRY("layer type", wrong.projections[0].type = XR_TYPE_VIEW);
    TRY("time", info.displayTime = 0);
    MUST(xrDestroySwapchain(never.handle));
    tell_violation("swapchain", xrDestroySwapchain(never.handle));
    XrSwapchainImageWaitInfo wait = {.type = XR_TYPE_SWAPCHAIN_IMAGE_WAIT_INFO};
    tell_violation("wait", xrWaitSwapchainImage(images->color[0].handle, &wait));
    tell_violation("release", xrReleaseSwapchainImage(images->color[0].handle, NULL));
    if (!options.threads) /* where the next frame has been waited for, it may begin */
        tell_violation("begin", xrBeginFrame(session->handle, NULL));
    tell_violation("end session", xrEndSession(session->handle));
    XrInstanceProperties properties = {.type = XR_TYPE_INSTANCE_PROPERTIES};
    struct context_handles ours = graphics.context;
    graphics.context = new_context();
    make_current(true); /* as a layer would that forgets to restore the context */
    tell_violation("context", xrGetInstanceProperties(instance, &properties));
    graphics.context = ours;
    make_current(true);
}

/* --- sessions -------------------------------------------------------------------- */

static void make_actions(void) {
    XrActionSetCreateInfo set = {.type = XR_TYPE_ACTION_SET_CREATE_INFO,
                                 .actionSetName = "driver",
                                 .localizedActionSetName = "Driver"};
    MUST(xrCreateActionSet(instance, &set, &action_set));
    XrActionCreateInfo action = {.type = XR_TYPE_ACTION_CREATE_INFO,
                                 .actionName = "pose",
                                 .actionType = XR_ACTION_TYPE_POSE_INPUT,
                                 .localizedActionName = "Pose"};
    MUST(xrCreateAction(action_set, &action, &pose_action));
    XrPath profile, path;
    MUST(xrStringToPath(instance,
                        has_gaze ? "/interaction_profiles/ext/eye_gaze_interaction"
                                 : "/interaction_profiles/khr/simple_controller",
                        &profile));
    MUST(xrStringToPath(instance,
                        has_gaze ? "/user/eyes_ext/input/gaze_ext/pose"
                                 : "/user/hand/left/input/aim/pose",
                        &path));
    XrActionSuggestedBinding binding = {pose_action, path};
    XrInteractionProfileSuggestedBinding suggested = {
        .type = XR_TYPE_INTERACTION_PROFILE_SUGGESTED_BINDING,
        .interactionProfile = profile,
        .countSuggestedBindings = 1,
        .suggestedBindings = &binding};
    MUST(xrSuggestInteractionProfileBindings(instance, &suggested));
}

static XrResult create_session(struct session *session) {
    XrGraphicsBindingEGLMNDX egl = {
        .type = XR_TYPE_GRAPHICS_BINDING_EGL_MNDX,
        .getProcAddress = (PFN_xrEglGetProcAddressMNDX)eglGetProcAddress,
        .display = graphics.egl_display,
        .config = graphics.egl_config,
        .context = graphics.context.egl};
    XrGraphicsBindingOpenGLXlibKHR glx = {
        .type = XR_TYPE_GRAPHICS_BINDING_OPENGL_XLIB_KHR,
        .xDisplay = graphics.x_display,
        .visualid = (uint32_t)graphics.visual,
        .glxFBConfig = graphics.glx_config,
        .glxDrawable = graphics.window,
        .glxContext = graphics.context.glx};
    XrGraphicsBindingVulkanKHR vulkan = vulkan_binding();
    XrSessionCreateInfo info = {.type = XR_TYPE_SESSION_CREATE_INFO,
                                .next = options.vulkan ? (void *)&vulkan
                                        : options.glx  ? (void *)&glx
                                                       : (void *)&egl,
                                .systemId = the_system};
    memset(session, 0, sizeof *session);
    pthread_mutex_init(&session->lock, NULL);
    pthread_cond_init(&session->changed, NULL);
    return xrCreateSession(instance, &info, &session->handle);
}

static void furnish(struct session *session) {
    const struct plan *plan = &options.plan;
    const struct plan plain = {.has_alpha = true};
    session->view_count = plan->is_mono ? 1 : 2;
    session->space = reference_space(session, XR_REFERENCE_SPACE_TYPE_LOCAL);
    session->view_space = reference_space(session, XR_REFERENCE_SPACE_TYPE_VIEW);
    if (action_set) {
        XrSessionActionSetsAttachInfo attached = {
            .type = XR_TYPE_SESSION_ACTION_SETS_ATTACH_INFO,
            .countActionSets = 1,
            .actionSets = &action_set};
        MUST(xrAttachSessionActionSets(session->handle, &attached));
        XrActionSpaceCreateInfo info = {.type = XR_TYPE_ACTION_SPACE_CREATE_INFO,
                                        .action = pose_action,
                                        .poseInActionSpace = {{0, 0, 0, 1}, {0, 0, 0}}};
        MUST(xrCreateActionSpace(session->handle, &info, &session->action_space));
    }
    make_images(session, &session->images[0], plan);
    if (plan->projections > 1) make_images(session, &session->images[1], &plain);
    if (plan->quad) {
        session->quad.chain_count = session->quad.view_count = 1;
        session->quad.first_view = 2;
        session->quad.has_alpha = plan->has_quad_alpha;
        make_chain(session, &session->quad.color[0], options.color_format, QUAD_PX,
                   QUAD_PX, 1, 1);
    }
}

static void destroy_session(struct session *session) {
    for (int i = 0; i < 2; i++) destroy_images(&session->images[i]);
    destroy_images(&session->quad);
    MUST(xrDestroySpace(session->space));
    MUST(xrDestroySpace(session->view_space));
    MUST(xrDestroySession(session->handle));
    pthread_mutex_destroy(&session->lock);
    pthread_cond_destroy(&session->changed);
}

static void enter_state(struct session *session, XrSessionState state) {
    session->state = state;
    if (state == XR_SESSION_STATE_READY) {
        XrSessionBeginInfo info = {.type = XR_TYPE_SESSION_BEGIN_INFO,
                                   .primaryViewConfigurationType = view_type};
        MUST(xrBeginSession(session->handle, &info));
        session->is_running = true;
    } else if (state == XR_SESSION_STATE_STOPPING && !options.plan.ends_from_thread) {
        end_waiter(session);
        session->is_running = false;
        MUST(xrEndSession(session->handle));
    } else if (state == XR_SESSION_STATE_EXITING) {
        session->is_over = true;
    }
}

static void take_events(struct session *sessions, int count) {
    XrEventDataBuffer event = {.type = XR_TYPE_EVENT_DATA_BUFFER};
    while (MUST(xrPollEvent(instance, &event)) == XR_SUCCESS) {
        const XrEventDataSessionStateChanged *change = (const void *)&event;
        for (int i = 0; i < count; i++)
            if (event.type == XR_TYPE_EVENT_DATA_SESSION_STATE_CHANGED &&
                change->session == sessions[i].handle)
                enter_state(&sessions[i], change->state);
        event = (XrEventDataBuffer){.type = XR_TYPE_EVENT_DATA_BUFFER};
    }
}

static void rest(void) { nanosleep(&(struct timespec){0, 1000000}, NULL); }

/* Show frames in each session in turn until all are over. */
static void run_sessions(struct session *sessions, int count) {
    int over = 0;
    while (over < count) {
        take_events(sessions, count);
        over = 0;
        for (int i = 0; i < count; i++) {
            struct session *session = &sessions[i];
            over += session->is_over;
            if (!session->is_running) {
                rest();
                continue;
            }
            show_frame(session);
            if (session->frame == options.frames && !session->is_leaving) {
                session->is_leaving = true;
                MUST(xrRequestExitSession(session->handle));
            }
        }
    }
}

static void *frames_in_thread(void *given) {
    struct session *session = given;
    make_current(true);
    pthread_mutex_lock(&session->lock);
    while (session->is_running) {
        pthread_mutex_unlock(&session->lock);
        show_frame(session);
        pthread_mutex_lock(&session->lock);
        session->is_leaving = session->frame == options.frames;
    }
    pthread_mutex_unlock(&session->lock);
    make_current(false);
    return NULL;
}

/* The frames run in a thread, and everything else here.  As the specification demands,
 * no other call is in progress when the session ends and when it is destroyed. */
static void run_frames_in_thread(struct session *session) {
    pthread_t frames;
    bool has_asked = false;
    make_current(false);
    while (!session->is_running) take_events(session, 1), rest();
    pthread_create(&frames, NULL, frames_in_thread, session);
    while (session->state != XR_SESSION_STATE_STOPPING) {
        rest();
        pthread_mutex_lock(&session->lock);
        bool is_leaving = session->is_leaving;
        pthread_mutex_unlock(&session->lock);
        if (is_leaving && !has_asked) MUST(xrRequestExitSession(session->handle));
        has_asked |= is_leaving;
        take_events(session, 1);
    }
    pthread_mutex_lock(&session->lock);
    session->is_running = false;
    pthread_mutex_unlock(&session->lock);
    pthread_join(frames, NULL);
    end_waiter(session);
    MUST(xrEndSession(session->handle));
    while (!session->is_over) take_events(session, 1), rest();
}

static int shown, timeouts; /* of all sessions */

static void run(struct session *sessions, int count) {
    for (int i = 0; i < count; i++) furnish(&sessions[i]);
    if (options.plan.ends_from_thread) run_frames_in_thread(sessions);
    else run_sessions(sessions, count);
    for (int i = 0; i < count; i++) {
        shown += sessions[i].frame;
        timeouts += sessions[i].timeouts;
        destroy_session(&sessions[i]);
    }
}

/* --- instance -------------------------------------------------------------------- */

static XrResult create_instance(XrInstance *made_instance) {
    const char *const WANTED[] = {options.vulkan == 1 ? XR_KHR_VULKAN_ENABLE_EXTENSION_NAME
                                  : options.vulkan
                                      ? XR_KHR_VULKAN_ENABLE2_EXTENSION_NAME
                                      : XR_KHR_OPENGL_ENABLE_EXTENSION_NAME,
                                         XR_MNDX_EGL_ENABLE_EXTENSION_NAME,
                                         XR_KHR_COMPOSITION_LAYER_DEPTH_EXTENSION_NAME,
                                         XR_EXT_EYE_GAZE_INTERACTION_EXTENSION_NAME};
    XrExtensionProperties offered[128];
    for (int i = 0; i < 128; i++)
        offered[i] = (XrExtensionProperties){.type = XR_TYPE_EXTENSION_PROPERTIES};
    uint32_t count = 0;
    MUST(xrEnumerateInstanceExtensionProperties(NULL, 128, &count, offered));
    const char *enabled[4];
    uint32_t enabled_count = 0;
    bool has[4] = {false};
    for (int k = 0; k < 4; k++) {
        for (uint32_t i = 0; i < count; i++)
            has[k] |= !strcmp(offered[i].extensionName, WANTED[k]);
        bool is_needed = k != 1 || !(options.glx || options.vulkan);
        if (has[k] && is_needed) enabled[enabled_count++] = WANTED[k];
    }
    if (!has[0] || (!has[1] && !options.glx && !options.vulkan))
        skip("the runtime does not take this graphics API");
    has_depth_extension = has[2];
    has_gaze = has[3];
    XrInstanceCreateInfo info = {
        .type = XR_TYPE_INSTANCE_CREATE_INFO,
        .applicationInfo = {.applicationName = "driver",
                            .apiVersion = XR_MAKE_VERSION(1, 0, 0)},
        .enabledExtensionCount = enabled_count,
        .enabledExtensionNames = enabled};
    return xrCreateInstance(&info, made_instance);
}

static void open_instance(void) {
    MUST(create_instance(&instance));
    XrSystemGetInfo info = {.type = XR_TYPE_SYSTEM_GET_INFO,
                            .formFactor = XR_FORM_FACTOR_HEAD_MOUNTED_DISPLAY};
    MUST(xrGetSystem(instance, &info, &the_system));
    if (options.vulkan) {
        open_vulkan(instance, the_system);
    } else {
        PFN_xrGetOpenGLGraphicsRequirementsKHR ask;
        MUST(xrGetInstanceProcAddr(instance, "xrGetOpenGLGraphicsRequirementsKHR",
                                   (PFN_xrVoidFunction *)&ask));
        XrGraphicsRequirementsOpenGLKHR needed = {
            .type = XR_TYPE_GRAPHICS_REQUIREMENTS_OPENGL_KHR};
        MUST(ask(instance, the_system, &needed));
    }
    view_type = options.plan.is_mono ? XR_VIEW_CONFIGURATION_TYPE_PRIMARY_MONO
                                     : XR_VIEW_CONFIGURATION_TYPE_PRIMARY_STEREO;
    XrViewConfigurationView views[2] = {{.type = XR_TYPE_VIEW_CONFIGURATION_VIEW},
                                        {.type = XR_TYPE_VIEW_CONFIGURATION_VIEW}};
    uint32_t count;
    XrResult result = xrEnumerateViewConfigurationViews(instance, the_system, view_type,
                                                        2, &count, views);
    if (result == XR_ERROR_VIEW_CONFIGURATION_TYPE_UNSUPPORTED)
        skip("the runtime has no such views");
    must(result, "xrEnumerateViewConfigurationViews");
    if (!options.width) {
        options.width = views[0].recommendedImageRectWidth;
        options.height = views[0].recommendedImageRectHeight;
    }
    if (options.plan.in_action_space) make_actions();
}

/* What the runtime permits: a session beside the first, an instance beside it. */
static void run_with_second(struct session *sessions) {
    MUST(create_session(&sessions[0]));
    XrResult beside = create_session(&sessions[1]);
    XrInstance other = XR_NULL_HANDLE;
    XrResult second = create_instance(&other);
    printf("{\"session_beside\": \"%s\", \"instance_beside\": \"%s\"}\n",
           code_name(beside), code_name(second));
    if (XR_SUCCEEDED(second)) MUST(xrDestroyInstance(other));
    run(sessions, XR_SUCCEEDED(beside) ? 2 : 1);
    MUST(xrDestroyInstance(instance));
    open_instance();
    MUST(create_session(&sessions[0]));
    run(sessions, 1);
}

/* --- arguments ------------------------------------------------------------------- */

static int64_t format_of(const char *name) {
    for (size_t i = 0; i < LENGTH(FORMATS); i++)
        if (!strcmp(FORMATS[i].name, name))
            return options.vulkan ? (int64_t)FORMATS[i].vulkan : FORMATS[i].opengl;
    fprintf(stderr, "driver: no format '%s'\n", name);
    exit(2);
}

static void read_arguments(int count, char **arguments) {
    bool is_case = false;
    const char *color_format = "SRGB8_ALPHA8", *depth_format = "D32F";
    for (size_t i = 0; i < LENGTH(CASES); i++)
        if (count > 1 && !strcmp(arguments[1], CASES[i].name))
            options.plan = CASES[i], is_case = true;
    for (size_t i = 0; !is_case && i < LENGTH(CASES); i++)
        fprintf(stderr, "%-18s %s\n", CASES[i].name, CASES[i].words);
    if (!is_case) exit(2);
    for (int i = 2; i < count; i++) {
        const char *name = arguments[i], *value = i + 1 < count ? arguments[i + 1] : "";
        if (!strcmp(name, "--glx")) options.glx = true;
        else if (!strcmp(name, "--threads")) options.threads = true;
        else if (!strcmp(name, "--check-state")) options.check_state = true;
        else if (!strcmp(name, "--validate")) options.validate = true;
        else {
            i++;
            if (!strcmp(name, "--frames")) options.frames = atoi(value);
            else if (!strcmp(name, "--size"))
                sscanf(value, "%ux%u", &options.width, &options.height);
            else if (!strcmp(name, "--vulkan")) options.vulkan = atoi(value);
            else if (!strcmp(name, "--format")) color_format = value;
            else if (!strcmp(name, "--depth")) depth_format = value;
            else if (!strcmp(name, "--distance-m"))
                options.distance_m = strtof(value, NULL);
            else if (!strcmp(name, "--near-z")) options.near_z = strtof(value, NULL);
            else if (!strcmp(name, "--far-z")) options.far_z = strtof(value, NULL);
            else {
                fprintf(stderr, "driver: no option '%s'\n", name);
                exit(2);
            }
        }
    }
    options.color_format = format_of(color_format);
    options.depth_format = format_of(depth_format);
}

int main(int count, char **arguments) {
    read_arguments(count, arguments);
    struct session sessions[2];
    if (!options.vulkan) {
        if (options.glx) open_glx();
        else open_egl();
        make_current(true);
        make_drawing();
    }
    if (options.check_state) make_unusual_objects();
    open_instance();
    if (options.check_state) set_unusual_state();
    if (options.plan.second) {
        run_with_second(sessions);
    } else {
        for (int i = 0; i < (options.plan.sessions ? options.plan.sessions : 1); i++) {
            if (!options.vulkan && !has_context()) make_current(true);
            MUST(create_session(sessions));
            run(sessions, 1);
        }
    }
    MUST(xrDestroyInstance(instance));
    if (options.vulkan) close_vulkan();
    else close_graphics();
    printf(
        "{\"case\": \"%s\", \"frames\": %d, \"timeouts\": %d, "
        "\"checked_state\": %s}\n",
        options.plan.name, shown, timeouts, options.check_state ? "true" : "false");
    return 0;
}

/* What is submitted, written to files. */
#include <errno.h>
#include <sys/stat.h>

#include "mock.h"

/* Read a part of a texture, the same bytes as stored, from a context of our own. */
static void read_pixels(const struct object *swapchain, int image, XrRect2Di part,
                        uint32_t layer, void *pixels, GLsizei size) {
    const struct format *format = swapchain->swapchain.format;
    GLuint texture = swapchain->swapchain.textures[image], resolved = 0;
    int x = part.offset.x, y = part.offset.y;
    GLint z = (GLint)layer;
    if (swapchain->swapchain.info.sampleCount > 1) { /* no function reads samples */
        GLenum point = format->is_depth ? GL_DEPTH_ATTACHMENT : GL_COLOR_ATTACHMENT0;
        GLuint framebuffers[2];
        int width = part.extent.width, height = part.extent.height;
        glCreateTextures(GL_TEXTURE_2D, 1, &resolved);
        glTextureStorage2D(resolved, 1, format->internal, width, height);
        glCreateFramebuffers(2, framebuffers);
        if (swapchain->swapchain.info.arraySize > 1)
            glNamedFramebufferTextureLayer(framebuffers[0], point, texture, 0, z);
        else glNamedFramebufferTexture(framebuffers[0], point, texture, 0);
        glNamedFramebufferTexture(framebuffers[1], point, resolved, 0);
        glEnable(GL_FRAMEBUFFER_SRGB); /* samples are averaged as light */
        glBlitNamedFramebuffer(
            framebuffers[0], framebuffers[1], x, y, x + width, y + height, 0, 0, width,
            height, format->is_depth ? GL_DEPTH_BUFFER_BIT : GL_COLOR_BUFFER_BIT,
            GL_NEAREST);
        glDeleteFramebuffers(2, framebuffers);
        texture = resolved;
        x = y = z = 0;
    }
    glPixelStorei(GL_PACK_ALIGNMENT, 1);
    glGetTextureSubImage(texture, 0, x, y, z, part.extent.width, part.extent.height, 1,
                         format->layout, format->type, size, pixels);
    glDeleteTextures(1, &resolved);
    GLenum error = glGetError();
    if (error) fprintf(stderr, "mock: reading a texture failed: 0x%x\n", error);
}

/* One view of a layer, or a quad, with its depth if it has any. */
struct capture {
    FILE *file; /* NULL: nothing is captured */
    const char *folder;
    int64_t number;
    bool has_pixels;
    uint32_t layer;
};

static void write_floats(FILE *file, const char *name, const float *values, int count) {
    fprintf(file, "\"%s\": [", name);
    for (int i = 0; i < count; i++)
        fprintf(file, "%s\"%a\"", i ? ", " : "", (double)values[i]);
    fprintf(file, "]");
}

static void write_pose(FILE *file, const XrPosef *pose) {
    const XrVector3f *p = &pose->position;
    const XrQuaternionf *q = &pose->orientation;
    write_floats(file, "pose", (float[]){p->x, p->y, p->z, q->x, q->y, q->z, q->w}, 7);
}

static void write_space(FILE *file, const struct object *space) {
    static const char *const TYPES[] = {"ACTION", "VIEW", "LOCAL", "STAGE"};
    XrReferenceSpaceType type = space->space.type;
    fprintf(file, "\"space\": {\"id\": %llu, \"kind\": \"%s\", ",
            (unsigned long long)space->id,
            type == XR_REFERENCE_SPACE_TYPE_LOCAL_FLOOR ? "LOCAL_FLOOR" : TYPES[type]);
    write_pose(file, &space->space.pose);
    fprintf(file, "}, ");
}

/* Write what a part of a swapchain is, and its pixels. */
static void capture_image(const struct capture *to, const XrSwapchainSubImage *part,
                          uint32_t view, const char *what) {
    const struct object *swapchain = find(SWAPCHAIN, ID(part->swapchain));
    const struct format *format = swapchain->swapchain.format;
    XrRect2Di rect = part->imageRect;
    fprintf(to->file,
            "\"swapchain\": %llu, \"image\": %d, \"releases\": %llu, "
            "\"format\": \"%s\", \"samples\": %u, \"rect\": [%d, %d, %d, %d], "
            "\"array_index\": %u",
            (unsigned long long)swapchain->id, swapchain->swapchain.released,
            (unsigned long long)swapchain->swapchain.release_count, format->name,
            swapchain->swapchain.info.sampleCount, rect.offset.x, rect.offset.y,
            rect.extent.width, rect.extent.height, part->imageArrayIndex);
    bool is_vulkan = swapchain->parent->session.vulkan.device;
    fprintf(to->file, ", \"usage\": %llu",
            (unsigned long long)swapchain->swapchain.info.usageFlags);
    if (!to->has_pixels || (is_vulkan && !can_read_vulkan(swapchain))) return;
    size_t size =
        (size_t)rect.extent.width * (size_t)rect.extent.height * format->pixel_bytes;
    void *pixels = calloc(1, size);
    int released = swapchain->swapchain.released;
    if (is_vulkan)
        read_vulkan_pixels(swapchain, released, rect, part->imageArrayIndex, pixels);
    else
        read_pixels(swapchain, released, rect, part->imageArrayIndex, pixels,
                    (GLsizei)size);
    char name[64], path[4096];
    snprintf(name, sizeof name, "%06lld_%u_%u_%s.bin", (long long)to->number, to->layer,
             view, what);
    snprintf(path, sizeof path, "%s/%s", to->folder, name);
    FILE *file = fopen(path, "wb");
    if (!file || fwrite(pixels, 1, size, file) != size)
        fprintf(stderr, "mock: %s: %s\n", path, strerror(errno));
    if (file) fclose(file);
    free(pixels);
    fprintf(to->file, ", \"file\": \"%s\"", name);
}

static void capture_view(const struct capture *to, uint32_t index,
                         const XrCompositionLayerProjectionView *view) {
    FILE *file = to->file;
    fprintf(file, "%s{", index ? ", " : "");
    write_pose(file, &view->pose);
    fprintf(file, ", ");
    write_floats(file, "fov",
                 (float[]){view->fov.angleLeft, view->fov.angleRight, view->fov.angleUp,
                           view->fov.angleDown},
                 4);
    fprintf(file, ", ");
    capture_image(to, &view->subImage, index, "color");
    const XrCompositionLayerDepthInfoKHR *depth =
        chained_structure(view->next, XR_TYPE_COMPOSITION_LAYER_DEPTH_INFO_KHR);
    if (depth && check_sub_image(find(SWAPCHAIN, ID(depth->subImage.swapchain))->parent,
                                 &depth->subImage, true) == XR_SUCCESS) {
        fprintf(file, ", \"depth\": {");
        write_floats(
            file, "range_and_planes",
            (float[]){depth->minDepth, depth->maxDepth, depth->nearZ, depth->farZ}, 4);
        fprintf(file, ", ");
        capture_image(to, &depth->subImage, index, "depth");
        fprintf(file, "}");
    }
    fprintf(file, "}");
}

static void capture_layer(struct capture *to,
                          const XrCompositionLayerBaseHeader *layer) {
    FILE *file = to->file;
    bool is_quad = layer->type == XR_TYPE_COMPOSITION_LAYER_QUAD;
    fprintf(file, "%s{\"type\": \"%s\", \"flags\": %llu, ", to->layer ? ", " : "",
            is_quad ? "quad" : "projection", (unsigned long long)layer->layerFlags);
    write_space(file, find(SPACE, ID(layer->space)));
    if (is_quad) {
        const XrCompositionLayerQuad *quad = (const void *)layer;
        fprintf(file, "\"eyes\": %d, ", (int)quad->eyeVisibility);
        write_pose(file, &quad->pose);
        fprintf(file, ", ");
        write_floats(file, "size", (float[]){quad->size.width, quad->size.height}, 2);
        fprintf(file, ", ");
        capture_image(to, &quad->subImage, 0, "color");
    } else {
        const XrCompositionLayerProjection *projection = (const void *)layer;
        fprintf(file, "\"views\": [");
        for (uint32_t i = 0; i < projection->viewCount; i++)
            capture_view(to, i, &projection->views[i]);
        fprintf(file, "]");
    }
    fprintf(file, "}");
}

void capture_frame(struct object *session, const XrFrameEndInfo *info) {
    const char *folder = setting("MOCK_XR_CAPTURE", NULL);
    if (!folder) return;
    char path[4096];
    snprintf(path, sizeof path, "%s/frames.jsonl", folder);
    mkdir(folder, 0777);
    long every = number_setting("MOCK_XR_CAPTURE_EVERY", 1);
    int64_t number = session->session.number;
    struct capture to = {fopen(path, "a"), folder, number,
                         every > 0 && number % every == 0, 0};
    if (!to.file) {
        fprintf(stderr, "mock: %s: %s\n", path, strerror(errno));
        return;
    }
    bool is_vulkan = session->session.vulkan.device;
    struct borrowed saved = {0};
    if (!is_vulkan) {
        saved = borrow();
        to.has_pixels = set_current(&session->session.own) && to.has_pixels;
    }
    fprintf(to.file,
            "{\"frame\": %lld, \"session\": %llu, \"display_time\": %lld, "
            "\"predicted_display_time\": %lld, \"layers\": [",
            (long long)number, (unsigned long long)session->id,
            (long long)info->displayTime, (long long)session->session.time);
    for (; to.layer < info->layerCount; to.layer++)
        capture_layer(&to, info->layers[to.layer]);
    fprintf(to.file, "]}\n");
    fclose(to.file);
    if (!is_vulkan) give_back(&saved);
}

/* Swapchains: textures, and who has them. */
#include "mock.h"

#include <limits.h>

#define DEPTH_PIXELS GL_DEPTH_COMPONENT, GL_FLOAT, 4, true, 0, 0
static const struct format FORMATS[] = {
    {"GL_SRGB8_ALPHA8", GL_SRGB8_ALPHA8, GL_RGBA, GL_UNSIGNED_BYTE, 4, false, 0, 0},
    {"GL_RGBA8", GL_RGBA8, GL_RGBA, GL_UNSIGNED_BYTE, 4, false, 0, 0},
    {"GL_RGB10_A2", GL_RGB10_A2, GL_RGBA, GL_UNSIGNED_INT_2_10_10_10_REV, 4, false, 0, 0},
    {"GL_RGBA16F", GL_RGBA16F, GL_RGBA, GL_HALF_FLOAT, 8, false, 0, 0},
    {"GL_DEPTH_COMPONENT16", GL_DEPTH_COMPONENT16, DEPTH_PIXELS},
    {"GL_DEPTH_COMPONENT24", GL_DEPTH_COMPONENT24, DEPTH_PIXELS},
    {"GL_DEPTH_COMPONENT32F", GL_DEPTH_COMPONENT32F, DEPTH_PIXELS},
    {"GL_DEPTH24_STENCIL8", GL_DEPTH24_STENCIL8, DEPTH_PIXELS},
    {"GL_DEPTH32F_STENCIL8", GL_DEPTH32F_STENCIL8, DEPTH_PIXELS},
};
enum { N_FORMATS = sizeof FORMATS / sizeof *FORMATS, MAX_FORMATS = 32 };

static bool is_vulkan(const struct object *session) {
    return session->session.vulkan.device;
}

/* Return the formats of a session's API, and how many there are. */
static const struct format *formats_of(const struct object *session, size_t *count) {
    *count = is_vulkan(session) ? N_VULKAN_FORMATS : N_FORMATS;
    return is_vulkan(session) ? VULKAN_FORMATS : FORMATS;
}

XrResult XRAPI_CALL xrEnumerateSwapchainFormats(XrSession session, uint32_t capacity,
                                                uint32_t *count, int64_t *formats) {
    ENTER;
    FIND(found, SESSION, session);
    int64_t offered[MAX_FORMATS];
    uint32_t n = 0;
    size_t known;
    const struct format *own = formats_of(found, &known);
    const char *list = setting("MOCK_XR_FORMATS", NULL), *word;
    size_t length;
    for (size_t i = 0; !list && i < known; i++) offered[n++] = own[i].internal;
    while (list && n < known && (word = next_word(&list, &length)))
        for (size_t i = 0; i < known; i++)
            if (length == strlen(own[i].name) && !strncmp(word, own[i].name, length))
                offered[n++] = own[i].internal;
    TWO_CALLS(capacity, count, n);
    memcpy(formats, offered, n * sizeof *formats);
    return XR_SUCCESS;
}

static bool make_textures(struct object *swapchain) {
    const XrSwapchainCreateInfo *info = &swapchain->swapchain.info;
    GLsizei width = (GLsizei)info->width, height = (GLsizei)info->height;
    GLsizei layers = (GLsizei)info->arraySize, samples = (GLsizei)info->sampleCount;
    GLenum format = (GLenum)info->format;
    bool is_array = layers > 1;
    GLenum target = samples > 1 ? is_array ? GL_TEXTURE_2D_MULTISAMPLE_ARRAY
                                           : GL_TEXTURE_2D_MULTISAMPLE
                    : is_array  ? GL_TEXTURE_2D_ARRAY
                                : GL_TEXTURE_2D;
    glGenTextures((GLsizei)swapchain->swapchain.image_count,
                  swapchain->swapchain.textures);
    for (uint32_t i = 0; i < swapchain->swapchain.image_count; i++) {
        glBindTexture(target, swapchain->swapchain.textures[i]);
        GLsizei mips = (GLsizei)info->mipCount;
        if (samples > 1 && is_array)
            glTexStorage3DMultisample(target, samples, format, width, height, layers,
                                      GL_TRUE);
        else if (samples > 1)
            glTexStorage2DMultisample(target, samples, format, width, height, GL_TRUE);
        else if (is_array) glTexStorage3D(target, mips, format, width, height, layers);
        else glTexStorage2D(target, mips, format, width, height);
    }
    glBindTexture(target, 0);
    glFinish(); /* before another context uses them */
    return glGetError() == GL_NO_ERROR;
}

XrResult XRAPI_CALL xrCreateSwapchain(XrSession session,
                                      const XrSwapchainCreateInfo *info,
                                      XrSwapchain *swapchain) {
    ENTER;
    FIND(found, SESSION, session);
    STRUCTURE(info, XR_TYPE_SWAPCHAIN_CREATE_INFO);
    const struct format *format = NULL;
    size_t known;
    const struct format *own = formats_of(found, &known);
    for (size_t i = 0; i < known; i++)
        if (own[i].internal == (GLenum)info->format) format = &own[i];
    REQUIRE(format && strstr(setting("MOCK_XR_FORMATS", format->name), format->name),
            XR_ERROR_SWAPCHAIN_FORMAT_UNSUPPORTED, "format 0x%llx is not offered",
            (long long)info->format);
    REQUIRE(info->width && info->height && info->width <= MAX_SIZE_PX &&
                info->height <= MAX_SIZE_PX && info->arraySize && info->mipCount &&
                info->faceCount && info->sampleCount && info->sampleCount <= 4,
            XR_ERROR_VALIDATION_FAILURE, "%u x %u x %u, %u samples", info->width,
            info->height, info->arraySize, info->sampleCount);
    if (info->faceCount != 1 ||
        info->createFlags & XR_SWAPCHAIN_CREATE_PROTECTED_CONTENT_BIT)
        return XR_ERROR_FEATURE_UNSUPPORTED;
    XrResult result = is_vulkan(found) ? XR_SUCCESS : finish_application(found);
    if (result != XR_SUCCESS) return result;
    static long made_count;
    if (made_count++ >= number_setting("MOCK_XR_MAX_SWAPCHAINS", LONG_MAX))
        return XR_ERROR_OUT_OF_MEMORY;
    struct object *made = create(SWAPCHAIN, found);
    made->swapchain.info = *info;
    made->swapchain.info.next = NULL;
    made->swapchain.format = format;
    made->swapchain.released = -1;
    made->swapchain.image_count =
        info->createFlags & XR_SWAPCHAIN_CREATE_STATIC_IMAGE_BIT ? 1 : N_IMAGES;
    bool is_made;
    if (is_vulkan(found)) {
        is_made = make_vulkan_images(made);
    } else {
        struct borrowed saved = borrow();
        is_made = set_current(&found->session.own) && make_textures(made);
        give_back(&saved);
    }
    made->is_alive = is_made;
    REQUIRE(is_made, XR_ERROR_RUNTIME_FAILURE, "the graphics API made no images");
    *swapchain = HANDLE(XrSwapchain, made);
    return XR_SUCCESS;
}

void destroy_swapchain(struct object *swapchain) {
    swapchain->is_alive = false;
    if (is_vulkan(swapchain->parent)) {
        destroy_vulkan_images(swapchain);
        return;
    }
    struct borrowed saved = borrow();
    if (set_current(&swapchain->parent->session.own))
        glDeleteTextures((GLsizei)swapchain->swapchain.image_count,
                         swapchain->swapchain.textures);
    give_back(&saved);
}

XrResult XRAPI_CALL xrDestroySwapchain(XrSwapchain swapchain) {
    ENTER;
    struct object *found = find(SWAPCHAIN, ID(swapchain));
    REQUIRE(found, XR_ERROR_HANDLE_INVALID, "there is no such swapchain");
    destroy_swapchain(found);
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrEnumerateSwapchainImages(XrSwapchain swapchain, uint32_t capacity,
                                               uint32_t *count,
                                               XrSwapchainImageBaseHeader *images) {
    ENTER;
    FIND(found, SWAPCHAIN, swapchain);
    TWO_CALLS(capacity, count, found->swapchain.image_count);
    XrSwapchainImageVulkanKHR *own = (XrSwapchainImageVulkanKHR *)images;
    for (uint32_t i = 0; is_vulkan(found->parent) && i < *count; i++) {
        STRUCTURE(&own[i], XR_TYPE_SWAPCHAIN_IMAGE_VULKAN_KHR);
        own[i].image = found->swapchain.images[i];
    }
    if (is_vulkan(found->parent)) return XR_SUCCESS;
    XrSwapchainImageOpenGLKHR *textures = (XrSwapchainImageOpenGLKHR *)images;
    for (uint32_t i = 0; i < *count; i++) {
        STRUCTURE(&textures[i], XR_TYPE_SWAPCHAIN_IMAGE_OPENGL_KHR);
        textures[i].image = found->swapchain.textures[i];
    }
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrAcquireSwapchainImage(XrSwapchain swapchain,
                                            const XrSwapchainImageAcquireInfo *info,
                                            uint32_t *index) {
    ENTER;
    FIND(found, SWAPCHAIN, swapchain);
    if (info) STRUCTURE(info, XR_TYPE_SWAPCHAIN_IMAGE_ACQUIRE_INFO);
    REQUIRE(found->swapchain.acquired_count < found->swapchain.image_count,
            XR_ERROR_CALL_ORDER_INVALID, "all images of swapchain %llu are acquired",
            (unsigned long long)found->id);
    REQUIRE(found->swapchain.image_count > 1 || !found->swapchain.release_count,
            XR_ERROR_CALL_ORDER_INVALID, "a static image is acquired again");
    *index = found->swapchain.next;
    if (is_vulkan(found->parent)) ready_vulkan_image(found, *index);
    found->swapchain.next = (*index + 1) % found->swapchain.image_count;
    found->swapchain.acquired[found->swapchain.acquired_count++] = *index;
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrWaitSwapchainImage(XrSwapchain swapchain,
                                         const XrSwapchainImageWaitInfo *info) {
    ENTER;
    FIND(found, SWAPCHAIN, swapchain);
    STRUCTURE(info, XR_TYPE_SWAPCHAIN_IMAGE_WAIT_INFO);
    REQUIRE(found->swapchain.acquired_count, XR_ERROR_CALL_ORDER_INVALID,
            "no image of swapchain %llu is acquired", (unsigned long long)found->id);
    REQUIRE(!found->swapchain.waited_count, XR_ERROR_CALL_ORDER_INVALID,
            "an image of swapchain %llu was waited for and not released",
            (unsigned long long)found->id);
    static long waits_in_vain; /* so far */
    if (info->timeout == 0 &&
        waits_in_vain < number_setting("MOCK_XR_WAIT_TIMEOUTS", 0)) {
        waits_in_vain++;
        return XR_TIMEOUT_EXPIRED;
    }
    found->swapchain.waited_count = 1;
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrReleaseSwapchainImage(XrSwapchain swapchain,
                                            const XrSwapchainImageReleaseInfo *info) {
    ENTER;
    FIND(found, SWAPCHAIN, swapchain);
    if (info) STRUCTURE(info, XR_TYPE_SWAPCHAIN_IMAGE_RELEASE_INFO);
    REQUIRE(found->swapchain.waited_count, XR_ERROR_CALL_ORDER_INVALID,
            "no image of swapchain %llu was waited for", (unsigned long long)found->id);
    XrResult result = finish_application(found->parent);
    if (result != XR_SUCCESS) return result;
    found->swapchain.released = (int)found->swapchain.acquired[0];
    found->swapchain.release_count++;
    found->swapchain.waited_count = 0;
    found->swapchain.acquired_count--;
    memmove(found->swapchain.acquired, found->swapchain.acquired + 1,
            found->swapchain.acquired_count * sizeof *found->swapchain.acquired);
    return XR_SUCCESS;
}

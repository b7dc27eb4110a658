/* Swapchains of the layer's own, which show filtered images. */
#include "frames.h"
#include "graphics.h"
#include "log.h"

static void destroy_image(session *at, own_image *image) {
    if (image->handle) at->instance->DestroySwapchain(image->handle);
    *image = (own_image){0};
}

void own_images_destroy(session *at) {
    for (int eye = 0; eye < WIRE_EYES; ++eye) destroy_image(at, at->images + eye);
}

static bool fill_image(session *at, own_image *image) {
    XrSwapchainCreateInfo info = {.type = XR_TYPE_SWAPCHAIN_CREATE_INFO,
                                  .usageFlags = XR_SWAPCHAIN_USAGE_COLOR_ATTACHMENT_BIT |
                                                XR_SWAPCHAIN_USAGE_SAMPLED_BIT |
                                                XR_SWAPCHAIN_USAGE_TRANSFER_DST_BIT,
                                  .format = image->format,
                                  .sampleCount = 1,
                                  .width = image->width_px,
                                  .height = image->height_px,
                                  .faceCount = 1,
                                  .arraySize = 1,
                                  .mipCount = 1};
    if (XR_FAILED(at->instance->CreateSwapchain(at->handle, &info, &image->handle))) {
        image->handle = XR_NULL_HANDLE;
        return false;
    }
    image->image_count = at->api->find_images(at, image->handle, image->images);
    return image->image_count;
}

static bool create_image(session *at, own_image *image, const wire_image *color) {
    bool is_same_format = image->handle && image->format == at->frame.format;
    if (is_same_format && image->width_px >= color->width_px &&
        image->height_px >= color->height_px)
        return true;
    /* Sizes that change with the frame rate must not create a swapchain per frame. */
    uint32_t width_px = color->width_px, height_px = color->height_px;
    if (is_same_format && width_px < image->width_px) width_px = image->width_px;
    if (is_same_format && height_px < image->height_px) height_px = image->height_px;
    at->is_shown = false; /* a new swapchain has no image yet */
    /* Before xrDestroySwapchain, all commands that refer to its images must complete. */
    if (image->handle) at->api->finish(at);
    destroy_image(at, image);
    image->format = at->frame.format;
    image->width_px = width_px;
    image->height_px = height_px;
    if (fill_image(at, image)) return true;
    destroy_image(at, image);
    return false;
}

bool own_images_acquire(session *at) {
    for (int eye = 0; eye < WIRE_EYES; ++eye) {
        own_image *image = at->images + eye;
        if (!create_image(at, image, &at->frame.wire.views[eye].color)) {
            LOG_ONCE(&at->reported, REASON_SWAPCHAIN,
                     "the runtime provides no swapchain for filtered images");
            at->frame.state = FRAME_NONE; /* try again with the next result */
            return false;
        }
        if (!image->is_acquired)
            image->is_acquired = XR_SUCCEEDED(
                at->instance->AcquireSwapchainImage(image->handle, NULL, &image->index));
        const XrSwapchainImageWaitInfo at_once = {.type = XR_TYPE_SWAPCHAIN_IMAGE_WAIT_INFO,
                                                  .timeout = 0};
        if (image->is_acquired && !image->is_waited)
            image->is_waited =
                at->instance->WaitSwapchainImage(image->handle, &at_once) == XR_SUCCESS;
        if (!image->is_waited) return false;
    }
    return true;
}

void own_images_release(session *at, bool is_written) {
    for (int eye = 0; eye < WIRE_EYES; ++eye) {
        own_image *image = at->images + eye;
        is_written &=
            XR_SUCCEEDED(at->instance->ReleaseSwapchainImage(image->handle, NULL));
        image->is_acquired = image->is_waited = false;
    }
    at->frame.state = FRAME_NONE;
    at->is_shown = is_written;
    at->shown = at->frame;
}

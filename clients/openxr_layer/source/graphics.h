/* What differs between graphics APIs.
 *
 * All functions are called with the session locked, and only within calls in which a
 * runtime may use the application's graphics as well. */
#ifndef OCU_LAYER_GRAPHICS_H
#define OCU_LAYER_GRAPHICS_H

#include "registry.h"

/* A part of a swapchain's copy, and where it goes in the memory shared with the helper:
 * color in its wire format, depth as float32. */
typedef struct {
    const swapchain *chain;
    const XrSwapchainSubImage *part;
    size_t start;
} image_read;

/* An image in the shared memory, and the acquired image that it is written to. */
typedef struct {
    const own_image *to;
    const wire_image *from;
} image_write;

typedef enum { READ_FAILED, READ_BEGUN, READ_DONE } read_state;

typedef struct graphics_api {
    const char *name;
    const char *formats;         /* of color that it can copy, for messages */
    XrSwapchainUsageFlags usage; /* that the application's swapchains get in addition */

    /* Open `graphics` with the session's binding; return a reason, or NULL. */
    const char *(*open)(session *at, const XrBaseInStructure *binding);
    void (*close)(session *at);

    const image_format *(*format_of)(int64_t format);

    /* Find the images of a swapchain; return how many there are, or 0. */
    uint32_t (*find_images)(const session *at, XrSwapchain handle,
                            uint64_t images[MAX_IMAGES]);

    /* Copy an image that is being released; return whether there is a copy. */
    bool (*copy)(swapchain *chain, uint64_t image);
    void (*destroy_copies)(session *at, swapchain *chains); /* of a list */

    /* Begin to read parts of copies into the shared memory. */
    read_state (*begin_read)(session *at, const image_read *reads, size_t count);
    /* Go on with that, for a limited time. */
    read_state (*finish_read)(session *at, uint64_t limit_ns);

    bool (*write)(session *at, const image_write *writes, size_t count);

    /* Wait until all commands of the layer's have completed. */
    void (*finish)(session *at);
} graphics_api;

extern const graphics_api gl_api, vk_api;

#endif

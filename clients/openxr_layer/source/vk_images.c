/* Images of programs that use Vulkan: copies of released ones, reads and uploads. */
#include <stdlib.h>
#include <string.h>

#include "graphics.h"
#include "log.h"
#include "vk_context.h"

#define MAX_READS 8

/* What a read puts into the buffer, and what the shared memory gets. */
typedef struct {
    VkFormat format;
    size_t start, pixels, pixel_bytes; /* of color */
} pending_read;

typedef struct {
    vk_context vk;
    vk_buffer from_device, to_device;
    pending_read reads[MAX_READS];
    size_t read_count;
} vk_state;

typedef struct {
    image_format head;
    VkImageAspectFlags aspects;
    uint32_t pixel_bytes; /* of color */
} format_row;

#define COLOR VK_IMAGE_ASPECT_COLOR_BIT
#define DEPTH VK_IMAGE_ASPECT_DEPTH_BIT
#define BOTH (VK_IMAGE_ASPECT_DEPTH_BIT | VK_IMAGE_ASPECT_STENCIL_BIT)
#define RGBA WIRE_TOP_FIRST
#define BGRA (WIRE_TOP_FIRST | WIRE_IS_BGR)
static const format_row FORMATS[] = {
    {{VK_FORMAT_R8G8B8A8_SRGB, WIRE_SRGB8, RGBA}, COLOR, 4},
    {{VK_FORMAT_B8G8R8A8_SRGB, WIRE_SRGB8, BGRA}, COLOR, 4},
    {{VK_FORMAT_R8G8B8A8_UNORM, WIRE_LINEAR8, RGBA}, COLOR, 4},
    {{VK_FORMAT_B8G8R8A8_UNORM, WIRE_LINEAR8, BGRA}, COLOR, 4},
    {{VK_FORMAT_A2B10G10R10_UNORM_PACK32, WIRE_LINEAR10, RGBA}, COLOR, 4},
    {{VK_FORMAT_A2R10G10B10_UNORM_PACK32, WIRE_LINEAR10, BGRA}, COLOR, 4},
    {{VK_FORMAT_R16G16B16A16_SFLOAT, WIRE_LINEAR16F, RGBA}, COLOR, 8},
    {{VK_FORMAT_D16_UNORM, 0, 0}, DEPTH, 0},
    {{VK_FORMAT_X8_D24_UNORM_PACK32, 0, 0}, DEPTH, 0},
    {{VK_FORMAT_D32_SFLOAT, 0, 0}, DEPTH, 0},
    {{VK_FORMAT_D16_UNORM_S8_UINT, 0, 0}, BOTH, 0},
    {{VK_FORMAT_D24_UNORM_S8_UINT, 0, 0}, BOTH, 0},
    {{VK_FORMAT_D32_SFLOAT_S8_UINT, 0, 0}, BOTH, 0},
};

static const image_format *format_of(int64_t format) {
    for (size_t i = 0; i < sizeof FORMATS / sizeof *FORMATS; ++i)
        if (FORMATS[i].head.format == format) return &FORMATS[i].head;
    return NULL;
}

static const format_row *row_of(const swapchain *chain) {
    return (const format_row *)chain->format; /* its first member */
}

static const char *open_graphics(session *at, const XrBaseInStructure *binding) {
    vk_state *state = calloc(1, sizeof *state);
    if (!state) return "there is no memory";
    const char *reason =
        vk_open(&state->vk, at->instance, (const XrGraphicsBindingVulkanKHR *)binding);
    if (reason) free(state);
    else at->graphics = state;
    return reason;
}

static void finish_all(session *at) { vk_finish(&((vk_state *)at->graphics)->vk); }

static void close_graphics(session *at) {
    vk_state *state = at->graphics;
    vk_finish(&state->vk);
    vk_destroy_buffer(&state->vk, &state->from_device);
    vk_destroy_buffer(&state->vk, &state->to_device);
    vk_close(&state->vk);
    free(state);
}

static uint32_t find_images(const session *at, XrSwapchain handle,
                            uint64_t images[MAX_IMAGES]) {
    XrSwapchainImageVulkanKHR found[MAX_IMAGES];
    for (int i = 0; i < MAX_IMAGES; ++i)
        found[i] = (XrSwapchainImageVulkanKHR){.type = XR_TYPE_SWAPCHAIN_IMAGE_VULKAN_KHR};
    uint32_t count = 0;
    if (XR_FAILED(at->instance->EnumerateSwapchainImages(
            handle, MAX_IMAGES, &count, (XrSwapchainImageBaseHeader *)found)))
        return 0;
    for (uint32_t i = 0; i < count; ++i) images[i] = (uint64_t)found[i].image;
    return count;
}

static void report(session *at, reason why, const char *what) {
    const vk_context *vk = &((vk_state *)at->graphics)->vk;
    if (vk->is_lost)
        LOG_ONCE(&at->reported, REASON_LOST, "the Vulkan device is lost; not filtered");
    else
        LOG_ONCE(&at->reported, why, "%s (Vulkan error %d)", what, (int)vk->error);
}

/* Copies ------------------------------------------------------------------------------- */

static bool make_copy(vk_context *vk, swapchain *chain) {
    const VkImageCreateInfo info = {
        .sType = VK_STRUCTURE_TYPE_IMAGE_CREATE_INFO,
        .imageType = VK_IMAGE_TYPE_2D,
        .format = (VkFormat)chain->info.format,
        .extent = {chain->info.width, chain->info.height, 1},
        .mipLevels = 1,
        .arrayLayers = chain->info.arraySize,
        .samples = VK_SAMPLE_COUNT_1_BIT,
        .tiling = VK_IMAGE_TILING_OPTIMAL,
        .usage = VK_IMAGE_USAGE_TRANSFER_SRC_BIT | VK_IMAGE_USAGE_TRANSFER_DST_BIT};
    vk_image *made = malloc(sizeof *made);
    if (!made || !vk_make_image(vk, made, &info)) {
        free(made);
        return false;
    }
    chain->copy = made;
    return true;
}

static VkImageLayout released_layout(const swapchain *chain) {
    return chain->format->wire ? VK_IMAGE_LAYOUT_COLOR_ATTACHMENT_OPTIMAL
                               : VK_IMAGE_LAYOUT_DEPTH_STENCIL_ATTACHMENT_OPTIMAL;
}

static void record_copy(const vk_context *vk, const vk_batch *batch,
                        const swapchain *chain, VkImage from) {
    const VkImageLayout SOURCE = VK_IMAGE_LAYOUT_TRANSFER_SRC_OPTIMAL,
                        TARGET = VK_IMAGE_LAYOUT_TRANSFER_DST_OPTIMAL;
    const XrSwapchainCreateInfo *info = &chain->info;
    VkImage to = ((const vk_image *)chain->copy)->handle;
    VkImageAspectFlags aspects = row_of(chain)->aspects;
    VkImageLayout usual = released_layout(chain);
    const vk_transition before[] = {
        {from, aspects, info->arraySize, usual, SOURCE},
        {to, aspects, info->arraySize, VK_IMAGE_LAYOUT_UNDEFINED, TARGET}};
    const vk_transition after[] = {{from, aspects, info->arraySize, SOURCE, usual},
                                   {to, aspects, info->arraySize, TARGET, SOURCE}};
    const VkImageSubresourceLayers part = {aspects & (COLOR | DEPTH), 0, 0,
                                           info->arraySize};
    const VkExtent3D extent = {info->width, info->height, 1};
    vk_transfer_barrier(vk, batch, before, 2);
    if (info->sampleCount > 1) {
        const VkImageResolve region = {
            .srcSubresource = part, .dstSubresource = part, .extent = extent};
        vk->CmdResolveImage(batch->commands, from, SOURCE, to, TARGET, 1, &region);
    } else {
        const VkImageCopy region = {
            .srcSubresource = part, .dstSubresource = part, .extent = extent};
        vk->CmdCopyImage(batch->commands, from, SOURCE, to, TARGET, 1, &region);
    }
    vk_transfer_barrier(vk, batch, after, 2);
}

static bool copy(swapchain *chain, uint64_t image) {
    session *at = chain->session;
    vk_context *vk = &((vk_state *)at->graphics)->vk;
    /* No command averages samples of depth. */
    if (vk->is_lost || (chain->info.sampleCount > 1 && !chain->format->wire)) return false;
    vk_batch *batch = vk->copies + vk->next_copy++ % VK_COPIES;
    bool is_copied = (chain->copy || make_copy(vk, chain)) && vk_begin(vk, batch);
    if (is_copied) {
        record_copy(vk, batch, chain, (VkImage)image);
        is_copied = vk_submit(vk, batch);
    }
    if (!is_copied) report(at, REASON_COPY, "a released image cannot be copied");
    return is_copied;
}

static void destroy_copies(session *at, swapchain *chains) {
    vk_context *vk = &((vk_state *)at->graphics)->vk;
    vk_finish(vk);
    for (swapchain *chain = chains; chain; chain = chain->next) {
        if (chain->copy) vk_destroy_image(vk, chain->copy);
        free(chain->copy);
        chain->copy = NULL;
    }
}

/* Reads -------------------------------------------------------------------------------- */

static void record_read(vk_state *state, const image_read *read) {
    const vk_context *vk = &state->vk;
    const format_row *row = row_of(read->chain);
    const XrRect2Di *rect = &read->part->imageRect;
    const VkBufferImageCopy region = {
        .bufferOffset = read->start,
        .imageSubresource = {row->aspects & (COLOR | DEPTH), 0,
                             read->part->imageArrayIndex, 1},
        .imageOffset = {rect->offset.x, rect->offset.y, 0},
        .imageExtent = {(uint32_t)rect->extent.width, (uint32_t)rect->extent.height, 1}};
    vk->CmdCopyImageToBuffer(vk->read.commands,
                             ((const vk_image *)read->chain->copy)->handle,
                             VK_IMAGE_LAYOUT_TRANSFER_SRC_OPTIMAL,
                             state->from_device.handle, 1, &region);
    state->reads[state->read_count++] = (pending_read){
        (VkFormat)row->head.format, read->start,
        (size_t)rect->extent.width * (size_t)rect->extent.height, row->pixel_bytes};
}

static read_state begin_read(session *at, const image_read *reads, size_t count) {
    vk_state *state = at->graphics;
    vk_context *vk = &state->vk;
    state->read_count = 0;
    /* Also waits for a read of a helper that has ended. */
    bool is_begun = vk_wait(vk, &vk->read, VK_LIMIT_NS) &&
                    vk_make_buffer(vk, &state->from_device, at->link.memory_bytes, true) &&
                    vk_begin(vk, &vk->read);
    if (is_begun) {
        for (size_t i = 0; i < count && i < MAX_READS; ++i) record_read(state, reads + i);
        const VkMemoryBarrier barrier = {.sType = VK_STRUCTURE_TYPE_MEMORY_BARRIER,
                                         .srcAccessMask = VK_ACCESS_TRANSFER_WRITE_BIT,
                                         .dstAccessMask = VK_ACCESS_HOST_READ_BIT};
        vk->CmdPipelineBarrier(vk->read.commands, VK_PIPELINE_STAGE_TRANSFER_BIT,
                               VK_PIPELINE_STAGE_HOST_BIT, 0, 1, &barrier, 0, NULL, 0,
                               NULL);
        is_begun = vk_submit(vk, &vk->read);
    }
    if (!is_begun) report(at, REASON_COPY, "copies cannot be read");
    return is_begun ? READ_BEGUN : READ_FAILED;
}

/* Write color as it is, and depth as numbers from 0 to 1. */
static void take_read(const pending_read *read, const uint8_t *from, uint8_t *to) {
    float *depth = (float *)(void *)to;
    switch (read->format) {
    case VK_FORMAT_D16_UNORM:
    case VK_FORMAT_D16_UNORM_S8_UINT:
        for (size_t i = 0; i < read->pixels; ++i)
            depth[i] = (float)((const uint16_t *)(const void *)from)[i] / 65535.0f;
        break;
    case VK_FORMAT_X8_D24_UNORM_PACK32:
    case VK_FORMAT_D24_UNORM_S8_UINT:
        for (size_t i = 0; i < read->pixels; ++i)
            depth[i] = (float)(((const uint32_t *)(const void *)from)[i] & 0xffffffu) /
                       16777215.0f;
        break;
    case VK_FORMAT_D32_SFLOAT:
    case VK_FORMAT_D32_SFLOAT_S8_UINT:
        memcpy(to, from, read->pixels * sizeof *depth);
        break;
    default: memcpy(to, from, read->pixels * read->pixel_bytes);
    }
}

static read_state finish_read(session *at, uint64_t limit_ns) {
    vk_state *state = at->graphics;
    if (!vk_wait(&state->vk, &state->vk.read, limit_ns))
        return state->vk.is_lost ? READ_FAILED : READ_BEGUN;
    for (size_t i = 0; i < state->read_count; ++i) {
        size_t start = state->reads[i].start;
        take_read(state->reads + i, state->from_device.mapped + start,
                  at->link.memory + start);
    }
    return READ_DONE;
}

/* Uploads ------------------------------------------------------------------------------ */

static void record_write(vk_state *state, const image_write *write) {
    const vk_context *vk = &state->vk;
    VkImage to = (VkImage)write->to->images[write->to->index];
    const vk_transition before = {to, COLOR, 1, VK_IMAGE_LAYOUT_COLOR_ATTACHMENT_OPTIMAL,
                                  VK_IMAGE_LAYOUT_TRANSFER_DST_OPTIMAL};
    const vk_transition after = {to, COLOR, 1, before.to, before.from};
    const VkBufferImageCopy region = {
        .bufferOffset = write->from->start,
        .imageSubresource = {COLOR, 0, 0, 1},
        .imageExtent = {write->from->width_px, write->from->height_px, 1}};
    vk_transfer_barrier(vk, &vk->write, &before, 1);
    vk->CmdCopyBufferToImage(vk->write.commands, state->to_device.handle, to, before.to, 1,
                             &region);
    vk_transfer_barrier(vk, &vk->write, &after, 1);
}

static bool write_images(session *at, const image_write *writes, size_t count) {
    vk_state *state = at->graphics;
    vk_context *vk = &state->vk;
    bool is_written =
        vk_wait(vk, &vk->write, VK_LIMIT_NS) &&
        vk_make_buffer(vk, &state->to_device, at->link.memory_bytes, false) &&
        vk_begin(vk, &vk->write);
    if (is_written) {
        for (size_t i = 0; i < count; ++i) {
            const wire_image *from = writes[i].from;
            const image_format *format = format_of(writes[i].to->format);
            uint32_t pixel = ((const format_row *)format)->pixel_bytes;
            memcpy(state->to_device.mapped + from->start, at->link.memory + from->start,
                   (size_t)from->width_px * from->height_px * pixel);
            record_write(state, writes + i);
        }
        is_written = vk_submit(vk, &vk->write);
    }
    if (!is_written) report(at, REASON_UPLOAD, "filtered images cannot be uploaded");
    return is_written;
}

const graphics_api vk_api = {
    .name = "Vulkan",
    .formats = "R8G8B8A8 and B8G8R8A8 (SRGB, UNORM), A2B10G10R10, A2R10G10B10, "
               "R16G16B16A16_SFLOAT",
    .usage = XR_SWAPCHAIN_USAGE_TRANSFER_SRC_BIT,
    .open = open_graphics,
    .close = close_graphics,
    .format_of = format_of,
    .find_images = find_images,
    .copy = copy,
    .destroy_copies = destroy_copies,
    .begin_read = begin_read,
    .finish_read = finish_read,
    .write = write_images,
    .finish = finish_all,
};

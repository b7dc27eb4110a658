/* Vulkan: how applications enable it, and images on their device.
 *
 * The queue is the application's.  It is used only in xrAcquireSwapchainImage,
 * xrReleaseSwapchainImage and xrEndFrame, as the specification demands. */
#include "mock.h"

#define DEPTH_FORMAT(name, number, bytes, aspects) \
    {name, number, 0, 0, 4, true, aspects, bytes}
#define COLOR_FORMAT(name, number, bytes) \
    {name, number, 0, 0, bytes, false, VK_IMAGE_ASPECT_COLOR_BIT, bytes}
enum {
    ONLY_DEPTH = VK_IMAGE_ASPECT_DEPTH_BIT,
    WITH_STENCIL = VK_IMAGE_ASPECT_DEPTH_BIT | VK_IMAGE_ASPECT_STENCIL_BIT
};
const struct format VULKAN_FORMATS[] = {
    COLOR_FORMAT("VK_R8G8B8A8_SRGB", VK_FORMAT_R8G8B8A8_SRGB, 4),
    COLOR_FORMAT("VK_B8G8R8A8_SRGB", VK_FORMAT_B8G8R8A8_SRGB, 4),
    COLOR_FORMAT("VK_R8G8B8A8_UNORM", VK_FORMAT_R8G8B8A8_UNORM, 4),
    COLOR_FORMAT("VK_B8G8R8A8_UNORM", VK_FORMAT_B8G8R8A8_UNORM, 4),
    COLOR_FORMAT("VK_A2B10G10R10_UNORM", VK_FORMAT_A2B10G10R10_UNORM_PACK32, 4),
    COLOR_FORMAT("VK_R16G16B16A16_SFLOAT", VK_FORMAT_R16G16B16A16_SFLOAT, 8),
    DEPTH_FORMAT("VK_D16_UNORM", VK_FORMAT_D16_UNORM, 2, ONLY_DEPTH),
    DEPTH_FORMAT("VK_D32_SFLOAT", VK_FORMAT_D32_SFLOAT, 4, ONLY_DEPTH),
    DEPTH_FORMAT("VK_D24_UNORM_S8_UINT", VK_FORMAT_D24_UNORM_S8_UINT, 4, WITH_STENCIL),
    DEPTH_FORMAT("VK_D32_SFLOAT_S8_UINT", VK_FORMAT_D32_SFLOAT_S8_UINT, 4,
                 WITH_STENCIL),
};
const size_t N_VULKAN_FORMATS = sizeof VULKAN_FORMATS / sizeof *VULKAN_FORMATS;

/* --- how applications enable it --------------------------------------------------- */

static XrResult require_versions(struct object *instance,
                                 XrGraphicsRequirementsVulkanKHR *needed) {
    STRUCTURE(needed, XR_TYPE_GRAPHICS_REQUIREMENTS_VULKAN_KHR);
    needed->minApiVersionSupported = XR_MAKE_VERSION(1, 0, 0);
    needed->maxApiVersionSupported = XR_MAKE_VERSION(1, 4, 0);
    instance->instance.has_asked_for_requirements = true;
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrGetVulkanGraphicsRequirementsKHR(
    XrInstance instance, XrSystemId system, XrGraphicsRequirementsVulkanKHR *needed) {
    ENTER;
    FIND(found, INSTANCE, instance);
    REQUIRE_SYSTEM(system);
    return require_versions(found, needed);
}

XrResult XRAPI_CALL xrGetVulkanGraphicsRequirements2KHR(
    XrInstance instance, XrSystemId system, XrGraphicsRequirementsVulkanKHR *needed) {
    ENTER;
    FIND(found, INSTANCE, instance);
    REQUIRE_SYSTEM(system);
    return require_versions(found, needed);
}

/* It needs no extension of Vulkan. */
static XrResult no_names(uint32_t capacity, uint32_t *count, char *buffer) {
    TWO_CALLS(capacity, count, 1u);
    *buffer = '\0';
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrGetVulkanInstanceExtensionsKHR(XrInstance instance,
                                                     XrSystemId system,
                                                     uint32_t capacity, uint32_t *count,
                                                     char *buffer) {
    ENTER;
    FIND(found, INSTANCE, instance);
    REQUIRE_SYSTEM(system);
    return no_names(capacity, count, buffer);
}

XrResult XRAPI_CALL xrGetVulkanDeviceExtensionsKHR(XrInstance instance,
                                                   XrSystemId system, uint32_t capacity,
                                                   uint32_t *count, char *buffer) {
    ENTER;
    FIND(found, INSTANCE, instance);
    REQUIRE_SYSTEM(system);
    return no_names(capacity, count, buffer);
}

static XrResult first_device(VkInstance vulkan, VkPhysicalDevice *device) {
    uint32_t count = 1;
    VkResult result = vkEnumeratePhysicalDevices(vulkan, &count, device);
    REQUIRE(result >= 0 && count, XR_ERROR_RUNTIME_FAILURE, "there is no device: %d",
            (int)result);
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrGetVulkanGraphicsDeviceKHR(XrInstance instance, XrSystemId system,
                                                 VkInstance vulkan,
                                                 VkPhysicalDevice *device) {
    ENTER;
    FIND(found, INSTANCE, instance);
    REQUIRE_SYSTEM(system);
    return first_device(vulkan, device);
}

XrResult XRAPI_CALL xrGetVulkanGraphicsDevice2KHR(
    XrInstance instance, const XrVulkanGraphicsDeviceGetInfoKHR *info,
    VkPhysicalDevice *device) {
    ENTER;
    FIND(found, INSTANCE, instance);
    STRUCTURE(info, XR_TYPE_VULKAN_GRAPHICS_DEVICE_GET_INFO_KHR);
    REQUIRE_SYSTEM(info->systemId);
    return first_device(info->vulkanInstance, device);
}

static VkInstance latest_instance; /* whose functions create devices */

XrResult XRAPI_CALL xrCreateVulkanInstanceKHR(XrInstance instance,
                                              const XrVulkanInstanceCreateInfoKHR *info,
                                              VkInstance *vulkan,
                                              VkResult *vulkan_result) {
    ENTER;
    FIND(found, INSTANCE, instance);
    STRUCTURE(info, XR_TYPE_VULKAN_INSTANCE_CREATE_INFO_KHR);
    REQUIRE_SYSTEM(info->systemId);
    PFN_vkCreateInstance create =
        (PFN_vkCreateInstance)info->pfnGetInstanceProcAddr(NULL, "vkCreateInstance");
    *vulkan_result = create(info->vulkanCreateInfo, info->vulkanAllocator, vulkan);
    if (*vulkan_result == VK_SUCCESS) latest_instance = *vulkan;
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrCreateVulkanDeviceKHR(XrInstance instance,
                                            const XrVulkanDeviceCreateInfoKHR *info,
                                            VkDevice *device, VkResult *vulkan_result) {
    ENTER;
    FIND(found, INSTANCE, instance);
    STRUCTURE(info, XR_TYPE_VULKAN_DEVICE_CREATE_INFO_KHR);
    REQUIRE_SYSTEM(info->systemId);
    PFN_vkCreateDevice create = (PFN_vkCreateDevice)info->pfnGetInstanceProcAddr(
        latest_instance, "vkCreateDevice");
    *vulkan_result = create(info->vulkanPhysicalDevice, info->vulkanCreateInfo,
                            info->vulkanAllocator, device);
    return XR_SUCCESS;
}

/* --- sessions --------------------------------------------------------------------- */

XrResult bind_vulkan(struct object *session, const XrGraphicsBindingVulkanKHR *given) {
    REQUIRE(given->instance && given->physicalDevice && given->device,
            XR_ERROR_GRAPHICS_DEVICE_INVALID, "the binding is not complete");
    struct vulkan *vulkan = &session->session.vulkan;
    vulkan->physical_device = given->physicalDevice;
    vulkan->device = given->device;
    vkGetDeviceQueue(given->device, given->queueFamilyIndex, given->queueIndex,
                     &vulkan->queue);
    const VkCommandPoolCreateInfo pool = {
        .sType = VK_STRUCTURE_TYPE_COMMAND_POOL_CREATE_INFO,
        .queueFamilyIndex = given->queueFamilyIndex};
    VkResult result = vkCreateCommandPool(given->device, &pool, NULL, &vulkan->pool);
    REQUIRE(result == VK_SUCCESS, XR_ERROR_GRAPHICS_DEVICE_INVALID, "no pool: %d",
            (int)result);
    return XR_SUCCESS;
}

void unbind_vulkan(struct object *session) {
    struct vulkan *vulkan = &session->session.vulkan;
    vkDestroyCommandPool(vulkan->device, vulkan->pool, NULL);
}

/* Run commands and wait for them. */
static VkCommandBuffer begin_commands(const struct vulkan *vulkan) {
    const VkCommandBufferAllocateInfo info = {
        .sType = VK_STRUCTURE_TYPE_COMMAND_BUFFER_ALLOCATE_INFO,
        .commandPool = vulkan->pool,
        .commandBufferCount = 1};
    const VkCommandBufferBeginInfo once = {
        .sType = VK_STRUCTURE_TYPE_COMMAND_BUFFER_BEGIN_INFO,
        .flags = VK_COMMAND_BUFFER_USAGE_ONE_TIME_SUBMIT_BIT};
    VkCommandBuffer made;
    vkAllocateCommandBuffers(vulkan->device, &info, &made);
    vkBeginCommandBuffer(made, &once);
    return made;
}

static void end_commands(const struct vulkan *vulkan, VkCommandBuffer commands) {
    const VkSubmitInfo info = {.sType = VK_STRUCTURE_TYPE_SUBMIT_INFO,
                               .commandBufferCount = 1,
                               .pCommandBuffers = &commands};
    vkEndCommandBuffer(commands);
    VkResult result = vkQueueSubmit(vulkan->queue, 1, &info, VK_NULL_HANDLE);
    if (result == VK_SUCCESS) result = vkQueueWaitIdle(vulkan->queue);
    if (result != VK_SUCCESS) fprintf(stderr, "mock: Vulkan failed: %d\n", (int)result);
    vkFreeCommandBuffers(vulkan->device, vulkan->pool, 1, &commands);
}

static void transition(VkCommandBuffer commands, VkImage image,
                       VkImageAspectFlags aspects, VkImageLayout from,
                       VkImageLayout to) {
    const VkImageMemoryBarrier barrier = {
        .sType = VK_STRUCTURE_TYPE_IMAGE_MEMORY_BARRIER,
        .srcAccessMask = VK_ACCESS_MEMORY_WRITE_BIT,
        .dstAccessMask = VK_ACCESS_MEMORY_READ_BIT | VK_ACCESS_MEMORY_WRITE_BIT,
        .oldLayout = from,
        .newLayout = to,
        .srcQueueFamilyIndex = VK_QUEUE_FAMILY_IGNORED,
        .dstQueueFamilyIndex = VK_QUEUE_FAMILY_IGNORED,
        .image = image,
        .subresourceRange = {aspects, 0, VK_REMAINING_MIP_LEVELS, 0,
                             VK_REMAINING_ARRAY_LAYERS}};
    vkCmdPipelineBarrier(commands, VK_PIPELINE_STAGE_ALL_COMMANDS_BIT,
                         VK_PIPELINE_STAGE_ALL_COMMANDS_BIT, 0, 0, NULL, 0, NULL, 1,
                         &barrier);
}

/* --- images ----------------------------------------------------------------------- */

static uint32_t memory_type(const struct vulkan *vulkan, uint32_t allowed,
                            VkMemoryPropertyFlags wanted) {
    VkPhysicalDeviceMemoryProperties memory;
    vkGetPhysicalDeviceMemoryProperties(vulkan->physical_device, &memory);
    for (uint32_t i = 0; i < memory.memoryTypeCount; i++)
        if (allowed >> i & 1 &&
            (memory.memoryTypes[i].propertyFlags & wanted) == wanted)
            return i;
    return 0;
}

static VkResult allocate(const struct vulkan *vulkan, const VkMemoryRequirements *needed,
                         VkMemoryPropertyFlags wanted, VkDeviceMemory *made) {
    const VkMemoryAllocateInfo info = {
        .sType = VK_STRUCTURE_TYPE_MEMORY_ALLOCATE_INFO,
        .allocationSize = needed->size,
        .memoryTypeIndex = memory_type(vulkan, needed->memoryTypeBits, wanted)};
    return vkAllocateMemory(vulkan->device, &info, NULL, made);
}

static VkResult make_image(const struct vulkan *vulkan, const VkImageCreateInfo *info,
                           VkImage *image, VkDeviceMemory *memory) {
    VkMemoryRequirements needed;
    VkResult result = vkCreateImage(vulkan->device, info, NULL, image);
    if (result != VK_SUCCESS) return result;
    vkGetImageMemoryRequirements(vulkan->device, *image, &needed);
    result = allocate(vulkan, &needed, 0, memory);
    if (result != VK_SUCCESS) return result;
    return vkBindImageMemory(vulkan->device, *image, *memory, 0);
}

static VkImageUsageFlags usage_of(XrSwapchainUsageFlags given) {
    static const struct {
        XrSwapchainUsageFlags given;
        VkImageUsageFlags usage;
    } FLAGS[] = {
        {XR_SWAPCHAIN_USAGE_COLOR_ATTACHMENT_BIT, VK_IMAGE_USAGE_COLOR_ATTACHMENT_BIT},
        {XR_SWAPCHAIN_USAGE_DEPTH_STENCIL_ATTACHMENT_BIT,
         VK_IMAGE_USAGE_DEPTH_STENCIL_ATTACHMENT_BIT},
        {XR_SWAPCHAIN_USAGE_UNORDERED_ACCESS_BIT, VK_IMAGE_USAGE_STORAGE_BIT},
        {XR_SWAPCHAIN_USAGE_TRANSFER_DST_BIT, VK_IMAGE_USAGE_TRANSFER_DST_BIT},
        {XR_SWAPCHAIN_USAGE_SAMPLED_BIT, VK_IMAGE_USAGE_SAMPLED_BIT},
    };
    VkImageUsageFlags usage = VK_IMAGE_USAGE_TRANSFER_SRC_BIT; /* for captures */
    for (size_t i = 0; i < sizeof FLAGS / sizeof *FLAGS; i++)
        if (given & FLAGS[i].given) usage |= FLAGS[i].usage;
    return usage;
}

bool make_vulkan_images(struct object *swapchain) {
    const struct vulkan *vulkan = &swapchain->parent->session.vulkan;
    const XrSwapchainCreateInfo *given = &swapchain->swapchain.info;
    const VkImageCreateInfo info = {
        .sType = VK_STRUCTURE_TYPE_IMAGE_CREATE_INFO,
        .imageType = VK_IMAGE_TYPE_2D,
        .format = (VkFormat)given->format,
        .extent = {given->width, given->height, 1},
        .mipLevels = given->mipCount,
        .arrayLayers = given->arraySize,
        .samples = (VkSampleCountFlagBits)given->sampleCount,
        .usage = usage_of(given->usageFlags)};
    for (uint32_t i = 0; i < swapchain->swapchain.image_count; i++)
        if (make_image(vulkan, &info, &swapchain->swapchain.images[i],
                       &swapchain->swapchain.memories[i]) != VK_SUCCESS)
            return false;
    return true;
}

void destroy_vulkan_images(struct object *swapchain) {
    const struct vulkan *vulkan = &swapchain->parent->session.vulkan;
    for (uint32_t i = 0; i < swapchain->swapchain.image_count; i++) {
        vkDestroyImage(vulkan->device, swapchain->swapchain.images[i], NULL);
        vkFreeMemory(vulkan->device, swapchain->swapchain.memories[i], NULL);
    }
}

static VkImageLayout usual_layout(const struct object *swapchain) {
    return swapchain->swapchain.format->is_depth
               ? VK_IMAGE_LAYOUT_DEPTH_STENCIL_ATTACHMENT_OPTIMAL
               : VK_IMAGE_LAYOUT_COLOR_ATTACHMENT_OPTIMAL;
}

/* Applications get images in that layout; new ones have none. */
void ready_vulkan_image(struct object *swapchain, uint32_t index) {
    const struct vulkan *vulkan = &swapchain->parent->session.vulkan;
    if (swapchain->swapchain.is_ready[index]) return;
    swapchain->swapchain.is_ready[index] = true;
    VkCommandBuffer commands = begin_commands(vulkan);
    transition(commands, swapchain->swapchain.images[index],
               swapchain->swapchain.format->aspects, VK_IMAGE_LAYOUT_UNDEFINED,
               usual_layout(swapchain));
    end_commands(vulkan, commands);
}

/* --- captures --------------------------------------------------------------------- */

struct host_buffer {
    VkBuffer handle;
    VkDeviceMemory memory;
    void *mapped;
};

static struct host_buffer make_buffer(const struct vulkan *vulkan, size_t bytes) {
    const VkBufferCreateInfo info = {.sType = VK_STRUCTURE_TYPE_BUFFER_CREATE_INFO,
                                     .size = bytes,
                                     .usage = VK_BUFFER_USAGE_TRANSFER_DST_BIT};
    struct host_buffer made;
    VkMemoryRequirements needed;
    vkCreateBuffer(vulkan->device, &info, NULL, &made.handle);
    vkGetBufferMemoryRequirements(vulkan->device, made.handle, &needed);
    allocate(vulkan, &needed,
             VK_MEMORY_PROPERTY_HOST_VISIBLE_BIT | VK_MEMORY_PROPERTY_HOST_COHERENT_BIT,
             &made.memory);
    vkBindBufferMemory(vulkan->device, made.handle, made.memory, 0);
    vkMapMemory(vulkan->device, made.memory, 0, VK_WHOLE_SIZE, 0, &made.mapped);
    return made;
}

/* Average the samples of a part, into an image that is destroyed by the caller. */
static VkImage resolved(const struct vulkan *vulkan, VkCommandBuffer commands,
                        const struct object *swapchain, VkImage image,
                        const VkBufferImageCopy *part, VkDeviceMemory *memory) {
    const VkImageCreateInfo info = {
        .sType = VK_STRUCTURE_TYPE_IMAGE_CREATE_INFO,
        .imageType = VK_IMAGE_TYPE_2D,
        .format = (VkFormat)swapchain->swapchain.info.format,
        .extent = part->imageExtent,
        .mipLevels = 1,
        .arrayLayers = 1,
        .samples = VK_SAMPLE_COUNT_1_BIT,
        .usage = VK_IMAGE_USAGE_TRANSFER_SRC_BIT | VK_IMAGE_USAGE_TRANSFER_DST_BIT};
    VkImage made;
    make_image(vulkan, &info, &made, memory);
    const VkImageResolve region = {.srcSubresource = part->imageSubresource,
                                   .srcOffset = part->imageOffset,
                                   .dstSubresource = {VK_IMAGE_ASPECT_COLOR_BIT, 0, 0, 1},
                                   .extent = part->imageExtent};
    transition(commands, made, VK_IMAGE_ASPECT_COLOR_BIT, VK_IMAGE_LAYOUT_UNDEFINED,
               VK_IMAGE_LAYOUT_TRANSFER_DST_OPTIMAL);
    vkCmdResolveImage(commands, image, VK_IMAGE_LAYOUT_TRANSFER_SRC_OPTIMAL, made,
                      VK_IMAGE_LAYOUT_TRANSFER_DST_OPTIMAL, 1, &region);
    transition(commands, made, VK_IMAGE_ASPECT_COLOR_BIT,
               VK_IMAGE_LAYOUT_TRANSFER_DST_OPTIMAL,
               VK_IMAGE_LAYOUT_TRANSFER_SRC_OPTIMAL);
    return made;
}

static float depth_of(const struct format *format, const void *from, size_t i) {
    switch (format->internal) {
    case VK_FORMAT_D16_UNORM: return (float)((const uint16_t *)from)[i] / 65535;
    case VK_FORMAT_D24_UNORM_S8_UINT:
        return (float)(((const uint32_t *)from)[i] & 0xffffff) / 16777215;
    default: return ((const float *)from)[i];
    }
}

/* Copy rows, the lowest first: here, images begin at the top. */
static void take_rows(const struct format *format, const void *from, XrExtent2Di extent,
                      void *to) {
    size_t width = (size_t)extent.width, height = (size_t)extent.height;
    for (size_t y = 0; y < height; y++) {
        size_t below = (height - 1 - y) * width;
        for (size_t x = 0; format->is_depth && x < width; x++)
            ((float *)to)[y * width + x] = depth_of(format, from, below + x);
        if (!format->is_depth)
            memcpy((char *)to + y * width * format->stored_bytes,
                   (const char *)from + below * format->stored_bytes,
                   width * format->stored_bytes);
    }
}

bool can_read_vulkan(const struct object *swapchain) {
    /* No command averages samples of depth. */
    return swapchain->swapchain.info.sampleCount == 1 ||
           !swapchain->swapchain.format->is_depth;
}

void read_vulkan_pixels(const struct object *swapchain, int image, XrRect2Di part,
                        uint32_t layer, void *pixels) {
    const struct vulkan *vulkan = &swapchain->parent->session.vulkan;
    const struct format *format = swapchain->swapchain.format;
    VkImage from = swapchain->swapchain.images[image], single = VK_NULL_HANDLE;
    VkDeviceMemory memory = VK_NULL_HANDLE;
    size_t bytes = (size_t)part.extent.width * (size_t)part.extent.height *
                   format->stored_bytes;
    struct host_buffer buffer = make_buffer(vulkan, bytes);
    VkBufferImageCopy region = {
        .imageSubresource = {format->aspects & ~(unsigned)VK_IMAGE_ASPECT_STENCIL_BIT, 0,
                             layer, 1},
        .imageOffset = {part.offset.x, part.offset.y, 0},
        .imageExtent = {(uint32_t)part.extent.width, (uint32_t)part.extent.height, 1}};
    VkCommandBuffer commands = begin_commands(vulkan);
    transition(commands, from, format->aspects, usual_layout(swapchain),
               VK_IMAGE_LAYOUT_TRANSFER_SRC_OPTIMAL);
    VkImage source = from;
    if (swapchain->swapchain.info.sampleCount > 1) {
        source = single =
            resolved(vulkan, commands, swapchain, from, &region, &memory);
        region.imageSubresource.baseArrayLayer = 0;
        region.imageOffset = (VkOffset3D){0};
    }
    vkCmdCopyImageToBuffer(commands, source, VK_IMAGE_LAYOUT_TRANSFER_SRC_OPTIMAL,
                           buffer.handle, 1, &region);
    transition(commands, from, format->aspects, VK_IMAGE_LAYOUT_TRANSFER_SRC_OPTIMAL,
               usual_layout(swapchain));
    end_commands(vulkan, commands);
    take_rows(format, buffer.mapped, part.extent, pixels);
    vkDestroyImage(vulkan->device, single, NULL);
    vkFreeMemory(vulkan->device, memory, NULL);
    vkDestroyBuffer(vulkan->device, buffer.handle, NULL);
    vkFreeMemory(vulkan->device, buffer.memory, NULL);
}

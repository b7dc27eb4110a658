/* The application's Vulkan device, and known pictures drawn with it.
 *
 * Pictures are rectangles that are cleared within a rendering, so that no shader is
 * needed; noise in the depth is copied from a buffer. */
#include "driver.h"

enum { N_BATCHES = 16, MAX_VIEWS = 128, STRIPE_PX = 4, CELLS = 16, CELL_ROWS = 8 };

static struct {
    VkInstance instance;
    VkPhysicalDevice physical_device;
    VkDevice device;
    VkQueue queue;
    uint32_t family;
    VkDebugUtilsMessengerEXT messenger;
    VkCommandPool pool;
    struct {
        VkCommandBuffer commands;
        VkFence done;
    } batches[N_BATCHES];
    unsigned next_batch;
    struct {
        VkImage image;
        uint32_t layer;
        VkImageView view;
    } views[MAX_VIEWS];
    unsigned view_count;
    long submits; /* by the layer */
} vulkan;

static void check(VkResult result, const char *call) {
    char why[32];
    snprintf(why, sizeof why, "VkResult %d", (int)result);
    if (result < 0) fail(call, why);
}
#define CHECK(call) check(call, #call)

/* --- what validation says --------------------------------------------------------- */

static VKAPI_ATTR VkBool32 VKAPI_CALL tell(VkDebugUtilsMessageSeverityFlagBitsEXT severity,
                                           VkDebugUtilsMessageTypeFlagsEXT types,
                                           const VkDebugUtilsMessengerCallbackDataEXT *data,
                                           void *user) {
    (void)severity, (void)types, (void)user;
    fprintf(stderr, "driver: validation: %s\n", data->pMessage);
    return VK_FALSE;
}

static const VkDebugUtilsMessengerCreateInfoEXT MESSENGER = {
    .sType = VK_STRUCTURE_TYPE_DEBUG_UTILS_MESSENGER_CREATE_INFO_EXT,
    .messageSeverity = VK_DEBUG_UTILS_MESSAGE_SEVERITY_WARNING_BIT_EXT |
                       VK_DEBUG_UTILS_MESSAGE_SEVERITY_ERROR_BIT_EXT,
    .messageType = VK_DEBUG_UTILS_MESSAGE_TYPE_VALIDATION_BIT_EXT |
                   VK_DEBUG_UTILS_MESSAGE_TYPE_PERFORMANCE_BIT_EXT,
    .pfnUserCallback = tell};

static void watch(void) {
    PFN_vkCreateDebugUtilsMessengerEXT make =
        (PFN_vkCreateDebugUtilsMessengerEXT)vkGetInstanceProcAddr(
            vulkan.instance, "vkCreateDebugUtilsMessengerEXT");
    CHECK(make(vulkan.instance, &MESSENGER, NULL, &vulkan.messenger));
}

/* --- functions that the layer calls ------------------------------------------------ */

enum { SUBMITS_PER_FRAME = 6, LOST_FRAME = 20 };

atomic_bool may_use_queue;

/* What others submit, who call through xrCreateVulkanDeviceKHR's function. */
static VKAPI_ATTR VkResult VKAPI_CALL submit_for_layer(VkQueue queue, uint32_t count,
                                                       const VkSubmitInfo *infos,
                                                       VkFence fence) {
    if (!may_use_queue)
        fprintf(stderr, "driver: validation: the queue is used where no layer may\n");
    if (options.plan.loses_device &&
        vulkan.submits++ > SUBMITS_PER_FRAME * LOST_FRAME)
        return VK_ERROR_DEVICE_LOST;
    return vkQueueSubmit(queue, count, infos, fence);
}

static VKAPI_ATTR PFN_vkVoidFunction VKAPI_CALL device_function(VkDevice device,
                                                                const char *name) {
    if (!strcmp(name, "vkQueueSubmit")) return (PFN_vkVoidFunction)submit_for_layer;
    return vkGetDeviceProcAddr(device, name);
}

static VKAPI_ATTR PFN_vkVoidFunction VKAPI_CALL instance_function(VkInstance instance,
                                                                  const char *name) {
    if (!strcmp(name, "vkGetDeviceProcAddr")) return (PFN_vkVoidFunction)device_function;
    return vkGetInstanceProcAddr(instance, name);
}

/* --- instance and device ----------------------------------------------------------- */

#define GET(instance, name) \
    PFN_##name name; \
    must(xrGetInstanceProcAddr(instance, #name, (PFN_xrVoidFunction *)&name), #name)

void ask_for_vulkan(XrInstance instance, XrSystemId system) {
    XrGraphicsRequirementsVulkanKHR needed = {
        .type = XR_TYPE_GRAPHICS_REQUIREMENTS_VULKAN_KHR};
    if (options.vulkan == 1) {
        GET(instance, xrGetVulkanGraphicsRequirementsKHR);
        must(xrGetVulkanGraphicsRequirementsKHR(instance, system, &needed),
             "xrGetVulkanGraphicsRequirementsKHR");
    } else {
        GET(instance, xrGetVulkanGraphicsRequirements2KHR);
        must(xrGetVulkanGraphicsRequirements2KHR(instance, system, &needed),
             "xrGetVulkanGraphicsRequirements2KHR");
    }
}

static void make_instance(XrInstance instance, XrSystemId system) {
    static const char *const LAYER = "VK_LAYER_KHRONOS_validation";
    static const char *const EXTENSIONS[] = {VK_EXT_DEBUG_UTILS_EXTENSION_NAME,
                                             VK_EXT_VALIDATION_FEATURES_EXTENSION_NAME};
    static const VkValidationFeatureEnableEXT FEATURE =
        VK_VALIDATION_FEATURE_ENABLE_SYNCHRONIZATION_VALIDATION_EXT;
    const VkValidationFeaturesEXT features = {
        .sType = VK_STRUCTURE_TYPE_VALIDATION_FEATURES_EXT,
        .pNext = &MESSENGER,
        .enabledValidationFeatureCount = 1,
        .pEnabledValidationFeatures = &FEATURE};
    const VkApplicationInfo application = {.sType = VK_STRUCTURE_TYPE_APPLICATION_INFO,
                                           .pApplicationName = "driver",
                                           .apiVersion = VK_API_VERSION_1_3};
    const VkInstanceCreateInfo info = {
        .sType = VK_STRUCTURE_TYPE_INSTANCE_CREATE_INFO,
        .pNext = options.validate ? &features : NULL,
        .pApplicationInfo = &application,
        .enabledLayerCount = options.validate,
        .ppEnabledLayerNames = &LAYER,
        .enabledExtensionCount = options.validate ? 2 : 0,
        .ppEnabledExtensionNames = EXTENSIONS};
    if (options.vulkan == 1) {
        CHECK(vkCreateInstance(&info, NULL, &vulkan.instance));
    } else {
        const XrVulkanInstanceCreateInfoKHR asked = {
            .type = XR_TYPE_VULKAN_INSTANCE_CREATE_INFO_KHR,
            .systemId = system,
            .pfnGetInstanceProcAddr = instance_function,
            .vulkanCreateInfo = &info};
        VkResult result;
        GET(instance, xrCreateVulkanInstanceKHR);
        must(xrCreateVulkanInstanceKHR(instance, &asked, &vulkan.instance, &result),
             "xrCreateVulkanInstanceKHR");
        check(result, "xrCreateVulkanInstanceKHR");
    }
    if (options.validate) watch();
}

static void choose_device(XrInstance instance, XrSystemId system) {
    if (options.vulkan == 1) {
        GET(instance, xrGetVulkanGraphicsDeviceKHR);
        must(xrGetVulkanGraphicsDeviceKHR(instance, system, vulkan.instance,
                                          &vulkan.physical_device),
             "xrGetVulkanGraphicsDeviceKHR");
        return;
    }
    const XrVulkanGraphicsDeviceGetInfoKHR info = {
        .type = XR_TYPE_VULKAN_GRAPHICS_DEVICE_GET_INFO_KHR,
        .systemId = system,
        .vulkanInstance = vulkan.instance};
    GET(instance, xrGetVulkanGraphicsDevice2KHR);
    must(xrGetVulkanGraphicsDevice2KHR(instance, &info, &vulkan.physical_device),
         "xrGetVulkanGraphicsDevice2KHR");
}

static uint32_t graphics_family(void) {
    VkQueueFamilyProperties found[16];
    uint32_t count = 16;
    vkGetPhysicalDeviceQueueFamilyProperties(vulkan.physical_device, &count, found);
    for (uint32_t i = 0; i < count; i++)
        if (found[i].queueFlags & VK_QUEUE_GRAPHICS_BIT) return i;
    fail("graphics_family", "no queue draws");
    return 0;
}

static void make_device(XrInstance instance, XrSystemId system) {
    static const float PRIORITY = 1;
    vulkan.family = graphics_family();
    const VkPhysicalDeviceVulkan13Features features = {
        .sType = VK_STRUCTURE_TYPE_PHYSICAL_DEVICE_VULKAN_1_3_FEATURES,
        .dynamicRendering = VK_TRUE};
    const VkDeviceQueueCreateInfo queue = {
        .sType = VK_STRUCTURE_TYPE_DEVICE_QUEUE_CREATE_INFO,
        .queueFamilyIndex = vulkan.family,
        .queueCount = 1,
        .pQueuePriorities = &PRIORITY};
    const VkDeviceCreateInfo info = {.sType = VK_STRUCTURE_TYPE_DEVICE_CREATE_INFO,
                                     .pNext = &features,
                                     .queueCreateInfoCount = 1,
                                     .pQueueCreateInfos = &queue};
    if (options.vulkan == 1) {
        CHECK(vkCreateDevice(vulkan.physical_device, &info, NULL, &vulkan.device));
    } else {
        const XrVulkanDeviceCreateInfoKHR asked = {
            .type = XR_TYPE_VULKAN_DEVICE_CREATE_INFO_KHR,
            .systemId = system,
            .pfnGetInstanceProcAddr = instance_function,
            .vulkanPhysicalDevice = vulkan.physical_device,
            .vulkanCreateInfo = &info};
        VkResult result;
        GET(instance, xrCreateVulkanDeviceKHR);
        must(xrCreateVulkanDeviceKHR(instance, &asked, &vulkan.device, &result),
             "xrCreateVulkanDeviceKHR");
        check(result, "xrCreateVulkanDeviceKHR");
    }
    vkGetDeviceQueue(vulkan.device, vulkan.family, 0, &vulkan.queue);
}

static void make_batches(void) {
    const VkCommandPoolCreateInfo pool = {
        .sType = VK_STRUCTURE_TYPE_COMMAND_POOL_CREATE_INFO,
        .flags = VK_COMMAND_POOL_CREATE_RESET_COMMAND_BUFFER_BIT,
        .queueFamilyIndex = vulkan.family};
    CHECK(vkCreateCommandPool(vulkan.device, &pool, NULL, &vulkan.pool));
    const VkCommandBufferAllocateInfo commands = {
        .sType = VK_STRUCTURE_TYPE_COMMAND_BUFFER_ALLOCATE_INFO,
        .commandPool = vulkan.pool,
        .commandBufferCount = 1};
    const VkFenceCreateInfo fence = {.sType = VK_STRUCTURE_TYPE_FENCE_CREATE_INFO,
                                     .flags = VK_FENCE_CREATE_SIGNALED_BIT};
    for (int i = 0; i < N_BATCHES; i++) {
        CHECK(vkAllocateCommandBuffers(vulkan.device, &commands,
                                       &vulkan.batches[i].commands));
        CHECK(vkCreateFence(vulkan.device, &fence, NULL, &vulkan.batches[i].done));
    }
}

void open_vulkan(XrInstance instance, XrSystemId system) {
    close_vulkan();
    ask_for_vulkan(instance, system);
    make_instance(instance, system);
    choose_device(instance, system);
    make_device(instance, system);
    make_batches();
}

void close_vulkan(void) {
    if (!vulkan.instance) return;
    CHECK(vkDeviceWaitIdle(vulkan.device));
    for (int i = 0; i < N_BATCHES; i++)
        vkDestroyFence(vulkan.device, vulkan.batches[i].done, NULL);
    vkDestroyCommandPool(vulkan.device, vulkan.pool, NULL);
    forget_vulkan_views();
    vkDestroyDevice(vulkan.device, NULL);
    if (vulkan.messenger) {
        PFN_vkDestroyDebugUtilsMessengerEXT destroy =
            (PFN_vkDestroyDebugUtilsMessengerEXT)vkGetInstanceProcAddr(
                vulkan.instance, "vkDestroyDebugUtilsMessengerEXT");
        destroy(vulkan.instance, vulkan.messenger, NULL);
    }
    vkDestroyInstance(vulkan.instance, NULL);
    memset(&vulkan, 0, sizeof vulkan);
}

XrGraphicsBindingVulkanKHR vulkan_binding(void) {
    return (XrGraphicsBindingVulkanKHR){.type = XR_TYPE_GRAPHICS_BINDING_VULKAN_KHR,
                                        .instance = vulkan.instance,
                                        .physicalDevice = vulkan.physical_device,
                                        .device = vulkan.device,
                                        .queueFamilyIndex = vulkan.family};
}

/* --- pictures ---------------------------------------------------------------------- */

/* Before swapchains are destroyed. */
void forget_vulkan_views(void) {
    CHECK(vkQueueWaitIdle(vulkan.queue));
    for (unsigned i = 0; i < vulkan.view_count; i++)
        vkDestroyImageView(vulkan.device, vulkan.views[i].view, NULL);
    vulkan.view_count = 0;
}

static VkImageView view_of(const struct vulkan_target *target, bool is_depth) {
    for (unsigned i = 0; i < vulkan.view_count; i++)
        if (vulkan.views[i].image == target->image &&
            vulkan.views[i].layer == target->layer)
            return vulkan.views[i].view;
    const VkImageViewCreateInfo info = {
        .sType = VK_STRUCTURE_TYPE_IMAGE_VIEW_CREATE_INFO,
        .image = target->image,
        .viewType = VK_IMAGE_VIEW_TYPE_2D,
        .format = target->format,
        .subresourceRange = {is_depth ? VK_IMAGE_ASPECT_DEPTH_BIT
                                      : VK_IMAGE_ASPECT_COLOR_BIT,
                             0, 1, target->layer, 1}};
    if (vulkan.view_count == MAX_VIEWS) fail("view_of", "too many images");
    unsigned i = vulkan.view_count++;
    vulkan.views[i].image = target->image;
    vulkan.views[i].layer = target->layer;
    CHECK(vkCreateImageView(vulkan.device, &info, NULL, &vulkan.views[i].view));
    return vulkan.views[i].view;
}

static VkCommandBuffer begin(VkFence *done) {
    unsigned i = vulkan.next_batch++ % N_BATCHES;
    *done = vulkan.batches[i].done;
    CHECK(vkWaitForFences(vulkan.device, 1, done, VK_TRUE, UINT64_MAX));
    CHECK(vkResetFences(vulkan.device, 1, done));
    const VkCommandBufferBeginInfo once = {
        .sType = VK_STRUCTURE_TYPE_COMMAND_BUFFER_BEGIN_INFO,
        .flags = VK_COMMAND_BUFFER_USAGE_ONE_TIME_SUBMIT_BIT};
    CHECK(vkBeginCommandBuffer(vulkan.batches[i].commands, &once));
    const VkMemoryBarrier barrier = {
        .sType = VK_STRUCTURE_TYPE_MEMORY_BARRIER,
        .srcAccessMask = VK_ACCESS_MEMORY_WRITE_BIT,
        .dstAccessMask = VK_ACCESS_MEMORY_READ_BIT | VK_ACCESS_MEMORY_WRITE_BIT};
    vkCmdPipelineBarrier(vulkan.batches[i].commands, VK_PIPELINE_STAGE_ALL_COMMANDS_BIT,
                         VK_PIPELINE_STAGE_ALL_COMMANDS_BIT, 0, 1, &barrier, 0, NULL, 0,
                         NULL);
    return vulkan.batches[i].commands;
}

static void submit(VkCommandBuffer commands, VkFence done) {
    const VkSubmitInfo info = {.sType = VK_STRUCTURE_TYPE_SUBMIT_INFO,
                               .commandBufferCount = 1,
                               .pCommandBuffers = &commands};
    CHECK(vkEndCommandBuffer(commands));
    CHECK(vkQueueSubmit(vulkan.queue, 1, &info, done));
}

/* Fill columns of rows; x and y are from the part's left and lower edges. */
static void fill(VkCommandBuffer commands, const struct picture *picture, int x, int y,
                 int width, int height, const float color[4]) {
    const XrRect2Di *part = &picture->part;
    if (x >= part->extent.width) return;
    if (x + width > part->extent.width) width = part->extent.width - x;
    /* Rows begin at the top, unless the picture is upside down. */
    int top = picture->is_flipped ? y : part->extent.height - y - height;
    const VkClearAttachment attachment = {
        .aspectMask = VK_IMAGE_ASPECT_COLOR_BIT,
        .clearValue.color.float32 = {color[0], color[1], color[2], color[3]}};
    const VkClearRect rect = {{{part->offset.x + x, part->offset.y + top},
                               {(uint32_t)width, (uint32_t)height}},
                              0,
                              1};
    vkCmdClearAttachments(commands, 1, &attachment, 1, &rect);
}

static void fill_columns(VkCommandBuffer commands, const struct picture *picture) {
    int width = picture->part.extent.width, height = picture->part.extent.height;
    for (int x = 0; x < width; x++) {
        float alpha = picture->has_alpha ? (float)x / (float)width : 1;
        bool is_white = (x + picture->frame) / STRIPE_PX % 2 == 0;
        int view = picture->view;
        float color[] = {is_white || view == 0, is_white || view == 2,
                         is_white || view == 1, alpha};
        int to = x + 1; /* the first column of the next stripe */
        while (!picture->has_alpha && (to + picture->frame) % STRIPE_PX) to++;
        bool is_cell = x < CELLS * STRIPE_PX;
        fill(commands, picture, x, is_cell ? CELL_ROWS : 0, to - x,
             height - (is_cell ? CELL_ROWS : 0), color);
        if (to > CELLS * STRIPE_PX && is_cell) /* its rest has no cells below it */
            fill(commands, picture, CELLS * STRIPE_PX, 0, to - CELLS * STRIPE_PX,
                 CELL_ROWS, color);
        x = to - 1;
    }
    for (int x = 0; x < CELLS * STRIPE_PX && x < width; x++) {
        float alpha = picture->has_alpha ? (float)x / (float)width : 1;
        bool bit = picture->frame >> (x / STRIPE_PX) & 1;
        int columns = picture->has_alpha ? 1 : STRIPE_PX;
        fill(commands, picture, x, 0, columns, CELL_ROWS, (float[]){0, bit, 0, alpha});
        x += columns - 1;
    }
}

static VkRenderingAttachmentInfo attachment(const struct vulkan_target *target,
                                            bool is_depth, float depth) {
    return (VkRenderingAttachmentInfo){
        .sType = VK_STRUCTURE_TYPE_RENDERING_ATTACHMENT_INFO,
        .imageView = view_of(target, is_depth),
        .imageLayout = is_depth ? VK_IMAGE_LAYOUT_DEPTH_STENCIL_ATTACHMENT_OPTIMAL
                                : VK_IMAGE_LAYOUT_COLOR_ATTACHMENT_OPTIMAL,
        .loadOp = is_depth ? VK_ATTACHMENT_LOAD_OP_CLEAR : VK_ATTACHMENT_LOAD_OP_LOAD,
        .storeOp = VK_ATTACHMENT_STORE_OP_STORE,
        .clearValue.depthStencil.depth = depth};
}

static VkRect2D area_of(const struct vulkan_target *target, XrRect2Di part) {
    uint32_t width = (uint32_t)part.extent.width, height = (uint32_t)part.extent.height;
    if (width > target->width) width = target->width; /* of another size */
    if (height > target->height) height = target->height;
    return (VkRect2D){{part.offset.x, part.offset.y}, {width, height}};
}

static void render(VkCommandBuffer commands, const struct picture *picture,
                   const struct vulkan_target *target, bool is_depth) {
    const VkRenderingAttachmentInfo attached =
        attachment(target, is_depth, picture->depth);
    const VkRenderingInfo info = {
        .sType = VK_STRUCTURE_TYPE_RENDERING_INFO,
        .renderArea = area_of(target, picture->part),
        .layerCount = 1,
        .colorAttachmentCount = !is_depth,
        .pColorAttachments = is_depth ? NULL : &attached,
        .pDepthAttachment = is_depth ? &attached : NULL};
    vkCmdBeginRendering(commands, &info);
    if (!is_depth) fill_columns(commands, picture);
    vkCmdEndRendering(commands);
}

void draw_with_vulkan(const struct picture *picture, const struct vulkan_target *color,
                      const struct vulkan_target *depth) {
    VkFence done;
    VkCommandBuffer commands = begin(&done);
    render(commands, picture, color, false);
    if (depth) render(commands, picture, depth, true);
    if (options.plan.breaks_layout) {
        const VkImageMemoryBarrier barrier = {
            .sType = VK_STRUCTURE_TYPE_IMAGE_MEMORY_BARRIER,
            .srcAccessMask = VK_ACCESS_MEMORY_WRITE_BIT,
            .dstAccessMask = VK_ACCESS_MEMORY_READ_BIT,
            .oldLayout = VK_IMAGE_LAYOUT_COLOR_ATTACHMENT_OPTIMAL,
            .newLayout = VK_IMAGE_LAYOUT_GENERAL,
            .srcQueueFamilyIndex = VK_QUEUE_FAMILY_IGNORED,
            .dstQueueFamilyIndex = VK_QUEUE_FAMILY_IGNORED,
            .image = color->image,
            .subresourceRange = {VK_IMAGE_ASPECT_COLOR_BIT, 0, 1, 0,
                                 VK_REMAINING_ARRAY_LAYERS}};
        vkCmdPipelineBarrier(commands, VK_PIPELINE_STAGE_ALL_COMMANDS_BIT,
                             VK_PIPELINE_STAGE_ALL_COMMANDS_BIT, 0, 0, NULL, 0, NULL, 1,
                             &barrier);
    }
    submit(commands, done);
}

/* Write depth that no rendering gives. */
void copy_depth_with_vulkan(const struct vulkan_target *target, const float *values) {
    size_t bytes = (size_t)target->width * target->height * sizeof *values;
    const VkBufferCreateInfo info = {.sType = VK_STRUCTURE_TYPE_BUFFER_CREATE_INFO,
                                     .size = bytes,
                                     .usage = VK_BUFFER_USAGE_TRANSFER_SRC_BIT};
    VkBuffer buffer;
    VkDeviceMemory memory;
    VkMemoryRequirements needed;
    VkPhysicalDeviceMemoryProperties types;
    void *mapped;
    CHECK(vkCreateBuffer(vulkan.device, &info, NULL, &buffer));
    vkGetBufferMemoryRequirements(vulkan.device, buffer, &needed);
    vkGetPhysicalDeviceMemoryProperties(vulkan.physical_device, &types);
    const VkMemoryPropertyFlags wanted =
        VK_MEMORY_PROPERTY_HOST_VISIBLE_BIT | VK_MEMORY_PROPERTY_HOST_COHERENT_BIT;
    uint32_t type = 0;
    while (type < types.memoryTypeCount &&
           (!(needed.memoryTypeBits >> type & 1) ||
            (types.memoryTypes[type].propertyFlags & wanted) != wanted))
        type++;
    const VkMemoryAllocateInfo allocation = {
        .sType = VK_STRUCTURE_TYPE_MEMORY_ALLOCATE_INFO,
        .allocationSize = needed.size,
        .memoryTypeIndex = type};
    CHECK(vkAllocateMemory(vulkan.device, &allocation, NULL, &memory));
    CHECK(vkBindBufferMemory(vulkan.device, buffer, memory, 0));
    CHECK(vkMapMemory(vulkan.device, memory, 0, VK_WHOLE_SIZE, 0, &mapped));
    memcpy(mapped, values, bytes);
    VkImageMemoryBarrier barrier = {
        .sType = VK_STRUCTURE_TYPE_IMAGE_MEMORY_BARRIER,
        .srcAccessMask = VK_ACCESS_MEMORY_WRITE_BIT,
        .dstAccessMask = VK_ACCESS_MEMORY_READ_BIT | VK_ACCESS_MEMORY_WRITE_BIT,
        .oldLayout = VK_IMAGE_LAYOUT_DEPTH_STENCIL_ATTACHMENT_OPTIMAL,
        .newLayout = VK_IMAGE_LAYOUT_TRANSFER_DST_OPTIMAL,
        .srcQueueFamilyIndex = VK_QUEUE_FAMILY_IGNORED,
        .dstQueueFamilyIndex = VK_QUEUE_FAMILY_IGNORED,
        .image = target->image,
        .subresourceRange = {VK_IMAGE_ASPECT_DEPTH_BIT, 0, 1, target->layer, 1}};
    const VkBufferImageCopy region = {
        .imageSubresource = {VK_IMAGE_ASPECT_DEPTH_BIT, 0, target->layer, 1},
        .imageExtent = {target->width, target->height, 1}};
    VkFence done;
    VkCommandBuffer commands = begin(&done);
    vkCmdPipelineBarrier(commands, VK_PIPELINE_STAGE_ALL_COMMANDS_BIT,
                         VK_PIPELINE_STAGE_ALL_COMMANDS_BIT, 0, 0, NULL, 0, NULL, 1,
                         &barrier);
    vkCmdCopyBufferToImage(commands, buffer, target->image, barrier.newLayout, 1,
                           &region);
    barrier.oldLayout = barrier.newLayout;
    barrier.newLayout = VK_IMAGE_LAYOUT_DEPTH_STENCIL_ATTACHMENT_OPTIMAL;
    vkCmdPipelineBarrier(commands, VK_PIPELINE_STAGE_ALL_COMMANDS_BIT,
                         VK_PIPELINE_STAGE_ALL_COMMANDS_BIT, 0, 0, NULL, 0, NULL, 1,
                         &barrier);
    submit(commands, done);
    CHECK(vkQueueWaitIdle(vulkan.queue));
    vkDestroyBuffer(vulkan.device, buffer, NULL);
    vkFreeMemory(vulkan.device, memory, NULL);
}

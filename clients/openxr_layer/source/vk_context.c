#include "vk_context.h"

#include <dlfcn.h>
#include <string.h>

#define MAX_TRANSITIONS 8

void vk_note_device(instance *own, const XrVulkanDeviceCreateInfoKHR *info, VkDevice made) {
    own->vulkan_device = made;
    own->vulkan_get_proc = (PFN_xrVoidFunction)info->pfnGetInstanceProcAddr;
}

/* Return how the application calls Vulkan: validation layers and the like are between.
 * XR_KHR_vulkan_enable does not tell, and applications then use the loader. */
static PFN_vkGetInstanceProcAddr get_proc_of(const instance *own, VkDevice device) {
    if (own->vulkan_get_proc && own->vulkan_device == device)
        return (PFN_vkGetInstanceProcAddr)own->vulkan_get_proc;
    void *library = dlopen("libvulkan.so.1", RTLD_NOW | RTLD_LOCAL);
    void *found = library ? dlsym(library, "vkGetInstanceProcAddr") : NULL;
    PFN_vkGetInstanceProcAddr get_proc;
    memcpy(&get_proc, &found, sizeof get_proc);
    return get_proc;
}

static const char *load(vk_context *vk, PFN_vkGetInstanceProcAddr get_proc,
                        const XrGraphicsBindingVulkanKHR *binding) {
    if (!get_proc) return "libvulkan is missing";
    PFN_vkGetPhysicalDeviceMemoryProperties get_memory =
        (PFN_vkGetPhysicalDeviceMemoryProperties)get_proc(
            binding->instance, "vkGetPhysicalDeviceMemoryProperties");
    PFN_vkGetDeviceProcAddr get_device_proc =
        (PFN_vkGetDeviceProcAddr)get_proc(binding->instance, "vkGetDeviceProcAddr");
    if (!get_memory || !get_device_proc) return "a function of Vulkan is missing";
    get_memory(binding->physicalDevice, &vk->memory);
    bool all = true;
#define F(name)                                                                          \
    vk->name = (PFN_vk##name)get_device_proc(vk->device, "vk" #name);                    \
    all &= vk->name != NULL;
    VK_FUNCTIONS(F)
#undef F
    return all ? NULL : "a function of Vulkan is missing";
}

static bool make_batch(vk_context *vk, vk_batch *batch) {
    const VkCommandBufferAllocateInfo commands = {
        .sType = VK_STRUCTURE_TYPE_COMMAND_BUFFER_ALLOCATE_INFO,
        .commandPool = vk->pool,
        .level = VK_COMMAND_BUFFER_LEVEL_PRIMARY,
        .commandBufferCount = 1};
    const VkFenceCreateInfo fence = {.sType = VK_STRUCTURE_TYPE_FENCE_CREATE_INFO};
    return vk_check(vk, vk->AllocateCommandBuffers(vk->device, &commands,
                                                   &batch->commands)) &&
           vk_check(vk, vk->CreateFence(vk->device, &fence, NULL, &batch->done));
}

static bool make_batches(vk_context *vk, uint32_t family) {
    const VkCommandPoolCreateInfo pool = {
        .sType = VK_STRUCTURE_TYPE_COMMAND_POOL_CREATE_INFO,
        .flags = VK_COMMAND_POOL_CREATE_RESET_COMMAND_BUFFER_BIT,
        .queueFamilyIndex = family};
    bool all = vk_check(vk, vk->CreateCommandPool(vk->device, &pool, NULL, &vk->pool));
    for (unsigned i = 0; i < VK_COPIES; ++i) all = all && make_batch(vk, vk->copies + i);
    return all && make_batch(vk, &vk->read) && make_batch(vk, &vk->write);
}

const char *vk_open(vk_context *vk, const instance *own,
                    const XrGraphicsBindingVulkanKHR *binding) {
    *vk = (vk_context){.device = binding->device};
    const char *reason = load(vk, get_proc_of(own, binding->device), binding);
    if (reason) return reason;
    vk->GetDeviceQueue(vk->device, binding->queueFamilyIndex, binding->queueIndex,
                       &vk->queue);
    if (!vk->queue) return "the application's Vulkan queue is unknown";
    if (make_batches(vk, binding->queueFamilyIndex)) return NULL;
    vk_close(vk);
    return "the Vulkan device provides no command buffers";
}

void vk_close(vk_context *vk) {
    vk_batch *batches[VK_COPIES + 2] = {&vk->read, &vk->write};
    for (unsigned i = 0; i < VK_COPIES; ++i) batches[2 + i] = vk->copies + i;
    for (unsigned i = 0; i < VK_COPIES + 2; ++i)
        vk->DestroyFence(vk->device, batches[i]->done, NULL);
    vk->DestroyCommandPool(vk->device, vk->pool, NULL);
}

bool vk_check(vk_context *vk, VkResult result) {
    if (result >= 0) return true;
    vk->error = result;
    vk->is_lost |= result == VK_ERROR_DEVICE_LOST;
    return false;
}

/* Batches ------------------------------------------------------------------------------ */

bool vk_wait(vk_context *vk, vk_batch *batch, uint64_t limit_ns) {
    if (!batch->is_pending) return true;
    VkResult result =
        vk->WaitForFences(vk->device, 1, &batch->done, VK_TRUE, limit_ns);
    if (!vk_check(vk, result) || result == VK_TIMEOUT) return false;
    batch->is_pending = false;
    return true;
}

void vk_finish(vk_context *vk) {
    for (unsigned i = 0; i < VK_COPIES; ++i) vk_wait(vk, vk->copies + i, VK_LIMIT_NS);
    vk_wait(vk, &vk->read, VK_LIMIT_NS);
    vk_wait(vk, &vk->write, VK_LIMIT_NS);
}

bool vk_begin(vk_context *vk, vk_batch *batch) {
    const VkCommandBufferBeginInfo info = {
        .sType = VK_STRUCTURE_TYPE_COMMAND_BUFFER_BEGIN_INFO,
        .flags = VK_COMMAND_BUFFER_USAGE_ONE_TIME_SUBMIT_BIT};
    return !vk->is_lost && vk_wait(vk, batch, VK_LIMIT_NS) &&
           vk_check(vk, vk->BeginCommandBuffer(batch->commands, &info));
}

bool vk_submit(vk_context *vk, vk_batch *batch) {
    const VkSubmitInfo info = {.sType = VK_STRUCTURE_TYPE_SUBMIT_INFO,
                               .commandBufferCount = 1,
                               .pCommandBuffers = &batch->commands};
    batch->is_pending =
        vk_check(vk, vk->EndCommandBuffer(batch->commands)) &&
        vk_check(vk, vk->ResetFences(vk->device, 1, &batch->done)) &&
        vk_check(vk, vk->QueueSubmit(vk->queue, 1, &info, batch->done));
    return batch->is_pending;
}

void vk_transfer_barrier(const vk_context *vk, const vk_batch *batch,
                         const vk_transition *transitions, uint32_t count) {
    VkImageMemoryBarrier barriers[MAX_TRANSITIONS];
    for (uint32_t i = 0; i < count; ++i)
        barriers[i] = (VkImageMemoryBarrier){
            .sType = VK_STRUCTURE_TYPE_IMAGE_MEMORY_BARRIER,
            .srcAccessMask = VK_ACCESS_MEMORY_WRITE_BIT,
            .dstAccessMask = VK_ACCESS_MEMORY_READ_BIT | VK_ACCESS_MEMORY_WRITE_BIT,
            .oldLayout = transitions[i].from,
            .newLayout = transitions[i].to,
            .srcQueueFamilyIndex = VK_QUEUE_FAMILY_IGNORED,
            .dstQueueFamilyIndex = VK_QUEUE_FAMILY_IGNORED,
            .image = transitions[i].image,
            .subresourceRange = {transitions[i].aspects, 0, 1, 0, transitions[i].layers}};
    /* The application's and the runtime's commands are not known. */
    vk->CmdPipelineBarrier(batch->commands, VK_PIPELINE_STAGE_ALL_COMMANDS_BIT,
                           VK_PIPELINE_STAGE_ALL_COMMANDS_BIT, 0, 0, NULL, 0, NULL, count,
                           barriers);
}

/* Memory ------------------------------------------------------------------------------- */

/* Allocate memory with properties, and others too if there is such memory. */
static bool allocate(vk_context *vk, const VkMemoryRequirements *needed,
                     VkMemoryPropertyFlags properties, VkMemoryPropertyFlags preferred,
                     VkDeviceMemory *made) {
    for (int pass = 0; pass < 2; ++pass) {
        VkMemoryPropertyFlags wanted = properties | (pass ? 0 : preferred);
        for (uint32_t i = 0; i < vk->memory.memoryTypeCount; ++i) {
            if (!(needed->memoryTypeBits >> i & 1) ||
                (vk->memory.memoryTypes[i].propertyFlags & wanted) != wanted)
                continue;
            const VkMemoryAllocateInfo info = {
                .sType = VK_STRUCTURE_TYPE_MEMORY_ALLOCATE_INFO,
                .allocationSize = needed->size,
                .memoryTypeIndex = i};
            return vk_check(vk, vk->AllocateMemory(vk->device, &info, NULL, made));
        }
    }
    return vk_check(vk, VK_ERROR_OUT_OF_DEVICE_MEMORY);
}

bool vk_make_buffer(vk_context *vk, vk_buffer *buffer, size_t bytes, bool is_read) {
    if (buffer->bytes >= bytes) return true;
    vk_destroy_buffer(vk, buffer);
    const VkBufferCreateInfo info = {.sType = VK_STRUCTURE_TYPE_BUFFER_CREATE_INFO,
                                     .size = bytes,
                                     .usage = is_read ? VK_BUFFER_USAGE_TRANSFER_DST_BIT
                                                      : VK_BUFFER_USAGE_TRANSFER_SRC_BIT};
    const VkMemoryPropertyFlags properties =
        VK_MEMORY_PROPERTY_HOST_VISIBLE_BIT | VK_MEMORY_PROPERTY_HOST_COHERENT_BIT;
    VkMemoryRequirements needed;
    void *mapped = NULL;
    bool is_made = vk_check(vk, vk->CreateBuffer(vk->device, &info, NULL, &buffer->handle));
    if (is_made) vk->GetBufferMemoryRequirements(vk->device, buffer->handle, &needed);
    is_made = is_made &&
              allocate(vk, &needed, properties,
                       is_read ? VK_MEMORY_PROPERTY_HOST_CACHED_BIT : 0, &buffer->memory) &&
              vk_check(vk, vk->BindBufferMemory(vk->device, buffer->handle,
                                                buffer->memory, 0)) &&
              vk_check(vk, vk->MapMemory(vk->device, buffer->memory, 0, VK_WHOLE_SIZE, 0,
                                         &mapped));
    buffer->mapped = mapped;
    buffer->bytes = bytes;
    if (!is_made) vk_destroy_buffer(vk, buffer);
    return is_made;
}

void vk_destroy_buffer(vk_context *vk, vk_buffer *buffer) {
    vk->DestroyBuffer(vk->device, buffer->handle, NULL);
    vk->FreeMemory(vk->device, buffer->memory, NULL);
    *buffer = (vk_buffer){0};
}

bool vk_make_image(vk_context *vk, vk_image *image, const VkImageCreateInfo *info) {
    VkMemoryRequirements needed;
    *image = (vk_image){0};
    bool is_made = vk_check(vk, vk->CreateImage(vk->device, info, NULL, &image->handle));
    if (is_made) vk->GetImageMemoryRequirements(vk->device, image->handle, &needed);
    is_made = is_made &&
              allocate(vk, &needed, 0, VK_MEMORY_PROPERTY_DEVICE_LOCAL_BIT,
                       &image->memory) &&
              vk_check(vk, vk->BindImageMemory(vk->device, image->handle, image->memory,
                                               0));
    if (!is_made) vk_destroy_image(vk, image);
    return is_made;
}

void vk_destroy_image(vk_context *vk, vk_image *image) {
    vk->DestroyImage(vk->device, image->handle, NULL);
    vk->FreeMemory(vk->device, image->memory, NULL);
    *image = (vk_image){0};
}

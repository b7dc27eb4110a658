/* The application's Vulkan device, as the layer uses it.
 *
 * The queue is the application's.  The layer submits to it only within
 * xrReleaseSwapchainImage and xrEndFrame, in which a runtime may use it as well (section
 * "Concurrency" of XR_KHR_vulkan_enable); fences are waited for anywhere. */
#ifndef OCU_LAYER_VK_CONTEXT_H
#define OCU_LAYER_VK_CONTEXT_H

#include <stdbool.h>
#include <vulkan/vulkan_core.h>

#define XR_USE_GRAPHICS_API_VULKAN
#include <openxr/openxr.h>
#include <openxr/openxr_platform.h>

#include "registry.h"

#define VK_FUNCTIONS(F)                                                                  \
    F(AllocateCommandBuffers)                                                            \
    F(AllocateMemory)                                                                    \
    F(BeginCommandBuffer)                                                                \
    F(BindBufferMemory)                                                                  \
    F(BindImageMemory)                                                                   \
    F(CmdCopyBufferToImage)                                                              \
    F(CmdCopyImage)                                                                      \
    F(CmdCopyImageToBuffer)                                                              \
    F(CmdPipelineBarrier)                                                                \
    F(CmdResolveImage)                                                                   \
    F(CreateBuffer)                                                                      \
    F(CreateCommandPool)                                                                 \
    F(CreateFence)                                                                       \
    F(CreateImage)                                                                       \
    F(DestroyBuffer)                                                                     \
    F(DestroyCommandPool)                                                                \
    F(DestroyFence)                                                                      \
    F(DestroyImage)                                                                      \
    F(EndCommandBuffer)                                                                  \
    F(FreeMemory)                                                                        \
    F(GetBufferMemoryRequirements)                                                       \
    F(GetDeviceQueue)                                                                    \
    F(GetImageMemoryRequirements)                                                        \
    F(MapMemory)                                                                         \
    F(QueueSubmit)                                                                       \
    F(ResetFences)                                                                       \
    F(WaitForFences)

/* Commands that are recorded and submitted together. */
typedef struct {
    VkCommandBuffer commands;
    VkFence done;
    bool is_pending; /* it was submitted, and `done` was not waited for */
} vk_batch;

#define VK_LIMIT_NS UINT64_C(1000000000) /* for commands that are due */

/* Of copies, so many may be in progress. */
#define VK_COPIES 12

typedef struct {
    VkDevice device;
    VkQueue queue;
    VkPhysicalDeviceMemoryProperties memory;
    VkCommandPool pool;
    vk_batch copies[VK_COPIES], read, write;
    unsigned next_copy;
    VkResult error; /* of the call that failed last */
    bool is_lost;
#define F(name) PFN_vk##name name;
    VK_FUNCTIONS(F)
#undef F
} vk_context;

/* A buffer in memory that the host has mapped. */
typedef struct {
    VkBuffer handle;
    VkDeviceMemory memory;
    size_t bytes;
    uint8_t *mapped;
} vk_buffer;

typedef struct {
    VkImage handle;
    VkDeviceMemory memory;
} vk_image;

/* Remember how the application calls Vulkan, from XR_KHR_vulkan_enable2. */
void vk_note_device(instance *own, const XrVulkanDeviceCreateInfoKHR *info, VkDevice made);

/* Use a binding's device; return a reason, or NULL. */
const char *vk_open(vk_context *vk, const instance *own,
                    const XrGraphicsBindingVulkanKHR *binding);
void vk_close(vk_context *vk);

/* Whether a call was successful; otherwise its result is the error. */
bool vk_check(vk_context *vk, VkResult result);

/* Begin a batch, after its commands of the last time have completed. */
bool vk_begin(vk_context *vk, vk_batch *batch);
bool vk_submit(vk_context *vk, vk_batch *batch);

/* Wait for a batch; false if it is not done by then, or if that failed. */
bool vk_wait(vk_context *vk, vk_batch *batch, uint64_t limit_ns);
void vk_finish(vk_context *vk);

/* Make a buffer of at least that size, for the host to read or to write. */
bool vk_make_buffer(vk_context *vk, vk_buffer *buffer, size_t bytes, bool is_read);
void vk_destroy_buffer(vk_context *vk, vk_buffer *buffer);

bool vk_make_image(vk_context *vk, vk_image *image, const VkImageCreateInfo *info);
void vk_destroy_image(vk_context *vk, vk_image *image);

/* Change the layout of an image's first level, after earlier and before later commands. */
typedef struct {
    VkImage image;
    VkImageAspectFlags aspects;
    uint32_t layers;
    VkImageLayout from, to;
} vk_transition;

void vk_transfer_barrier(const vk_context *vk, const vk_batch *batch,
                         const vk_transition *transitions, uint32_t count);

#endif

/* A layer of Vulkan between zink and the validation layers, so that these see what they
 * are to judge, and so that their silence means something (`layers.py`).
 *
 * - Chains of access chains become one each, by spirv-opt: the validation layers of 2023
 *   do not follow zink's chains to the buffer, and then watch no access to it.
 * - Draws are in render passes: in dynamic rendering, the layers of 2023 crash.
 * - With GL_WITNESS_DROP_BARRIERS every pipeline barrier is dropped: a deliberate fault.
 *
 * GL_WITNESS_SPIRV_OPT is the path of spirv-opt, GL_WITNESS_FOLDER one for its files.
 * One instance and one device a process.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <vulkan/vk_layer.h>
#include <vulkan/vulkan.h>

static PFN_vkGetInstanceProcAddr next_instance;
static PFN_vkGetDeviceProcAddr next_device;
static VkInstance instance;
static PFN_vkCmdPipelineBarrier next_barrier;
static PFN_vkCmdPipelineBarrier2 next_barrier2;
static PFN_vkCreateShaderModule next_module;

static VKAPI_ATTR VkResult VKAPI_CALL create_instance(
    const VkInstanceCreateInfo *info, const VkAllocationCallbacks *memory,
    VkInstance *made) {
    VkLayerInstanceCreateInfo *link = (VkLayerInstanceCreateInfo *)info->pNext;
    while (link->sType != VK_STRUCTURE_TYPE_LOADER_INSTANCE_CREATE_INFO ||
           link->function != VK_LAYER_LINK_INFO)
        link = (VkLayerInstanceCreateInfo *)link->pNext;
    next_instance = link->u.pLayerInfo->pfnNextGetInstanceProcAddr;
    link->u.pLayerInfo = link->u.pLayerInfo->pNext;
    PFN_vkCreateInstance create =
        (PFN_vkCreateInstance)next_instance(NULL, "vkCreateInstance");
    VkResult result = create(info, memory, made);
    instance = *made;
    return result;
}

static VKAPI_ATTR VkResult VKAPI_CALL create_device(
    VkPhysicalDevice physical, const VkDeviceCreateInfo *info,
    const VkAllocationCallbacks *memory, VkDevice *made) {
    VkLayerDeviceCreateInfo *link = (VkLayerDeviceCreateInfo *)info->pNext;
    while (link->sType != VK_STRUCTURE_TYPE_LOADER_DEVICE_CREATE_INFO ||
           link->function != VK_LAYER_LINK_INFO)
        link = (VkLayerDeviceCreateInfo *)link->pNext;
    PFN_vkGetInstanceProcAddr find = link->u.pLayerInfo->pfnNextGetInstanceProcAddr;
    next_device = link->u.pLayerInfo->pfnNextGetDeviceProcAddr;
    link->u.pLayerInfo = link->u.pLayerInfo->pNext;
    PFN_vkCreateDevice create = (PFN_vkCreateDevice)find(instance, "vkCreateDevice");
    VkResult result = create(physical, info, memory, made);
    if (result != VK_SUCCESS) return result;
    next_barrier = (PFN_vkCmdPipelineBarrier)next_device(*made, "vkCmdPipelineBarrier");
    next_barrier2 =
        (PFN_vkCmdPipelineBarrier2)next_device(*made, "vkCmdPipelineBarrier2");
    if (!next_barrier2)
        next_barrier2 =
            (PFN_vkCmdPipelineBarrier2)next_device(*made, "vkCmdPipelineBarrier2KHR");
    next_module = (PFN_vkCreateShaderModule)next_device(*made, "vkCreateShaderModule");
    return result;
}

static VKAPI_ATTR VkResult VKAPI_CALL extensions(
    VkPhysicalDevice physical, const char *layer, uint32_t *n_found,
    VkExtensionProperties *found) {
    PFN_vkEnumerateDeviceExtensionProperties find =
        (PFN_vkEnumerateDeviceExtensionProperties)next_instance(
            instance, "vkEnumerateDeviceExtensionProperties");
    VkResult result = find(physical, layer, n_found, found);
    for (uint32_t i = 0; found && i < *n_found; ++i)
        if (strcmp(found[i].extensionName, "VK_KHR_dynamic_rendering") == 0)
            strcpy(found[i].extensionName, "VK_none");
    return result;
}

static VKAPI_ATTR void VKAPI_CALL barrier(
    VkCommandBuffer commands, VkPipelineStageFlags before, VkPipelineStageFlags after,
    VkDependencyFlags flags, uint32_t n_memory, const VkMemoryBarrier *memory,
    uint32_t n_buffers, const VkBufferMemoryBarrier *buffers, uint32_t n_images,
    const VkImageMemoryBarrier *images) {
    if (getenv("GL_WITNESS_DROP_BARRIERS")) return;
    next_barrier(commands, before, after, flags, n_memory, memory, n_buffers, buffers,
                 n_images, images);
}

static VKAPI_ATTR void VKAPI_CALL barrier2(
    VkCommandBuffer commands, const VkDependencyInfo *what) {
    if (!getenv("GL_WITNESS_DROP_BARRIERS")) next_barrier2(commands, what);
}

/* Runs spirv-opt over a file, and returns what is in it then, or NULL. */
static uint32_t *combined(const char *path, size_t *n_bytes) {
    char command[1024];
    snprintf(command, sizeof command, "'%s' --combine-access-chains '%s' -o '%s'",
             getenv("GL_WITNESS_SPIRV_OPT"), path, path);
    FILE *file = system(command) == 0 ? fopen(path, "rb") : NULL;
    if (!file) return NULL;
    fseek(file, 0, SEEK_END);
    *n_bytes = (size_t)ftell(file);
    rewind(file);
    uint32_t *code = malloc(*n_bytes);
    if (fread(code, 1, *n_bytes, file) != *n_bytes) abort();
    fclose(file);
    return code;
}

static VKAPI_ATTR VkResult VKAPI_CALL create_module(
    VkDevice device, const VkShaderModuleCreateInfo *info,
    const VkAllocationCallbacks *memory, VkShaderModule *made) {
    char path[512];
    snprintf(path, sizeof path, "%s/module-XXXXXX", getenv("GL_WITNESS_FOLDER"));
    FILE *file = fdopen(mkstemp(path), "wb");
    fwrite(info->pCode, 1, info->codeSize, file);
    fclose(file);
    VkShaderModuleCreateInfo changed = *info;
    uint32_t *code = combined(path, &changed.codeSize);
    remove(path);
    if (!code) { /* seen in the log: without it the layers watch nothing */
        fprintf(stderr, "gl-witness: spirv-opt failed\n");
        abort();
    }
    changed.pCode = code;
    VkResult result = next_module(device, &changed, memory, made);
    free(code);
    return result;
}

static PFN_vkVoidFunction ours(const char *name) {
    static const struct { const char *name; PFN_vkVoidFunction function; } all[] = {
        {"vkCreateInstance", (PFN_vkVoidFunction)create_instance},
        {"vkCreateDevice", (PFN_vkVoidFunction)create_device},
        {"vkEnumerateDeviceExtensionProperties", (PFN_vkVoidFunction)extensions},
        {"vkCreateShaderModule", (PFN_vkVoidFunction)create_module},
        {"vkCmdPipelineBarrier", (PFN_vkVoidFunction)barrier},
        {"vkCmdPipelineBarrier2", (PFN_vkVoidFunction)barrier2},
        {"vkCmdPipelineBarrier2KHR", (PFN_vkVoidFunction)barrier2},
    };
    for (size_t i = 0; i < sizeof all / sizeof *all; ++i)
        if (strcmp(name, all[i].name) == 0) return all[i].function;
    return NULL;
}

static VKAPI_ATTR PFN_vkVoidFunction VKAPI_CALL find_device(
    VkDevice device, const char *name) {
    PFN_vkVoidFunction found = ours(name);
    return found || !next_device ? found : next_device(device, name);
}

static VKAPI_ATTR PFN_vkVoidFunction VKAPI_CALL find_instance(
    VkInstance of, const char *name) {
    if (strcmp(name, "vkGetDeviceProcAddr") == 0) return (PFN_vkVoidFunction)find_device;
    PFN_vkVoidFunction found = ours(name);
    return found || !next_instance ? found : next_instance(of, name);
}

VK_LAYER_EXPORT VKAPI_ATTR VkResult VKAPI_CALL vkNegotiateLoaderLayerInterfaceVersion(
    VkNegotiateLayerInterface *interface) {
    interface->loaderLayerInterfaceVersion = 2;
    interface->pfnGetInstanceProcAddr = find_instance;
    interface->pfnGetDeviceProcAddr = find_device;
    interface->pfnGetPhysicalDeviceProcAddr = NULL;
    return VK_SUCCESS;
}

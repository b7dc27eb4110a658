/* Functions by name, and those of XR_EXT_debug_utils, which have no effect. */
#include "mock.h"

#include <openxr/openxr_loader_negotiation.h>

XrResult XRAPI_CALL xrCreateDebugUtilsMessengerEXT(
    XrInstance instance, const XrDebugUtilsMessengerCreateInfoEXT *info,
    XrDebugUtilsMessengerEXT *messenger) {
    ENTER;
    FIND(found, INSTANCE, instance);
    STRUCTURE(info, XR_TYPE_DEBUG_UTILS_MESSENGER_CREATE_INFO_EXT);
    *messenger = HANDLE(XrDebugUtilsMessengerEXT, create(MESSENGER, found));
    return XR_SUCCESS;
}

XrResult XRAPI_CALL
xrDestroyDebugUtilsMessengerEXT(XrDebugUtilsMessengerEXT messenger) {
    ENTER;
    FIND(found, MESSENGER, messenger);
    found->is_alive = false;
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrSetDebugUtilsObjectNameEXT(
    XrInstance instance, const XrDebugUtilsObjectNameInfoEXT *info) {
    ENTER;
    FIND(found, INSTANCE, instance);
    STRUCTURE(info, XR_TYPE_DEBUG_UTILS_OBJECT_NAME_INFO_EXT);
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrSubmitDebugUtilsMessageEXT(
    XrInstance instance, XrDebugUtilsMessageSeverityFlagsEXT severity,
    XrDebugUtilsMessageTypeFlagsEXT types,
    const XrDebugUtilsMessengerCallbackDataEXT *data) {
    ENTER;
    FIND(found, INSTANCE, instance);
    (void)severity, (void)types, (void)data;
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrSessionBeginDebugUtilsLabelRegionEXT(
    XrSession session, const XrDebugUtilsLabelEXT *label) {
    ENTER;
    FIND(found, SESSION, session);
    STRUCTURE(label, XR_TYPE_DEBUG_UTILS_LABEL_EXT);
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrSessionEndDebugUtilsLabelRegionEXT(XrSession session) {
    ENTER;
    FIND(found, SESSION, session);
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrSessionInsertDebugUtilsLabelEXT(
    XrSession session, const XrDebugUtilsLabelEXT *label) {
    ENTER;
    FIND(found, SESSION, session);
    STRUCTURE(label, XR_TYPE_DEBUG_UTILS_LABEL_EXT);
    return XR_SUCCESS;
}

/* --- functions by name ----------------------------------------------------------- */

#define ALWAYS -1 /* also without an instance */
#define CORE -2
#define CORE_1_1 -3
#define ENTRY(name, extension) {#name, (PFN_xrVoidFunction)name, extension}
static const struct {
    const char *name;
    PFN_xrVoidFunction function;
    int extension; /* that must be enabled */
} FUNCTIONS[] = {
    ENTRY(xrGetInstanceProcAddr, ALWAYS),
    ENTRY(xrEnumerateInstanceExtensionProperties, ALWAYS),
    ENTRY(xrCreateInstance, ALWAYS),
    ENTRY(xrDestroyInstance, CORE),
    ENTRY(xrGetInstanceProperties, CORE),
    ENTRY(xrPollEvent, CORE),
    ENTRY(xrResultToString, CORE),
    ENTRY(xrStructureTypeToString, CORE),
    ENTRY(xrGetSystem, CORE),
    ENTRY(xrGetSystemProperties, CORE),
    ENTRY(xrEnumerateEnvironmentBlendModes, CORE),
    ENTRY(xrCreateSession, CORE),
    ENTRY(xrDestroySession, CORE),
    ENTRY(xrEnumerateReferenceSpaces, CORE),
    ENTRY(xrCreateReferenceSpace, CORE),
    ENTRY(xrGetReferenceSpaceBoundsRect, CORE),
    ENTRY(xrCreateActionSpace, CORE),
    ENTRY(xrLocateSpace, CORE),
    ENTRY(xrLocateSpaces, CORE_1_1),
    ENTRY(xrDestroySpace, CORE),
    ENTRY(xrEnumerateViewConfigurations, CORE),
    ENTRY(xrGetViewConfigurationProperties, CORE),
    ENTRY(xrEnumerateViewConfigurationViews, CORE),
    ENTRY(xrEnumerateSwapchainFormats, CORE),
    ENTRY(xrCreateSwapchain, CORE),
    ENTRY(xrDestroySwapchain, CORE),
    ENTRY(xrEnumerateSwapchainImages, CORE),
    ENTRY(xrAcquireSwapchainImage, CORE),
    ENTRY(xrWaitSwapchainImage, CORE),
    ENTRY(xrReleaseSwapchainImage, CORE),
    ENTRY(xrBeginSession, CORE),
    ENTRY(xrEndSession, CORE),
    ENTRY(xrRequestExitSession, CORE),
    ENTRY(xrWaitFrame, CORE),
    ENTRY(xrBeginFrame, CORE),
    ENTRY(xrEndFrame, CORE),
    ENTRY(xrLocateViews, CORE),
    ENTRY(xrStringToPath, CORE),
    ENTRY(xrPathToString, CORE),
    ENTRY(xrCreateActionSet, CORE),
    ENTRY(xrDestroyActionSet, CORE),
    ENTRY(xrCreateAction, CORE),
    ENTRY(xrDestroyAction, CORE),
    ENTRY(xrSuggestInteractionProfileBindings, CORE),
    ENTRY(xrAttachSessionActionSets, CORE),
    ENTRY(xrGetCurrentInteractionProfile, CORE),
    ENTRY(xrGetActionStateBoolean, CORE),
    ENTRY(xrGetActionStateFloat, CORE),
    ENTRY(xrGetActionStateVector2f, CORE),
    ENTRY(xrGetActionStatePose, CORE),
    ENTRY(xrSyncActions, CORE),
    ENTRY(xrEnumerateBoundSourcesForAction, CORE),
    ENTRY(xrGetInputSourceLocalizedName, CORE),
    ENTRY(xrApplyHapticFeedback, CORE),
    ENTRY(xrStopHapticFeedback, CORE),
    ENTRY(xrGetOpenGLGraphicsRequirementsKHR, OPENGL),
    ENTRY(xrGetVulkanInstanceExtensionsKHR, VULKAN),
    ENTRY(xrGetVulkanDeviceExtensionsKHR, VULKAN),
    ENTRY(xrGetVulkanGraphicsDeviceKHR, VULKAN),
    ENTRY(xrGetVulkanGraphicsRequirementsKHR, VULKAN),
    ENTRY(xrCreateVulkanInstanceKHR, VULKAN2),
    ENTRY(xrCreateVulkanDeviceKHR, VULKAN2),
    ENTRY(xrGetVulkanGraphicsDevice2KHR, VULKAN2),
    ENTRY(xrGetVulkanGraphicsRequirements2KHR, VULKAN2),
    ENTRY(xrCreateDebugUtilsMessengerEXT, DEBUG_UTILS),
    ENTRY(xrDestroyDebugUtilsMessengerEXT, DEBUG_UTILS),
    ENTRY(xrSetDebugUtilsObjectNameEXT, DEBUG_UTILS),
    ENTRY(xrSubmitDebugUtilsMessageEXT, DEBUG_UTILS),
    ENTRY(xrSessionBeginDebugUtilsLabelRegionEXT, DEBUG_UTILS),
    ENTRY(xrSessionEndDebugUtilsLabelRegionEXT, DEBUG_UTILS),
    ENTRY(xrSessionInsertDebugUtilsLabelEXT, DEBUG_UTILS),
};

XrResult XRAPI_CALL xrGetInstanceProcAddr(XrInstance instance, const char *name,
                                          PFN_xrVoidFunction *function) {
    ENTER;
    *function = NULL;
    if (instance && !find(INSTANCE, ID(instance))) return XR_ERROR_HANDLE_INVALID;
    for (size_t i = 0; i < sizeof FUNCTIONS / sizeof *FUNCTIONS; i++) {
        int extension = FUNCTIONS[i].extension;
        if (strcmp(FUNCTIONS[i].name, name)) continue;
        bool has_it = extension == CORE_1_1
                          ? XR_VERSION_MINOR(mock.api_version) >= 1
                          : extension < 0 || mock.is_enabled[extension];
        if (!has_it || (!instance && extension != ALWAYS)) break;
        *function = FUNCTIONS[i].function;
        return XR_SUCCESS;
    }
    return instance ? XR_ERROR_FUNCTION_UNSUPPORTED : XR_ERROR_HANDLE_INVALID;
}

/* The loader finds the runtime by this function. */
__attribute__((visibility("default"))) XrResult XRAPI_CALL
xrNegotiateLoaderRuntimeInterface(const XrNegotiateLoaderInfo *loader,
                                  XrNegotiateRuntimeRequest *request) {
    if (loader->structType != XR_LOADER_INTERFACE_STRUCT_LOADER_INFO ||
        request->structType != XR_LOADER_INTERFACE_STRUCT_RUNTIME_REQUEST ||
        loader->minInterfaceVersion > XR_CURRENT_LOADER_RUNTIME_VERSION)
        return XR_ERROR_INITIALIZATION_FAILED;
    request->runtimeInterfaceVersion = XR_CURRENT_LOADER_RUNTIME_VERSION;
    request->runtimeApiVersion = XR_CURRENT_API_VERSION;
    request->getInstanceProcAddr = xrGetInstanceProcAddr;
    return XR_SUCCESS;
}

/* The instance, and what the one headset is. */
#include <openxr/openxr_reflection.h>

#include "mock.h"

static const char *const EXTENSIONS[] = {
    XR_KHR_OPENGL_ENABLE_EXTENSION_NAME, XR_MNDX_EGL_ENABLE_EXTENSION_NAME,
    XR_KHR_VULKAN_ENABLE_EXTENSION_NAME, XR_KHR_VULKAN_ENABLE2_EXTENSION_NAME,
    XR_KHR_COMPOSITION_LAYER_DEPTH_EXTENSION_NAME,
    XR_EXT_EYE_GAZE_INTERACTION_EXTENSION_NAME, XR_EXT_DEBUG_UTILS_EXTENSION_NAME};

static bool is_offered(int extension) {
    const char *list = setting("MOCK_XR_EXTENSIONS", NULL), *word;
    if (!list) return true;
    size_t length;
    while ((word = next_word(&list, &length)))
        if (length == strlen(EXTENSIONS[extension]) &&
            !strncmp(word, EXTENSIONS[extension], length))
            return true;
    return false;
}

XrResult XRAPI_CALL xrEnumerateInstanceExtensionProperties(
    const char *layer, uint32_t capacity, uint32_t *count,
    XrExtensionProperties *properties) {
    ENTER;
    (void)layer; /* the loader answers for those of layers */
    uint32_t n = 0;
    for (int i = 0; i < N_EXTENSIONS; i++) n += is_offered(i);
    TWO_CALLS(capacity, count, n);
    for (int i = 0; i < N_EXTENSIONS; i++) {
        if (!is_offered(i)) continue;
        STRUCTURE(properties, XR_TYPE_EXTENSION_PROPERTIES);
        snprintf(properties->extensionName, sizeof properties->extensionName, "%s",
                 EXTENSIONS[i]);
        properties++->extensionVersion = 1;
    }
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrCreateInstance(const XrInstanceCreateInfo *info,
                                     XrInstance *instance) {
    ENTER;
    STRUCTURE(info, XR_TYPE_INSTANCE_CREATE_INFO,
              XR_TYPE_DEBUG_UTILS_MESSENGER_CREATE_INFO_EXT);
    XrVersion version = info->applicationInfo.apiVersion;
    REQUIRE(XR_VERSION_MAJOR(version) == 1 && XR_VERSION_MINOR(version) <= 1,
            XR_ERROR_API_VERSION_UNSUPPORTED, "version %u.%u is unknown",
            (unsigned)XR_VERSION_MAJOR(version), (unsigned)XR_VERSION_MINOR(version));
    memset(mock.is_enabled, 0, sizeof mock.is_enabled);
    for (uint32_t i = 0; i < info->enabledExtensionCount; i++) {
        int found = N_EXTENSIONS;
        for (int k = 0; k < N_EXTENSIONS; k++)
            if (!strcmp(info->enabledExtensionNames[i], EXTENSIONS[k])) found = k;
        if (found == N_EXTENSIONS || !is_offered(found))
            return XR_ERROR_EXTENSION_NOT_PRESENT;
        mock.is_enabled[found] = true;
    }
    mock.api_version = version;
    mock.is_instance_lost = false;
    *instance = HANDLE(XrInstance, create(INSTANCE, NULL));
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrDestroyInstance(XrInstance instance) {
    ENTER;
    struct object *found = find(INSTANCE, ID(instance));
    REQUIRE(found, XR_ERROR_HANDLE_INVALID, "there is no such instance");
    drop_events();
    for (uint64_t i = 0; i < mock.object_count; i++)
        if (mock.objects[i]->kind == SESSION && mock.objects[i]->is_alive &&
            mock.objects[i]->parent == found)
            destroy_session(mock.objects[i]);
    for (uint64_t i = 0; i < mock.object_count; i++) {
        struct object *root = mock.objects[i];
        while (root->parent) root = root->parent;
        if (root == found) mock.objects[i]->is_alive = false;
    }
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrGetInstanceProperties(XrInstance instance,
                                            XrInstanceProperties *properties) {
    ENTER;
    FIND(found, INSTANCE, instance);
    STRUCTURE(properties, XR_TYPE_INSTANCE_PROPERTIES);
    properties->runtimeVersion = XR_MAKE_VERSION(1, 0, 0);
    strcpy(properties->runtimeName, "mock runtime");
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrResultToString(XrInstance instance, XrResult value,
                                     char text[XR_MAX_RESULT_STRING_SIZE]) {
    ENTER;
    FIND(found, INSTANCE, instance);
    snprintf(text, XR_MAX_RESULT_STRING_SIZE, "%s", code_name(value));
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrStructureTypeToString(XrInstance instance, XrStructureType value,
                                            char text[XR_MAX_STRUCTURE_NAME_SIZE]) {
    ENTER;
    FIND(found, INSTANCE, instance);
    switch (value) {
#define STRUCTURE_NAME(name, number) \
    case name: strcpy(text, #name); break;
        XR_LIST_ENUM_XrStructureType(STRUCTURE_NAME)
    default:
        snprintf(text, XR_MAX_STRUCTURE_NAME_SIZE, "XR_UNKNOWN_STRUCTURE_TYPE_%d",
                 (int)value);
    }
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrGetSystem(XrInstance instance, const XrSystemGetInfo *info,
                                XrSystemId *system) {
    ENTER;
    FIND(found, INSTANCE, instance);
    STRUCTURE(info, XR_TYPE_SYSTEM_GET_INFO);
    if (info->formFactor != XR_FORM_FACTOR_HEAD_MOUNTED_DISPLAY)
        return XR_ERROR_FORM_FACTOR_UNSUPPORTED;
    *system = 1;
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrGetSystemProperties(XrInstance instance, XrSystemId system,
                                          XrSystemProperties *properties) {
    ENTER;
    FIND(found, INSTANCE, instance);
    REQUIRE_SYSTEM(system);
    XrStructureType gaze = XR_TYPE_SYSTEM_EYE_GAZE_INTERACTION_PROPERTIES_EXT;
    STRUCTURE(properties, XR_TYPE_SYSTEM_PROPERTIES, mock.is_enabled[GAZE] ? gaze : 0);
    XrSystemEyeGazeInteractionPropertiesEXT *eyes =
        (void *)(uintptr_t)chained_structure(properties->next, gaze);
    if (eyes) eyes->supportsEyeGazeInteraction = XR_TRUE;
    properties->systemId = system;
    properties->vendorId = 1;
    strcpy(properties->systemName, "mock headset");
    properties->graphicsProperties =
        (XrSystemGraphicsProperties){MAX_SIZE_PX, MAX_SIZE_PX, MAX_LAYERS};
    properties->trackingProperties = (XrSystemTrackingProperties){XR_TRUE, XR_TRUE};
    return XR_SUCCESS;
}

static uint32_t view_configuration_count(void) {
    return number_setting("MOCK_XR_MONO", 0) ? 2 : 1;
}

uint32_t views_of(XrViewConfigurationType type) {
    if (type == XR_VIEW_CONFIGURATION_TYPE_PRIMARY_STEREO) return 2;
    return type == XR_VIEW_CONFIGURATION_TYPE_PRIMARY_MONO &&
           view_configuration_count() == 2;
}

XrResult XRAPI_CALL xrEnumerateViewConfigurations(XrInstance instance,
                                                  XrSystemId system, uint32_t capacity,
                                                  uint32_t *count,
                                                  XrViewConfigurationType *types) {
    ENTER;
    FIND(found, INSTANCE, instance);
    REQUIRE_SYSTEM(system);
    uint32_t n = view_configuration_count();
    TWO_CALLS(capacity, count, n);
    types[0] = XR_VIEW_CONFIGURATION_TYPE_PRIMARY_STEREO;
    if (n == 2) types[1] = XR_VIEW_CONFIGURATION_TYPE_PRIMARY_MONO;
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrGetViewConfigurationProperties(
    XrInstance instance, XrSystemId system, XrViewConfigurationType type,
    XrViewConfigurationProperties *properties) {
    ENTER;
    FIND(found, INSTANCE, instance);
    REQUIRE_SYSTEM(system);
    REQUIRE_VIEWS(type);
    STRUCTURE(properties, XR_TYPE_VIEW_CONFIGURATION_PROPERTIES);
    properties->viewConfigurationType = type;
    properties->fovMutable = XR_TRUE;
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrEnumerateViewConfigurationViews(
    XrInstance instance, XrSystemId system, XrViewConfigurationType type,
    uint32_t capacity, uint32_t *count, XrViewConfigurationView *views) {
    ENTER;
    FIND(found, INSTANCE, instance);
    REQUIRE_SYSTEM(system);
    REQUIRE_VIEWS(type);
    TWO_CALLS(capacity, count, views_of(type));
    uint32_t width = 448, height = 504;
    sscanf(setting("MOCK_XR_SIZE", ""), "%ux%u", &width, &height);
    for (uint32_t i = 0; i < views_of(type); i++) {
        STRUCTURE(&views[i], XR_TYPE_VIEW_CONFIGURATION_VIEW);
        views[i].recommendedImageRectWidth = width;
        views[i].recommendedImageRectHeight = height;
        views[i].maxImageRectWidth = views[i].maxImageRectHeight = MAX_SIZE_PX;
        views[i].recommendedSwapchainSampleCount = 1;
        views[i].maxSwapchainSampleCount = 4;
    }
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrEnumerateEnvironmentBlendModes(XrInstance instance,
                                                     XrSystemId system,
                                                     XrViewConfigurationType type,
                                                     uint32_t capacity, uint32_t *count,
                                                     XrEnvironmentBlendMode *modes) {
    ENTER;
    FIND(found, INSTANCE, instance);
    REQUIRE_SYSTEM(system);
    REQUIRE_VIEWS(type);
    TWO_CALLS(capacity, count, 1u);
    *modes = XR_ENVIRONMENT_BLEND_MODE_OPAQUE;
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrGetOpenGLGraphicsRequirementsKHR(
    XrInstance instance, XrSystemId system, XrGraphicsRequirementsOpenGLKHR *needed) {
    ENTER;
    FIND(found, INSTANCE, instance);
    REQUIRE_SYSTEM(system);
    STRUCTURE(needed, XR_TYPE_GRAPHICS_REQUIREMENTS_OPENGL_KHR);
    needed->minApiVersionSupported = XR_MAKE_VERSION(3, 3, 0);
    needed->maxApiVersionSupported = XR_MAKE_VERSION(4, 6, 0);
    found->instance.has_asked_for_requirements = true;
    return XR_SUCCESS;
}

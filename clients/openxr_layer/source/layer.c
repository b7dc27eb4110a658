/* An OpenXR API layer through which another program is seen as an eye would see it.
 *
 * It copies color and depth of each view when the application releases its images, sends
 * them to a helper process, and shows the newest filtered frame in place of the
 * application's.  It passes on all other calls and layers unchanged.  See
 * docs/how-to/openxr-layer.md. */
#include <openxr/openxr_loader_negotiation.h>
#include <stdlib.h>
#include <string.h>

#include "frames.h"
#include "gaze.h"
#include "graphics.h"
#include "log.h"
#include "vk_context.h"

#define LAYER_NAME "XR_APILAYER_ocufilter_eye"
#define EXPORT __attribute__((visibility("default")))
#define DEPTH XR_KHR_COMPOSITION_LAYER_DEPTH_EXTENSION_NAME
#define GAZE XR_EXT_EYE_GAZE_INTERACTION_EXTENSION_NAME
#define MAX_COPIED_RELEASES 4u

/* Sessions ------------------------------------------------------------------------------- */

static void destroy_swapchain(swapchain *chain) {
    pthread_mutex_destroy(&chain->lock);
    free(chain);
}

/* Forget a session and what belongs to it; its handles are destroyed by the runtime. */
static void destroy_session(session *at) {
    swapchain *chains = detach_swapchains(at);
    space *known = detach_spaces(at);
    pthread_mutex_lock(&at->lock);
    if (at->api) at->api->destroy_copies(at, chains);
    frames_close(at);
    pthread_mutex_unlock(&at->lock);
    for (swapchain *next; chains; chains = next) {
        next = chains->next;
        destroy_swapchain(chains);
    }
    for (space *next; known; known = next) {
        next = known->next;
        free(known);
    }
    remove_session(at);
    pthread_mutex_destroy(&at->lock);
    free(at);
}

/* Open the graphics API that a session uses; return a reason, or NULL. */
static const char *open_graphics(session *at, const XrSessionCreateInfo *info) {
    for (const XrBaseInStructure *found = info->next; found; found = found->next) {
        const graphics_api *api =
            found->type == XR_TYPE_GRAPHICS_BINDING_VULKAN_KHR ? &vk_api
            : found->type == XR_TYPE_GRAPHICS_BINDING_OPENGL_XLIB_KHR ||
                    found->type == XR_TYPE_GRAPHICS_BINDING_EGL_MNDX
                ? &gl_api
                : NULL;
        if (!api) continue;
        const char *reason = api->open(at, found);
        if (!reason) at->api = api;
        return reason;
    }
    return "the application uses neither Vulkan nor OpenGL on X11 or EGL";
}

static XRAPI_ATTR XrResult XRAPI_CALL layer_CreateSession(XrInstance handle,
                                                          const XrSessionCreateInfo *info,
                                                          XrSession *made) {
    instance *own = find_instance(handle);
    if (!own) return XR_ERROR_HANDLE_INVALID;
    XrResult result = own->CreateSession(handle, info, made);
    if (XR_FAILED(result)) return result;
    session *at = calloc(1, sizeof *at);
    if (!at) {
        own->DestroySession(*made);
        return XR_ERROR_OUT_OF_MEMORY;
    }
    at->handle = *made;
    at->instance = own;
    pthread_mutex_init(&at->lock, NULL);
    const char *reason = open_graphics(at, info);
    link_init(&at->link, own->application, own->engine, at->api ? at->api->name : "");
    if (reason) LOG("the application's own frames are shown: %s", reason);
    add_session(at);
    return result;
}

static XRAPI_ATTR XrResult XRAPI_CALL layer_DestroySession(XrSession handle) {
    session *at = find_session(handle);
    if (!at) return XR_ERROR_HANDLE_INVALID;
    PFN_xrDestroySession destroy = at->instance->DestroySession;
    destroy_session(at);
    return destroy(handle);
}

static XRAPI_ATTR XrResult XRAPI_CALL layer_BeginFrame(XrSession handle,
                                                       const XrFrameBeginInfo *info) {
    session *at = find_session(handle);
    if (!at) return XR_ERROR_HANDLE_INVALID;
    frames_begin(at);
    return at->instance->BeginFrame(handle, info);
}

static XRAPI_ATTR XrResult XRAPI_CALL layer_EndFrame(XrSession handle,
                                                     const XrFrameEndInfo *info) {
    session *at = find_session(handle);
    return at ? frames_end(at, info) : XR_ERROR_HANDLE_INVALID;
}

static XRAPI_ATTR XrResult XRAPI_CALL layer_PollEvent(XrInstance handle,
                                                      XrEventDataBuffer *event) {
    instance *own = find_instance(handle);
    if (!own) return XR_ERROR_HANDLE_INVALID;
    XrResult result = own->PollEvent(handle, event);
    if (result != XR_SUCCESS ||
        event->type != XR_TYPE_EVENT_DATA_REFERENCE_SPACE_CHANGE_PENDING)
        return result;
    const XrEventDataReferenceSpaceChangePending *change = (const void *)event;
    note_recentered(change->session, change->changeTime);
    return result;
}

static XRAPI_ATTR XrResult XRAPI_CALL layer_CreateVulkanDeviceKHR(
    XrInstance handle, const XrVulkanDeviceCreateInfoKHR *info, VkDevice *made,
    VkResult *vulkan_result) {
    instance *own = find_instance(handle);
    PFN_xrCreateVulkanDeviceKHR create = NULL;
    if (!own || XR_FAILED(own->get_proc_addr(handle, "xrCreateVulkanDeviceKHR",
                                             (PFN_xrVoidFunction *)&create)))
        return XR_ERROR_HANDLE_INVALID;
    XrResult result = create(handle, info, made, vulkan_result);
    if (XR_SUCCEEDED(result) && *vulkan_result == VK_SUCCESS)
        vk_note_device(own, info, *made);
    return result;
}

/* Spaces --------------------------------------------------------------------------------- */

static XRAPI_ATTR XrResult XRAPI_CALL layer_CreateReferenceSpace(
    XrSession handle, const XrReferenceSpaceCreateInfo *info, XrSpace *made) {
    session *at = find_session(handle);
    if (!at) return XR_ERROR_HANDLE_INVALID;
    XrResult result = at->instance->CreateReferenceSpace(handle, info, made);
    space *known = XR_SUCCEEDED(result) ? calloc(1, sizeof *known) : NULL;
    if (!known) return result;
    known->handle = *made;
    known->session = handle;
    known->instance = at->instance;
    known->kind = (reference_space){info->referenceSpaceType, info->poseInReferenceSpace};
    add_space(known);
    return result;
}

static XRAPI_ATTR XrResult XRAPI_CALL layer_DestroySpace(XrSpace handle) {
    space *known = find_space(handle);
    if (known) {
        PFN_xrDestroySpace destroy = known->instance->DestroySpace;
        remove_space(known);
        free(known);
        return destroy(handle);
    }
    /* Spaces of actions and extensions are not recorded; nearly all programs have one
     * instance. */
    XrResult result = XR_ERROR_HANDLE_INVALID;
    for (instance *of = next_instance(NULL); of && result == XR_ERROR_HANDLE_INVALID;
         of = next_instance(of))
        result = of->DestroySpace(handle);
    return result;
}

/* Swapchains ----------------------------------------------------------------------------- */

static XRAPI_ATTR XrResult XRAPI_CALL layer_CreateSwapchain(
    XrSession handle, const XrSwapchainCreateInfo *info, XrSwapchain *made) {
    session *at = find_session(handle);
    if (!at) return XR_ERROR_HANDLE_INVALID;
    XrSwapchainCreateInfo mine = *info;
    if (at->api) mine.usageFlags |= at->api->usage;
    XrResult result = at->instance->CreateSwapchain(handle, &mine, made);
    bool can_copy = XR_SUCCEEDED(result);
    if (!can_copy && mine.usageFlags != info->usageFlags)
        result = at->instance->CreateSwapchain(handle, info, made);
    if (XR_FAILED(result)) return result;
    swapchain *chain = calloc(1, sizeof *chain);
    if (!chain) {
        at->instance->DestroySwapchain(*made);
        return XR_ERROR_OUT_OF_MEMORY;
    }
    chain->handle = *made;
    chain->session = at;
    pthread_mutex_init(&chain->lock, NULL);
    chain->info = *info;
    chain->info.next = NULL;
    if (at->api && can_copy && info->faceCount == 1) {
        chain->format = at->api->format_of(info->format);
        chain->image_count = at->api->find_images(at, *made, chain->images);
        if (!chain->image_count) chain->format = NULL;
    }
    add_swapchain(chain);
    return result;
}

static XRAPI_ATTR XrResult XRAPI_CALL layer_DestroySwapchain(XrSwapchain handle) {
    swapchain *chain = find_swapchain(handle);
    if (!chain) return XR_ERROR_HANDLE_INVALID;
    session *at = chain->session;
    remove_swapchain(chain);
    chain->next = NULL;
    pthread_mutex_lock(&at->lock);
    if (chain->copy && at->api) at->api->destroy_copies(at, chain);
    pthread_mutex_unlock(&at->lock);
    destroy_swapchain(chain);
    return at->instance->DestroySwapchain(handle);
}

static XRAPI_ATTR XrResult XRAPI_CALL layer_AcquireSwapchainImage(
    XrSwapchain handle, const XrSwapchainImageAcquireInfo *info, uint32_t *index) {
    swapchain *chain = find_swapchain(handle);
    if (!chain) return XR_ERROR_HANDLE_INVALID;
    XrResult result = chain->session->instance->AcquireSwapchainImage(handle, info, index);
    pthread_mutex_lock(&chain->lock);
    if (XR_SUCCEEDED(result) && chain->acquired_count < MAX_IMAGES)
        chain->acquired[chain->acquired_count++] = *index;
    pthread_mutex_unlock(&chain->lock);
    return result;
}

/* Return the index of the image that is released next, or one that no image has. */
static uint32_t next_released(swapchain *chain) {
    pthread_mutex_lock(&chain->lock);
    uint32_t index = chain->acquired_count ? chain->acquired[0] : MAX_IMAGES;
    pthread_mutex_unlock(&chain->lock);
    return index;
}

static void copy_released(swapchain *chain) {
    session *at = chain->session;
    uint32_t index = next_released(chain);
    if (!at->api || !chain->format) return;
    pthread_mutex_lock(&at->lock);
    uint64_t begun_ns = now_ns();
    /* Images of quads and other layers need no copy. */
    bool is_used = at->link.is_accepted && index < chain->image_count &&
                   chain->unused_releases < MAX_COPIED_RELEASES;
    /* Without one, an earlier copy is not of this image. */
    chain->has_copy = is_used && at->api->copy(chain, chain->images[index]);
    if (is_used) {
        ++chain->unused_releases;
        at->copy_ns += now_ns() - begun_ns;
    }
    pthread_mutex_unlock(&at->lock);
}

static XRAPI_ATTR XrResult XRAPI_CALL layer_ReleaseSwapchainImage(
    XrSwapchain handle, const XrSwapchainImageReleaseInfo *info) {
    swapchain *chain = find_swapchain(handle);
    if (!chain) return XR_ERROR_HANDLE_INVALID;
    copy_released(chain);
    XrResult result = chain->session->instance->ReleaseSwapchainImage(handle, info);
    pthread_mutex_lock(&chain->lock);
    if (XR_SUCCEEDED(result) && chain->acquired_count) {
        --chain->acquired_count;
        memmove(chain->acquired, chain->acquired + 1,
                chain->acquired_count * sizeof *chain->acquired);
    }
    pthread_mutex_unlock(&chain->lock);
    return result;
}

/* Actions -------------------------------------------------------------------------------- */

static XRAPI_ATTR XrResult XRAPI_CALL layer_SuggestInteractionProfileBindings(
    XrInstance handle, const XrInteractionProfileSuggestedBinding *given) {
    instance *own = find_instance(handle);
    return own ? gaze_suggest(own, given) : XR_ERROR_HANDLE_INVALID;
}

static XRAPI_ATTR XrResult XRAPI_CALL layer_AttachSessionActionSets(
    XrSession handle, const XrSessionActionSetsAttachInfo *given) {
    session *at = find_session(handle);
    return at ? gaze_attach(at, given) : XR_ERROR_HANDLE_INVALID;
}

static XRAPI_ATTR XrResult XRAPI_CALL layer_SyncActions(XrSession handle,
                                                        const XrActionsSyncInfo *given) {
    session *at = find_session(handle);
    return at ? gaze_sync(at, given) : XR_ERROR_HANDLE_INVALID;
}

/* Instances ------------------------------------------------------------------------------ */

static bool names(const XrInstanceCreateInfo *info, const char *extension) {
    for (uint32_t i = 0; i < info->enabledExtensionCount; ++i)
        if (!strcmp(info->enabledExtensionNames[i], extension)) return true;
    return false;
}

/* Create the instance below with other extensions than the application asks for. */
static XrResult create_below(const XrInstanceCreateInfo *given, bool adds_gaze,
                             bool drops_depth, const XrApiLayerCreateInfo *layers,
                             XrInstance *made) {
    const char **all = calloc(given->enabledExtensionCount + 1, sizeof *all);
    if (!all) return XR_ERROR_OUT_OF_MEMORY;
    uint32_t count = 0;
    for (uint32_t i = 0; i < given->enabledExtensionCount; ++i) {
        const char *name = given->enabledExtensionNames[i];
        if (!drops_depth || strcmp(name, DEPTH)) all[count++] = name;
    }
    if (adds_gaze) all[count++] = GAZE;
    XrInstanceCreateInfo mine = *given;
    mine.enabledExtensionCount = count;
    mine.enabledExtensionNames = all;
    XrApiLayerCreateInfo rest = *layers;
    rest.nextInfo = layers->nextInfo->next;
    XrResult result = layers->nextInfo->nextCreateApiLayerInstance(&mine, &rest, made);
    free(all);
    return result;
}

static bool has_functions(instance *own) {
    bool all = true;
#define F(name)                                                                          \
    all &= XR_SUCCEEDED(own->get_proc_addr(own->handle, "xr" #name,                      \
                                           (PFN_xrVoidFunction *)&own->name));
    NEXT_FUNCTIONS(F)
#undef F
    return all;
}

/* Runtimes may allow a single instance, so that one that is not used must go. */
static void destroy_below(PFN_xrGetInstanceProcAddr get_proc_addr, XrInstance handle) {
    PFN_xrDestroyInstance destroy = NULL;
    if (XR_SUCCEEDED(get_proc_addr(handle, "xrDestroyInstance",
                                   (PFN_xrVoidFunction *)&destroy)))
        destroy(handle);
}

static void watch_forks(void) { pthread_atfork(NULL, NULL, abandon_links); }

static XRAPI_ATTR XrResult XRAPI_CALL layer_CreateApiLayerInstance(
    const XrInstanceCreateInfo *info, const XrApiLayerCreateInfo *layers,
    XrInstance *made) {
    if (!layers || !layers->nextInfo || strcmp(layers->nextInfo->layerName, LAYER_NAME))
        return XR_ERROR_INITIALIZATION_FAILED;
    /* Runtimes refuse an instance with extensions that they lack.  The layer adds the gaze
     * extension if it can; depth is offered to the application by the layer's manifest. */
    bool has_gaze = names(info, GAZE), has_depth = names(info, DEPTH);
    XrResult result = XR_ERROR_EXTENSION_NOT_PRESENT;
    bool adds_gaze = false, drops_depth = false;
    for (int i = 0; i < 4 && result == XR_ERROR_EXTENSION_NOT_PRESENT; ++i) {
        adds_gaze = !(i & 1);
        drops_depth = i & 2;
        if ((adds_gaze && has_gaze) || (drops_depth && !has_depth)) continue;
        result = create_below(info, adds_gaze, drops_depth, layers, made);
    }
    if (XR_FAILED(result)) return result;
    PFN_xrGetInstanceProcAddr get_proc_addr = layers->nextInfo->nextGetInstanceProcAddr;
    instance *own = calloc(1, sizeof *own);
    if (own) {
        own->handle = *made;
        own->get_proc_addr = get_proc_addr;
    }
    if (!own || !has_functions(own)) {
        destroy_below(get_proc_addr, *made);
        free(own);
        return XR_ERROR_INITIALIZATION_FAILED;
    }
    own->has_gaze = adds_gaze || has_gaze;
    own->is_depth_stripped = drops_depth;
    memcpy(own->application, info->applicationInfo.applicationName,
           sizeof own->application - 1);
    memcpy(own->engine, info->applicationInfo.engineName, sizeof own->engine - 1);
    if (own->has_gaze) gaze_create(own);
    add_instance(own);
    static pthread_once_t once = PTHREAD_ONCE_INIT;
    pthread_once(&once, watch_forks);
    return result;
}

static XRAPI_ATTR XrResult XRAPI_CALL layer_DestroyInstance(XrInstance handle) {
    instance *own = find_instance(handle);
    if (!own) return XR_ERROR_HANDLE_INVALID;
    PFN_xrDestroyInstance destroy = own->DestroyInstance;
    for (session *at; (at = session_of_instance(own));) destroy_session(at);
    remove_instance(own);
    free(own);
    return destroy(handle);
}

/* The loader ----------------------------------------------------------------------------- */

static XRAPI_ATTR XrResult XRAPI_CALL layer_GetInstanceProcAddr(
    XrInstance handle, const char *name, PFN_xrVoidFunction *function) {
    static const struct {
        const char *name;
        PFN_xrVoidFunction function;
    } OWN[] = {
#define F(name) {"xr" #name, (PFN_xrVoidFunction)layer_##name}
        F(AcquireSwapchainImage),
        F(AttachSessionActionSets),
        F(BeginFrame),
        F(CreateReferenceSpace),
        F(CreateSession),
        F(CreateSwapchain),
        F(CreateVulkanDeviceKHR),
        F(DestroyInstance),
        F(DestroySession),
        F(DestroySpace),
        F(DestroySwapchain),
        F(EndFrame),
        F(GetInstanceProcAddr),
        F(PollEvent),
        F(ReleaseSwapchainImage),
        F(SuggestInteractionProfileBindings),
        F(SyncActions),
#undef F
    };
    /* Functions of extensions exist only where the runtime has them. */
    instance *own = find_instance(handle);
    XrResult result =
        own ? own->get_proc_addr(handle, name, function) : XR_ERROR_HANDLE_INVALID;
    if (own && XR_FAILED(result)) return result;
    for (size_t i = 0; i < sizeof OWN / sizeof *OWN; ++i) {
        if (strcmp(name, OWN[i].name)) continue;
        *function = OWN[i].function;
        return XR_SUCCESS;
    }
    return result;
}

EXPORT XRAPI_ATTR XrResult XRAPI_CALL xrNegotiateLoaderApiLayerInterface(
    const XrNegotiateLoaderInfo *loader, const char *name,
    XrNegotiateApiLayerRequest *request) {
    if (!loader || !request || (name && strcmp(name, LAYER_NAME)) ||
        loader->structType != XR_LOADER_INTERFACE_STRUCT_LOADER_INFO ||
        request->structType != XR_LOADER_INTERFACE_STRUCT_API_LAYER_REQUEST ||
        loader->minInterfaceVersion > XR_CURRENT_LOADER_API_LAYER_VERSION ||
        loader->maxInterfaceVersion < XR_CURRENT_LOADER_API_LAYER_VERSION)
        return XR_ERROR_INITIALIZATION_FAILED;
    request->layerInterfaceVersion = XR_CURRENT_LOADER_API_LAYER_VERSION;
    request->layerApiVersion = XR_CURRENT_API_VERSION;
    request->getInstanceProcAddr = layer_GetInstanceProcAddr;
    request->createApiLayerInstance = layer_CreateApiLayerInstance;
    return XR_SUCCESS;
}

/* Two threads with a session each: one makes and destroys sessions, the other swapchains
 * and spaces, at the same time, as the specification allows. */
#include <EGL/egl.h>
#include <EGL/eglext.h>
#include <GL/gl.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#define XR_USE_GRAPHICS_API_OPENGL
#define XR_USE_PLATFORM_EGL
#include <openxr/openxr.h>
#include <openxr/openxr_platform.h>

enum { SESSIONS = 100, SWAPCHAINS = 200, SPACES = 20 };

static XrInstance instance;
static XrSystemId system_id;
static EGLDisplay display;
static EGLConfig config;

static void must(XrResult result, const char *call) {
    if (XR_SUCCEEDED(result)) return;
    fprintf(stderr, "handles: %s: %d\n", call, result);
    exit(1);
}
#define MUST(call) must(call, #call)

static EGLContext current_context(void) {
    const EGLint version[] = {EGL_CONTEXT_MAJOR_VERSION, 3, EGL_CONTEXT_MINOR_VERSION, 3,
                              EGL_NONE};
    eglBindAPI(EGL_OPENGL_API);
    EGLContext made = eglCreateContext(display, config, EGL_NO_CONTEXT, version);
    eglMakeCurrent(display, EGL_NO_SURFACE, EGL_NO_SURFACE, made);
    return made;
}

static XrSession create_session(EGLContext context) {
    XrGraphicsBindingEGLMNDX binding = {
        .type = XR_TYPE_GRAPHICS_BINDING_EGL_MNDX,
        .getProcAddress = (PFN_xrEglGetProcAddressMNDX)eglGetProcAddress,
        .display = display,
        .config = config,
        .context = context};
    XrSessionCreateInfo info = {XR_TYPE_SESSION_CREATE_INFO, &binding, 0, system_id};
    XrSession made;
    MUST(xrCreateSession(instance, &info, &made));
    return made;
}

static XrSwapchain create_swapchain(XrSession session) {
    XrSwapchainCreateInfo info = {.type = XR_TYPE_SWAPCHAIN_CREATE_INFO,
                                  .usageFlags = XR_SWAPCHAIN_USAGE_COLOR_ATTACHMENT_BIT,
                                  .format = 0x8c43, /* GL_SRGB8_ALPHA8 */
                                  .sampleCount = 1,
                                  .width = 16,
                                  .height = 16,
                                  .faceCount = 1,
                                  .arraySize = 1,
                                  .mipCount = 1};
    XrSwapchain made;
    MUST(xrCreateSwapchain(session, &info, &made));
    return made;
}

static XrSpace create_space(XrSession session) {
    XrReferenceSpaceCreateInfo info = {.type = XR_TYPE_REFERENCE_SPACE_CREATE_INFO,
                                       .referenceSpaceType = XR_REFERENCE_SPACE_TYPE_LOCAL,
                                       .poseInReferenceSpace.orientation.w = 1};
    XrSpace made;
    MUST(xrCreateReferenceSpace(session, &info, &made));
    return made;
}

static void *make_sessions(void *unused) {
    EGLContext context = current_context();
    for (int i = 0; i < SESSIONS; i++) {
        XrSession session = create_session(context);
        create_swapchain(session);
        create_space(session);
        MUST(xrDestroySession(session));
    }
    return unused;
}

static void *make_parts(void *unused) {
    XrSession session = create_session(current_context());
    for (int i = 0; i < SWAPCHAINS; i++) {
        XrSwapchain swapchain = create_swapchain(session);
        XrSpace spaces[SPACES];
        for (int k = 0; k < SPACES; k++) spaces[k] = create_space(session);
        for (int k = 0; k < SPACES; k++) MUST(xrDestroySpace(spaces[k]));
        MUST(xrDestroySwapchain(swapchain));
    }
    return unused;
}

static void open_display(void) {
    const EGLint wanted[] = {EGL_SURFACE_TYPE, EGL_PBUFFER_BIT, EGL_RENDERABLE_TYPE,
                             EGL_OPENGL_BIT, EGL_NONE};
    EGLint count;
    display = eglGetPlatformDisplay(EGL_PLATFORM_SURFACELESS_MESA, EGL_DEFAULT_DISPLAY, NULL);
    eglInitialize(display, NULL, NULL);
    eglChooseConfig(display, wanted, &config, 1, &count);
}

static void open_instance(void) {
    const char *extensions[] = {"XR_KHR_opengl_enable", "XR_MNDX_egl_enable"};
    XrInstanceCreateInfo info = {
        .type = XR_TYPE_INSTANCE_CREATE_INFO,
        .applicationInfo = {.applicationName = "handles", .apiVersion = XR_API_VERSION_1_0},
        .enabledExtensionCount = 2,
        .enabledExtensionNames = extensions};
    MUST(xrCreateInstance(&info, &instance));
    XrSystemGetInfo system = {XR_TYPE_SYSTEM_GET_INFO, NULL,
                              XR_FORM_FACTOR_HEAD_MOUNTED_DISPLAY};
    MUST(xrGetSystem(instance, &system, &system_id));
    PFN_xrGetOpenGLGraphicsRequirementsKHR get_requirements;
    MUST(xrGetInstanceProcAddr(instance, "xrGetOpenGLGraphicsRequirementsKHR",
                               (PFN_xrVoidFunction *)&get_requirements));
    XrGraphicsRequirementsOpenGLKHR requirements = {
        .type = XR_TYPE_GRAPHICS_REQUIREMENTS_OPENGL_KHR};
    MUST(get_requirements(instance, system_id, &requirements));
}

int main(void) {
    open_display();
    open_instance();
    pthread_t sessions, parts;
    pthread_create(&sessions, NULL, make_sessions, NULL);
    pthread_create(&parts, NULL, make_parts, NULL);
    pthread_join(sessions, NULL);
    pthread_join(parts, NULL);
    MUST(xrDestroyInstance(instance));
    return 0;
}

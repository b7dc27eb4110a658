/* A session, from its binding to its end, and its events. */
#include "mock.h"

enum { MAX_EVENTS = 64 };
static XrEventDataBuffer events[MAX_EVENTS];
static unsigned event_first, event_count;

void *queue_event(XrStructureType type) {
    XrEventDataBuffer *event = &events[(event_first + event_count) % MAX_EVENTS];
    if (event_count < MAX_EVENTS) event_count++;
    memset(event, 0, sizeof *event);
    event->type = type;
    return event;
}

/* Those of an instance end with it. */
void drop_events(void) { event_count = 0; }

XrTime now_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * 1000000000ll + now.tv_nsec;
}

void enter_state(struct object *session, XrSessionState state) {
    XrEventDataSessionStateChanged *event =
        queue_event(XR_TYPE_EVENT_DATA_SESSION_STATE_CHANGED);
    event->session = HANDLE(XrSession, session);
    event->state = state;
    event->time = now_ns();
    session->session.state = state;
}

void begin_stopping(struct object *session) {
    XrSessionState state = session->session.state;
    if (state == XR_SESSION_STATE_STOPPING) return;
    if (state == XR_SESSION_STATE_FOCUSED)
        enter_state(session, XR_SESSION_STATE_VISIBLE);
    if (state >= XR_SESSION_STATE_VISIBLE)
        enter_state(session, XR_SESSION_STATE_SYNCHRONIZED);
    enter_state(session, XR_SESSION_STATE_STOPPING);
}

XrResult XRAPI_CALL xrPollEvent(XrInstance instance, XrEventDataBuffer *event) {
    ENTER;
    FIND(found, INSTANCE, instance);
    STRUCTURE(event, XR_TYPE_EVENT_DATA_BUFFER);
    if (!event_count) return XR_EVENT_UNAVAILABLE;
    *event = events[event_first];
    event_first = (event_first + 1) % MAX_EVENTS;
    event_count--;
    return XR_SUCCESS;
}

static XrResult bind_egl(struct object *session,
                         const XrGraphicsBindingEGLMNDX *given) {
    static const EGLint VERSION[] = {EGL_CONTEXT_MAJOR_VERSION, 4,
                                     EGL_CONTEXT_MINOR_VERSION, 5, EGL_NONE};
    REQUIRE(mock.is_enabled[EGL], XR_ERROR_VALIDATION_FAILURE, "EGL is not enabled");
    REQUIRE(given->display && given->context && given->getProcAddress,
            XR_ERROR_GRAPHICS_DEVICE_INVALID, "the binding is not complete");
    session->session.application =
        (struct current){.egl_display = given->display, .egl = given->context};
    session->session.own = session->session.application;
    session->session.own.egl =
        eglCreateContext(given->display, given->config, given->context, VERSION);
    REQUIRE(session->session.own.egl, XR_ERROR_GRAPHICS_DEVICE_INVALID,
            "no context can share with the application's: 0x%x",
            (unsigned)eglGetError());
    return XR_SUCCESS;
}

static XrResult bind_glx(struct object *session,
                         const XrGraphicsBindingOpenGLXlibKHR *given) {
    static const int VERSION[] = {GLX_CONTEXT_MAJOR_VERSION_ARB, 4,
                                  GLX_CONTEXT_MINOR_VERSION_ARB, 5, None};
    static const int SMALL[] = {GLX_PBUFFER_WIDTH, 1, GLX_PBUFFER_HEIGHT, 1, None};
    REQUIRE(given->xDisplay && given->glxContext && given->glxDrawable,
            XR_ERROR_GRAPHICS_DEVICE_INVALID, "the binding is not complete");
    PFNGLXCREATECONTEXTATTRIBSARBPROC make =
        (PFNGLXCREATECONTEXTATTRIBSARBPROC)glXGetProcAddressARB(
            (const GLubyte *)"glXCreateContextAttribsARB");
    session->session.application = (struct current){
        .glx_display = given->xDisplay,
        .glx = given->glxContext,
        .glx_draw = given->glxDrawable,
        .glx_read = given->glxDrawable,
    };
    struct current *own = &session->session.own;
    own->glx_display = given->xDisplay;
    session->session.pbuffer =
        glXCreatePbuffer(given->xDisplay, given->glxFBConfig, SMALL);
    own->glx_draw = own->glx_read = session->session.pbuffer;
    own->glx =
        make(given->xDisplay, given->glxFBConfig, given->glxContext, True, VERSION);
    REQUIRE(own->glx, XR_ERROR_GRAPHICS_DEVICE_INVALID,
            "no context can share with the application's");
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrCreateSession(XrInstance instance,
                                    const XrSessionCreateInfo *info,
                                    XrSession *session) {
    ENTER;
    FIND(parent, INSTANCE, instance);
    STRUCTURE(info, XR_TYPE_SESSION_CREATE_INFO,
              XR_TYPE_GRAPHICS_BINDING_OPENGL_XLIB_KHR,
              XR_TYPE_GRAPHICS_BINDING_EGL_MNDX, XR_TYPE_GRAPHICS_BINDING_VULKAN_KHR);
    REQUIRE_SYSTEM(info->systemId);
    const void *vulkan =
        chained_structure(info->next, XR_TYPE_GRAPHICS_BINDING_VULKAN_KHR);
    REQUIRE(vulkan ? mock.is_enabled[VULKAN] || mock.is_enabled[VULKAN2]
                   : mock.is_enabled[OPENGL],
            XR_ERROR_GRAPHICS_DEVICE_INVALID, "the graphics API is not enabled");
    REQUIRE(parent->instance.has_asked_for_requirements,
            XR_ERROR_GRAPHICS_REQUIREMENTS_CALL_MISSING,
            "the graphics requirements were not asked for");
    const void *egl = chained_structure(info->next, XR_TYPE_GRAPHICS_BINDING_EGL_MNDX);
    const void *glx =
        chained_structure(info->next, XR_TYPE_GRAPHICS_BINDING_OPENGL_XLIB_KHR);
    REQUIRE(egl || glx || vulkan, XR_ERROR_GRAPHICS_DEVICE_INVALID,
            "there is no binding");
    struct object *made = create(SESSION, parent);
    XrResult result;
    if (vulkan) {
        result = bind_vulkan(made, vulkan);
    } else {
        struct borrowed saved = borrow();
        result = egl ? bind_egl(made, egl) : bind_glx(made, glx);
        give_back(&saved);
    }
    made->is_alive = result == XR_SUCCESS;
    if (result != XR_SUCCESS) return result;
    const struct current *application = &made->session.application;
    if (!vulkan)
        know_context(application->egl ? application->egl : (void *)application->glx);
    enter_state(made, XR_SESSION_STATE_IDLE);
    enter_state(made, XR_SESSION_STATE_READY);
    *session = HANDLE(XrSession, made);
    return XR_SUCCESS;
}

void destroy_session(struct object *session) {
    for (uint64_t i = 0; i < mock.object_count; i++) {
        if (mock.objects[i]->parent != session || !mock.objects[i]->is_alive) continue;
        if (mock.objects[i]->kind == SWAPCHAIN) destroy_swapchain(mock.objects[i]);
        mock.objects[i]->is_alive = false;
    }
    struct current *own = &session->session.own;
    if (session->session.vulkan.device) unbind_vulkan(session);
    if (own->egl) eglDestroyContext(own->egl_display, own->egl);
    if (own->glx) {
        glXDestroyContext(own->glx_display, own->glx);
        glXDestroyPbuffer(own->glx_display, session->session.pbuffer);
    }
    for (uint32_t i = 0; i < session->session.attached_count; i++)
        session->session.attached[i]->action.is_attached = false;
    session->is_alive = session->session.is_running = false;
    pthread_cond_broadcast(&mock.frame_has_begun);
}

XrResult XRAPI_CALL xrDestroySession(XrSession session) {
    ENTER;
    struct object *found = find(SESSION, ID(session));
    REQUIRE(found, XR_ERROR_HANDLE_INVALID, "there is no such session");
    destroy_session(found);
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrBeginSession(XrSession session, const XrSessionBeginInfo *info) {
    ENTER;
    FIND(found, SESSION, session);
    STRUCTURE(info, XR_TYPE_SESSION_BEGIN_INFO);
    REQUIRE_VIEWS(info->primaryViewConfigurationType);
    REQUIRE(!found->session.is_running, XR_ERROR_SESSION_RUNNING,
            "it has begun before");
    REQUIRE(found->session.state == XR_SESSION_STATE_READY, XR_ERROR_SESSION_NOT_READY,
            "its state is %d", (int)found->session.state);
    found->session.is_running = true;
    found->session.view_count = views_of(info->primaryViewConfigurationType);
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrEndSession(XrSession session) {
    ENTER;
    FIND(found, SESSION, session);
    REQUIRE_RUNNING(found);
    REQUIRE(found->session.state == XR_SESSION_STATE_STOPPING,
            XR_ERROR_SESSION_NOT_STOPPING, "its state is %d",
            (int)found->session.state);
    found->session.is_running = found->session.in_frame = false;
    found->session.begun = found->session.waited;
    pthread_cond_broadcast(&mock.frame_has_begun);
    enter_state(found, XR_SESSION_STATE_IDLE);
    enter_state(found, XR_SESSION_STATE_EXITING);
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrRequestExitSession(XrSession session) {
    ENTER;
    FIND(found, SESSION, session);
    REQUIRE_RUNNING(found);
    begin_stopping(found);
    return XR_SUCCESS;
}

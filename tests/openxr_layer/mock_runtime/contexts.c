/* Contexts of OpenGL: of the application, of the runtime, and of nobody. */
#include "mock.h"

enum { MAX_KNOWN = 64 };

static struct current get_current(void) {
    return (struct current){
        eglGetCurrentDisplay(),         eglGetCurrentContext(),
        eglGetCurrentSurface(EGL_DRAW), eglGetCurrentSurface(EGL_READ),
        glXGetCurrentDisplay(),         glXGetCurrentContext(),
        glXGetCurrentDrawable(),        glXGetCurrentReadDrawable()};
}

/* A thread cannot have a context of EGL and one of GLX: the other one goes first. */
bool set_current(const struct current *wanted) {
    struct current now = get_current();
    if (now.glx && !wanted->glx) glXMakeContextCurrent(now.glx_display, 0, 0, NULL);
    if (now.egl && !wanted->egl)
        eglMakeCurrent(now.egl_display, EGL_NO_SURFACE, EGL_NO_SURFACE, EGL_NO_CONTEXT);
    if (wanted->egl)
        return eglMakeCurrent(wanted->egl_display, wanted->egl_draw, wanted->egl_read,
                              wanted->egl);
    if (wanted->glx)
        return glXMakeContextCurrent(wanted->glx_display, wanted->glx_draw,
                                     wanted->glx_read, wanted->glx);
    return true;
}

/* Of EGL's client APIs, a thread may have bound OpenGL ES, which has contexts apart. */
struct borrowed borrow(void) {
    struct borrowed saved = {.api = eglQueryAPI()};
    eglBindAPI(EGL_OPENGL_API);
    saved.before = get_current();
    return saved;
}

void give_back(const struct borrowed *saved) {
    set_current(&saved->before);
    eglBindAPI(saved->api);
}

/* Wait for the application's commands, in its context or queue. */
XrResult finish_application(struct object *session) {
    if (session->session.vulkan.device) {
        VkResult result = vkQueueWaitIdle(session->session.vulkan.queue);
        REQUIRE(result == VK_SUCCESS, XR_ERROR_RUNTIME_FAILURE, "the queue failed: %d",
                (int)result);
        return XR_SUCCESS;
    }
    struct borrowed saved = borrow();
    bool is_ours = set_current(&session->session.application);
    if (is_ours) glFinish();
    give_back(&saved);
    REQUIRE(is_ours, XR_ERROR_RUNTIME_FAILURE,
            "the application's context is current on another thread");
    return XR_SUCCESS;
}

static void *known_contexts[MAX_KNOWN];
static unsigned known_count;

void know_context(void *context) {
    if (known_count < MAX_KNOWN) known_contexts[known_count++] = context;
}

/* A layer that leaves its context current is seen at the next call: the thread then has
 * a context that is no session's, and that nobody had before there was a session. */
static void check_current_context(void) {
    void *context = eglGetCurrentContext();
    if (!context) context = glXGetCurrentContext();
    if (!context || known_count == MAX_KNOWN) return;
    for (unsigned i = 0; i < known_count; i++)
        if (known_contexts[i] == context) return;
    know_context(context); /* reported once */
    for (uint64_t i = 0; i < mock.object_count; i++)
        if (mock.objects[i]->kind == SESSION && mock.objects[i]->is_alive) {
            fprintf(
                stderr,
                "mock: violation: %s: the current context is not the application's\n",
                mock.call);
            return;
        }
}

int enter(const char *name) {
    pthread_mutex_lock(&mock.lock);
    mock.call = name;
    check_current_context();
    return 0;
}

void leave(int *unused) {
    (void)unused;
    pthread_mutex_unlock(&mock.lock);
}

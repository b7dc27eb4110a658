#define _GNU_SOURCE
#include "gl_context.h"

#include <dlfcn.h>
#include <pthread.h>
#include <stdlib.h>
#include <string.h>

#include "log.h"

/* Window-system functions, from the libraries that the application has loaded. */
#define GLX_FUNCTIONS(F)                                                                 \
    F(GLXContext, glXCreateContextAttribsARB,                                            \
      (Display *, GLXFBConfig, GLXContext, Bool, const int *))                           \
    F(GLXPbuffer, glXCreatePbuffer, (Display *, GLXFBConfig, const int *))               \
    F(void, glXDestroyContext, (Display *, GLXContext))                                  \
    F(void, glXDestroyPbuffer, (Display *, GLXPbuffer))                                  \
    F(GLXContext, glXGetCurrentContext, (void))                                          \
    F(Display *, glXGetCurrentDisplay, (void))                                           \
    F(GLXDrawable, glXGetCurrentDrawable, (void))                                        \
    F(GLXDrawable, glXGetCurrentReadDrawable, (void))                                    \
    F(int, glXGetFBConfigAttrib, (Display *, GLXFBConfig, int, int *))                   \
    F(GLXFBConfig *, glXGetFBConfigs, (Display *, int, int *))                           \
    F(Bool, glXMakeContextCurrent, (Display *, GLXDrawable, GLXDrawable, GLXContext))    \
    F(int, glXQueryContext, (Display *, GLXContext, int, int *))

#define EGL_FUNCTIONS(F)                                                                 \
    F(EGLBoolean, eglBindAPI, (EGLenum))                                                 \
    F(EGLContext, eglCreateContext,                                                      \
      (EGLDisplay, EGLConfig, EGLContext, const EGLint *))                               \
    F(EGLSurface, eglCreatePbufferSurface, (EGLDisplay, EGLConfig, const EGLint *))      \
    F(EGLBoolean, eglDestroyContext, (EGLDisplay, EGLContext))                           \
    F(EGLBoolean, eglDestroySurface, (EGLDisplay, EGLSurface))                           \
    F(EGLContext, eglGetCurrentContext, (void))                                          \
    F(EGLDisplay, eglGetCurrentDisplay, (void))                                          \
    F(EGLSurface, eglGetCurrentSurface, (EGLint))                                        \
    F(EGLBoolean, eglMakeCurrent, (EGLDisplay, EGLSurface, EGLSurface, EGLContext))      \
    F(EGLenum, eglQueryAPI, (void))                                                      \
    F(EGLBoolean, eglQueryContext, (EGLDisplay, EGLContext, EGLint, EGLint *))           \
    F(const char *, eglQueryString, (EGLDisplay, EGLint))

#define F(type, name, parameters) static type(*p_##name) parameters;
GLX_FUNCTIONS(F)
EGL_FUNCTIONS(F)
#undef F
static int (*p_XFree)(void *);
static int (*p_XSync)(Display *, Bool);
static XErrorHandler (*p_XSetErrorHandler)(XErrorHandler);
static void *(*glx_get_proc)(const GLubyte *);
static void *(*egl_get_proc)(const char *);

static void *library(const char *name) { return dlopen(name, RTLD_NOW | RTLD_LOCAL); }

/* ISO C does not convert between pointers to objects and to functions; POSIX does. */
static bool set_pointer(void *target, void *found) {
    memcpy(target, &found, sizeof found);
    return found != NULL;
}

/* Functions are loaded once in a process. */
static pthread_mutex_t loading = PTHREAD_MUTEX_INITIALIZER;

static const char *load_glx_once(void) {
    static bool is_loaded;
    if (is_loaded) return NULL;
    void *gl = library("libGL.so.1"), *x11 = library("libX11.so.6");
    if (!gl || !x11) return "libGL or libX11 is missing";
    if (!set_pointer(&glx_get_proc, dlsym(gl, "glXGetProcAddressARB")))
        return "glXGetProcAddressARB is missing";
    bool all = set_pointer(&p_XFree, dlsym(x11, "XFree")) &
               set_pointer(&p_XSync, dlsym(x11, "XSync")) &
               set_pointer(&p_XSetErrorHandler, dlsym(x11, "XSetErrorHandler"));
#define F(type, name, parameters)                                                        \
    all &= set_pointer(&p_##name, glx_get_proc((const GLubyte *)#name));
    GLX_FUNCTIONS(F)
#undef F
    is_loaded = all;
    return all ? NULL : "a function of GLX is missing";
}

static const char *load_egl_once(PFN_xrEglGetProcAddressMNDX get_proc) {
    static bool is_loaded;
    if (is_loaded) return NULL;
    void *egl = library("libEGL.so.1");
    if (get_proc) memcpy(&egl_get_proc, &get_proc, sizeof egl_get_proc);
    else if (!egl || !set_pointer(&egl_get_proc, dlsym(egl, "eglGetProcAddress")))
        return "eglGetProcAddress is missing";
    bool all = true;
    /* eglGetProcAddress returns functions of EGL itself only since EGL 1.5 */
#define F(type, name, parameters)                                                        \
    all &= set_pointer(&p_##name, egl ? dlsym(egl, #name) : NULL) ||                     \
           set_pointer(&p_##name, egl_get_proc(#name));
    EGL_FUNCTIONS(F)
#undef F
    is_loaded = all;
    return all ? NULL : "a function of EGL is missing";
}

static const char *load_glx(void) {
    pthread_mutex_lock(&loading);
    const char *reason = load_glx_once();
    pthread_mutex_unlock(&loading);
    return reason;
}

static const char *load_egl(PFN_xrEglGetProcAddressMNDX get_proc) {
    pthread_mutex_lock(&loading);
    const char *reason = load_egl_once(get_proc);
    pthread_mutex_unlock(&loading);
    return reason;
}

static const char *load_gl(gl_context *gl) {
    bool all = true;
#define GET(name) (gl->is_egl ? egl_get_proc(name) : glx_get_proc((const GLubyte *)(name)))
#define F(NAME, name) all &= set_pointer(&gl->name, GET("gl" #name));
    GL_FUNCTIONS(F)
#undef F
    set_pointer(&gl->CopyImageSubData, GET("glCopyImageSubData")); /* also without support */
#undef GET
    return all ? NULL : "a function of OpenGL 3.2 is missing";
}

/* GLX --------------------------------------------------------------------------------- */

static bool has_x_error;

static int note_x_error(Display *display, XErrorEvent *event) {
    (void)display, (void)event;
    has_x_error = true;
    return 0;
}

/* The configuration of the application's context.  Some programs pass a wrong one in the
 * graphics binding, which runtimes ignore. */
static GLXFBConfig config_of(Display *display, GLXContext context) {
    int id = 0, screen = 0, count = 0;
    p_glXQueryContext(display, context, GLX_FBCONFIG_ID, &id);
    p_glXQueryContext(display, context, GLX_SCREEN, &screen);
    GLXFBConfig *all = p_glXGetFBConfigs(display, screen, &count), found = NULL;
    for (int i = 0; i < count && !found; ++i) {
        int own = 0;
        p_glXGetFBConfigAttrib(display, all[i], GLX_FBCONFIG_ID, &own);
        if (own == id) found = all[i];
    }
    if (all) p_XFree(all);
    return found;
}

/* A context that shares with another one must have the same kind of resets and errors,
 * which cannot be queried without making the other one current. */
static const int GLX_ATTRIBUTES[][9] = {
    {0x2091, 3, 0x2092, 2, 0x9126, 1, 0},            /* 3.2 core */
    {0x2091, 3, 0x2092, 2, 0x9126, 1, 0x8256, 0x8252, 0}, /* lose context on reset */
    {0x2091, 3, 0x2092, 2, 0x9126, 1, 0x31b3, 1, 0}, /* no errors */
    {0x2091, 3, 0x2092, 0, 0},
};

static const char *open_glx(gl_context *gl, const XrGraphicsBindingOpenGLXlibKHR *binding) {
    const char *reason = load_glx();
    if (reason) return reason;
    load_egl(NULL); /* for gl_enter; it may be missing */
    Display *display = gl->x_display = binding->xDisplay;
    if (!display || !binding->glxContext) return "the graphics binding has no context";
    /* The default handler ends the program at the first error.  A process has one. */
    static pthread_mutex_t handler = PTHREAD_MUTEX_INITIALIZER;
    pthread_mutex_lock(&handler);
    p_XSync(display, False);
    XErrorHandler previous = p_XSetErrorHandler(note_x_error);
    GLXFBConfig config = config_of(display, binding->glxContext);
    for (size_t i = 0; config && !gl->glx_context &&
                       i < sizeof GLX_ATTRIBUTES / sizeof *GLX_ATTRIBUTES; ++i)
        gl->glx_context = p_glXCreateContextAttribsARB(display, config,
                                                       binding->glxContext, True,
                                                       GLX_ATTRIBUTES[i]);
    int kinds = 0;
    if (gl->glx_context &&
        !p_glXGetFBConfigAttrib(display, config, GLX_DRAWABLE_TYPE, &kinds) &&
        kinds & GLX_PBUFFER_BIT) {
        const int size[] = {GLX_PBUFFER_WIDTH, 1, GLX_PBUFFER_HEIGHT, 1, None};
        has_x_error = false;
        gl->glx_drawable = p_glXCreatePbuffer(display, config, size);
        p_XSync(display, False);
        /* An OpenGL context since 3.0 needs no drawable. */
        if (has_x_error) gl->glx_drawable = None;
    }
    p_XSync(display, False);
    p_XSetErrorHandler(previous);
    pthread_mutex_unlock(&handler);
    if (!config) return "the configuration of the application's context is unknown";
    return gl->glx_context ? NULL : "no context shares with the application's";
}

/* EGL --------------------------------------------------------------------------------- */

static const EGLint EGL_ATTRIBUTES[][9] = {
    {0x3098, 3, 0x30fb, 2, 0x30fd, 1, EGL_NONE},
    {0x3098, 3, 0x30fb, 2, 0x30fd, 1, 0x31bd, 0x31bf, EGL_NONE},
    {0x3098, 3, 0x30fb, 2, 0x30fd, 1, 0x31b3, 1, EGL_NONE},
};

static const char *open_egl(gl_context *gl, const XrGraphicsBindingEGLMNDX *binding) {
    const char *reason = load_egl(binding->getProcAddress);
    if (reason) return reason;
    EGLDisplay display = gl->egl_display = binding->display;
    EGLint client = 0;
    if (!p_eglQueryContext(display, binding->context, EGL_CONTEXT_CLIENT_TYPE, &client))
        return "the graphics binding has no context";
    if (client != EGL_OPENGL_API) return "the application uses OpenGL ES";
    EGLenum api = p_eglQueryAPI();
    p_eglBindAPI(EGL_OPENGL_API);
    for (size_t i = 0; gl->egl_context == EGL_NO_CONTEXT &&
                       i < sizeof EGL_ATTRIBUTES / sizeof *EGL_ATTRIBUTES; ++i)
        gl->egl_context = p_eglCreateContext(display, binding->config, binding->context,
                                             EGL_ATTRIBUTES[i]);
    const char *extensions = p_eglQueryString(display, EGL_EXTENSIONS);
    if (!extensions || !strstr(extensions, "EGL_KHR_surfaceless_context")) {
        const EGLint size[] = {EGL_WIDTH, 1, EGL_HEIGHT, 1, EGL_NONE};
        gl->egl_surface = p_eglCreatePbufferSurface(display, binding->config, size);
    }
    p_eglBindAPI(api);
    return gl->egl_context != EGL_NO_CONTEXT ? NULL
                                             : "no context shares with the application's";
}

/* Both -------------------------------------------------------------------------------- */

const char *gl_open(gl_context *gl, const XrBaseInStructure *binding) {
    *gl = (gl_context){.is_egl = binding->type == XR_TYPE_GRAPHICS_BINDING_EGL_MNDX,
                       .egl_context = EGL_NO_CONTEXT,
                       .egl_surface = EGL_NO_SURFACE};
    const char *reason = gl->is_egl
                             ? open_egl(gl, (const XrGraphicsBindingEGLMNDX *)binding)
                             : open_glx(gl, (const XrGraphicsBindingOpenGLXlibKHR *)binding);
    if (!reason) reason = load_gl(gl);
    gl_current before;
    if (!reason && !gl_enter(gl, &before)) reason = "its context cannot be made current";
    if (reason) {
        gl_close(gl);
        return reason;
    }
    int major = 0, minor = 0;
    const char *version = (const char *)gl->GetString(GL_VERSION);
    if (!version || sscanf(version, "%d.%d", &major, &minor) != 2 ||
        10 * major + minor < 43)
        gl->CopyImageSubData = NULL;
    const char *renderer = (const char *)gl->GetString(GL_RENDERER);
    gl->is_software = renderer && (strstr(renderer, "llvmpipe") ||
                                   strstr(renderer, "softpipe") ||
                                   strstr(renderer, "Software Rasterizer"));
    const char *reads = getenv("OCUFILTER_LAYER_READS"); /* as with a GPU, without one */
    if (reads && !strcmp(reads, "buffered")) gl->is_software = false;
    gl->GenFramebuffers(1, &gl->read_framebuffer);
    gl->GenFramebuffers(1, &gl->draw_framebuffer);
    gl->BindFramebuffer(GL_READ_FRAMEBUFFER, gl->read_framebuffer);
    gl->BindFramebuffer(GL_DRAW_FRAMEBUFFER, gl->draw_framebuffer);
    /* Samples are averaged in linear light. */
    gl->Enable(GL_FRAMEBUFFER_SRGB);
    gl_leave(gl, &before, false);
    return NULL;
}

void gl_close(gl_context *gl) {
    if (gl->glx_context) {
        if (gl->glx_drawable) p_glXDestroyPbuffer(gl->x_display, gl->glx_drawable);
        p_glXDestroyContext(gl->x_display, gl->glx_context);
    }
    if (gl->egl_context != EGL_NO_CONTEXT) {
        if (gl->egl_surface != EGL_NO_SURFACE)
            p_eglDestroySurface(gl->egl_display, gl->egl_surface);
        p_eglDestroyContext(gl->egl_display, gl->egl_context);
    }
    *gl = (gl_context){.egl_context = EGL_NO_CONTEXT, .egl_surface = EGL_NO_SURFACE};
}

static bool make_own_current(gl_context *gl) {
    if (gl->is_egl)
        return p_eglMakeCurrent(gl->egl_display, gl->egl_surface, gl->egl_surface,
                                gl->egl_context);
    return p_glXMakeContextCurrent(gl->x_display, gl->glx_drawable, gl->glx_drawable,
                                   gl->glx_context);
}

static void restore(gl_context *gl, const gl_current *before) {
    if (gl->is_egl) {
        if (before->has_context)
            p_eglMakeCurrent(before->egl_display, before->egl_draw, before->egl_read,
                             before->egl_context);
        else
            p_eglMakeCurrent(gl->egl_display, EGL_NO_SURFACE, EGL_NO_SURFACE,
                             EGL_NO_CONTEXT);
        p_eglBindAPI(before->egl_api);
    } else if (before->has_context) {
        p_glXMakeContextCurrent(before->x_display, before->glx_draw, before->glx_read,
                                before->glx_context);
    } else {
        p_glXMakeContextCurrent(gl->x_display, None, None, NULL);
    }
}

bool gl_enter(gl_context *gl, gl_current *before) {
    /* A thread has a current context of GLX or of EGL, not of both.  The call for the
     * other one fails: in EGL with an error code, in GLX with an X error, whose default
     * handler ends the program. */
    if (!gl->is_egl && p_eglGetCurrentContext &&
        p_eglGetCurrentContext() != EGL_NO_CONTEXT)
        return false;
    *before = (gl_current){0};
    if (gl->is_egl) {
        before->egl_api = p_eglQueryAPI();
        p_eglBindAPI(EGL_OPENGL_API);
        before->egl_context = p_eglGetCurrentContext();
        before->has_context = before->egl_context != EGL_NO_CONTEXT;
        before->egl_display = p_eglGetCurrentDisplay();
        before->egl_draw = p_eglGetCurrentSurface(EGL_DRAW);
        before->egl_read = p_eglGetCurrentSurface(EGL_READ);
    } else {
        before->glx_context = p_glXGetCurrentContext();
        before->has_context = before->glx_context != NULL;
        before->x_display = p_glXGetCurrentDisplay();
        before->glx_draw = p_glXGetCurrentDrawable();
        before->glx_read = p_glXGetCurrentReadDrawable();
    }
    GLsync drawn = NULL;
    if (before->has_context) {
        drawn = gl->FenceSync(GL_SYNC_GPU_COMMANDS_COMPLETE, 0);
        gl->Flush();
    }
    bool is_current = make_own_current(gl);
    if (!is_current) restore(gl, before);
    if (drawn) {
        before->is_shared = is_current && gl->IsSync(drawn);
        if (before->is_shared) gl->WaitSync(drawn, 0, GL_TIMEOUT_IGNORED);
        else if (is_current) { /* an unrelated context, which alone has the fence */
            restore(gl, before);
            gl->DeleteSync(drawn);
            is_current = make_own_current(gl);
            drawn = NULL;
        }
        if (drawn) gl->DeleteSync(drawn);
    }
    return is_current;
}

void gl_leave(gl_context *gl, const gl_current *before, bool has_written) {
    GLsync written = NULL;
    if (has_written && before->is_shared)
        written = gl->FenceSync(GL_SYNC_GPU_COMMANDS_COMPLETE, 0);
    if (has_written && !before->is_shared) gl->Finish();
    gl->Flush();
    restore(gl, before);
    if (written) {
        gl->WaitSync(written, 0, GL_TIMEOUT_IGNORED);
        gl->DeleteSync(written);
    }
}

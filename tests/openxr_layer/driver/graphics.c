/* The application's context, of EGL or of GLX. */
#include "driver.h"

struct graphics graphics;

struct context_handles new_context(void) {
    static const EGLint EGL_VERSION_3_3[] = {EGL_CONTEXT_MAJOR_VERSION, 3,
                                             EGL_CONTEXT_MINOR_VERSION, 3, EGL_NONE};
    static const int GLX_VERSION_3_3[] = {GLX_CONTEXT_MAJOR_VERSION_ARB,
                                          3,
                                          GLX_CONTEXT_MINOR_VERSION_ARB,
                                          3,
                                          GLX_CONTEXT_PROFILE_MASK_ARB,
                                          GLX_CONTEXT_CORE_PROFILE_BIT_ARB,
                                          None};
    PFNGLXCREATECONTEXTATTRIBSARBPROC make =
        (PFNGLXCREATECONTEXTATTRIBSARBPROC)glXGetProcAddressARB(
            (const GLubyte *)"glXCreateContextAttribsARB");
    struct context_handles made = {0};
    if (options.glx)
        made.glx =
            make(graphics.x_display, graphics.glx_config, NULL, True, GLX_VERSION_3_3);
    else
        made.egl = eglCreateContext(graphics.egl_display, graphics.egl_config,
                                    EGL_NO_CONTEXT, EGL_VERSION_3_3);
    if (!made.glx && !made.egl) fail("new_context", "no OpenGL 3.3");
    return made;
}

void open_egl(void) {
    static const EGLint CONFIG[] = {EGL_SURFACE_TYPE, EGL_PBUFFER_BIT,
                                    EGL_RENDERABLE_TYPE, EGL_OPENGL_BIT, EGL_NONE};
    EGLint count = 0;
    graphics.egl_display =
        eglGetPlatformDisplay(EGL_PLATFORM_SURFACELESS_MESA, EGL_DEFAULT_DISPLAY, NULL);
    if (!eglInitialize(graphics.egl_display, NULL, NULL))
        fail("eglInitialize", "no display without a surface");
    eglBindAPI(EGL_OPENGL_API);
    eglChooseConfig(graphics.egl_display, CONFIG, &graphics.egl_config, 1, &count);
    graphics.context = new_context();
}

void open_glx(void) {
    static const int CONFIG[] = {GLX_DRAWABLE_TYPE,
                                 GLX_WINDOW_BIT,
                                 GLX_RENDER_TYPE,
                                 GLX_RGBA_BIT,
                                 GLX_DOUBLEBUFFER,
                                 True,
                                 GLX_RED_SIZE,
                                 8,
                                 None};
    int count = 0;
    graphics.x_display = XOpenDisplay(NULL);
    if (!graphics.x_display) fail("XOpenDisplay", "no display");
    GLXFBConfig *found = glXChooseFBConfig(
        graphics.x_display, DefaultScreen(graphics.x_display), CONFIG, &count);
    if (!count) fail("glXChooseFBConfig", "no configuration");
    graphics.glx_config = found[0];
    XFree(found);
    XVisualInfo *visual =
        glXGetVisualFromFBConfig(graphics.x_display, graphics.glx_config);
    graphics.visual = visual->visualid;
    Window root = DefaultRootWindow(graphics.x_display);
    XSetWindowAttributes with = {
        .colormap =
            XCreateColormap(graphics.x_display, root, visual->visual, AllocNone)};
    graphics.window =
        XCreateWindow(graphics.x_display, root, 0, 0, 64, 64, 0, visual->depth,
                      InputOutput, visual->visual, CWColormap, &with);
    XFree(visual);
    graphics.context = new_context();
}

void make_current(bool is_current) {
    if (options.vulkan) return; /* a device belongs to no thread */
    bool done =
        options.glx
            ? glXMakeCurrent(graphics.x_display, is_current ? graphics.window : None,
                             is_current ? graphics.context.glx : NULL)
            : eglBindAPI(EGL_OPENGL_API) &&
                  eglMakeCurrent(graphics.egl_display, EGL_NO_SURFACE, EGL_NO_SURFACE,
                                 is_current ? graphics.context.egl : EGL_NO_CONTEXT);
    if (!done) fail("make_current", "the context could not be made current");
}

void close_graphics(void) {
    make_current(false);
    if (options.glx) {
        glXDestroyContext(graphics.x_display, graphics.context.glx);
        XDestroyWindow(graphics.x_display, graphics.window);
        XCloseDisplay(graphics.x_display);
    } else {
        eglDestroyContext(graphics.egl_display, graphics.context.egl);
        eglTerminate(graphics.egl_display);
        eglReleaseThread();
    }
}

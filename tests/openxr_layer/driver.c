/* An OpenXR application that draws known pictures, for tests of an API layer below it.
 *
 *   driver CASE [--frames N] [--size WxH] [--format F] [--depth D] [--distance-m X]
 *          [--near-z X] [--far-z X] [--glx] [--threads] [--check-state]
 *
 * CASE is one of `CASES` below, which says what each does.  Formats: SRGB8_ALPHA8, RGBA8,
 * RGB10_A2, RGBA16F; D16, D24, D32F, D24S8, D32FS8, none.  The depth is that of a plane
 * across the view; planes of --near-z 100 --far-z 0.1 are reversed, "inf" is infinite.
 *
 * Row y (from the bottom) and column x of view v of frame n are white where
 * (x + n) / 4 is even, elsewhere red (v = 0) or blue (v = 1); in the lowest 8 rows the
 * first 64 columns are 16 cells, bit by bit of n: green for 1 and black for 0.  A quad is
 * a view of its own, 2, in green.  Alpha is 1, or x / width where the case is about alpha.
 *
 * On standard output: a line of JSON for each frame shown, with the time it is for, the
 * views as submitted ("%a": x, y, z, quaternion; left, right, up, down) and milliseconds
 * in calls; and a summary.  Exit status: 0; 1 if a call failed, or if one left a state
 * changed (--check-state); 77 if the runtime lacks what the case needs.
 */
#include <EGL/egl.h>
#include <EGL/eglext.h>
#define GL_GLEXT_PROTOTYPES
#include <GL/gl.h>
#include <GL/glext.h>
#include <GL/glx.h>
#include <math.h>
#include <pthread.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#define XR_USE_GRAPHICS_API_OPENGL
#define XR_USE_PLATFORM_XLIB
#define XR_USE_PLATFORM_EGL
#include <openxr/openxr.h>
#include <openxr/openxr_platform.h>
#include <openxr/openxr_reflection.h>

enum fault {
    SOUND,
    CONSTANT,
    NOT_A_NUMBER,
    SWAPPED,
    ZERO_NEAR,
    EQUAL,
    RANGE,
    SIZE,
    STALE,
    RECT,
    GARBAGE,
    OTHER_ARRAY
};

struct plan {
    const char *name, *words;
    bool is_array, is_wide, has_offset, is_dynamic, is_flipped, has_alpha, is_mono;
    bool is_view_locked, in_action_space, renews_space, other_thread, no_context;
    bool ends_from_thread, second, violates;
    uint32_t samples;
    int release_every; /* frames; -1: only the first one */
    int sessions, projections, quad; /* quad: -1 below, 1 above the projection */
    enum fault depth;
};

static const struct plan CASES[] = {
    {"plain", "two swapchains, both drawn each frame", .release_every = 1},
    {"array", "one swapchain of two layers", .is_array = true},
    {"wide", "one image with both views side by side", .is_wide = true},
    {"offset", "views are parts of larger images", .has_offset = true},
    {"msaa4", "images of four samples", .samples = 4},
    {"reuse", "drawn once, submitted each frame", .release_every = -1},
    {"half-rate", "drawn every second frame", .release_every = 2},
    {"two-layers", "a second projection, blended by its alpha", .projections = 2},
    {"quad-below", "a quad under the projection", .quad = -1},
    {"quad-above", "a quad over the projection", .quad = 1},
    {"view-locked", "the projection is in a VIEW space", .is_view_locked = true},
    {"action-space", "the projection is in a space of an action", .in_action_space = true},
    {"space-destroyed", "another space every 10 frames", .renews_space = true},
    {"mono", "one view, of PRIMARY_MONO", .is_mono = true},
    {"other-thread", "another thread releases and ends", .other_thread = true},
    {"no-context", "releases and ends without a context", .no_context = true},
    {"restart", "three sessions, one after the other", .sessions = 3},
    {"end-from-thread", "the frames run in a thread", .ends_from_thread = true},
    {"second-session", "another session beside and after", .second = true},
    {"dynamic-size", "another size every 5 frames", .is_dynamic = true},
    {"fov-flipped", "angleUp below angleDown", .is_flipped = true},
    {"alpha", "a projection blended by its alpha", .has_alpha = true},
    {"violation", "errors that the runtime must report", .violates = true},
    {"depth-constant", "nothing but 1", .depth = CONSTANT},
    {"depth-nan", "not a number (with Mesa: 0) in every second column", .depth = NOT_A_NUMBER},
    {"depth-swapped", "nearZ and farZ exchanged", .depth = SWAPPED},
    {"depth-zero-near", "nearZ is 0", .depth = ZERO_NEAR},
    {"depth-equal", "nearZ is farZ", .depth = EQUAL},
    {"depth-range", "minDepth above maxDepth, or maxDepth above 1", .depth = RANGE},
    {"depth-size", "half the resolution of the color", .depth = SIZE},
    {"depth-stale", "released in the first frame only", .depth = STALE},
    {"depth-rect", "part outside of the image", .depth = RECT},
    {"depth-garbage", "noise", .depth = GARBAGE},
    {"depth-other-array", "each view has the depth of the other, at twice or half the "
                          "distance", .is_array = true, .depth = OTHER_ARRAY},
};

static const struct {
    const char *name;
    GLenum format;
} FORMATS[] = {
    {"SRGB8_ALPHA8", GL_SRGB8_ALPHA8},   {"RGBA8", GL_RGBA8},
    {"RGB10_A2", GL_RGB10_A2},           {"RGBA16F", GL_RGBA16F},
    {"D16", GL_DEPTH_COMPONENT16},       {"D24", GL_DEPTH_COMPONENT24},
    {"D32F", GL_DEPTH_COMPONENT32F},     {"D24S8", GL_DEPTH24_STENCIL8},
    {"D32FS8", GL_DEPTH32F_STENCIL8},    {"none", GL_NONE},
};

enum { QUAD_PX = 64, OFFSET_X_PX = 40, OFFSET_Y_PX = 24, SKIPPED = 77 };

static struct {
    struct plan plan;
    int frames;
    uint32_t width, height;
    GLenum color_format, depth_format;
    float distance_m, near_z, far_z;
    bool glx, threads, check_state;
} options = {.frames = 30,
             .color_format = GL_SRGB8_ALPHA8,
             .depth_format = GL_DEPTH_COMPONENT32F,
             .distance_m = 2,
             .near_z = 0.1f,
             .far_z = 100};

/* --- failures -------------------------------------------------------------------- */

static const char *code_name(XrResult code) {
    switch (code) {
#define NAME(name, value) \
    case name: \
        return #name;
        XR_LIST_ENUM_XrResult(NAME) default : return "XrResult";
    }
}

static void fail(const char *call, const char *why) {
    printf("{\"error\": \"%s\", \"call\": \"%s\"}\n", why, call);
    fflush(stdout);
    fprintf(stderr, "driver: %s: %s\n", call, why);
    _Exit(1); /* other threads may be in the middle of a frame */
}

static XrResult must(XrResult result, const char *call) {
    if (XR_FAILED(result)) fail(call, code_name(result));
    return result;
}

#define MUST(call) must(call, #call)

static void skip(const char *why) {
    printf("{\"skipped\": \"%s\"}\n", why);
    exit(SKIPPED);
}

/* --- contexts -------------------------------------------------------------------- */

struct context_handles { /* one of them */
    EGLContext egl;
    GLXContext glx;
};

static struct {
    EGLDisplay egl_display;
    EGLConfig egl_config;
    Display *x_display;
    GLXFBConfig glx_config;
    Window window;
    VisualID visual;
    struct context_handles context;
} graphics;

static struct context_handles new_context(void) {
    static const EGLint EGL_VERSION_3_3[] = {EGL_CONTEXT_MAJOR_VERSION, 3,
                                             EGL_CONTEXT_MINOR_VERSION, 3, EGL_NONE};
    static const int GLX_VERSION_3_3[] = {GLX_CONTEXT_MAJOR_VERSION_ARB, 3,
                                          GLX_CONTEXT_MINOR_VERSION_ARB, 3,
                                          GLX_CONTEXT_PROFILE_MASK_ARB,
                                          GLX_CONTEXT_CORE_PROFILE_BIT_ARB, None};
    PFNGLXCREATECONTEXTATTRIBSARBPROC make =
        (PFNGLXCREATECONTEXTATTRIBSARBPROC)glXGetProcAddressARB(
            (const GLubyte *)"glXCreateContextAttribsARB");
    struct context_handles made = {0};
    if (options.glx)
        made.glx = make(graphics.x_display, graphics.glx_config, NULL, True,
                        GLX_VERSION_3_3);
    else
        made.egl = eglCreateContext(graphics.egl_display, graphics.egl_config,
                                    EGL_NO_CONTEXT, EGL_VERSION_3_3);
    if (!made.glx && !made.egl) fail("new_context", "no OpenGL 3.3");
    return made;
}

static void open_egl(void) {
    static const EGLint CONFIG[] = {EGL_SURFACE_TYPE, EGL_PBUFFER_BIT, EGL_RENDERABLE_TYPE,
                                    EGL_OPENGL_BIT, EGL_NONE};
    EGLint count = 0;
    graphics.egl_display = eglGetPlatformDisplay(EGL_PLATFORM_SURFACELESS_MESA,
                                                 EGL_DEFAULT_DISPLAY, NULL);
    if (!eglInitialize(graphics.egl_display, NULL, NULL))
        fail("eglInitialize", "no display without a surface");
    eglBindAPI(EGL_OPENGL_API);
    eglChooseConfig(graphics.egl_display, CONFIG, &graphics.egl_config, 1, &count);
    graphics.context = new_context();
}

static void open_glx(void) {
    static const int CONFIG[] = {GLX_DRAWABLE_TYPE, GLX_WINDOW_BIT, GLX_RENDER_TYPE,
                                 GLX_RGBA_BIT, GLX_DOUBLEBUFFER, True, GLX_RED_SIZE, 8, None};
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
        .colormap = XCreateColormap(graphics.x_display, root, visual->visual, AllocNone)};
    graphics.window =
        XCreateWindow(graphics.x_display, root, 0, 0, 64, 64, 0, visual->depth,
                      InputOutput, visual->visual, CWColormap, &with);
    XFree(visual);
    graphics.context = new_context();
}

static void make_current(bool is_current) {
    bool done =
        options.glx
            ? glXMakeCurrent(graphics.x_display, is_current ? graphics.window : None,
                             is_current ? graphics.context.glx : NULL)
            : eglBindAPI(EGL_OPENGL_API) &&
                  eglMakeCurrent(graphics.egl_display, EGL_NO_SURFACE, EGL_NO_SURFACE,
                                 is_current ? graphics.context.egl : EGL_NO_CONTEXT);
    if (!done) fail("make_current", "the context could not be made current");
}

static void close_graphics(void) {
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

/* --- state of OpenGL that calls must leave alone --------------------------------- */

#define LIST(name) {#name, name}
static const struct {
    const char *name;
    GLenum value;
} STATES[] = {
    LIST(GL_CURRENT_PROGRAM), LIST(GL_VERTEX_ARRAY_BINDING), LIST(GL_ARRAY_BUFFER_BINDING),
    LIST(GL_ELEMENT_ARRAY_BUFFER_BINDING), LIST(GL_PIXEL_PACK_BUFFER_BINDING),
    LIST(GL_PIXEL_UNPACK_BUFFER_BINDING), LIST(GL_UNIFORM_BUFFER_BINDING),
    LIST(GL_TRANSFORM_FEEDBACK_BUFFER_BINDING), LIST(GL_COPY_READ_BUFFER_BINDING),
    LIST(GL_COPY_WRITE_BUFFER_BINDING), LIST(GL_SHADER_STORAGE_BUFFER_BINDING),
    LIST(GL_DRAW_INDIRECT_BUFFER_BINDING), LIST(GL_DISPATCH_INDIRECT_BUFFER_BINDING),
    LIST(GL_ATOMIC_COUNTER_BUFFER_BINDING), LIST(GL_PROGRAM_PIPELINE_BINDING),
    LIST(GL_DRAW_FRAMEBUFFER_BINDING), LIST(GL_READ_FRAMEBUFFER_BINDING),
    LIST(GL_RENDERBUFFER_BINDING), LIST(GL_DRAW_BUFFER), LIST(GL_READ_BUFFER),
    LIST(GL_ACTIVE_TEXTURE), LIST(GL_VIEWPORT), LIST(GL_SCISSOR_BOX), LIST(GL_DEPTH_RANGE),
    LIST(GL_COLOR_WRITEMASK), LIST(GL_DEPTH_WRITEMASK), LIST(GL_DEPTH_FUNC),
    LIST(GL_STENCIL_WRITEMASK), LIST(GL_STENCIL_BACK_WRITEMASK), LIST(GL_STENCIL_FUNC),
    LIST(GL_STENCIL_REF), LIST(GL_STENCIL_VALUE_MASK), LIST(GL_STENCIL_FAIL),
    LIST(GL_STENCIL_PASS_DEPTH_FAIL), LIST(GL_STENCIL_PASS_DEPTH_PASS),
    LIST(GL_BLEND_SRC_RGB), LIST(GL_BLEND_DST_RGB), LIST(GL_BLEND_SRC_ALPHA),
    LIST(GL_BLEND_DST_ALPHA), LIST(GL_BLEND_EQUATION_RGB), LIST(GL_BLEND_EQUATION_ALPHA),
    LIST(GL_BLEND_COLOR), LIST(GL_CULL_FACE_MODE), LIST(GL_FRONT_FACE),
    LIST(GL_POLYGON_MODE), LIST(GL_POLYGON_OFFSET_FACTOR), LIST(GL_POLYGON_OFFSET_UNITS),
    LIST(GL_COLOR_CLEAR_VALUE), LIST(GL_DEPTH_CLEAR_VALUE), LIST(GL_STENCIL_CLEAR_VALUE),
    LIST(GL_LOGIC_OP_MODE), LIST(GL_SAMPLE_COVERAGE_VALUE), LIST(GL_POINT_SIZE),
    LIST(GL_PACK_ALIGNMENT), LIST(GL_PACK_ROW_LENGTH), LIST(GL_PACK_SKIP_ROWS),
    LIST(GL_PACK_SKIP_PIXELS), LIST(GL_PACK_IMAGE_HEIGHT), LIST(GL_PACK_SKIP_IMAGES),
    LIST(GL_PACK_SWAP_BYTES), LIST(GL_UNPACK_ALIGNMENT), LIST(GL_UNPACK_ROW_LENGTH),
    LIST(GL_UNPACK_SKIP_ROWS), LIST(GL_UNPACK_SKIP_PIXELS), LIST(GL_UNPACK_IMAGE_HEIGHT),
    LIST(GL_UNPACK_SKIP_IMAGES), LIST(GL_UNPACK_SWAP_BYTES), LIST(GL_BLEND),
    LIST(GL_DEPTH_TEST), LIST(GL_STENCIL_TEST), LIST(GL_SCISSOR_TEST), LIST(GL_CULL_FACE),
    LIST(GL_FRAMEBUFFER_SRGB), LIST(GL_MULTISAMPLE), LIST(GL_SAMPLE_COVERAGE),
    LIST(GL_SAMPLE_ALPHA_TO_COVERAGE), LIST(GL_SAMPLE_MASK), LIST(GL_DITHER),
    LIST(GL_COLOR_LOGIC_OP), LIST(GL_POLYGON_OFFSET_FILL), LIST(GL_DEPTH_CLAMP),
    LIST(GL_RASTERIZER_DISCARD), LIST(GL_PRIMITIVE_RESTART), LIST(GL_PROGRAM_POINT_SIZE),
    LIST(GL_TEXTURE_CUBE_MAP_SEAMLESS), LIST(GL_CLIP_DISTANCE0), LIST(GL_CLIP_ORIGIN),
    LIST(GL_CLIP_DEPTH_MODE),
};
static const struct {
    const char *name;
    GLenum value;
} UNIT_STATES[] = {
    LIST(GL_TEXTURE_BINDING_2D), LIST(GL_TEXTURE_BINDING_2D_ARRAY),
    LIST(GL_TEXTURE_BINDING_3D), LIST(GL_TEXTURE_BINDING_CUBE_MAP),
    LIST(GL_TEXTURE_BINDING_RECTANGLE), LIST(GL_TEXTURE_BINDING_BUFFER),
    LIST(GL_TEXTURE_BINDING_2D_MULTISAMPLE), LIST(GL_TEXTURE_BINDING_2D_MULTISAMPLE_ARRAY),
    LIST(GL_SAMPLER_BINDING),
};
#define LENGTH(array) (sizeof(array) / sizeof *(array))
enum { N_STATES = LENGTH(STATES), N_UNIT_STATES = LENGTH(UNIT_STATES), N_UNITS = 8 };

static bool is_known[N_STATES], is_unit_known[N_UNIT_STATES];

struct snapshot {
    void *current[8];
    EGLenum api;
    GLenum error;
    GLfloat values[N_STATES][4];
    GLint units[N_UNITS][N_UNIT_STATES];
    GLint uniform_buffers[4], query;
};

static bool has_context(void) { return eglGetCurrentContext() || glXGetCurrentContext(); }

static void read_state(struct snapshot *to) {
    memset(to, 0, sizeof *to);
    void *current[] = {eglGetCurrentDisplay(),
                       eglGetCurrentContext(),
                       eglGetCurrentSurface(EGL_DRAW),
                       eglGetCurrentSurface(EGL_READ),
                       glXGetCurrentDisplay(),
                       glXGetCurrentContext(),
                       (void *)(uintptr_t)glXGetCurrentDrawable(),
                       (void *)(uintptr_t)glXGetCurrentReadDrawable()};
    memcpy(to->current, current, sizeof current);
    to->api = eglQueryAPI();
    if (!has_context()) return;
    to->error = glGetError();
    for (int i = 0; i < N_STATES; i++)
        if (is_known[i]) glGetFloatv(STATES[i].value, to->values[i]);
    GLint active;
    glGetIntegerv(GL_ACTIVE_TEXTURE, &active);
    for (int unit = 0; unit < N_UNITS; unit++) {
        glActiveTexture(GL_TEXTURE0 + (GLenum)unit);
        for (int i = 0; i < N_UNIT_STATES; i++)
            if (is_unit_known[i]) glGetIntegerv(UNIT_STATES[i].value, &to->units[unit][i]);
    }
    glActiveTexture((GLenum)active);
    for (GLuint i = 0; i < 4; i++)
        glGetIntegeri_v(GL_UNIFORM_BUFFER_BINDING, i, &to->uniform_buffers[i]);
    glGetQueryiv(GL_SAMPLES_PASSED, GL_CURRENT_QUERY, &to->query);
}

/* Fail with the first difference; where the context is another one, all else is too. */
static void compare_states(const char *call, const struct snapshot *a,
                           const struct snapshot *b) {
    static const char *const CURRENT[] = {"display", "context", "draw surface",
                                          "read surface"};
    char why[128] = "";
#define DIFFER(differs, ...) \
    if (!*why && (differs)) snprintf(why, sizeof why, __VA_ARGS__)
    for (int i = 0; i < 8; i++)
        DIFFER(a->current[i] != b->current[i], "the current %s changed", CURRENT[i % 4]);
    DIFFER(a->api != b->api, "EGL's API changed");
    DIFFER(a->error, "OpenGL's error 0x%x before it", a->error);
    DIFFER(b->error, "OpenGL's error 0x%x", b->error);
    for (int i = 0; i < N_STATES; i++)
        DIFFER(memcmp(a->values[i], b->values[i], sizeof a->values[i]),
               "%s was %g, is %g", STATES[i].name, (double)a->values[i][0],
               (double)b->values[i][0]);
    for (int unit = 0; unit < N_UNITS; unit++)
        for (int i = 0; i < N_UNIT_STATES; i++)
            DIFFER(a->units[unit][i] != b->units[unit][i], "%s of unit %d was %d, is %d",
                   UNIT_STATES[i].name, unit, a->units[unit][i], b->units[unit][i]);
    for (int i = 0; i < 4; i++)
        DIFFER(a->uniform_buffers[i] != b->uniform_buffers[i],
               "uniform buffer %d was %d, is %d", i, a->uniform_buffers[i],
               b->uniform_buffers[i]);
    DIFFER(a->query != b->query, "the query was %d, is %d", a->query, b->query);
    if (*why) fail(call, why);
}

static GLuint made[8]; /* objects that are bound while calls are made */

static void make_unusual_objects(void) {
    for (int i = 0; i < N_STATES; i++) { /* some came with later versions of OpenGL */
        GLfloat values[16];
        glGetFloatv(STATES[i].value, values);
        is_known[i] = glGetError() == GL_NO_ERROR;
    }
    for (int i = 0; i < N_UNIT_STATES; i++) {
        GLint value;
        glGetIntegerv(UNIT_STATES[i].value, &value);
        is_unit_known[i] = glGetError() == GL_NO_ERROR;
    }
    glGenTextures(3, made);
    glGenBuffers(1, &made[3]);
    glGenSamplers(1, &made[4]);
    glGenRenderbuffers(1, &made[5]);
    glGenQueries(1, &made[6]);
}

/* Set what a layer might rely on, or change, to values that are not the defaults. */
static void set_unusual_state(void) {
    static const GLenum BUFFERS[] = {GL_ARRAY_BUFFER,     GL_PIXEL_PACK_BUFFER,
                                     GL_PIXEL_UNPACK_BUFFER, GL_UNIFORM_BUFFER,
                                     GL_COPY_READ_BUFFER, GL_COPY_WRITE_BUFFER};
    static const GLenum TOGGLES[] = {GL_BLEND,        GL_DEPTH_TEST, GL_STENCIL_TEST,
                                     GL_SCISSOR_TEST, GL_CULL_FACE,  GL_FRAMEBUFFER_SRGB,
                                     GL_RASTERIZER_DISCARD, GL_SAMPLE_COVERAGE};
    for (size_t i = 0; i < LENGTH(BUFFERS); i++) glBindBuffer(BUFFERS[i], made[3]);
    for (size_t i = 0; i < LENGTH(TOGGLES); i++) glEnable(TOGGLES[i]);
    for (GLuint unit = 0; unit < N_UNITS; unit++) {
        glActiveTexture(GL_TEXTURE0 + unit);
        glBindTexture(GL_TEXTURE_2D, made[0]);
        glBindTexture(GL_TEXTURE_2D_ARRAY, made[1]);
        glBindTexture(GL_TEXTURE_2D_MULTISAMPLE, made[2]);
        glBindSampler(unit, made[4]);
    }
    glActiveTexture(GL_TEXTURE3);
    glBindBufferBase(GL_UNIFORM_BUFFER, 1, made[3]);
    glBindRenderbuffer(GL_RENDERBUFFER, made[5]);
    glViewport(3, 5, 7, 11);
    glScissor(1, 2, 3, 4);
    glDepthRange(0.25, 0.75);
    glColorMask(GL_TRUE, GL_FALSE, GL_TRUE, GL_FALSE);
    glDepthMask(GL_FALSE);
    glDepthFunc(GL_GEQUAL);
    glStencilFunc(GL_NOTEQUAL, 3, 0x55);
    glStencilMask(0x0f);
    glBlendFuncSeparate(GL_ONE, GL_SRC_ALPHA, GL_ZERO, GL_DST_COLOR);
    glBlendEquation(GL_FUNC_REVERSE_SUBTRACT);
    glBlendColor(0.1f, 0.2f, 0.3f, 0.4f);
    glCullFace(GL_FRONT);
    glFrontFace(GL_CW);
    glPolygonMode(GL_FRONT_AND_BACK, GL_LINE);
    glClearColor(0.5f, 0.25f, 0.125f, 1);
    glClearDepth(0.5);
    glClearStencil(7);
    glSampleCoverage(0.5f, GL_TRUE);
    glPixelStorei(GL_PACK_ALIGNMENT, 8);
    glPixelStorei(GL_PACK_ROW_LENGTH, 77);
    glPixelStorei(GL_UNPACK_ALIGNMENT, 2);
    glPixelStorei(GL_UNPACK_ROW_LENGTH, 55);
    glPixelStorei(GL_UNPACK_SKIP_PIXELS, 1);
    glBeginQuery(GL_SAMPLES_PASSED, made[6]);
}

static void set_usual_state(void) {
    static const GLenum OFF[] = {GL_BLEND,        GL_STENCIL_TEST,     GL_CULL_FACE,
                                 GL_SCISSOR_TEST, GL_FRAMEBUFFER_SRGB, GL_RASTERIZER_DISCARD,
                                 GL_SAMPLE_COVERAGE};
    for (size_t i = 0; i < LENGTH(OFF); i++) glDisable(OFF[i]);
    for (GLuint unit = 0; unit < N_UNITS; unit++) glBindSampler(unit, 0);
    glEnable(GL_DEPTH_TEST); /* without it no depth is written */
    glDepthFunc(GL_ALWAYS);
    glDepthMask(GL_TRUE);
    glDepthRange(0, 1);
    glColorMask(GL_TRUE, GL_TRUE, GL_TRUE, GL_TRUE);
    glPolygonMode(GL_FRONT_AND_BACK, GL_FILL);
    glBindBuffer(GL_PIXEL_UNPACK_BUFFER, 0);
    glPixelStorei(GL_UNPACK_ALIGNMENT, 4);
    glPixelStorei(GL_UNPACK_ROW_LENGTH, 0);
    glPixelStorei(GL_UNPACK_SKIP_PIXELS, 0);
    glActiveTexture(GL_TEXTURE0);
    glEndQuery(GL_SAMPLES_PASSED);
}

static double now_ms(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return 1e3 * (double)now.tv_sec + 1e-6 * (double)now.tv_nsec;
}

/* Make a call of OpenXR, note how long it takes, and see that it leaves OpenGL alone. */
#define CHECKED(result, spent_ms, call) \
    do { \
        struct snapshot before, after; \
        if (options.check_state) read_state(&before); \
        double start_ms = now_ms(); \
        result = call; \
        spent_ms += now_ms() - start_ms; \
        if (options.check_state) { \
            read_state(&after); \
            compare_states(#call, &before, &after); \
        } \
    } while (0)

#define MUST_CHECKED(spent_ms, call) \
    do { \
        XrResult result; \
        CHECKED(result, spent_ms, call); \
        must(result, #call); \
    } while (0)

/* --- pictures -------------------------------------------------------------------- */

static const char VERTEX[] =
    "#version 330 core\n"
    "void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0,"
    " 0, 1); }";
static const char FRAGMENT[] =
    "#version 330 core\n"
    "uniform ivec4 part; uniform int frame, view; uniform bool flipped, alpha, noise;\n"
    "uniform float depth; out vec4 color;\n"
    "void main() {\n"
    "  ivec2 at = ivec2(gl_FragCoord.xy) - part.xy;\n"
    "  if (flipped) at.y = part.w - 1 - at.y;\n"
    "  vec3 own = vec3(view == 0, view == 2, view == 1);\n"
    "  bool bit = ((frame >> (at.x / 4)) & 1) == 1;\n"
    "  bool is_number = at.y < 8 && at.x < 64;\n"
    "  color.rgb = is_number ? vec3(0, bit, 0)\n"
    "                        : ((at.x + frame) / 4) % 2 == 0 ? vec3(1) : own;\n"
    "  color.a = alpha ? float(at.x) / float(part.z) : 1.0;\n"
    "  float random = fract(sin(dot(vec2(at), vec2(12.9898, 78.233)) + float(frame))"
    " * 43758.5453);\n"
    "  gl_FragDepth = noise ? random : depth;\n"
    "}";

static GLuint program, vertex_array, framebuffer;

static GLuint compiled(GLenum kind, const char *text) {
    GLint ok;
    GLuint shader = glCreateShader(kind);
    glShaderSource(shader, 1, &text, NULL);
    glCompileShader(shader);
    glGetShaderiv(shader, GL_COMPILE_STATUS, &ok);
    if (!ok) fail("glCompileShader", "a shader does not compile");
    return shader;
}

static void make_objects(void) {
    program = glCreateProgram();
    glAttachShader(program, compiled(GL_VERTEX_SHADER, VERTEX));
    glAttachShader(program, compiled(GL_FRAGMENT_SHADER, FRAGMENT));
    glLinkProgram(program);
    glGenVertexArrays(1, &vertex_array);
    glGenFramebuffers(1, &framebuffer);
    if (options.check_state) make_unusual_objects();
}

/* Return what a depth buffer holds at a distance: 0 at nearZ, 1 at farZ. */
static float window_depth(float z_m) {
    double near_z = (double)options.near_z, far_z = (double)options.far_z;
    double z = (double)z_m;
    if (isinf(far_z)) return (float)(1 - near_z / z);
    if (isinf(near_z)) return (float)(far_z / z);
    return (float)(far_z * (z - near_z) / (z * (far_z - near_z)));
}

/* --- swapchains ------------------------------------------------------------------ */

struct chain {
    XrSwapchain handle;
    GLuint textures[8];
    uint32_t width, height, layers, samples, index;
    bool is_acquired;
};

/* The images of one layer: a swapchain for each view, or one for all. */
struct images {
    struct chain color[2], depth[2];
    uint32_t chain_count, view_count;
    bool has_depth, has_alpha;
    int first_view; /* 2 for a quad */
};

struct session {
    XrSession handle;
    XrSpace space, view_space, action_space;
    XrSessionState state;
    bool is_running, is_leaving, is_over;
    struct images images[2], quad;
    uint32_t view_count;
    XrView views[2]; /* of the pictures in the swapchains */
    int frame; /* shown so far */
    XrTime time;
    XrSpace layer_space;
    double acquire_ms, wait_ms, release_ms, end_ms;
    pthread_t waiter;
    pthread_mutex_t lock;
    pthread_cond_t changed;
    bool has_waiter, has_state, is_waiter_done;
    XrFrameState waited;
};

static XrInstance instance;
static XrSystemId the_system;
static XrViewConfigurationType view_type;
static bool has_depth_extension, has_gaze;
static XrActionSet action_set;
static XrAction pose_action;
static pthread_mutex_t tell_lock = PTHREAD_MUTEX_INITIALIZER;

static void make_chain(const struct session *session, struct chain *chain, GLenum format,
                       uint32_t width, uint32_t height, uint32_t layers,
                       uint32_t samples) {
    bool is_color = format == options.color_format;
    XrSwapchainCreateInfo info = {
        .type = XR_TYPE_SWAPCHAIN_CREATE_INFO,
        .usageFlags = XR_SWAPCHAIN_USAGE_SAMPLED_BIT |
                      (is_color ? XR_SWAPCHAIN_USAGE_COLOR_ATTACHMENT_BIT
                                : XR_SWAPCHAIN_USAGE_DEPTH_STENCIL_ATTACHMENT_BIT),
        .format = format,
        .sampleCount = samples,
        .width = width,
        .height = height,
        .faceCount = 1,
        .arraySize = layers,
        .mipCount = 1,
    };
    *chain = (struct chain){
        .width = width, .height = height, .layers = layers, .samples = samples};
    MUST(xrCreateSwapchain(session->handle, &info, &chain->handle));
    XrSwapchainImageOpenGLKHR images[8];
    for (int i = 0; i < 8; i++)
        images[i] =
            (XrSwapchainImageOpenGLKHR){.type = XR_TYPE_SWAPCHAIN_IMAGE_OPENGL_KHR};
    uint32_t count;
    MUST(xrEnumerateSwapchainImages(chain->handle, 8, &count,
                                    (XrSwapchainImageBaseHeader *)images));
    for (uint32_t i = 0; i < count; i++) chain->textures[i] = images[i].image;
}

static void make_images(const struct session *session, struct images *images,
                        const struct plan *plan) {
    uint32_t width = options.width, height = options.height, divisor = 1;
    if (plan->is_wide) width *= session->view_count;
    if (plan->has_offset) width += 2 * OFFSET_X_PX, height += 2 * OFFSET_Y_PX;
    if (plan->depth == SIZE) divisor = 2;
    images->view_count = session->view_count;
    images->chain_count = plan->is_array || plan->is_wide ? 1 : session->view_count;
    images->has_depth = options.depth_format != GL_NONE;
    images->has_alpha = plan->has_alpha;
    uint32_t layers = plan->is_array ? session->view_count : 1;
    uint32_t samples = plan->samples ? plan->samples : 1;
    for (uint32_t i = 0; i < images->chain_count; i++) {
        make_chain(session, &images->color[i], options.color_format, width, height, layers,
                   samples);
        if (images->has_depth)
            make_chain(session, &images->depth[i], options.depth_format, width / divisor,
                       height / divisor, layers, samples);
    }
}

static void acquire(struct session *session, struct chain *chain) {
    XrSwapchainImageWaitInfo info = {.type = XR_TYPE_SWAPCHAIN_IMAGE_WAIT_INFO,
                                     .timeout = XR_INFINITE_DURATION};
    MUST_CHECKED(session->acquire_ms,
                 xrAcquireSwapchainImage(chain->handle, NULL, &chain->index));
    MUST_CHECKED(session->acquire_ms, xrWaitSwapchainImage(chain->handle, &info));
    chain->is_acquired = true;
}

static void release(struct session *session, struct chain *chain) {
    if (!chain->is_acquired) return;
    MUST_CHECKED(session->release_ms, xrReleaseSwapchainImage(chain->handle, NULL));
    chain->is_acquired = false;
}

static XrSwapchainSubImage part_of(const struct plan *plan, const struct chain *chain,
                                   uint32_t view, int frame) {
    int width = (int)options.width, height = (int)options.height;
    XrSwapchainSubImage part = {.swapchain = chain->handle};
    if (chain->width == QUAD_PX) width = height = QUAD_PX;
    if (plan->is_wide) part.imageRect.offset.x = (int)view * width;
    if (plan->has_offset)
        part.imageRect.offset = (XrOffset2Di){OFFSET_X_PX, OFFSET_Y_PX};
    if (plan->is_dynamic) width -= 16 * (frame / 5 % 4), height -= 8 * (frame / 5 % 4);
    if (chain->width < (uint32_t)width) width = (int)chain->width;
    if (chain->height < (uint32_t)height) height = (int)chain->height;
    part.imageRect.extent = (XrExtent2Di){width, height};
    part.imageArrayIndex = plan->is_array ? view : 0;
    return part;
}

static void attach(GLenum point, const struct chain *chain, uint32_t layer) {
    GLuint texture = chain ? chain->textures[chain->index] : 0;
    if (chain && chain->layers > 1)
        glFramebufferTextureLayer(GL_FRAMEBUFFER, point, texture, 0, (GLint)layer);
    else
        glFramebufferTexture(GL_FRAMEBUFFER, point, texture, 0);
}

static void set_uniform(const char *name, int value) {
    glUniform1i(glGetUniformLocation(program, name), value);
}

/* A shader cannot write what is no number: it is clamped after it.  Mesa also clamps what
 * is uploaded, and stores 0; other drivers store it. */
static void spoil_depth(const struct chain *chain) {
    size_t count = (size_t)chain->width * chain->height;
    float *values = malloc(count * sizeof *values);
    for (size_t i = 0; i < count; i++)
        values[i] = i % 2 ? NAN : window_depth(options.distance_m);
    glBindTexture(GL_TEXTURE_2D, chain->textures[chain->index]);
    glTexSubImage2D(GL_TEXTURE_2D, 0, 0, 0, (GLsizei)chain->width, (GLsizei)chain->height,
                    GL_DEPTH_COMPONENT, GL_FLOAT, values);
    free(values);
}

static void draw_view(const struct plan *plan, const struct images *images, uint32_t view,
                      int frame) {
    const struct chain *color = &images->color[view % images->chain_count];
    const struct chain *depth = &images->depth[view % images->chain_count];
    XrSwapchainSubImage part = part_of(plan, color, view, frame);
    int x = part.imageRect.offset.x, y = part.imageRect.offset.y;
    int width = part.imageRect.extent.width, height = part.imageRect.extent.height;
    float distance_m = options.distance_m * (plan->depth == OTHER_ARRAY && view ? 2 : 1);
    bool has_own_size = images->has_depth && depth->width != color->width;
    bool has_depth = images->has_depth && depth->is_acquired;
    glBindFramebuffer(GL_FRAMEBUFFER, framebuffer);
    glUseProgram(program);
    glBindVertexArray(vertex_array);
    glUniform4i(glGetUniformLocation(program, "part"), x, y, width, height);
    set_uniform("frame", frame);
    set_uniform("view", images->first_view + (int)view);
    set_uniform("flipped", plan->is_flipped);
    set_uniform("alpha", images->has_alpha);
    set_uniform("noise", plan->depth == GARBAGE);
    glUniform1f(glGetUniformLocation(program, "depth"),
                plan->depth == CONSTANT ? 1 : window_depth(distance_m));
    for (int pass = 0; pass < (has_own_size ? 2 : 1); pass++) {
        attach(GL_COLOR_ATTACHMENT0, pass ? NULL : color, view);
        attach(GL_DEPTH_ATTACHMENT, has_depth && pass == has_own_size ? depth : NULL, view);
        glViewport(x, y, width, height);
        glDrawArrays(GL_TRIANGLES, 0, 3);
    }
    if (plan->depth == NOT_A_NUMBER && has_depth) spoil_depth(depth);
}

static void draw(struct session *session, const struct plan *plan, struct images *images) {
    for (uint32_t i = 0; i < images->chain_count; i++) {
        acquire(session, &images->color[i]);
        if (images->has_depth && !(plan->depth == STALE && session->frame))
            acquire(session, &images->depth[i]);
    }
    if (options.check_state) set_usual_state();
    glEnable(GL_DEPTH_TEST);
    glDepthFunc(GL_ALWAYS);
    for (uint32_t i = 0; i < images->view_count; i++)
        draw_view(plan, images, i, session->frame);
    if (options.check_state) set_unusual_state();
}

static void release_images(struct session *session, struct images *images) {
    for (uint32_t i = 0; i < images->chain_count; i++) {
        release(session, &images->color[i]);
        release(session, &images->depth[i]);
    }
}

static void destroy_images(const struct images *images) {
    for (uint32_t i = 0; i < images->chain_count; i++) {
        MUST(xrDestroySwapchain(images->color[i].handle));
        if (images->has_depth) MUST(xrDestroySwapchain(images->depth[i].handle));
    }
}

/* --- layers ---------------------------------------------------------------------- */

struct layers {
    XrCompositionLayerProjection projections[2];
    XrCompositionLayerProjectionView views[2][2];
    XrCompositionLayerDepthInfoKHR depths[2][2];
    XrCompositionLayerQuad quad;
    const XrCompositionLayerBaseHeader *list[3];
    uint32_t count;
};

static void describe_depth(XrCompositionLayerDepthInfoKHR *depth, const struct plan *plan,
                           const struct images *images, uint32_t view, int frame) {
    const struct chain *chain = &images->depth[view % images->chain_count];
    *depth = (XrCompositionLayerDepthInfoKHR){
        .type = XR_TYPE_COMPOSITION_LAYER_DEPTH_INFO_KHR,
        .subImage = part_of(plan, chain, view, frame),
        .maxDepth = 1,
        .nearZ = options.near_z,
        .farZ = options.far_z,
    };
    switch (plan->depth) {
    case SWAPPED: depth->nearZ = options.far_z, depth->farZ = options.near_z; break;
    case ZERO_NEAR: depth->nearZ = 0; break;
    case EQUAL: depth->nearZ = depth->farZ = 1; break;
    case RANGE:
        depth->minDepth = frame % 2 ? 0 : 0.8f;
        depth->maxDepth = frame % 2 ? 1.5f : 0.2f;
        break;
    case RECT: depth->subImage.imageRect.offset.x = (int)chain->width / 2; break;
    case OTHER_ARRAY: depth->subImage.imageArrayIndex = 1 - view; break;
    default: break;
    }
}

static void describe_layers(struct session *session, struct layers *layers) {
    const struct plan *plan = &options.plan;
    const struct plan plain = {.has_alpha = true};
    memset(layers, 0, sizeof *layers);
    layers->quad = (XrCompositionLayerQuad){
        .type = XR_TYPE_COMPOSITION_LAYER_QUAD,
        .space = session->layer_space,
        .pose = {{0, 0, 0, 1}, {0, 0, -1}},
        .size = {0.3f, 0.3f},
    };
    if (plan->quad)
        layers->quad.subImage = part_of(&plain, &session->quad.color[0], 0, 0);
    const void *quad = &layers->quad;
    if (plan->quad < 0) layers->list[layers->count++] = quad;
    int projections = plan->projections ? plan->projections : 1;
    for (int k = 0; k < projections; k++) {
        const struct plan *own = k ? &plain : plan;
        const struct images *images = &session->images[k];
        for (uint32_t i = 0; i < session->view_count; i++) {
            XrCompositionLayerProjectionView *view = &layers->views[k][i];
            view->type = XR_TYPE_COMPOSITION_LAYER_PROJECTION_VIEW;
            view->pose = session->views[i].pose;
            view->fov = session->views[i].fov;
            if (plan->is_flipped) {
                view->fov.angleUp = session->views[i].fov.angleDown;
                view->fov.angleDown = session->views[i].fov.angleUp;
            }
            const struct chain *color = &images->color[i % images->chain_count];
            view->subImage = part_of(own, color, i, session->frame);
            describe_depth(&layers->depths[k][i], own, images, i, session->frame);
            if (has_depth_extension && images->has_depth)
                view->next = &layers->depths[k][i];
        }
        layers->projections[k] = (XrCompositionLayerProjection){
            .type = XR_TYPE_COMPOSITION_LAYER_PROJECTION,
            .space = session->layer_space,
            .viewCount = session->view_count,
            .views = layers->views[k],
        };
        if (images->has_alpha)
            layers->projections[k].layerFlags =
                XR_COMPOSITION_LAYER_BLEND_TEXTURE_SOURCE_ALPHA_BIT |
                XR_COMPOSITION_LAYER_UNPREMULTIPLIED_ALPHA_BIT;
        layers->list[layers->count++] = (const void *)&layers->projections[k];
    }
    if (plan->quad > 0) layers->list[layers->count++] = quad;
}

/* --- frames ---------------------------------------------------------------------- */

static void tell_frame(const struct session *session, XrResult result) {
    pthread_mutex_lock(&tell_lock);
    printf("{\"frame\": %d, \"session\": %llu, \"display_time\": %lld, \"views\": [",
           session->frame, (unsigned long long)(uintptr_t)session->handle,
           (long long)session->time);
    for (uint32_t i = 0; i < session->view_count; i++) {
        const XrPosef *p = &session->views[i].pose;
        const XrFovf *f = &session->views[i].fov;
        const float numbers[] = {p->position.x,    p->position.y,    p->position.z,
                                 p->orientation.x, p->orientation.y, p->orientation.z,
                                 p->orientation.w, f->angleLeft,     f->angleRight,
                                 f->angleUp,       f->angleDown};
        printf("%s[", i ? ", " : "");
        for (int k = 0; k < 11; k++) printf("%s\"%a\"", k ? ", " : "", (double)numbers[k]);
        printf("]");
    }
    printf("], \"acquire_ms\": %.3f, \"release_ms\": %.3f, \"end_frame_ms\": %.3f, "
           "\"end_frame\": \"%s\"}\n",
           session->acquire_ms, session->release_ms, session->end_ms, code_name(result));
    fflush(stdout);
    pthread_mutex_unlock(&tell_lock);
}

static XrResult end_frame(struct session *session, const struct layers *layers) {
    XrFrameEndInfo info = {
        .type = XR_TYPE_FRAME_END_INFO,
        .displayTime = session->time,
        .environmentBlendMode = XR_ENVIRONMENT_BLEND_MODE_OPAQUE,
        .layerCount = layers ? layers->count : 0,
        .layers = layers ? layers->list : NULL,
    };
    XrResult result;
    CHECKED(result, session->end_ms, xrEndFrame(session->handle, &info));
    /* A runtime may refuse depth that is not valid. */
    if (!options.plan.depth) must(result, "xrEndFrame");
    return result;
}

/* Release what was drawn, and submit it. */
static void finish_frame(struct session *session) {
    struct layers layers;
    for (int i = 0; i < 2; i++) release_images(session, &session->images[i]);
    release_images(session, &session->quad);
    describe_layers(session, &layers);
    tell_frame(session, end_frame(session, &layers));
}

static void *finish_in_thread(void *session) {
    make_current(true);
    finish_frame(session);
    make_current(false);
    return NULL;
}

static void *wait_in_thread(void *given) {
    struct session *session = given;
    pthread_mutex_lock(&session->lock);
    while (!session->is_waiter_done) {
        if (session->has_state) {
            pthread_cond_wait(&session->changed, &session->lock);
            continue;
        }
        pthread_mutex_unlock(&session->lock);
        XrFrameState state = {.type = XR_TYPE_FRAME_STATE};
        MUST(xrWaitFrame(session->handle, NULL, &state));
        pthread_mutex_lock(&session->lock);
        session->waited = state;
        session->has_state = true;
        pthread_cond_broadcast(&session->changed);
    }
    pthread_mutex_unlock(&session->lock);
    return NULL;
}

static XrFrameState wait_frame(struct session *session) {
    XrFrameState state = {.type = XR_TYPE_FRAME_STATE};
    if (!options.threads) {
        MUST_CHECKED(session->wait_ms, xrWaitFrame(session->handle, NULL, &state));
        return state;
    }
    if (!session->has_waiter) {
        session->has_waiter = true;
        session->is_waiter_done = session->has_state = false;
        pthread_create(&session->waiter, NULL, wait_in_thread, session);
    }
    pthread_mutex_lock(&session->lock);
    while (!session->has_state) pthread_cond_wait(&session->changed, &session->lock);
    state = session->waited;
    session->has_state = false;
    pthread_cond_broadcast(&session->changed);
    pthread_mutex_unlock(&session->lock);
    return state;
}

/* End the thread that waits for frames; a frame that it waited for takes its course. */
static void end_waiter(struct session *session) {
    if (!session->has_waiter) return;
    pthread_mutex_lock(&session->lock);
    session->is_waiter_done = true;
    pthread_cond_broadcast(&session->changed);
    pthread_mutex_unlock(&session->lock);
    pthread_join(session->waiter, NULL);
    session->has_waiter = false;
    if (!session->has_state) return;
    MUST(xrBeginFrame(session->handle, NULL));
    session->time = session->waited.predictedDisplayTime;
    end_frame(session, NULL);
}

static XrSpace reference_space(const struct session *session, XrReferenceSpaceType type) {
    XrReferenceSpaceCreateInfo info = {.type = XR_TYPE_REFERENCE_SPACE_CREATE_INFO,
                                       .referenceSpaceType = type,
                                       .poseInReferenceSpace = {{0, 0, 0, 1}, {0, 0, 0}}};
    XrSpace space;
    MUST(xrCreateReferenceSpace(session->handle, &info, &space));
    return space;
}

static void locate_views(struct session *session) {
    const struct plan *plan = &options.plan;
    session->layer_space = plan->is_view_locked    ? session->view_space
                           : plan->in_action_space ? session->action_space
                                                   : session->space;
    XrViewLocateInfo info = {.type = XR_TYPE_VIEW_LOCATE_INFO,
                             .viewConfigurationType = view_type,
                             .displayTime = session->time,
                             .space = session->layer_space};
    XrViewState state = {.type = XR_TYPE_VIEW_STATE};
    uint32_t count;
    for (int i = 0; i < 2; i++) session->views[i] = (XrView){.type = XR_TYPE_VIEW};
    MUST_CHECKED(session->wait_ms, xrLocateViews(session->handle, &info, &state, 2, &count,
                                                 session->views));
    for (int i = 0; i < 2; i++) /* without a location: at the origin */
        if (!(state.viewStateFlags & XR_VIEW_STATE_ORIENTATION_VALID_BIT))
            session->views[i].pose = (XrPosef){{0, 0, 0, 1}, {0, 0, 0}};
}

static void violate(struct session *session);

static void show_frame(struct session *session) {
    const struct plan *plan = &options.plan;
    session->acquire_ms = session->release_ms = session->end_ms = 0;
    XrFrameState state = wait_frame(session);
    session->time = state.predictedDisplayTime;
    MUST_CHECKED(session->wait_ms, xrBeginFrame(session->handle, NULL));
    if (action_set) {
        XrActiveActionSet active = {.actionSet = action_set};
        XrActionsSyncInfo info = {.type = XR_TYPE_ACTIONS_SYNC_INFO,
                                  .countActiveActionSets = 1,
                                  .activeActionSets = &active};
        MUST(xrSyncActions(session->handle, &info));
    }
    if (!state.shouldRender || session->frame == options.frames) {
        end_frame(session, NULL);
        return;
    }
    if (plan->violates && session->frame == options.frames / 2) violate(session);
    int every = plan->release_every ? plan->release_every : 1;
    if (every < 0 ? !session->frame : session->frame % every == 0) {
        const struct plan plain = {.has_alpha = true};
        locate_views(session);
        draw(session, plan, &session->images[0]);
        if (plan->projections > 1) draw(session, &plain, &session->images[1]);
        if (plan->quad) draw(session, &plain, &session->quad);
    }
    if (plan->other_thread) {
        pthread_t other;
        make_current(false);
        pthread_create(&other, NULL, finish_in_thread, session);
        pthread_join(other, NULL);
        make_current(true);
    } else if (plan->no_context) {
        glFlush();
        make_current(false);
        finish_frame(session);
        make_current(true);
    } else {
        finish_frame(session);
    }
    session->frame++;
    if (plan->renews_space && session->frame % 10 == 0) {
        MUST(xrDestroySpace(session->space));
        session->space = reference_space(session, XR_REFERENCE_SPACE_TYPE_LOCAL);
    }
}

/* --- what no application may do -------------------------------------------------- */

static void tell_violation(const char *what, XrResult result) {
    printf("{\"violation\": \"%s\", \"code\": \"%s\"}\n", what, code_name(result));
}

/* Within a frame, do what is wrong, and go on as if it had not been tried. */
static void violate(struct session *session) {
    struct images *images = &session->images[0];
    struct chain never;
    struct layers right, wrong;
    XrFrameEndInfo info = {.type = XR_TYPE_FRAME_END_INFO,
                           .displayTime = session->time,
                           .environmentBlendMode = XR_ENVIRONMENT_BLEND_MODE_OPAQUE,
                           .layerCount = 1,
                           .layers = wrong.list};
    XrSpace gone = reference_space(session, XR_REFERENCE_SPACE_TYPE_LOCAL);
    MUST(xrDestroySpace(gone));
    make_chain(session, &never, options.color_format, options.width, options.height, 1, 1);
    describe_layers(session, &right);
    right.list[0] = (const void *)&wrong.projections[0];
    right.projections[0].views = wrong.views[0];
    XrBaseInStructure unknown = {.type = (XrStructureType)1234567};
#define TRY(what, change) \
    wrong = right; \
    change; \
    tell_violation(what, xrEndFrame(session->handle, &info))
    TRY("rect", wrong.views[0][0].subImage.imageRect.offset.x = 1);
    TRY("array index", wrong.views[0][1].subImage.imageArrayIndex = 7);
    TRY("never released", wrong.views[0][0].subImage.swapchain = never.handle);
    TRY("space", wrong.projections[0].space = gone);
    TRY("pose", wrong.views[0][0].pose.orientation.w = 3);
    TRY("fov", wrong.views[0][0].fov.angleUp = NAN);
    TRY("view count", wrong.projections[0].viewCount = 1);
    TRY("chain", wrong.views[0][0].next = &unknown);
    TRY("flags", wrong.projections[0].layerFlags = 1 << 30);
    TRY("time", info.displayTime = 0);
    MUST(xrDestroySwapchain(never.handle));
    tell_violation("swapchain", xrDestroySwapchain(never.handle));
    tell_violation("release", xrReleaseSwapchainImage(images->color[0].handle, NULL));
    if (!options.threads) /* where the next frame has been waited for, it may begin */
        tell_violation("begin", xrBeginFrame(session->handle, NULL));
    tell_violation("end session", xrEndSession(session->handle));
    XrInstanceProperties properties = {.type = XR_TYPE_INSTANCE_PROPERTIES};
    struct context_handles ours = graphics.context;
    graphics.context = new_context();
    make_current(true); /* as a layer would that forgets to restore the context */
    tell_violation("context", xrGetInstanceProperties(instance, &properties));
    graphics.context = ours;
    make_current(true);
}

/* --- sessions -------------------------------------------------------------------- */

static void make_actions(void) {
    XrActionSetCreateInfo set = {.type = XR_TYPE_ACTION_SET_CREATE_INFO,
                                 .actionSetName = "driver",
                                 .localizedActionSetName = "Driver"};
    MUST(xrCreateActionSet(instance, &set, &action_set));
    XrActionCreateInfo action = {.type = XR_TYPE_ACTION_CREATE_INFO,
                                 .actionName = "pose",
                                 .actionType = XR_ACTION_TYPE_POSE_INPUT,
                                 .localizedActionName = "Pose"};
    MUST(xrCreateAction(action_set, &action, &pose_action));
    XrPath profile, path;
    MUST(xrStringToPath(instance,
                        has_gaze ? "/interaction_profiles/ext/eye_gaze_interaction"
                                 : "/interaction_profiles/khr/simple_controller",
                        &profile));
    MUST(xrStringToPath(instance,
                        has_gaze ? "/user/eyes_ext/input/gaze_ext/pose"
                                 : "/user/hand/left/input/aim/pose",
                        &path));
    XrActionSuggestedBinding binding = {pose_action, path};
    XrInteractionProfileSuggestedBinding suggested = {
        .type = XR_TYPE_INTERACTION_PROFILE_SUGGESTED_BINDING,
        .interactionProfile = profile,
        .countSuggestedBindings = 1,
        .suggestedBindings = &binding};
    MUST(xrSuggestInteractionProfileBindings(instance, &suggested));
}

static XrResult create_session(struct session *session) {
    XrGraphicsBindingEGLMNDX egl = {
        .type = XR_TYPE_GRAPHICS_BINDING_EGL_MNDX,
        .getProcAddress = (PFN_xrEglGetProcAddressMNDX)eglGetProcAddress,
        .display = graphics.egl_display,
        .config = graphics.egl_config,
        .context = graphics.context.egl};
    XrGraphicsBindingOpenGLXlibKHR glx = {
        .type = XR_TYPE_GRAPHICS_BINDING_OPENGL_XLIB_KHR,
        .xDisplay = graphics.x_display,
        .visualid = (uint32_t)graphics.visual,
        .glxFBConfig = graphics.glx_config,
        .glxDrawable = graphics.window,
        .glxContext = graphics.context.glx};
    XrSessionCreateInfo info = {.type = XR_TYPE_SESSION_CREATE_INFO,
                                .next = options.glx ? (void *)&glx : (void *)&egl,
                                .systemId = the_system};
    memset(session, 0, sizeof *session);
    pthread_mutex_init(&session->lock, NULL);
    pthread_cond_init(&session->changed, NULL);
    return xrCreateSession(instance, &info, &session->handle);
}

static void furnish(struct session *session) {
    const struct plan *plan = &options.plan;
    const struct plan plain = {.has_alpha = true};
    session->view_count = plan->is_mono ? 1 : 2;
    session->space = reference_space(session, XR_REFERENCE_SPACE_TYPE_LOCAL);
    session->view_space = reference_space(session, XR_REFERENCE_SPACE_TYPE_VIEW);
    if (action_set) {
        XrSessionActionSetsAttachInfo attached = {
            .type = XR_TYPE_SESSION_ACTION_SETS_ATTACH_INFO,
            .countActionSets = 1,
            .actionSets = &action_set};
        MUST(xrAttachSessionActionSets(session->handle, &attached));
        XrActionSpaceCreateInfo info = {.type = XR_TYPE_ACTION_SPACE_CREATE_INFO,
                                        .action = pose_action,
                                        .poseInActionSpace = {{0, 0, 0, 1}, {0, 0, 0}}};
        MUST(xrCreateActionSpace(session->handle, &info, &session->action_space));
    }
    make_images(session, &session->images[0], plan);
    if (plan->projections > 1) make_images(session, &session->images[1], &plain);
    if (plan->quad) {
        session->quad.chain_count = session->quad.view_count = 1;
        session->quad.first_view = 2;
        make_chain(session, &session->quad.color[0], options.color_format, QUAD_PX,
                   QUAD_PX, 1, 1);
    }
}

static void destroy_session(struct session *session) {
    for (int i = 0; i < 2; i++) destroy_images(&session->images[i]);
    destroy_images(&session->quad);
    MUST(xrDestroySpace(session->space));
    MUST(xrDestroySpace(session->view_space));
    MUST(xrDestroySession(session->handle));
    pthread_mutex_destroy(&session->lock);
    pthread_cond_destroy(&session->changed);
}

static void enter_state(struct session *session, XrSessionState state) {
    session->state = state;
    if (state == XR_SESSION_STATE_READY) {
        XrSessionBeginInfo info = {.type = XR_TYPE_SESSION_BEGIN_INFO,
                                   .primaryViewConfigurationType = view_type};
        MUST(xrBeginSession(session->handle, &info));
        session->is_running = true;
    } else if (state == XR_SESSION_STATE_STOPPING && !options.plan.ends_from_thread) {
        end_waiter(session);
        session->is_running = false;
        MUST(xrEndSession(session->handle));
    } else if (state == XR_SESSION_STATE_EXITING) {
        session->is_over = true;
    }
}

static void take_events(struct session *sessions, int count) {
    XrEventDataBuffer event = {.type = XR_TYPE_EVENT_DATA_BUFFER};
    while (MUST(xrPollEvent(instance, &event)) == XR_SUCCESS) {
        const XrEventDataSessionStateChanged *change = (const void *)&event;
        for (int i = 0; i < count; i++)
            if (event.type == XR_TYPE_EVENT_DATA_SESSION_STATE_CHANGED &&
                change->session == sessions[i].handle)
                enter_state(&sessions[i], change->state);
        event = (XrEventDataBuffer){.type = XR_TYPE_EVENT_DATA_BUFFER};
    }
}

static void rest(void) { nanosleep(&(struct timespec){0, 1000000}, NULL); }

/* Show frames in each session in turn until all are over. */
static void run_sessions(struct session *sessions, int count) {
    int over = 0;
    while (over < count) {
        take_events(sessions, count);
        over = 0;
        for (int i = 0; i < count; i++) {
            struct session *session = &sessions[i];
            over += session->is_over;
            if (!session->is_running) {
                rest();
                continue;
            }
            show_frame(session);
            if (session->frame == options.frames && !session->is_leaving) {
                session->is_leaving = true;
                MUST(xrRequestExitSession(session->handle));
            }
        }
    }
}

static void *frames_in_thread(void *given) {
    struct session *session = given;
    make_current(true);
    pthread_mutex_lock(&session->lock);
    while (session->is_running) {
        pthread_mutex_unlock(&session->lock);
        show_frame(session);
        pthread_mutex_lock(&session->lock);
        session->is_leaving = session->frame == options.frames;
    }
    pthread_mutex_unlock(&session->lock);
    make_current(false);
    return NULL;
}

/* The frames run in a thread, and everything else here.  As the specification demands,
 * no other call is in progress when the session ends and when it is destroyed. */
static void run_frames_in_thread(struct session *session) {
    pthread_t frames;
    bool has_asked = false;
    make_current(false);
    while (!session->is_running) take_events(session, 1), rest();
    pthread_create(&frames, NULL, frames_in_thread, session);
    while (session->state != XR_SESSION_STATE_STOPPING) {
        rest();
        pthread_mutex_lock(&session->lock);
        bool is_leaving = session->is_leaving;
        pthread_mutex_unlock(&session->lock);
        if (is_leaving && !has_asked) MUST(xrRequestExitSession(session->handle));
        has_asked |= is_leaving;
        take_events(session, 1);
    }
    pthread_mutex_lock(&session->lock);
    session->is_running = false;
    pthread_mutex_unlock(&session->lock);
    pthread_join(frames, NULL);
    end_waiter(session);
    MUST(xrEndSession(session->handle));
    while (!session->is_over) take_events(session, 1), rest();
}

static int shown; /* frames, of all sessions */

static void run(struct session *sessions, int count) {
    for (int i = 0; i < count; i++) furnish(&sessions[i]);
    if (options.plan.ends_from_thread)
        run_frames_in_thread(sessions);
    else
        run_sessions(sessions, count);
    for (int i = 0; i < count; i++) {
        shown += sessions[i].frame;
        destroy_session(&sessions[i]);
    }
}

/* --- instance -------------------------------------------------------------------- */

static XrResult create_instance(XrInstance *made_instance) {
    static const char *const WANTED[] = {
        XR_KHR_OPENGL_ENABLE_EXTENSION_NAME, XR_MNDX_EGL_ENABLE_EXTENSION_NAME,
        XR_KHR_COMPOSITION_LAYER_DEPTH_EXTENSION_NAME,
        XR_EXT_EYE_GAZE_INTERACTION_EXTENSION_NAME};
    XrExtensionProperties offered[128];
    for (int i = 0; i < 128; i++)
        offered[i] = (XrExtensionProperties){.type = XR_TYPE_EXTENSION_PROPERTIES};
    uint32_t count = 0;
    MUST(xrEnumerateInstanceExtensionProperties(NULL, 128, &count, offered));
    const char *enabled[4];
    uint32_t enabled_count = 0;
    bool has[4] = {false};
    for (int k = 0; k < 4; k++) {
        for (uint32_t i = 0; i < count; i++)
            has[k] |= !strcmp(offered[i].extensionName, WANTED[k]);
        bool is_needed = k != 1 || !options.glx;
        if (has[k] && is_needed) enabled[enabled_count++] = WANTED[k];
    }
    if (!has[0] || (!has[1] && !options.glx))
        skip("the runtime does not take this kind of context");
    has_depth_extension = has[2];
    has_gaze = has[3];
    XrInstanceCreateInfo info = {.type = XR_TYPE_INSTANCE_CREATE_INFO,
                                 .applicationInfo = {.applicationName = "driver",
                                                     .apiVersion = XR_MAKE_VERSION(1, 0, 0)},
                                 .enabledExtensionCount = enabled_count,
                                 .enabledExtensionNames = enabled};
    return xrCreateInstance(&info, made_instance);
}

static void open_instance(void) {
    MUST(create_instance(&instance));
    XrSystemGetInfo info = {.type = XR_TYPE_SYSTEM_GET_INFO,
                            .formFactor = XR_FORM_FACTOR_HEAD_MOUNTED_DISPLAY};
    MUST(xrGetSystem(instance, &info, &the_system));
    PFN_xrGetOpenGLGraphicsRequirementsKHR ask;
    MUST(xrGetInstanceProcAddr(instance, "xrGetOpenGLGraphicsRequirementsKHR",
                               (PFN_xrVoidFunction *)&ask));
    XrGraphicsRequirementsOpenGLKHR needed = {
        .type = XR_TYPE_GRAPHICS_REQUIREMENTS_OPENGL_KHR};
    MUST(ask(instance, the_system, &needed));
    view_type = options.plan.is_mono ? XR_VIEW_CONFIGURATION_TYPE_PRIMARY_MONO
                                     : XR_VIEW_CONFIGURATION_TYPE_PRIMARY_STEREO;
    XrViewConfigurationView views[2] = {{.type = XR_TYPE_VIEW_CONFIGURATION_VIEW},
                                        {.type = XR_TYPE_VIEW_CONFIGURATION_VIEW}};
    uint32_t count;
    XrResult result = xrEnumerateViewConfigurationViews(instance, the_system, view_type, 2,
                                                        &count, views);
    if (result == XR_ERROR_VIEW_CONFIGURATION_TYPE_UNSUPPORTED)
        skip("the runtime has no such views");
    must(result, "xrEnumerateViewConfigurationViews");
    if (!options.width) {
        options.width = views[0].recommendedImageRectWidth;
        options.height = views[0].recommendedImageRectHeight;
    }
    if (options.plan.in_action_space) make_actions();
}

/* What the runtime permits: a session beside the first, an instance beside it. */
static void run_with_second(struct session *sessions) {
    MUST(create_session(&sessions[0]));
    XrResult beside = create_session(&sessions[1]);
    XrInstance other = XR_NULL_HANDLE;
    XrResult second = create_instance(&other);
    printf("{\"session_beside\": \"%s\", \"instance_beside\": \"%s\"}\n",
           code_name(beside), code_name(second));
    if (XR_SUCCEEDED(second)) MUST(xrDestroyInstance(other));
    run(sessions, XR_SUCCEEDED(beside) ? 2 : 1);
    MUST(xrDestroyInstance(instance));
    open_instance();
    MUST(create_session(&sessions[0]));
    run(sessions, 1);
}

/* --- arguments ------------------------------------------------------------------- */

static GLenum format_of(const char *name) {
    for (size_t i = 0; i < LENGTH(FORMATS); i++)
        if (!strcmp(FORMATS[i].name, name)) return FORMATS[i].format;
    fprintf(stderr, "driver: no format '%s'\n", name);
    exit(2);
}

static void read_arguments(int count, char **arguments) {
    bool is_case = false;
    for (size_t i = 0; i < LENGTH(CASES); i++)
        if (count > 1 && !strcmp(arguments[1], CASES[i].name))
            options.plan = CASES[i], is_case = true;
    for (size_t i = 0; !is_case && i < LENGTH(CASES); i++)
        fprintf(stderr, "%-18s %s\n", CASES[i].name, CASES[i].words);
    if (!is_case) exit(2);
    for (int i = 2; i < count; i++) {
        const char *name = arguments[i], *value = i + 1 < count ? arguments[i + 1] : "";
        if (!strcmp(name, "--glx")) options.glx = true;
        else if (!strcmp(name, "--threads")) options.threads = true;
        else if (!strcmp(name, "--check-state")) options.check_state = true;
        else {
            i++;
            if (!strcmp(name, "--frames")) options.frames = atoi(value);
            else if (!strcmp(name, "--size"))
                sscanf(value, "%ux%u", &options.width, &options.height);
            else if (!strcmp(name, "--format")) options.color_format = format_of(value);
            else if (!strcmp(name, "--depth")) options.depth_format = format_of(value);
            else if (!strcmp(name, "--distance-m")) options.distance_m = strtof(value, NULL);
            else if (!strcmp(name, "--near-z")) options.near_z = strtof(value, NULL);
            else if (!strcmp(name, "--far-z")) options.far_z = strtof(value, NULL);
            else {
                fprintf(stderr, "driver: no option '%s'\n", name);
                exit(2);
            }
        }
    }
}

int main(int count, char **arguments) {
    read_arguments(count, arguments);
    struct session sessions[2];
    if (options.glx) open_glx();
    else open_egl();
    make_current(true);
    make_objects();
    open_instance();
    if (options.check_state) set_unusual_state();
    if (options.plan.second) {
        run_with_second(sessions);
    } else {
        for (int i = 0; i < (options.plan.sessions ? options.plan.sessions : 1); i++) {
            if (!has_context()) make_current(true);
            MUST(create_session(sessions));
            run(sessions, 1);
        }
    }
    MUST(xrDestroyInstance(instance));
    close_graphics();
    printf("{\"case\": \"%s\", \"frames\": %d, \"checked_state\": %s}\n", options.plan.name,
           shown, options.check_state ? "true" : "false");
    return 0;
}

/* An OpenXR application that draws known pictures, for tests of an API layer below it.
 *
 *   driver CASE [--frames N] [--size WxH] [--format F] [--depth D] [--distance-m X]
 *          [--near-z X] [--far-z X] [--glx] [--vulkan 1|2] [--validate] [--threads]
 *          [--check-state]
 *
 * CASE is one of `CASES` in driver.c, where it says what each does.  Formats of color:
 * SRGB8_ALPHA8, RGBA8, RGB10_A2, RGBA16F, with Vulkan also BGRA8_SRGB and BGRA8; of
 * depth: D16, D24, D32F, D24S8, D32FS8, none.  --vulkan names the version of
 * XR_KHR_vulkan_enable; with --validate, Khronos' validation layer writes what it finds
 * to standard error. The depth is that of a plane across the view.  --near-z 100 --far-z 0.1 is
 * reversed, and "inf" is infinite.  With --threads a thread waits for the frames.
 *
 * Row y (from the bottom) and column x of view v of frame n are white where
 * (x + n) / 4 is even, elsewhere red (v = 0) or blue (v = 1); in the lowest 8 rows the
 * first 64 columns are 16 cells, bit by bit of n: green for 1 and black for 0.  A quad
 * is a view of its own, 2, in green.  Alpha is 1, or x / width where the case is about
 * alpha.
 *
 * On standard output: a line of JSON for each frame shown, with the time it is for, the
 * views as submitted ("%a": x, y, z, quaternion; left, right, up, down) and
 * milliseconds in calls; and a summary.  Exit status: 0; 1 if a call failed, or if one
 * left a state changed (--check-state); 77 if the runtime lacks what the case needs.
 */
#include <EGL/egl.h>
#include <EGL/eglext.h>
#define GL_GLEXT_PROTOTYPES
#include <GL/gl.h>
#include <GL/glext.h>
#include <GL/glx.h>
#include <math.h>
#include <pthread.h>
#include <stdatomic.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <vulkan/vulkan.h>
#define XR_USE_GRAPHICS_API_OPENGL
#define XR_USE_GRAPHICS_API_VULKAN
#define XR_USE_PLATFORM_XLIB
#define XR_USE_PLATFORM_EGL
#include <openxr/openxr.h>
#include <openxr/openxr_platform.h>

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
    bool never_waits;
    bool is_view_locked, in_action_space, renews_space, other_thread, no_context;
    bool ends_from_thread, second, violates;
    bool is_growing, is_hidden, other_context, acquires_ahead, forks;
    bool loses_device, breaks_layout, is_quad_locked, has_quad_alpha;
    uint32_t samples;
    int release_every;               /* frames; -1: only the first one */
    int sessions, projections, quad; /* quad: -1 below, 1 above the projection */
    enum fault depth;
};

extern struct options {
    struct plan plan;
    int frames;
    uint32_t width, height;
    int64_t color_format, depth_format; /* of the API */
    float distance_m, near_z, far_z;
    bool glx, threads, check_state, validate;
    int vulkan;
} options;

/* --- failures.c ------------------------------------------------------------------ */

const char *code_name(XrResult code);
void fail(const char *call, const char *why);
XrResult must(XrResult result, const char *call);
void skip(const char *why);

/* --- graphics.c ------------------------------------------------------------------ */

struct context_handles { /* one of them */
    EGLContext egl;
    GLXContext glx;
};

extern struct graphics {
    EGLDisplay egl_display;
    EGLConfig egl_config;
    Display *x_display;
    GLXFBConfig glx_config;
    Window window;
    VisualID visual;
    struct context_handles context;
} graphics;

struct context_handles new_context(void);
void open_egl(void);
void open_glx(void);
void make_current(bool is_current);
void close_graphics(void);

/* --- state.c --------------------------------------------------------------------- */

#define LENGTH(array) (sizeof(array) / sizeof *(array))
enum { MAX_STATES = 100, MAX_UNIT_STATES = 16, N_UNITS = 8 };

struct snapshot {
    void *current[8];
    EGLenum api;
    GLenum error;
    GLfloat values[MAX_STATES][4];
    GLint units[N_UNITS][MAX_UNIT_STATES];
    GLint uniform_buffers[4], query;
};

bool has_context(void);
void make_unusual_objects(void);
void set_unusual_state(void);
void set_usual_state(void);
void read_state(struct snapshot *to);
void compare_states(const char *call, const struct snapshot *a,
                    const struct snapshot *b);
double now_ms(void);

/* Make a call of OpenXR, note how long it takes, and see that it leaves OpenGL alone.
 */
#define TIMED(spent_ms, call) \
    ({ \
        struct snapshot before, after; \
        if (options.check_state) read_state(&before); \
        double start_ms = now_ms(); \
        XrResult answer = call; \
        spent_ms += now_ms() - start_ms; \
        if (options.check_state) { \
            read_state(&after); \
            compare_states(#call, &before, &after); \
        } \
        answer; \
    })
#define MUST_TIMED(spent_ms, call) must(TIMED(spent_ms, call), #call)
#define MUST(call) \
    ({ \
        double spent = 0; \
        MUST_TIMED(spent, call); \
    })

/* --- pictures.c ------------------------------------------------------------------ */

/* What is drawn into a part of an image. */
struct picture {
    int frame, view;
    XrRect2Di part;
    bool is_flipped, has_alpha, has_noise;
    float depth;
};

void make_drawing(void);
void draw_picture(const struct picture *picture);
void attach(GLenum point, GLuint texture, bool is_array, uint32_t layer);
float window_depth(float z_m);

/* --- vulkan.c -------------------------------------------------------------------- */

/* A layer of an image that is drawn into. */
struct vulkan_target {
    VkImage image;
    VkFormat format;
    uint32_t layer, width, height;
};

/* Whether a call is in progress in which a layer may use the queue. */
extern atomic_bool may_use_queue;

void open_vulkan(XrInstance instance, XrSystemId system);
void close_vulkan(void);
XrGraphicsBindingVulkanKHR vulkan_binding(void);
void forget_vulkan_views(void);
void draw_with_vulkan(const struct picture *picture, const struct vulkan_target *color,
                      const struct vulkan_target *depth);
void copy_depth_with_vulkan(const struct vulkan_target *target, const float *values);

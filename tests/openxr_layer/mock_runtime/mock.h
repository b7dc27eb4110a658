/* An OpenXR runtime without a headset, for tests of an API layer above it.
 *
 * It validates strictly: what an application or a layer does wrong gets the error code
 * of the specification and a line "mock: violation: FUNCTION: ..." on standard error.
 * Its swapchain images are textures of OpenGL, made in a context of its own that shares
 * with the application's; like Monado, it makes the application's context current where
 * it has to wait for its commands, and restores what was current.  For applications that
 * use Vulkan, they are images on the application's device.
 *
 * Environment (numbers of frames count xrWaitFrame in this process, from 0):
 *   MOCK_XR_EXTENSIONS     offered, separated by commas or spaces (all it knows)
 *   MOCK_XR_FORMATS        swapchain formats, best first: GL_SRGB8_ALPHA8,...
 *   MOCK_XR_SIZE           recommended size of a view (448x504)
 *   MOCK_XR_MONO           1: also offers PRIMARY_MONO
 *   MOCK_XR_RATE_HZ        rate of xrWaitFrame (90); 0: it never sleeps
 *   MOCK_XR_HEAD           file with a line "x y z qx qy qz qw" per frame, in the first
 *                          LOCAL space; the last one repeats (default: at its origin)
 *   MOCK_XR_GAZE_DEG       "h,v" to the right and up (0,0), or "none": not active
 *   MOCK_XR_MAX_SWAPCHAINS  so many swapchains are made in this process
 *   MOCK_XR_WAIT_TIMEOUTS  so many waits of no time for an image are in vain
 *   MOCK_XR_RECENTER_AT    frame at whose end LOCAL and LOCAL_FLOOR get another origin
 *   MOCK_XR_LOSE_AT        frame whose xrEndFrame loses the session; "N,instance"
 *   MOCK_XR_EXIT_AT        frame at whose end the user ends the session
 *   MOCK_XR_LENIENT_DEPTH  1: takes frames whose depth is invalid, and still reports it
 *   MOCK_XR_CAPTURE        folder for frames.jsonl and pixels of what is submitted
 *   MOCK_XR_CAPTURE_EVERY  pixels of one frame in so many (1)
 *
 * Pixels are as stored, without padding, in OpenGL's order: the lowest row comes first.
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
#define XR_EXTENSION_PROTOTYPES
#include <vulkan/vulkan.h>
#define XR_USE_GRAPHICS_API_OPENGL
#define XR_USE_GRAPHICS_API_VULKAN
#define XR_USE_PLATFORM_XLIB
#define XR_USE_PLATFORM_EGL
#include <openxr/openxr.h>
#include <openxr/openxr_platform.h>

enum { N_IMAGES = 3, MAX_LAYERS = 16, MAX_SIZE_PX = 8192, MAX_ACTION_SETS = 16 };
enum { OPENGL, EGL, VULKAN, VULKAN2, DEPTH, GAZE, DEBUG_UTILS, N_EXTENSIONS };
static const XrPosef IDENTITY = {{0, 0, 0, 1}, {0, 0, 0}};

struct format {
    const char *name;
    GLenum internal, layout, type; /* the last two: of its pixels in a file */
    unsigned pixel_bytes; /* in a file; depth: a float */
    bool is_depth;
    VkImageAspectFlags aspects;
    unsigned stored_bytes; /* of a pixel of Vulkan's */
};

/* The application's device. */
struct vulkan {
    VkPhysicalDevice physical_device;
    VkDevice device; /* NULL: it uses OpenGL */
    VkQueue queue;
    VkCommandPool pool;
};

/* What a thread has current: a context of EGL, one of GLX or none. */
struct current {
    EGLDisplay egl_display;
    EGLContext egl;
    EGLSurface egl_draw, egl_read;
    Display *glx_display;
    GLXContext glx;
    GLXDrawable glx_draw, glx_read;
};

/* What was current before another context was. */
struct borrowed {
    struct current before;
    EGLenum api;
};

enum kind { INSTANCE, SESSION, SPACE, SWAPCHAIN, ACTION_SET, ACTION, MESSENGER };
extern const char *const KINDS[];

/* What a handle names.  Handles are never used again, so that a destroyed one is found
 * out. */
struct object {
    enum kind kind;
    bool is_alive;
    uint64_t id;
    struct object *parent;
    union {
        struct {
            bool has_asked_for_requirements;
        } instance;
        struct {
            struct current application, own;
            GLXPbuffer pbuffer;
            struct vulkan vulkan;
            XrSessionState state;
            bool is_running, is_lost, in_frame, has_actions, is_synced;
            uint32_t view_count;
            uint64_t waited, begun;        /* frames */
            int64_t waited_number, number; /* of the frame that waits, that has begun */
            XrTime waited_time, time;
            struct object *attached[MAX_ACTION_SETS];
            uint32_t attached_count;
        } session;
        struct {
            XrReferenceSpaceType type; /* 0: of an action */
            XrPosef pose;
            struct object *action;
        } space;
        struct {
            XrSwapchainCreateInfo info;
            const struct format *format;
            GLuint textures[N_IMAGES];
            VkImage images[N_IMAGES];
            VkDeviceMemory memories[N_IMAGES];
            bool is_ready[N_IMAGES]; /* they have a layout */
            uint32_t image_count, acquired_count, waited_count;
            uint32_t acquired[N_IMAGES]; /* oldest first; the first may be waited for */
            uint32_t next;
            int released; /* the last one; -1: none yet */
            uint64_t release_count;
        } swapchain;
        struct {
            char name[XR_MAX_ACTION_SET_NAME_SIZE];
            char localized[XR_MAX_LOCALIZED_ACTION_SET_NAME_SIZE];
            bool is_attached;
            XrActionType type; /* of an action */
            bool is_gaze;
        } action;
    };
};

/* All that the files share; the lock is held while a call is answered. */
extern struct mock {
    pthread_mutex_t lock;
    pthread_cond_t frame_has_begun;
    const char *call; /* that is being answered */
    struct object **objects;
    uint64_t object_count;
    bool is_enabled[N_EXTENSIONS], is_instance_lost;
    XrVersion api_version;
} mock;

/* --- objects.c ------------------------------------------------------------------- */

const char *code_name(XrResult code);
__attribute__((format(printf, 2, 3))) XrResult violation(XrResult code,
                                                         const char *words, ...);
const char *setting(const char *name, const char *otherwise);
long number_setting(const char *name, long otherwise);
const char *next_word(const char **list, size_t *length);
struct object *create(enum kind kind, struct object *parent);
struct object *find(enum kind kind, uint64_t id);
struct object *session_of(struct object *object);
XrResult check_chain(const void *next, const XrStructureType *allowed);
const void *chained_structure(const void *next, XrStructureType type);

#define ID(handle) ((uint64_t)(uintptr_t)(handle))
#define HANDLE(type, object) ((type)(uintptr_t)(object)->id)

/* Find the object of a handle, or leave the function. */
#define FIND(name, kind, handle) \
    struct object *name = find(kind, ID(handle)); \
    if (mock.is_instance_lost) return XR_ERROR_INSTANCE_LOST; \
    if (!name) \
        return violation(XR_ERROR_HANDLE_INVALID, "%s %llu does not exist", \
                         KINDS[kind], (unsigned long long)ID(handle)); \
    if (session_of(name) && session_of(name)->session.is_lost) \
    return XR_ERROR_SESSION_LOST

#define REQUIRE(condition, code, ...) \
    if (!(condition)) return violation(code, __VA_ARGS__)

/* Check the type of a structure and of what hangs on it, or leave the function. */
#define STRUCTURE(pointer, wanted, ...) \
    do { \
        REQUIRE(pointer, XR_ERROR_VALIDATION_FAILURE, #pointer " is NULL"); \
        REQUIRE((pointer)->type == wanted, XR_ERROR_VALIDATION_FAILURE, \
                #pointer " has the type %d", (int)(pointer)->type); \
        XrResult chained = \
            check_chain((pointer)->next, (XrStructureType[]){0, ##__VA_ARGS__, 0}); \
        if (chained != XR_SUCCESS) return chained; \
    } while (0)

#define TWO_CALLS(capacity, count, n) \
    do { \
        REQUIRE(count, XR_ERROR_VALIDATION_FAILURE, #count " is NULL"); \
        *(count) = (n); \
        if (!(capacity)) return XR_SUCCESS; \
        REQUIRE((capacity) >= (n), XR_ERROR_SIZE_INSUFFICIENT, #capacity " is %u", \
                (unsigned)(capacity)); \
    } while (0)

#define REQUIRE_TIME(time) \
    REQUIRE((time) > 0, XR_ERROR_TIME_INVALID, "the time is %lld", (long long)(time))

#define REQUIRE_RUNNING(session_object) \
    REQUIRE((session_object)->session.is_running, XR_ERROR_SESSION_NOT_RUNNING, \
            "the session does not run")

#define REQUIRE_VIEWS(type) \
    if (!views_of(type)) return XR_ERROR_VIEW_CONFIGURATION_TYPE_UNSUPPORTED

#define REQUIRE_SYSTEM(system) \
    REQUIRE((system) == 1, XR_ERROR_SYSTEM_INVALID, "there is no such system")

/* --- contexts.c ------------------------------------------------------------------ */

bool set_current(const struct current *wanted);
struct borrowed borrow(void);
void give_back(const struct borrowed *saved);
XrResult finish_application(struct object *session);
void know_context(void *context);
int enter(const char *name);
void leave(int *unused);

/* Hold the lock until the function returns. */
#define ENTER __attribute__((cleanup(leave), unused)) int entered = enter(__func__)

/* --- vulkan.c --------------------------------------------------------------------- */

extern const struct format VULKAN_FORMATS[];
extern const size_t N_VULKAN_FORMATS;
XrResult bind_vulkan(struct object *session, const XrGraphicsBindingVulkanKHR *given);
void unbind_vulkan(struct object *session);
bool make_vulkan_images(struct object *swapchain);
void destroy_vulkan_images(struct object *swapchain);
void ready_vulkan_image(struct object *swapchain, uint32_t index);
bool can_read_vulkan(const struct object *swapchain);
void read_vulkan_pixels(const struct object *swapchain, int image, XrRect2Di part,
                        uint32_t layer, void *pixels);

/* --- the other files ------------------------------------------------------------- */

uint32_t views_of(XrViewConfigurationType type);
void *queue_event(XrStructureType type);
void drop_events(void);
XrTime now_ns(void);
void enter_state(struct object *session, XrSessionState state);
void begin_stopping(struct object *session);
void destroy_session(struct object *session);
void destroy_swapchain(struct object *swapchain);
bool is_unit(const XrPosef *pose);
void recenter(struct object *session);
int64_t remember_frame(XrTime time);
bool is_gaze_active(struct object *action);
XrResult check_sub_image(struct object *session, const XrSwapchainSubImage *part,
                         bool is_depth);
XrResult check_layer(struct object *session, const XrCompositionLayerBaseHeader *layer);
void capture_frame(struct object *session, const XrFrameEndInfo *info);

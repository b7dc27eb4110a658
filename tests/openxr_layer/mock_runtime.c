/* An OpenXR runtime without a headset, for tests of an API layer above it.
 *
 * It validates strictly: what an application or a layer does wrong gets the error code of
 * the specification and a line "mock: violation: FUNCTION: ..." on standard error.  Its
 * swapchain images are textures of OpenGL, made in a context of its own that shares with
 * the application's; like Monado, it makes the application's context current where it has
 * to wait for its commands, and restores what was current.
 *
 * Environment (numbers of frames count xrWaitFrame in this process, from 0):
 *   MOCK_XR_EXTENSIONS     offered, separated by commas or spaces (default: all it knows)
 *   MOCK_XR_FORMATS        swapchain formats, best first: GL_SRGB8_ALPHA8,...
 *   MOCK_XR_SIZE           recommended size of a view (448x504)
 *   MOCK_XR_MONO           1: also offers PRIMARY_MONO
 *   MOCK_XR_RATE_HZ        rate of xrWaitFrame (90); 0: it never sleeps
 *   MOCK_XR_HEAD           file with a line "x y z qx qy qz qw" per frame, in the first
 *                          LOCAL space; the last one repeats (default: at its origin)
 *   MOCK_XR_GAZE_DEG       "h,v" to the right and up (0,0), or "none": not active
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
#include <errno.h>
#include <math.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <time.h>
#define XR_NO_PROTOTYPES
#define XR_USE_GRAPHICS_API_OPENGL
#define XR_USE_PLATFORM_XLIB
#define XR_USE_PLATFORM_EGL
#include <openxr/openxr.h>
#include <openxr/openxr_loader_negotiation.h>
#include <openxr/openxr_platform.h>
#include <openxr/openxr_reflection.h>

enum {
    N_IMAGES = 3,
    MAX_LAYERS = 16,
    MAX_SIZE_PX = 8192,
    MAX_EVENTS = 64,
    MAX_KNOWN = 64,
    N_PAST = 256, /* frames whose display time is remembered */
    SYSTEM = 1,
    WAIT_S = 5, /* until a frame that never begins is a violation */
};
static const float EYE_X_M[] = {-0.032f, 0.032f};
static const XrFovf EYE_FOV[] = {{-0.80f, 0.75f, 0.78f, -0.82f},
                                 {-0.75f, 0.80f, 0.78f, -0.82f}};
static const float FLOOR_M = -1.6f;
static const XrPosef IDENTITY = {{0, 0, 0, 1}, {0, 0, 0}};
/* of the second LOCAL in the first: aside and turned left by 30 degrees */
static const XrPosef RECENTERED = {{0, 0.258819045f, 0, 0.965925826f}, {0.25f, 0, -0.5f}};

static const char *const EXTENSIONS[] = {
    XR_KHR_OPENGL_ENABLE_EXTENSION_NAME, XR_MNDX_EGL_ENABLE_EXTENSION_NAME,
    XR_KHR_COMPOSITION_LAYER_DEPTH_EXTENSION_NAME,
    XR_EXT_EYE_GAZE_INTERACTION_EXTENSION_NAME, XR_EXT_DEBUG_UTILS_EXTENSION_NAME};
enum { OPENGL, EGL, DEPTH, GAZE, DEBUG_UTILS, N_EXTENSIONS };

struct format {
    const char *name;
    GLenum internal, layout, type; /* the last two: of its pixels in a file */
    unsigned pixel_bytes;
    bool is_depth;
};
#define DEPTH_PIXELS GL_DEPTH_COMPONENT, GL_FLOAT, 4, true
static const struct format FORMATS[] = {
    {"GL_SRGB8_ALPHA8", GL_SRGB8_ALPHA8, GL_RGBA, GL_UNSIGNED_BYTE, 4, false},
    {"GL_RGBA8", GL_RGBA8, GL_RGBA, GL_UNSIGNED_BYTE, 4, false},
    {"GL_RGB10_A2", GL_RGB10_A2, GL_RGBA, GL_UNSIGNED_INT_2_10_10_10_REV, 4, false},
    {"GL_RGBA16F", GL_RGBA16F, GL_RGBA, GL_HALF_FLOAT, 8, false},
    {"GL_DEPTH_COMPONENT16", GL_DEPTH_COMPONENT16, DEPTH_PIXELS},
    {"GL_DEPTH_COMPONENT24", GL_DEPTH_COMPONENT24, DEPTH_PIXELS},
    {"GL_DEPTH_COMPONENT32F", GL_DEPTH_COMPONENT32F, DEPTH_PIXELS},
    {"GL_DEPTH24_STENCIL8", GL_DEPTH24_STENCIL8, DEPTH_PIXELS},
    {"GL_DEPTH32F_STENCIL8", GL_DEPTH32F_STENCIL8, DEPTH_PIXELS},
};
enum { N_FORMATS = sizeof FORMATS / sizeof *FORMATS };

/* What a thread has current: a context of EGL, one of GLX or none. */
struct current {
    EGLDisplay egl_display;
    EGLContext egl;
    EGLSurface egl_draw, egl_read;
    Display *glx_display;
    GLXContext glx;
    GLXDrawable glx_draw, glx_read;
};

enum kind { INSTANCE, SESSION, SPACE, SWAPCHAIN, ACTION_SET, ACTION, MESSENGER };
static const char *const KINDS[] = {"instance",   "session", "space",    "swapchain",
                                    "action set", "action",  "messenger"};

/* What a handle names.  Handles are never used again, so that a destroyed one is found
 * out. */
struct object {
    enum kind kind;
    bool is_alive;
    uint64_t id;
    struct object *parent;
    union {
        struct {
            struct current application, own;
            GLXPbuffer pbuffer;
            XrSessionState state;
            bool is_running, is_lost, in_frame, has_actions, is_synced;
            uint32_t view_count;
            XrViewConfigurationType views;
            uint64_t waited, begun; /* frames */
            int64_t waited_number, number; /* of the frame that waits, that has begun */
            XrTime waited_time, time;
            struct object *attached[16];
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

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t frame_has_begun = PTHREAD_COND_INITIALIZER;
static const char *call; /* that is being answered */

static struct object **objects;
static uint64_t object_count;

static bool is_enabled[N_EXTENSIONS], has_asked_for_requirements, is_instance_lost;
static XrVersion api_version;
static XrEventDataBuffer events[MAX_EVENTS];
static unsigned event_first, event_count;
static char **paths;
static XrPath path_count;

static void *known_contexts[MAX_KNOWN];
static unsigned known_count;

static int64_t frames_waited;
static struct {
    XrTime time;
    int64_t number;
} past[N_PAST];
static XrTime recentered_from = INT64_MAX;
static XrPosef *head_poses;
static size_t head_count;
static long waits_in_vain = -1;
static bool has_exited, has_recentered;

/* --- reports and look-ups -------------------------------------------------------- */

static const char *code_name(XrResult code) {
    switch (code) {
#define NAME(name, value) \
    case name: \
        return #name;
        XR_LIST_ENUM_XrResult(NAME)
        default : return "XrResult";
    }
}

__attribute__((format(printf, 2, 3))) static XrResult violation(XrResult code,
                                                                const char *words, ...) {
    char text[512];
    va_list arguments;
    va_start(arguments, words);
    vsnprintf(text, sizeof text, words, arguments);
    va_end(arguments);
    fprintf(stderr, "mock: violation: %s: %s (%s)\n", call, text, code_name(code));
    return code;
}

static const char *setting(const char *name, const char *otherwise) {
    const char *value = getenv(name);
    return value && *value ? value : otherwise;
}

static long number_setting(const char *name, long otherwise) {
    const char *value = setting(name, NULL);
    return value ? strtol(value, NULL, 10) : otherwise;
}

/* Return the next word of a list, and its length; move the list on. */
static const char *next_word(const char **list, size_t *length) {
    *list += strspn(*list, ", ");
    const char *word = *list;
    *length = strcspn(word, ", ");
    *list += *length;
    return *length ? word : NULL;
}

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

static struct object *create(enum kind kind, struct object *parent) {
    struct object *made = calloc(1, sizeof *made);
    objects = realloc(objects, (object_count + 1) * sizeof *objects);
    objects[object_count++] = made;
    made->kind = kind;
    made->is_alive = true;
    made->id = object_count;
    made->parent = parent;
    return made;
}

static struct object *find(enum kind kind, uint64_t id) {
    if (!id || id > object_count) return NULL;
    struct object *found = objects[id - 1];
    return found->is_alive && found->kind == kind ? found : NULL;
}

static struct object *session_of(struct object *object) {
    while (object && object->kind != SESSION) object = object->parent;
    return object;
}

#define ID(handle) ((uint64_t)(uintptr_t)(handle))
#define HANDLE(type, object) ((type)(uintptr_t)(object)->id)

/* Find the object of a handle, or leave the function. */
#define FIND(name, kind, handle) \
    struct object *name = find(kind, ID(handle)); \
    if (is_instance_lost) return XR_ERROR_INSTANCE_LOST; \
    if (!name) \
        return violation(XR_ERROR_HANDLE_INVALID, "%s %llu does not exist", KINDS[kind], \
                         (unsigned long long)ID(handle)); \
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

static XrResult check_chain(const void *next, const XrStructureType *allowed) {
    for (const XrBaseInStructure *at = next; at; at = at->next) {
        bool is_known = false;
        for (int i = 1; allowed[i]; i++) is_known |= at->type == allowed[i];
        REQUIRE(is_known, XR_ERROR_VALIDATION_FAILURE,
                "a structure of type %d is chained, which is unknown there or not enabled",
                (int)at->type);
    }
    return XR_SUCCESS;
}

static const void *chained_structure(const void *next, XrStructureType type) {
    const XrBaseInStructure *at = next;
    while (at && at->type != type) at = at->next;
    return at;
}

/* --- contexts -------------------------------------------------------------------- */

static struct current get_current(void) {
    return (struct current){
        eglGetCurrentDisplay(),          eglGetCurrentContext(),
        eglGetCurrentSurface(EGL_DRAW),  eglGetCurrentSurface(EGL_READ),
        glXGetCurrentDisplay(),          glXGetCurrentContext(),
        glXGetCurrentDrawable(),         glXGetCurrentReadDrawable()};
}

/* A thread cannot have a context of EGL and one of GLX: the other one goes first. */
static bool set_current(const struct current *wanted) {
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
struct borrowed {
    struct current before;
    EGLenum api;
};

static struct borrowed borrow(void) {
    struct borrowed saved = {.api = eglQueryAPI()};
    eglBindAPI(EGL_OPENGL_API);
    saved.before = get_current();
    return saved;
}

static void give_back(const struct borrowed *saved) {
    set_current(&saved->before);
    eglBindAPI(saved->api);
}

/* Wait for the application's commands, in its context. */
static XrResult finish_application(struct object *session) {
    struct borrowed saved = borrow();
    bool is_ours = set_current(&session->session.application);
    if (is_ours) glFinish();
    give_back(&saved);
    REQUIRE(is_ours, XR_ERROR_RUNTIME_FAILURE,
            "the application's context is current on another thread");
    return XR_SUCCESS;
}

/* A layer that leaves its context current is seen at the next call: the thread then has a
 * context that is no session's, and that nobody had before there was a session. */
static void check_current_context(void) {
    void *context = eglGetCurrentContext();
    if (!context) context = glXGetCurrentContext();
    if (!context || known_count == MAX_KNOWN) return;
    for (unsigned i = 0; i < known_count; i++)
        if (known_contexts[i] == context) return;
    known_contexts[known_count++] = context; /* reported once */
    for (uint64_t i = 0; i < object_count; i++)
        if (objects[i]->kind == SESSION && objects[i]->is_alive) {
            fprintf(stderr,
                    "mock: violation: %s: the current context is not the application's\n",
                    call);
            return;
        }
}

static int enter(const char *name) {
    pthread_mutex_lock(&lock);
    call = name;
    check_current_context();
    return 0;
}

static void leave(int *unused) {
    (void)unused;
    pthread_mutex_unlock(&lock);
}

/* Hold the lock until the function returns. */
#define ENTER __attribute__((cleanup(leave), unused)) int entered = enter(__func__)

/* --- poses ----------------------------------------------------------------------- */

static XrVector3f rotated(XrQuaternionf q, XrVector3f v) {
    double x = 2 * ((double)q.y * v.z - (double)q.z * v.y);
    double y = 2 * ((double)q.z * v.x - (double)q.x * v.z);
    double z = 2 * ((double)q.x * v.y - (double)q.y * v.x);
    return (XrVector3f){(float)(v.x + q.w * x + q.y * z - q.z * y),
                        (float)(v.y + q.w * y + q.z * x - q.x * z),
                        (float)(v.z + q.w * z + q.x * y - q.y * x)};
}

/* Return where something is that has a pose within another one. */
static XrPosef within(XrPosef outer, XrPosef inner) {
    XrQuaternionf a = outer.orientation, b = inner.orientation;
    XrVector3f moved = rotated(a, inner.position);
    return (XrPosef){{a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
                      a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x,
                      a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w,
                      a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z},
                     {outer.position.x + moved.x, outer.position.y + moved.y,
                      outer.position.z + moved.z}};
}

static XrPosef inverse(XrPosef pose) {
    XrQuaternionf q = pose.orientation;
    XrQuaternionf back = {-q.x, -q.y, -q.z, q.w};
    XrVector3f moved = rotated(back, pose.position);
    return (XrPosef){back, {-moved.x, -moved.y, -moved.z}};
}

static void read_head_poses(void) {
    const char *path = setting("MOCK_XR_HEAD", NULL);
    FILE *file = path && !head_poses ? fopen(path, "r") : NULL;
    if (!file) return;
    XrPosef p;
    while (fscanf(file, "%f %f %f %f %f %f %f", &p.position.x, &p.position.y,
                  &p.position.z, &p.orientation.x, &p.orientation.y, &p.orientation.z,
                  &p.orientation.w) == 7) {
        head_poses = realloc(head_poses, (head_count + 1) * sizeof p);
        head_poses[head_count++] = p;
    }
    fclose(file);
}

static XrPosef head_at(XrTime time) {
    if (!head_count) return IDENTITY;
    int64_t number = 0;
    for (int i = 0; i < N_PAST; i++)
        if (past[i].time && past[i].time <= time && past[i].number > number)
            number = past[i].number;
    return head_poses[(size_t)number < head_count ? (size_t)number : head_count - 1];
}

/* Return the direction of the gaze in the head: -z turned up, then aside. */
static XrPosef gaze_pose(void) {
    double h_deg = 0, v_deg = 0;
    sscanf(setting("MOCK_XR_GAZE_DEG", "0,0"), "%lf,%lf", &h_deg, &v_deg);
    double aside = -h_deg * acos(-1) / 360, up = v_deg * acos(-1) / 360;
    return (XrPosef){{(float)(cos(aside) * sin(up)), (float)(sin(aside) * cos(up)),
                      (float)(-sin(aside) * sin(up)), (float)(cos(aside) * cos(up))},
                     {0, 0, 0}};
}

static bool is_gaze_active(struct object *action) {
    return action->action.is_gaze && strcmp(setting("MOCK_XR_GAZE_DEG", ""), "none");
}

/* Return where a space is in the first LOCAL space; false: nobody knows. */
static bool space_at(struct object *space, XrTime time, XrPosef *pose) {
    XrPosef origin = IDENTITY;
    switch (space->space.type) {
    case XR_REFERENCE_SPACE_TYPE_VIEW: origin = head_at(time); break;
    case XR_REFERENCE_SPACE_TYPE_STAGE: origin.position.y = FLOOR_M; break;
    case XR_REFERENCE_SPACE_TYPE_LOCAL:
    case XR_REFERENCE_SPACE_TYPE_LOCAL_FLOOR:
        if (time >= recentered_from) origin = RECENTERED;
        if (space->space.type == XR_REFERENCE_SPACE_TYPE_LOCAL_FLOOR)
            origin.position.y += FLOOR_M;
        break;
    default:
        if (!space->space.action->is_alive || !is_gaze_active(space->space.action))
            return false;
        origin = within(head_at(time), gaze_pose());
    }
    *pose = within(origin, space->space.pose);
    return true;
}

static bool is_unit(const XrPosef *pose) {
    const XrQuaternionf *q = &pose->orientation;
    double length = sqrt((double)q->x * q->x + (double)q->y * q->y +
                         (double)q->z * q->z + (double)q->w * q->w);
    return isfinite(pose->position.x) && isfinite(pose->position.y) &&
           isfinite(pose->position.z) && fabs(length - 1) < 0.01;
}

/* --- events ---------------------------------------------------------------------- */

static void *queue_event(XrStructureType type) {
    XrEventDataBuffer *event = &events[(event_first + event_count) % MAX_EVENTS];
    if (event_count < MAX_EVENTS) event_count++;
    memset(event, 0, sizeof *event);
    event->type = type;
    return event;
}

static XrTime now_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * 1000000000ll + now.tv_nsec;
}

static void enter_state(struct object *session, XrSessionState state) {
    XrEventDataSessionStateChanged *event =
        queue_event(XR_TYPE_EVENT_DATA_SESSION_STATE_CHANGED);
    event->session = HANDLE(XrSession, session);
    event->state = state;
    event->time = now_ns();
    session->session.state = state;
}

static void begin_stopping(struct object *session) {
    XrSessionState state = session->session.state;
    if (state == XR_SESSION_STATE_STOPPING) return;
    if (state == XR_SESSION_STATE_FOCUSED) enter_state(session, XR_SESSION_STATE_VISIBLE);
    if (state >= XR_SESSION_STATE_VISIBLE)
        enter_state(session, XR_SESSION_STATE_SYNCHRONIZED);
    enter_state(session, XR_SESSION_STATE_STOPPING);
}

static void recenter(struct object *session) {
    has_recentered = true;
    recentered_from = session->session.time + 1;
    for (int i = 0; i < 2; i++) {
        XrEventDataReferenceSpaceChangePending *event =
            queue_event(XR_TYPE_EVENT_DATA_REFERENCE_SPACE_CHANGE_PENDING);
        event->session = HANDLE(XrSession, session);
        event->referenceSpaceType =
            i ? XR_REFERENCE_SPACE_TYPE_LOCAL_FLOOR : XR_REFERENCE_SPACE_TYPE_LOCAL;
        event->changeTime = recentered_from;
        event->poseValid = XR_TRUE;
        event->poseInPreviousSpace = RECENTERED;
    }
}

static XrResult XRAPI_CALL xrPollEvent(XrInstance instance, XrEventDataBuffer *event) {
    ENTER;
    FIND(found, INSTANCE, instance);
    STRUCTURE(event, XR_TYPE_EVENT_DATA_BUFFER);
    if (!event_count) return XR_EVENT_UNAVAILABLE;
    *event = events[event_first];
    event_first = (event_first + 1) % MAX_EVENTS;
    event_count--;
    return XR_SUCCESS;
}

/* --- instance and system --------------------------------------------------------- */

static XrResult XRAPI_CALL xrEnumerateInstanceExtensionProperties(
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

static XrResult XRAPI_CALL xrCreateInstance(const XrInstanceCreateInfo *info,
                                            XrInstance *instance) {
    ENTER;
    STRUCTURE(info, XR_TYPE_INSTANCE_CREATE_INFO,
              XR_TYPE_DEBUG_UTILS_MESSENGER_CREATE_INFO_EXT);
    XrVersion version = info->applicationInfo.apiVersion;
    REQUIRE(XR_VERSION_MAJOR(version) == 1 && XR_VERSION_MINOR(version) <= 1,
            XR_ERROR_API_VERSION_UNSUPPORTED, "version %u.%u is unknown",
            (unsigned)XR_VERSION_MAJOR(version), (unsigned)XR_VERSION_MINOR(version));
    memset(is_enabled, 0, sizeof is_enabled);
    for (uint32_t i = 0; i < info->enabledExtensionCount; i++) {
        int found = N_EXTENSIONS;
        for (int k = 0; k < N_EXTENSIONS; k++)
            if (!strcmp(info->enabledExtensionNames[i], EXTENSIONS[k])) found = k;
        if (found == N_EXTENSIONS || !is_offered(found))
            return XR_ERROR_EXTENSION_NOT_PRESENT;
        is_enabled[found] = true;
    }
    api_version = version;
    event_count = 0;
    has_asked_for_requirements = is_instance_lost = false;
    if (waits_in_vain < 0) waits_in_vain = number_setting("MOCK_XR_WAIT_TIMEOUTS", 0);
    read_head_poses();
    *instance = HANDLE(XrInstance, create(INSTANCE, NULL));
    return XR_SUCCESS;
}

static void destroy_session(struct object *session);

static XrResult XRAPI_CALL xrDestroyInstance(XrInstance instance) {
    ENTER;
    struct object *found = find(INSTANCE, ID(instance));
    REQUIRE(found, XR_ERROR_HANDLE_INVALID, "there is no such instance");
    for (uint64_t i = 0; i < object_count; i++)
        if (objects[i]->kind == SESSION && objects[i]->is_alive &&
            objects[i]->parent == found)
            destroy_session(objects[i]);
    for (uint64_t i = 0; i < object_count; i++) {
        struct object *root = objects[i];
        while (root->parent) root = root->parent;
        if (root == found) objects[i]->is_alive = false;
    }
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL xrGetInstanceProperties(XrInstance instance,
                                                   XrInstanceProperties *properties) {
    ENTER;
    FIND(found, INSTANCE, instance);
    STRUCTURE(properties, XR_TYPE_INSTANCE_PROPERTIES);
    properties->runtimeVersion = XR_MAKE_VERSION(1, 0, 0);
    strcpy(properties->runtimeName, "mock runtime");
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL xrResultToString(XrInstance instance, XrResult value,
                                            char text[XR_MAX_RESULT_STRING_SIZE]) {
    ENTER;
    FIND(found, INSTANCE, instance);
    snprintf(text, XR_MAX_RESULT_STRING_SIZE, "%s", code_name(value));
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL xrStructureTypeToString(
    XrInstance instance, XrStructureType value,
    char text[XR_MAX_STRUCTURE_NAME_SIZE]) {
    ENTER;
    FIND(found, INSTANCE, instance);
    switch (value) {
#define STRUCTURE_NAME(name, number) \
    case name: \
        strcpy(text, #name); \
        break;
        XR_LIST_ENUM_XrStructureType(STRUCTURE_NAME)
        default
            : snprintf(text, XR_MAX_STRUCTURE_NAME_SIZE, "XR_UNKNOWN_STRUCTURE_TYPE_%d",
                       (int)value);
    }
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL xrGetSystem(XrInstance instance, const XrSystemGetInfo *info,
                                       XrSystemId *system) {
    ENTER;
    FIND(found, INSTANCE, instance);
    STRUCTURE(info, XR_TYPE_SYSTEM_GET_INFO);
    if (info->formFactor != XR_FORM_FACTOR_HEAD_MOUNTED_DISPLAY)
        return XR_ERROR_FORM_FACTOR_UNSUPPORTED;
    *system = SYSTEM;
    return XR_SUCCESS;
}

#define REQUIRE_SYSTEM(system) \
    REQUIRE((system) == SYSTEM, XR_ERROR_SYSTEM_INVALID, "there is no such system")

static XrResult XRAPI_CALL xrGetSystemProperties(XrInstance instance, XrSystemId system,
                                                 XrSystemProperties *properties) {
    ENTER;
    FIND(found, INSTANCE, instance);
    REQUIRE_SYSTEM(system);
    XrStructureType gaze = XR_TYPE_SYSTEM_EYE_GAZE_INTERACTION_PROPERTIES_EXT;
    STRUCTURE(properties, XR_TYPE_SYSTEM_PROPERTIES, is_enabled[GAZE] ? gaze : 0);
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

static uint32_t views_of(XrViewConfigurationType type) {
    if (type == XR_VIEW_CONFIGURATION_TYPE_PRIMARY_STEREO) return 2;
    return type == XR_VIEW_CONFIGURATION_TYPE_PRIMARY_MONO &&
           view_configuration_count() == 2;
}

#define REQUIRE_VIEWS(type) \
    if (!views_of(type)) return XR_ERROR_VIEW_CONFIGURATION_TYPE_UNSUPPORTED

static XrResult XRAPI_CALL xrEnumerateViewConfigurations(
    XrInstance instance, XrSystemId system, uint32_t capacity, uint32_t *count,
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

static XrResult XRAPI_CALL xrGetViewConfigurationProperties(
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

static XrResult XRAPI_CALL xrEnumerateViewConfigurationViews(
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

static XrResult XRAPI_CALL xrEnumerateEnvironmentBlendModes(
    XrInstance instance, XrSystemId system, XrViewConfigurationType type,
    uint32_t capacity, uint32_t *count, XrEnvironmentBlendMode *modes) {
    ENTER;
    FIND(found, INSTANCE, instance);
    REQUIRE_SYSTEM(system);
    REQUIRE_VIEWS(type);
    TWO_CALLS(capacity, count, 1u);
    *modes = XR_ENVIRONMENT_BLEND_MODE_OPAQUE;
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL xrGetOpenGLGraphicsRequirementsKHR(
    XrInstance instance, XrSystemId system, XrGraphicsRequirementsOpenGLKHR *needed) {
    ENTER;
    FIND(found, INSTANCE, instance);
    REQUIRE_SYSTEM(system);
    STRUCTURE(needed, XR_TYPE_GRAPHICS_REQUIREMENTS_OPENGL_KHR);
    needed->minApiVersionSupported = XR_MAKE_VERSION(3, 3, 0);
    needed->maxApiVersionSupported = XR_MAKE_VERSION(4, 6, 0);
    has_asked_for_requirements = true;
    return XR_SUCCESS;
}

/* --- session --------------------------------------------------------------------- */

static XrResult bind_egl(struct object *session, const XrGraphicsBindingEGLMNDX *given) {
    static const EGLint VERSION[] = {EGL_CONTEXT_MAJOR_VERSION, 4,
                                     EGL_CONTEXT_MINOR_VERSION, 5, EGL_NONE};
    REQUIRE(is_enabled[EGL], XR_ERROR_VALIDATION_FAILURE, "EGL is not enabled");
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
    own->glx = make(given->xDisplay, given->glxFBConfig, given->glxContext, True, VERSION);
    REQUIRE(own->glx, XR_ERROR_GRAPHICS_DEVICE_INVALID,
            "no context can share with the application's");
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL xrCreateSession(XrInstance instance,
                                           const XrSessionCreateInfo *info,
                                           XrSession *session) {
    ENTER;
    FIND(parent, INSTANCE, instance);
    STRUCTURE(info, XR_TYPE_SESSION_CREATE_INFO,
              XR_TYPE_GRAPHICS_BINDING_OPENGL_XLIB_KHR, XR_TYPE_GRAPHICS_BINDING_EGL_MNDX);
    REQUIRE_SYSTEM(info->systemId);
    REQUIRE(is_enabled[OPENGL], XR_ERROR_GRAPHICS_DEVICE_INVALID, "OpenGL is not enabled");
    REQUIRE(has_asked_for_requirements, XR_ERROR_GRAPHICS_REQUIREMENTS_CALL_MISSING,
            "xrGetOpenGLGraphicsRequirementsKHR was not called");
    const void *egl = chained_structure(info->next, XR_TYPE_GRAPHICS_BINDING_EGL_MNDX);
    const void *glx =
        chained_structure(info->next, XR_TYPE_GRAPHICS_BINDING_OPENGL_XLIB_KHR);
    REQUIRE(egl || glx, XR_ERROR_GRAPHICS_DEVICE_INVALID, "there is no binding");
    struct object *made = create(SESSION, parent);
    struct borrowed saved = borrow();
    XrResult result = egl ? bind_egl(made, egl) : bind_glx(made, glx);
    give_back(&saved);
    made->is_alive = result == XR_SUCCESS;
    if (result != XR_SUCCESS) return result;
    const struct current *application = &made->session.application;
    if (known_count < MAX_KNOWN)
        known_contexts[known_count++] =
            application->egl ? application->egl : (void *)application->glx;
    enter_state(made, XR_SESSION_STATE_IDLE);
    enter_state(made, XR_SESSION_STATE_READY);
    *session = HANDLE(XrSession, made);
    return XR_SUCCESS;
}

static void destroy_swapchain(struct object *swapchain);

static void destroy_session(struct object *session) {
    for (uint64_t i = 0; i < object_count; i++) {
        if (objects[i]->parent != session || !objects[i]->is_alive) continue;
        if (objects[i]->kind == SWAPCHAIN) destroy_swapchain(objects[i]);
        objects[i]->is_alive = false;
    }
    struct current *own = &session->session.own;
    if (own->egl) eglDestroyContext(own->egl_display, own->egl);
    if (own->glx) {
        glXDestroyContext(own->glx_display, own->glx);
        glXDestroyPbuffer(own->glx_display, session->session.pbuffer);
    }
    for (uint32_t i = 0; i < session->session.attached_count; i++)
        session->session.attached[i]->action.is_attached = false;
    session->is_alive = false;
    pthread_cond_broadcast(&frame_has_begun);
}

static XrResult XRAPI_CALL xrDestroySession(XrSession session) {
    ENTER;
    struct object *found = find(SESSION, ID(session));
    REQUIRE(found, XR_ERROR_HANDLE_INVALID, "there is no such session");
    destroy_session(found);
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL xrBeginSession(XrSession session,
                                          const XrSessionBeginInfo *info) {
    ENTER;
    FIND(found, SESSION, session);
    STRUCTURE(info, XR_TYPE_SESSION_BEGIN_INFO);
    REQUIRE_VIEWS(info->primaryViewConfigurationType);
    REQUIRE(!found->session.is_running, XR_ERROR_SESSION_RUNNING, "it has begun before");
    REQUIRE(found->session.state == XR_SESSION_STATE_READY, XR_ERROR_SESSION_NOT_READY,
            "its state is %d", (int)found->session.state);
    found->session.is_running = true;
    found->session.views = info->primaryViewConfigurationType;
    found->session.view_count = views_of(info->primaryViewConfigurationType);
    return XR_SUCCESS;
}

#define REQUIRE_RUNNING(session_object) \
    REQUIRE((session_object)->session.is_running, XR_ERROR_SESSION_NOT_RUNNING, \
            "the session does not run")

static XrResult XRAPI_CALL xrEndSession(XrSession session) {
    ENTER;
    FIND(found, SESSION, session);
    REQUIRE_RUNNING(found);
    REQUIRE(found->session.state == XR_SESSION_STATE_STOPPING,
            XR_ERROR_SESSION_NOT_STOPPING, "its state is %d", (int)found->session.state);
    found->session.is_running = found->session.in_frame = false;
    found->session.begun = found->session.waited;
    pthread_cond_broadcast(&frame_has_begun);
    enter_state(found, XR_SESSION_STATE_IDLE);
    enter_state(found, XR_SESSION_STATE_EXITING);
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL xrRequestExitSession(XrSession session) {
    ENTER;
    FIND(found, SESSION, session);
    REQUIRE_RUNNING(found);
    begin_stopping(found);
    return XR_SUCCESS;
}

/* --- spaces ---------------------------------------------------------------------- */

static uint32_t reference_space_count(void) {
    return XR_VERSION_MINOR(api_version) >= 1 ? 4 : 3;
}

static const XrReferenceSpaceType REFERENCE_SPACES[] = {
    XR_REFERENCE_SPACE_TYPE_VIEW, XR_REFERENCE_SPACE_TYPE_LOCAL,
    XR_REFERENCE_SPACE_TYPE_STAGE, XR_REFERENCE_SPACE_TYPE_LOCAL_FLOOR};

static XrResult XRAPI_CALL xrEnumerateReferenceSpaces(XrSession session,
                                                      uint32_t capacity, uint32_t *count,
                                                      XrReferenceSpaceType *types) {
    ENTER;
    FIND(found, SESSION, session);
    TWO_CALLS(capacity, count, reference_space_count());
    memcpy(types, REFERENCE_SPACES, *count * sizeof *types);
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL xrCreateReferenceSpace(XrSession session,
                                                  const XrReferenceSpaceCreateInfo *info,
                                                  XrSpace *space) {
    ENTER;
    FIND(found, SESSION, session);
    STRUCTURE(info, XR_TYPE_REFERENCE_SPACE_CREATE_INFO);
    REQUIRE(is_unit(&info->poseInReferenceSpace), XR_ERROR_POSE_INVALID,
            "the pose is not one");
    bool is_known = false;
    for (uint32_t i = 0; i < reference_space_count(); i++)
        is_known |= REFERENCE_SPACES[i] == info->referenceSpaceType;
    REQUIRE(is_known, XR_ERROR_REFERENCE_SPACE_UNSUPPORTED, "type %d is not offered",
            (int)info->referenceSpaceType);
    struct object *made = create(SPACE, found);
    made->space.type = info->referenceSpaceType;
    made->space.pose = info->poseInReferenceSpace;
    *space = HANDLE(XrSpace, made);
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL xrGetReferenceSpaceBoundsRect(XrSession session,
                                                         XrReferenceSpaceType type,
                                                         XrExtent2Df *bounds) {
    ENTER;
    FIND(found, SESSION, session);
    (void)type;
    *bounds = (XrExtent2Df){0, 0};
    return XR_SPACE_BOUNDS_UNAVAILABLE;
}

static XrResult XRAPI_CALL xrCreateActionSpace(XrSession session,
                                               const XrActionSpaceCreateInfo *info,
                                               XrSpace *space) {
    ENTER;
    FIND(found, SESSION, session);
    STRUCTURE(info, XR_TYPE_ACTION_SPACE_CREATE_INFO);
    FIND(action, ACTION, info->action);
    REQUIRE(action->action.type == XR_ACTION_TYPE_POSE_INPUT,
            XR_ERROR_ACTION_TYPE_MISMATCH, "the action is no pose");
    REQUIRE(is_unit(&info->poseInActionSpace), XR_ERROR_POSE_INVALID,
            "the pose is not one");
    struct object *made = create(SPACE, found);
    made->space.pose = info->poseInActionSpace;
    made->space.action = action;
    *space = HANDLE(XrSpace, made);
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL xrDestroySpace(XrSpace space) {
    ENTER;
    struct object *found = find(SPACE, ID(space));
    REQUIRE(found, XR_ERROR_HANDLE_INVALID, "there is no such space");
    found->is_alive = false;
    return XR_SUCCESS;
}

#define REQUIRE_TIME(time) \
    REQUIRE((time) > 0, XR_ERROR_TIME_INVALID, "the time is %lld", (long long)(time))

static void locate(struct object *space, struct object *base, XrTime time,
                   XrSpaceLocationFlags *flags, XrPosef *pose) {
    XrPosef inner, outer;
    *flags = 0;
    *pose = IDENTITY;
    if (!space_at(space, time, &inner) || !space_at(base, time, &outer)) return;
    *flags = XR_SPACE_LOCATION_ORIENTATION_VALID_BIT |
             XR_SPACE_LOCATION_POSITION_VALID_BIT |
             XR_SPACE_LOCATION_ORIENTATION_TRACKED_BIT |
             XR_SPACE_LOCATION_POSITION_TRACKED_BIT;
    *pose = space == base ? IDENTITY : within(inverse(outer), inner);
}

static XrResult XRAPI_CALL xrLocateSpace(XrSpace space, XrSpace base, XrTime time,
                                         XrSpaceLocation *location) {
    ENTER;
    FIND(found, SPACE, space);
    FIND(found_base, SPACE, base);
    XrStructureType sample = XR_TYPE_EYE_GAZE_SAMPLE_TIME_EXT;
    STRUCTURE(location, XR_TYPE_SPACE_LOCATION, XR_TYPE_SPACE_VELOCITY,
              is_enabled[GAZE] ? sample : 0);
    REQUIRE(found->parent == found_base->parent, XR_ERROR_VALIDATION_FAILURE,
            "the spaces are of two sessions");
    REQUIRE_TIME(time);
    locate(found, found_base, time, &location->locationFlags, &location->pose);
    XrSpaceVelocity *velocity =
        (void *)(uintptr_t)chained_structure(location->next, XR_TYPE_SPACE_VELOCITY);
    if (velocity) velocity->velocityFlags = 0;
    XrEyeGazeSampleTimeEXT *sampled =
        (void *)(uintptr_t)chained_structure(location->next, sample);
    if (sampled) sampled->time = location->locationFlags ? time : 0;
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL xrLocateSpaces(XrSession session,
                                          const XrSpacesLocateInfo *info,
                                          XrSpaceLocations *locations) {
    ENTER;
    FIND(found, SESSION, session);
    STRUCTURE(info, XR_TYPE_SPACES_LOCATE_INFO);
    STRUCTURE(locations, XR_TYPE_SPACE_LOCATIONS);
    FIND(base, SPACE, info->baseSpace);
    REQUIRE_TIME(info->time);
    REQUIRE(info->spaceCount == locations->locationCount, XR_ERROR_VALIDATION_FAILURE,
            "%u spaces and %u locations", info->spaceCount, locations->locationCount);
    for (uint32_t i = 0; i < info->spaceCount; i++) {
        FIND(space, SPACE, info->spaces[i]);
        locate(space, base, info->time, &locations->locations[i].locationFlags,
               &locations->locations[i].pose);
    }
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL xrLocateViews(XrSession session, const XrViewLocateInfo *info,
                                         XrViewState *state, uint32_t capacity,
                                         uint32_t *count, XrView *views) {
    ENTER;
    FIND(found, SESSION, session);
    STRUCTURE(info, XR_TYPE_VIEW_LOCATE_INFO);
    STRUCTURE(state, XR_TYPE_VIEW_STATE);
    FIND(space, SPACE, info->space);
    REQUIRE(space->parent == found, XR_ERROR_VALIDATION_FAILURE,
            "the space is of another session");
    REQUIRE_VIEWS(info->viewConfigurationType);
    REQUIRE_TIME(info->displayTime);
    uint32_t n = views_of(info->viewConfigurationType);
    XrPosef base, head = head_at(info->displayTime);
    state->viewStateFlags = 0;
    if (space_at(space, info->displayTime, &base))
        state->viewStateFlags =
            XR_VIEW_STATE_ORIENTATION_VALID_BIT | XR_VIEW_STATE_POSITION_VALID_BIT |
            XR_VIEW_STATE_ORIENTATION_TRACKED_BIT | XR_VIEW_STATE_POSITION_TRACKED_BIT;
    else
        base = IDENTITY;
    TWO_CALLS(capacity, count, n);
    for (uint32_t i = 0; i < n; i++) {
        STRUCTURE(&views[i], XR_TYPE_VIEW);
        XrPosef eye = IDENTITY;
        if (n == 2) eye.position.x = EYE_X_M[i];
        views[i].pose = within(inverse(base), within(head, eye));
        views[i].fov = EYE_FOV[i];
    }
    return XR_SUCCESS;
}

/* --- swapchains ------------------------------------------------------------------ */

static XrResult XRAPI_CALL xrEnumerateSwapchainFormats(XrSession session,
                                                       uint32_t capacity, uint32_t *count,
                                                       int64_t *formats) {
    ENTER;
    FIND(found, SESSION, session);
    int64_t offered[N_FORMATS];
    uint32_t n = 0;
    const char *list = setting("MOCK_XR_FORMATS", NULL), *word;
    size_t length;
    for (int i = 0; !list && i < N_FORMATS; i++) offered[n++] = FORMATS[i].internal;
    while (list && n < N_FORMATS && (word = next_word(&list, &length)))
        for (int i = 0; i < N_FORMATS; i++)
            if (length == strlen(FORMATS[i].name) &&
                !strncmp(word, FORMATS[i].name, length))
                offered[n++] = FORMATS[i].internal;
    TWO_CALLS(capacity, count, n);
    memcpy(formats, offered, n * sizeof *formats);
    return XR_SUCCESS;
}

static bool make_textures(struct object *swapchain) {
    const XrSwapchainCreateInfo *info = &swapchain->swapchain.info;
    GLsizei width = (GLsizei)info->width, height = (GLsizei)info->height;
    GLsizei layers = (GLsizei)info->arraySize, samples = (GLsizei)info->sampleCount;
    GLenum format = (GLenum)info->format;
    bool is_array = layers > 1;
    GLenum target = samples > 1 ? is_array ? GL_TEXTURE_2D_MULTISAMPLE_ARRAY
                                           : GL_TEXTURE_2D_MULTISAMPLE
                    : is_array  ? GL_TEXTURE_2D_ARRAY
                                : GL_TEXTURE_2D;
    glGenTextures((GLsizei)swapchain->swapchain.image_count,
                  swapchain->swapchain.textures);
    for (uint32_t i = 0; i < swapchain->swapchain.image_count; i++) {
        glBindTexture(target, swapchain->swapchain.textures[i]);
        GLsizei mips = (GLsizei)info->mipCount;
        if (samples > 1 && is_array)
            glTexStorage3DMultisample(target, samples, format, width, height, layers,
                                      GL_TRUE);
        else if (samples > 1)
            glTexStorage2DMultisample(target, samples, format, width, height, GL_TRUE);
        else if (is_array)
            glTexStorage3D(target, mips, format, width, height, layers);
        else
            glTexStorage2D(target, mips, format, width, height);
    }
    glBindTexture(target, 0);
    glFinish(); /* before another context uses them */
    return glGetError() == GL_NO_ERROR;
}

static XrResult XRAPI_CALL xrCreateSwapchain(XrSession session,
                                             const XrSwapchainCreateInfo *info,
                                             XrSwapchain *swapchain) {
    ENTER;
    FIND(found, SESSION, session);
    STRUCTURE(info, XR_TYPE_SWAPCHAIN_CREATE_INFO);
    const struct format *format = NULL;
    for (int i = 0; i < N_FORMATS; i++)
        if (FORMATS[i].internal == (GLenum)info->format) format = &FORMATS[i];
    REQUIRE(format && strstr(setting("MOCK_XR_FORMATS", format->name), format->name),
            XR_ERROR_SWAPCHAIN_FORMAT_UNSUPPORTED, "format 0x%llx is not offered",
            (long long)info->format);
    REQUIRE(info->width && info->height && info->width <= MAX_SIZE_PX &&
                info->height <= MAX_SIZE_PX && info->arraySize && info->mipCount &&
                info->faceCount && info->sampleCount && info->sampleCount <= 4,
            XR_ERROR_VALIDATION_FAILURE, "%u x %u x %u, %u samples", info->width,
            info->height, info->arraySize, info->sampleCount);
    if (info->faceCount != 1 ||
        info->createFlags & XR_SWAPCHAIN_CREATE_PROTECTED_CONTENT_BIT)
        return XR_ERROR_FEATURE_UNSUPPORTED;
    XrResult result = finish_application(found);
    if (result != XR_SUCCESS) return result;
    struct object *made = create(SWAPCHAIN, found);
    made->swapchain.info = *info;
    made->swapchain.info.next = NULL;
    made->swapchain.format = format;
    made->swapchain.released = -1;
    made->swapchain.image_count =
        info->createFlags & XR_SWAPCHAIN_CREATE_STATIC_IMAGE_BIT ? 1 : N_IMAGES;
    struct borrowed saved = borrow();
    bool is_made = set_current(&found->session.own) && make_textures(made);
    give_back(&saved);
    made->is_alive = is_made;
    REQUIRE(is_made, XR_ERROR_RUNTIME_FAILURE, "OpenGL made no textures");
    *swapchain = HANDLE(XrSwapchain, made);
    return XR_SUCCESS;
}

static void destroy_swapchain(struct object *swapchain) {
    struct borrowed saved = borrow();
    if (set_current(&swapchain->parent->session.own))
        glDeleteTextures((GLsizei)swapchain->swapchain.image_count,
                         swapchain->swapchain.textures);
    give_back(&saved);
    swapchain->is_alive = false;
}

static XrResult XRAPI_CALL xrDestroySwapchain(XrSwapchain swapchain) {
    ENTER;
    struct object *found = find(SWAPCHAIN, ID(swapchain));
    REQUIRE(found, XR_ERROR_HANDLE_INVALID, "there is no such swapchain");
    destroy_swapchain(found);
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL xrEnumerateSwapchainImages(XrSwapchain swapchain,
                                                      uint32_t capacity, uint32_t *count,
                                                      XrSwapchainImageBaseHeader *images) {
    ENTER;
    FIND(found, SWAPCHAIN, swapchain);
    TWO_CALLS(capacity, count, found->swapchain.image_count);
    XrSwapchainImageOpenGLKHR *textures = (XrSwapchainImageOpenGLKHR *)images;
    for (uint32_t i = 0; i < *count; i++) {
        STRUCTURE(&textures[i], XR_TYPE_SWAPCHAIN_IMAGE_OPENGL_KHR);
        textures[i].image = found->swapchain.textures[i];
    }
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL xrAcquireSwapchainImage(XrSwapchain swapchain,
                                                   const XrSwapchainImageAcquireInfo *info,
                                                   uint32_t *index) {
    ENTER;
    FIND(found, SWAPCHAIN, swapchain);
    if (info) STRUCTURE(info, XR_TYPE_SWAPCHAIN_IMAGE_ACQUIRE_INFO);
    REQUIRE(found->swapchain.acquired_count < found->swapchain.image_count,
            XR_ERROR_CALL_ORDER_INVALID, "all images of swapchain %llu are acquired",
            (unsigned long long)found->id);
    REQUIRE(found->swapchain.image_count > 1 || !found->swapchain.release_count,
            XR_ERROR_CALL_ORDER_INVALID, "a static image is acquired again");
    *index = found->swapchain.next;
    found->swapchain.next = (*index + 1) % found->swapchain.image_count;
    found->swapchain.acquired[found->swapchain.acquired_count++] = *index;
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL xrWaitSwapchainImage(XrSwapchain swapchain,
                                                const XrSwapchainImageWaitInfo *info) {
    ENTER;
    FIND(found, SWAPCHAIN, swapchain);
    STRUCTURE(info, XR_TYPE_SWAPCHAIN_IMAGE_WAIT_INFO);
    REQUIRE(found->swapchain.acquired_count, XR_ERROR_CALL_ORDER_INVALID,
            "no image of swapchain %llu is acquired", (unsigned long long)found->id);
    REQUIRE(!found->swapchain.waited_count, XR_ERROR_CALL_ORDER_INVALID,
            "an image of swapchain %llu was waited for and not released",
            (unsigned long long)found->id);
    if (info->timeout == 0 && waits_in_vain > 0) {
        waits_in_vain--;
        return XR_TIMEOUT_EXPIRED;
    }
    found->swapchain.waited_count = 1;
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL xrReleaseSwapchainImage(
    XrSwapchain swapchain, const XrSwapchainImageReleaseInfo *info) {
    ENTER;
    FIND(found, SWAPCHAIN, swapchain);
    if (info) STRUCTURE(info, XR_TYPE_SWAPCHAIN_IMAGE_RELEASE_INFO);
    REQUIRE(found->swapchain.waited_count, XR_ERROR_CALL_ORDER_INVALID,
            "no image of swapchain %llu was waited for", (unsigned long long)found->id);
    XrResult result = finish_application(found->parent);
    if (result != XR_SUCCESS) return result;
    found->swapchain.released = (int)found->swapchain.acquired[0];
    found->swapchain.release_count++;
    found->swapchain.waited_count = 0;
    found->swapchain.acquired_count--;
    memmove(found->swapchain.acquired, found->swapchain.acquired + 1,
            found->swapchain.acquired_count * sizeof *found->swapchain.acquired);
    return XR_SUCCESS;
}

/* --- what is submitted ----------------------------------------------------------- */

/* Read a part of a texture, the same bytes as stored, from a context of our own. */
static void read_pixels(const struct object *swapchain, int image, XrRect2Di part,
                        uint32_t layer, void *pixels, GLsizei size) {
    const struct format *format = swapchain->swapchain.format;
    GLuint texture = swapchain->swapchain.textures[image], resolved = 0;
    int x = part.offset.x, y = part.offset.y;
    GLint z = (GLint)layer;
    if (swapchain->swapchain.info.sampleCount > 1) { /* no function reads samples */
        GLenum point = format->is_depth ? GL_DEPTH_ATTACHMENT : GL_COLOR_ATTACHMENT0;
        GLuint framebuffers[2];
        int width = part.extent.width, height = part.extent.height;
        glCreateTextures(GL_TEXTURE_2D, 1, &resolved);
        glTextureStorage2D(resolved, 1, format->internal, width, height);
        glCreateFramebuffers(2, framebuffers);
        if (swapchain->swapchain.info.arraySize > 1)
            glNamedFramebufferTextureLayer(framebuffers[0], point, texture, 0, z);
        else
            glNamedFramebufferTexture(framebuffers[0], point, texture, 0);
        glNamedFramebufferTexture(framebuffers[1], point, resolved, 0);
        glEnable(GL_FRAMEBUFFER_SRGB); /* samples are averaged as light */
        glBlitNamedFramebuffer(
            framebuffers[0], framebuffers[1], x, y, x + width, y + height, 0, 0, width,
            height, format->is_depth ? GL_DEPTH_BUFFER_BIT : GL_COLOR_BUFFER_BIT,
            GL_NEAREST);
        glDeleteFramebuffers(2, framebuffers);
        texture = resolved;
        x = y = z = 0;
    }
    glPixelStorei(GL_PACK_ALIGNMENT, 1);
    glGetTextureSubImage(texture, 0, x, y, z, part.extent.width, part.extent.height, 1,
                         format->layout, format->type, size, pixels);
    glDeleteTextures(1, &resolved);
    GLenum error = glGetError();
    if (error) fprintf(stderr, "mock: reading a texture failed: 0x%x\n", error);
}

/* One view of a layer, or a quad, with its depth if it has any. */
struct capture {
    FILE *file; /* NULL: nothing is captured */
    const char *folder;
    int64_t number;
    bool has_pixels;
    uint32_t layer;
};

static void write_floats(FILE *file, const char *name, const float *values, int count) {
    fprintf(file, "\"%s\": [", name);
    for (int i = 0; i < count; i++)
        fprintf(file, "%s\"%a\"", i ? ", " : "", (double)values[i]);
    fprintf(file, "]");
}

static void write_pose(FILE *file, const XrPosef *pose) {
    const XrVector3f *p = &pose->position;
    const XrQuaternionf *q = &pose->orientation;
    write_floats(file, "pose", (float[]){p->x, p->y, p->z, q->x, q->y, q->z, q->w}, 7);
}

static void write_space(FILE *file, const struct object *space) {
    static const char *const TYPES[] = {"ACTION", "VIEW", "LOCAL", "STAGE"};
    XrReferenceSpaceType type = space->space.type;
    fprintf(file, "\"space\": {\"id\": %llu, \"kind\": \"%s\", ",
            (unsigned long long)space->id,
            type == XR_REFERENCE_SPACE_TYPE_LOCAL_FLOOR ? "LOCAL_FLOOR" : TYPES[type]);
    write_pose(file, &space->space.pose);
    fprintf(file, "}, ");
}

/* Write what a part of a swapchain is, and its pixels. */
static void capture_image(const struct capture *to, const XrSwapchainSubImage *part,
                          uint32_t view, const char *what) {
    const struct object *swapchain = find(SWAPCHAIN, ID(part->swapchain));
    const struct format *format = swapchain->swapchain.format;
    XrRect2Di rect = part->imageRect;
    fprintf(to->file,
            "\"swapchain\": %llu, \"image\": %d, \"releases\": %llu, "
            "\"format\": \"%s\", \"samples\": %u, \"rect\": [%d, %d, %d, %d], "
            "\"array_index\": %u",
            (unsigned long long)swapchain->id, swapchain->swapchain.released,
            (unsigned long long)swapchain->swapchain.release_count, format->name,
            swapchain->swapchain.info.sampleCount, rect.offset.x, rect.offset.y,
            rect.extent.width, rect.extent.height, part->imageArrayIndex);
    if (!to->has_pixels) return;
    size_t size = (size_t)rect.extent.width * (size_t)rect.extent.height *
                  format->pixel_bytes;
    void *pixels = calloc(1, size);
    read_pixels(swapchain, swapchain->swapchain.released, rect, part->imageArrayIndex,
                pixels, (GLsizei)size);
    char name[64], path[4096];
    snprintf(name, sizeof name, "%06lld_%u_%u_%s.bin", (long long)to->number, to->layer,
             view, what);
    snprintf(path, sizeof path, "%s/%s", to->folder, name);
    FILE *file = fopen(path, "wb");
    if (!file || fwrite(pixels, 1, size, file) != size)
        fprintf(stderr, "mock: %s: %s\n", path, strerror(errno));
    if (file) fclose(file);
    free(pixels);
    fprintf(to->file, ", \"file\": \"%s\"", name);
}

static XrResult check_sub_image(struct object *session, const XrSwapchainSubImage *part,
                                bool is_depth) {
    const char *what = is_depth ? "depth" : "color";
    FIND(swapchain, SWAPCHAIN, part->swapchain);
    unsigned long long id = swapchain->id;
    const XrSwapchainCreateInfo *info = &swapchain->swapchain.info;
    REQUIRE(swapchain->parent == session, XR_ERROR_VALIDATION_FAILURE,
            "%s: swapchain %llu is of another session", what, id);
    REQUIRE(swapchain->swapchain.release_count, XR_ERROR_LAYER_INVALID,
            "%s: no image of swapchain %llu was ever released", what, id);
    REQUIRE(swapchain->swapchain.format->is_depth == is_depth,
            XR_ERROR_VALIDATION_FAILURE, "%s: swapchain %llu has the format %s", what, id,
            swapchain->swapchain.format->name);
    const XrRect2Di *rect = &part->imageRect;
    REQUIRE(rect->offset.x >= 0 && rect->offset.y >= 0 && rect->extent.width > 0 &&
                rect->extent.height > 0 &&
                (int64_t)rect->offset.x + rect->extent.width <= info->width &&
                (int64_t)rect->offset.y + rect->extent.height <= info->height,
            XR_ERROR_SWAPCHAIN_RECT_INVALID, "%s: %d,%d %dx%d of %ux%u", what,
            rect->offset.x, rect->offset.y, rect->extent.width, rect->extent.height,
            info->width, info->height);
    REQUIRE(part->imageArrayIndex < info->arraySize, XR_ERROR_VALIDATION_FAILURE,
            "%s: array index %u of %u", what, part->imageArrayIndex, info->arraySize);
    return XR_SUCCESS;
}

static XrResult check_depth(struct object *session,
                            const XrCompositionLayerDepthInfoKHR *depth) {
    XrResult result = check_sub_image(session, &depth->subImage, true);
    if (result != XR_SUCCESS) return result;
    REQUIRE(depth->minDepth >= 0 && depth->minDepth < depth->maxDepth &&
                depth->maxDepth <= 1,
            XR_ERROR_VALIDATION_FAILURE, "depth from %g to %g", (double)depth->minDepth,
            (double)depth->maxDepth);
    REQUIRE(depth->nearZ >= 0 && depth->farZ >= 0 && depth->nearZ != depth->farZ,
            XR_ERROR_VALIDATION_FAILURE, "near plane %g, far plane %g",
            (double)depth->nearZ, (double)depth->farZ);
    return XR_SUCCESS;
}

static XrResult check_view(struct object *session,
                           const XrCompositionLayerProjectionView *view) {
    XrStructureType depth = XR_TYPE_COMPOSITION_LAYER_DEPTH_INFO_KHR;
    STRUCTURE(view, XR_TYPE_COMPOSITION_LAYER_PROJECTION_VIEW,
              is_enabled[DEPTH] ? depth : 0);
    REQUIRE(is_unit(&view->pose), XR_ERROR_POSE_INVALID, "the pose of a view is not one");
    const float angles[] = {view->fov.angleLeft, view->fov.angleRight, view->fov.angleUp,
                            view->fov.angleDown};
    for (int i = 0; i < 4; i++)
        REQUIRE(fabs((double)angles[i]) < acos(0), XR_ERROR_VALIDATION_FAILURE,
                "an angle of the field of view is %g", (double)angles[i]);
    XrResult result = check_sub_image(session, &view->subImage, false);
    const void *chained = chained_structure(view->next, depth);
    if (result != XR_SUCCESS || !chained) return result;
    result = check_depth(session, chained);
    return number_setting("MOCK_XR_LENIENT_DEPTH", 0) ? XR_SUCCESS : result;
}

static XrResult check_layer(struct object *session,
                            const XrCompositionLayerBaseHeader *layer) {
    const XrCompositionLayerFlags KNOWN_FLAGS =
        XR_COMPOSITION_LAYER_CORRECT_CHROMATIC_ABERRATION_BIT |
        XR_COMPOSITION_LAYER_BLEND_TEXTURE_SOURCE_ALPHA_BIT |
        XR_COMPOSITION_LAYER_UNPREMULTIPLIED_ALPHA_BIT;
    REQUIRE(layer, XR_ERROR_LAYER_INVALID, "a layer is NULL");
    const XrCompositionLayerProjection *projection = (const void *)layer;
    const XrCompositionLayerQuad *quad = (const void *)layer;
    REQUIRE(layer->type == XR_TYPE_COMPOSITION_LAYER_PROJECTION ||
                layer->type == XR_TYPE_COMPOSITION_LAYER_QUAD,
            XR_ERROR_LAYER_INVALID, "a layer has the type %d", (int)layer->type);
    STRUCTURE(layer, layer->type);
    REQUIRE(!(layer->layerFlags & ~KNOWN_FLAGS), XR_ERROR_VALIDATION_FAILURE,
            "the flags are 0x%llx", (unsigned long long)layer->layerFlags);
    FIND(space, SPACE, layer->space);
    REQUIRE(space->parent == session, XR_ERROR_VALIDATION_FAILURE,
            "a layer's space is of another session");
    if (layer->type == XR_TYPE_COMPOSITION_LAYER_QUAD) {
        REQUIRE(is_unit(&quad->pose), XR_ERROR_POSE_INVALID, "a quad's pose is not one");
        REQUIRE(quad->eyeVisibility <= XR_EYE_VISIBILITY_RIGHT,
                XR_ERROR_VALIDATION_FAILURE, "a quad's visibility is %d",
                (int)quad->eyeVisibility);
        return check_sub_image(session, &quad->subImage, false);
    }
    REQUIRE(projection->viewCount == session->session.view_count,
            XR_ERROR_VALIDATION_FAILURE, "a layer has %u views", projection->viewCount);
    for (uint32_t i = 0; i < projection->viewCount; i++) {
        XrResult result = check_view(session, &projection->views[i]);
        if (result != XR_SUCCESS) return result;
    }
    return XR_SUCCESS;
}

static void capture_view(const struct capture *to, uint32_t index,
                         const XrCompositionLayerProjectionView *view) {
    FILE *file = to->file;
    fprintf(file, "%s{", index ? ", " : "");
    write_pose(file, &view->pose);
    fprintf(file, ", ");
    write_floats(file, "fov",
                 (float[]){view->fov.angleLeft, view->fov.angleRight, view->fov.angleUp,
                           view->fov.angleDown},
                 4);
    fprintf(file, ", ");
    capture_image(to, &view->subImage, index, "color");
    const XrCompositionLayerDepthInfoKHR *depth =
        chained_structure(view->next, XR_TYPE_COMPOSITION_LAYER_DEPTH_INFO_KHR);
    if (depth && check_sub_image(find(SWAPCHAIN, ID(depth->subImage.swapchain))->parent,
                                 &depth->subImage, true) == XR_SUCCESS) {
        fprintf(file, ", \"depth\": {");
        write_floats(
            file, "range_and_planes",
            (float[]){depth->minDepth, depth->maxDepth, depth->nearZ, depth->farZ}, 4);
        fprintf(file, ", ");
        capture_image(to, &depth->subImage, index, "depth");
        fprintf(file, "}");
    }
    fprintf(file, "}");
}

static void capture_layer(struct capture *to, const XrCompositionLayerBaseHeader *layer) {
    FILE *file = to->file;
    bool is_quad = layer->type == XR_TYPE_COMPOSITION_LAYER_QUAD;
    fprintf(file, "%s{\"type\": \"%s\", \"flags\": %llu, ", to->layer ? ", " : "",
            is_quad ? "quad" : "projection", (unsigned long long)layer->layerFlags);
    write_space(file, find(SPACE, ID(layer->space)));
    if (is_quad) {
        const XrCompositionLayerQuad *quad = (const void *)layer;
        fprintf(file, "\"eyes\": %d, ", (int)quad->eyeVisibility);
        write_pose(file, &quad->pose);
        fprintf(file, ", ");
        write_floats(file, "size", (float[]){quad->size.width, quad->size.height}, 2);
        fprintf(file, ", ");
        capture_image(to, &quad->subImage, 0, "color");
    } else {
        const XrCompositionLayerProjection *projection = (const void *)layer;
        fprintf(file, "\"views\": [");
        for (uint32_t i = 0; i < projection->viewCount; i++)
            capture_view(to, i, &projection->views[i]);
        fprintf(file, "]");
    }
    fprintf(file, "}");
}

static void capture_frame(struct object *session, const XrFrameEndInfo *info) {
    const char *folder = setting("MOCK_XR_CAPTURE", NULL);
    if (!folder) return;
    char path[4096];
    snprintf(path, sizeof path, "%s/frames.jsonl", folder);
    mkdir(folder, 0777);
    long every = number_setting("MOCK_XR_CAPTURE_EVERY", 1);
    int64_t number = session->session.number;
    struct capture to = {fopen(path, "a"), folder, number,
                         every > 0 && number % every == 0, 0};
    if (!to.file) {
        fprintf(stderr, "mock: %s: %s\n", path, strerror(errno));
        return;
    }
    struct borrowed saved = borrow();
    to.has_pixels = set_current(&session->session.own) && to.has_pixels;
    fprintf(to.file,
            "{\"frame\": %lld, \"session\": %llu, \"display_time\": %lld, "
            "\"predicted_display_time\": %lld, \"layers\": [",
            (long long)number, (unsigned long long)session->id,
            (long long)info->displayTime, (long long)session->session.time);
    for (; to.layer < info->layerCount; to.layer++)
        capture_layer(&to, info->layers[to.layer]);
    fprintf(to.file, "]}\n");
    fclose(to.file);
    give_back(&saved);
}

/* --- frames ---------------------------------------------------------------------- */

static bool is_due(int64_t number, const char *name) {
    long at = number_setting(name, -1);
    return at >= 0 && number >= at;
}

static void sleep_until(XrTime time_ns) {
    struct timespec until = {time_ns / 1000000000, time_ns % 1000000000};
    pthread_mutex_unlock(&lock);
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, NULL) == EINTR) {
    }
    pthread_mutex_lock(&lock);
}

static XrResult XRAPI_CALL xrWaitFrame(XrSession session, const XrFrameWaitInfo *info,
                                       XrFrameState *state) {
    ENTER;
    FIND(found, SESSION, session);
    if (info) STRUCTURE(info, XR_TYPE_FRAME_WAIT_INFO);
    STRUCTURE(state, XR_TYPE_FRAME_STATE);
    REQUIRE_RUNNING(found);
    struct timespec limit;
    clock_gettime(CLOCK_REALTIME, &limit);
    limit.tv_sec += WAIT_S;
    while (found->session.waited > found->session.begun && found->is_alive)
        if (pthread_cond_timedwait(&frame_has_begun, &lock, &limit) == ETIMEDOUT) {
            call = __func__;
            return violation(XR_ERROR_CALL_ORDER_INVALID,
                             "the frame of the last call did not begin in %d s", WAIT_S);
        }
    long rate_hz = number_setting("MOCK_XR_RATE_HZ", 90);
    XrDuration period = 1000000000 / (rate_hz ? rate_hz : 90);
    XrTime last = found->session.waited_time, now = now_ns();
    /* The frame is shown two periods after the application is woken for it. */
    XrTime time = last + period;
    if (time < now + 2 * period) time = rate_hz || last <= now ? now + 2 * period : last + 1;
    found->session.waited++;
    found->session.waited_time = time;
    found->session.waited_number = frames_waited;
    past[frames_waited % N_PAST].time = time;
    past[frames_waited % N_PAST].number = frames_waited;
    frames_waited++;
    state->predictedDisplayTime = time;
    state->predictedDisplayPeriod = period;
    state->shouldRender = found->session.state >= XR_SESSION_STATE_VISIBLE &&
                          found->session.state <= XR_SESSION_STATE_FOCUSED;
    if (rate_hz) sleep_until(time - 2 * period);
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL xrBeginFrame(XrSession session, const XrFrameBeginInfo *info) {
    ENTER;
    FIND(found, SESSION, session);
    if (info) STRUCTURE(info, XR_TYPE_FRAME_BEGIN_INFO);
    REQUIRE_RUNNING(found);
    REQUIRE(found->session.waited > found->session.begun, XR_ERROR_CALL_ORDER_INVALID,
            "no frame was waited for");
    bool is_discarded = found->session.in_frame;
    found->session.begun++;
    found->session.in_frame = true;
    found->session.number = found->session.waited_number;
    found->session.time = found->session.waited_time;
    if (found->session.state == XR_SESSION_STATE_READY)
        enter_state(found, XR_SESSION_STATE_SYNCHRONIZED);
    pthread_cond_broadcast(&frame_has_begun);
    return is_discarded ? XR_FRAME_DISCARDED : XR_SUCCESS;
}

static XrResult XRAPI_CALL xrEndFrame(XrSession session, const XrFrameEndInfo *info) {
    ENTER;
    FIND(found, SESSION, session);
    STRUCTURE(info, XR_TYPE_FRAME_END_INFO);
    REQUIRE_RUNNING(found);
    REQUIRE(found->session.in_frame, XR_ERROR_CALL_ORDER_INVALID, "no frame has begun");
    REQUIRE_TIME(info->displayTime);
    REQUIRE(info->environmentBlendMode == XR_ENVIRONMENT_BLEND_MODE_OPAQUE,
            XR_ERROR_ENVIRONMENT_BLEND_MODE_UNSUPPORTED, "blend mode %d",
            (int)info->environmentBlendMode);
    REQUIRE(info->layerCount <= MAX_LAYERS, XR_ERROR_LAYER_LIMIT_EXCEEDED, "%u layers",
            info->layerCount);
    REQUIRE(info->layers || !info->layerCount, XR_ERROR_VALIDATION_FAILURE,
            "layers is NULL");
    for (uint32_t i = 0; i < info->layerCount; i++) {
        XrResult result = check_layer(found, info->layers[i]);
        if (result != XR_SUCCESS) return result;
    }
    XrResult result = finish_application(found);
    if (result != XR_SUCCESS) return result;
    capture_frame(found, info);
    found->session.in_frame = false;
    if (found->session.state == XR_SESSION_STATE_SYNCHRONIZED) {
        enter_state(found, XR_SESSION_STATE_VISIBLE);
        enter_state(found, XR_SESSION_STATE_FOCUSED);
    }
    int64_t number = found->session.number;
    if (is_due(number, "MOCK_XR_RECENTER_AT") && !has_recentered) recenter(found);
    if (is_due(number, "MOCK_XR_EXIT_AT") && !has_exited) {
        has_exited = true;
        begin_stopping(found);
    }
    if (is_due(number, "MOCK_XR_LOSE_AT")) {
        is_instance_lost = strstr(setting("MOCK_XR_LOSE_AT", ""), "instance");
        found->session.is_lost = true;
        enter_state(found, XR_SESSION_STATE_LOSS_PENDING);
        return is_instance_lost ? XR_ERROR_INSTANCE_LOST : XR_ERROR_SESSION_LOST;
    }
    return XR_SUCCESS;
}

/* --- paths and actions ----------------------------------------------------------- */

static const char GAZE_PROFILE[] = "/interaction_profiles/ext/eye_gaze_interaction";
static const char GAZE_PATH[] = "/user/eyes_ext/input/gaze_ext/pose";
static const char GAZE_USER[] = "/user/eyes_ext";

static XrPath path_of(const char *text) {
    for (XrPath i = 0; i < path_count; i++)
        if (!strcmp(paths[i], text)) return i + 1;
    paths = realloc(paths, (path_count + 1) * sizeof *paths);
    paths[path_count++] = strdup(text);
    return path_count;
}

static XrResult XRAPI_CALL xrStringToPath(XrInstance instance, const char *text,
                                          XrPath *path) {
    ENTER;
    FIND(found, INSTANCE, instance);
    REQUIRE(*text == '/' && text[1] &&
                !text[strspn(text, "abcdefghijklmnopqrstuvwxyz0123456789-_./")],
            XR_ERROR_PATH_FORMAT_INVALID, "'%s' is no path", text);
    *path = path_of(text);
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL xrPathToString(XrInstance instance, XrPath path,
                                          uint32_t capacity, uint32_t *count,
                                          char *text) {
    ENTER;
    FIND(found, INSTANCE, instance);
    REQUIRE(path && path <= path_count, XR_ERROR_PATH_INVALID, "there is no such path");
    uint32_t size = (uint32_t)strlen(paths[path - 1]) + 1;
    TWO_CALLS(capacity, count, size);
    memcpy(text, paths[path - 1], size);
    return XR_SUCCESS;
}

/* Give a new action or set its names, which no sibling has. */
static XrResult name_action(struct object *made, const char *name,
                            const char *localized) {
    for (uint64_t i = 0; i < object_count; i++) {
        const struct object *other = objects[i];
        if (other == made || other->kind != made->kind || !other->is_alive ||
            other->parent != made->parent)
            continue;
        made->is_alive = false;
        REQUIRE(strcmp(other->action.name, name), XR_ERROR_NAME_DUPLICATED,
                "there is a '%s'", name);
        REQUIRE(strcmp(other->action.localized, localized),
                XR_ERROR_LOCALIZED_NAME_DUPLICATED, "there is a '%s'", localized);
        made->is_alive = true;
    }
    snprintf(made->action.name, sizeof made->action.name, "%s", name);
    snprintf(made->action.localized, sizeof made->action.localized, "%s", localized);
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL xrCreateActionSet(XrInstance instance,
                                             const XrActionSetCreateInfo *info,
                                             XrActionSet *set) {
    ENTER;
    FIND(found, INSTANCE, instance);
    STRUCTURE(info, XR_TYPE_ACTION_SET_CREATE_INFO);
    struct object *made = create(ACTION_SET, found);
    *set = HANDLE(XrActionSet, made);
    return name_action(made, info->actionSetName, info->localizedActionSetName);
}

static XrResult XRAPI_CALL xrCreateAction(XrActionSet set, const XrActionCreateInfo *info,
                                          XrAction *action) {
    ENTER;
    FIND(found, ACTION_SET, set);
    STRUCTURE(info, XR_TYPE_ACTION_CREATE_INFO);
    REQUIRE(!found->action.is_attached, XR_ERROR_ACTIONSETS_ALREADY_ATTACHED,
            "the set '%s' is attached", found->action.name);
    struct object *made = create(ACTION, found);
    made->action.type = info->actionType;
    *action = HANDLE(XrAction, made);
    return name_action(made, info->actionName, info->localizedActionName);
}

static XrResult XRAPI_CALL xrDestroyActionSet(XrActionSet set) {
    ENTER;
    FIND(found, ACTION_SET, set);
    for (uint64_t i = 0; i < object_count; i++)
        if (objects[i]->parent == found) objects[i]->is_alive = false;
    found->is_alive = false;
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL xrDestroyAction(XrAction action) {
    ENTER;
    FIND(found, ACTION, action);
    found->is_alive = false;
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL xrSuggestInteractionProfileBindings(
    XrInstance instance, const XrInteractionProfileSuggestedBinding *suggested) {
    ENTER;
    FIND(found, INSTANCE, instance);
    STRUCTURE(suggested, XR_TYPE_INTERACTION_PROFILE_SUGGESTED_BINDING);
    XrPath profile = suggested->interactionProfile;
    REQUIRE(profile && profile <= path_count, XR_ERROR_PATH_INVALID,
            "there is no such path");
    bool is_gaze = !strcmp(paths[profile - 1], GAZE_PROFILE);
    REQUIRE(!is_gaze || is_enabled[GAZE], XR_ERROR_PATH_UNSUPPORTED,
            "%s is not enabled", GAZE_PROFILE);
    REQUIRE(suggested->countSuggestedBindings, XR_ERROR_VALIDATION_FAILURE,
            "nothing is suggested");
    for (uint32_t i = 0; i < suggested->countSuggestedBindings; i++) {
        FIND(action, ACTION, suggested->suggestedBindings[i].action);
        REQUIRE(!action->parent->action.is_attached,
                XR_ERROR_ACTIONSETS_ALREADY_ATTACHED, "the set of '%s' is attached",
                action->action.name);
    }
    if (!is_gaze) return XR_SUCCESS; /* there are no controllers */
    for (uint64_t i = 0; i < object_count; i++) /* it replaces the last suggestion */
        if (objects[i]->kind == ACTION) objects[i]->action.is_gaze = false;
    for (uint32_t i = 0; i < suggested->countSuggestedBindings; i++) {
        const XrActionSuggestedBinding *one = &suggested->suggestedBindings[i];
        if (one->binding == path_of(GAZE_PATH))
            find(ACTION, ID(one->action))->action.is_gaze = true;
    }
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL
xrAttachSessionActionSets(XrSession session, const XrSessionActionSetsAttachInfo *info) {
    ENTER;
    FIND(found, SESSION, session);
    STRUCTURE(info, XR_TYPE_SESSION_ACTION_SETS_ATTACH_INFO);
    REQUIRE(!found->session.has_actions, XR_ERROR_ACTIONSETS_ALREADY_ATTACHED,
            "the session has its action sets");
    REQUIRE(info->countActionSets && info->countActionSets <= 16,
            XR_ERROR_VALIDATION_FAILURE, "%u action sets", info->countActionSets);
    for (uint32_t i = 0; i < info->countActionSets; i++) {
        FIND(set, ACTION_SET, info->actionSets[i]);
        set->action.is_attached = true;
        found->session.attached[i] = set;
    }
    found->session.attached_count = info->countActionSets;
    found->session.has_actions = true;
    return XR_SUCCESS;
}

static bool is_attached(const struct object *session, const struct object *set) {
    for (uint32_t i = 0; i < session->session.attached_count; i++)
        if (session->session.attached[i] == set) return true;
    return false;
}

static XrResult XRAPI_CALL xrSyncActions(XrSession session, const XrActionsSyncInfo *info) {
    ENTER;
    FIND(found, SESSION, session);
    STRUCTURE(info, XR_TYPE_ACTIONS_SYNC_INFO);
    for (uint32_t i = 0; i < info->countActiveActionSets; i++) {
        FIND(set, ACTION_SET, info->activeActionSets[i].actionSet);
        REQUIRE(is_attached(found, set), XR_ERROR_ACTIONSET_NOT_ATTACHED,
                "the set '%s' is not attached", set->action.name);
    }
    found->session.is_synced = found->session.state == XR_SESSION_STATE_FOCUSED;
    return found->session.is_synced ? XR_SUCCESS : XR_SESSION_NOT_FOCUSED;
}

/* Begin a function that tells the state of an action. */
#define ACTION_STATE(action_type, structure_type) \
    ENTER; \
    FIND(found, SESSION, session); \
    STRUCTURE(info, XR_TYPE_ACTION_STATE_GET_INFO); \
    STRUCTURE(state, structure_type); \
    FIND(action, ACTION, info->action); \
    REQUIRE(action->action.type == action_type, XR_ERROR_ACTION_TYPE_MISMATCH, \
            "'%s' has another type", action->action.name); \
    REQUIRE(is_attached(found, action->parent), XR_ERROR_ACTIONSET_NOT_ATTACHED, \
            "the set of '%s' is not attached", action->action.name); \
    state->isActive = XR_FALSE

static XrResult XRAPI_CALL xrGetActionStateBoolean(XrSession session,
                                                   const XrActionStateGetInfo *info,
                                                   XrActionStateBoolean *state) {
    ACTION_STATE(XR_ACTION_TYPE_BOOLEAN_INPUT, XR_TYPE_ACTION_STATE_BOOLEAN);
    state->currentState = state->changedSinceLastSync = XR_FALSE;
    state->lastChangeTime = 0;
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL xrGetActionStateFloat(XrSession session,
                                                 const XrActionStateGetInfo *info,
                                                 XrActionStateFloat *state) {
    ACTION_STATE(XR_ACTION_TYPE_FLOAT_INPUT, XR_TYPE_ACTION_STATE_FLOAT);
    state->currentState = 0;
    state->changedSinceLastSync = XR_FALSE;
    state->lastChangeTime = 0;
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL xrGetActionStateVector2f(XrSession session,
                                                    const XrActionStateGetInfo *info,
                                                    XrActionStateVector2f *state) {
    ACTION_STATE(XR_ACTION_TYPE_VECTOR2F_INPUT, XR_TYPE_ACTION_STATE_VECTOR2F);
    state->currentState = (XrVector2f){0, 0};
    state->changedSinceLastSync = XR_FALSE;
    state->lastChangeTime = 0;
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL xrGetActionStatePose(XrSession session,
                                                const XrActionStateGetInfo *info,
                                                XrActionStatePose *state) {
    ACTION_STATE(XR_ACTION_TYPE_POSE_INPUT, XR_TYPE_ACTION_STATE_POSE);
    state->isActive = found->session.is_synced && is_gaze_active(action);
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL xrGetCurrentInteractionProfile(XrSession session, XrPath user,
                                                          XrInteractionProfileState *state) {
    ENTER;
    FIND(found, SESSION, session);
    STRUCTURE(state, XR_TYPE_INTERACTION_PROFILE_STATE);
    REQUIRE(found->session.has_actions, XR_ERROR_ACTIONSET_NOT_ATTACHED,
            "the session has no action sets");
    bool is_gaze = is_enabled[GAZE] && user == path_of(GAZE_USER);
    state->interactionProfile = is_gaze ? path_of(GAZE_PROFILE) : XR_NULL_PATH;
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL xrEnumerateBoundSourcesForAction(
    XrSession session, const XrBoundSourcesForActionEnumerateInfo *info,
    uint32_t capacity, uint32_t *count, XrPath *sources) {
    ENTER;
    FIND(found, SESSION, session);
    STRUCTURE(info, XR_TYPE_BOUND_SOURCES_FOR_ACTION_ENUMERATE_INFO);
    FIND(action, ACTION, info->action);
    uint32_t n = action->action.is_gaze;
    TWO_CALLS(capacity, count, n);
    if (n) sources[0] = path_of(GAZE_PATH);
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL xrGetInputSourceLocalizedName(
    XrSession session, const XrInputSourceLocalizedNameGetInfo *info, uint32_t capacity,
    uint32_t *count, char *text) {
    ENTER;
    FIND(found, SESSION, session);
    STRUCTURE(info, XR_TYPE_INPUT_SOURCE_LOCALIZED_NAME_GET_INFO);
    TWO_CALLS(capacity, count, (uint32_t)sizeof "gaze");
    strcpy(text, "gaze");
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL xrApplyHapticFeedback(XrSession session,
                                                 const XrHapticActionInfo *info,
                                                 const XrHapticBaseHeader *feedback) {
    ENTER;
    FIND(found, SESSION, session);
    STRUCTURE(info, XR_TYPE_HAPTIC_ACTION_INFO);
    (void)feedback;
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL xrStopHapticFeedback(XrSession session,
                                                const XrHapticActionInfo *info) {
    ENTER;
    FIND(found, SESSION, session);
    STRUCTURE(info, XR_TYPE_HAPTIC_ACTION_INFO);
    return XR_SUCCESS;
}

/* --- XR_EXT_debug_utils: taken, and of no effect --------------------------------- */

static XrResult XRAPI_CALL xrCreateDebugUtilsMessengerEXT(
    XrInstance instance, const XrDebugUtilsMessengerCreateInfoEXT *info,
    XrDebugUtilsMessengerEXT *messenger) {
    ENTER;
    FIND(found, INSTANCE, instance);
    STRUCTURE(info, XR_TYPE_DEBUG_UTILS_MESSENGER_CREATE_INFO_EXT);
    *messenger = HANDLE(XrDebugUtilsMessengerEXT, create(MESSENGER, found));
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL
xrDestroyDebugUtilsMessengerEXT(XrDebugUtilsMessengerEXT messenger) {
    ENTER;
    FIND(found, MESSENGER, messenger);
    found->is_alive = false;
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL xrSetDebugUtilsObjectNameEXT(
    XrInstance instance, const XrDebugUtilsObjectNameInfoEXT *info) {
    ENTER;
    FIND(found, INSTANCE, instance);
    STRUCTURE(info, XR_TYPE_DEBUG_UTILS_OBJECT_NAME_INFO_EXT);
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL xrSubmitDebugUtilsMessageEXT(
    XrInstance instance, XrDebugUtilsMessageSeverityFlagsEXT severity,
    XrDebugUtilsMessageTypeFlagsEXT types,
    const XrDebugUtilsMessengerCallbackDataEXT *data) {
    ENTER;
    FIND(found, INSTANCE, instance);
    (void)severity, (void)types, (void)data;
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL xrSessionBeginDebugUtilsLabelRegionEXT(
    XrSession session, const XrDebugUtilsLabelEXT *label) {
    ENTER;
    FIND(found, SESSION, session);
    STRUCTURE(label, XR_TYPE_DEBUG_UTILS_LABEL_EXT);
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL xrSessionEndDebugUtilsLabelRegionEXT(XrSession session) {
    ENTER;
    FIND(found, SESSION, session);
    return XR_SUCCESS;
}

static XrResult XRAPI_CALL xrSessionInsertDebugUtilsLabelEXT(
    XrSession session, const XrDebugUtilsLabelEXT *label) {
    ENTER;
    FIND(found, SESSION, session);
    STRUCTURE(label, XR_TYPE_DEBUG_UTILS_LABEL_EXT);
    return XR_SUCCESS;
}

/* --- functions by name ----------------------------------------------------------- */

static XrResult XRAPI_CALL xrGetInstanceProcAddr(XrInstance, const char *,
                                                 PFN_xrVoidFunction *);

#define ALWAYS -1 /* also without an instance */
#define CORE -2
#define CORE_1_1 -3
#define ENTRY(name, extension) {#name, (PFN_xrVoidFunction)name, extension}
static const struct {
    const char *name;
    PFN_xrVoidFunction function;
    int extension; /* that must be enabled */
} FUNCTIONS[] = {
    ENTRY(xrGetInstanceProcAddr, ALWAYS),
    ENTRY(xrEnumerateInstanceExtensionProperties, ALWAYS),
    ENTRY(xrCreateInstance, ALWAYS),
    ENTRY(xrDestroyInstance, CORE),
    ENTRY(xrGetInstanceProperties, CORE),
    ENTRY(xrPollEvent, CORE),
    ENTRY(xrResultToString, CORE),
    ENTRY(xrStructureTypeToString, CORE),
    ENTRY(xrGetSystem, CORE),
    ENTRY(xrGetSystemProperties, CORE),
    ENTRY(xrEnumerateEnvironmentBlendModes, CORE),
    ENTRY(xrCreateSession, CORE),
    ENTRY(xrDestroySession, CORE),
    ENTRY(xrEnumerateReferenceSpaces, CORE),
    ENTRY(xrCreateReferenceSpace, CORE),
    ENTRY(xrGetReferenceSpaceBoundsRect, CORE),
    ENTRY(xrCreateActionSpace, CORE),
    ENTRY(xrLocateSpace, CORE),
    ENTRY(xrLocateSpaces, CORE_1_1),
    ENTRY(xrDestroySpace, CORE),
    ENTRY(xrEnumerateViewConfigurations, CORE),
    ENTRY(xrGetViewConfigurationProperties, CORE),
    ENTRY(xrEnumerateViewConfigurationViews, CORE),
    ENTRY(xrEnumerateSwapchainFormats, CORE),
    ENTRY(xrCreateSwapchain, CORE),
    ENTRY(xrDestroySwapchain, CORE),
    ENTRY(xrEnumerateSwapchainImages, CORE),
    ENTRY(xrAcquireSwapchainImage, CORE),
    ENTRY(xrWaitSwapchainImage, CORE),
    ENTRY(xrReleaseSwapchainImage, CORE),
    ENTRY(xrBeginSession, CORE),
    ENTRY(xrEndSession, CORE),
    ENTRY(xrRequestExitSession, CORE),
    ENTRY(xrWaitFrame, CORE),
    ENTRY(xrBeginFrame, CORE),
    ENTRY(xrEndFrame, CORE),
    ENTRY(xrLocateViews, CORE),
    ENTRY(xrStringToPath, CORE),
    ENTRY(xrPathToString, CORE),
    ENTRY(xrCreateActionSet, CORE),
    ENTRY(xrDestroyActionSet, CORE),
    ENTRY(xrCreateAction, CORE),
    ENTRY(xrDestroyAction, CORE),
    ENTRY(xrSuggestInteractionProfileBindings, CORE),
    ENTRY(xrAttachSessionActionSets, CORE),
    ENTRY(xrGetCurrentInteractionProfile, CORE),
    ENTRY(xrGetActionStateBoolean, CORE),
    ENTRY(xrGetActionStateFloat, CORE),
    ENTRY(xrGetActionStateVector2f, CORE),
    ENTRY(xrGetActionStatePose, CORE),
    ENTRY(xrSyncActions, CORE),
    ENTRY(xrEnumerateBoundSourcesForAction, CORE),
    ENTRY(xrGetInputSourceLocalizedName, CORE),
    ENTRY(xrApplyHapticFeedback, CORE),
    ENTRY(xrStopHapticFeedback, CORE),
    ENTRY(xrGetOpenGLGraphicsRequirementsKHR, OPENGL),
    ENTRY(xrCreateDebugUtilsMessengerEXT, DEBUG_UTILS),
    ENTRY(xrDestroyDebugUtilsMessengerEXT, DEBUG_UTILS),
    ENTRY(xrSetDebugUtilsObjectNameEXT, DEBUG_UTILS),
    ENTRY(xrSubmitDebugUtilsMessageEXT, DEBUG_UTILS),
    ENTRY(xrSessionBeginDebugUtilsLabelRegionEXT, DEBUG_UTILS),
    ENTRY(xrSessionEndDebugUtilsLabelRegionEXT, DEBUG_UTILS),
    ENTRY(xrSessionInsertDebugUtilsLabelEXT, DEBUG_UTILS),
};

static XrResult XRAPI_CALL xrGetInstanceProcAddr(XrInstance instance, const char *name,
                                                 PFN_xrVoidFunction *function) {
    ENTER;
    *function = NULL;
    if (instance && !find(INSTANCE, ID(instance))) return XR_ERROR_HANDLE_INVALID;
    for (size_t i = 0; i < sizeof FUNCTIONS / sizeof *FUNCTIONS; i++) {
        int extension = FUNCTIONS[i].extension;
        if (strcmp(FUNCTIONS[i].name, name)) continue;
        bool has_it = extension == CORE_1_1 ? XR_VERSION_MINOR(api_version) >= 1
                                            : extension < 0 || is_enabled[extension];
        if (!has_it || (!instance && extension != ALWAYS)) break;
        *function = FUNCTIONS[i].function;
        return XR_SUCCESS;
    }
    return instance ? XR_ERROR_FUNCTION_UNSUPPORTED : XR_ERROR_HANDLE_INVALID;
}

/* The loader finds the runtime by this function. */
__attribute__((visibility("default"))) XrResult XRAPI_CALL
xrNegotiateLoaderRuntimeInterface(const XrNegotiateLoaderInfo *loader,
                                  XrNegotiateRuntimeRequest *request) {
    if (loader->structType != XR_LOADER_INTERFACE_STRUCT_LOADER_INFO ||
        request->structType != XR_LOADER_INTERFACE_STRUCT_RUNTIME_REQUEST ||
        loader->minInterfaceVersion > XR_CURRENT_LOADER_RUNTIME_VERSION)
        return XR_ERROR_INITIALIZATION_FAILED;
    request->runtimeInterfaceVersion = XR_CURRENT_LOADER_RUNTIME_VERSION;
    request->runtimeApiVersion = XR_CURRENT_API_VERSION;
    request->getInstanceProcAddr = xrGetInstanceProcAddr;
    return XR_SUCCESS;
}

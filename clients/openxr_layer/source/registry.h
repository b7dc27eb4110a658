/* What the layer knows of the application's instances, sessions, swapchains and spaces. */
#ifndef OCU_LAYER_REGISTRY_H
#define OCU_LAYER_REGISTRY_H

#include <openxr/openxr.h>
#include <pthread.h>

#include "link.h"

#define MAX_IMAGES 32
#define MAX_RECENTERED 4
#define MAX_SPACES 4

/* Functions of the next layer or of the runtime. */
#define NEXT_FUNCTIONS(F)                                                                \
    F(AcquireSwapchainImage)                                                             \
    F(AttachSessionActionSets)                                                           \
    F(BeginFrame)                                                                        \
    F(CreateAction)                                                                      \
    F(CreateActionSet)                                                                   \
    F(CreateActionSpace)                                                                 \
    F(CreateReferenceSpace)                                                              \
    F(CreateSession)                                                                     \
    F(CreateSwapchain)                                                                   \
    F(DestroyInstance)                                                                   \
    F(DestroySession)                                                                    \
    F(DestroySpace)                                                                      \
    F(DestroySwapchain)                                                                  \
    F(EndFrame)                                                                          \
    F(EnumerateSwapchainImages)                                                          \
    F(LocateSpace)                                                                       \
    F(PollEvent)                                                                         \
    F(ReleaseSwapchainImage)                                                             \
    F(StringToPath)                                                                      \
    F(SuggestInteractionProfileBindings)                                                 \
    F(SyncActions)                                                                       \
    F(WaitSwapchainImage)

typedef struct instance {
    struct instance *next;
    XrInstance handle;
    PFN_xrGetInstanceProcAddr get_proc_addr;
#define F(name) PFN_xr##name name;
    NEXT_FUNCTIONS(F)
#undef F
    char application[XR_MAX_APPLICATION_NAME_SIZE], engine[XR_MAX_ENGINE_NAME_SIZE];
    bool is_depth_stripped; /* the runtime does not take depth, the application submits it */
    void *vulkan_device;  /* that was created through XR_KHR_vulkan_enable2 last */
    PFN_xrVoidFunction vulkan_get_proc; /* its application's vkGetInstanceProcAddr */
    bool has_gaze;        /* XR_EXT_eye_gaze_interaction is enabled */
    bool is_gaze_suggested;
    XrActionSet gaze_set;
    XrAction gaze_action;
} instance;

/* Spaces of the same type and pose have the same coordinates. */
typedef struct {
    XrReferenceSpaceType type;
    XrPosef pose;
} reference_space;

typedef struct space {
    struct space *next;
    XrSpace handle;
    XrSession session;
    instance *instance;
    reference_space kind;
} space;

/* A format of swapchain images that can be copied. */
typedef struct {
    int64_t format; /* of the graphics API */
    uint32_t wire;  /* of color; 0 for depth */
    uint32_t flags; /* of a wire_frame with it */
} image_format;

typedef struct swapchain {
    struct swapchain *next;
    XrSwapchain handle;
    struct session *session;
    XrSwapchainCreateInfo info;
    const image_format *format; /* NULL: its images cannot be copied */
    uint32_t image_count;
    uint64_t images[MAX_IMAGES];
    pthread_mutex_t lock;          /* of these: several threads may acquire and release */
    uint32_t acquired[MAX_IMAGES]; /* indices, the oldest first */
    uint32_t acquired_count;
    void *copy;                    /* of the image that was released last */
    bool has_copy;
    unsigned unused_releases;      /* since a frame with this swapchain was filtered */
} swapchain;

typedef enum { FRAME_NONE, FRAME_READING, FRAME_SENT, FRAME_FILTERED } frame_state;

/* A frame of the application, on its way through the helper or shown. */
typedef struct {
    frame_state state;
    uint64_t begun_ns;
    reference_space space;
    XrCompositionLayerFlags flags;
    int64_t format;        /* of the color images */
    XrSwapchainSubImage quads[WIRE_QUADS]; /* those that it contains; NULL: none */
    wire_frame wire;
} app_frame;

/* A swapchain of the layer's own, with the filtered image of one eye. */
typedef struct {
    XrSwapchain handle;
    int64_t format;
    uint32_t width_px, height_px;
    uint32_t image_count;
    uint64_t images[MAX_IMAGES];
    bool is_acquired, is_waited;
    uint32_t index;        /* of the acquired image */
} own_image;

typedef struct session {
    struct session *next;
    XrSession handle;
    instance *instance;
    /* times of the latest changes of the origins of spaces, under the registry's lock */
    XrTime recentered[MAX_RECENTERED];
    unsigned recentered_count;
    pthread_mutex_t lock;  /* of everything below; held while graphics are used */
    const struct graphics_api *api; /* NULL: not filtered */
    void *graphics;        /* of the API */
    link_state link;
    unsigned reported;
    app_frame frame;       /* the one that the helper has */
    uint64_t next_frame;
    own_image images[WIRE_EYES];
    bool is_shown;         /* `images` contain the result of `shown` */
    app_frame shown;
    reference_space space_kinds[MAX_SPACES];
    XrSpace spaces[MAX_SPACES]; /* the layer's own, of these kinds */
    unsigned space_count;
    XrSpace view_space, gaze_space;
    bool is_gaze_attached;
    bool has_filtered;     /* a frame of this helper was shown */
    uint32_t frames, frames_filtered, frames_fallback;
    uint64_t copy_ns, read_ns, upload_ns, other_ns;
    uint64_t inside_ns;    /* of the current frame, in read_ns and upload_ns */
} session;

void add_instance(instance *item);
void add_session(session *item);
void add_swapchain(swapchain *item);
void add_space(space *item);

/* Remove an item from its list; it is not freed. */
void remove_instance(instance *item);
void remove_session(session *item);
void remove_swapchain(swapchain *item);
void remove_space(space *item);

instance *find_instance(XrInstance handle);
session *find_session(XrSession handle);
swapchain *find_swapchain(XrSwapchain handle);
space *find_space(XrSpace handle);
bool find_reference_space(XrSpace handle, reference_space *found);

/* Return the instance behind another one in the list; the first one after NULL. */
instance *next_instance(const instance *after);
session *session_of_instance(const instance *own);

/* Remove the items of a session from their list and return them as one. */
swapchain *detach_swapchains(const session *at);
space *detach_spaces(const session *at);

/* Note that a space of a session gets another origin. */
void note_recentered(XrSession handle, XrTime time);

/* Whether a space got another origin after the first time, up to the last one. */
bool is_recentered_between(session *at, XrTime first, XrTime last);

/* Give up all connections to the helper, in a forked child. */
void abandon_links(void);

#endif

/* What the layer knows of the application's instances, sessions, swapchains and spaces. */
#ifndef OCU_LAYER_H
#define OCU_LAYER_H

#include <pthread.h>

#include "gl_context.h"
#include "link.h"

#define LAYER_NAME "XR_APILAYER_ocufilter_eye"
#define MAX_IMAGES 32
#define MAX_LAYERS 64
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

typedef struct swapchain {
    struct swapchain *next;
    XrSwapchain handle;
    struct session *session;
    XrSwapchainCreateInfo info;
    uint32_t image_count;
    GLuint images[MAX_IMAGES];
    pthread_mutex_t lock;          /* of these: several threads may acquire and release */
    uint32_t acquired[MAX_IMAGES]; /* indices, the oldest first */
    uint32_t acquired_count;
    GLuint copy;                   /* of the image that was released last */
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
    wire_frame wire;
} app_frame;

/* A swapchain of the layer's own, with the filtered image of one eye. */
typedef struct {
    XrSwapchain handle;
    int64_t format;
    uint32_t width_px, height_px;
    uint32_t image_count;
    GLuint images[MAX_IMAGES];
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
    pthread_mutex_t lock;  /* of everything below; held while the context is current */
    bool has_gl;
    gl_context gl;
    link_state link;
    unsigned reported;
    app_frame frame;       /* the one that the helper has */
    GLuint pixels;         /* buffer that it is read into, without software rendering */
    size_t pixels_bytes;
    GLsync is_read;
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

/* swapchains.c */
bool swapchain_can_copy(const swapchain *chain);
void swapchain_copy(swapchain *chain, GLuint image);
void swapchain_read(const swapchain *chain, const XrSwapchainSubImage *part,
                    uint32_t format, void *target);
uint32_t wire_format_of(int64_t format);
bool is_depth_format(int64_t format);

/* gaze.c */
void gaze_create(instance *own);
XrResult gaze_suggest(instance *own, const XrInteractionProfileSuggestedBinding *given);
XrResult gaze_attach(session *at, const XrSessionActionSetsAttachInfo *given);
XrResult gaze_sync(session *at, const XrActionsSyncInfo *given);
void gaze_locate(session *at, XrTime time, wire_frame *frame);

/* frames.c */
void frames_begin(session *at);
XrResult frames_end(session *at, const XrFrameEndInfo *info);
void frames_close(session *at);

/* layer.c */
swapchain *find_swapchain(XrSwapchain handle);
bool find_reference_space(XrSpace handle, reference_space *found);
bool is_recentered_between(session *at, XrTime first, XrTime last);

#endif

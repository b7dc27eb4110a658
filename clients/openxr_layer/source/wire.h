/* Messages between the layer and its helper, and the layout of their shared memory.
 *
 * A message is one packet of a Unix socket (SOCK_SEQPACKET).  The layer sends HELLO; the
 * helper answers WELCOME; the layer sends MEMORY with the descriptor of a sealed memfd,
 * and then a FRAME whose images are in that memory.  The helper writes the filtered color
 * over the color and sends RESULT; only then may the layer send the next FRAME.
 *
 * clients/openxr_layer/wire.py has the same structures; the tests compare both. */
#ifndef OCU_LAYER_WIRE_H
#define OCU_LAYER_WIRE_H

#include <stdint.h>

#define WIRE_MAGIC 0x4f435558u /* "OCUX" */
#define WIRE_VERSION 2u
#define WIRE_EYES 2
#define WIRE_QUADS 4
#define WIRE_QUAD_PIXELS (1 << 24) /* of the largest one */

enum { WIRE_HELLO = 1, WIRE_WELCOME, WIRE_MEMORY, WIRE_FRAME, WIRE_RESULT };

/* Format of color images. */
enum {
    WIRE_SRGB8 = 1,   /* bytes, sRGB */
    WIRE_LINEAR8,     /* bytes, linear light */
    WIRE_LINEAR16F,   /* half floats, linear light */
    WIRE_LINEAR10     /* 32 bits, linear light: three channels of 10 and 2 of opacity */
};

enum {
    WIRE_HAS_HEAD = 1,
    WIRE_HAS_GAZE = 2,
    WIRE_IS_BLENDED = 4, /* the layer below shows through the alpha channel */
    WIRE_TOP_FIRST = 8,  /* rows begin at the top; otherwise at the bottom, as in OpenGL */
    WIRE_IS_BGR = 16,    /* channels are BGRA; otherwise RGBA */
    WIRE_IS_UNPREMULTIPLIED = 32 /* alpha is not in the color; only of quads */
};

typedef struct {
    uint32_t kind, magic, version, process_id;
    char application[128], engine[128], graphics[16];
} wire_hello;

typedef struct {
    uint32_t kind, magic, version;
    uint32_t wait_ms;     /* longest wait for the result of a frame */
    uint32_t max_age_ms;  /* of a filtered frame that is shown again */
    uint32_t leaves_quads; /* quads are shown unfiltered */
} wire_welcome;

typedef struct {
    uint32_t kind, padding;
    uint64_t size_bytes;
} wire_memory;

typedef struct {
    uint64_t start;       /* in the memory, bytes */
    uint32_t width_px, height_px;
} wire_image;

typedef struct {
    float position_m[3], orientation[4]; /* x, y, z, w */
    float fov_rad[4];                    /* left, right, up, down */
    float min_depth, max_depth, near_m, far_m;
    wire_image color, depth;             /* depth: float32, 0 to 1; width 0 without */
} wire_view;

/* A quad layer above the projection. */
typedef struct {
    float position_m[3], orientation[4]; /* in the space of the views' poses */
    float size_m[2];
    uint32_t color_format, flags; /* of frames, IS_BLENDED or IS_UNPREMULTIPLIED */
    uint32_t eyes;                /* 1: left, 2: right, 3: both */
    wire_image color;             /* width 0: no quad */
} wire_quad;

typedef struct {
    uint32_t kind, flags;
    uint64_t frame_id;
    int64_t display_time_ns;
    uint32_t color_format;
    float head[7];        /* position, orientation */
    float gaze[4];        /* orientation within the head; -z points ahead */
    int64_t gaze_time_ns; /* 0: unknown */
    wire_view views[WIRE_EYES];
    wire_quad quads[WIRE_QUADS]; /* the lowest first */
    /* since the previous FRAME: frames that the application submitted, those shown
     * filtered, those shown unfiltered after the first filtered one, and the time that
     * the layer took on the application's threads */
    uint32_t frames, frames_filtered, frames_fallback;
    uint32_t copy_us, read_us, upload_us, other_us;
} wire_frame;

typedef struct {
    uint32_t kind, is_filtered; /* 0: show the application's own frame */
    uint64_t frame_id;
} wire_result;

#endif

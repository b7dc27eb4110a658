/* Data shared by the stages of a frame.  Arrays belong to the caller (records.py mirrors
 * the layout); images are rows from top to bottom, surface by surface. */
#ifndef OCU_FRAME_H
#define OCU_FRAME_H

#include <stdint.h>

#include "added_light.h"
#include "constants.h"
#include "pool.h"

enum { COLOR_SRGB8 = 0, COLOR_LINEAR = 1, COLOR_HALF = 2 };

/* Size of a kernel of the frame.  The kernel lies within
 * dx^2 + dy^2 <= (radius_px + 0.5)^2; reach_px: left, right, up, down. */
typedef struct {
    float spread_px[2];       /* at the near and the far end of its interval */
    int32_t highest_level;    /* it allows merged squares of up to 2^level pixels */
    uint16_t radius_px;
    uint8_t reach_px[4];
    uint8_t levels_used;      /* a bit per level; set by merging */
    uint8_t spare;
} kernel_shape;

/* Kernels exist in pixels of 1, 2 and 4 px.  Kernels of a coarse resolution r are added to
 * pixels of 2^r px, whose light is interpolated between their centers. */
#define RESOLUTIONS 3

/* Texels of zeros between the rows of a kernel: a fragment is added to columns of eight pixels
 * that its kernel may only touch. */
#define ROW_GAP_TEXELS 7

/* A kernel for fragments of one level: texels of four pairs (red, green, blue, mean) of
 * 15-bit weights at the near and far end.  weight = scale * (near * (1 - f) + far * f),
 * with the fraction f of the interval.  Fine kernels hold the near end alone: its high and low
 * 15 bits take the places of both ends. */
typedef struct {
    uint32_t first_texel;     /* of row 0; ROW_GAP_TEXELS zeros lie before and after a row */
    int32_t resolution;
    int16_t left, up;         /* of its first texel from that of the fragment's square */
    int16_t width, height;
    float scale;
    float near_ratio;         /* share of 1 - f in 15 bits */
    float far_ratio;
    int32_t spare;
} level_image;

typedef struct { level_image level[MAX_LEVEL + 1]; } kernel_image;

/* A pixel, or a merged square of 2^level pixels, with its blur: the extent of its light
 * (fragment), and the light itself (fragment_light). */
typedef struct {
    uint16_t x, y;            /* first pixel */
    uint32_t state;           /* kernel | level << LEVEL_SHIFT | EDGE_BIT | SPECIAL_BIT */
    /* Of the kernel's interval, in parts of 65535; once kernels are blended, the shares of
     * their near and far ends (set_factors). */
    uint32_t fraction;
} fragment;

typedef struct {
    float rgb[RGB];           /* times the coverage */
    float depth;              /* sort depth, smaller is nearer */
} fragment_light;

/* Values of the few fragments with SPECIAL_BIT; of others 0, 1 and 0. */
typedef struct {
    float strength;           /* of an edge of the visible surface, 0 to 1 */
    float coverage;           /* 1 on the visible surface */
    float excess;             /* light that coverage does not amplify */
} fragment_extra;

/* Consecutive fragments of one block with the same kernel and level, in scan order. */
typedef struct {
    uint32_t first, count;    /* of its fragments */
    uint32_t state;           /* as of a fragment; EDGE_BIT and SPECIAL_BIT if one has them */
    float nearest, farthest;  /* least and largest sort depth */
    uint16_t left, right, top, bottom;       /* its pixels */
    uint16_t radius_px;
    uint16_t spare;
} cluster;

enum { BOX_LEFT, BOX_RIGHT, BOX_TOP, BOX_BOTTOM };

#define LEVEL_SHIFT 28
#define KERNEL_MASK 0xFFFFFFFu
#define EDGE_BIT 0x40000000u
#define SPECIAL_BIT 0x80000000u

/* A block of 8 x 8 pixels; its fragments and clusters follow those of the block to its left. */
typedef struct {
    uint32_t first, end;      /* of its fragments */
    uint32_t first_cluster, end_cluster;
    uint16_t radius_px;       /* largest of its fragments */
    uint8_t has_edge;
    uint8_t merged;           /* pixels that are part of squares */
} block_info;

/* A node kernel at one resolution: floats in fours (red, green, blue, mean), surrounded by
 * texels of zeros.  stride is 0 if no kernel needs it. */
typedef struct {
    uint64_t first_texel;
    int32_t stride;           /* texels from row to row */
    uint8_t reach_px[4];
} recipe_image;

/* Job that downsamples kernels of a store; see shrink.h. */
typedef struct {
    pool *threads;
    const uint16_t *from;
    const uint64_t *from_first;
    const uint32_t *from_reach;
    uint16_t *to;
    const uint64_t *to_first;
    const uint32_t *to_reach;
    const int64_t *kernels;   /* their indices (count,) */
    int32_t resolution;
    int32_t count;
} shrink_job;

typedef struct {
    pool *threads;

    /* The frame, and the image within its border. */
    int32_t width, height, surface_count;
    int32_t border_px, image_width, image_height;
    int32_t block_columns, block_rows;

    const void *color[2];
    int32_t color_kind;
    int32_t depth_is_planar;
    const float *depth_m[2];
    float tangents[4];        /* left, right, up, down */
    float vergence_scale, vergence_offset_m;   /* scale / (distance + offset), at the cornea */
    float vergence_low_dpt, vergence_high_dpt, vergence_margin_dpt;
    float blur_px_per_dpt;

    const float *layer_dpt, *layer_per_dpt;  /* ends of intervals, intervals per dpt */
    int32_t layer_count, interval_count;
    int32_t cell_px, cell_columns;  /* cell_px is a power of two, or 0: one cell */
    const float *corner_dpt;  /* change of defocus at the corners of the cells */
    const int32_t *column_cell;              /* of each column of the frame */
    const float *column_share;               /* position within it, 0 to 1 */
    /* If pixels blend the kernels of the cells around them: the first cell of each column
     * and row of the frame, and the share of the next one.  Otherwise NULL. */
    const int32_t *blend_column, *blend_row;
    const float *blend_across, *blend_down;
    int32_t block_slots;      /* fragments that a block has room for */
    int32_t has_fine_kernels; /* one distance in each interval, in 30 bits */
    float *row_scratch;                      /* cell_columns + 1 for each thread */

    float *dpt;               /* of each pixel; NOTHING_DPT in empty hidden pixels */
    float *position;          /* in layers */
    float *block_light;       /* (block_rows, block_columns, 4): sum over pixels, and count */
    uint8_t *used;            /* (cells, intervals) */
    int64_t missing_count, clamped_count, bad_color_count;

    /* Fragments. */
    const uint32_t *kernel_of;  /* (cells, intervals) */
    kernel_shape *shapes;
    int32_t kernel_count;
    int32_t max_level;
    int32_t paper_rule;
    float white_level;
    float tolerance;          /* of merging, relative to the default */
    float gaze_direction[3];  /* right, up, forward; zero: merging is the same everywhere */
    float largest_reach_px;
    int32_t bright_pixels;    /* 0: no light is in excess */
    fragment *fragments;      /* block_slots per block; no gaps in a row of blocks */
    fragment_light *lights;
    fragment_extra *extras;
    float *blend_shares;      /* of each fragment; NULL if pixels do not blend cells */
    cluster *clusters;        /* at most as many as fragments; no gaps in a row of blocks */
    int16_t *boxes[4];        /* first and last columns and rows that clusters light */
    block_info *blocks;
    int64_t fragment_count, merged_count;
    int32_t farthest_px;      /* largest radius of a fragment */
    int32_t is_encoded;       /* for a display: dark parts need a finer tolerance */

    /* Kernels. */
    const uint16_t *store[RESOLUTIONS];
    const uint64_t *store_first[RESOLUTIONS];      /* of each cached kernel */
    const uint32_t *store_reach[RESOLUTIONS];      /* four bytes: left, right, up, down */
    uint64_t store_words[RESOLUTIONS];             /* number of words */
    float coarse_spread_px[RESOLUTIONS];           /* smallest spread that may use it */
    const uint32_t *recipes;  /* (n, 3, 18): cached kernels, unused, weights */
    int32_t recipe_count;
    recipe_image *recipe_images;                   /* (n, RESOLUTIONS) */
    float *recipe_texels;
    const int64_t *kernel_cells, *kernel_parts;    /* (n), (n, 3) */
    const int64_t *node_near, *node_far;
    const double *part_weights, *part_maps;        /* (n, 2, 3), (n, 2, 3, 2, 2) */
    kernel_image *kernels;
    uint32_t *kernel_texels;
    float *blend_scratch;
    uint64_t blend_scratch_floats;                 /* of one thread */
    uint64_t recipe_texel_count, kernel_texel_count;
    uint64_t kernel_gap_count;                     /* of these, zeros between rows */

    /* The output image. */
    void *picture;            /* (image_height, image_width, 3) */
    int32_t output_kind;      /* as color_kind */
    int32_t failed;           /* out of memory */
    int64_t entry_count;
    added_light added;
} frame;

#endif

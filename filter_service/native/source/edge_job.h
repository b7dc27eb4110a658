/* Arguments of the functions for light beyond kernels; records.py mirrors the layout. */
#ifndef OCU_EDGE_JOB_H
#define OCU_EDGE_JOB_H

#include "kernel_job.h"
#include "pool.h"
#include "psf_job.h"

/* Which elements of the edge see sources; see edge_light.py. */
typedef struct {
    pool *threads;
    const int64_t *x_px, *y_px;                 /* of the sources */
    const double *object_dpt;
    const int64_t *kinds;
    const uint8_t *is_hidden;                   /* behind the visible surface */
    const double *shift_px;   /* (n_kinds, N_EDGE, 2), per diopter of rays to the elements */
    const float *depth_m;     /* of the visible surface */
    const double *tangents;   /* of the image's edges if depth is along z, else NaN */
    const double *nearest_dpt;                  /* bounds in squares (rows, columns) */
    float *seen;              /* (count, N_EDGE) */
    double largest_dpt;       /* of nearest_dpt */
    int64_t height, width, rows, columns, count;
} visibility_job;

/* Share of blended kernels that ends before each pixel. */
typedef struct {
    pool *threads;
    store_tables tables;
    state_reads reads;
    const int64_t *nodes;     /* (count, 3): field nodes of each kernel */
    const double *weight_ratio;                 /* (count, 3) */
    const double *layer_dpt, *layer_ratio;      /* (count, 2) */
    const double *zero_dpt;   /* (n_fields, 3) */
    const double *maps;       /* (count, 2, 3, 2, 2), as in FrameKernels */
    const int64_t *reach_px;  /* (count,) */
    float *omitted;           /* (count, 3, side, side) */
    int64_t side, count;
} omitted_job;

/* Light around sources. */
typedef struct {
    pool *threads;
    const float *share_ratio; /* (side, side): factor of each offset */
    const float *rho_index, *phi_index;         /* its position in the tables */
    const float *polar;       /* (count, n_phi, n_fine, 3): tables of distant light */
    const float *edges;       /* (n_kinds, 3, EDGE_ROWS, N_EDGE) */
    const int64_t *kernel_kind;                 /* (count,) */
    const float *seen;        /* (count, N_EDGE) */
    const float *radius_px;   /* up to this, light is computed from the edges */
    const float *omitted;     /* (n, 3, side, side), see omitted_job; NULL: distant light */
    const int64_t *omitted_index;               /* (count,) */
    float *kernels;           /* (count, side, side, 3) */
    int64_t n_phi, n_fine, side, count;
} light_job;

/* Tails of blended kernels, see tails.h. */
typedef struct {
    pool *threads;
    store_tables tables;
    state_reads reads;
    const int64_t *nodes;     /* as in omitted_job */
    const double *weight_ratio, *layer_dpt, *layer_ratio, *zero_dpt, *maps;
    const float *edges;       /* (count, 3, EDGE_ROWS, N_EDGE) */
    const int64_t *step_px;   /* (count,) */
    float *near, *far;        /* (count, NEAR_TAPS, 3), (count, FAR_TAPS, 3) */
    int64_t count;
} tails_job;

/* Blocks of pixels that share a kernel are the squares of this level; those of level 0 are of
 * SQUARE_PX, see added_light.h. */
#define BLOCK_LEVEL 3
#define MAX_LEVELS 8

/* Light beyond kernels of all squares. */
typedef struct {
    pool *threads;
    const uint8_t *kinds;     /* (block_rows, block_columns): kernel of each block */
    const float *near, *far;  /* as in tails_job */
    const int64_t *powers;    /* (count,): level of each near kernel; that of the far is one more */
    float *levels[BLOCK_LEVEL + 1];             /* mean light (3, rows, columns) of squares */
    float *planes[MAX_LEVELS];                  /* as in added_light, zero before */
    int64_t rows, columns, block_rows, block_columns, count;
    int32_t n_levels;
} spread_job;

#endif

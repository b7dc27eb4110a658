/* Arguments of the functions that plan a frame's kernels; records.py mirrors the layout. */
#ifndef OCU_KERNEL_JOB_H
#define OCU_KERNEL_JOB_H

#include <stdint.h>

/* See StoreTables and StateReads in psfs/pack.py. */
typedef struct {
    const double *values_dpt;
    const int64_t *starts;
    const double *channel_shift_dpt;            /* (n_groups, 3) */
    const uint32_t *offsets, *reach_words;
    const int32_t *radius_px;
    const float *blur_px, *spread_px, *peak_ratio;
    const uint8_t *is_computed;
    uint32_t *last_used;
} store_tables;

typedef struct {
    const int64_t *groups;
    const double *scales, *weights;
    int64_t count;
} state_reads;

/* Maps (n_cells, 3, 2, 2) and their ratios (n_cells, 3); see MapTables in image_cells.py. */
typedef struct {
    const double *node_from_cell, *cell_from_node;
    const double *area_ratio, *box_ratio, *stretch_ratio, *change_ratio;
} map_tables;

/* Kernels of pairs of cell and interval, and what they consist of; see KernelList in
 * frame_kernels.py. */
typedef struct {
    const uint8_t *used;      /* (n_cells, n_intervals) */
    const int64_t *cell_nodes;                  /* (n_cells, 3) */
    int64_t n_cells, n_intervals, n_fields, n_layers;
    int64_t *cells, *intervals, *parts;         /* (count,), (count, 3) */
    uint32_t *kernel_of;      /* (n_cells, n_intervals), zero before */
    int64_t *fields, *node_intervals;           /* of node kernels */
    int64_t *near, *far;      /* their recipes */
    int64_t *recipe_fields, *recipe_layers;
    int64_t *marks;           /* scratch (n_fields, max(n_intervals, n_layers)), zero before */
    int64_t count, node_count, recipe_count;    /* results */
} list_job;

/* Recipes of field nodes at layers; see NodeKernels in frame_kernels.py. */
typedef struct {
    store_tables tables;
    state_reads reads;
    const int64_t *fields, *layers;             /* ascending; equal fields are adjacent */
    const double *layer_dpt, *layer_zero_dpt;   /* (n_layers,), (n_fields, 3) */
    uint32_t *words;          /* (count, 3, 3, RECIPE_TAPS), zero before */
    int64_t *reach_px, *radius_px;              /* (count, 4), (count,) */
    double *peak_ratio, *spread_px;
    const int64_t *near, *far;                  /* recipes of node kernels (m,) */
    int64_t *node_reach_px, *node_radius_px;    /* of node kernels: (m, 4), (m,) */
    double *node_peak_ratio;
    int64_t *missing;         /* unique PSFs that are not computed */
    int64_t count, node_count;
    uint32_t frame_number;    /* written to last_used of each PSF that is read */
} recipe_job;

/* Kernels of pairs of cell and interval; see FrameKernels in frame_kernels.py. */
typedef struct {
    map_tables cell_maps;
    const double *cell_weight_ratio;            /* (n_cells, 3) */
    const int64_t *cells, *parts;               /* (count,), (count, 3) */
    const int64_t *node_reach_px, *node_radius_px;  /* of node kernels: (m, 4), (m,) */
    const double *node_peak_ratio;
    const int64_t *near, *far;                  /* recipes of node kernels */
    const double *recipe_spread_px;
    double *weight_ratio, *maps;                /* (count, 2, 3), (count, 2, 3, 2, 2) */
    int64_t *reach_px, *radius_px;              /* (count, 4), (count,) */
    double *peak_ratio, *spread_px;             /* (count,), (count, 2) */
    int64_t count;
} size_job;

#endif

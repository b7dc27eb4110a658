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

/* Recipes of field nodes at layers; see NodeKernels in frame_kernels.py. */
typedef struct {
    store_tables tables;
    state_reads reads;
    const int64_t *fields;    /* equal ones are adjacent */
    const double *total_dpt;  /* (count, 3), ascending within a field node */
    uint32_t *words;          /* (count, 3, 3, RECIPE_TAPS), zero before */
    int64_t *reach_px, *radius_px;              /* (count, 4), (count,) */
    double *peak_ratio, *spread_px;
    int64_t *missing;         /* unique PSFs that are not computed */
    int64_t count;
    uint32_t frame_number;    /* written to last_used of each PSF that is read */
} recipe_job;

/* Kernels of pairs of cell and interval; see FrameKernels in frame_kernels.py. */
typedef struct {
    map_tables cell_maps;
    const double *cell_weight_ratio;            /* (n_cells, 3) */
    const int64_t *cells, *parts;               /* (count,), (count, 3) */
    const int64_t *node_reach_px, *node_radius_px;  /* of node kernels: (m, 4), (m,) */
    const double *node_peak_ratio, *near_spread_px, *far_spread_px;
    double *weight_ratio, *maps;                /* (count, 2, 3), (count, 2, 3, 2, 2) */
    int64_t *reach_px, *radius_px;              /* (count, 4), (count,) */
    double *peak_ratio, *spread_px;             /* (count,), (count, 2) */
    int64_t count;
} size_job;

#endif

/* Arguments of `needed_intervals`; records.py mirrors the layout. */
#ifndef OCU_NODE_JOB_H
#define OCU_NODE_JOB_H

#include <stdint.h>

/* Ranges of defocus, and the spots of the groups. */
typedef struct {
    const double *covariance;     /* (n_groups, 4, 3), see `defocus_nodes._Rays` */
    const double *unit_px;        /* (n_groups,) */
    const double *light_ratio;    /* (n_foci, n_groups) */
    const double *foci_dpt;       /* (n_foci,) */
    const int64_t *groups;        /* (n,): group of each range */
    const double *lows, *highs;   /* (n,): ends */
    const double *shifts_dpt;     /* (n_shifts, n), added to the defocus of nodes */
    double *needed;               /* (n, n_samples) */
    double error;                 /* RMS, half-way between nodes */
    double doubling, blur_exponent, sharp_px, own_share, diffraction_share; /* `error_law` */
    int64_t n, n_groups, n_foci, n_shifts, n_samples;
} node_job;

#endif

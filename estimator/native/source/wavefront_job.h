/* Arguments and results of tracing wavefronts; records.py mirrors the layout. */
#ifndef OCU_WAVEFRONT_JOB_H
#define OCU_WAVEFRONT_JOB_H

#include <stdint.h>

#include "pool.h"

enum { WAVEFRONTS_DONE = 0, WAVEFRONTS_NO_MEMORY = 1 };

/* Fields of eyes; each has an eye and a row of refractive indices. */
typedef struct {
    pool *threads;
    const double *packed;          /* (eyes, n_rows, N_COLUMNS) */
    const double *indices;         /* (index rows, n_indices) */
    const int64_t *eyes;           /* (count,) */
    const int64_t *index_rows;     /* (count,) */
    const int64_t *reference_rows; /* (count,): at the reference wavelength, for shifts */
    const double *fields_rad;      /* (count, 2) */
    const double *radii_mm;        /* (count, n_radii): of stops, or of circles */
    const double *pupil_z_mm;      /* (count,): of the entrance pupil */
    const double *rings;           /* (n_rings,), relative to the radius */
    const double *ring_weights;    /* (n_rings,) */
    const double *azimuths;        /* (n_azimuths, 2) */
    const double *monomials;       /* (n_terms, n_terms): row j, the monomials of term j */
    const double *projection;      /* (n_terms, n_azimuths, n_rings): of W on a circle */
    double *results;
    double object_dpt;             /* of the source, whose wave is subtracted */
    int64_t count, n_rows, n_indices, n_radii, n_rings, n_azimuths, n_terms;
    int64_t at_pupil;              /* the plane is that of the entrance pupil if it is given */
    int64_t by_slopes;             /* fit the slopes instead of W */
    int64_t only_whole;            /* leave vignetted pupils, which take 30 times as long */
} wavefront_job;

#endif

/* Arguments of `fill_defocus`; records.py mirrors the layout. */
#ifndef OCU_DEFOCUS_JOB_H
#define OCU_DEFOCUS_JOB_H

#include <stdint.h>

/* Traced values over pupils and accommodations: sums of monomials, and a rim. */
typedef struct {
    const double *pupils_mm;  /* (pupil_count,), ascending */
    const double *powers;     /* (10,) of the pupil with which values change */
    const double *accommodations_dpt; /* (accommodation_count,), ascending */
    const double *values;     /* (fields, channels, pupils, accommodations, 10) */
    int64_t channel_count, pupil_count, accommodation_count;
} defocus_grid;

/* Pairs of field and wavelength, in one state of the eye. */
typedef struct {
    defocus_grid field, axis;
    const int64_t *fields, *channels; /* (count,): of each request, in the grids */
    const double *open_mm;    /* (count,): unvignetted pupil */
    const double *always;     /* (count, 5): sums to add ... */
    const double *fading;     /* ... and those of a phase that is stretched ... */
    double fading_mm;         /* ... in pupils of larger radii than this */
    double *scratch;          /* axis.channel_count, and accommodations of both grids */
    double *found_dpt;        /* (count,) */
    double pupil_mm, accommodation_dpt;
    double overshoot, sphere_per_c20;
    int64_t count;
} defocus_job;

#endif

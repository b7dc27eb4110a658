/* Arguments and results of computing PSFs; records.py mirrors the layout. */
#ifndef OCU_PSF_JOB_H
#define OCU_PSF_JOB_H

#include <stdint.h>

#include "pool.h"
#include "terms.h"

#define TURN_POWERS 7         /* of the polynomials for cosine and sine */
#define N_EDGE 48             /* points of a survey on the pupil's edge */
#define N_SURVEY 193          /* all points of a survey, padded to SURVEY_STRIDE */
#define SURVEY_STRIDE 200
#define ELLIPSE_COLUMNS 5
#define LOG_AMPLITUDES 6
#define PIXEL_CORNER_PX 0.21   /* to the corner of a pixel; see survey.py */

/* Tables of the modules of estimator/psf, so that each number is defined once. */
typedef struct {
    /* For n terms, 28 to 66. */
    const double *monomials;        /* (n, n): row j, the monomials of Zernike term j */
    const double *zernike_terms;    /* its inverse */
    const double *node_xy;          /* (2, n): points that fix a polynomial */
    const double *from_nodes;       /* (n, n): row k, effect of value k on each term */
    const float *slope_x, *slope_y; /* (n, SURVEY_STRIDE): of monomials at points */
    const float *edge_xy;           /* (2, N_EDGE) */
    const double *passed_powers;    /* (6, n_rings * n_ring) */
    const double *ring_weights;     /* (n_rings - 1,); the last ring is the edge */
    const float *fresnel;           /* (fresnel_count, 2) from -limit to limit: values,
                                     * and differences to the next */
    const float *edge_response;     /* (2 half_width steps + 1, 2), likewise */
    const float *pixel_filters;     /* rows of filter_stride, for k = 1, 2 ... */
    const int32_t *lengths;         /* (length_count,) of FFTs, ascending */
    const int32_t *twiddle_first;   /* (length_count,) pairs */
    const float *twiddles;          /* exp(-2 pi i p / n), n pairs for each length */
    float cosine[TURN_POWERS], sine[TURN_POWERS]; /* polynomials of turns, in squares */
    double fresnel_limit;
    double least_margin_px;
    double base_db, per_rms_db, per_pixel_db, per_narrow_db, rays_from_db, fade_db;
    double min_cells, max_cells, cells_per_px;
    double min_edge_points, edge_points_per_px, min_curvature_ratio;
    double far_px, near_px;
    int32_t fresnel_count, edge_half_width, edge_steps;
    int32_t filter_stride, filter_count, filter_half_width;
    int32_t length_count, n_rings, n_ring;
    int32_t order;                  /* of the n terms */
} psf_tables;

enum { PSF_DONE = 0, PSF_NOT_HERE = 1, PSF_NO_MEMORY = 2 };

/* Wavefronts of nodes, (nodes, primaries, ...), and the requested PSFs. */
typedef struct {
    pool *threads;
    const psf_tables *tables;
    const double *zernike_um;         /* (..., n) at 0 dpt */
    const double *per_dpt_um;         /* (..., n) */
    const double *circle_diameter_mm; /* (...) */
    const double *pupil_ellipse;      /* (..., 5) */
    const double *pixel_from_mrad;    /* (groups, 2, 2) */
    const double *wavelength_nm;      /* (channels, primaries) */
    const double *apodization_per_mm2; /* (channels, primaries), or none */
    double apodization_center_mm[2];
    /* Rings in the pupils; none if there is no table. */
    const double *ring_offset_mm;     /* (..., 2): of the pupil's center from the rings' */
    const double *ring_reach_mrad;    /* (...): reach of their light beyond the rays */
    const float *ring_tables;         /* (channels, primaries, ring_count, 2): amplitude
                                       * by squared distance */
    double ring_steps_per_mm2;
    double ring_lattice_mm[3];        /* of a honeycomb: pitch, inner and outer radius */
    double cut_ratio;                 /* share of the light that is cropped */
    double centroid_ratio;            /* most that this shifts the centroid */
    double oversampling, margin;
    const int64_t *nodes, *groups, *channels; /* (count,) */
    const double *total_dpt;          /* (count,) */
    int64_t *reach_px;                /* (count, 4): results */
    int64_t *radius_px;
    int64_t *sizes;                   /* texels */
    double *peak_ratio, *spread_px, *lost_ratio, *rays_ratio;
    int32_t *outcome;                 /* PSF_DONE, or the reason for no kernel */
    void *results;                    /* of the threads, until take_psfs */
    int32_t count, primaries;
    int32_t max_radius_px, is_diffracting;
    int32_t min_samples_per_px, ring_count, cut_steps;
} psf_job;

/* Surveyed pupils (count, ...) and kernels over discs of given radii. */
typedef struct {
    const psf_job *job;               /* threads, tables, sampling, rings */
    const double *box_um, *half_width, *shear, *log_amplitude; /* of `PupilFrames` */
    const double *wavelength_um;
    const double *low_px, *high_px, *edge_px, *normal, *edge_um, *passed_ratio;
    const double *pixel_from_mrad;
    const double *ring_offset_mm;     /* none if there are no rings */
    const int64_t *ring_channels;
    const double *rays_ratio;         /* share of ray optics */
    const int64_t *radius_px, *first; /* radii, and offsets in the kernels */
    float *kernels;
    double *light_ratio;              /* share of the light in the disc */
    int32_t *outcome;
    int64_t count;
} psf_discs_job;

#endif

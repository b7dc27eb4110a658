/* An eye as Python packs it: estimator/optics/surfaces.py describes the columns. */
#ifndef OCU_PACKED_EYE_H
#define OCU_PACKED_EYE_H

#include "lanes.h"

/* Geometry: a row for each refracting surface, the retina last. */
enum {
    CURVATURE_X = 0,
    CURVATURE_Y = 1,
    CONIC = 2,
    VERTEX = 3,        /* x, y, z, mm */
    ROTATION = 6,      /* (3, 3): surface axes to eye axes */
    FORM = 15,
    IS_TURNED = 16,
    CLEAR_SQUARED = 17,
    NEAR_GRADIENT = 18,
    GRADIENT = 19,     /* column of the index row; 0: homogeneous */
    OFFSET = 20,       /* monomials in Horner's order */
    STOP_Z = 48,       /* last row only */
    N_BEFORE_STOP = 49, /* last row only */
    FORM_NUMBERS = 50,
    HAS_OFFSET = 62,
    N_COLUMNS = 64
};

enum { N_FORM_NUMBERS = HAS_OFFSET - FORM_NUMBERS, OFFSET_ORDER = 6 };

/* Index row, from the column that GRADIENT names. */
enum { GRADIENT_FORM = 0, GRADIENT_STEPS = 1, GRADIENT_NUMBERS = 2 };

/* Outcome of a ray; estimator/optics/raytrace.py names them. */
enum {
    TRACED = 0,
    MISSED = 1,
    CLIPPED = 2,
    TOTAL_REFLECTION = 3,
    OUT_OF_ORDER = 4,
    NOT_CONVERGED = 5,
    IDLE = 6           /* a lane without a ray */
};

/* One eye at one wavelength. */
typedef struct {
    const double *packed;  /* (n_surfaces + 1, N_COLUMNS) */
    const double *indices; /* air, the medium behind each surface, then gradients */
    int n_surfaces, n_before;
} eye;

INLINE const double *row_of(const eye *e, int i) { return e->packed + (ptrdiff_t)i * N_COLUMNS; }

INLINE eye eye_at(const double *packed, int n_rows, const double *indices) {
    eye e = {packed, indices, n_rows - 1, 0};
    e.n_before = (int)row_of(&e, n_rows - 1)[N_BEFORE_STOP];
    return e;
}

INLINE double stop_z(const eye *e) { return row_of(e, e->n_surfaces)[STOP_Z]; }

typedef struct {
    lanes x, y, z;
} vector3;

/* Rays, one in each lane. */
typedef struct {
    vector3 at;    /* mm */
    vector3 along; /* direction cosines */
    lanes path;    /* optical path length, mm */
    lanes since;   /* distance from the last refracting surface, mm */
    flags status;
} rays;

/* Ends the rays that fail here; those that have ended keep their status. */
INLINE void end_rays(rays *r, flags fails, int status) {
    r->status |= fails & (r->status == TRACED) & status;
}

INLINE vector3 moved(vector3 p, lanes distance, vector3 along) {
    return (vector3){p.x + distance * along.x, p.y + distance * along.y,
                     p.z + distance * along.z};
}

INLINE vector3 from_vertex(const double *row, vector3 p) {
    return (vector3){p.x - row[VERTEX], p.y - row[VERTEX + 1], p.z - row[VERTEX + 2]};
}

INLINE vector3 to_surface_axes(const double *row, vector3 v) {
    const double *m = row + ROTATION;
    return (vector3){m[0] * v.x + m[3] * v.y + m[6] * v.z, m[1] * v.x + m[4] * v.y + m[7] * v.z,
                     m[2] * v.x + m[5] * v.y + m[8] * v.z};
}

INLINE vector3 to_eye_axes(const double *row, vector3 v) {
    const double *m = row + ROTATION;
    return (vector3){m[0] * v.x + m[1] * v.y + m[2] * v.z, m[3] * v.x + m[4] * v.y + m[5] * v.z,
                     m[6] * v.x + m[7] * v.y + m[8] * v.z};
}

#endif

/* Sag of a biconic, and offset terms, which add to any form. */
#ifndef OCU_FORM_BICONIC_H
#define OCU_FORM_BICONIC_H

#include "packed_eye.h"

/* Sag, mm, and its slopes, in the axes of the surface. */
typedef struct {
    lanes z, zx, zy;
    flags inside; /* the form is defined there */
} sags;

typedef sags (*sag_function)(const double *row, lanes x, lanes y);

/* Keeps roots and their reciprocals finite outside the domain of a form. */
#define LEAST_RADICAND 1e-12

INLINE lanes guarded_root(lanes radicand) {
    return root_of_lanes(larger_lanes(radicand, all_lanes(LEAST_RADICAND)));
}

static sags biconic_sag(const double *row, lanes x, lanes y) {
    double cx = row[CURVATURE_X], cy = row[CURVATURE_Y], k1 = 1.0 + row[CONIC];
    lanes radicand = 1.0 - k1 * (cx * cx * x * x + cy * cy * y * y);
    lanes root = guarded_root(radicand);
    lanes numerator = cx * x * x + cy * y * y;
    lanes inverse = 1.0 / (1.0 + root);
    lanes common = numerator * k1 * inverse * inverse / root;
    return (sags){numerator * inverse, x * cx * (2.0 * inverse + common * cx),
                  y * cy * (2.0 * inverse + common * cy), radicand > 0.0};
}

/* Adds a polynomial and its slopes. */
INLINE void add_offset(const double *row, lanes x, lanes y, sags *s) {
    const double *term = row + OFFSET;
    lanes z = {0.0}, zx = {0.0}, zy = {0.0};
    for (int b = OFFSET_ORDER; b >= 0; --b) {
        lanes q = {0.0}, dq = {0.0};
        for (int a = OFFSET_ORDER - b; a >= 0; --a) {
            dq = dq * x + q;
            q = q * x + *term++;
        }
        zy = zy * y + z;
        z = z * y + q;
        zx = zx * y + dq;
    }
    s->z += z;
    s->zx += zx;
    s->zy += zy;
}

#endif

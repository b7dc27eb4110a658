/* A conic profile along y, revolved about an axis parallel to y. */
#ifndef OCU_FORM_TOROID_H
#define OCU_FORM_TOROID_H

#include "form_biconic.h"

static sags toroid_sag(const double *row, lanes x, lanes y) {
    double cx = row[CURVATURE_X], cy = row[CURVATURE_Y], k1 = 1.0 + row[CONIC];
    lanes radicand = 1.0 - k1 * cy * cy * y * y;
    lanes root = guarded_root(radicand);
    lanes profile = cy * y * y / (1.0 + root), slope = cy * y / root;
    lanes near = 1.0 - cx * profile;
    lanes squared = near * near - cx * cx * x * x;
    lanes far = guarded_root(squared);
    return (sags){(profile * (1.0 + near) + cx * x * x) / (1.0 + far), cx * x / far,
                  near * slope / far, (radicand > 0.0) & (squared > 0.0)};
}

#endif

/* The sum of two conic profiles, along x and along y. */
#ifndef OCU_FORM_SEPARATE_PROFILES_H
#define OCU_FORM_SEPARATE_PROFILES_H

#include "form_biconic.h"

static sags separate_profiles_sag(const double *row, lanes x, lanes y) {
    double cx = row[CURVATURE_X], cy = row[CURVATURE_Y];
    lanes along_x = 1.0 - (1.0 + row[FORM_NUMBERS]) * cx * cx * x * x;
    lanes along_y = 1.0 - (1.0 + row[FORM_NUMBERS + 1]) * cy * cy * y * y;
    lanes root_x = guarded_root(along_x), root_y = guarded_root(along_y);
    return (sags){cx * x * x / (1.0 + root_x) + cy * y * y / (1.0 + root_y), cx * x / root_x,
                  cy * y / root_y, (along_x > 0.0) & (along_y > 0.0)};
}

#endif

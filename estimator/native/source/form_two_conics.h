/* A biconic with a conic constant in each meridian. */
#ifndef OCU_FORM_TWO_CONICS_H
#define OCU_FORM_TWO_CONICS_H

#include "form_biconic.h"

static sags two_conics_sag(const double *row, lanes x, lanes y) {
    double cx = row[CURVATURE_X], cy = row[CURVATURE_Y];
    double kx = 1.0 + row[FORM_NUMBERS], ky = 1.0 + row[FORM_NUMBERS + 1];
    lanes radicand = 1.0 - kx * cx * cx * x * x - ky * cy * cy * y * y;
    lanes root = guarded_root(radicand);
    lanes numerator = cx * x * x + cy * y * y, inverse = 1.0 / (1.0 + root);
    lanes common = numerator * inverse * inverse / root;
    return (sags){numerator * inverse, x * cx * (2.0 * inverse + common * kx * cx),
                  y * cy * (2.0 * inverse + common * ky * cy), radicand > 0.0};
}

#endif

/* A biconic plus even powers of the distance from its axis. */
#ifndef OCU_FORM_EVEN_ASPHERE_H
#define OCU_FORM_EVEN_ASPHERE_H

#include "form_biconic.h"

static sags even_asphere_sag(const double *row, lanes x, lanes y) {
    sags s = biconic_sag(row, x, y);
    lanes squared = x * x + y * y, value = {0.0}, slope = {0.0};
    for (int t = FORM_NUMBERS + N_FORM_NUMBERS - 1; t >= FORM_NUMBERS; --t) {
        slope = slope * squared + value;
        value = value * squared + row[t];
    }
    slope = slope * squared + value;
    s.z += value * squared;
    s.zx += 2.0 * x * slope;
    s.zy += 2.0 * y * slope;
    return s;
}

#endif

/* Transfer of wavefronts to another plane along the chief ray. */
#ifndef OCU_MOVED_PLANE_H
#define OCU_MOVED_PLANE_H

#include "lanes.h"

/* Adds moved rays to moments of their positions, and to those of W, for each wavefront.
 *
 * Lengths are relative to the radius of the circle.  tables_um (count, order + 1, order + 1) holds
 * the coefficients of x^a y^b, a first; rays (n_rays, 3) are x, y and weight, and move by reach
 * (count,) times the gradient.  moments is (count, 2 fitted + 1, 2 fitted + 1), products_um
 * (count, fitted + 1, fitted + 1). */
static void add_moved_rays(const double *tables_um, const double *reach, const double *rays,
                           double *moments, double *products_um, int64_t count, int64_t n_rays,
                           int64_t order, int64_t fitted) {
    int64_t n = order + 1, n_fitted = fitted + 1, n_moments = 2 * fitted + 1;
    for (int64_t i = 0; i < count; ++i) {
        const double *table = tables_um + i * n * n;
        double *moment = moments + i * n_moments * n_moments;
        double *product = products_um + i * n_fitted * n_fitted;
        for (int64_t k = 0; k < n_rays; ++k) {
            double x = rays[3 * k], y = rays[3 * k + 1], weight = rays[3 * k + 2];
            double value = 0.0, slope_x = 0.0, slope_y = 0.0;
            for (int64_t a = order; a >= 0; --a) {
                double row = 0.0, row_y = 0.0;
                for (int64_t b = order - a; b >= 0; --b) {
                    row_y = row_y * y + row;
                    row = row * y + table[a * n + b];
                }
                slope_x = slope_x * x + value;
                value = value * x + row;
                slope_y = slope_y * x + row_y;
            }
            x += reach[i] * slope_x;
            y += reach[i] * slope_y;
            value += 0.5 * reach[i] * (slope_x * slope_x + slope_y * slope_y);
            double power_x = weight;
            for (int64_t a = 0; a < n_moments; ++a) {
                double power = power_x;
                for (int64_t b = 0; b < n_moments - a; ++b) {
                    moment[a * n_moments + b] += power;
                    if (a + b <= fitted) product[a * n_fitted + b] += power * value;
                    power *= y;
                }
                power_x *= x;
            }
        }
    }
}

#endif

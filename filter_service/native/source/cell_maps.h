/* Linear maps from the pixels of image cells to those of stored kernels. */
#ifndef OCU_CELL_MAPS_H
#define OCU_CELL_MAPS_H

#include <math.h>

#include "bounds.h"
#include "constants.h"

/* Writes the inverses of maps (count, 2, 2), and the ratios (4, count) of `map_tables`. */
static void map_ratios(const double *maps, int64_t count, double *inverse, double *ratios) {
    double *areas = ratios, *boxes = areas + count;
    double *stretches = boxes + count, *changes = stretches + count;
    for (int64_t n = 0; n < count; ++n, maps += 4, inverse += 4) {
        double a = maps[0], b = maps[1], c = maps[2], d = maps[3];
        double area = a * d - b * c;
        inverse[0] = d / area;
        inverse[1] = -b / area;
        inverse[2] = -c / area;
        inverse[3] = a / area;
        /* Largest singular value of the inverse: that of the map over its area. */
        double longest = 0.5 * (hypot(a + d, b - c) + hypot(a - d, b + c));
        areas[n] = fabs(area);
        boxes[n] = fabs(area) / fabs(a * d);
        stretches[n] = longest / fabs(area);
        changes[n] = sqrt((a - 1.0) * (a - 1.0) + b * b + c * c + (d - 1.0) * (d - 1.0));
    }
}

/* Returns whether a map changes a kernel noticeably. */
INLINE int needs_map(double change_ratio, int64_t radius_px) {
    return change_ratio > MIN_SHIFT_RATIO
           && change_ratio * (double)radius_px > MIN_SHIFT_PX;
}

/* Converts reaches (left, right, up, down) by the map `out` (2, 2) to the image's pixels.
 * Linear interpolation extends the light by one stored pixel. */
INLINE void map_reach(const double *out, int64_t *reach_px) {
    double left = (double)reach_px[0] + 1.0, right = (double)reach_px[1] + 1.0;
    double up = (double)reach_px[2] + 1.0, down = (double)reach_px[3] + 1.0;
    for (int axis = 0; axis < 2; ++axis) {
        double a = out[2 * axis], b = out[2 * axis + 1];
        double low = at_most(-a * left, a * right) + at_most(-b * up, b * down);
        double high = at_least(-a * left, a * right) + at_least(-b * up, b * down);
        double ends[2] = {-low, high};
        for (int side = 0; side < 2; ++side) {
            double whole_px = ceil(ends[side] - 1e-9) - 1.0;
            reach_px[2 * axis + side] = (int64_t)clipped(whole_px, 0.0, MAX_REACH_PX);
        }
    }
}

#endif

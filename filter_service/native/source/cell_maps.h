/* Linear maps from the pixels of image cells to those of stored kernels. */
#ifndef OCU_CELL_MAPS_H
#define OCU_CELL_MAPS_H

#include <math.h>
#include <string.h>

#include "bounds.h"
#include "constants.h"
#include "kernel_job.h"

/* A map from the pixels of a cell to those of stored kernels, its inverse, and ratios of
 * `map_tables`. */
typedef struct {
    double out[4], back[4];
    double area_ratio, box_ratio, stretch_ratio;
} cell_map;

INLINE cell_map whole_map(const double *map) {
    double a = map[0], b = map[1], c = map[2], d = map[3];
    double area = a * d - b * c;
    /* Largest singular value of the inverse: that of the map over its area. */
    double longest = 0.5 * (sqrt((a + d) * (a + d) + (b - c) * (b - c))
                            + sqrt((a - d) * (a - d) + (b + c) * (b + c)));
    return (cell_map){{a, b, c, d},
                      {d / area, -b / area, -c / area, a / area},
                      fabs(area),
                      fabs(area) / fabs(a * d),
                      longest / fabs(area)};
}

/* Writes the inverses of maps (count, 2, 2), and the ratios (4, count) of `map_tables`. */
static void map_ratios(const double *maps, int64_t count, double *inverse, double *ratios) {
    double *areas = ratios, *boxes = areas + count;
    double *stretches = boxes + count, *changes = stretches + count;
    for (int64_t n = 0; n < count; ++n, maps += 4, inverse += 4) {
        cell_map own = whole_map(maps);
        memcpy(inverse, own.back, sizeof own.back);
        areas[n] = own.area_ratio;
        boxes[n] = own.box_ratio;
        stretches[n] = own.stretch_ratio;
        double right = maps[0] - 1.0, down = maps[3] - 1.0;
        changes[n] = sqrt(right * right + maps[1] * maps[1] + maps[2] * maps[2] + down * down);
    }
}

/* Share of a map that is applied to a kernel: none where it changes little. */
INLINE double map_share(double change_ratio, double spread_px) {
    double shift_px = change_ratio * (spread_px + KERNEL_TAIL_PX);
    return clipped((change_ratio - MIN_SHIFT_RATIO) / MIN_SHIFT_FADE_RATIO, 0.0, 1.0)
           * clipped((shift_px - MIN_SHIFT_PX) / MIN_SHIFT_FADE_PX, 0.0, 1.0);
}

/* The map of corner `at` as far as a kernel of this spread needs it. */
INLINE cell_map needed_map(const map_tables *maps, int64_t at, double spread_px) {
    const double *map = maps->node_from_cell + 4 * at;
    double share = map_share(maps->change_ratio[at], spread_px);
    if (share <= 0.0) return (cell_map){{1, 0, 0, 1}, {1, 0, 0, 1}, 1, 1, 1};
    if (share >= 1.0) {
        cell_map own = {.area_ratio = maps->area_ratio[at],
                        .box_ratio = maps->box_ratio[at],
                        .stretch_ratio = maps->stretch_ratio[at]};
        memcpy(own.out, map, sizeof own.out);
        memcpy(own.back, maps->cell_from_node + 4 * at, sizeof own.back);
        return own;
    }
    double part[4] = {1.0 + share * (map[0] - 1.0), share * map[1], share * map[2],
                      1.0 + share * (map[3] - 1.0)};
    return whole_map(part);
}

INLINE int is_unmoved(const double *map) {
    return map[0] == 1.0 && map[1] == 0.0 && map[2] == 0.0 && map[3] == 1.0;
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

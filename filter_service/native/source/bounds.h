/* Bounds of numbers. */
#ifndef OCU_BOUNDS_H
#define OCU_BOUNDS_H

#include "vectors.h"

INLINE int64_t smaller_index(int64_t a, int64_t b) { return a < b ? a : b; }
INLINE int64_t larger_index(int64_t a, int64_t b) { return a > b ? a : b; }

/* Not fmax and fmin, which would be library calls; the bound where `value` is NaN. */
INLINE double at_least(double value, double low) { return value > low ? value : low; }
INLINE double at_most(double value, double high) { return value < high ? value : high; }

INLINE double clipped(double value, double low, double high) {
    return at_most(at_least(value, low), high);
}

#endif

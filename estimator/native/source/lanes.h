/* Vectors of doubles, one ray or sample in each lane, and masks of their comparisons. */
#ifndef OCU_LANES_H
#define OCU_LANES_H

#include <math.h>

#include "vectors.h"

enum { N_LANES = 4 };

typedef double lanes __attribute__((vector_size(8 * N_LANES)));
typedef int64_t flags __attribute__((vector_size(8 * N_LANES))); /* -1: true */

INLINE lanes load_lanes(const double *from) {
    lanes value;
    memcpy(&value, from, sizeof value);
    return value;
}

INLINE void store_lanes(double *to, lanes value) { memcpy(to, &value, sizeof value); }

INLINE lanes all_lanes(double value) { return value - (lanes){0.0}; }

INLINE flags all_flags(int64_t value) { return value - (flags){0}; }

/* The first `count` lanes. */
INLINE flags first_lanes(int count) {
    flags index;
    for (int i = 0; i < N_LANES; ++i) index[i] = i;
    return index < all_flags(count);
}

INLINE flags chosen_flags(flags yes, flags a, flags b) { return (yes & a) | (~yes & b); }

INLINE lanes chosen(flags yes, lanes a, lanes b) {
#if defined(OCU_AVX2)
    return __builtin_ia32_blendvpd256(b, a, (lanes)yes);
#else
    return (lanes)chosen_flags(yes, (flags)a, (flags)b);
#endif
}

INLINE int any_lane(flags yes) {
#if defined(OCU_AVX2)
    return __builtin_ia32_movmskpd256((lanes)yes) != 0;
#else
    int64_t any = 0;
    for (int i = 0; i < N_LANES; ++i) any |= yes[i];
    return any != 0;
#endif
}

INLINE lanes size_of_lanes(lanes value) {
    return (lanes)((flags)value & all_flags(INT64_MAX));
}

/* `value`, which is not negative, with the sign of another. */
INLINE lanes with_sign(lanes value, lanes sign) {
    return (lanes)((flags)value | ((flags)sign & all_flags(INT64_MIN)));
}

/* Lane-wise maximum; the second value if either is NaN. */
INLINE lanes larger_lanes(lanes a, lanes b) { return chosen(a > b, a, b); }

/* NaN where the value is negative. */
INLINE lanes root_of_lanes(lanes value) {
#if defined(OCU_AVX2) && !defined(__clang__) /* clang makes one instruction of the loop */
    return __builtin_ia32_sqrtpd256(value);
#else
    for (int i = 0; i < N_LANES; ++i) value[i] = __builtin_sqrt(value[i]);
    return value;
#endif
}

INLINE double sum_of_lanes(lanes value) {
    double sum = 0.0;
    for (int i = 0; i < N_LANES; ++i) sum += value[i];
    return sum;
}

#endif

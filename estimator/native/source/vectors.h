/* Portable vectors of eight (two texels) and four. */
#ifndef OCU_VECTORS_H
#define OCU_VECTORS_H

#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

typedef float f32x4 __attribute__((vector_size(16)));
typedef float f32x8 __attribute__((vector_size(32)));
typedef int32_t i32x4 __attribute__((vector_size(16)));
typedef int32_t i32x8 __attribute__((vector_size(32)));
typedef int16_t i16x16 __attribute__((vector_size(32)));
typedef uint16_t u16x8 __attribute__((vector_size(16)));

#define INLINE static inline __attribute__((always_inline, unused))

INLINE f32x4 load4(const float *from) {
    f32x4 value;
    memcpy(&value, from, sizeof value);
    return value;
}

INLINE void store4(float *to, f32x4 value) { memcpy(to, &value, sizeof value); }

INLINE f32x8 load8(const float *from) {
    f32x8 value;
    memcpy(&value, from, sizeof value);
    return value;
}

INLINE void store8(float *to, f32x8 value) { memcpy(to, &value, sizeof value); }

INLINE f32x8 all8(float value) {
    return (f32x8){value, value, value, value, value, value, value, value};
}

INLINE f32x4 all4(float value) { return (f32x4){value, value, value, value}; }

INLINE int larger_int(int a, int b) { return a > b ? a : b; }
INLINE int smaller_int(int a, int b) { return a < b ? a : b; }

/* Not fmaxf and fminf, which would be library calls. */
INLINE float larger_float(float a, float b) { return a > b ? a : b; }
INLINE float smaller_float(float a, float b) { return a < b ? a : b; }

/* Lane-wise maximum and minimum; the second value if either is NaN. */
#if defined(__x86_64__)
INLINE f32x4 larger4(f32x4 a, f32x4 b) { return __builtin_ia32_maxps(a, b); }
INLINE f32x4 smaller4(f32x4 a, f32x4 b) { return __builtin_ia32_minps(a, b); }
#else
INLINE f32x4 larger4(f32x4 a, f32x4 b) {
    i32x4 first = a > b;
    return (f32x4)((first & (i32x4)a) | (~first & (i32x4)b));
}

INLINE f32x4 smaller4(f32x4 a, f32x4 b) {
    i32x4 first = a < b;
    return (f32x4)((first & (i32x4)a) | (~first & (i32x4)b));
}
#endif

#ifdef OCU_AVX2
INLINE f32x8 larger8(f32x8 a, f32x8 b) { return __builtin_ia32_maxps256(a, b); }
INLINE f32x8 smaller8(f32x8 a, f32x8 b) { return __builtin_ia32_minps256(a, b); }
#else
INLINE f32x8 larger8(f32x8 a, f32x8 b) {
    i32x8 first = a > b;
    return (f32x8)((first & (i32x8)a) | (~first & (i32x8)b));
}

INLINE f32x8 smaller8(f32x8 a, f32x8 b) {
    i32x8 first = a < b;
    return (f32x8)((first & (i32x8)a) | (~first & (i32x8)b));
}
#endif

/* Returns whether any lane is true (all bits set). */
INLINE int any8(i32x8 lanes) {
#ifdef OCU_AVX2
    return __builtin_ia32_movmskps256((f32x8)lanes) != 0;
#else
    int32_t any = 0;
    for (int i = 0; i < 8; ++i) any |= lanes[i];
    return any != 0;
#endif
}

INLINE i16x16 all16(int value) {
    int16_t v = (int16_t)value;
    return (i16x16){v, v, v, v, v, v, v, v, v, v, v, v, v, v, v, v};
}

/* Bit mask of the 16 lanes that are true. */
INLINE uint32_t bits_of_lanes(i16x16 lanes) {
    uint32_t bits = 0;
#ifdef OCU_AVX2
    typedef char c8x16 __attribute__((vector_size(16)));
    i16x16 packed = (i16x16)__builtin_ia32_packsswb256(lanes, lanes);
    c8x16 low, high;
    memcpy(&low, &packed, sizeof low);
    memcpy(&high, (char *)&packed + 16, sizeof high);
    bits = ((uint32_t)__builtin_ia32_pmovmskb128(low) & 255u)
           | ((uint32_t)__builtin_ia32_pmovmskb128(high) & 255u) << 8;
#else
    for (int i = 0; i < 16; ++i) bits |= (uint32_t)(lanes[i] & 1) << i;
#endif
    return bits;
}

/* Bit mask of the eight lanes that are true. */
INLINE uint32_t bits_of8(i32x8 lanes) {
#ifdef OCU_AVX2
    return (uint32_t)__builtin_ia32_movmskps256((f32x8)lanes);
#else
    uint32_t bits = 0;
    for (int i = 0; i < 8; ++i) bits |= (uint32_t)(lanes[i] & 1) << i;
    return bits;
#endif
}

/* Absolute values. */
INLINE f32x8 size8(f32x8 value) {
    i32x8 sign = {INT32_MIN, INT32_MIN, INT32_MIN, INT32_MIN,
                  INT32_MIN, INT32_MIN, INT32_MIN, INT32_MIN};
    return (f32x8)((i32x8)value & ~sign);
}

INLINE f32x8 root8(f32x8 value) {
#if defined(OCU_AVX2) && !defined(__clang__) /* clang makes one instruction of the loop */
    return __builtin_ia32_sqrtps256(value);
#else
    for (int i = 0; i < 8; ++i) value[i] = __builtin_sqrtf(value[i]);
    return value;
#endif
}

#if defined(__clang__) || __GNUC__ >= 12
#define MIXED(a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#else
#define MIXED(a, b, ...) __builtin_shuffle(a, b, (i32x8){__VA_ARGS__})
#endif

/* Entries of a table of pairs.  Single loads of whole pairs take half the time of two
 * gathers. */
INLINE void pairs8(const float *table, i32x8 at, f32x8 *first, f32x8 *second) {
    typedef double f64x4 __attribute__((vector_size(32)));
    double pair[8];
    for (int i = 0; i < 8; ++i) memcpy(pair + i, table + 2 * at[i], sizeof *pair);
    f64x4 low = {pair[0], pair[1], pair[4], pair[5]};
    f64x4 high = {pair[2], pair[3], pair[6], pair[7]};
    *first = MIXED((f32x8)low, (f32x8)high, 0, 2, 8, 10, 4, 6, 12, 14);
    *second = MIXED((f32x8)low, (f32x8)high, 1, 3, 9, 11, 5, 7, 13, 15);
}

/* Reciprocal square root of positive values, to 2^-22. */
INLINE f32x8 inverse_root8(f32x8 value) {
#ifdef OCU_AVX2
    f32x8 guess = __builtin_ia32_rsqrtps256(value);
    return guess * (all8(1.5f) - all8(0.5f) * value * guess * guess);
#else
    return all8(1.0f) / root8(value);
#endif
}

/* Integer part of nonnegative values. */
INLINE i32x8 whole8(f32x8 value) { return __builtin_convertvector(value, i32x8); }

/* Swaps lanes with their neighbors: one (level 1), two or four (level 3) lanes away. */
INLINE f32x8 across8(f32x8 value, int level) {
#if defined(__clang__)
    if (level == 1) return __builtin_shufflevector(value, value, 1, 0, 3, 2, 5, 4, 7, 6);
    if (level == 2) return __builtin_shufflevector(value, value, 2, 3, 0, 1, 6, 7, 4, 5);
    return __builtin_shufflevector(value, value, 4, 5, 6, 7, 0, 1, 2, 3);
#else
    if (level == 1) return __builtin_shuffle(value, (i32x8){1, 0, 3, 2, 5, 4, 7, 6});
    if (level == 2) return __builtin_shuffle(value, (i32x8){2, 3, 0, 1, 6, 7, 4, 5});
    return __builtin_shuffle(value, (i32x8){4, 5, 6, 7, 0, 1, 2, 3});
#endif
}

/* Four values twice. */
INLINE f32x8 twice4(f32x4 value) {
#if defined(__clang__) || __GNUC__ >= 12
    return __builtin_shufflevector(value, value, 0, 1, 2, 3, 4, 5, 6, 7);
#else
    return (f32x8){value[0], value[1], value[2], value[3],
                   value[0], value[1], value[2], value[3]};
#endif
}

/* The same from memory: one load. */
INLINE f32x8 load_twice4(const float *from) {
#if defined(OCU_AVX2) && !defined(__clang__) /* clang makes one load of two */
    return __builtin_ia32_vbroadcastf128_ps256((const f32x4 *)from);
#else
    return twice4(load4(from));
#endif
}

/* Copies the second of each four lanes to the fourth. */
INLINE f32x8 second_as_fourth8(f32x8 value) {
    return MIXED(value, value, 0, 1, 2, 1, 4, 5, 6, 5);
}

/* Lanes of a vector, by their number. */
INLINE f32x8 lanes_of8(f32x8 value, i32x8 lanes) {
#ifdef OCU_AVX2
    return __builtin_ia32_permvarsf256(value, lanes);
#else
    f32x8 found;
    for (int i = 0; i < 8; ++i) found[i] = value[lanes[i]];
    return found;
#endif
}

/* Eight 16-bit words as floats. */
INLINE f32x8 floats_of(u16x8 words) {
    return __builtin_convertvector(__builtin_convertvector(words, i32x8), f32x8);
}

/* Exact a * c + b * d for each pair of 16-bit numbers. */
INLINE i32x8 pair_sums(i32x8 pairs, i32x8 factors) {
#ifdef OCU_AVX2
    return (i32x8)__builtin_ia32_pmaddwd256((i16x16)pairs, (i16x16)factors);
#else
    i32x8 low = ((pairs << 16) >> 16) * ((factors << 16) >> 16);
    return low + (pairs >> 16) * (factors >> 16);
#endif
}

#endif

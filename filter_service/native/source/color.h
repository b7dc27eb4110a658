/* Transfer curves: sRGB (IEC 61966-2-1) and half floats. */
#ifndef OCU_COLOR_H
#define OCU_COLOR_H

#include <math.h>
#include <stdint.h>
#include <string.h>

#include "vectors.h"

extern float linear_of_byte[256];

/* Bytes at equal steps of a float's bits, 128 per octave: the byte changes at most once in
 * each. */
#define STEP_SHIFT 16
#define FIRST_STEP (0x38000000u >> STEP_SHIFT) /* 2^-15, half of the second byte */
#define LAST_STEP (0x3F800000u >> STEP_SHIFT)  /* 1 */
typedef struct {
    float next_light;         /* light from which the next byte is the nearest */
    uint32_t byte;            /* at the start of the step */
} byte_step;
extern byte_step byte_steps[LAST_STEP - FIRST_STEP + 1];

INLINE uint32_t bits_of(float value) {
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    return bits;
}

INLINE float float_of(uint32_t bits) {
    float value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

/* Nearest bytes of eight light values; NaN becomes dark. */
INLINE void bytes_of_linear(f32x8 light, uint8_t *bytes) {
    f32x8 dark = all8(float_of(FIRST_STEP << STEP_SHIFT));
    light = smaller8(larger8(light, dark), all8(1.0f));
    i32x8 at = ((i32x8)light >> STEP_SHIFT) - (int32_t)FIRST_STEP;
    for (int i = 0; i < 8; ++i) {
        const byte_step *step = byte_steps + at[i];
        bytes[i] = (uint8_t)(step->byte + (light[i] >= step->next_light));
    }
}

INLINE float float_of_half(uint16_t half) {
    uint32_t sign = (uint32_t)(half & 0x8000u) << 16;
    uint32_t exponent = (half >> 10) & 31u;
    uint32_t mantissa = half & 1023u;
    if (exponent == 0) { /* zero, and steps of 2^-24 */
        float small = (float)mantissa * 0x1p-24f;
        return sign ? -small : small;
    }
    if (exponent == 31) return float_of(sign | 0x7F800000u | (mantissa << 13));
    return float_of(sign | ((exponent + 112u) << 23) | (mantissa << 13));
}

/* Nearest half, ties to even; clamped to the largest. */
INLINE uint16_t half_of_float(float value) {
    if (value > 65504.0f) value = 65504.0f;
    if (value < -65504.0f) value = -65504.0f;
    uint32_t bits = bits_of(value);
    uint16_t sign = (uint16_t)((bits >> 16) & 0x8000u);
    bits &= 0x7FFFFFFFu;
    if (bits < 0x38800000u) { /* below the smallest normal half */
        float steps = float_of(bits) * 0x1p24f;
        return (uint16_t)(sign | (uint16_t)rintf(steps));
    }
    bits += 0xFFFu + ((bits >> 13) & 1u);
    return (uint16_t)(sign | ((bits >> 13) - (112u << 10)));
}

#endif

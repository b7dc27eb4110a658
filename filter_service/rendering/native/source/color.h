/* Transfer curves: sRGB (IEC 61966-2-1) and half floats. */
#ifndef OCU_COLOR_H
#define OCU_COLOR_H

#include <math.h>
#include <stdint.h>
#include <string.h>

#include "vectors.h"

/* Linear light of each byte, and from which light on each byte is the nearest. */
extern float linear_of_byte[256];
extern float first_light_of_byte[257];

/* Bytes at the start of equal steps of a float's bits, 128 steps an octave. */
#define GUESS_SHIFT 16
#define GUESS_FIRST (0x38000000u >> GUESS_SHIFT) /* 2^-15, half of the second byte */
#define GUESS_END (0x3F800000u >> GUESS_SHIFT)   /* 1 */
extern uint8_t guessed_byte[GUESS_END - GUESS_FIRST + 1];

void make_color_tables(void);

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

INLINE uint8_t byte_of_linear(float light) {
    if (!(light >= first_light_of_byte[1])) return 0; /* what is not a number, too */
    if (light >= 1.0f) return 255;
    unsigned guess = guessed_byte[(bits_of(light) >> GUESS_SHIFT) - GUESS_FIRST];
    while (light >= first_light_of_byte[guess + 1]) ++guess;
    return (uint8_t)guess;
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

/* Nearest half, to even; beyond the largest the largest. */
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

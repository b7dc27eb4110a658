#include "color.h"

float linear_of_byte[256];
byte_step byte_steps[LAST_STEP - FIRST_STEP + 1];

static double linear_of_srgb(double srgb) {
    return srgb <= 0.04045 ? srgb / 12.92 : pow((srgb + 0.055) / 1.055, 2.4);
}

/* Light from which a byte is the nearest; infinity beyond the last byte. */
static float first_light_of(unsigned byte) {
    return byte < 256 ? (float)linear_of_srgb((byte - 0.5) / 255.0) : INFINITY;
}

__attribute__((constructor)) static void make_color_tables(void) {
    for (int byte = 0; byte < 256; ++byte)
        linear_of_byte[byte] = (float)linear_of_srgb(byte / 255.0);
    unsigned byte = 0;
    for (uint32_t step = FIRST_STEP; step <= LAST_STEP; ++step) {
        float light = float_of(step << STEP_SHIFT);
        while (light >= first_light_of(byte + 1)) ++byte;
        byte_steps[step - FIRST_STEP] = (byte_step){first_light_of(byte + 1), byte};
    }
}

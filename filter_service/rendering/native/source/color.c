#include "color.h"

float linear_of_byte[256];
float first_light_of_byte[257];
uint8_t guessed_byte[GUESS_END - GUESS_FIRST + 1];

static double linear_of_srgb(double srgb) {
    return srgb <= 0.04045 ? srgb / 12.92 : pow((srgb + 0.055) / 1.055, 2.4);
}

void make_color_tables(void) {
    for (int byte = 0; byte < 256; ++byte) {
        linear_of_byte[byte] = (float)linear_of_srgb(byte / 255.0);
        first_light_of_byte[byte] = (float)linear_of_srgb((byte - 0.5) / 255.0);
    }
    first_light_of_byte[256] = INFINITY;
    unsigned byte = 0;
    for (uint32_t step = GUESS_FIRST; step <= GUESS_END; ++step) {
        float light = float_of(step << GUESS_SHIFT);
        while (byte < 255 && light >= first_light_of_byte[byte + 1]) ++byte;
        guessed_byte[step - GUESS_FIRST] = (uint8_t)byte;
    }
}

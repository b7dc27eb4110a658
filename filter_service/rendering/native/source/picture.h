/* Sums become the picture: light over coverage, encoded.  Twins: encode_srgb, encode_half. */

#include "frame.h"
#include "vectors.h"

INLINE void write_pixel(const frame *f, size_t at, const float *rgb) {
    for (size_t c = 0; c < RGB; ++c) {
        if (f->output_kind == COLOR_SRGB8)
            ((uint8_t *)f->picture)[3 * at + c] = byte_of_linear(rgb[c]);
        else if (f->output_kind == COLOR_LINEAR)
            ((float *)f->picture)[3 * at + c] = rgb[c];
        else
            ((uint16_t *)f->picture)[3 * at + c] = half_of_float(rgb[c]);
    }
}

/* Light of a pixel that has hardly any: where a colour lacks it, the pixel's own. */
static void fill_in_own(const frame *f, int x, int y, const float *coverage, float *rgb) {
    f32x4 own = pixel_color(f, 0, (size_t)y * (size_t)f->width + (size_t)x);
    for (int c = 0; c < RGB; ++c)
        if (!(coverage[c] >= MIN_COVERAGE)) rgb[c] = own[c];
}

/* Writes the pixels of a window: light over coverage. */
static void write_window(const frame *f, const window *w, const pixel_pair *sums) {
    int left = larger_int(w->x0, f->border_px);
    int right = smaller_int(w->x0 + w->width, f->border_px + f->image_width);
    int bottom = smaller_int(w->y0 + w->height, f->border_px + f->image_height);
    for (int y = larger_int(w->y0, f->border_px); y < bottom; ++y) {
        const pixel_pair *row = sums + (y - w->y0) * PAIRS_ACROSS;
        size_t to = (size_t)(y - f->border_px) * (size_t)f->image_width;
        for (int x = left; x < right; ++x) {
            const float *light = (const float *)(row + (x - w->x0) / 2) + 4 * ((x - w->x0) & 1);
            f32x4 coverage = load4(light + 8);
            f32x4 least = all4(MIN_COVERAGE);
            float rgb[4];
            store4(rgb, load4(light) / larger4(coverage, least));
            i32x4 lacks = coverage < least;
            if (lacks[0] | lacks[1] | lacks[2]) fill_in_own(f, x, y, light + 8, rgb);
            write_pixel(f, to + (size_t)(x - f->border_px), rgb);
        }
    }
}

/* Conversion of sums to the output image: light over coverage, encoded.  Twins: encode_srgb,
 * encode_half. */

#include "frame.h"
#include "vectors.h"

/* Light of two pixels over their coverage; without coverage, the pixels' own light.  Pixels
 * before `left` and from `right` on are outside the image. */
INLINE f32x8 seen_light(const frame *f, const pixel_pair *sums, int x, int y, int left,
                        int right) {
    f32x8 least = all8(MIN_COVERAGE);
    f32x8 light = sums->light / larger8(sums->coverage, least);
    i32x8 lacks = (sums->coverage < least) & (i32x8){-1, -1, -1, 0, -1, -1, -1, 0};
    if (!any8(lacks)) return light;
    for (int i = 0; i < 8; ++i) {
        int column = x + i / 4;
        if (!lacks[i] || column < left || column >= right) continue;
        f32x4 own = pixel_color(f, 0, (size_t)y * (size_t)f->width + (size_t)column);
        light[i] = own[i % 4];
    }
    return light;
}

INLINE size_t pixel_bytes(int kind) {
    return RGB * (kind == COLOR_SRGB8 ? 1 : kind == COLOR_LINEAR ? sizeof(float) : 2);
}

/* Writes two pixels in the caller's encoding. */
INLINE void encode_pair(int kind, f32x8 light, uint8_t *to) {
    if (kind == COLOR_SRGB8) {
        uint8_t bytes[8];
        bytes_of_linear(light, bytes);
        memcpy(to, bytes, RGB);
        memcpy(to + RGB, bytes + 4, RGB);
        return;
    }
    for (int pixel = 0; pixel < 2; ++pixel, to += pixel_bytes(kind)) {
        float rgb[RGB] = {light[4 * pixel], light[4 * pixel + 1], light[4 * pixel + 2]};
        if (kind == COLOR_LINEAR) {
            memcpy(to, rgb, sizeof rgb);
            continue;
        }
        uint16_t halves[RGB];
        for (int c = 0; c < RGB; ++c) halves[c] = half_of_float(rgb[c]);
        memcpy(to, halves, sizeof halves);
    }
}

/* Writes the pixels of a window, in one kind of encoding. */
INLINE void write_window_as(const frame *f, int kind, const window *w, const pixel_pair *sums) {
    int left = larger_int(w->x0, f->border_px);
    int right = smaller_int(w->x0 + w->width, f->border_px + f->image_width);
    int bottom = smaller_int(w->y0 + w->height, f->border_px + f->image_height);
    if (left >= right) return;
    size_t size = pixel_bytes(kind);
    uint8_t row[BIN_WIDTH * RGB * sizeof(float)];
    for (int y = larger_int(w->y0, f->border_px); y < bottom; ++y) {
        const pixel_pair *from = sums + (y - w->y0) * PAIRS_ACROSS;
        for (int x = 0; x < w->width; x += 2) {
            f32x8 light = seen_light(f, from + x / 2, w->x0 + x, y, left, right);
            encode_pair(kind, light, row + size * (size_t)x);
        }
        size_t to = (size_t)(y - f->border_px) * (size_t)f->image_width
                    + (size_t)(left - f->border_px);
        memcpy((uint8_t *)f->picture + size * to, row + size * (size_t)(left - w->x0),
               size * (size_t)(right - left));
    }
}

static void write_window(const frame *f, const window *w, const pixel_pair *sums) {
    if (f->output_kind == COLOR_SRGB8) write_window_as(f, COLOR_SRGB8, w, sums);
    else if (f->output_kind == COLOR_LINEAR) write_window_as(f, COLOR_LINEAR, w, sums);
    else write_window_as(f, COLOR_HALF, w, sums);
}

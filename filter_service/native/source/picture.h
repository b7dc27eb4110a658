/* Conversion of sums to the output image: light over coverage, encoded.  Twins: encode_srgb,
 * encode_half. */

#include "frame.h"
#include "vectors.h"

/* Light of each pixel relative to its light over coverage: coverage changes the excess
 * neither where it is missing, nor where kernels of different shape add up to more than 1. */
INLINE f32x8 kept_light(const pixel_pair *sums) {
    return all8(1.0f) - excess_shares(sums) * (all8(1.0f) - sums->coverage);
}

/* Light of two pixels over their coverage; without coverage, the pixels' own light.  Pixels
 * before `left` and from `right` on are outside the image. */
INLINE f32x8 seen_light(const frame *f, const pixel_pair *sums, int x, int y, int left,
                        int right) {
    f32x8 least = all8(MIN_COVERAGE);
    f32x8 light = sums->light / larger8(sums->coverage, least);
    if (has_excess(sums) && !f->paper_rule)
        light *= kept_light(sums);
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

/* Light of two pixels by depths, as far as light of edges reaches them, else of all depths at
 * once. */
INLINE f32x8 mixed_light(const frame *f, const pixel_pair *near, const pixel_pair *total, int x,
                         int y, int left, int right) {
    f32x8 by_depth = seen_light(f, near, x, y, left, right);
    float first = smaller_float(total->light[3] * (1.0f / EDGE_MIX_COVERAGE), 1.0f);
    float second = smaller_float(total->light[7] * (1.0f / EDGE_MIX_COVERAGE), 1.0f);
    if (smaller_float(first, second) >= 1.0f) return by_depth;
    f32x8 all = seen_light(f, total, x, y, left, right);
    f32x8 share = {first, first, first, first, second, second, second, second};
    return all + share * (by_depth - all);
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

/* Writes the pixels of a window, in one kind of encoding: of sums by depths and their total,
 * or of one sum (`total` is NULL). */
INLINE void write_window_as(const frame *f, int kind, const window *w, const pixel_pair *sums,
                            const pixel_pair *total) {
    int left = larger_int(w->x0, f->border_px);
    int right = smaller_int(w->x0 + w->width, f->border_px + f->image_width);
    int bottom = smaller_int(w->y0 + w->height, f->border_px + f->image_height);
    if (left >= right) return;
    size_t size = pixel_bytes(kind);
    uint8_t row[BIN_WIDTH * RGB * sizeof(float)];
    f32x8 blended[BIN_WIDTH / SQUARE_PX + 2];
    int from_px = left - f->border_px, first = from_px / SQUARE_PX - 1;
    for (int y = larger_int(w->y0, f->border_px); y < bottom; ++y) {
        if (f->added.squares != NULL)
            blend_squares(&f->added, y - f->border_px, first, BIN_WIDTH / SQUARE_PX + 2, blended);
        for (int x = 0; x < w->width; x += 2) {
            int pair = (y - w->y0) * PAIRS_ACROSS + x / 2;
            f32x8 light = total == NULL
                              ? seen_light(f, sums + pair, w->x0 + x, y, left, right)
                              : mixed_light(f, sums + pair, total + pair, w->x0 + x, y, left,
                                            right);
            if (f->added.squares != NULL && w->x0 + x >= left && w->x0 + x < right)
                light = with_light(light, blended, first, w->x0 + x - f->border_px);
            encode_pair(kind, light, row + size * (size_t)x);
        }
        size_t to = (size_t)(y - f->border_px) * (size_t)f->image_width
                    + (size_t)(left - f->border_px);
        memcpy((uint8_t *)f->picture + size * to, row + size * (size_t)(left - w->x0),
               size * (size_t)(right - left));
    }
}

static void write_window(const frame *f, const window *w, const pixel_pair *sums,
                         const pixel_pair *total) {
    if (f->output_kind == COLOR_SRGB8) write_window_as(f, COLOR_SRGB8, w, sums, total);
    else if (f->output_kind == COLOR_LINEAR) write_window_as(f, COLOR_LINEAR, w, sums, total);
    else write_window_as(f, COLOR_HALF, w, sums, total);
}

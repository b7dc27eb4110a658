/* Recipes: kernels of field nodes at layers, blended from the cache over pupil,
 * accommodation and defocus.  Twin: blend_psfs of shaders/passes. */

#include <math.h>

#include "color.h"
#include "frame.h"
#include "vectors.h"

#define RECIPE_WORDS (3 * RECIPE_TAPS)
#define PAD_TEXELS 3          /* zeros between rows, the most that a mapped pixel reads */

/* Resolution in which a level of a kernel is computed: coarse if it is blurred enough. */
INLINE int resolution_of(const frame *f, const kernel_shape *shape, int level) {
    float spread = smaller_float(shape->spread_px[0], shape->spread_px[1]);
    for (int r = RESOLUTIONS - 1; r > 0; --r)
        if (level >= r && spread >= f->coarse_spread_px[r]) return r;
    return 0;
}

/* Bit mask of the resolutions that the used levels of a kernel need. */
static int resolutions_used(const frame *f, int kernel) {
    const kernel_shape *shape = f->shapes + kernel;
    int bits = 0;
    for (int level = 0; level <= MAX_LEVEL; ++level)
        if (shape->levels_used & (1 << level)) bits |= 1 << resolution_of(f, shape, level);
    return bits;
}

/* Number of a kernel's first part at one end. */
INLINE size_t first_part(int kernel, int is_far) {
    return FIELD_CORNERS * (2 * (size_t)kernel + (size_t)is_far);
}

/* Recipes of a kernel's end; -1 for parts of zero weight. */
INLINE void kernel_recipes(const frame *f, int kernel, int is_far, int *recipes) {
    const int64_t *parts = f->kernel_parts + FIELD_CORNERS * (size_t)kernel;
    const double *weights = f->part_weights + first_part(kernel, is_far);
    for (int j = 0; j < FIELD_CORNERS; ++j)
        recipes[j] = weights[j] > 0.0 ? (int)(is_far ? f->node_far : f->node_near)[parts[j]] : -1;
}

/* Reach of the kernels that a recipe blends. */
static reach recipe_reach(const frame *f, int recipe, int r) {
    reach all = {0, 0, 0, 0};
    for (int channel = 0; channel < RGB; ++channel) {
        const uint32_t *words = f->recipes + ((size_t)recipe * RGB + (size_t)channel) * RECIPE_WORDS;
        for (int tap = 0; tap < RECIPE_TAPS; ++tap)
            if (float_of(words[2 * RECIPE_TAPS + tap]) > 0.0f)
                all = wider(all, unpack_reach(f->store_reach[r][words[tap]]));
    }
    int beyond = r > 0;       /* sharpening */
    return (reach){all.left + beyond, all.right + beyond, all.up + beyond, all.down + beyond};
}

/* Floats from row to row of a channel of a recipe: it is converted in eights, with the zeros
 * after it. */
INLINE int plane_stride(reach box) { return (reach_width(box) + PAD_TEXELS + 7) & ~7; }

/* Lays out recipes consecutively, in the resolutions that kernels need. */
static void place_recipes(frame *f) {
    memset(f->recipe_images, 0, sizeof(recipe_image) * RESOLUTIONS * (size_t)f->recipe_count);
    for (int k = 0; k < f->kernel_count; ++k) {
        int used = resolutions_used(f, k);
        for (int end = 0; used && end < 2; ++end) {
            int recipes[FIELD_CORNERS];
            kernel_recipes(f, k, end, recipes);
            for (int j = 0; j < FIELD_CORNERS; ++j)
                for (int r = 0; recipes[j] >= 0 && r < RESOLUTIONS; ++r)
                    if (used & (1 << r)) f->recipe_images[RESOLUTIONS * recipes[j] + r].stride = 1;
        }
    }
    uint64_t next = PAD_TEXELS;
    uint64_t largest = 0;
    for (int i = 0; i < RESOLUTIONS * f->recipe_count; ++i) {
        recipe_image *image = f->recipe_images + i;
        if (image->stride == 0) continue;
        reach box = recipe_reach(f, i / RESOLUTIONS, i % RESOLUTIONS);
        uint8_t sides[4] = {(uint8_t)box.left, (uint8_t)box.right, (uint8_t)box.up,
                            (uint8_t)box.down};
        memcpy(image->reach_px, sides, sizeof sides);
        image->stride = reach_width(box) + PAD_TEXELS;
        image->first_texel = next + (uint64_t)PAD_TEXELS * (uint64_t)image->stride;
        next += (uint64_t)image->stride * (uint64_t)(reach_height(box) + 2 * PAD_TEXELS);
        uint64_t planes = (uint64_t)(plane_stride(box) * (reach_height(box) + 1));
        largest = planes > largest ? planes : largest;
    }
    f->recipe_texel_count = next + PAD_TEXELS;
    f->blend_scratch_floats = (RGB * largest + 15) & ~(uint64_t)15;
}

/* Adds a weighted row of quantized weights. */
INLINE void add_row(float *to, const uint16_t *from, int count, float weight) {
    f32x8 factor = all8(weight);
    int x = 0;
    for (; x + 8 <= count; x += 8) {
        u16x8 words;
        memcpy(&words, from + x, sizeof words);
        store8(to + x, load8(to + x) + factor * floats_of(words));
    }
    for (; x < count; ++x) to[x] += weight * (float)from[x];
}

/* Masks of eight words: the mask of those from n on begins at 8 - n, that of those before n at
 * 16 - n. */
#define EIGHT(word) word, word, word, word, word, word, word, word
static const uint16_t word_masks[24] = {EIGHT(0), EIGHT(0xFFFF), EIGHT(0)};

INLINE void add_words(float *to, const uint16_t *from, u16x8 kept, f32x8 factor) {
    u16x8 words;
    memcpy(&words, from, sizeof words);
    store8(to, load8(to) + factor * floats_of(words & kept));
}

/* Adds weighted rows of quantized weights in eights of which the first `lead` words and those
 * from `end` on are outside of the row: all taps add to the same eights, so that a load never
 * waits for two stores. */
static void add_rows_of_words(float *to, int stride, const uint16_t *from, int width,
                              int height, int lead, float weight) {
    f32x8 factor = all8(weight);
    int last = (lead + width - 1) & ~7;
    u16x8 first_kept, last_kept;
    memcpy(&first_kept, word_masks + 8 - lead, sizeof first_kept);
    memcpy(&last_kept, word_masks + 16 - (lead + width - last), sizeof last_kept);
    if (last == 0) first_kept &= last_kept;
    u16x8 all_kept = ~(u16x8){0};
    for (from -= lead; height-- > 0; from += width, to += stride) {
        add_words(to, from, first_kept, factor);
        for (ptrdiff_t x = 8; x < last; x += 8) add_words(to + x, from + x, all_kept, factor);
        if (last > 0) add_words(to + last, from + last, last_kept, factor);
    }
}

/* Blends one channel of a recipe into a plane of rows of `stride` floats. */
static void blend_channel(const frame *f, const uint32_t *words, int r, reach box, int stride,
                          float *plane) {
    memset(plane, 0, sizeof(float) * (size_t)stride * (size_t)reach_height(box));
    float pixels = (float)(1 << 2 * r); /* texels of a coarse kernel are means */
    for (int tap = 0; tap < RECIPE_TAPS; ++tap) {
        float weight = pixels * float_of(words[2 * RECIPE_TAPS + tap]);
        if (!(weight > 0.0f)) continue;
        reach own = unpack_reach(f->store_reach[r][words[tap]]);
        uint64_t at = f->store_first[r][words[tap]];
        const uint16_t *from = f->store[r] + at;
        int width = reach_width(own), height = reach_height(own);
        int column = box.left - own.left, lead = column & 7;
        float *to = plane + (box.up - own.up) * stride + column;
        uint64_t end = at + (uint64_t)(width * height);
        if (at >= 8 && end + 8 <= f->store_words[r])
            add_rows_of_words(to - lead, stride, from, width, height, lead, weight);
        else /* the eights would read beyond the store */
            for (int y = 0; y < height; ++y)
                add_row(to + y * stride, from + y * width, width, weight);
    }
}

/* Sharpens a coarse kernel.  The means over coarse pixels and the interpolation between their
 * centers add 1 and 3 px^2 to the variance along each axis (coarse pixels of 2 and 4 px): in
 * coarse pixels 2 * SHARPENING.  The second difference removes it. */
static const float SHARPENING[RESOLUTIONS] = {0.0f, 0.125f, 0.09375f};

static void sharpen(float *plane, int width, int height, int stride, float share, float *spare) {
    float *above = spare, *own = spare + stride;
    memset(above, 0, sizeof(float) * (size_t)width);
    for (int y = 0; y < height; ++y, plane += stride) {
        const float *below = y + 1 < height ? plane + stride : NULL;
        memcpy(own, plane, sizeof(float) * (size_t)width);
        for (int x = 0; x < width; ++x) {
            float around = above[x] + (below ? below[x] : 0.0f);
            if (x > 0) around += own[x - 1];
            if (x + 1 < width) around += own[x + 1];
            plane[x] = own[x] + share * (4.0f * own[x] - around);
        }
        float *last = above;
        above = own;
        own = last;
    }
}

/* Writes eight texels: red, green, blue and their mean. */
INLINE void write_colors(f32x8 red, f32x8 green, f32x8 blue, float *to) {
    f32x8 mean = (red + green + blue) * all8(1.0f / 3.0f);
    f32x8 rg_low = MIXED(red, green, 0, 8, 1, 9, 4, 12, 5, 13);
    f32x8 rg_high = MIXED(red, green, 2, 10, 3, 11, 6, 14, 7, 15);
    f32x8 bm_low = MIXED(blue, mean, 0, 8, 1, 9, 4, 12, 5, 13);
    f32x8 bm_high = MIXED(blue, mean, 2, 10, 3, 11, 6, 14, 7, 15);
    /* texels 0 and 4, 1 and 5, 2 and 6, 3 and 7 */
    f32x8 first = MIXED(rg_low, bm_low, 0, 1, 8, 9, 4, 5, 12, 13);
    f32x8 second = MIXED(rg_low, bm_low, 2, 3, 10, 11, 6, 7, 14, 15);
    f32x8 third = MIXED(rg_high, bm_high, 0, 1, 8, 9, 4, 5, 12, 13);
    f32x8 fourth = MIXED(rg_high, bm_high, 2, 3, 10, 11, 6, 7, 14, 15);
    store8(to, MIXED(first, second, 0, 1, 2, 3, 8, 9, 10, 11));
    store8(to + 8, MIXED(third, fourth, 0, 1, 2, 3, 8, 9, 10, 11));
    store8(to + 16, MIXED(first, second, 4, 5, 6, 7, 12, 13, 14, 15));
    store8(to + 24, MIXED(third, fourth, 4, 5, 6, 7, 12, 13, 14, 15));
}

/* Item of the first loop: blends one recipe in one resolution. */
static void blend_recipe(void *argument, int item, int thread) {
    const frame *f = argument;
    const recipe_image *image = f->recipe_images + item;
    if (image->stride == 0) return;
    const uint32_t *words = f->recipes + (size_t)(item / RESOLUTIONS) * RGB * RECIPE_WORDS;
    reach box = read_reach(image->reach_px);
    int width = reach_width(box);
    int height = reach_height(box);
    int stride = plane_stride(box);
    size_t plane = (size_t)stride * (size_t)height;
    float *scratch = f->blend_scratch + (size_t)thread * f->blend_scratch_floats;
    for (int channel = 0; channel < RGB; ++channel)
        blend_channel(f, words + channel * RECIPE_WORDS, item % RESOLUTIONS, box, stride,
                      scratch + (size_t)channel * plane);
    int r = item % RESOLUTIONS;
    for (int channel = 0; r > 0 && channel < RGB; ++channel)
        sharpen(scratch + (size_t)channel * plane, width, height, stride, SHARPENING[r],
                scratch + RGB * plane);
    float *row = f->recipe_texels + 4 * image->first_texel;
    size_t pad = sizeof(float) * 4 * PAD_TEXELS * (size_t)(image->stride + 1);
    memset(row - pad / sizeof(float), 0, pad);
    for (int y = 0; y < height; ++y, row += 4 * image->stride) {
        const float *red = scratch + (size_t)y * (size_t)stride;
        /* Texels beyond the zeros after the row are written again with the next row. */
        for (int x = 0; x < width + PAD_TEXELS; x += 8)
            write_colors(load8(red + x), load8(red + plane + x), load8(red + 2 * plane + x),
                         row + 4 * x);
    }
    memset(row, 0, sizeof(float) * 4 * PAD_TEXELS * (size_t)image->stride);
}

/* Kernels in the format that fragments read: both ends of an interval of layers, 15 bits. */

#include <math.h>

#include "dither.h"
#include "frame.h"
#include "vectors.h"

#define STEPS_15_BITS 32767.0f

/* Texels from one row of a kernel to the next. */
INLINE int row_texels(const level_image *image) { return image->width + ROW_GAP_TEXELS; }

/* Lays out the levels of all kernels that fragments use, consecutively. */
static void place_kernels(frame *f) {
    uint64_t texel = ROW_GAP_TEXELS, gaps = ROW_GAP_TEXELS;
    uint64_t largest = 0;
    for (int k = 0; k < f->kernel_count; ++k) {
        const kernel_shape *shape = f->shapes + k;
        reach boxes[RESOLUTIONS];
        int needed = resolutions_used(f, k);
        for (int r = 0; r < RESOLUTIONS; ++r) {
            if (!(needed & (1 << r))) continue;
            int near[FIELD_CORNERS], far[FIELD_CORNERS];
            kernel_recipes(f, k, 0, near);
            kernel_recipes(f, k, 1, far);
            boxes[r] = wider(end_box(f, k, 0, near, r), end_box(f, k, 1, far, r));
        }
        for (int level = 0; level <= MAX_LEVEL; ++level) {
            if (!(shape->levels_used & (1 << level))) continue;
            level_image *image = f->kernels[k].level + level;
            int r = resolution_of(f, shape, level);
            int beyond = level_extent(level - r);
            image->resolution = r;
            image->left = (int16_t)boxes[r].left;
            image->up = (int16_t)boxes[r].up;
            image->width = (int16_t)(reach_width(boxes[r]) + beyond);
            image->height = (int16_t)(reach_height(boxes[r]) + beyond);
            image->first_texel = (uint32_t)texel;
            uint64_t texels = (uint64_t)row_texels(image) * (uint64_t)image->height;
            texel += texels;
            gaps += ROW_GAP_TEXELS * (uint64_t)image->height;
            texels += LEVEL_PAD * (uint64_t)image->height;
            largest = texels > largest ? texels : largest;
        }
    }
    f->kernel_texel_count = texel;
    f->kernel_gap_count = gaps;
    /* both ends of a kernel at all levels, four floats per texel */
    uint64_t floats = 2 * (MAX_LEVEL + 1) * 4 * (largest + 64);
    if (floats > f->blend_scratch_floats) f->blend_scratch_floats = floats;
}

INLINE i32x8 steps_of(f32x8 texels, f32x8 per_light, f32x8 added) {
    f32x8 steps = texels * per_light + added;
    i32x8 whole = __builtin_convertvector(steps, i32x8);
    /* rounds down, also the negative texels of coarse kernels */
    return whole + (__builtin_convertvector(whole, f32x8) > steps);
}

INLINE f32x8 of_texels(float first, float second) {
    return (f32x8){first, first, first, first, second, second, second, second};
}

/* A level of an end within a row of the kernel: its texels and its first and last column. */
typedef struct {
    const float *texels;           /* of column 0 of the kernel */
    int first, end;
} end_row;

INLINE end_row row_of_end(const kernel_end *end, int level, int y, const level_image *image) {
    int from_y = y - (image->up - end->box.up);
    if (from_y < 0 || from_y >= level_height(end, level))
        return (end_row){no_texels, 0, image->width};
    int first = image->left - end->box.left;
    const float *texels = end->texels[level] + 4 * from_y * level_stride(end, level);
    return (end_row){texels - 4 * first, first, first + level_width(end, level)};
}

/* Steps per light of both ends, and the dither of the row. */
typedef struct { f32x8 near, far; const float *added; } step_sizes;

/* Writes texels of a row: near ends in the low halves, far ends in the high ones.  `column` is
 * that of the first one from the center of the kernel. */
INLINE void write_texels(const float *near, const float *far, step_sizes steps, int column,
                         ptrdiff_t count, uint32_t *to) {
    const float *added = steps.added;
    int c = column & 3;
    f32x8 here = of_texels(added[c], added[(c + 1) & 3]);
    f32x8 next = of_texels(added[c ^ 2], added[(c + 3) & 3]);
    ptrdiff_t x = 0;
    for (; x + 8 <= count; x += 8) {
        i32x8 texels = (steps_of(load8(near + x), steps.near, here) & 0xFFFF)
                       | steps_of(load8(far + x), steps.far, here) << 16;
        memcpy(to + x, &texels, sizeof texels);
        f32x8 last = here;
        here = next;
        next = last;
    }
    if (x == count) return;
    i32x8 texels = (steps_of(twice4(load4(near + x)), steps.near, here) & 0xFFFF)
                   | steps_of(twice4(load4(far + x)), steps.far, here) << 16;
    memcpy(to + x, &texels, sizeof texels / 2);
}

/* Writes one row of a kernel, and the zeros behind it. */
INLINE void write_row(const level_image *image, end_row near, end_row far, step_sizes steps,
                      uint32_t *to) {
    int first = larger_int(near.first, far.first), end = smaller_int(near.end, far.end);
    int column = -image->left, width = image->width;
    if (first > 0)
        write_texels(near.first ? no_texels : near.texels, far.first ? no_texels : far.texels,
                     steps, column, 4 * first, to);
    write_texels(near.texels + 4 * first, far.texels + 4 * first, steps, column + first,
                 4 * (end - first), to + 4 * first);
    if (end < width)
        write_texels(near.end == end ? no_texels : near.texels + 4 * end,
                     far.end == end ? no_texels : far.texels + 4 * end, steps, column + end,
                     4 * (width - end), to + 4 * end);
    memset(to + 4 * image->width, 0, 16 * ROW_GAP_TEXELS);
}

/* Writes a kernel's level, which is level `own` of its resolution. */
static void write_level(const frame *f, level_image *image, int own, kernel_end *const *ends) {
    float near = ends[0]->largest[own];
    float far = ends[1]->largest[own];
    float most = larger_float(larger_float(near, far), 1e-30f);
    /* A coarse pixel carries the light of as many pixels as it is later spread over. */
    image->scale = most / (STEPS_15_BITS * STEPS_15_BITS);
    image->near_ratio = STEPS_15_BITS * near / most;
    image->far_ratio = STEPS_15_BITS * far / most;
    step_sizes steps = {all8(near > 0.0f ? STEPS_15_BITS / near : 0.0f),
                       all8(far > 0.0f ? STEPS_15_BITS / far : 0.0f), NULL};
    uint32_t *row = f->kernel_texels + 4 * (size_t)image->first_texel;
    memset(row - 4 * ROW_GAP_TEXELS, 0, 16 * ROW_GAP_TEXELS);
    for (int y = 0; y < image->height; ++y, row += 4 * row_texels(image)) {
        steps.added = before_next_cut[(y - image->up) & 3];
        write_row(image, row_of_end(ends[0], own, y, image),
                  row_of_end(ends[1], own, y, image), steps, row);
    }
}

/* Writes the near end of a kernel in 30 bits, rounded: derivatives are differences of kernels
 * that differ by little. */
static void write_fine_level(const frame *f, level_image *image, int own,
                             const kernel_end *end) {
    float most = larger_float(end->largest[own], 1e-30f);
    float per_light = STEPS_15_BITS * STEPS_15_BITS / most;
    int base = (int)STEPS_15_BITS;
    image->scale = 1.0f / per_light;
    image->near_ratio = image->far_ratio = STEPS_15_BITS;
    uint32_t *row = f->kernel_texels + 4 * (size_t)image->first_texel;
    memset(row - 4 * ROW_GAP_TEXELS, 0, 16 * ROW_GAP_TEXELS);
    for (int y = 0; y < image->height; ++y, row += 4 * row_texels(image)) {
        end_row from = row_of_end(end, own, y, image);
        memset(row, 0, 16 * (size_t)row_texels(image));
        for (int i = 4 * from.first; i < 4 * smaller_int(from.end, image->width); ++i) {
            int steps = smaller_int((int)(from.texels[i] * per_light + 0.5f), base * base);
            row[i] = (uint32_t)(steps / base) | (uint32_t)(steps % base) << 16;
        }
    }
}

#define KERNELS_AN_ITEM 8

/* Blends some kernels in one resolution, cell by cell: the far end of one kernel is mostly
 * the near end of the next. */
static void blend_some(const frame *f, int first, int last, int r, kernel_end *two) {
    kernel_end *ends[2] = {&two[0], &two[1]};
    two[0].cell = two[1].cell = -1;
    for (int k = first; k < last; ++k) {
        if (!(resolutions_used(f, k) & (1 << r))) continue;
        kernel_end *other = ends[0];
        ends[0] = ends[1];
        ends[1] = other;
        make_end(f, k, 0, r, ends[0]);
        make_end(f, k, 1, r, ends[1]);
        const kernel_shape *shape = f->shapes + k;
        for (int level = r; level <= MAX_LEVEL; ++level) {
            if (!(shape->levels_used & (1 << level))) continue;
            if (resolution_of(f, shape, level) != r) continue;
            make_levels(ends[0], level - r);
            make_levels(ends[1], level - r);
            level_image *image = f->kernels[k].level + level;
            if (f->has_fine_kernels) write_fine_level(f, image, level - r, ends[0]);
            else write_level(f, image, level - r, ends);
        }
    }
}

/* Item of the second loop: blends some kernels in all resolutions. */
static void blend_kernels(void *argument, int item, int thread) {
    const frame *f = argument;
    float *scratch = f->blend_scratch + (size_t)thread * f->blend_scratch_floats;
    size_t plane = (size_t)(f->blend_scratch_floats / (2 * (MAX_LEVEL + 1)));
    kernel_end two[2];
    for (int e = 0; e < 2; ++e)
        for (int level = 0; level <= MAX_LEVEL; ++level)
            two[e].texels[level]
                = scratch + (size_t)(e * (MAX_LEVEL + 1) + level) * plane + 4 * LEVEL_LEAD;
    int last = smaller_int((item + 1) * KERNELS_AN_ITEM, f->kernel_count);
    for (int r = 0; r < RESOLUTIONS; ++r)
        blend_some(f, item * KERNELS_AN_ITEM, last, r, two);
}

/* Kernels in the format that fragments read: both ends of an interval of layers, 15 bits. */

#include <math.h>

#include "dither.h"
#include "frame.h"
#include "vectors.h"

#define STEPS_15_BITS 32767.0f

INLINE int level_extent(int level) { return (1 << level) - 1; }

/* Texels from one row of a kernel to the next. */
INLINE int row_texels(const level_image *image) { return image->width + ROW_GAP_TEXELS; }

/* Lays out the levels of all kernels that fragments use, consecutively. */
static void place_kernels(frame *f) {
    uint64_t texel = ROW_GAP_TEXELS;
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
            largest = texels > largest ? texels : largest;
        }
    }
    f->kernel_texel_count = texel;
    /* both ends of a kernel at all levels, four floats per texel */
    uint64_t floats = 2 * (MAX_LEVEL + 1) * 4 * (largest + 64);
    if (floats > f->blend_scratch_floats) f->blend_scratch_floats = floats;
}

INLINE i32x4 steps_of(f32x4 texel, f32x4 per_light, float added) {
    f32x4 steps = texel * per_light + all4(added);
    i32x4 whole = __builtin_convertvector(steps, i32x4);
    /* rounds down, also the negative texels of coarse kernels */
    return whole + (__builtin_convertvector(whole, f32x4) > steps);
}

/* Writes one row of a kernel: near ends in the low halves, far ends in the high ones. */
INLINE void write_row(const kernel_end *end, int level, int y, const level_image *image,
                      int is_far, f32x4 per_light, uint32_t *to) {
    int from_y = y - (image->up - end->box.up);
    int width = reach_width(end->box) + level_extent(level);
    int height = reach_height(end->box) + level_extent(level);
    if (from_y < 0 || from_y >= height) return;
    const float *from = end->texels[level] + 4 * (size_t)from_y * (size_t)width;
    to += 4 * (image->left - end->box.left);
    const float *added = before_next_cut[(y - image->up) & 3];
    for (int x = 0; x < width; ++x) {
        i32x4 steps = steps_of(load4(from + 4 * x), per_light, added[(x - end->box.left) & 3]);
        i32x4 texel;
        memcpy(&texel, to + 4 * x, sizeof texel);
        texel |= is_far ? steps << 16 : steps & 0xFFFF;
        memcpy(to + 4 * x, &texel, sizeof texel);
    }
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
    f32x4 near_steps = all4(near > 0.0f ? STEPS_15_BITS / near : 0.0f);
    f32x4 far_steps = all4(far > 0.0f ? STEPS_15_BITS / far : 0.0f);
    uint32_t *row = f->kernel_texels + 4 * (size_t)image->first_texel;
    memset(row - 4 * ROW_GAP_TEXELS, 0, 16 * ROW_GAP_TEXELS);
    for (int y = 0; y < image->height; ++y, row += 4 * row_texels(image)) {
        memset(row, 0, 16 * (size_t)row_texels(image));
        write_row(ends[0], own, y, image, 0, near_steps, row);
        write_row(ends[1], own, y, image, 1, far_steps, row);
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
            write_level(f, f->kernels[k].level + level, level - r, ends);
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
            two[e].texels[level] = scratch + (size_t)(e * (MAX_LEVEL + 1) + level) * plane;
    int last = smaller_int((item + 1) * KERNELS_AN_ITEM, f->kernel_count);
    for (int r = 0; r < RESOLUTIONS; ++r)
        blend_some(f, item * KERNELS_AN_ITEM, last, r, two);
}

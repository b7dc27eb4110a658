/* This frame's kernels from the cache: field node by layer (recipes), then cell by
 * interval.  Twins: blend_psfs, blend_cells and merge_psfs of shaders/passes. */

#include <math.h>

#include "color.h"
#include "frame.h"
#include "vectors.h"

#define RECIPE_WORDS (3 * RECIPE_TAPS)
#define LONGEST_REACH_PX 255
#define PAD_TEXELS 3          /* zeros between rows, as many as a mapped pixel may read */
#define STEPS_15_BITS 32767.0f

typedef struct { int left, right, up, down; } reach;

INLINE reach unpack_reach(uint32_t word) {
    return (reach){(int)(word & 255), (int)(word >> 8 & 255), (int)(word >> 16 & 255),
                   (int)(word >> 24)};
}

INLINE reach read_reach(const uint8_t *bytes) {
    return (reach){bytes[0], bytes[1], bytes[2], bytes[3]};
}

INLINE int reach_width(reach r) { return r.left + r.right + 1; }
INLINE int reach_height(reach r) { return r.up + r.down + 1; }

INLINE int larger_int(int a, int b) { return a > b ? a : b; }
INLINE int smaller_int(int a, int b) { return a < b ? a : b; }

INLINE reach wider(reach a, reach b) {
    return (reach){larger_int(a.left, b.left), larger_int(a.right, b.right),
                   larger_int(a.up, b.up), larger_int(a.down, b.down)};
}

/* --- recipes ----------------------------------------------------------------- */

/* Resolution in which a level of a kernel is made: what is blurred enough is coarse. */
INLINE int resolution_of(const frame *f, const kernel_shape *shape, int level) {
    float spread = smaller_float(shape->spread_px[0], shape->spread_px[1]);
    for (int r = RESOLUTIONS - 1; r > 0; --r)
        if (level > r && spread >= f->coarse_spread_px[r]) return r;
    return 0;
}

/* Resolutions, a bit each, that the used levels of a kernel need. */
static int resolutions_used(const frame *f, int kernel) {
    const kernel_shape *shape = f->shapes + kernel;
    int bits = 0;
    for (int level = 0; level <= MAX_LEVEL; ++level)
        if (shape->levels_used & (1 << level)) bits |= 1 << resolution_of(f, shape, level);
    return bits;
}

/* Recipes of a kernel's ends; -1 where a part weighs nothing. */
INLINE void kernel_recipes(const frame *f, int kernel, int is_far, int *recipes) {
    const int64_t *parts = f->kernel_parts + FIELD_CORNERS * (size_t)kernel;
    const double *weights = f->part_weights + FIELD_CORNERS * (size_t)kernel;
    for (int j = 0; j < FIELD_CORNERS; ++j)
        recipes[j] = weights[j] > 0.0 ? (int)(is_far ? f->node_far : f->node_near)[parts[j]] : -1;
}

/* Reach of what a recipe is blended from. */
static reach recipe_reach(const frame *f, int recipe, int r) {
    reach all = {0, 0, 0, 0};
    for (int channel = 0; channel < RGB; ++channel) {
        const uint32_t *words = f->recipes + ((size_t)recipe * RGB + (size_t)channel) * RECIPE_WORDS;
        for (int tap = 0; tap < RECIPE_TAPS; ++tap)
            if (float_of(words[2 * RECIPE_TAPS + tap]) > 0.0f)
                all = wider(all, unpack_reach(f->store_reach[r][words[tap]]));
    }
    return all;
}

/* Places recipes one behind the other, in the resolutions that kernels need. */
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
        uint64_t planes = (uint64_t)(reach_width(box) + 8) * (uint64_t)reach_height(box);
        largest = planes > largest ? planes : largest;
    }
    f->recipe_texel_count = next + PAD_TEXELS;
    f->blend_scratch_floats = RGB * largest;
}

/* Adds a weighted row of steps. */
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

/* Blends one channel of a recipe into a plane of rows of `stride` floats. */
static void blend_channel(const frame *f, const uint32_t *words, int r, reach box, int stride,
                          float *plane) {
    memset(plane, 0, sizeof(float) * (size_t)stride * (size_t)reach_height(box));
    float pixels = (float)(1 << 2 * r); /* steps of a coarse kernel are means */
    for (int tap = 0; tap < RECIPE_TAPS; ++tap) {
        float weight = pixels * float_of(words[2 * RECIPE_TAPS + tap]);
        if (!(weight > 0.0f)) continue;
        reach own = unpack_reach(f->store_reach[r][words[tap]]);
        const uint16_t *from = f->store[r] + f->store_first[r][words[tap]];
        int width = reach_width(own);
        float *to = plane + (box.up - own.up) * stride + box.left - own.left;
        for (int y = 0; y < reach_height(own); ++y)
            add_row(to + y * stride, from + y * width, width, weight);
    }
}

/* Item of the first loop: one recipe in one resolution. */
static void blend_recipe(void *argument, int item, int thread) {
    const frame *f = argument;
    const recipe_image *image = f->recipe_images + item;
    if (image->stride == 0) return;
    const uint32_t *words = f->recipes + (size_t)(item / RESOLUTIONS) * RGB * RECIPE_WORDS;
    reach box = read_reach(image->reach_px);
    int width = reach_width(box);
    int height = reach_height(box);
    int stride = width + 8;
    size_t plane = (size_t)stride * (size_t)height;
    float *scratch = f->blend_scratch + (size_t)thread * f->blend_scratch_floats;
    for (int channel = 0; channel < RGB; ++channel)
        blend_channel(f, words + channel * RECIPE_WORDS, item % RESOLUTIONS, box, stride,
                      scratch + (size_t)channel * plane);
    float *row = f->recipe_texels + 4 * image->first_texel;
    size_t pad = sizeof(float) * 4 * PAD_TEXELS * (size_t)(image->stride + 1);
    memset(row - pad / sizeof(float), 0, pad);
    for (int y = 0; y < height; ++y, row += 4 * image->stride) {
        const float *red = scratch + (size_t)y * (size_t)stride;
        for (int x = 0; x < width; ++x)
            store4(row + 4 * x, (f32x4){red[x], red[plane + (size_t)x],
                                        red[2 * plane + (size_t)x], 0.0f});
        memset(row + 4 * width, 0, sizeof(float) * 4 * PAD_TEXELS);
    }
    memset(row, 0, sizeof(float) * 4 * PAD_TEXELS * (size_t)image->stride);
}

/* --- one end of a kernel ------------------------------------------------------- */

/* A kernel at one layer: floats in fours, and the sums over squares that it needs. */
typedef struct {
    int recipes[FIELD_CORNERS];    /* that it was made of; -1: nothing yet */
    double maps[FIELD_CORNERS][4];
    int64_t cell;
    reach box;
    int level_count;               /* made so far */
    float *texels[MAX_LEVEL + 1];
    float largest[MAX_LEVEL + 1];
} kernel_end;

INLINE int is_unmoved(const double *map) {
    return map[0] == 1.0 && map[1] == 0.0 && map[2] == 0.0 && map[3] == 1.0;
}

/* Reach in the image's pixels of a kernel stored in others; twin: cell_maps.mapped_reach. */
static reach mapped_reach(const double *map, reach stored) {
    double area = map[0] * map[3] - map[1] * map[2];
    double inverse[2][2] = {{map[3] / area, -map[1] / area}, {-map[2] / area, map[0] / area}};
    double ends[4];
    for (int axis = 0; axis < 2; ++axis) {
        double a = inverse[axis][0];
        double b = inverse[axis][1];
        double left = -a * (stored.left + 1.0), right = a * (stored.right + 1.0);
        double up = -b * (stored.up + 1.0), down = b * (stored.down + 1.0);
        ends[2 * axis] = -(fmin(left, right) + fmin(up, down));
        ends[2 * axis + 1] = fmax(left, right) + fmax(up, down);
    }
    int sides[4];
    for (int side = 0; side < 4; ++side) {
        int whole = (int)ceil(ends[side] - 1e-9) - 1;
        sides[side] = whole < 0 ? 0 : smaller_int(whole, LONGEST_REACH_PX);
    }
    return (reach){sides[0], sides[1], sides[2], sides[3]};
}

/* Where the pixels of a row read along one axis: first texel, and shares of so many. */
#define MOST_TAPS 8
#define LONGEST_ROW (2 * LONGEST_REACH_PX + 1)

typedef struct {
    int32_t first[LONGEST_ROW];
    float shares[MOST_TAPS][LONGEST_ROW];
} row_reads;

/* Shares of stored texels that pixels cover: middles `start + step * n`, half a side. */
INLINE void find_covered(float start, float step, float half, int count, int n_taps,
                         int lowest, int highest, row_reads *reads) {
    for (int n = 0; n < count; ++n) {
        float middle = start + step * (float)n;
        float low = middle - half;
        float high = middle + half;
        float first = __builtin_floorf(low + 0.5f);
        first = first < (float)lowest ? (float)lowest : first;
        first = first > (float)highest ? (float)highest : first;
        reads->first[n] = (int32_t)first;
        for (int tap = 0; tap < n_taps; ++tap) {
            float from = first + ((float)tap - 0.5f);
            float to = from + 1.0f;
            from = low > from ? low : from;
            to = high < to ? high : to;
            reads->shares[tap][n] = to > from ? to - from : 0.0f;
        }
    }
}

/* Adds a mapped part: each pixel takes the light of the stored ones that its sides
 * cover.  n_taps is 2 or 3 for nearly all; the compiler makes a loop for each. */
INLINE void add_mapped_taps(const float *texels, int stride, reach stored, const float *map,
                            float weight, reach box, int n_taps, float *to) {
    float half_x = 0.5f * fabsf(map[0]);
    float half_y = 0.5f * fabsf(map[3]);
    int width = reach_width(box);
    row_reads across, along;
    for (int y = -box.up; y <= box.down; ++y, to += 4 * width) {
        float x = (float)-box.left;
        find_covered(map[0] * x + map[1] * (float)y, map[0], half_x, width, n_taps,
                     -stored.left - n_taps, stored.right + 1, &across);
        find_covered(map[2] * x + map[3] * (float)y, map[2], half_y, width, n_taps,
                     -stored.up - n_taps, stored.down + 1, &along);
        for (int n = 0; n < width; ++n) {
            const float *from = texels + 4 * ((ptrdiff_t)(along.first[n] + stored.up) * stride
                                              + across.first[n] + stored.left);
            f32x4 sum = all4(0.0f);
            for (int j = 0; j < n_taps; ++j, from += 4 * stride) {
                f32x4 line = load4(from) * all4(across.shares[0][n]);
                for (int i = 1; i < n_taps; ++i)
                    line += load4(from + 4 * i) * all4(across.shares[i][n]);
                sum += line * all4(along.shares[j][n]);
            }
            store4(to + 4 * n, load4(to + 4 * n) + sum * all4(weight));
        }
    }
}

static void add_mapped(const frame *f, const recipe_image *image, const double *map,
                       float weight, reach box, float *to) {
    const float *texels = f->recipe_texels + 4 * image->first_texel;
    reach stored = read_reach(image->reach_px);
    float own[4] = {(float)map[0], (float)map[1], (float)map[2], (float)map[3]};
    float side = larger_float(fabsf(own[0]), fabsf(own[3]));
    int n_taps = (int)floorf(side) + 2;
    if (side <= 1.0f) n_taps = 2;
    if (n_taps == 2) add_mapped_taps(texels, image->stride, stored, own, weight, box, 2, to);
    else if (n_taps == 3)
        add_mapped_taps(texels, image->stride, stored, own, weight, box, 3, to);
    else
        add_mapped_taps(texels, image->stride, stored, own, weight, box,
                        smaller_int(n_taps, MOST_TAPS), to);
}

static void add_unmoved(const frame *f, const recipe_image *image, float weight, reach box,
                        float *to) {
    reach stored = read_reach(image->reach_px);
    const float *from = f->recipe_texels + 4 * image->first_texel;
    int width = reach_width(box);
    int count = 4 * reach_width(stored);
    to += 4 * ((box.up - stored.up) * width + box.left - stored.left);
    for (int y = 0; y < reach_height(stored); ++y, to += 4 * width, from += 4 * image->stride)
        for (int x = 0; x < count; x += 4)
            store4(to + x, load4(to + x) + load4(from + x) * all4(weight));
}

static float largest_of(const float *texels, size_t count) {
    f32x4 most = all4(0.0f);
    for (size_t i = 0; i < count; ++i) most = larger4(load4(texels + 4 * i), most);
    return larger_float(most[0], larger_float(most[1], most[2]));
}

/* Box of a kernel's end: that of its parts, as they are mapped. */
static reach end_box(const frame *f, int kernel, const int *recipes, int r) {
    const double *maps = f->part_maps + 4 * FIELD_CORNERS * (size_t)kernel;
    reach box = {0, 0, 0, 0};
    for (int j = 0; j < FIELD_CORNERS; ++j) {
        if (recipes[j] < 0) continue;
        reach own = read_reach(f->recipe_images[RESOLUTIONS * recipes[j] + r].reach_px);
        box = wider(box, is_unmoved(maps + 4 * j) ? own : mapped_reach(maps + 4 * j, own));
    }
    return box;
}

/* Makes the kernel of a cell at one layer, unless that is what it holds. */
static void make_end(const frame *f, int kernel, int is_far, int r, kernel_end *end) {
    const double *weights = f->part_weights + FIELD_CORNERS * (size_t)kernel;
    const double *maps = f->part_maps + 4 * FIELD_CORNERS * (size_t)kernel;
    int recipes[FIELD_CORNERS];
    kernel_recipes(f, kernel, is_far, recipes);
    if (end->cell == f->kernel_cells[kernel]
        && memcmp(recipes, end->recipes, sizeof recipes) == 0
        && memcmp(maps, end->maps, sizeof end->maps) == 0)
        return;
    end->cell = f->kernel_cells[kernel];
    memcpy(end->recipes, recipes, sizeof recipes);
    memcpy(end->maps, maps, sizeof end->maps);
    reach box = end->box = end_box(f, kernel, recipes, r);
    size_t count = (size_t)reach_width(box) * (size_t)reach_height(box);
    memset(end->texels[0], 0, sizeof(float) * 4 * count);
    for (int j = 0; j < FIELD_CORNERS; ++j) {
        if (recipes[j] < 0) continue;
        const recipe_image *image = f->recipe_images + RESOLUTIONS * recipes[j] + r;
        float weight = (float)weights[j];
        if (is_unmoved(maps + 4 * j)) add_unmoved(f, image, weight, box, end->texels[0]);
        else add_mapped(f, image, maps + 4 * j, weight, box, end->texels[0]);
    }
    end->largest[0] = largest_of(end->texels[0], count);
    end->level_count = 1;
}

/* Sums of the level below over 2 x 2 squares, up to a level. */
static void make_levels(kernel_end *end, int level) {
    for (; end->level_count <= level; ++end->level_count) {
        int step = 1 << (end->level_count - 1);
        int width = reach_width(end->box) + step - 1;
        int height = reach_height(end->box) + step - 1;
        int wide = width + step;
        const float *from = end->texels[end->level_count - 1];
        float *to = end->texels[end->level_count];
        size_t count = (size_t)wide * (size_t)(height + step);
        memset(to, 0, sizeof(float) * 4 * count);
        for (int y = 0; y < height; ++y, from += 4 * width) {
            for (int corner = 0; corner < 4; ++corner) {
                float *row = to + 4 * ((y + step * (corner >> 1)) * wide + step * (corner & 1));
                for (int x = 0; x < 4 * width; x += 4)
                    store4(row + x, load4(row + x) + load4(from + x));
            }
        }
        end->largest[end->level_count] = largest_of(to, count);
    }
}

/* --- kernels as fragments read them --------------------------------------------- */

INLINE int level_extent(int level) { return (1 << level) - 1; }

/* Places the levels of all kernels that fragments use, one behind the other. */
static void place_kernels(frame *f) {
    uint64_t texel = 1;
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
            boxes[r] = wider(end_box(f, k, near, r), end_box(f, k, far, r));
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
            uint64_t texels = (uint64_t)(image->width + 1) * (uint64_t)image->height;
            texel += texels;
            largest = texels > largest ? texels : largest;
        }
    }
    f->kernel_texel_count = texel + 1;
    /* both ends of a kernel at all levels, four floats a texel */
    uint64_t floats = 2 * (MAX_LEVEL + 1) * 4 * (largest + 64);
    if (floats > f->blend_scratch_floats) f->blend_scratch_floats = floats;
}

/* One texel of four as steps of 15 bits. */
INLINE i32x4 steps_of(f32x4 texel, f32x4 per_light) {
    return __builtin_convertvector(texel * per_light + all4(0.5f), i32x4);
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
    for (int x = 0; x < width; ++x) {
        i32x4 steps = steps_of(load4(from + 4 * x), per_light);
        i32x4 texel;
        memcpy(&texel, to + 4 * x, sizeof texel);
        texel |= is_far ? steps << 16 : steps;
        memcpy(to + 4 * x, &texel, sizeof texel);
    }
}

/* Writes a kernel's level, which is level `own` of its resolution. */
static void write_level(const frame *f, level_image *image, int own, kernel_end *const *ends) {
    float near = ends[0]->largest[own];
    float far = ends[1]->largest[own];
    float most = larger_float(larger_float(near, far), 1e-30f);
    /* A coarse pixel sends the light of as many pixels as it is then spread over. */
    image->scale = most / (STEPS_15_BITS * STEPS_15_BITS);
    image->near_ratio = STEPS_15_BITS * near / most;
    image->far_ratio = STEPS_15_BITS * far / most;
    f32x4 near_steps = all4(near > 0.0f ? STEPS_15_BITS / near : 0.0f);
    f32x4 far_steps = all4(far > 0.0f ? STEPS_15_BITS / far : 0.0f);
    uint32_t *row = f->kernel_texels + 4 * (size_t)image->first_texel;
    memset(row - 4, 0, 16);
    for (int y = 0; y < image->height; ++y, row += 4 * (image->width + 1)) {
        memset(row, 0, 16 * (size_t)(image->width + 1));
        write_row(ends[0], own, y, image, 0, near_steps, row);
        write_row(ends[1], own, y, image, 1, far_steps, row);
    }
}

#define KERNELS_AN_ITEM 8

/* Some kernels in one resolution, of one cell after the other: what is the far end of one
 * is mostly the near end of the next. */
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

/* Item of the second loop: some kernels in all resolutions. */
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

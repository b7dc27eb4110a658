/* Pixels to fragments: squares of 2, 4 and 8 alike where the blur hides the difference,
 * block by block.  Twin: merge_fragments.comp.glsl. */

#include <math.h>

#include "color.h"
#include "frame.h"
#include "vectors.h"

#define BLOCK_PIXELS (TILE_SIZE_PX * TILE_SIZE_PX)

/* The square that starts at a pixel of a block. */
typedef struct {
    f32x4 mean, low, high;    /* linear RGB, dpt */
    float place, nearest, farthest;  /* positions in layers */
    float spread_px;          /* least */
    uint8_t is_edge;
} square;

/* A block on its way: its pixels, and the squares that are left. */
typedef struct {
    const frame *f;
    int surface, x0, y0;      /* first pixel */
    square squares[BLOCK_PIXELS];
    uint32_t kernel[BLOCK_PIXELS];
    int8_t level[BLOCK_PIXELS];      /* -1: part of another, or nothing */
} block;

INLINE f32x4 pixel_color(const frame *f, int surface, size_t pixel) {
    size_t first = 3 * pixel;
    if (f->color_kind == COLOR_SRGB8) {
        const uint8_t *bytes = (const uint8_t *)f->color[surface] + first;
        return (f32x4){linear_of_byte[bytes[0]], linear_of_byte[bytes[1]],
                       linear_of_byte[bytes[2]], 0.0f};
    }
    float rgb[RGB];
    if (f->color_kind == COLOR_LINEAR) {
        memcpy(rgb, (const float *)f->color[surface] + first, sizeof rgb);
    } else {
        const uint16_t *halves = (const uint16_t *)f->color[surface] + first;
        for (int c = 0; c < RGB; ++c) rgb[c] = float_of_half(halves[c]);
    }
    for (int c = 0; c < RGB; ++c)
        if (!isfinite(rgb[c])) rgb[c] = 0.0f;
    return (f32x4){rgb[0], rgb[1], rgb[2], 0.0f};
}

/* Whether a neighbour lies on another surface, seen through this pupil. */
INLINE int is_edge_pixel(const frame *f, const float *dpt, int x, int y) {
    float limit = DISCONTINUITY_PX;
    float own = dpt[0];
    int edge = 0;
    if (x + 1 < f->width) edge |= fabsf(dpt[1] - own) * f->blur_px_per_dpt > limit;
    if (x > 0) edge |= fabsf(dpt[-1] - own) * f->blur_px_per_dpt > limit;
    if (y + 1 < f->height) edge |= fabsf(dpt[f->width] - own) * f->blur_px_per_dpt > limit;
    if (y > 0) edge |= fabsf(dpt[-f->width] - own) * f->blur_px_per_dpt > limit;
    return edge;
}

INLINE int cell_of(const frame *f, int x, int y) {
    if (f->cell_px == 0) return 0;
    int column = clamped_int(x - f->border_px, 0, f->image_width - 1) / f->cell_px;
    int row = clamped_int(y - f->border_px, 0, f->image_height - 1) / f->cell_px;
    return row * f->cell_columns + column;
}

/* Reads a block's pixels as squares of one; returns the highest level any may reach. */
INLINE int read_block(block *b) {
    const frame *f = b->f;
    size_t pixels = (size_t)f->width * (size_t)f->height;
    int highest = 0;
    for (int i = 0; i < BLOCK_PIXELS; ++i) {
        int x = b->x0 + i % TILE_SIZE_PX;
        int y = b->y0 + i / TILE_SIZE_PX;
        b->level[i] = -1;
        if (x >= f->width || y >= f->height) continue;
        size_t own = (size_t)y * (size_t)f->width + (size_t)x;
        size_t pixel = (size_t)b->surface * pixels + own;
        float dpt = f->dpt[pixel];
        if (dpt < 0.0f) continue;
        float place = f->position[pixel];
        int interval = position_interval(f, place);
        uint32_t kernel = f->kernel_of[cell_of(f, x, y) * f->interval_count + interval];
        const kernel_shape *shape = f->shapes + kernel;
        square *s = b->squares + i;
        s->mean = pixel_color(f, b->surface, own);
        s->mean[3] = dpt;
        s->low = s->high = s->mean;
        s->place = s->nearest = s->farthest = place;
        s->spread_px = shape->spread_px[0]
                     + (place - (float)interval) * (shape->spread_px[1] - shape->spread_px[0]);
        s->is_edge = b->surface != 0 || is_edge_pixel(f, f->dpt + pixel, x, y);
        b->kernel[i] = kernel;
        b->level[i] = 0;
        if (shape->highest_level > highest) highest = shape->highest_level;
    }
    return highest;
}

/* Kernel at the mean position of a square. */
INLINE uint32_t kernel_at(const block *b, int i, float place) {
    const frame *f = b->f;
    int cell = cell_of(f, b->x0 + i % TILE_SIZE_PX, b->y0 + i / TILE_SIZE_PX);
    return f->kernel_of[cell * f->interval_count + position_interval(f, place)];
}

/* Whether a square of four of the level below may be one fragment.  Seen from a blur of
 * half the size, a square of the next level looks the same: so does its error. */
INLINE int is_similar(const frame *f, const square *s, uint32_t kernel, int level) {
    float spread = s->spread_px / (float)(1 << (level - 1));
    if (spread < MERGE_MIN_SPREAD_PX) return 0;
    f32x4 contrast = s->high - s->low;
    float largest = fmaxf(contrast[0], fmaxf(contrast[1], contrast[2]));
    float blur_step = fmaxf(MERGE_MAX_BLUR_STEP_PX, MERGE_MAX_BLUR_RATIO * s->spread_px);
    float most = f->white_level * MERGE_CONTRAST * spread * __builtin_sqrtf(spread);
    /* What is brighter than white would show how coarse pixels are. */
    float brightest = fmaxf(s->high[0], fmaxf(s->high[1], s->high[2]));
    if (brightest > f->white_level && resolution_of(f, f->shapes + kernel, level)) return 0;
    return largest <= f->tolerance * most
        && floorf(s->farthest) - floorf(s->nearest) <= 1.0f
        && contrast[3] * f->blur_px_per_dpt <= f->tolerance * blur_step
        && f->shapes[kernel].highest_level >= level;
}

/* Merges four squares of the level below, the first of which starts at pixel i. */
INLINE void merge_four(block *b, int i, int level) {
    int side = 1 << (level - 1);
    int members[4] = {i, i + side, i + side * TILE_SIZE_PX, i + side * (TILE_SIZE_PX + 1)};
    for (int m = 0; m < 4; ++m)
        if (b->level[members[m]] != level - 1) return;
    square all = b->squares[i];
    for (int m = 1; m < 4; ++m) {
        const square *s = b->squares + members[m];
        all.mean += s->mean;
        all.low = smaller4(s->low, all.low);
        all.high = larger4(s->high, all.high);
        all.place += s->place;
        all.nearest = fminf(all.nearest, s->nearest);
        all.farthest = fmaxf(all.farthest, s->farthest);
        all.spread_px = fminf(all.spread_px, s->spread_px);
        all.is_edge |= s->is_edge;
    }
    all.mean *= 0.25f;
    all.place *= 0.25f;
    uint32_t kernel = kernel_at(b, i, all.place);
    if (!is_similar(b->f, &all, kernel, level)) return;
    b->squares[i] = all;
    b->kernel[i] = kernel;
    b->level[i] = (int8_t)level;
    for (int m = 1; m < 4; ++m) b->level[members[m]] = -1;
}

/* Smaller is nearer. */
INLINE float sort_depth(const frame *f, int x, int y, float dpt) {
    if (!f->paper_rule) return -dpt;
    float distance_m = dpt > 0.0f ? fminf(1.0f / dpt, PAPER_FAR_M) : PAPER_FAR_M;
    float n_pixels = (float)((int64_t)f->width * f->height);
    float scan = (float)((int64_t)y * f->width + x) / n_pixels;
    return distance_m + PAPER_TIE_BREAK_M * scan;
}

INLINE void write_fragment(const block *b, int i, fragment *to) {
    const frame *f = b->f;
    const square *s = b->squares + i;
    int x = b->x0 + i % TILE_SIZE_PX;
    int y = b->y0 + i / TILE_SIZE_PX;
    kernel_shape *shape = f->shapes + b->kernel[i];
    float fraction = s->place - (float)position_interval(f, s->place);
    for (int c = 0; c < RGB; ++c) to->rgb[c] = s->mean[c];
    to->depth = sort_depth(f, x, y, s->mean[3]);
    to->x = (uint16_t)x;
    to->y = (uint16_t)y;
    to->state = b->kernel[i] | (uint32_t)b->level[i] << LEVEL_SHIFT
              | (s->is_edge ? EDGE_BIT : 0u);
    to->fraction = (uint16_t)(fraction * 65535.0f + 0.5f);
    /* coarse light is spread over half a pixel of its own, and over one between middles */
    int r = resolution_of(f, shape, b->level[i]);
    int beyond = r ? 2 << r : 0;
    to->radius_px = (uint16_t)(shape->radius_px + beyond);
    for (int side = 0; side < 4; ++side)
        to->reach_px[side] = (uint8_t)smaller_int(shape->reach_px[side] + beyond, 255);
    uint8_t used = (uint8_t)(1 << b->level[i]);
    if (!(__atomic_load_n(&shape->levels_used, __ATOMIC_RELAXED) & used))
        __atomic_fetch_or(&shape->levels_used, used, __ATOMIC_RELAXED);
}

INLINE void take_in_box(block_info *info, const fragment *one, int extent) {
    int x0 = one->x - one->reach_px[0];
    int x1 = one->x + one->reach_px[1] + extent;
    int y0 = one->y - one->reach_px[2];
    int y1 = one->y + one->reach_px[3] + extent;
    info->x0 = (int16_t)(x0 < info->x0 ? x0 : info->x0);
    info->y0 = (int16_t)(y0 < info->y0 ? y0 : info->y0);
    info->x1 = (int16_t)(x1 > info->x1 ? x1 : info->x1);
    info->y1 = (int16_t)(y1 > info->y1 ? y1 : info->y1);
    float reach = (float)one->radius_px + 0.5f;
    info->reach_px = reach > info->reach_px ? reach : info->reach_px;
}

/* Whether an edge of what is seen is so close that light from a hidden block may pass. */
static int edge_in_reach(const frame *f, int column, int row) {
    int search = 2 * ((int)f->largest_reach_px / TILE_SIZE_PX + 1);
    int left = clamped_int(column - search, 0, f->block_columns);
    int right = clamped_int(column + search + 1, 0, f->block_columns);
    int top = clamped_int(row - search, 0, f->block_rows);
    int bottom = clamped_int(row + search + 1, 0, f->block_rows);
    for (int y = top; y < bottom; ++y) {
        for (int x = left; x < right; ++x) {
            const block_info *seen = f->blocks + y * f->block_columns + x;
            if (!seen->has_edge) continue;
            float reach = seen->reach_px + f->largest_reach_px;
            int gap_x = clamped_int(abs(x - column) * TILE_SIZE_PX - TILE_SIZE_PX + 1, 0, 1 << 15);
            int gap_y = clamped_int(abs(y - row) * TILE_SIZE_PX - TILE_SIZE_PX + 1, 0, 1 << 15);
            if ((float)(gap_x * gap_x + gap_y * gap_y) <= reach * reach) return 1;
        }
    }
    return 0;
}

static void merge_block(frame *f, int surface, int column, int row) {
    int index = (surface * f->block_rows + row) * f->block_columns + column;
    block_info info = {.x0 = INT16_MAX, .y0 = INT16_MAX, .x1 = INT16_MIN, .y1 = INT16_MIN};
    block b; /* not cleared: 6 KB */
    b.f = f;
    b.surface = surface;
    b.x0 = column * TILE_SIZE_PX;
    b.y0 = row * TILE_SIZE_PX;
    if (surface == 0 || edge_in_reach(f, column, row)) {
        int highest = read_block(&b);
        highest = highest < f->max_level ? highest : f->max_level;
        for (int level = 1; level <= highest; ++level)
            for (int y = 0; y < TILE_SIZE_PX; y += 1 << level)
                for (int x = 0; x < TILE_SIZE_PX; x += 1 << level)
                    merge_four(&b, y * TILE_SIZE_PX + x, level);
        fragment *out = f->fragments + (size_t)index * BLOCK_PIXELS;
        for (int i = 0; i < BLOCK_PIXELS; ++i) {
            if (b.level[i] < 0) continue;
            write_fragment(&b, i, out + info.count);
            take_in_box(&info, out + info.count, (1 << b.level[i]) - 1);
            info.has_edge |= b.squares[i].is_edge;
            if (b.level[i] > 0) info.merged = (uint16_t)(info.merged + (1 << 2 * b.level[i]));
            ++info.count;
        }
    }
    f->blocks[index] = info;
}

typedef struct {
    frame *f;
    int surface;
} merge_job;

/* One row of blocks. */
static void merge_row(void *argument, int row, int thread) {
    merge_job *job = argument;
    (void)thread;
    frame *f = job->f;
    int64_t count = 0;
    int64_t merged = 0;
    for (int column = 0; column < f->block_columns; ++column) {
        merge_block(f, job->surface, column, row);
        const block_info *info =
            f->blocks + (job->surface * f->block_rows + row) * f->block_columns + column;
        count += info->count;
        merged += info->merged;
    }
    __atomic_fetch_add(&f->fragment_count, count, __ATOMIC_RELAXED);
    __atomic_fetch_add(&f->merged_count, merged, __ATOMIC_RELAXED);
}

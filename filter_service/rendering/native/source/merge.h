/* Pixels to fragments: squares of 2, 4 and 8 alike where the blur hides the difference,
 * block by block.  Twin: merge_fragments.comp.glsl. */

#include <math.h>

#include "color.h"
#include "frame.h"
#include "vectors.h"

#define BLOCK_PIXELS (TILE_SIZE_PX * TILE_SIZE_PX)

#define QUADS_ACROSS (TILE_SIZE_PX / 2)
#define QUADS (QUADS_ACROSS * QUADS_ACROSS)

/* A merged square; it starts at a quad of pixels. */
typedef struct {
    f32x4 mean, low, high;    /* linear RGB, dpt */
    float place, nearest, farthest;  /* positions in layers */
    float spread_px;          /* least */
    uint32_t kernel;
    int is_edge;
} square;

/* A block on its way: its pixels, and the squares that are left. */
typedef struct {
    const frame *f;
    int surface, x0, y0;      /* first pixel */
    f32x4 color[BLOCK_PIXELS];       /* linear RGB, dpt */
    float place[BLOCK_PIXELS];
    float spread_px[BLOCK_PIXELS];
    uint32_t kernel[BLOCK_PIXELS];
    uint8_t is_edge[BLOCK_PIXELS];
    int8_t level[BLOCK_PIXELS];      /* -1: part of another, or nothing */
    square squares[QUADS];
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

/* Notes which pixels have a neighbour on another surface, seen through this pupil. */
INLINE void find_edges(block *b) {
    const frame *f = b->f;
    enum { SIDE = TILE_SIZE_PX + 2 };
    float dpt[SIDE][SIDE];    /* with those around; beyond the frame as at its edge */
    for (int y = 0; y < SIDE; ++y) {
        int row = clamped_int(b->y0 + y - 1, 0, f->height - 1);
        const float *from = f->dpt + (size_t)row * (size_t)f->width;
        if (b->x0 > 0 && b->x0 + TILE_SIZE_PX < f->width)
            memcpy(dpt[y], from + b->x0 - 1, sizeof dpt[y]);
        else
            for (int x = 0; x < SIDE; ++x)
                dpt[y][x] = from[clamped_int(b->x0 + x - 1, 0, f->width - 1)];
    }
    float limit = DISCONTINUITY_PX;
    for (int y = 1; y <= TILE_SIZE_PX; ++y) {
        for (int x = 1; x <= TILE_SIZE_PX; ++x) {
            float own = dpt[y][x];
            float across = larger_float(fabsf(dpt[y][x - 1] - own), fabsf(dpt[y][x + 1] - own));
            float along = larger_float(fabsf(dpt[y - 1][x] - own), fabsf(dpt[y + 1][x] - own));
            float most = larger_float(across, along) * f->blur_px_per_dpt;
            b->is_edge[(y - 1) * TILE_SIZE_PX + x - 1] = most > limit;
        }
    }
}

INLINE int cell_row(const frame *f, int y) {
    if (f->cell_px == 0) return 0;
    int place = clamped_int(y - f->border_px, 0, f->image_height - 1);
    return (place >> __builtin_ctz((unsigned)f->cell_px)) * f->cell_columns;
}

INLINE int cell_column(const frame *f, int x) { return f->cell_px ? f->column_cell[x] : 0; }

/* Reads a block's pixels; returns the highest level that any may merge to. */
INLINE int read_block(block *b) {
    const frame *f = b->f;
    size_t pixels = (size_t)f->width * (size_t)f->height;
    int highest = 0;
    if (b->surface == 0) find_edges(b);
    else memset(b->is_edge, 1, sizeof b->is_edge);
    memset(b->level, -1, sizeof b->level);
    int width = smaller_int(f->width - b->x0, TILE_SIZE_PX);
    int height = smaller_int(f->height - b->y0, TILE_SIZE_PX);
    for (int y = 0; y < height; ++y) {
        size_t first = (size_t)(b->y0 + y) * (size_t)f->width + (size_t)b->x0;
        const float *dpt = f->dpt + (size_t)b->surface * pixels + first;
        const float *place = f->position + (size_t)b->surface * pixels + first;
        int row = cell_row(f, b->y0 + y);
        for (int x = 0; x < width; ++x) {
            if (dpt[x] < 0.0f) continue;
            int i = y * TILE_SIZE_PX + x;
            int interval = position_interval(f, place[x]);
            int cell = row + cell_column(f, b->x0 + x);
            uint32_t kernel = f->kernel_of[cell * f->interval_count + interval];
            const kernel_shape *shape = f->shapes + kernel;
            float spread = shape->spread_px[1] - shape->spread_px[0];
            b->color[i] = pixel_color(f, b->surface, first + (size_t)x);
            b->color[i][3] = dpt[x];
            b->place[i] = place[x];
            b->spread_px[i] = shape->spread_px[0] + (place[x] - (float)interval) * spread;
            b->kernel[i] = kernel;
            b->level[i] = 0;
            if (shape->highest_level > highest) highest = shape->highest_level;
        }
    }
    return highest;
}

/* Kernel at the mean position of a square that starts at pixel i. */
INLINE uint32_t kernel_at(const block *b, int i, float place) {
    const frame *f = b->f;
    int cell = cell_row(f, b->y0 + i / TILE_SIZE_PX) + cell_column(f, b->x0 + i % TILE_SIZE_PX);
    return f->kernel_of[cell * f->interval_count + position_interval(f, place)];
}

/* Whether a square of four of the level below may be one fragment.  Seen from a blur of
 * half the size, a square of the next level looks the same: so does its error. */
INLINE int is_similar(const frame *f, const square *s, int level) {
    float spread = s->spread_px / (float)(1 << (level - 1));
    if (spread < MERGE_MIN_SPREAD_PX) return 0;
    f32x4 contrast = s->high - s->low;
    float largest = larger_float(contrast[0], larger_float(contrast[1], contrast[2]));
    float most = f->white_level * MERGE_CONTRAST * spread * __builtin_sqrtf(spread);
    if (largest > f->tolerance * most) return 0;
    float blur_step = larger_float(MERGE_MAX_BLUR_STEP_PX, MERGE_MAX_BLUR_RATIO * s->spread_px);
    if (contrast[3] * f->blur_px_per_dpt > f->tolerance * blur_step) return 0;
    if (__builtin_floorf(s->farthest) - __builtin_floorf(s->nearest) > 1.0f) return 0;
    const kernel_shape *shape = f->shapes + s->kernel;
    if (shape->highest_level < level) return 0;
    /* What is brighter than white would show how coarse pixels are. */
    float brightest = larger_float(s->high[0], larger_float(s->high[1], s->high[2]));
    return brightest <= f->white_level || resolution_of(f, shape, level) == 0;
}

INLINE void keep_square(block *b, const square *all, int i, int side, int level) {
    b->level[i] = (int8_t)level;
    b->level[i + side] = -1;
    b->level[i + side * TILE_SIZE_PX] = -1;
    b->level[i + side * (TILE_SIZE_PX + 1)] = -1;
    b->squares[i / TILE_SIZE_PX / 2 * QUADS_ACROSS + i % TILE_SIZE_PX / 2] = *all;
}

/* Merges the four pixels of a quad, the first of which is pixel i. */
INLINE void merge_pixels(block *b, int i) {
    int members[4] = {i, i + 1, i + TILE_SIZE_PX, i + TILE_SIZE_PX + 1};
    if ((b->level[members[0]] | b->level[members[1]] | b->level[members[2]]
         | b->level[members[3]]) != 0)
        return;
    float spread = b->spread_px[i];
    for (int m = 1; m < 4; ++m) spread = smaller_float(spread, b->spread_px[members[m]]);
    if (spread < MERGE_MIN_SPREAD_PX) return;
    square all = {.mean = b->color[i], .low = b->color[i], .high = b->color[i],
                  .place = b->place[i], .nearest = b->place[i], .farthest = b->place[i],
                  .spread_px = spread, .is_edge = b->is_edge[i]};
    for (int m = 1; m < 4; ++m) {
        int at = members[m];
        all.mean += b->color[at];
        all.low = smaller4(b->color[at], all.low);
        all.high = larger4(b->color[at], all.high);
        all.place += b->place[at];
        all.nearest = smaller_float(all.nearest, b->place[at]);
        all.farthest = larger_float(all.farthest, b->place[at]);
        all.is_edge |= b->is_edge[at];
    }
    all.mean *= 0.25f;
    all.place *= 0.25f;
    all.kernel = kernel_at(b, i, all.place);
    if (is_similar(b->f, &all, 1)) keep_square(b, &all, i, 1, 1);
}

INLINE const square *square_at(const block *b, int i) {
    return b->squares + i / TILE_SIZE_PX / 2 * QUADS_ACROSS + i % TILE_SIZE_PX / 2;
}

/* Merges four squares of the level below, the first of which starts at pixel i. */
INLINE void merge_squares(block *b, int i, int level) {
    int side = 1 << (level - 1);
    int members[4] = {i, i + side, i + side * TILE_SIZE_PX, i + side * (TILE_SIZE_PX + 1)};
    for (int m = 0; m < 4; ++m)
        if (b->level[members[m]] != level - 1) return;
    square all = *square_at(b, i);
    for (int m = 1; m < 4; ++m) {
        const square *s = square_at(b, members[m]);
        all.mean += s->mean;
        all.low = smaller4(s->low, all.low);
        all.high = larger4(s->high, all.high);
        all.place += s->place;
        all.nearest = smaller_float(all.nearest, s->nearest);
        all.farthest = larger_float(all.farthest, s->farthest);
        all.spread_px = smaller_float(all.spread_px, s->spread_px);
        all.is_edge |= s->is_edge;
    }
    all.mean *= 0.25f;
    all.place *= 0.25f;
    all.kernel = kernel_at(b, i, all.place);
    if (is_similar(b->f, &all, level)) keep_square(b, &all, i, side, level);
}

/* Smaller is nearer. */
INLINE float sort_depth(const frame *f, int x, int y, float dpt) {
    if (!f->paper_rule) return -dpt;
    float distance_m = dpt > 0.0f ? fminf(1.0f / dpt, PAPER_FAR_M) : PAPER_FAR_M;
    float n_pixels = (float)((int64_t)f->width * f->height);
    float scan = (float)((int64_t)y * f->width + x) / n_pixels;
    return distance_m + PAPER_TIE_BREAK_M * scan;
}

/* Coarse light is spread over half a pixel of its own, and over one between middles. */
INLINE int spread_beyond(int resolution) { return resolution ? 2 << resolution : 0; }

INLINE void write_box(const frame *f, uint32_t at, reach r, int beyond, int extent) {
    int x = f->fragments[at].x, y = f->fragments[at].y;
    f->boxes[BOX_LEFT][at] = (int16_t)(x - r.left - beyond);
    f->boxes[BOX_RIGHT][at] = (int16_t)(x + r.right + beyond + extent);
    f->boxes[BOX_TOP][at] = (int16_t)(y - r.up - beyond);
    f->boxes[BOX_BOTTOM][at] = (int16_t)(y + r.down + beyond + extent);
}

/* Writes pixel i of a block, or the square that starts there, as fragment `at`. */
INLINE void write_fragment(const block *b, int i, uint32_t at) {
    const frame *f = b->f;
    int level = b->level[i];
    const square *s = square_at(b, i);
    f32x4 color = level ? s->mean : b->color[i];
    float place = level ? s->place : b->place[i];
    uint32_t kernel = level ? s->kernel : b->kernel[i];
    int is_edge = level ? s->is_edge : b->is_edge[i];
    int x = b->x0 + i % TILE_SIZE_PX;
    int y = b->y0 + i / TILE_SIZE_PX;
    kernel_shape *shape = f->shapes + kernel;
    float fraction = place - (float)position_interval(f, place);
    int beyond = level > 1 ? spread_beyond(resolution_of(f, shape, level)) : 0;
    float depth = sort_depth(f, x, y, color[3]);
    uint32_t state = kernel | (uint32_t)level << LEVEL_SHIFT | (is_edge ? EDGE_BIT : 0u);
    f->lights[at] = (fragment_light){{color[0], color[1], color[2]}, depth};
    f->fragments[at] = (fragment){(uint16_t)x, (uint16_t)y, state,
                                  (uint16_t)(fraction * 65535.0f + 0.5f),
                                  (uint16_t)(shape->radius_px + beyond)};
    write_box(f, at, read_reach(shape->reach_px), beyond, (1 << level) - 1);
    uint8_t used = (uint8_t)(1 << level);
    if (!(__atomic_load_n(&shape->levels_used, __ATOMIC_RELAXED) & used))
        __atomic_fetch_or(&shape->levels_used, used, __ATOMIC_RELAXED);
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
            float farthest = (float)seen->radius_px + 0.5f + f->largest_reach_px;
            int gap_x = clamped_int(abs(x - column) * TILE_SIZE_PX - TILE_SIZE_PX + 1, 0, 1 << 15);
            int gap_y = clamped_int(abs(y - row) * TILE_SIZE_PX - TILE_SIZE_PX + 1, 0, 1 << 15);
            if ((float)(gap_x * gap_x + gap_y * gap_y) <= farthest * farthest) return 1;
        }
    }
    return 0;
}

/* Writes what is left of a block, in scan order. */
static void write_block(const block *b, block_info *info) {
    for (int i = 0; i < BLOCK_PIXELS; ++i) {
        int level = b->level[i];
        if (level < 0) continue;
        write_fragment(b, i, info->end);
        const fragment *one = b->f->fragments + info->end++;
        if (one->radius_px > info->radius_px) info->radius_px = one->radius_px;
        info->has_edge |= (one->state & EDGE_BIT) != 0;
        if (level > 0) info->merged = (uint8_t)(info->merged + (1 << 2 * level));
    }
}

/* Writes the fragments of a block from place `first` on. */
static block_info merge_block(const frame *f, int surface, int column, int row, uint32_t first) {
    block_info info = {first, first, 0, 0, 0};
    block b; /* not cleared: 6 KB */
    b.f = f;
    b.surface = surface;
    b.x0 = column * TILE_SIZE_PX;
    b.y0 = row * TILE_SIZE_PX;
    if (surface == 0 || edge_in_reach(f, column, row)) {
        int highest = smaller_int(read_block(&b), f->max_level);
        for (int level = 1; level <= highest; ++level)
            for (int y = 0; y < TILE_SIZE_PX; y += 1 << level)
                for (int x = 0; x < TILE_SIZE_PX; x += 1 << level) {
                    if (level == 1) merge_pixels(&b, y * TILE_SIZE_PX + x);
                    else merge_squares(&b, y * TILE_SIZE_PX + x, level);
                }
        write_block(&b, &info);
    }
    return info;
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
    int64_t merged = 0;
    int32_t farthest_px = 0;
    int line = (job->surface * f->block_rows + row) * f->block_columns;
    uint32_t first = (uint32_t)line * BLOCK_PIXELS;
    uint32_t at = first;
    for (int column = 0; column < f->block_columns; ++column) {
        block_info *info = f->blocks + line + column;
        *info = merge_block(f, job->surface, column, row, at);
        at = info->end;
        merged += info->merged;
        farthest_px = larger_int(farthest_px, info->radius_px);
    }
    int32_t known_px = __atomic_load_n(&f->farthest_px, __ATOMIC_RELAXED);
    while (farthest_px > known_px)
        if (__atomic_compare_exchange_n(&f->farthest_px, &known_px, farthest_px, 1,
                                        __ATOMIC_RELAXED, __ATOMIC_RELAXED))
            break;
    __atomic_fetch_add(&f->fragment_count, at - first, __ATOMIC_RELAXED);
    __atomic_fetch_add(&f->merged_count, merged, __ATOMIC_RELAXED);
}

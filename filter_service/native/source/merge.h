/* Conversion of pixels to fragments, block by block. */

#include <math.h>

#include "frame.h"
#include "vectors.h"

/* Values of a pixel or square that becomes a fragment. */
typedef struct {
    f32x4 color;              /* linear RGB, dpt */
    float place;
    uint32_t kernel;
    int level, is_edge;
    float strength, coverage; /* as of the fragment's light */
} origin;

/* Mean over the square that starts at a pixel. */
INLINE float square_mean(const float *pixels, int i, int level) {
    float sum = 0.0f;
    for (uint64_t left = square_pixels[level] << i; left; left &= left - 1)
        sum += pixels[__builtin_ctzll(left)];
    return sum / (float)(1 << 2 * level);
}

INLINE origin origin_of(const block *b, const block_squares *all, int i, int level) {
    int is_edge = (b->edges & square_pixels[level] << i) != 0;
    float share = is_edge ? square_mean(b->share, i, level) : 0.0f;
    float strength = b->surface == 0 ? share : 0.0f;
    float coverage = b->surface == 0 ? 1.0f : share;
    if (level == 0)
        return (origin){{b->rgb[0][i], b->rgb[1][i], b->rgb[2][i], b->dpt[i]},
                        b->place[i], b->kernel[i], 0, is_edge, strength, coverage};
    const square_row *s = &all->rows[level - 1][i / TILE_SIZE_PX >> level];
    int lane = i % TILE_SIZE_PX;
    return (origin){{lane_of(&s->mean[0], lane), lane_of(&s->mean[1], lane),
                     lane_of(&s->mean[2], lane), lane_of(&s->dpt, lane)},
                    lane_of(&s->place, lane), all->kernel[i], level, is_edge, strength,
                    coverage};
}

/* Sort depth; smaller is nearer. */
INLINE float sort_depth(const frame *f, int x, int y, float dpt) {
    if (!f->paper_rule) return -dpt;
    float distance_m = dpt > 0.0f ? fminf(1.0f / dpt, PAPER_FAR_M) : PAPER_FAR_M;
    float n_pixels = (float)((int64_t)f->width * f->height);
    float scan = (float)((int64_t)y * f->width + x) / n_pixels;
    return distance_m + PAPER_TIE_BREAK_M * scan;
}

/* Coarse light extends over half a coarse pixel, and over one by interpolation. */
INLINE int spread_beyond(int resolution) { return resolution ? 2 << resolution : 0; }

INLINE void write_box(const frame *f, uint32_t at, reach r, int beyond, int extent) {
    int x = f->fragments[at].x, y = f->fragments[at].y;
    f->boxes[BOX_LEFT][at] = (int16_t)(x - r.left - beyond);
    f->boxes[BOX_RIGHT][at] = (int16_t)(x + r.right + beyond + extent);
    f->boxes[BOX_TOP][at] = (int16_t)(y - r.up - beyond);
    f->boxes[BOX_BOTTOM][at] = (int16_t)(y + r.down + beyond + extent);
}

/* Writes pixel i of a block, or the square that starts there, as fragment `at`. */
INLINE void write_fragment(const block *b, int i, const origin *from, uint32_t at) {
    const frame *f = b->f;
    int level = from->level;
    int x = b->x0 + i % TILE_SIZE_PX;
    int y = b->y0 + i / TILE_SIZE_PX;
    kernel_shape *shape = f->shapes + from->kernel;
    float fraction = from->place - (float)position_interval(f, from->place);
    int beyond = level > 1 ? spread_beyond(resolution_of(f, shape, level)) : 0;
    float depth = sort_depth(f, x, y, from->color[3]);
    f32x4 bright = larger4(from->color - b->bright * all4(from->coverage), all4(0.0f));
    float excess = (bright[0] + bright[1] + bright[2]) * (1.0f / RGB);
    int is_special = excess > 0.0f || from->strength > 0.0f || from->coverage < 1.0f;
    uint32_t state = from->kernel | (uint32_t)level << LEVEL_SHIFT
                     | (from->is_edge ? EDGE_BIT : 0u) | (is_special ? SPECIAL_BIT : 0u);
    f->lights[at] =
        (fragment_light){{from->color[0], from->color[1], from->color[2]}, depth};
    if (is_special) f->extras[at] = (fragment_extra){from->strength, from->coverage, excess};
    f->fragments[at] = (fragment){(uint16_t)x, (uint16_t)y, state,
                                  (uint16_t)(fraction * 65535.0f + 0.5f),
                                  (uint16_t)(shape->radius_px + beyond)};
    write_box(f, at, read_reach(shape->reach_px), beyond, (1 << level) - 1);
    uint8_t used = (uint8_t)(1 << level);
    if (!(__atomic_load_n(&shape->levels_used, __ATOMIC_RELAXED) & used))
        __atomic_fetch_or(&shape->levels_used, used, __ATOMIC_RELAXED);
}

/* Returns whether an edge of the visible surface is so close that light of a hidden block may
 * pass. */
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

/* Writes pixel i of a block as one fragment for each of the cells that it blends. */
INLINE void write_blended(const block *b, int i, const origin *pixel, block_info *info) {
    const frame *f = b->f;
    cell_part parts[FIELD_CORNERS];
    int count = blended_cells(f, b->x0 + i % TILE_SIZE_PX, b->y0 + i / TILE_SIZE_PX, parts);
    int interval = position_interval(f, pixel->place);
    for (int j = 0; j < count; ++j) {
        origin own = *pixel;
        own.kernel = f->kernel_of[parts[j].cell * f->interval_count + interval];
        f->blend_shares[info->end] = parts[j].share;
        write_fragment(b, i, &own, info->end++);
    }
}

/* Removes squares that are part of larger ones; returns the pixels that are part of none. */
INLINE uint64_t largest_squares(const block *b, block_squares *all) {
    uint64_t pixels = b->held;
    for (int level = 1; level <= MAX_LEVEL; ++level) {
        for (uint64_t left = all->merged[level]; left; left &= left - 1) {
            uint64_t part = square_pixels[level] << __builtin_ctzll(left);
            pixels &= ~part;
            for (int below = 1; below < level; ++below) all->merged[below] &= ~part;
        }
    }
    return pixels;
}

INLINE void move_toward(float *value, float mean, float share) {
    *value += share * (mean - *value);
}

/* Moves the pixels and merged squares of a square toward its mean. */
static void fade_square(block *b, block_squares *all, uint64_t pixels, int i, int level) {
    float share = all->fade[level][i];
    square_row *s = &all->rows[level - 1][i / TILE_SIZE_PX >> level];
    int lane = i % TILE_SIZE_PX;
    float dpt = lane_of(&s->dpt, lane), place = lane_of(&s->place, lane);
    uint64_t inside = square_pixels[level] << i;
    for (uint64_t left = pixels & inside; left; left &= left - 1) {
        int at = __builtin_ctzll(left);
        for (int c = 0; c < RGB; ++c)
            move_toward(b->rgb[c] + at, lane_of(&s->mean[c], lane), share);
        move_toward(b->dpt + at, dpt, share);
        move_toward(b->place + at, place, share);
        b->kernel[at] = kernel_at(b, at, b->place[at]);
    }
    for (int below = 1; below < level; ++below)
        for (uint64_t left = all->merged[below] & inside; left; left &= left - 1) {
            int at = __builtin_ctzll(left), own = at % TILE_SIZE_PX;
            square_row *part = &all->rows[below - 1][at / TILE_SIZE_PX >> below];
            for (int c = 0; c < RGB; ++c)
                move_toward((float *)&part->mean[c] + own, lane_of(&s->mean[c], lane), share);
            move_toward((float *)&part->dpt + own, dpt, share);
            move_toward((float *)&part->place + own, place, share);
            all->kernel[at] = kernel_at(b, at, lane_of(&part->place, own));
        }
    if (!(b->edges & inside)) return;
    float mean = square_mean(b->share, i, level);
    for (uint64_t left = inside; left; left &= left - 1)
        move_toward(b->share + __builtin_ctzll(left), mean, share);
    b->edges |= inside;
}

/* Writes the fragments of a block in scan order. */
static void write_block(block *b, block_squares *all, block_info *info) {
    uint64_t pixels = largest_squares(b, all);
    for (int level = 1; level <= MAX_LEVEL; ++level)
        for (uint64_t left = all->fading[level]; left; left &= left - 1)
            fade_square(b, all, pixels, __builtin_ctzll(left), level);
    uint64_t starts = pixels | all->merged[1] | all->merged[2] | all->merged[3];
    for (; starts; starts &= starts - 1) {
        int i = __builtin_ctzll(starts);
        int level = 0;
        while (level < MAX_LEVEL && !((level ? all->merged[level] : pixels) >> i & 1)) ++level;
        origin from = origin_of(b, all, i, level);
        uint32_t first = info->end;
        if (level == 0 && b->f->blend_column != NULL) write_blended(b, i, &from, info);
        else write_fragment(b, i, &from, info->end++);
        for (; first < info->end; ++first) {
            const fragment *one = b->f->fragments + first;
            if (one->radius_px > info->radius_px) info->radius_px = one->radius_px;
            info->has_edge |= (one->state & EDGE_BIT) != 0;
        }
        if (level > 0) info->merged = (uint8_t)(info->merged + (1 << 2 * level));
    }
}

/* Writes the fragments of a block from index `first` on. */
static block_info merge_block(const frame *f, int surface, int column, int row, uint32_t first) {
    block_info info = {first, first, 0, 0, 0};
    block b;                  /* both are 6 KB and not cleared */
    block_squares all;
    if (surface == 0 || edge_in_reach(f, column, row)) {
        read_block(&b, f, surface, column, row);
        merge_squares(&b, smaller_int(b.highest_level, f->max_level), &all);
        write_block(&b, &all, &info);
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
    uint32_t first = (uint32_t)line * (uint32_t)f->block_slots;
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

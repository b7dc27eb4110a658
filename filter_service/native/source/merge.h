/* Conversion of pixels to fragments, block by block. */

#include <math.h>

#include "frame.h"
#include "vectors.h"

/* Values of a pixel or square that becomes a fragment. */
typedef struct {
    f32x4 color;              /* linear RGB, dpt */
    float place;
    int is_edge;
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
                        b->place[i], is_edge, strength, coverage};
    const square_row *s = &all->rows[level - 1][i / TILE_SIZE_PX >> level];
    int lane = i % TILE_SIZE_PX;
    return (origin){{lane_of(&s->mean[0], lane), lane_of(&s->mean[1], lane),
                     lane_of(&s->mean[2], lane), lane_of(&s->dpt, lane)},
                    lane_of(&s->place, lane), is_edge, strength, coverage};
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

/* Box of the pixels that a cluster lights. */
INLINE void write_box(const frame *f, uint32_t at, reach r, int beyond) {
    const cluster *own = f->clusters + at;
    f->boxes[BOX_LEFT][at] = (int16_t)(own->left - r.left - beyond);
    f->boxes[BOX_RIGHT][at] = (int16_t)(own->right + r.right + beyond);
    f->boxes[BOX_TOP][at] = (int16_t)(own->top - r.up - beyond);
    f->boxes[BOX_BOTTOM][at] = (int16_t)(own->bottom + r.down + beyond);
}

/* Part of a block's pixels whose fragments have SPECIAL_BIT, at level 0. */
INLINE uint64_t special_pixels(const block *b) {
    if (b->surface > 0) return ~(uint64_t)0;
    uint64_t bright = 0;
    for (int y = 0; y < TILE_SIZE_PX; ++y) {
        i32x8 any = {0};
        for (int c = 0; c < RGB; ++c)
            any |= load8(b->rgb[c] + y * TILE_SIZE_PX) > all8(b->bright[c]);
        bright |= (uint64_t)bits_of8(any) << (y * TILE_SIZE_PX);
    }
    return bright | b->edges;
}

INLINE uint32_t fraction_of(const frame *f, float place) {
    float fraction = place - (float)position_interval(f, place);
    return (uint32_t)(fraction * 65535.0f + 0.5f);
}

/* Writes a pixel of the visible surface that is not special as fragment `at`; returns its
 * depth. */
INLINE float write_plain(const block *b, int i, uint32_t kernel, uint32_t at) {
    const frame *f = b->f;
    int x = b->x0 + i % TILE_SIZE_PX, y = b->y0 + i / TILE_SIZE_PX;
    float depth = sort_depth(f, x, y, b->dpt[i]);
    f->lights[at] = (fragment_light){{b->rgb[0][i], b->rgb[1][i], b->rgb[2][i]}, depth};
    f->fragments[at] =
        (fragment){(uint16_t)x, (uint16_t)y, kernel, fraction_of(f, b->place[i])};
    return depth;
}

/* Writes pixel i of a block, or the square that starts there, as fragment `at`; returns its
 * depth. */
static float write_fragment(const block *b, const block_squares *all, int i, int level,
                            uint32_t kernel, uint32_t at) {
    const frame *f = b->f;
    int x = b->x0 + i % TILE_SIZE_PX, y = b->y0 + i / TILE_SIZE_PX;
    origin from = origin_of(b, all, i, level);
    float depth = sort_depth(f, x, y, from.color[3]);
    f32x4 bright = larger4(from.color - b->bright * all4(from.coverage), all4(0.0f));
    float excess = (bright[0] + bright[1] + bright[2]) * (1.0f / RGB);
    int is_special = excess > 0.0f || from.strength > 0.0f || from.coverage < 1.0f;
    uint32_t state = kernel | (uint32_t)level << LEVEL_SHIFT | (from.is_edge ? EDGE_BIT : 0u)
                     | (is_special ? SPECIAL_BIT : 0u);
    f->lights[at] = (fragment_light){{from.color[0], from.color[1], from.color[2]}, depth};
    if (is_special) f->extras[at] = (fragment_extra){from.strength, from.coverage, excess};
    f->fragments[at] = (fragment){(uint16_t)x, (uint16_t)y, state, fraction_of(f, from.place)};
    return depth;
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

/* Pixels of a block with a kernel. */
INLINE uint64_t pixels_with(const uint32_t *kernels, uint32_t kernel) {
    int32_t own = (int32_t)kernel;
    i32x8 wanted = {own, own, own, own, own, own, own, own};
    uint64_t found = 0;
    for (int y = 0; y < TILE_SIZE_PX; ++y) {
        i32x8 row;
        memcpy(&row, kernels + y * TILE_SIZE_PX, sizeof row);
        found |= (uint64_t)bits_of8(row == wanted) << (y * TILE_SIZE_PX);
    }
    return found;
}

/* Writes pixels, or squares that start there, with the same kernel and level as a cluster. */
static void write_cluster(block *b, const block_squares *all, int level, uint64_t starts,
                          uint32_t kernel, const float *shares, block_info *info) {
    const frame *f = b->f;
    kernel_shape *shape = f->shapes + kernel;
    cluster *own = f->clusters + info->end_cluster;
    uint64_t special = level > 0 ? ~(uint64_t)0 : b->special;
    uint32_t at = info->end, state = kernel | (uint32_t)level << LEVEL_SHIFT;
    float nearest = INFINITY, farthest = -INFINITY;
    for (uint64_t left = starts; left; left &= left - 1, ++at) {
        int i = __builtin_ctzll(left);
        float depth;
        if (special >> i & 1) {
            depth = write_fragment(b, all, i, level, kernel, at);
            state |= f->fragments[at].state;
        } else {
            depth = write_plain(b, i, kernel, at);
        }
        if (shares != NULL) f->blend_shares[at] = shares[i];
        nearest = smaller_float(depth, nearest);
        farthest = larger_float(depth, farthest);
    }
    uint64_t columns = starts | starts >> 32;
    columns |= columns >> 16;
    columns = (columns | columns >> 8) & 255;
    int extent = (1 << level) - 1;
    int beyond = spread_beyond(resolution_of(f, shape, level));
    *own = (cluster){.first = info->end, .count = at - info->end, .state = state,
                     .nearest = nearest, .farthest = farthest,
                     .left = (uint16_t)(b->x0 + __builtin_ctzll(columns)),
                     .right = (uint16_t)(b->x0 + 63 - __builtin_clzll(columns) + extent),
                     .top = (uint16_t)(b->y0 + __builtin_ctzll(starts) / TILE_SIZE_PX),
                     .bottom = (uint16_t)(b->y0 + (63 - __builtin_clzll(starts)) / TILE_SIZE_PX
                                          + extent),
                     .radius_px = (uint16_t)(shape->radius_px + beyond)};
    write_box(f, info->end_cluster++, read_reach(shape->reach_px), beyond);
    info->end = at;
    info->radius_px = (uint16_t)larger_int(info->radius_px, own->radius_px);
    info->has_edge |= (state & EDGE_BIT) != 0;
    uint8_t used = (uint8_t)(1 << level);
    if (!(__atomic_load_n(&shape->levels_used, __ATOMIC_RELAXED) & used))
        __atomic_fetch_or(&shape->levels_used, used, __ATOMIC_RELAXED);
}

/* Writes pixels, or squares that start there, cluster by cluster. */
static void write_clusters(block *b, const block_squares *all, int level, uint64_t starts,
                           const uint32_t *kernels, const float *shares, block_info *info) {
    while (starts) {
        uint32_t kernel = kernels[__builtin_ctzll(starts)];
        uint64_t same = starts & pixels_with(kernels, kernel);
        write_cluster(b, all, level, same, kernel, shares, info);
        starts &= ~same;
    }
}

/* Writes each pixel as one fragment for each of the cells that it blends. */
static void write_blended(block *b, const block_squares *all, uint64_t starts,
                          block_info *info) {
    const frame *f = b->f;
    uint32_t kernels[FIELD_CORNERS][BLOCK_PIXELS] = {0};
    float shares[FIELD_CORNERS][BLOCK_PIXELS];
    uint64_t read[FIELD_CORNERS] = {0};
    for (uint64_t left = starts; left; left &= left - 1) {
        int i = __builtin_ctzll(left);
        cell_part parts[FIELD_CORNERS];
        int interval = position_interval(f, b->place[i]);
        int count = blended_cells(f, b->x0 + i % TILE_SIZE_PX, b->y0 + i / TILE_SIZE_PX, parts);
        for (int j = 0; j < count; ++j) {
            kernels[j][i] = f->kernel_of[parts[j].cell * f->interval_count + interval];
            shares[j][i] = parts[j].share;
            read[j] |= left & -left;
        }
    }
    for (int j = 0; j < FIELD_CORNERS; ++j)
        write_clusters(b, all, 0, read[j], kernels[j], shares[j], info);
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

/* Writes the fragments of a block, cluster by cluster. */
static void write_block(block *b, block_squares *all, block_info *info) {
    uint64_t pixels = largest_squares(b, all);
    for (int level = 1; level <= MAX_LEVEL; ++level)
        for (uint64_t left = all->fading[level]; left; left &= left - 1)
            fade_square(b, all, pixels, __builtin_ctzll(left), level);
    b->special = special_pixels(b);
    if (b->f->blend_column == NULL) write_clusters(b, all, 0, pixels, b->kernel, NULL, info);
    else write_blended(b, all, pixels, info);
    for (int level = 1; level <= MAX_LEVEL; ++level) {
        write_clusters(b, all, level, all->merged[level], all->kernel, NULL, info);
        info->merged += (uint8_t)(__builtin_popcountll(all->merged[level]) << 2 * level);
    }
}

/* Writes the fragments and clusters of a block behind those of the block before it. */
static block_info merge_block(const frame *f, int surface, int column, int row,
                              const block_info *before) {
    block_info info = {.first = before->end, .end = before->end,
                       .first_cluster = before->end_cluster,
                       .end_cluster = before->end_cluster};
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
    block_info last = {.end = first, .end_cluster = first};
    for (int column = 0; column < f->block_columns; ++column) {
        block_info *info = f->blocks + line + column;
        *info = last = merge_block(f, job->surface, column, row, &last);
        merged += info->merged;
        farthest_px = larger_int(farthest_px, info->radius_px);
    }
    int32_t known_px = __atomic_load_n(&f->farthest_px, __ATOMIC_RELAXED);
    while (farthest_px > known_px)
        if (__atomic_compare_exchange_n(&f->farthest_px, &known_px, farthest_px, 1,
                                        __ATOMIC_RELAXED, __ATOMIC_RELAXED))
            break;
    __atomic_fetch_add(&f->fragment_count, last.end - first, __ATOMIC_RELAXED);
    __atomic_fetch_add(&f->merged_count, merged, __ATOMIC_RELAXED);
}

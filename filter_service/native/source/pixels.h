/* Conversion of each pixel's depth to vergence at the cornea and layer position, and the
 * pairs of cell and layer interval that the frame uses.  Twin: build_fragments.comp.glsl. */

#include <math.h>

#include "frame.h"
#include "vectors.h"

/* Smaller depth is missing; as in rgbd_view.py. */
#define MIN_DEPTH_M 1e-6f

/* Marks a pair as used; reads first, because most pixels find it marked. */
INLINE void note_use(uint8_t *mark) {
    if (!__atomic_load_n(mark, __ATOMIC_RELAXED)) __atomic_store_n(mark, 1, __ATOMIC_RELAXED);
}

INLINE int clamped_int(int value, int low, int high) {
    return value < low ? low : value > high ? high : value;
}

/* Interval of layers that contains a distance, clamped to the first and last; tries that of the
 * previous distance and its neighbors first. */
INLINE int find_interval(const frame *f, float dpt, int at) {
    const float *layers = f->layer_dpt;
    int last = f->layer_count - 2;
    at += at < last && layers[at + 1] <= dpt;
    at -= at > 0 && dpt < layers[at];
    if (layers[at] <= dpt && (at == last || dpt < layers[at + 1])) return at;
    int first = 0;
    while (first < last) {
        int middle = (first + last + 1) / 2;
        if (layers[middle] <= dpt) first = middle;
        else last = middle - 1;
    }
    return first;
}

INLINE int position_interval(const frame *f, float position) {
    int interval = (int)position;
    return interval < f->interval_count - 1 ? interval : f->interval_count - 1;
}

/* Share of a hidden pixel that its distance behind the visible surface lets appear. */
INLINE float hidden_coverage(const frame *f, float seen_dpt, float dpt) {
    float behind_px = (seen_dpt - dpt) * f->blur_px_per_dpt;
    float beyond = behind_px * (1.0f / DISCONTINUITY_PX) - 1.0f;
    return smaller_float(larger_float(beyond, 0.0f), 1.0f);
}

/* Change of defocus over the field at the center of a row, at the edges of its cells. */
INLINE void row_changes(const frame *f, int y, float *change_dpt) {
    int place = clamped_int(y - f->border_px, 0, f->image_height - 1);
    int row = place >> __builtin_ctz((unsigned)f->cell_px);
    float down = ((float)(place - row * f->cell_px) + 0.5f) / (float)f->cell_px;
    const float *above = f->corner_dpt + row * (f->cell_columns + 1);
    const float *below = above + f->cell_columns + 1;
    for (int column = 0; column <= f->cell_columns; ++column)
        change_dpt[column] = above[column] + down * (below[column] - above[column]);
}

/* Cells whose kernels a pixel reads, and their shares; returns their number.  Pixels that
 * blend read the corners of a triangle of cell centers. */
typedef struct {
    int cell;
    float share;
} cell_part;

INLINE int blended_cells(const frame *f, int x, int y, cell_part *parts) {
    int columns = f->cell_columns;
    int first = f->blend_row[y] * columns + f->blend_column[x];
    float across = f->blend_across[x], down = f->blend_down[y];
    float low = smaller_float(across, down), high = larger_float(across, down);
    cell_part corners[FIELD_CORNERS] = {{first, 1.0f - high},
                                        {first + (across >= down ? 1 : columns), high - low},
                                        {first + columns + 1, low}};
    int count = 0;
    for (int j = 0; j < FIELD_CORNERS; ++j)
        if (corners[j].share > 0.0f) parts[count++] = corners[j];
    return count;
}

/* Marks the pairs of a pixel that blends cells. */
INLINE void note_blended(const frame *f, int x, int y, float position) {
    cell_part parts[FIELD_CORNERS];
    int interval = position_interval(f, position);
    for (int j = blended_cells(f, x, y, parts); j-- > 0;)
        note_use(f->used + parts[j].cell * f->interval_count + interval);
}

/* A row of a surface. */
typedef struct {
    const frame *f;
    int y;
    const float *depth_m;
    const float *seen_dpt;          /* of the surface in front of it, if it is hidden */
    const float *change_dpt;        /* at the edges of cells */
    uint8_t *used;                  /* pairs of the first cell */
    float *dpt, *position;
    int interval;                   /* of the previous pixel */
    int noted;                      /* last pair that was marked */
    int64_t clamped, missing;
} pixel_line;

/* Adjacent pixels of one cell, all or none of which are in the image without its border. */
typedef struct { int first, end, column, is_in_image; } pixel_run;

/* Up to eight values; the last one is repeated. */
INLINE f32x8 load_first8(const float *from, int count) {
    if (count >= 8) return load8(from);
    float values[8];
    for (int i = 0; i < 8; ++i) values[i] = from[smaller_int(i, count - 1)];
    return load8(values);
}

INLINE void store_first8(float *to, f32x8 values, int count) {
    if (count >= 8) store8(to, values);
    else memcpy(to, &values, sizeof *to * (size_t)count);
}

INLINE f32x8 chosen8(i32x8 choice, f32x8 yes, f32x8 no) {
    return (f32x8)((choice & (i32x8)yes) | (~choice & (i32x8)no));
}

INLINE f32x8 columns8(int x) {
    float first = (float)x;
    return (f32x8){0.0f, 1.0f, 2.0f, 3.0f, 4.0f, 5.0f, 6.0f, 7.0f} + all8(first);
}

/* Vergences of eight pixels from column x on, not clamped; arbitrary for missing depth. */
INLINE f32x8 vergences8(const frame *f, f32x8 depth_m, int x, float along, float across) {
    if (f->depth_is_planar) {
        f32x8 tx = all8(f->tangents[0]) + (columns8(x) + all8(0.5f)) * all8(across);
        depth_m *= root8(all8(along) + tx * tx);
    }
    f32x8 kept_m = larger8(depth_m, all8(NEAREST_M));
    return all8(f->vergence_scale) / (kept_m + all8(f->vergence_offset_m));
}

INLINE void note_pair(pixel_line *line, int column, int interval) {
    int pair = column * line->f->interval_count + interval;
    if (pair != line->noted) note_use(line->used + pair);
    line->noted = pair;
}

/* Layer positions of eight pixels of a cell, whose pairs it marks; `open` is a bit mask of the
 * pixels that hold something.  One interval after the other: mostly, all are in the same. */
INLINE f32x8 positions8(pixel_line *line, f32x8 dpt, uint32_t open, int column) {
    const frame *f = line->f;
    int last = f->layer_count - 2, blends = f->blend_column != NULL;
    f32x8 position = all8(0.0f);
    if (last < 0 && open && !blends) note_pair(line, column, 0);
    if (last < 0) return position;
    for (uint32_t found = 0; open; found = open & -open) {
        if (found) line->interval = find_interval(f, dpt[__builtin_ctz(open)], line->interval);
        int at = line->interval;
        f32x8 low = all8(f->layer_dpt[at]);
        i32x8 within = dpt < all8(at < last ? f->layer_dpt[at + 1] : INFINITY);
        if (at > 0) within &= dpt >= low;
        uint32_t own = (bits_of8(within) & open) | found;
        if (!own) continue;
        open &= ~own;
        f32x8 share = (dpt - low) * all8(f->layer_per_dpt[at]);
        share = smaller8(larger8(share, all8(0.0f)), all8(1.0f));
        f32x8 placed = all8((float)at) + share;
        position = chosen8(within, placed, position);
        if (blends) continue;
        /* Rounding may place a pixel at the end of its interval, which is part of the next. */
        i32x8 ended = placed >= all8((float)(at + 1));
        uint32_t next = at < last ? bits_of8(ended) & own : 0;
        if (next != own) note_pair(line, column, at);
        if (next) note_pair(line, column, at + 1);
    }
    return position;
}

/* Computes a run of pixels. */
INLINE void compute_run(pixel_line *line, pixel_run run) {
    const frame *f = line->f;
    float along = 0.0f, across = 0.0f;
    if (f->depth_is_planar) {
        float down = (f->tangents[3] - f->tangents[2]) / (float)f->height;
        float ty = f->tangents[2] + ((float)line->y + 0.5f) * down;
        across = (f->tangents[1] - f->tangents[0]) / (float)f->width;
        along = 1.0f + ty * ty;
    }
    f32x8 low = all8(f->vergence_low_dpt), high = all8(f->vergence_high_dpt);
    f32x8 low_limit = all8(f->vergence_low_dpt - f->vergence_margin_dpt);
    f32x8 high_limit = all8(f->vergence_high_dpt + f->vergence_margin_dpt);
    float left = 0.0f, change = 0.0f;
    if (f->cell_px) {
        left = line->change_dpt[run.column];
        change = line->change_dpt[run.column + 1] - left;
    }
    for (int x = run.first; x < run.end; x += 8) {
        int count = smaller_int(run.end - x, 8);
        uint32_t all = (1u << count) - 1u;
        f32x8 depth_m = load_first8(line->depth_m + x, count);
        f32x8 dpt = vergences8(f, depth_m, x, along, across);
        i32x8 holds = depth_m > all8(0.0f);
        if (run.is_in_image) {
            i32x8 outside = holds & ((dpt < low_limit) | (dpt > high_limit));
            line->clamped += __builtin_popcount(bits_of8(outside) & all);
            i32x8 is_known = depth_m >= all8(MIN_DEPTH_M);
            line->missing += __builtin_popcount(~bits_of8(is_known) & all);
        }
        dpt = smaller8(high, larger8(low, dpt));
        if (line->seen_dpt != NULL) {
            f32x8 behind_px = (load_first8(line->seen_dpt + x, count) - dpt)
                              * all8(f->blur_px_per_dpt);
            /* where hidden_coverage is not 0 */
            holds &= behind_px * all8(1.0f / DISCONTINUITY_PX) > all8(1.0f);
            dpt = chosen8(holds, dpt, all8(NOTHING_DPT));
        }
        store_first8(line->dpt + x, dpt, count);
        uint32_t open = bits_of8(dpt >= all8(0.0f)) & all;
        if (f->cell_px)
            dpt += all8(left) + load_first8(f->column_share + x, count) * all8(change);
        f32x8 position = positions8(line, dpt, open, run.column);
        store_first8(line->position + x, position, count);
        for (; f->blend_column != NULL && open; open &= open - 1) {
            int lane = __builtin_ctz(open);
            note_blended(f, x + lane, line->y, position[lane]);
        }
    }
}

/* Computes a row of a surface in runs. */
static void compute_line(pixel_line *line) {
    const frame *f = line->f;
    int image_end = f->border_px + f->image_width;
    int is_in_image = line->y >= f->border_px && line->y < f->border_px + f->image_height;
    pixel_run run = {0, 0, 0, 0};
    for (; run.first < f->width; run.first = run.end) {
        int x = run.first;
        run.column = f->cell_px ? f->column_cell[x] : 0;
        int cell_end = f->cell_px ? f->border_px + (run.column + 1) * f->cell_px : image_end;
        run.is_in_image = is_in_image && x >= f->border_px && x < image_end;
        run.end = x < f->border_px ? f->border_px
                  : x < image_end  ? smaller_int(cell_end, image_end)
                                   : f->width;
        compute_run(line, run);
    }
}

/* Returns whether all channels of a pixel are finite. */
INLINE int is_finite_pixel(const frame *f, int surface, size_t pixel) {
    for (size_t c = 3 * pixel; c < 3 * pixel + RGB; ++c) {
        if (f->color_kind == COLOR_LINEAR) {
            if (!isfinite(((const float *)f->color[surface])[c])) return 0;
        } else if ((((const uint16_t *)f->color[surface])[c] & 0x7C00u) == 0x7C00u) {
            return 0;
        }
    }
    return 1;
}

/* Number of pixels in a row of the image with non-finite light; hidden pixels without depth
 * do not count. */
static int64_t bad_colors(const frame *f, int surface, size_t first, const float *depth_m) {
    if (f->color_kind == COLOR_SRGB8) return 0;
    int64_t count = 0;
    for (int x = f->border_px; x < f->border_px + f->image_width; ++x)
        if (surface == 0 || depth_m[x] > 0.0f)
            count += !is_finite_pixel(f, surface, first + (size_t)x);
    return count;
}

/* Item: one row of all surfaces. */
static void pixel_row(void *argument, int y, int thread) {
    frame *f = argument;
    float *change_dpt = f->row_scratch + (size_t)thread * (size_t)(f->cell_columns + 1);
    size_t pixels = (size_t)f->width * (size_t)f->height;
    size_t first = (size_t)y * (size_t)f->width;
    int place = clamped_int(y - f->border_px, 0, f->image_height - 1);
    int first_cell = 0;
    int64_t clamped = 0, missing = 0, bad = 0;
    if (f->cell_px) {
        row_changes(f, y, change_dpt);
        first_cell = (place >> __builtin_ctz((unsigned)f->cell_px)) * f->cell_columns;
    }
    for (int s = 0; s < f->surface_count; ++s) {
        pixel_line line = {.f = f, .y = y, .depth_m = f->depth_m[s] + first,
                           .seen_dpt = s > 0 ? f->dpt + first : NULL,
                           .change_dpt = change_dpt,
                           .used = f->used + first_cell * f->interval_count,
                           .dpt = f->dpt + (size_t)s * pixels + first,
                           .position = f->position + (size_t)s * pixels + first,
                           .noted = -1};
        compute_line(&line);
        clamped += line.clamped;
        missing += s == 0 ? line.missing : 0;
        if (place == y - f->border_px) bad += bad_colors(f, s, first, line.depth_m);
    }
    if (clamped) __atomic_fetch_add(&f->clamped_count, clamped, __ATOMIC_RELAXED);
    if (bad) __atomic_fetch_add(&f->bad_color_count, bad, __ATOMIC_RELAXED);
    if (missing) __atomic_fetch_add(&f->missing_count, missing, __ATOMIC_RELAXED);
}

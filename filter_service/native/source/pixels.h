/* Conversion of each pixel's depth to vergence at the cornea and layer position, and the
 * pairs of cell and layer interval that the frame uses.  Twin: build_fragments.comp.glsl. */

#include <math.h>

#include "frame.h"
#include "vectors.h"

/* Marks a pair as used; reads first, because most pixels find it marked. */
INLINE void note_use(uint8_t *mark) {
    if (!__atomic_load_n(mark, __ATOMIC_RELAXED)) __atomic_store_n(mark, 1, __ATOMIC_RELAXED);
}

INLINE int clamped_int(int value, int low, int high) {
    return value < low ? low : value > high ? high : value;
}

/* Interval of layers that contains a distance, clamped to the first and last; tries the
 * interval of the previous distance first. */
INLINE int find_interval(const frame *f, float dpt, int at) {
    const float *layers = f->layer_dpt;
    int last = f->layer_count - 2;
    if (layers[at] <= dpt && (at == last || dpt < layers[at + 1])) return at;
    int first = 0;
    while (first < last) {
        int middle = (first + last + 1) / 2;
        if (layers[middle] <= dpt) first = middle;
        else last = middle - 1;
    }
    return first;
}

/* Layer position of a distance; `at` is the interval of the previous one. */
INLINE float layer_position(const frame *f, float dpt, int *at) {
    if (f->layer_count < 2) return 0.0f;
    int low = *at = find_interval(f, dpt, *at);
    float share = (dpt - f->layer_dpt[low]) * f->layer_per_dpt[low];
    return (float)low + smaller_float(larger_float(share, 0.0f), 1.0f);
}

INLINE int position_interval(const frame *f, float position) {
    int interval = (int)position;
    return interval < f->interval_count - 1 ? interval : f->interval_count - 1;
}

INLINE float vergence_dpt(const frame *f, float distance_m) {
    float kept_m = larger_float(distance_m, NEAREST_M);
    return f->vergence_scale / (kept_m + f->vergence_offset_m);
}

/* Vergences of a row of pixels, not clamped; arbitrary for missing depth. */
INLINE void row_vergences(const frame *f, const float *depth_m, int y, float *dpt) {
    int width = f->width;
    if (!f->depth_is_planar) {
        for (int x = 0; x < width; ++x) dpt[x] = vergence_dpt(f, depth_m[x]);
        return;
    }
    float across = (f->tangents[1] - f->tangents[0]) / (float)width;
    float down = (f->tangents[3] - f->tangents[2]) / (float)f->height;
    float ty = f->tangents[2] + ((float)y + 0.5f) * down;
    float along = 1.0f + ty * ty;
    for (int x = 0; x < width; ++x) {
        float tx = f->tangents[0] + ((float)x + 0.5f) * across;
        dpt[x] = vergence_dpt(f, depth_m[x] * __builtin_sqrtf(along + tx * tx));
    }
}

/* Share of a hidden pixel that its distance behind the visible surface lets appear. */
INLINE float hidden_coverage(const frame *f, float seen_dpt, float dpt) {
    float behind_px = (seen_dpt - dpt) * f->blur_px_per_dpt;
    float beyond = behind_px * (1.0f / DISCONTINUITY_PX) - 1.0f;
    return smaller_float(larger_float(beyond, 0.0f), 1.0f);
}

/* Empties a row of the hidden surface where there is no depth, or the blur is that of the
 * surface in front of it. */
INLINE void hide_row(const frame *f, const float *depth_m, const float *seen_dpt,
                     float *dpt) {
    for (int x = 0; x < f->width; ++x) {
        int holds = depth_m[x] > 0.0f && hidden_coverage(f, seen_dpt[x], dpt[x]) > 0.0f;
        dpt[x] = holds ? dpt[x] : NOTHING_DPT;
    }
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

/* Computes positions and used pairs of a row of a surface from its clamped vergences. */
static void row_positions(const frame *f, const float *dpt, int y, float *change_dpt,
                          float *position) {
    int found = 0;
    int noted = -1;
    int first_cell = 0;
    if (f->cell_px) {
        row_changes(f, y, change_dpt);
        int place = clamped_int(y - f->border_px, 0, f->image_height - 1);
        first_cell = (place >> __builtin_ctz((unsigned)f->cell_px)) * f->cell_columns;
    }
    for (int x = 0; x < f->width; ++x) {
        if (dpt[x] < 0.0f) continue;
        float change = 0.0f;
        int column = 0;
        if (f->cell_px) {
            column = f->column_cell[x];
            float left = change_dpt[column];
            change = left + f->column_share[x] * (change_dpt[column + 1] - left);
        }
        position[x] = layer_position(f, dpt[x] + change, &found);
        if (f->blend_column != NULL) {
            note_blended(f, x, y, position[x]);
            continue;
        }
        int pair = (first_cell + column) * f->interval_count + position_interval(f, position[x]);
        if (pair != noted) note_use(f->used + pair);
        noted = pair;
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
    int64_t clamped = 0;
    int64_t missing = 0;
    int64_t bad = 0;
    size_t pixels = (size_t)f->width * (size_t)f->height;
    size_t first = (size_t)y * (size_t)f->width;
    int in_image = y >= f->border_px && y < f->border_px + f->image_height;
    for (int s = f->surface_count - 1; s >= 0; --s) {
        const float *depth_m = f->depth_m[s] + first;
        float *dpt = f->dpt + (size_t)s * pixels + first;
        row_vergences(f, depth_m, y, dpt);
        float low = f->vergence_low_dpt - f->vergence_margin_dpt;
        float high = f->vergence_high_dpt + f->vergence_margin_dpt;
        int last = f->border_px + f->image_width;
        for (int x = f->border_px; x < last; ++x) {
            int holds = depth_m[x] > 0.0f;
            clamped += holds && (dpt[x] < low || dpt[x] > high) && in_image;
            missing += !holds && in_image && s == 0;
        }
        if (in_image) bad += bad_colors(f, s, first, depth_m);
        for (int x = 0; x < f->width; ++x) {
            float kept = dpt[x] < f->vergence_low_dpt ? f->vergence_low_dpt : dpt[x];
            dpt[x] = kept > f->vergence_high_dpt ? f->vergence_high_dpt : kept;
        }
    }
    for (int s = f->surface_count - 1; s > 0; --s)
        hide_row(f, f->depth_m[s] + first, f->dpt + first,
                 f->dpt + (size_t)s * pixels + first);
    for (int s = 0; s < f->surface_count; ++s) {
        float *dpt = f->dpt + (size_t)s * pixels + first;
        row_positions(f, dpt, y, change_dpt, f->position + (size_t)s * pixels + first);
    }
    if (clamped) __atomic_fetch_add(&f->clamped_count, clamped, __ATOMIC_RELAXED);
    if (bad) __atomic_fetch_add(&f->bad_color_count, bad, __ATOMIC_RELAXED);
    if (missing) __atomic_fetch_add(&f->missing_count, missing, __ATOMIC_RELAXED);
}

/* The pixels of a block: light, distance, position between layers, kernel. */

#include <float.h>
#include <math.h>

#include "color.h"
#include "frame.h"
#include "vectors.h"

#define BLOCK_PIXELS (TILE_SIZE_PX * TILE_SIZE_PX)

/* Pixels in scan order; sets of pixels are bit masks. */
typedef struct {
    const frame *f;
    int surface, x0, y0;      /* first pixel */
    float rgb[RGB][BLOCK_PIXELS];    /* linear light */
    float dpt[BLOCK_PIXELS];
    float place[BLOCK_PIXELS];       /* in layers */
    float spread_px[BLOCK_PIXELS];
    uint32_t kernel[BLOCK_PIXELS];
    float share[BLOCK_PIXELS];       /* strength of an edge; on the hidden surface, coverage */
    f32x4 bright;             /* light above which it is not amplified */
    uint64_t held;            /* pixels that are not empty */
    uint64_t edges;           /* pixels next to another surface, or hidden */
    uint64_t special;         /* pixels that may need extra values */
    int highest_level;        /* of merging, over the pixels' kernels */
    float tolerance;          /* of merging, at this angle from the gaze */
    float smallest_spread_px; /* of kernels that merge */
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

/* Distances of a block and the pixels around it, clamped to the frame. */
#define AROUND_PX (TILE_SIZE_PX + 2)

INLINE void copy_around(const block *b, float *dpt) {
    const frame *f = b->f;
    for (int y = 0; y < AROUND_PX; ++y) {
        int row = clamped_int(b->y0 + y - 1, 0, f->height - 1);
        const float *from = f->dpt + (size_t)row * (size_t)f->width;
        for (int x = 0; x < AROUND_PX; ++x)
            dpt[y * AROUND_PX + x] = from[clamped_int(b->x0 + x - 1, 0, f->width - 1)];
    }
}

/* Finds pixels with a neighbor on another surface, as seen through this pupil, and how much
 * they count as edges. */
INLINE uint64_t find_edges(block *b) {
    const frame *f = b->f;
    float copied[AROUND_PX * AROUND_PX];
    const float *above_left = copied;
    ptrdiff_t stride = AROUND_PX;
    if (b->x0 > 0 && b->x0 + TILE_SIZE_PX < f->width && b->y0 > 0
        && b->y0 + TILE_SIZE_PX < f->height) {
        stride = f->width;
        above_left = f->dpt + (b->y0 - 1) * stride + b->x0 - 1;
    } else {
        copy_around(b, copied);
    }
    uint64_t edges = 0;
    for (int y = 0; y < TILE_SIZE_PX; ++y) {
        const float *left = above_left + (y + 1) * stride;
        f32x8 own = load8(left + 1);
        f32x8 across = larger8(size8(load8(left) - own), size8(load8(left + 2) - own));
        f32x8 along = larger8(size8(load8(left + 1 - stride) - own),
                              size8(load8(left + 1 + stride) - own));
        f32x8 most_px = larger8(across, along) * all8(f->blur_px_per_dpt);
        f32x8 beyond = most_px * all8(1.0f / DISCONTINUITY_PX) - all8(1.0f);
        f32x8 strength = smaller8(larger8(beyond, all8(0.0f)), all8(1.0f));
        store8(b->share + y * TILE_SIZE_PX, strength * strength);
        edges |= (uint64_t)bits_of8(strength > all8(0.0f)) << (y * TILE_SIZE_PX);
    }
    return edges;
}

INLINE int cell_row(const frame *f, int y) {
    if (f->cell_px == 0) return 0;
    int place = clamped_int(y - f->border_px, 0, f->image_height - 1);
    return (place >> __builtin_ctz((unsigned)f->cell_px)) * f->cell_columns;
}

INLINE int cell_column(const frame *f, int x) { return f->cell_px ? f->column_cell[x] : 0; }

/* Reads the light of a row of pixels. */
INLINE void read_light(block *b, int i, size_t first, int width) {
    const frame *f = b->f;
    if (f->color_kind == COLOR_SRGB8) {
        const uint8_t *bytes = (const uint8_t *)f->color[b->surface] + RGB * first;
        for (int x = 0; x < width; ++x)
            for (int c = 0; c < RGB; ++c) b->rgb[c][i + x] = linear_of_byte[bytes[RGB * x + c]];
        return;
    }
    for (int x = 0; x < width; ++x) {
        f32x4 color = pixel_color(f, b->surface, first + (size_t)x);
        for (int c = 0; c < RGB; ++c) b->rgb[c][i + x] = color[c];
    }
}

/* Sets the kernels of a row of pixels, and their spread. */
INLINE void read_kernels(block *b, int i, const float *place, int width) {
    const frame *f = b->f;
    int row = cell_row(f, b->y0 + i / TILE_SIZE_PX);
    int last_pair = -1;
    uint32_t kernel = 0;
    const kernel_shape *shape = f->shapes;
    for (int x = 0; x < width; ++x, ++i) {
        if (!(b->held >> i & 1)) continue;
        int interval = position_interval(f, place[x]);
        int pair = (row + cell_column(f, b->x0 + x)) * f->interval_count + interval;
        if (pair != last_pair) {
            last_pair = pair;
            kernel = f->kernel_of[pair];
            shape = f->shapes + kernel;
            b->highest_level = larger_int(b->highest_level, shape->highest_level);
        }
        float change_px = shape->spread_px[1] - shape->spread_px[0];
        b->spread_px[i] = shape->spread_px[0] + (place[x] - (float)interval) * change_px;
        b->kernel[i] = kernel;
    }
}

/* Reads a row of a block into pixels i and on; its first pixel in the frame is `first`. */
INLINE void read_row(block *b, int i, size_t first, int width) {
    const frame *f = b->f;
    size_t pixels = (size_t)f->width * (size_t)f->height;
    const float *dpt = f->dpt + (size_t)b->surface * pixels + first;
    const float *place = f->position + (size_t)b->surface * pixels + first;
    if (width == TILE_SIZE_PX) {
        b->held |= (uint64_t)bits_of8(load8(dpt) >= all8(0.0f)) << i;
    } else {
        for (int x = 0; x < width; ++x) b->held |= (uint64_t)(dpt[x] >= 0.0f) << (i + x);
    }
    if (!(b->held >> i & 255)) return;
    memcpy(b->dpt + i, dpt, sizeof *dpt * (size_t)width);
    memcpy(b->place + i, place, sizeof *place * (size_t)width);
    read_light(b, i, first, width);
    read_kernels(b, i, place, width);
    if (b->surface == 0) return;
    const float *seen_dpt = f->dpt + first;
    for (int x = 0; x < width; ++x) {
        int held = (int)(b->held >> (i + x) & 1);
        float share = !held ? 0.0f : f->paper_rule ? 1.0f : hidden_coverage(f, seen_dpt[x], dpt[x]);
        b->share[i + x] = share;
        for (int c = 0; c < RGB; ++c) b->rgb[c][i + x] *= share;
        if (!held) b->dpt[i + x] = b->place[i + x] = 0.0f;
    }
}

/* Sets the limits of merging, which grow with the angle from the gaze.  Twin:
 * shaders/common/detection.glsl. */
INLINE void set_limits(block *b) {
    const frame *f = b->f;
    const float *gaze = f->gaze_direction, *tangents = f->tangents;
    b->tolerance = f->tolerance;
    b->smallest_spread_px = MERGE_MIN_SPREAD_PX;
    if (gaze[0] == 0.0f && gaze[1] == 0.0f && gaze[2] == 0.0f) return;
    float half = 0.5f * TILE_SIZE_PX;
    float across = ((float)b->x0 + half) / (float)f->width;
    float along = ((float)b->y0 + half) / (float)f->height;
    float right = tangents[0] + across * (tangents[1] - tangents[0]);
    float up = tangents[2] + along * (tangents[3] - tangents[2]);
    float length = sqrtf(right * right + up * up + 1.0f);
    float cosine = (right * gaze[0] + up * gaze[1] + gaze[2]) / length;
    float eccentricity_deg = acosf(smaller_float(cosine, 1.0f)) * (float)(180.0 / M_PI);
    float beyond_deg = eccentricity_deg - DETECTION_MARGIN_DEG;
    if (beyond_deg <= 0.0f) return;
    float gain = exp2f(smaller_float(DETECTION_OCTAVES_PER_DEG * beyond_deg,
                                     DETECTION_MAX_OCTAVES));
    b->tolerance *= gain;
    b->smallest_spread_px *= powf(gain, -1.0f / MERGE_CONTRAST_POWER);
}

/* Light of eight pixels of the visible surface or, at the end of a row, of fewer. */
INLINE f32x4 row_light(const frame *f, size_t first, int count) {
    f32x4 sum = all4(0.0f);
    if (f->color_kind != COLOR_SRGB8 || count < TILE_SIZE_PX) {
        for (int x = 0; x < count; ++x) sum += pixel_color(f, 0, first + (size_t)x);
        return sum;
    }
    const uint8_t *bytes = (const uint8_t *)f->color[0] + RGB * first;
    float rgb[RGB] = {0.0f, 0.0f, 0.0f};
    for (int x = 0; x < TILE_SIZE_PX; ++x)
        for (int c = 0; c < RGB; ++c) rgb[c] += linear_of_byte[bytes[RGB * x + c]];
    return (f32x4){rgb[0], rgb[1], rgb[2], 0.0f};
}

/* Sums light over each block of a row; four floats each, the last is the number of pixels. */
static void sum_block_row(void *argument, int row, int thread) {
    (void)thread;
    const frame *f = argument;
    float *to = f->block_light + 4 * (size_t)row * (size_t)f->block_columns;
    for (int column = 0; column < f->block_columns; ++column) {
        int x0 = column * TILE_SIZE_PX;
        int count = smaller_int(f->width - x0, TILE_SIZE_PX);
        int y1 = smaller_int((row + 1) * TILE_SIZE_PX, f->height);
        f32x4 sum = all4(0.0f);
        for (int y = row * TILE_SIZE_PX; y < y1; ++y)
            sum += row_light(f, (size_t)y * (size_t)f->width + (size_t)x0, count);
        sum[3] = (float)(count * (y1 - row * TILE_SIZE_PX));
        store4(to + 4 * column, sum);
    }
}

/* Sets the limit of light that is amplified: EXCESS_RATIO times the mean over this block and
 * those around it. */
INLINE void set_bright(block *b, int column, int row) {
    const frame *f = b->f;
    if (!f->bright_pixels) {
        b->bright = all4(FLT_MAX);
        return;
    }
    f32x4 sum = all4(0.0f);
    int right = smaller_int(column + 2, f->block_columns);
    int bottom = smaller_int(row + 2, f->block_rows);
    for (int y = larger_int(row - 1, 0); y < bottom; ++y)
        for (int x = larger_int(column - 1, 0); x < right; ++x)
            sum += load4(f->block_light + 4 * (y * f->block_columns + x));
    b->bright = all4(EXCESS_RATIO / sum[3]) * sum;
}

/* Reads a block; empty pixels stay dark and sharp. */
INLINE void read_block(block *b, const frame *f, int surface, int column, int row) {
    b->f = f;
    b->surface = surface;
    b->x0 = column * TILE_SIZE_PX;
    b->y0 = row * TILE_SIZE_PX;
    b->held = 0;
    b->highest_level = 0;
    set_limits(b);
    set_bright(b, column, row);
    b->edges = surface == 0 ? find_edges(b) : ~(uint64_t)0;
    int width = smaller_int(f->width - b->x0, TILE_SIZE_PX);
    int height = smaller_int(f->height - b->y0, TILE_SIZE_PX);
    if (surface > 0 || width < TILE_SIZE_PX || height < TILE_SIZE_PX) {
        memset(b->rgb, 0, sizeof b->rgb);
        memset(b->dpt, 0, sizeof b->dpt);
        memset(b->place, 0, sizeof b->place);
        memset(b->spread_px, 0, sizeof b->spread_px);
    }
    for (int y = 0; y < height; ++y) {
        size_t first = (size_t)(b->y0 + y) * (size_t)f->width + (size_t)b->x0;
        read_row(b, y * TILE_SIZE_PX, first, width);
    }
}

/* Kernel of a layer position in the cell of pixel i. */
INLINE uint32_t kernel_at(const block *b, int i, float place) {
    const frame *f = b->f;
    int cell = cell_row(f, b->y0 + i / TILE_SIZE_PX) + cell_column(f, b->x0 + i % TILE_SIZE_PX);
    return f->kernel_of[cell * f->interval_count + position_interval(f, place)];
}

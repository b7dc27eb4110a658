/* Light of all pixels beyond their kernels: the tails of kernels, on squares of pixels.
 *
 * The tail of a kernel is computed at steps of a power of two, so that its box ends within
 * BOX_STEPS.  Near the box it is a kernel on squares of four steps, and farther away on squares
 * of eight.  Both are means over the square that sends and the square that receives. */
#ifndef OCU_TAILS_H
#define OCU_TAILS_H

#include <float.h>
#include <math.h>

#include "added_light.h"
#include "bounds.h"
#include "bright_pixels.h"
#include "color.h"
#include "edge_job.h"
#include "edge_light.h"
#include "pool.h"

/* Steps from the center to which the near light is sampled.  It fades out from the first to the
 * second number of steps, and the far light fades in. */
#define NEAR_STEPS 15
#define FADE_FIRST 10.0f
#define FADE_LAST 16.0f
#define NEAR_SIDE (2 * NEAR_STEPS + 1)
#define NEAR_STRIDE 32        /* of a row, in whole vectors */
/* Samples of the far light, four steps apart. */
#define FAR_SAMPLES 12
#define FAR_SAMPLE_STEPS 4
#define FAR_SIDE (2 * FAR_SAMPLES + 1)

/* Squares of both kernels from the center. */
#define NEAR_SQUARES 4
#define FAR_SQUARES 6
#define NEAR_TAPS ((2 * NEAR_SQUARES + 1) * (2 * NEAR_SQUARES + 1))
#define FAR_TAPS ((2 * FAR_SQUARES + 1) * (2 * FAR_SQUARES + 1))

INLINE float near_share(float steps) {
    float part = (steps - FADE_FIRST) / (FADE_LAST - FADE_FIRST);
    part = smaller_float(larger_float(part, 0.0f), 1.0f);
    return 1.0f - part * part * (3.0f - 2.0f * part);
}

/* Share of a step within two ends, in pixels of a stored kernel. */
INLINE f32x8 overlap(f32x8 at, float low, float high, float per_step) {
    f32x8 zero = all8(0.0f), one = all8(1.0f), half = all8(0.5f), scale = all8(per_step);
    f32x8 above = smaller8(larger8((at - all8(low)) * scale + half, zero), one);
    return above * smaller8(larger8((all8(high) - at) * scale + half, zero), one);
}

/* Subtracts the share of a tap from the steps that its kernel covers. */
INLINE void subtract_steps(const double *map, uint32_t sides_px, float step_px, float share,
                           float *omitted) {
    float left = -(float)(sides_px & 255u) - 0.5f, right = (float)(sides_px >> 8 & 255u) + 0.5f;
    float up = -(float)(sides_px >> 16 & 255u) - 0.5f, down = (float)(sides_px >> 24) + 0.5f;
    float m[4], per_step = 1.0f / step_px;
    for (int i = 0; i < 4; ++i) m[i] = (float)map[i];
    f32x8 first = {0.0f, 1.0f, 2.0f, 3.0f, 4.0f, 5.0f, 6.0f, 7.0f};
    for (int row = 0; row < NEAR_SIDE; ++row) {
        float y = step_px * (float)(row - NEAR_STEPS);
        for (int i = 0; i < NEAR_STRIDE; i += 8) {
            f32x8 x = all8(step_px) * (first + all8((float)(i - NEAR_STEPS)));
            f32x8 inside = overlap(all8(m[0]) * x + all8(m[1] * y), left, right, per_step)
                           * overlap(all8(m[2]) * x + all8(m[3] * y), up, down, per_step);
            float *to = omitted + NEAR_STRIDE * row + i;
            store8(to, load8(to) - all8(share) * inside);
        }
    }
}

/* Writes the share of a blended kernel's channel that ends before each step. */
static void omit_steps(const tails_job *job, int64_t n, int64_t channel, float *omitted) {
    const state_reads *reads = &job->reads;
    int64_t uppers[RECIPE_TAPS / 2], psfs[RECIPE_TAPS];
    double weights[RECIPE_TAPS];
    for (int i = 0; i < NEAR_SIDE * NEAR_STRIDE; ++i) omitted[i] = 1.0f;
    for (int64_t j = FIELD_CORNERS * n; j < FIELD_CORNERS * (n + 1); ++j) {
        int64_t node = job->nodes[j];
        for (int64_t layer = 2 * n; layer < 2 * (n + 1); ++layer) {
            double ratio = job->weight_ratio[j] * job->layer_ratio[layer];
            if (ratio == 0.0) continue;
            for (int64_t corner = 0; corner < reads->count; ++corner)
                uppers[corner] = job->tables.starts[reads->groups[corner] + node];
            double total_dpt = job->layer_dpt[layer] + job->zero_dpt[RGB * node + channel];
            channel_taps(&job->tables, reads, node, (int)channel, total_dpt, uppers, psfs,
                         weights);
            int64_t part = FIELD_CORNERS * layer + j - FIELD_CORNERS * n;
            for (int64_t tap = 0; tap < 2 * reads->count; ++tap)
                if (weights[tap] * ratio != 0.0)
                    subtract_steps(job->maps + 4 * part, job->tables.reach_words[psfs[tap]],
                                   (float)job->step_px[n], (float)(weights[tap] * ratio),
                                   omitted);
        }
    }
}

/* Writes an edge (EDGE_ROWS, N_EDGE) in units of a step. */
INLINE void scale_edge(const float *edge, float per_step, float *scaled) {
    memcpy(scaled, edge, EDGE_ROWS * N_EDGE * sizeof *scaled);
    for (int i = 0; i < N_EDGE; ++i) {
        scaled[SLOPE_X * N_EDGE + i] *= per_step;
        scaled[SLOPE_Y * N_EDGE + i] *= per_step;
        scaled[LENGTH * N_EDGE + i] *= per_step;
    }
}

/* Writes a kernel on squares (2 squares + 1, 2 squares + 1, 3), one channel, of light at
 * samples (2 most + 1, stride), `ratio` of them along each square. */
INLINE void squares_of(const float *light, int most, int stride, int squares, int ratio,
                       float *kernel) {
    for (int y = -squares; y <= squares; ++y)
        for (int x = -squares; x <= squares; ++x, kernel += RGB) {
            float sum = 0.0f;
            for (int i = larger_int(ratio * y - ratio + 1, -most);
                 i <= smaller_int(ratio * y + ratio - 1, most); ++i)
                for (int k = larger_int(ratio * x - ratio + 1, -most);
                     k <= smaller_int(ratio * x + ratio - 1, most); ++k) {
                    int near_y = ratio - abs(i - ratio * y), near_x = ratio - abs(k - ratio * x);
                    sum += (float)(near_y * near_x) * light[(i + most) * stride + k + most];
                }
            *kernel = sum / (float)(ratio * ratio);
        }
}

/* Item: a channel of a kernel. */
static void tail_channel(void *argument, int item, int thread) {
    (void)thread;
    const tails_job *job = argument;
    int64_t n = item / RGB, channel = item % RGB;
    float omitted[NEAR_SIDE * NEAR_STRIDE], light[NEAR_SIDE * NEAR_STRIDE] = {0.0f};
    float far[FAR_SIDE * FAR_SIDE] = {0.0f}, edge[EDGE_ROWS * N_EDGE], seen[N_EDGE];
    const float *own = job->edges + EDGE_ROWS * N_EDGE * item;
    float per_step = 1.0f / (float)job->step_px[n];
    for (int i = 0; i < N_EDGE; ++i) seen[i] = 1.0f;
    omit_steps(job, n, channel, omitted);
    scale_edge(own, per_step, edge);
    for (int y = -NEAR_STEPS; y <= NEAR_STEPS; ++y)
        for (int x = -NEAR_STEPS; x <= NEAR_STEPS; ++x) {
            int at = (y + NEAR_STEPS) * NEAR_STRIDE + x + NEAR_STEPS;
            float share = near_share(sqrtf((float)(x * x + y * y))) * omitted[at];
            if (share > MIN_OMITTED)
                light[at] = share * edge_density(edge, seen, (float)x, (float)y);
        }
    squares_of(light, NEAR_STEPS, NEAR_STRIDE, NEAR_SQUARES, 4,
               job->near + RGB * NEAR_TAPS * n + channel);
    scale_edge(own, per_step / (float)FAR_SAMPLE_STEPS, edge);
    for (int y = -FAR_SAMPLES; y <= FAR_SAMPLES; ++y)
        for (int x = -FAR_SAMPLES; x <= FAR_SAMPLES; ++x) {
            float samples = sqrtf((float)(x * x + y * y));
            float share = 1.0f - near_share((float)FAR_SAMPLE_STEPS * samples);
            if (share <= MIN_OMITTED || samples > (float)FAR_SAMPLES + 0.5f) continue;
            int row = FAR_SAMPLE_STEPS * y + NEAR_STEPS, column = FAR_SAMPLE_STEPS * x + NEAR_STEPS;
            if (row >= 0 && row < NEAR_SIDE && column >= 0 && column < NEAR_SIDE)
                share *= larger_float(omitted[row * NEAR_STRIDE + column], 0.0f);
            far[(y + FAR_SAMPLES) * FAR_SIDE + x + FAR_SAMPLES] =
                share * edge_density(edge, seen, (float)x, (float)y);
        }
    squares_of(far, FAR_SAMPLES, FAR_SIDE, FAR_SQUARES, 2,
               job->far + RGB * FAR_TAPS * n + channel);
}

/* Writes the tails of blended kernels as kernels on squares. */
static void fill_tails(tails_job *job) {
    pool_run(job->threads, (int)(RGB * job->count), tail_channel, job);
}

typedef struct {
    const uint8_t *bytes;     /* (height, width, 3), or NULL */
    const float *floats;
    int64_t height, width;
    double white;             /* pixels much brighter are left out; negative: none is */
    double low, high;         /* see fade_light */
    float *means;             /* (3, rows, columns) */
    int64_t rows, columns;
} means_job;

/* Adds the linear light of a pixel; that of a bright pixel is added elsewhere. */
INLINE void add_float_pixel(const means_job *job, const float *pixel, float *sum) {
    float most = larger_float(larger_float(pixel[0], pixel[1]), pixel[2]), share = 0.0f;
    float sizes = fabsf(pixel[0]) + fabsf(pixel[1]) + fabsf(pixel[2]);
    if (!(sizes <= FLT_MAX)) return;
    if (job->white >= 0.0 && (double)most > job->low * job->white) {
        double light[RGB];
        fade_light(pixel, 1, job->white, job->low, job->high, &share, light);
    }
    for (int c = 0; c < RGB; ++c) sum[c] += (1.0f - share) * pixel[c];
}

/* Item: a row of squares. */
static void row_of_means(void *argument, int row, int thread) {
    (void)thread;
    const means_job *job = argument;
    int64_t y = SQUARE_PX * (int64_t)row, end_y = smaller_index(y + SQUARE_PX, job->height);
    for (int64_t column = 0; column < job->columns; ++column) {
        int64_t x = SQUARE_PX * column, end_x = smaller_index(x + SQUARE_PX, job->width);
        float sum[RGB] = {0.0f};
        for (int64_t at = y; at < end_y; ++at) {
            int64_t first = RGB * (at * job->width + x), count = RGB * (end_x - x);
            if (job->bytes != NULL)
                for (int64_t i = first; i < first + count; i += RGB)
                    for (int c = 0; c < RGB; ++c) sum[c] += linear_of_byte[job->bytes[i + c]];
            else
                for (int64_t i = first; i < first + count; i += RGB)
                    add_float_pixel(job, job->floats + i, sum);
        }
        float share = 1.0f / (float)((end_y - y) * (end_x - x));
        for (int c = 0; c < RGB; ++c)
            job->means[(c * job->rows + row) * job->columns + column] = share * sum[c];
    }
}

/* Writes the mean linear light of squares of SQUARE_PX. */
static void square_means(pool *threads, const uint8_t *bytes, const float *floats,
                         int64_t height, int64_t width, double white, double low, double high,
                         float *means) {
    int64_t rows = (height + SQUARE_PX - 1) / SQUARE_PX;
    int64_t columns = (width + SQUARE_PX - 1) / SQUARE_PX;
    means_job job = {bytes, floats, height, width, white, low, high, means, rows, columns};
    pool_run(threads, (int)rows, row_of_means, &job);
}

/* Targets that one item computes, and with the squares around them. */
#define TILE_ROWS 8
#define TILE_COLUMNS 32
#define HALO_ROWS (TILE_ROWS + 2 * FAR_SQUARES)
#define HALO_STRIDE (TILE_COLUMNS + 2 * FAR_SQUARES + 4)
#define PLANE (HALO_ROWS * HALO_STRIDE)

typedef struct {
    float light[RGB];
    int y, x;
} tail_tap;

/* Nonzero taps of a kernel on squares; returns their number. */
INLINE int list_taps(const float *kernel, int squares, tail_tap *taps) {
    int count = 0;
    for (int y = -squares; y <= squares; ++y)
        for (int x = -squares; x <= squares; ++x, kernel += RGB)
            if (kernel[0] > 0.0f || kernel[1] > 0.0f || kernel[2] > 0.0f)
                taps[count++] = (tail_tap){{kernel[0], kernel[1], kernel[2]}, y, x};
    return count;
}

/* Level 0 has squares of SQUARE_PX; each next level has squares of twice the size. */
INLINE int64_t level_size(int64_t squares, int level) {
    return (squares + (1 << level) - 1) >> level;
}

/* Writes the light of a square of several blocks, of those that have a kernel, and their
 * share. */
INLINE void mean_of_blocks(const spread_job *job, int level, int kind, int64_t y, int64_t x,
                           float *to) {
    int shift = level - BLOCK_LEVEL, count = 0;
    int64_t end_y = smaller_index((y + 1) << shift, job->block_rows);
    int64_t end_x = smaller_index((x + 1) << shift, job->block_columns);
    float sums[RGB + 1] = {0.0f};
    for (int64_t v = y << shift; v < end_y; ++v)
        for (int64_t u = x << shift; u < end_x; ++u, ++count) {
            if (job->kinds[v * job->block_columns + u] != kind) continue;
            for (int c = 0; c < RGB; ++c)
                sums[c] += job->levels[BLOCK_LEVEL]
                                      [(c * job->block_rows + v) * job->block_columns + u];
            sums[RGB] += 1.0f;
        }
    for (int c = 0; c <= RGB; ++c) to[c * PLANE] = sums[c] / (float)count;
}

/* Writes the light of the squares around a tile that have a kernel, and their share, in planes
 * (4, HALO_ROWS, HALO_STRIDE).  Others, and those outside the image, are 0. */
static void read_around(const spread_job *job, int level, int kind, int64_t top, int64_t left,
                        float *around) {
    int64_t rows = level_size(job->rows, level), columns = level_size(job->columns, level);
    int64_t end_y = smaller_index(top + TILE_ROWS + FAR_SQUARES, rows);
    int64_t end_x = smaller_index(left + TILE_COLUMNS + FAR_SQUARES, columns);
    int64_t start_y = larger_index(top - FAR_SQUARES, 0);
    int64_t start_x = larger_index(left - FAR_SQUARES, 0);
    memset(around, 0, (RGB + 1) * PLANE * sizeof *around);
    float *first = around - (top - FAR_SQUARES) * HALO_STRIDE - (left - FAR_SQUARES);
    if (level > BLOCK_LEVEL) {
        for (int64_t y = start_y; y < end_y; ++y)
            for (int64_t x = start_x; x < end_x; ++x)
                mean_of_blocks(job, level, kind, y, x, first + y * HALO_STRIDE + x);
        return;
    }
    int shift = BLOCK_LEVEL - level;
    for (int64_t y = start_y; y < end_y; ++y) {
        const uint8_t *kinds = job->kinds + (y >> shift) * job->block_columns;
        for (int64_t x = start_x, next; x < end_x; x = next) {
            next = smaller_index(((x >> shift) + 1) << shift, end_x);
            if (kinds[x >> shift] != kind) continue;
            const float *mean = job->levels[level] + y * columns;
            for (int64_t c = 0; c < RGB; ++c)
                for (int64_t i = x; i < next; ++i)
                    first[c * PLANE + y * HALO_STRIDE + i] = mean[c * rows * columns + i];
            for (int64_t i = x; i < next; ++i)
                first[RGB * PLANE + y * HALO_STRIDE + i] = 1.0f;
        }
    }
}

/* Bits of the kinds of the blocks that a tile reads. */
INLINE uint32_t kinds_around(const spread_job *job, int level, int64_t y, int64_t x) {
    int64_t edge_px = (int64_t)SQUARE_PX << level, block_px = (int64_t)SQUARE_PX << BLOCK_LEVEL;
    int64_t top = larger_index((y - FAR_SQUARES) * edge_px / block_px, 0);
    int64_t left = larger_index((x - FAR_SQUARES) * edge_px / block_px, 0);
    int64_t end_y = smaller_index((y + TILE_ROWS + FAR_SQUARES) * edge_px / block_px + 1,
                                  job->block_rows);
    int64_t end_x = smaller_index((x + TILE_COLUMNS + FAR_SQUARES) * edge_px / block_px + 1,
                                  job->block_columns);
    uint32_t bits = 0;
    for (int64_t v = top; v < end_y; ++v)
        for (int64_t u = left; u < end_x; ++u)
            bits |= 1u << job->kinds[v * job->block_columns + u];
    return bits;
}

/* Adds the light that eight squares receive; `own` is that of the first, of planes (4, ...).
 * Where all squares around have one kernel, the share is the same everywhere. */
INLINE void receive(const tail_tap *taps, int count, const float *own, int is_only, f32x8 *light,
                    f32x8 *share) {
    for (int c = 0; c < RGB; ++c) light[c] = share[c] = all8(0.0f);
    for (const tail_tap *tap = taps; tap < taps + count; ++tap) {
        const float *from = own - tap->y * HALO_STRIDE - tap->x;
        f32x8 has = is_only ? all8(1.0f) : load8(from + RGB * PLANE);
        for (int c = 0; c < RGB; ++c) {
            f32x8 weight = all8(tap->light[c]);
            light[c] += weight * load8(from + c * PLANE);
            share[c] += is_only ? weight : weight * has;
        }
    }
}

/* Adds the light that a tile receives from the squares of a kind. */
static void spread_kind(const spread_job *job, int level, int kind, int squares,
                        const float *kernel, int64_t top, int64_t left, int is_only) {
    int64_t rows = level_size(job->rows, level), columns = level_size(job->columns, level);
    tail_tap taps[FAR_TAPS];
    float around[(RGB + 1) * PLANE];
    int count = list_taps(kernel, squares, taps);
    read_around(job, level, kind, top, left, around);
    int64_t end = smaller_index(TILE_ROWS, rows - top);
    for (int64_t y = 0; y < end; ++y)
        for (int64_t x = 0; x < TILE_COLUMNS && left + x < columns; x += 8) {
            const float *own = around + (y + FAR_SQUARES) * HALO_STRIDE + x + FAR_SQUARES;
            f32x8 light[RGB], share[RGB];
            if (is_only) receive(taps, count, own, 1, light, share);
            else receive(taps, count, own, 0, light, share);
            int64_t width = smaller_index(columns - left - x, 8);
            float *to = job->planes[level] + 8 * ((top + y) * columns + left + x);
            for (int i = 0; i < width; ++i, to += 8) {
                f32x8 sum = {light[0][i], light[1][i], light[2][i], 0.0f,
                             share[0][i], share[1][i], share[2][i], 0.0f};
                store8(to, load8(to) + sum);
            }
        }
}

/* Item: a tile of a level. */
static void spread_tile(void *argument, int item, int thread) {
    (void)thread;
    const spread_job *job = argument;
    int level = 0;
    int64_t across;
    for (;; ++level) {
        across = (level_size(job->columns, level) + TILE_COLUMNS - 1) / TILE_COLUMNS;
        int64_t tiles = across * ((level_size(job->rows, level) + TILE_ROWS - 1) / TILE_ROWS);
        if (item < tiles) break;
        item -= (int)tiles;
    }
    int64_t top = TILE_ROWS * (item / across), left = TILE_COLUMNS * (item % across);
    uint32_t kinds = kinds_around(job, level, top, left);
    int is_only = (kinds & (kinds - 1)) == 0 && top >= FAR_SQUARES && left >= FAR_SQUARES
                  && top + TILE_ROWS + FAR_SQUARES <= level_size(job->rows, level)
                  && left + TILE_COLUMNS + FAR_SQUARES <= level_size(job->columns, level);
    for (int kind = 0; kind < job->count; ++kind) {
        if (!(kinds >> kind & 1u)) continue;
        if (job->powers[kind] == level)
            spread_kind(job, level, kind, NEAR_SQUARES, job->near + RGB * NEAR_TAPS * kind, top,
                        left, is_only);
        if (job->powers[kind] + 1 == level)
            spread_kind(job, level, kind, FAR_SQUARES, job->far + RGB * FAR_TAPS * kind, top,
                        left, is_only);
    }
}

/* Writes means of two by two squares, of those in the image. */
static void halve_means(const float *fine, int64_t rows, int64_t columns, float *coarse) {
    int64_t coarse_rows = level_size(rows, 1), coarse_columns = level_size(columns, 1);
    for (int64_t c = 0; c < RGB; ++c, fine += rows * columns)
        for (int64_t y = 0; y < coarse_rows; ++y)
            for (int64_t x = 0; x < coarse_columns; ++x, ++coarse) {
                int64_t right = smaller_index(2 * x + 1, columns - 1);
                const float *upper = fine + 2 * y * columns;
                const float *lower = fine + smaller_index(2 * y + 1, rows - 1) * columns;
                *coarse = 0.25f * (upper[2 * x] + upper[right] + lower[2 * x] + lower[right]);
            }
}

typedef struct { const spread_job *job; int level; } raise_job;

/* Item: a row of squares, to which the next level is added, interpolated. */
static void raise_row(void *argument, int y, int thread) {
    (void)thread;
    const raise_job *own = argument;
    const spread_job *job = own->job;
    int64_t columns = level_size(job->columns, own->level);
    int64_t coarse_rows = level_size(job->rows, own->level + 1), last = level_size(columns, 1) - 1;
    int64_t near = y / 2;
    int64_t far = y % 2 ? smaller_index(near + 1, coarse_rows - 1) : larger_index(near - 1, 0);
    const float *upper = job->planes[own->level + 1] + 8 * near * (last + 1);
    const float *lower = job->planes[own->level + 1] + 8 * far * (last + 1);
    float *to = job->planes[own->level] + 8 * y * columns;
    f32x8 most = all8(0.75f), rest = all8(0.25f), before = all8(0.0f), here = before;
    for (int64_t x = -1; x <= last; ++x) { /* `here` is of column x, but for margins */
        int64_t at = 8 * smaller_index(x + 1, last);
        f32x8 after = most * load8(upper + at) + rest * load8(lower + at);
        if (x < 0) here = after;
        f32x8 middle = most * here;
        if (x >= 0) store8(to + 16 * x, load8(to + 16 * x) + middle + rest * before);
        if (x >= 0 && 2 * x + 1 < columns)
            store8(to + 16 * x + 8, load8(to + 16 * x + 8) + middle + rest * after);
        before = here;
        here = after;
    }
}

/* Writes the light that squares receive from beyond kernels, and its share of white. */
static void spread_tails(spread_job *job) {
    int64_t items = 0;
    for (int level = 0; level + 1 < job->n_levels; ++level)
        if (level < BLOCK_LEVEL)
            halve_means(job->levels[level], level_size(job->rows, level),
                        level_size(job->columns, level), job->levels[level + 1]);
    for (int level = 0; level < job->n_levels; ++level)
        items += (level_size(job->columns, level) + TILE_COLUMNS - 1) / TILE_COLUMNS
                 * ((level_size(job->rows, level) + TILE_ROWS - 1) / TILE_ROWS);
    pool_run(job->threads, (int)items, spread_tile, job);
    for (int level = job->n_levels - 2; level >= 0; --level) {
        raise_job own = {job, level};
        pool_run(job->threads, (int)level_size(job->rows, level), raise_row, &own);
    }
}

typedef struct {
    added_light added;
    float *image;             /* (height, width, 3) */
    int64_t width;
    uint8_t *encoded;         /* (height, width, 3), or NULL */
} add_tails_job;

/* Squares that are interpolated at a time. */
#define ADDED_SQUARES 32
#define ADDED_PX (SQUARE_PX * ADDED_SQUARES)

/* Item: a row of an image. */
static void add_tails_row(void *argument, int y, int thread) {
    (void)thread;
    const add_tails_job *job = argument;
    for (int64_t x = 0; x < job->width; x += ADDED_PX) {
        f32x8 blended[ADDED_SQUARES + 2];
        float before[RGB * ADDED_PX + 8], after[RGB * ADDED_PX + 8];
        int64_t count = smaller_index(job->width - x, ADDED_PX);
        int64_t first = x / SQUARE_PX - 1, at = RGB * (job->width * y + x);
        size_t size = RGB * (size_t)count;
        memcpy(before, job->image + at, size * sizeof *before);
        for (size_t i = size; i < size + 8; ++i) before[i] = 0.0f;
        blend_squares(&job->added, y, first, ADDED_SQUARES + 2, blended);
        for (int64_t k = 0; k < count; k += 2) {
            f32x4 one = load4(before + RGB * k), other = load4(before + RGB * k + RGB);
            f32x8 own = {one[0], one[1], one[2], 0.0f, other[0], other[1], other[2], 0.0f};
            own = with_light(own, blended, first, x + k);
            store4(after + RGB * k, (f32x4){own[0], own[1], own[2], 0.0f});
            store4(after + RGB * k + RGB, (f32x4){own[4], own[5], own[6], 0.0f});
        }
        if (job->encoded == NULL) {
            memcpy(job->image + at, after, size * sizeof *after);
            continue;
        }
        uint8_t bytes[RGB * ADDED_PX + 8];
        for (size_t i = 0; i < size; i += 8) bytes_of_linear(load8(after + i), bytes + i);
        memcpy(job->encoded + at, bytes, size);
    }
}

/* Adds light from beyond kernels to an image, in place, or encodes the sum as sRGB. */
static void add_tails(pool *threads, const float *squares, int64_t rows, int64_t columns,
                      float *image, int64_t height, int64_t width, uint8_t *encoded) {
    add_tails_job job = {{squares, rows, columns}, image, width, encoded};
    pool_run(threads, (int)height, add_tails_row, &job);
}

#endif

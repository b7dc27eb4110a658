/* Light of sources on grids of coarse pixels, added to an image. */
#ifndef OCU_PLANES_H
#define OCU_PLANES_H

#include <math.h>

#include "bounds.h"
#include "color.h"
#include "constants.h"
#include "pool.h"

/* Least share of a source that a coarse pixel receives. */
#define MIN_SPLIT 1e-6

/* Distributes sources (count,) to a grid of coarse pixels; returns the number of entries.
 * points: x, y in pixels of the image; kernels: ascending; is_split: whether each source is
 * divided between the four pixels around it, and not moved to the nearest.  `stamps` (rows,
 * columns) is scratch, -1: coarse pixels, with a margin of one on each side.  Outputs: coarse
 * pixels x, y without the margin, their kernels, and their light, which is zero before. */
static int64_t gather_points(const double *points, const int64_t *kernels, const double *light,
                             int64_t count, int64_t pitch_px, int64_t is_split, int64_t *stamps,
                             int64_t columns, int64_t *at, int64_t *kernel, float *gathered) {
    int64_t first = 0, n = 0;
    for (int64_t k = 0; k < count; ++k) {
        if (k == 0 || kernels[k] != kernels[k - 1]) first = n;
        double x = (points[2 * k] + 0.5) / (double)pitch_px - 0.5;
        double y = (points[2 * k + 1] + 0.5) / (double)pitch_px - 0.5;
        if (!is_split) {
            x = floor(x + 0.5);
            y = floor(y + 0.5);
        }
        double left = floor(x), up = floor(y);
        for (int corner = 0; corner < 4; ++corner) {
            int right = corner & 1, down = corner >> 1;
            double share = (right ? x - left : left + 1.0 - x) * (down ? y - up : up + 1.0 - y);
            if (share < MIN_SPLIT) continue;
            int64_t column = (int64_t)left + right, row = (int64_t)up + down;
            int64_t *number = stamps + (row + 1) * columns + column + 1;
            if (*number < first) {
                *number = n;
                at[2 * n] = column;
                at[2 * n + 1] = row;
                kernel[n++] = kernels[k];
            }
            for (int c = 0; c < RGB; ++c) {
                float *sum = gathered + RGB * *number + c;
                *sum = (float)((double)*sum + share * light[RGB * k + c]);
            }
        }
    }
    return n;
}

typedef struct {
    const int64_t *at, *kernel;                 /* (count, 2): x, y; (count,) */
    const float *light;       /* (count, 3) */
    int64_t count;
    const float *kernels;     /* (n_kernels, side, side, 3), round */
    int64_t side;
    float *image;             /* (height, width, 3) */
    int64_t height, width;
} source_job;

/* Adds pixels (count, 3) of one color each times light (3,). */
INLINE void add_pixels(float *pixels, const float *kernel, const float *light, int64_t count) {
    float r = light[0], g = light[1], b = light[2];
    f32x8 factors[RGB] = {{r, g, b, r, g, b, r, g}, {b, r, g, b, r, g, b, r},
                          {g, b, r, g, b, r, g, b}};
    int64_t i = 0;
    for (; i + 24 <= RGB * count; i += 24)
        for (int part = 0; part < RGB; ++part) {
            float *to = pixels + i + 8 * part;
            store8(to, load8(to) + factors[part] * load8(kernel + i + 8 * part));
        }
    for (; i < RGB * count; ++i) pixels[i] += light[i % RGB] * kernel[i];
}

/* Rows of an image that one item adds sources to: each item looks at all of them. */
#define ROWS_AN_ITEM 16

static void add_source_rows(void *argument, int item, int thread) {
    (void)thread;
    const source_job *job = argument;
    int64_t start = (int64_t)item * ROWS_AN_ITEM, half = job->side / 2;
    int64_t end = smaller_index(start + ROWS_AN_ITEM, job->height);
    for (int64_t k = 0; k < job->count; ++k) {
        int64_t x = job->at[2 * k], y = job->at[2 * k + 1];
        int64_t last_row = smaller_index(y + half + 1, end);
        for (int64_t row = larger_index(y - half, start); row < last_row; ++row) {
            int64_t half_row = (int64_t)sqrt((double)(half * half - (row - y) * (row - y)));
            int64_t first = larger_index(x - half_row, 0);
            int64_t last = smaller_index(x + half_row + 1, job->width);
            const float *kernel =
                job->kernels
                + RGB * ((job->kernel[k] * job->side + row - y + half) * job->side + half - x);
            add_pixels(job->image + RGB * (row * job->width + first), kernel + RGB * first,
                       job->light + RGB * k, last - first);
        }
    }
}

/* Adds sources times their kernels to an image. */
static void add_sources(pool *threads, const int64_t *at, const int64_t *kernel,
                        const float *light, int64_t count, const float *kernels, int64_t side,
                        float *image, int64_t height, int64_t width) {
    source_job job = {at, kernel, light, count, kernels, side, image, height, width};
    pool_run(threads, (int)((height + ROWS_AN_ITEM - 1) / ROWS_AN_ITEM), add_source_rows, &job);
}

typedef struct {
    const float *coarse;      /* (rows, columns, 3); rows is 0 if there is nothing to add */
    int64_t rows, columns;
    float *image;             /* (height, width, 3) */
    int64_t width;
    uint8_t *encoded;         /* (height, width, 3) */
} plane_job;

/* Coarse pixels that are interpolated at a time. */
#define PLANE_PART 64

/* Adds a row of coarse pixels of twice the size, interpolated, to `count` pixels from pixel
 * x on, which is even; count is at most 2 PLANE_PART. */
INLINE void add_plane_part(const plane_job *job, int64_t y, int64_t x, int64_t count,
                            float *row) {
    float between[RGB * (PLANE_PART + 2)];
    int64_t own = y / 2, last = job->columns - 1;
    int64_t other = y % 2 ? smaller_index(own + 1, job->rows - 1) : larger_index(own - 1, 0);
    const float *near = job->coarse + RGB * job->columns * own;
    const float *far = job->coarse + RGB * job->columns * other;
    int64_t used = (count + 1) / 2;
    int64_t first = x / 2 - 1;        /* of `between`, which has a margin on each side */
    int64_t from = larger_index(first, 0), to = smaller_index(first + used + 1, last);
    float *at = between + RGB * (from - first);
    for (int64_t i = 0; i < RGB * (to - from + 1); ++i)
        at[i] = 0.75f * near[RGB * from + i] + 0.25f * far[RGB * from + i];
    if (from > first) memcpy(between, between + RGB, RGB * sizeof *between);
    if (to < first + used + 1)
        memcpy(between + RGB * (used + 1), between + RGB * used, RGB * sizeof *between);
    for (int64_t k = 0; k < RGB * (count / 2); k += RGB, row += 2 * RGB)
        for (int64_t c = k; c < k + RGB; ++c) {
            float middle = 0.75f * between[c + RGB];
            row[c - k] += middle + 0.25f * between[c];
            row[c - k + RGB] += middle + 0.25f * between[c + 2 * RGB];
        }
    if (count % 2) /* the last pixel of an odd number */
        for (int64_t c = RGB * (used - 1); c < RGB * used; ++c)
            row[c - RGB * (used - 1)] += 0.75f * between[c + RGB] + 0.25f * between[c];
}

/* Item: a row of an image. */
static void add_plane_row(void *argument, int y, int thread) {
    (void)thread;
    const plane_job *job = argument;
    float *row = job->image + RGB * job->width * y;
    for (int64_t x = 0; x < job->width; x += 2 * PLANE_PART)
        add_plane_part(job, y, x, smaller_index(job->width - x, 2 * PLANE_PART), row + RGB * x);
}

/* Adds coarse pixels of twice the size, interpolated, to an image. */
static void add_plane(pool *threads, const float *coarse, int64_t rows, int64_t columns,
                       float *image, int64_t height, int64_t width) {
    plane_job job = {coarse, rows, columns, image, width, NULL};
    pool_run(threads, (int)height, add_plane_row, &job);
}

/* Item: a row of an image, which is left as it is. */
static void encode_row(void *argument, int y, int thread) {
    (void)thread;
    const plane_job *job = argument;
    for (int64_t x = 0; x < job->width; x += 2 * PLANE_PART) {
        float light[RGB * 2 * PLANE_PART];
        uint8_t bytes[RGB * 2 * PLANE_PART];
        int64_t count = smaller_index(job->width - x, 2 * PLANE_PART);
        int64_t first = RGB * (job->width * y + x);
        size_t size = RGB * (size_t)count;
        memcpy(light, job->image + first, size * sizeof *light);
        for (size_t i = size; i < (size + 7) / 8 * 8; ++i) light[i] = 0.0f;
        if (job->rows) add_plane_part(job, y, x, count, light);
        for (size_t i = 0; i < size; i += 8) bytes_of_linear(load8(light + i), bytes + i);
        memcpy(job->encoded + first, bytes, size);
    }
}

/* Adds coarse pixels, and encodes the sums as sRGB; NaN becomes dark. */
static void add_and_encode(pool *threads, const float *coarse, int64_t rows, int64_t columns,
                           const float *image, int64_t height, int64_t width,
                           uint8_t *encoded) {
    plane_job job = {coarse, rows, columns, (float *)image, width, encoded};
    pool_run(threads, (int)height, encode_row, &job);
}

#endif

/* Pixels that are much brighter than white, as sources of light beyond kernels. */
#ifndef OCU_BRIGHT_PIXELS_H
#define OCU_BRIGHT_PIXELS_H

#include <math.h>

#include "bounds.h"
#include "constants.h"
#include "pool.h"

/* Brightest light of a source, so that sums of sources remain finite in float32. */
#define MAX_SOURCE_LIGHT 1e30

/* Bits of an image (height, width, 3) of floats or halves; the other is NULL.  Positive floats
 * are ordered as their bits, and integers are compared faster. */
typedef struct {
    const int32_t *floats;
    const int16_t *halves;
    int64_t width;
    int64_t limit;            /* bits of the light above which a pixel is bright */
    int64_t *counts;          /* (height,) */
    const int64_t *offsets;   /* (height + 1,) */
    int64_t *y_px, *x_px;     /* of bright pixels, from an offset for each row on */
} bright_job;

INLINE int is_bright(const bright_job *job, int64_t pixel) {
    int found = 0;
    for (int64_t at = RGB * pixel; at < RGB * (pixel + 1); ++at)
        found |= (job->floats != NULL ? job->floats[at] : job->halves[at]) > job->limit;
    return found;
}

/* Returns whether a row has a bright value. */
static int has_bright(const bright_job *job, int64_t y) {
    int64_t count = RGB * job->width;
    if (job->floats == NULL) {
        const int16_t *bits = job->halves + count * y;
        int16_t largest = INT16_MIN;
        for (int64_t i = 0; i < count; ++i) largest = bits[i] > largest ? bits[i] : largest;
        return largest > job->limit;
    }
    const int32_t *bits = job->floats + count * y;
    int32_t largest = INT32_MIN;
    for (int64_t i = 0; i < count; ++i) largest = bits[i] > largest ? bits[i] : largest;
    return largest > job->limit;
}

/* Item: counts the bright pixels of a row. */
static void count_bright_row(void *argument, int y, int thread) {
    (void)thread;
    const bright_job *job = argument;
    job->counts[y] = 0;
    if (!has_bright(job, y)) return;
    for (int64_t x = 0; x < job->width; ++x)
        job->counts[y] += is_bright(job, y * job->width + x);
}

/* Counts the bright pixels of each row. */
static void count_bright(pool *threads, const int32_t *floats, const int16_t *halves,
                         int64_t height, int64_t width, int64_t limit, int64_t *counts) {
    bright_job job = {floats, halves, width, limit, counts, NULL, NULL, NULL};
    pool_run(threads, (int)height, count_bright_row, &job);
}

/* Item: lists the bright pixels of a row. */
static void list_bright_row(void *argument, int y, int thread) {
    (void)thread;
    const bright_job *job = argument;
    int64_t n = job->offsets[y];
    for (int64_t x = 0; x < job->width && n < job->offsets[y + 1]; ++x) {
        if (!is_bright(job, y * job->width + x)) continue;
        job->y_px[n] = y;
        job->x_px[n++] = x;
    }
}

/* Lists the bright pixels, row by row. */
static void list_bright(pool *threads, const int32_t *floats, const int16_t *halves,
                        int64_t height, int64_t width, int64_t limit, const int64_t *offsets,
                        int64_t *y_px, int64_t *x_px) {
    bright_job job = {floats, halves, width, limit, NULL, offsets, y_px, x_px};
    pool_run(threads, (int)height, list_bright_row, &job);
}

/* Writes the share (count,) of the light (count, 3) of pixels (count, 3) that is a source's.
 * It fades in between two ratios to white.  Values that are not finite have none. */
static void fade_light(const float *color, int64_t count, double white, double low,
                       double high, float *share, double *light) {
    for (int64_t k = 0; k < count; ++k, color += RGB, light += RGB) {
        double brightest = 0.0;
        for (int c = 0; c < RGB; ++c) {
            light[c] = isfinite(color[c]) ? clipped((double)color[c], 0.0, MAX_SOURCE_LIGHT) : 0.0;
            brightest = at_least(light[c], brightest);
        }
        double part = brightest > 0.0 ? 1.0 : 0.0;
        if (brightest < high * white) {
            part = at_least((brightest / white - low) / (high - low), 0.0);
            part = part * part * (3.0 - 2.0 * part);
        }
        share[k] = (float)part;
        for (int c = 0; c < RGB; ++c) light[c] *= part;
    }
}

/* Sums of a source: light, x and y weighted with it, light of its brightest pixel. */
enum { SUM_X = 3, SUM_Y = 4, SUM_BRIGHTEST = 5, SUMS = 6 };

/* Merges pixels (count,) of equal squares of 2^power pixels into sources; returns their
 * number.  `index` (surfaces, rows, columns) is scratch, -1; the outputs are the source of
 * each pixel, and the sums and the brightest pixel of each source. */
static int64_t merge_pixels(const int64_t *y_px, const int64_t *x_px, const int64_t *surface,
                            const double *light, int64_t count, int64_t power, int32_t *index,
                            int64_t rows, int64_t columns, int64_t *source, double *sums,
                            int64_t *at) {
    int64_t n_sources = 0;
    for (int64_t k = 0; k < count; ++k, light += RGB) {
        int64_t row = surface[k] * rows + (y_px[k] >> power);
        int32_t *own = index + row * columns + (x_px[k] >> power);
        double *sum = sums + SUMS * (*own < 0 ? n_sources : *own);
        if (*own < 0) {
            *own = (int32_t)n_sources++;
            memset(sum, 0, SUMS * sizeof *sum);
        }
        double total = light[0] + light[1] + light[2];
        for (int c = 0; c < RGB; ++c) sum[c] += light[c];
        sum[SUM_X] += total * (double)x_px[k];
        sum[SUM_Y] += total * (double)y_px[k];
        if (total > sum[SUM_BRIGHTEST]) {
            sum[SUM_BRIGHTEST] = total;
            at[*own] = k;
        }
        source[k] = *own;
    }
    return n_sources;
}

/* Multiplies pixels (count,) of an image by 1 - share * ratio of the kind of their source. */
static void dim_pixels(const int64_t *y_px, const int64_t *x_px, const int64_t *source,
                       const float *share, int64_t count, const int64_t *kind,
                       const double *ratio, float *image, int64_t width) {
    for (int64_t k = 0; k < count; ++k) {
        const double *own = ratio + RGB * kind[source[k]];
        float *pixel = image + RGB * (y_px[k] * width + x_px[k]);
        for (int c = 0; c < RGB; ++c) pixel[c] *= (float)(1.0 - (double)share[k] * own[c]);
    }
}

#endif

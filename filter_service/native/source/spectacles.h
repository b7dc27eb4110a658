/* An image through spectacles: resampled by a linear map of tangents.  Color is interpolated
 * bilinearly.  Depth is that of the nearest pixel, because an average of two depths is the
 * depth of neither surface. */
#ifndef OCU_SPECTACLES_H
#define OCU_SPECTACLES_H

#include "bounds.h"
#include "constants.h"
#include "pool.h"
#include "vectors.h"

typedef struct {
    const float *color, *depth_m;      /* (height, width, 3), (height, width) */
    int64_t height, width;
    const double *tangents;   /* of the left and upper edge, and of a pixel */
    const double *to_source;  /* map (2, 2) from output to source tangents */
    float *resampled, *resampled_m;
} resample_job;

/* Place of an output pixel in the source: rows i and `below`, columns j and `right`, with the
 * shares q and p of the second ones. */
typedef struct {
    double s, t, p, q;
    int64_t i, j, below, right;
} source_place;

INLINE source_place place_of(int64_t x, int64_t y, int64_t height, int64_t width,
                             const double *tangents, const double *map) {
    source_place at;
    double u = tangents[0] + ((double)x + 0.5) * tangents[2];
    double v = tangents[1] + ((double)y + 0.5) * tangents[3];
    at.s = (map[0] * u + map[1] * v - tangents[0]) / tangents[2] - 0.5;
    at.t = (map[2] * u + map[3] * v - tangents[1]) / tangents[3] - 0.5;
    at.s = clipped(at.s, 0.0, (double)width - 1.0);
    at.t = clipped(at.t, 0.0, (double)height - 1.0);
    at.i = smaller_index((int64_t)at.t, larger_index(height - 2, 0));
    at.j = smaller_index((int64_t)at.s, larger_index(width - 2, 0));
    at.below = smaller_index(at.i + 1, height - 1);
    at.right = smaller_index(at.j + 1, width - 1);
    at.p = at.s - (double)at.j;
    at.q = at.t - (double)at.i;
    return at;
}

/* Item: a row of pixels. */
static void resample_row(void *argument, int y, int thread) {
    (void)thread;
    const resample_job *job = argument;
    int64_t height = job->height, width = job->width;
    for (int64_t x = 0; x < width; ++x) {
        source_place at = place_of(x, y, height, width, job->tangents, job->to_source);
        int64_t nearest = smaller_index((int64_t)(at.t + 0.5), height - 1) * width
                          + smaller_index((int64_t)(at.s + 0.5), width - 1);
        job->resampled_m[y * width + x] = job->depth_m[nearest];
        const float *over = job->color + RGB * at.i * width;
        const float *under = job->color + RGB * at.below * width;
        for (int c = 0; c < RGB; ++c) {
            int64_t from = RGB * at.j + c, to = RGB * at.right + c;
            double high = (double)over[from] + at.p * (double)(over[to] - over[from]);
            double low = (double)under[from] + at.p * (double)(under[to] - under[from]);
            job->resampled[RGB * (y * width + x) + c] = (float)(high + at.q * (low - high));
        }
    }
}

static void resample(pool *threads, const float *color, const float *depth_m, int64_t height,
                     int64_t width, const double *tangents, const double *to_source,
                     float *resampled, float *resampled_m) {
    resample_job job = {color,    depth_m,   height,    width,
                        tangents, to_source, resampled, resampled_m};
    pool_run(threads, (int)height, resample_row, &job);
}

/* Adjoint of the resampling of color: adds the pixels (height, width, 3) of the output to those
 * of the source, in one thread, because the sums depend on their order. */
static void resample_adjoint(const float *resampled, int64_t height, int64_t width,
                             const double *tangents, const double *to_source, float *color) {
    memset(color, 0, RGB * (size_t)(height * width) * sizeof *color);
    for (int64_t y = 0; y < height; ++y)
        for (int64_t x = 0; x < width; ++x) {
            source_place at = place_of(x, y, height, width, tangents, to_source);
            float p = (float)at.p, q = (float)at.q;
            float *over = color + RGB * at.i * width, *under = color + RGB * at.below * width;
            const float *from = resampled + RGB * (y * width + x);
            for (int c = 0; c < RGB; ++c) {
                float high = (1.0f - q) * from[c], low = q * from[c];
                over[RGB * at.j + c] += (1.0f - p) * high;
                over[RGB * at.right + c] += p * high;
                under[RGB * at.j + c] += (1.0f - p) * low;
                under[RGB * at.right + c] += p * low;
            }
        }
}

#endif

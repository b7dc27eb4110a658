/* An image through spectacles: resampled by a linear map of tangents.  Color is interpolated
 * bilinearly.  Depth is that of the nearest pixel, because an average of two depths is the
 * depth of neither surface. */
#ifndef OCU_SPECTACLES_H
#define OCU_SPECTACLES_H

#include "bounds.h"
#include "constants.h"
#include "pool.h"

typedef struct {
    const float *color, *depth_m;      /* (height, width, 3), (height, width) */
    int64_t height, width;
    const double *tangents;   /* of the left and upper edge, and of a pixel */
    const double *to_source;  /* map (2, 2) from output to source tangents */
    float *resampled, *resampled_m;
} resample_job;

/* Item: a row of pixels. */
static void resample_row(void *argument, int y, int thread) {
    (void)thread;
    const resample_job *job = argument;
    const double *tangents = job->tangents, *map = job->to_source;
    int64_t height = job->height, width = job->width;
    double v = tangents[1] + (y + 0.5) * tangents[3];
    for (int64_t x = 0; x < width; ++x) {
        double u = tangents[0] + ((double)x + 0.5) * tangents[2];
        double s = (map[0] * u + map[1] * v - tangents[0]) / tangents[2] - 0.5;
        double t = (map[2] * u + map[3] * v - tangents[1]) / tangents[3] - 0.5;
        s = clipped(s, 0.0, (double)width - 1.0);
        t = clipped(t, 0.0, (double)height - 1.0);
        int64_t i = smaller_index((int64_t)t, larger_index(height - 2, 0));
        int64_t j = smaller_index((int64_t)s, larger_index(width - 2, 0));
        int64_t below = smaller_index(i + 1, height - 1), right = smaller_index(j + 1, width - 1);
        double p = s - (double)j, q = t - (double)i;
        int64_t nearest = smaller_index((int64_t)(t + 0.5), height - 1) * width
                          + smaller_index((int64_t)(s + 0.5), width - 1);
        job->resampled_m[y * width + x] = job->depth_m[nearest];
        const float *over = job->color + RGB * i * width;
        const float *under = job->color + RGB * below * width;
        for (int c = 0; c < RGB; ++c) {
            int64_t from = RGB * j + c, to = RGB * right + c;
            double high = (double)over[from] + p * (double)(over[to] - over[from]);
            double low = (double)under[from] + p * (double)(under[to] - under[from]);
            job->resampled[RGB * (y * width + x) + c] = (float)(high + q * (low - high));
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

#endif

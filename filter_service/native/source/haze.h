/* Straylight: means of the cells of a coarse grid, and interpolation between the cells.  The
 * caller convolves the means; see rendering/media_effects.py. */
#ifndef OCU_HAZE_H
#define OCU_HAZE_H

#include "bounds.h"
#include "constants.h"
#include "pool.h"

typedef struct {
    const float *image;       /* (height, width, 3) */
    int64_t width;
    const int64_t *rows, *columns;              /* first pixel of each cell */
    const double *row_shares, *column_shares;   /* of this pixel and the following ones */
    int64_t row_steps, column_steps, cells;     /* shares of a cell; cells of a row */
    float *coarse;            /* (rows, cells, 3) */
} mean_job;

/* Item: a row of cells. */
static void mean_row(void *argument, int i, int thread) {
    (void)thread;
    const mean_job *job = argument;
    const double *row_shares = job->row_shares + i * job->row_steps;
    for (int64_t j = 0; j < job->cells; ++j) {
        const double *column_shares = job->column_shares + j * job->column_steps;
        double red = 0.0, green = 0.0, blue = 0.0;
        for (int64_t k = 0; k < job->row_steps; ++k) {
            if (row_shares[k] == 0.0) continue; /* the cell has fewer rows of pixels */
            const float *pixel =
                job->image + RGB * ((job->rows[i] + k) * job->width + job->columns[j]);
            for (int64_t n = 0; n < job->column_steps; ++n, pixel += RGB) {
                double share = row_shares[k] * column_shares[n];
                if (share == 0.0) continue;
                red += share * (double)pixel[0];
                green += share * (double)pixel[1];
                blue += share * (double)pixel[2];
            }
        }
        float *mean = job->coarse + RGB * (i * job->cells + j);
        mean[0] = (float)red;
        mean[1] = (float)green;
        mean[2] = (float)blue;
    }
}

/* Writes the mean light of cells (n_rows, n_columns, 3). */
static void cell_means(pool *threads, const float *image, int64_t width, const int64_t *rows,
                       const double *row_shares, int64_t n_rows, int64_t row_steps,
                       const int64_t *columns, const double *column_shares,
                       int64_t n_columns, int64_t column_steps, float *coarse) {
    mean_job job = {image,     width,        rows,      columns, row_shares, column_shares,
                    row_steps, column_steps, n_columns, coarse};
    pool_run(threads, (int)n_rows, mean_row, &job);
}

typedef struct {
    float *image;             /* (height, width, 3) */
    int64_t width;
    const float *coarse;      /* (rows, columns, 3) */
    int64_t rows, columns;
    const double *row_at, *column_at; /* pixel centers in cells, whose centers are integers */
    double unscattered_ratio;
    const double *gains;      /* (3,) */
} scatter_job;

/* Item: a row of pixels. */
static void scatter_row(void *argument, int y, int thread) {
    (void)thread;
    const scatter_job *job = argument;
    int64_t i = smaller_index((int64_t)job->row_at[y], larger_index(job->rows - 2, 0));
    double v = job->row_at[y] - (double)i;
    const float *above = job->coarse + RGB * job->columns * i;
    const float *below = i + 1 < job->rows ? above + RGB * job->columns : above;
    float *pixel = job->image + RGB * job->width * y;
    int64_t last = larger_index(job->columns - 2, 0);
    for (int64_t x = 0; x < job->width; ++x, pixel += RGB) {
        int64_t j = smaller_index((int64_t)job->column_at[x], last);
        double u = job->column_at[x] - (double)j;
        int64_t left = RGB * j, right = j + 1 < job->columns ? left + RGB : left;
        for (int c = 0; c < RGB; ++c) {
            double over = (double)above[left + c]
                          + u * (double)(above[right + c] - above[left + c]);
            double under = (double)below[left + c]
                           + u * (double)(below[right + c] - below[left + c]);
            double light = job->unscattered_ratio * (double)pixel[c];
            pixel[c] = (float)(job->gains[c] * (light + over + v * (under - over)));
        }
    }
}

/* Attenuates an image by scattering and by the media, and adds the scattered light. */
static void add_scattered(pool *threads, float *image, int64_t height, int64_t width,
                          const float *coarse, int64_t rows, int64_t columns,
                          const double *row_at, const double *column_at,
                          double unscattered_ratio, const double *gains) {
    scatter_job job = {image,  width,     coarse,            rows, columns,
                       row_at, column_at, unscattered_ratio, gains};
    pool_run(threads, (int)height, scatter_row, &job);
}

#endif

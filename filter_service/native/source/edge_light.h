/* Light that the edge of the pupil diffracts beyond kernels.
 *
 * An edge element ds with slope s and normal n lights the points p = s + d n, for d of either
 * sign.  With f = (p - s) . t for the tangent t, these are the elements where f changes its
 * sign along the edge, and the density there is 1 / d^2 |ds / df|, see needed_radius_px in
 * estimator/psf/survey.py.  Its mean over a pixel is taken along t and n, so that it is finite
 * on caustics, where f has a double zero. */
#ifndef OCU_EDGE_LIGHT_H
#define OCU_EDGE_LIGHT_H

#include <math.h>

#include "edge_job.h"
#include "store_reads.h"
#include "vectors.h"

/* Rows of an edge: slopes, tangents and normals, lengths, and sines of the angle to the next
 * tangent. */
enum { SLOPE_X, SLOPE_Y, TANGENT_X, TANGENT_Y, NORMAL_X, NORMAL_Y, LENGTH, TURN, EDGE_ROWS };

/* An interval of f shorter than this, px, is taken as this long, so that it counts once. */
#define MIN_CHANGE_PX 1e-3f
/* Least share of a kernel that is omitted at a pixel to which light is added. */
#define MIN_OMITTED 1e-6f

typedef struct { f32x8 across, along; } edge_place;

/* Place of a point (x, y) along the tangents and normals of eight elements. */
INLINE edge_place place_at_edge(const float *edge, int first, float x, float y) {
    const float *row = edge + first;
    f32x8 from_x = all8(x) - load8(row + SLOPE_X * N_EDGE);
    f32x8 from_y = all8(y) - load8(row + SLOPE_Y * N_EDGE);
    edge_place found;
    found.across = from_x * load8(row + TANGENT_X * N_EDGE)
                   + from_y * load8(row + TANGENT_Y * N_EDGE);
    found.along = from_x * load8(row + NORMAL_X * N_EDGE)
                  + from_y * load8(row + NORMAL_Y * N_EDGE);
    return found;
}

/* Values of eight elements moved by one, with that of the next eight. */
INLINE f32x8 next_of(f32x8 own, f32x8 next) { return MIXED(own, next, 1, 2, 3, 4, 5, 6, 7, 8); }

/* Returns the density of the light that an edge (EDGE_ROWS, N_EDGE) sends to a point, px;
 * `seen` (N_EDGE,) is the visible share from each element to the next. */
static float edge_density(const float *edge, const float *seen, float x, float y) {
    f32x8 total = all8(0.0f), half = all8(0.5f);
    edge_place first = place_at_edge(edge, 0, x, y), here = first;
    for (int at = 0; at < N_EDGE; at += 8) {
        edge_place ahead = at + 8 < N_EDGE ? place_at_edge(edge, at + 8, x, y) : first;
        f32x8 across = next_of(here.across, ahead.across);
        f32x8 rise = across - here.across, middle = half * (across + here.across);
        f32x8 change = larger8(size8(rise), all8(MIN_CHANGE_PX));
        f32x8 low = larger8(middle - half * change, -half);
        f32x8 high = smaller8(middle + half * change, half);
        f32x8 overlap = larger8(high - low, all8(0.0f));
        /* At the zero of f: the normal turns between the elements. */
        f32x8 distance = half * (here.along + next_of(here.along, ahead.along))
                         - all8(1.0f / 6.0f) * load8(edge + TURN * N_EDGE + at) * rise;
        f32x8 square = larger8(distance * distance, all8(1.0f)) - all8(0.25f);
        f32x8 strength = load8(seen + at) * load8(edge + LENGTH * N_EDGE + at);
        total += strength * overlap / (change * square);
        here = ahead;
    }
    total += across8(total, 3);
    total += across8(total, 2);
    return total[0] + total[1];
}

typedef struct {
    const float *edges;       /* (n_kinds, 3, EDGE_ROWS, N_EDGE) */
    const int64_t *kernel_kind;
    const float *seen;        /* (n, N_EDGE) */
    const float *rho_px, *directions;           /* (n_rho,), (n_phi, 2) */
    int64_t n_rho, n_phi, steps;                /* steps between two distances */
    float *polar;             /* (n, n_phi, (n_rho - 1) steps + 1, 3) */
} polar_job;

/* Item: a direction of a kernel. */
static void polar_line(void *argument, int line, int thread) {
    (void)thread;
    const polar_job *job = argument;
    int64_t n = line / job->n_phi;
    const float *direction = job->directions + 2 * (line % job->n_phi);
    const float *edges = job->edges + RGB * EDGE_ROWS * N_EDGE * job->kernel_kind[n];
    float *light = job->polar + RGB * ((job->n_rho - 1) * job->steps + 1) * line;
    float before[RGB] = {0.0f};
    for (int64_t r = 0; r < job->n_rho; ++r) {
        float rho = job->rho_px[r], x = rho * direction[0], y = rho * direction[1];
        for (int c = 0; c < RGB; ++c) {
            const float *edge = edges + EDGE_ROWS * N_EDGE * c;
            float found = edge_density(edge, job->seen + N_EDGE * n, x, y) * (rho * rho * rho);
            light[RGB * job->steps * r + c] = found;
            float root = 1.0f / sqrtf(larger_float(found, 1e-12f));
            for (int64_t k = 1; r > 0 && k < job->steps; ++k) {
                float part = (float)k / (float)job->steps;
                float between = before[c] + part * (root - before[c]);
                light[RGB * (job->steps * (r - 1) + k) + c] = 1.0f / (between * between);
            }
            before[c] = root;
        }
    }
}

/* Writes tables of light times rho^3.  It is computed at distances, and interpolated so that
 * the reciprocals of the distances are evenly spaced between them.  For a round spot of radius
 * g, (light rho^3)^-1/2 is proportional to 1 - g / rho, and so linear in 1 / rho. */
static void fill_polar(pool *threads, const float *edges, const int64_t *kernel_kind,
                       const float *seen, int64_t count, const float *rho_px, int64_t n_rho,
                       const float *directions, int64_t n_phi, int64_t steps, float *polar) {
    polar_job job = {edges, kernel_kind, seen,  rho_px, directions,
                     n_rho, n_phi,       steps, polar};
    pool_run(threads, (int)(count * n_phi), polar_line, &job);
}

/* Writes the light of a pixel near a source, where the kernel omits a share of it. */
INLINE void near_pixel(const light_job *job, int64_t n, int64_t row, int64_t column, float x,
                       float y, float *light) {
    const float *edges = job->edges + RGB * EDGE_ROWS * N_EDGE * job->kernel_kind[n];
    const float *omitted = job->omitted + RGB * job->side * job->side * job->omitted_index[n];
    for (int c = 0; c < RGB; ++c) {
        float ratio = omitted[(c * job->side + row) * job->side + column];
        if (ratio <= MIN_OMITTED) continue;
        const float *edge = edges + EDGE_ROWS * N_EDGE * c;
        light[c] = ratio * edge_density(edge, job->seen + N_EDGE * n, x, y);
    }
}

/* Writes the light of a pixel from the tables. */
INLINE void distant_pixel(const light_job *job, const float *polar, float factor, float rho,
                          float phi, float *light) {
    int64_t r = (int64_t)rho, m = (int64_t)phi;
    float right = rho - (float)r, down = phi - (float)m;
    if (m >= job->n_phi) m -= job->n_phi; /* rounded up */
    int64_t after = m + 1 < job->n_phi ? m + 1 : 0;
    const float *own = polar + RGB * (m * job->n_fine + r);
    const float *next = polar + RGB * (after * job->n_fine + r);
    for (int c = 0; c < RGB; ++c) {
        float first = own[c] + right * (own[RGB + c] - own[c]);
        float last = next[c] + right * (next[RGB + c] - next[c]);
        light[c] = factor * (first + down * (last - first));
    }
}

/* Item: a row of a kernel. */
static void light_row(void *argument, int line, int thread) {
    (void)thread;
    const light_job *job = argument;
    int64_t side = job->side, n = line / side, row = line % side;
    const float *polar = job->polar + RGB * job->n_phi * job->n_fine * n;
    float *light = job->kernels + RGB * side * line;
    float square_px = job->omitted == NULL ? 0.0f : job->radius_px[n] * job->radius_px[n];
    float y = (float)(row - side / 2);
    memset(light, 0, RGB * (size_t)side * sizeof *light);
    for (int64_t column = 0; column < side; ++column, light += RGB) {
        float x = (float)(column - side / 2);
        int64_t at = row * side + column;
        if (job->share_ratio[at] == 0.0f) continue;
        if (x * x + y * y < square_px) near_pixel(job, n, row, column, x, y, light);
        else
            distant_pixel(job, polar, job->share_ratio[at], job->rho_index[at],
                          job->phi_index[at], light);
    }
}

/* Writes kernels of light. */
static void fill_light(light_job *job) {
    pool_run(job->threads, (int)(job->count * job->side), light_row, job);
}

/* Subtracts the share of a tap from the pixels that its kernel reaches. */
INLINE void subtract_box(const double *map, uint32_t sides_px, int64_t half, int64_t around,
                         double share, float *omitted) {
    double left = -(double)(sides_px & 255u) - 0.5, right = (double)(sides_px >> 8 & 255u) + 0.5;
    double up = -(double)(sides_px >> 16 & 255u) - 0.5, down = (double)(sides_px >> 24) + 0.5;
    for (int64_t y = -around; y <= around; ++y) {
        float *row = omitted + (half + y) * (2 * half + 1) + half;
        for (int64_t x = -around; x <= around; ++x) {
            double u = map[0] * (double)x + map[1] * (double)y;
            double v = map[2] * (double)x + map[3] * (double)y;
            int is_inside = (u > left) & (u < right) & (v > up) & (v < down);
            row[x] = (float)((double)row[x] - (is_inside ? share : 0.0));
        }
    }
}

/* Item: a channel of a kernel. */
static void omit_channel(void *argument, int item, int thread) {
    (void)thread;
    const omitted_job *job = argument;
    const state_reads *reads = &job->reads;
    int64_t n = item / RGB, channel = item % RGB, half = job->side / 2;
    float *omitted = job->omitted + job->side * job->side * item;
    int64_t around = smaller_index(job->reach_px[n], half);
    int64_t uppers[RECIPE_TAPS / 2], psfs[RECIPE_TAPS];
    double weights[RECIPE_TAPS];
    for (int64_t at = 0; at < job->side * job->side; ++at) omitted[at] = 1.0f;
    for (int64_t j = FIELD_CORNERS * n; j < FIELD_CORNERS * (n + 1); ++j) {
        int64_t node = job->nodes[j];
        for (int64_t layer = 2 * n; layer < 2 * (n + 1); ++layer) {
            if (job->weight_ratio[j] == 0.0 || job->layer_ratio[layer] == 0.0) continue;
            for (int64_t corner = 0; corner < reads->count; ++corner)
                uppers[corner] = job->tables.starts[reads->groups[corner] + node];
            double total_dpt = job->layer_dpt[layer] + job->zero_dpt[RGB * node + channel];
            channel_taps(&job->tables, reads, node, (int)channel, total_dpt, uppers, psfs,
                         weights);
            int64_t part = FIELD_CORNERS * layer + j - FIELD_CORNERS * n;
            const double *map = job->maps + 4 * part;
            for (int64_t tap = 0; tap < 2 * reads->count; ++tap) {
                double share =
                    weights[tap] * job->weight_ratio[j] * job->layer_ratio[layer];
                if (share != 0.0)
                    subtract_box(map, job->tables.reach_words[psfs[tap]], half,
                                 around, share, omitted);
            }
        }
    }
}

/* Writes the share of blended kernels that ends before each pixel. */
static void fill_omitted(omitted_job *job) {
    pool_run(job->threads, (int)(RGB * job->count), omit_channel, job);
}

#endif

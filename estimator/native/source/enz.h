/* Extended Nijboer-Zernike series: Bessel functions, their sums over a pupil, and the light of
 * the image.  Twins: scipy.special.jv, and sums of it. */
#ifndef OCU_ENZ_H
#define OCU_ENZ_H

#include <math.h>
#include <stdint.h>

#include "lanes.h"

#define N_NODE_VECTORS 2                    /* dependent on nothing of each other */
#define N_NODES (N_NODE_VECTORS * N_LANES)  /* that are processed at once */
/* Argument above which J_0 and J_1 are computed by Hankel's expansion, to 1e-15. */
#define UPWARD_FROM 50.0
#define HANKEL_TERMS 12
/* Numbers of Miller's recurrence beyond this are scaled down; they grow by up to 2^58 from one
 * order to the next, and every fourth is checked. */
#define LARGE_NUMBER 1e150
#define LEAST_ARGUMENT 1e-15

/* J_order(x) for an order of 0 or 1 and large x. */
static double hankel_asymptotic(int order, double x) {
    double term = 1.0, even = 1.0, odd = 0.0;
    for (int k = 1; k <= HANKEL_TERMS; ++k) {
        double step = 2.0 * k - 1.0;
        term *= (4.0 * order * order - step * step) / (8.0 * k * x);
        if (k % 2 == 0) even += k % 4 == 2 ? -term : term;
        else odd += k % 4 == 1 ? term : -term;
    }
    double phase = x - (0.5 * order + 0.25) * M_PI;
    return sqrt(2.0 / (M_PI * x)) * (even * cos(phase) - odd * sin(phase));
}

/* J_0 ... J_(count - 1) at arguments above UPWARD_FROM and count + 1, by the recurrence to
 * higher orders, which is stable for orders below the argument.  found: (count,
 * N_NODES). */
INLINE void bessel_upward(const lanes *x, int64_t count, double *found) {
    lanes below[N_NODE_VECTORS], here[N_NODE_VECTORS], inverse[N_NODE_VECTORS];
    for (int v = 0; v < N_NODE_VECTORS; ++v) {
        inverse[v] = 1.0 / x[v];
        for (int i = 0; i < N_LANES; ++i) {
            below[v][i] = hankel_asymptotic(0, x[v][i]);
            here[v][i] = hankel_asymptotic(1, x[v][i]);
        }
    }
    for (int64_t order = 0; order < count; ++order)
        for (int v = 0; v < N_NODE_VECTORS; ++v) {
            store_lanes(found + order * N_NODES + v * N_LANES, below[v]);
            lanes above = 2.0 * ((double)order + 1.0) * inverse[v] * here[v] - below[v];
            below[v] = here[v];
            here[v] = above;
        }
}

INLINE void scale_lanes(double *values, lanes scale) {
    store_lanes(values, load_lanes(values) * scale);
}

/* The same at any arguments by Miller's recurrence to lower orders, which starts above both
 * orders and arguments. */
INLINE void bessel_downward(const lanes *x, double largest, int64_t count, double *found) {
    lanes above[N_NODE_VECTORS], here[N_NODE_VECTORS], norm[N_NODE_VECTORS];
    lanes inverse[N_NODE_VECTORS];
    double from = largest > (double)count ? largest : (double)count;
    int64_t start = 2 * (((int64_t)from + 30 + (int64_t)(6.0 * cbrt(largest))) / 2);
    for (int v = 0; v < N_NODE_VECTORS; ++v) {
        inverse[v] = 1.0 / x[v];
        above[v] = norm[v] = all_lanes(0.0);
        here[v] = all_lanes(1e-300);
    }
    for (int64_t order = start; order > 0; --order) {
        for (int v = 0; v < N_NODE_VECTORS; ++v) {
            lanes below = 2.0 * (double)order * inverse[v] * here[v] - above[v];
            above[v] = here[v];
            here[v] = below;
            if (order <= count) store_lanes(found + (order - 1) * N_NODES + v * N_LANES, below);
            /* 1 = J_0 + 2 J_2 + 2 J_4 ... */
            if (order % 2 == 1) norm[v] += order == 1 ? below : 2.0 * below;
        }
        if (order % 4 != 0) continue;
        for (int v = 0; v < N_NODE_VECTORS; ++v) {
            flags is_large = size_of_lanes(here[v]) > all_lanes(LARGE_NUMBER);
            if (!any_lane(is_large)) continue;
            lanes scale = chosen(is_large, all_lanes(1.0 / LARGE_NUMBER), all_lanes(1.0));
            above[v] *= scale;
            here[v] *= scale;
            norm[v] *= scale;
            for (int64_t k = order - 1; k < count; ++k)
                scale_lanes(found + k * N_NODES + v * N_LANES, scale);
        }
    }
    for (int v = 0; v < N_NODE_VECTORS; ++v) {
        lanes scale = 1.0 / norm[v];
        for (int64_t k = 0; k < count; ++k)
            scale_lanes(found + k * N_NODES + v * N_LANES, scale);
    }
}

static void bessel_at_zero(int64_t count, double *found) {
    for (int64_t i = 0; i < count * N_NODES; ++i) found[i] = i < N_NODES ? 1.0 : 0.0;
}

/* Sums over nodes: found (n_r, n_rows, n_orders) = sum of weighted J_m(2 pi r rho).
 *
 * weighted: (n_rho / 8, n_rows, n_orders, 8), which are blocks of N_NODES nodes; work:
 * (n_rows + 1, n_orders, 8). */
static void hankel_table(const double *r, const double *rho, const double *weighted,
                         double *found, double *work, int64_t n_r, int64_t n_rho,
                         int64_t n_rows, int64_t n_orders) {
    int64_t count = n_rows * n_orders;
    double *bessel = work, *sums = work + n_orders * N_NODES;
    for (int64_t q = 0; q < n_r; ++q, found += count) {
        for (int64_t i = 0; i < count * N_NODES; ++i) sums[i] = 0.0;
        for (int64_t first = 0; first < n_rho; first += N_NODES) {
            lanes x[N_NODE_VECTORS];
            double least = INFINITY, largest = 0.0;
            for (int v = 0; v < N_NODE_VECTORS; ++v) {
                x[v] = 2.0 * M_PI * r[q] * load_lanes(rho + first + v * N_LANES);
                x[v] = larger_lanes(x[v], all_lanes(LEAST_ARGUMENT));
                for (int i = 0; i < N_LANES; ++i) {
                    least = x[v][i] < least ? x[v][i] : least;
                    largest = x[v][i] > largest ? x[v][i] : largest;
                }
            }
            if (least > UPWARD_FROM && least > (double)n_orders + 1.0)
                bessel_upward(x, n_orders, bessel);
            else if (largest > LEAST_ARGUMENT) bessel_downward(x, largest, n_orders, bessel);
            else bessel_at_zero(n_orders, bessel);
            const double *weights = weighted + first * count;
            int64_t width = n_orders * N_NODES;
            for (int64_t row = 0; row < n_rows; ++row, weights += width)
                for (int64_t k = 0; k < width; ++k)
                    sums[row * width + k] += weights[k] * bessel[k];
        }
        for (int64_t i = 0; i < count; ++i) {
            found[i] = 0.0;
            for (int64_t k = 0; k < N_NODES; ++k) found[i] += sums[i * N_NODES + k];
        }
    }
}

/* Weights of four samples of a cubic interpolation at t from the second. */
INLINE void cubic_weights(double t, double weights[4]) {
    weights[0] = -t * (t - 1.0) * (t - 2.0) / 6.0;
    weights[1] = (t + 1.0) * (t - 1.0) * (t - 2.0) / 2.0;
    weights[2] = -(t + 1.0) * t * (t - 2.0) / 2.0;
    weights[3] = (t + 1.0) * t * (t - 1.0) / 6.0;
}

/* |U|^2 of an image at the points q = (from_px[0] x + from_px[1] y, from_px[2] x +
 * from_px[3] y) of a grid (n_y, n_x), with U = sum of A_m(r) cos(m phi) + i B_m(r) sin(m phi).
 *
 * table: (n_r, 4, n_orders), the real and imaginary parts of A and of B at the radii -1, 0, 1
 * ... / per_r; n_orders is a multiple of N_LANES. */
static void image_light(const double *from_px, const double *x_px, const double *y_px,
                        const double *table, double *found, int64_t n_x, int64_t n_y,
                        int64_t n_r, int64_t n_orders, double per_r) {
    int64_t stride = 4 * n_orders;
    for (int64_t j = 0; j < n_y; ++j)
        for (int64_t i = 0; i < n_x; ++i) {
            double qx = from_px[0] * x_px[i] + from_px[1] * y_px[j];
            double qy = from_px[2] * x_px[i] + from_px[3] * y_px[j];
            double r = sqrt(qx * qx + qy * qy), place = r * per_r + 1.0, w[4];
            double c = r > 1e-12 ? qx / r : 1.0, s = r > 1e-12 ? qy / r : 0.0;
            int64_t k = (int64_t)place < n_r - 3 ? (int64_t)place : n_r - 3;
            cubic_weights(place - (double)k, w);
            /* Cosines and sines of multiples of phi, and of the step to the next vector. */
            double c2 = c * c - s * s, s2 = 2.0 * c * s;
            lanes cosine = {1.0, c, c2, c2 * c - s2 * s}, sine = {0.0, s, s2, s2 * c + c2 * s};
            double step_c = c2 * c2 - s2 * s2, step_s = 2.0 * c2 * s2;
            lanes real = all_lanes(0.0), imaginary = real;
            const double *from = table + (k - 1) * stride;
            for (int64_t m = 0; m < n_orders; m += N_LANES, from += N_LANES) {
                lanes parts[4];
                for (int part = 0; part < 4; ++part) {
                    const double *at = from + part * n_orders;
                    parts[part] = w[0] * load_lanes(at) + w[1] * load_lanes(at + stride)
                                  + w[2] * load_lanes(at + 2 * stride)
                                  + w[3] * load_lanes(at + 3 * stride);
                }
                real += parts[0] * cosine - parts[3] * sine;
                imaginary += parts[1] * cosine + parts[2] * sine;
                lanes turned = step_c * cosine - step_s * sine;
                sine = step_s * cosine + step_c * sine;
                cosine = turned;
            }
            double a = sum_of_lanes(real), b = sum_of_lanes(imaginary);
            found[j * n_x + i] = a * a + b * b;
        }
}

#endif

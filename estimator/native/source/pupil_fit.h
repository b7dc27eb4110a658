/* Fits to wavefront samples: Zernike coefficients, radius of the rim, ellipse. */
#ifndef OCU_PUPIL_FIT_H
#define OCU_PUPIL_FIT_H

#include "lanes.h"
#include "terms.h"

#define PIVOT_LIMIT 1e-13 /* smallest pivot, relative to the diagonal, of a regular matrix */

enum { RIM_STEPS = 20, CONIC_TERMS = 5 };

/* Columns of an ellipse. */
enum {
    CENTER_X = 0,
    CENTER_Y = 1,
    SEMI_MAJOR = 2,
    SEMI_MINOR = 3,
    MAJOR_AXIS_RAD = 4,
    N_ELLIPSE = 5
};

/* Samples of a wavefront, (count,) each; the count is a multiple of N_LANES. */
typedef struct {
    double *x, *y;             /* mm */
    double *w;                 /* um */
    double *slope_x, *slope_y; /* um/mm */
    double *weight;            /* 0 excludes a sample */
    int count;
} sample_table;

/* Zernike polynomials as sums of monomials: those of term j are entries[start[j]] and so on. */
typedef struct {
    int order, n_terms;
    int start[MOST_TERMS + 1];
    struct {
        int monomial; /* by degree, then by the power of y */
        double factor;
    } entries[MOST_TERMS * MOST_TERMS];
} zernike_terms;

/* Fills the table from a matrix (n_terms, n_terms), row j the monomials of term j. */
static void read_terms(zernike_terms *z, const double *monomials, int n_terms) {
    int count = 0;
    z->n_terms = n_terms;
    z->order = 0;
    while ((z->order + 1) * (z->order + 2) / 2 < n_terms) ++z->order;
    for (int j = 0; j < n_terms; ++j) {
        z->start[j] = count;
        for (int t = 0; t < n_terms; ++t) {
            if (monomials[j * n_terms + t] == 0.0) continue;
            z->entries[count].monomial = t;
            z->entries[count++].factor = monomials[j * n_terms + t];
        }
    }
    z->start[n_terms] = count;
}

/* Adds the monomials (n_terms,) of coefficients. */
static void add_monomials(const zernike_terms *z, const double *zernike_um, double *monomials) {
    for (int j = 0; j < z->n_terms; ++j)
        for (int k = z->start[j]; k < z->start[j + 1]; ++k)
            monomials[z->entries[k].monomial] += z->entries[k].factor * zernike_um[j];
}

/* Writes the polynomials (n_terms, count) at points of the unit circle, or their derivatives of
 * order d_x, d_y, which is 0 or 1. */
static void write_basis(const zernike_terms *z, const sample_table *s, double radius_mm, int d_x,
                        int d_y, double *basis) {
    for (int i = 0; i < s->count; i += N_LANES) {
        lanes x = load_lanes(s->x + i) / radius_mm, y = load_lanes(s->y + i) / radius_mm;
        lanes power_x[MOST_ORDER + 1], power_y[MOST_ORDER + 1], monomials[MOST_TERMS];
        power_x[0] = power_y[0] = all_lanes(1.0);
        for (int k = 0; k < z->order; ++k) {
            power_x[k + 1] = power_x[k] * x;
            power_y[k + 1] = power_y[k] * y;
        }
        int t = 0;
        for (int degree = 0; degree <= z->order; ++degree)
            for (int b = 0; b <= degree; ++b, ++t) {
                int a = degree - b;
                double factor = (d_x ? a : 1.0) * (d_y ? b : 1.0);
                monomials[t] = a < d_x || b < d_y
                                   ? (lanes){0.0}
                                   : factor * power_x[a - d_x] * power_y[b - d_y];
            }
        for (int j = 0; j < z->n_terms; ++j) {
            lanes sum = {0.0};
            for (int k = z->start[j]; k < z->start[j + 1]; ++k)
                sum += z->entries[k].factor * monomials[z->entries[k].monomial];
            store_lanes(basis + (ptrdiff_t)j * s->count + i, sum);
        }
    }
}

/* Length of the rows of a matrix of n columns. */
INLINE int row_length(int n) { return (n + N_LANES - 1) / N_LANES * N_LANES; }

static double dot_of_samples(const double *a, const double *b, int count) {
    lanes sum = {0.0};
    for (int i = 0; i < count; i += N_LANES) sum += load_lanes(a + i) * load_lanes(b + i);
    return sum_of_lanes(sum);
}

/* Adds the products of the weighted polynomials from term `first` on: with one another to the
 * upper triangle of the matrix, and with the values, times `scale`, to the right side. */
static void add_normal_equations(const double *basis, const sample_table *s,
                                 const double *values, double scale, int first, int n_terms,
                                 double *weighted, double *matrix, double *right) {
    int count = s->count, n = n_terms - first, length = row_length(n);
    for (int i = 0; i < n; ++i) {
        const double *own = basis + (ptrdiff_t)(first + i) * count;
        for (int k = 0; k < count; k += N_LANES)
            store_lanes(weighted + k, load_lanes(own + k) * load_lanes(s->weight + k));
        right[i] += scale * dot_of_samples(weighted, values, count);
        int j = i;
        /* Four sums at a time keep the processor's units busy. */
        for (; j + 3 < n; j += 4) {
            const double *other = basis + (ptrdiff_t)(first + j) * count;
            lanes sums[4] = {{0.0}, {0.0}, {0.0}, {0.0}};
            for (int k = 0; k < count; k += N_LANES) {
                lanes value = load_lanes(weighted + k);
                for (int m = 0; m < 4; ++m)
                    sums[m] += value * load_lanes(other + (ptrdiff_t)m * count + k);
            }
            for (int m = 0; m < 4; ++m) matrix[i * length + j + m] += sum_of_lanes(sums[m]);
        }
        for (; j < n; ++j)
            matrix[i * length + j] +=
                dot_of_samples(weighted, basis + (ptrdiff_t)(first + j) * count, count);
    }
}

/* Solves a symmetric system (n, row_length(n)) in place from its upper triangle; 0 if it is
 * singular.  Vectors also change numbers beside the triangle, which are not used. */
static int solve_symmetric(double *matrix, double *right, int n) {
    int length = row_length(n);
    double diagonal[MOST_TERMS];
    for (int k = 0; k < n; ++k) diagonal[k] = matrix[k * length + k];
    for (int k = 0; k < n; ++k) {
        double *row = matrix + (ptrdiff_t)k * length;
        if (!(row[k] > PIVOT_LIMIT * diagonal[k])) return 0;
        double inverse = 1.0 / sqrt(row[k]);
        for (int j = k; j < n; ++j) row[j] *= inverse;
        for (int i = k + 1; i < n; ++i) {
            double factor = row[i], *other = matrix + (ptrdiff_t)i * length;
            for (int j = i / N_LANES * N_LANES; j < length; j += N_LANES)
                store_lanes(other + j, load_lanes(other + j) - factor * load_lanes(row + j));
        }
    }
    for (int k = 0; k < n; ++k) {
        const double *row = matrix + (ptrdiff_t)k * length;
        right[k] /= row[k];
        for (int j = k + 1; j < n; ++j) right[j] -= right[k] * row[j];
    }
    for (int k = n - 1; k >= 0; --k) {
        const double *row = matrix + (ptrdiff_t)k * length;
        double total = right[k];
        for (int j = k + 1; j < n; ++j) total -= row[j] * right[j];
        right[k] = total / row[k];
    }
    return 1;
}

/* Memory of a fit: (n_terms, count), (n_terms, row_length(n_terms)) and (count,). */
typedef struct {
    double *basis, *matrix, *row;
} fit_work;

/* Fits coefficients, um, to the samples by weighted least squares; piston is zero.
 *
 * With `by_slopes`, the fit is to the slopes (Algorithm 1) instead of W.  Returns the RMS
 * residual of W without piston, um; NaN if the fit is singular. */
static double fit_zernike(const zernike_terms *z, const sample_table *s, double radius_mm,
                          int by_slopes, const fit_work *work, double *zernike_um) {
    int first = by_slopes ? 1 : 0, n = z->n_terms - first, count = s->count;
    double right[MOST_TERMS] = {0.0};
    memset(work->matrix, 0, sizeof(double) * (size_t)(n * row_length(n)));
    for (int d_y = 0; by_slopes && d_y < 2; ++d_y) {
        write_basis(z, s, radius_mm, 1 - d_y, d_y, work->basis);
        add_normal_equations(work->basis, s, d_y ? s->slope_y : s->slope_x, radius_mm, first,
                             z->n_terms, work->row, work->matrix, right);
    }
    write_basis(z, s, radius_mm, 0, 0, work->basis);
    if (!by_slopes)
        add_normal_equations(work->basis, s, s->w, 1.0, first, z->n_terms, work->row,
                             work->matrix, right);
    if (!solve_symmetric(work->matrix, right, n)) {
        for (int j = 0; j < z->n_terms; ++j) zernike_um[j] = NAN;
        return NAN;
    }
    zernike_um[0] = 0.0;
    memcpy(zernike_um + 1, right + 1 - first, sizeof(double) * (size_t)(z->n_terms - 1));
    double total = 0.0, mean = 0.0, squares = 0.0;
    for (int i = 0; i < count; i += N_LANES) {
        lanes rest = load_lanes(s->w + i), weight = load_lanes(s->weight + i);
        for (int j = 1; j < z->n_terms; ++j)
            rest -= zernike_um[j] * load_lanes(work->basis + (ptrdiff_t)j * count + i);
        store_lanes(work->row + i, rest);
        total += sum_of_lanes(weight);
        mean += sum_of_lanes(weight * rest);
    }
    mean /= total;
    for (int i = 0; i < count; i += N_LANES) {
        lanes rest = load_lanes(work->row + i) - mean;
        squares += sum_of_lanes(load_lanes(s->weight + i) * rest * rest);
    }
    return sqrt(squares / total);
}

/* Largest value of a Fourier series within `reach` of an angle, by Newton's method.  Cosines and
 * sines of multiples follow from those of the angle. */
static double series_peak(double mean, const double *even, const double *odd, int n_terms,
                          double angle, double reach) {
    double largest = 0.0, start = angle;
    for (int i = 0; i < RIM_STEPS; ++i) {
        double value = mean, slope = 0.0, bend = 0.0;
        double cosine = cos(angle), sine = sin(angle), c = 1.0, s = 0.0;
        for (int k = 1; k <= n_terms; ++k) {
            double before = c;
            c = before * cosine - s * sine;
            s = before * sine + s * cosine;
            value += even[k] * c + odd[k] * s;
            slope += k * (odd[k] * c - even[k] * s);
            bend -= (double)k * k * (even[k] * c + odd[k] * s);
        }
        if (value > largest) largest = value;
        double step = bend < 0.0 ? -slope / bend : copysign(0.25 * reach, slope);
        double next = fmin(fmax(angle + step, start - reach), start + reach);
        if (fabs(next - angle) < 1e-9) break;
        angle = next;
    }
    return largest;
}

/* Largest distance, mm, of rim points (n,) from the chief ray.  The azimuths (n, 2), cosine and
 * sine, are those of the stop, equally spaced; `series` is memory for 3 n numbers.
 *
 * The rim of an unvignetted pupil is smooth: Newton's method finds the maxima of the Fourier
 * series of its squared distance.  A vignetted rim has kinks, so the farthest of its points is
 * used. */
static double rim_radius(const double *x, const double *y, int n, const double *azimuths,
                         int is_whole, double *series) {
    double largest = 0.0, mean = 0.0, *squared = series, *even = series + n, *odd = even + n;
    for (int i = 0; i < n; ++i) {
        squared[i] = x[i] * x[i] + y[i] * y[i];
        if (squared[i] > largest) largest = squared[i];
        mean += squared[i] / n;
    }
    if (!is_whole) return sqrt(largest);
    int n_terms = (n - 1) / 2;
    double reach = 2.0 * M_PI / n;
    for (int k = 1; k <= n_terms; ++k) {
        even[k] = odd[k] = 0.0;
        for (int i = 0; i < n; ++i) {
            const double *direction = azimuths + 2 * (k * i % n);
            even[k] += 2.0 / n * squared[i] * direction[0];
            odd[k] += 2.0 / n * squared[i] * direction[1];
        }
    }
    for (int i = 0; i < n; ++i)
        if (squared[i] > squared[(i + n - 1) % n] && squared[i] >= squared[(i + 1) % n])
            largest = fmax(largest, series_peak(mean, even, odd, n_terms, reach * i, reach));
    return sqrt(largest);
}

/* Fits the conic a x² + b xy + c y² + d x + e y = 1 to rim points (n,), and writes the columns of
 * its ellipse; NaN if it is none. */
static void fit_ellipse(const double *x, const double *y, int n, double radius_mm,
                        double *ellipse) {
    enum { LENGTH = 2 * N_LANES };
    double matrix[CONIC_TERMS * LENGTH] = {0.0}, right[CONIC_TERMS] = {0.0};
    for (int i = 0; i < n; ++i) {
        double u = x[i] / radius_mm, v = y[i] / radius_mm;
        double row[CONIC_TERMS] = {u * u, u * v, v * v, u, v};
        for (int j = 0; j < CONIC_TERMS; ++j) {
            for (int k = j; k < CONIC_TERMS; ++k) matrix[j * LENGTH + k] += row[j] * row[k];
            right[j] += row[j];
        }
    }
    for (int j = 0; j < N_ELLIPSE; ++j) ellipse[j] = NAN;
    if (!solve_symmetric(matrix, right, CONIC_TERMS)) return;
    double a = right[0], b = right[1], c = right[2], d = right[3], e = right[4];
    double determinant = 4.0 * a * c - b * b;
    if (determinant <= 0.0) return;
    double cx = (b * e - 2.0 * c * d) / determinant, cy = (b * d - 2.0 * a * e) / determinant;
    double level = 1.0 + a * cx * cx + b * cx * cy + c * cy * cy;
    double half = 0.5 * (a + c), spread = 0.5 * hypot(a - c, b);
    ellipse[CENTER_X] = cx * radius_mm;
    ellipse[CENTER_Y] = cy * radius_mm;
    ellipse[SEMI_MAJOR] = radius_mm * sqrt(level / (half - spread));
    ellipse[SEMI_MINOR] = radius_mm * sqrt(level / (half + spread));
    /* The minor axis is along the eigenvector of the larger eigenvalue. */
    double axis = 0.5 * atan2(b, a - c) + 0.5 * M_PI;
    ellipse[MAJOR_AXIS_RAD] = axis - M_PI * floor(axis / M_PI);
}

#endif

/* The pupil of a PSF in pixel coordinates, and a survey of its wavefront; derived in
 * estimator/psf/pupil.py, survey.py and switch.py. */

#include <math.h>

typedef struct {
    int order;
    double box[MOST_TERMS];   /* um, over the bounding box */
    double disc[MOST_TERMS];  /* over the unit disc */
    double half[2], shear, root; /* um per px; root: sqrt(1 - shear^2) */
    double log_amplitude[LOG_AMPLITUDES];
    double wavelength_um;
    double low[2], high[2], blur_px; /* of the slopes, px */
    float edge[2][N_EDGE], normal[2][N_EDGE];
    double narrow_ratio, passed_ratio, edge_um, rays_ratio;
    double weight;            /* share of the kernel */
    int is_apodized;
    const float *rings;       /* a table, or NULL */
    double from_box_mm[6];    /* rows: position relative to the rings, of x, y and 1 */
} pupil;

/* Growing scratch memory of a thread. */
typedef struct {
    void *at;
    size_t size;
} scratch;

/* Buffer for `count` floats, aligned for vectors; NULL if out of memory.  Growing discards
 * the content. */
INLINE void *room_for(scratch *s, size_t count) {
    size_t size = sizeof(float) * count;
    if (size <= s->size) return s->at;
    free(s->at);
    s->size = 0;
    if (posix_memalign(&s->at, 64, size) != 0) s->at = NULL;
    if (s->at != NULL) s->size = size;
    return s->at;
}

/* Rounds down; numbers are small. */
INLINE f32x8 floor8(f32x8 value) {
    f32x8 whole = __builtin_convertvector(__builtin_convertvector(value, i32x8), f32x8);
    i32x8 is_above = whole > value; /* -1 where it is */
    return whole + __builtin_convertvector(is_above, f32x8);
}

#define NUMBERS8 ((f32x8){0, 1, 2, 3, 4, 5, 6, 7})

INLINE double square(double value) { return value * value; }
INLINE double larger_double(double a, double b) { return a > b ? a : b; }
INLINE double smaller_double(double a, double b) { return a < b ? a : b; }

INLINE int terms_of(int order) { return (order + 1) * (order + 2) / 2; }

/* Calls an inline function with the order of most eyes as a constant, so that its loops are
 * unrolled for it. */
#define FOR_ORDER(order, function, ...) \
    ((order) == 6 ? function(6, __VA_ARGS__) : function(order, __VA_ARGS__))

/* Exponents of x and y of term t; terms are ordered by degree. */
INLINE void exponents(int t, int *x, int *y) {
    int degree = 0;
    while ((degree + 1) * (degree + 2) / 2 <= t) ++degree;
    *y = t - degree * (degree + 1) / 2;
    *x = degree - *y;
}

/* Terms by powers of y and x. */
INLINE void fill_dense(int order, const double *terms, double scale,
                       double dense[MOST_POWERS][MOST_POWERS]) {
    for (int t = 0; t < terms_of(order); ++t) {
        int x, y;
        exponents(t, &x, &y);
        dense[y][x] = terms[t] / scale;
    }
}

/* out (n,) = in (n,) times a matrix (n, n). */
INLINE void times_matrix(int order, const double *in, const double *matrix, double *out) {
    double sum[MOST_TERMS];
    int n = terms_of(order);
    for (int t = 0; t < n; ++t) sum[t] = 0.0;
    for (int j = 0; j < n; ++j)
        for (int t = 0; t < n; ++t) sum[t] += in[j] * matrix[j * n + t];
    memcpy(out, sum, sizeof *sum * (size_t)n);
}

/* Coefficients of source(shift + matrix w), without the constant. */
INLINE void substitute(int order, const psf_tables *tables, const double *source,
                       const double matrix[4], const double shift[2], double *out) {
    double xs[MOST_POWERS][MOST_TERMS], ys[MOST_POWERS][MOST_TERMS], values[MOST_TERMS];
    int n = terms_of(order);
    const double *u = tables->node_xy, *v = u + n;
    for (int k = 0; k < n; ++k) {
        values[k] = 0.0;
        xs[0][k] = ys[0][k] = 1.0;
        xs[1][k] = shift[0] + matrix[0] * u[k] + matrix[1] * v[k];
        ys[1][k] = shift[1] + matrix[2] * u[k] + matrix[3] * v[k];
    }
    for (int i = 2; i <= order; ++i)
        for (int k = 0; k < n; ++k) {
            xs[i][k] = xs[i - 1][k] * xs[1][k];
            ys[i][k] = ys[i - 1][k] * ys[1][k];
        }
    int t = 1;
    for (int degree = 1; degree <= order; ++degree)
        for (int b = 0; b <= degree; ++b, ++t)
            for (int k = 0; k < n; ++k)
                values[k] += source[t] * xs[degree - b][k] * ys[b][k];
    times_matrix(order, values, tables->from_nodes, out);
    out[0] = 0.0;
}

/* Computes the wavefront over box and disc from monomials over a circle, of which `matrix`
 * and `shift` are the box. */
INLINE void place_wavefront(int order, const psf_tables *tables, const double *monomials_um,
                            const double matrix[4], const double shift[2], pupil *own) {
    own->order = order;
    substitute(order, tables, monomials_um, matrix, shift, own->box);
    if (own->shear == 0.0) {
        memcpy(own->disc, own->box, sizeof *own->disc * (size_t)terms_of(order));
        return;
    }
    const double lower[4] = {1.0, 0.0, own->shear, own->root}, none[2] = {0.0, 0.0};
    substitute(order, tables, own->box, lower, none, own->disc);
}

/* Computes half sides, shear, and the wavefront over box and disc, from monomials over a
 * circle. */
static void frame_pupil(const psf_tables *tables, const double *monomials_um,
                        double radius_mm, const double *ellipse, const double *jacobian,
                        pupil *own) {
    double cosine = cos(ellipse[4]), sine = sin(ellipse[4]);
    double major = square(ellipse[2]), minor = square(ellipse[3]);
    double exx = major * cosine * cosine + minor * sine * sine;
    double eyy = major * sine * sine + minor * cosine * cosine;
    double exy = (major - minor) * cosine * sine;
    double det = jacobian[0] * jacobian[3] - jacobian[1] * jacobian[2];
    double txx = jacobian[3] / det, txy = -jacobian[2] / det;
    double tyx = -jacobian[1] / det, tyy = jacobian[0] / det;
    double sxx = txx * txx * exx + 2.0 * txx * txy * exy + txy * txy * eyy;
    double syy = tyx * tyx * exx + 2.0 * tyx * tyy * exy + tyy * tyy * eyy;
    double sxy = txx * tyx * exx + (txx * tyy + txy * tyx) * exy + txy * tyy * eyy;
    own->half[0] = sqrt(sxx);
    own->half[1] = sqrt(syy);
    own->shear = sxy / (own->half[0] * own->half[1]);
    own->root = sqrt(1.0 - square(own->shear));
    double matrix[4], shift[2] = {ellipse[0] / radius_mm, ellipse[1] / radius_mm};
    for (int i = 0; i < 2; ++i)
        for (int q = 0; q < 2; ++q)
            matrix[2 * i + q] = jacobian[2 * q + i] * own->half[q] / radius_mm;
    FOR_ORDER(tables->order, place_wavefront, tables, monomials_um, matrix, shift, own);
}

/* Computes the apodization -k |u - u0|^2 over the box, and the light that passes. */
static void apodize_pupil(const psf_tables *tables, double per_mm2, const double *center_mm,
                          const double *ellipse, const double *jacobian, pupil *own) {
    double matrix[2][2], offset[2];
    for (int i = 0; i < 2; ++i) {
        offset[i] = ellipse[i] - center_mm[i];
        for (int q = 0; q < 2; ++q) matrix[i][q] = jacobian[2 * q + i] * own->half[q];
    }
    double *c = own->log_amplitude;
    c[0] = square(offset[0]) + square(offset[1]);
    c[1] = 2.0 * (offset[0] * matrix[0][0] + offset[1] * matrix[1][0]);
    c[2] = 2.0 * (offset[0] * matrix[0][1] + offset[1] * matrix[1][1]);
    c[3] = square(matrix[0][0]) + square(matrix[1][0]);
    c[4] = 2.0 * (matrix[0][0] * matrix[0][1] + matrix[1][0] * matrix[1][1]);
    c[5] = square(matrix[0][1]) + square(matrix[1][1]);
    for (int i = 0; i < LOG_AMPLITUDES; ++i) c[i] *= -per_mm2;
    double r = own->shear, s = own->root;
    const double disc[LOG_AMPLITUDES] = {
        c[0], c[1] + r * c[2], s * c[2],
        c[3] + r * c[4] + r * r * c[5], s * c[4] + 2.0 * r * s * c[5], s * s * c[5]};
    int count = tables->n_rings * tables->n_ring;
    double passed = 0.0, mean = 0.0;
    for (int ring = 0; ring < tables->n_rings; ++ring) {
        mean = 0.0;
        for (int i = 0; i < tables->n_ring; ++i) {
            const double *powers = tables->passed_powers + ring * tables->n_ring + i;
            double exponent = 0.0;
            for (int t = 0; t < LOG_AMPLITUDES; ++t) exponent += disc[t] * powers[t * count];
            mean += exp(2.0 * exponent);
        }
        mean /= tables->n_ring;
        if (ring + 1 < tables->n_rings) passed += mean * tables->ring_weights[ring];
    }
    own->is_apodized = 1;
    own->passed_ratio = passed;
    own->edge_um = own->wavelength_um * mean / passed; /* mean: of the edge */
}

INLINE float least8(f32x8 v) {
    float least = v[0];
    for (int i = 1; i < 8; ++i) least = smaller_float(least, v[i]);
    return least;
}

INLINE double sum8(f32x8 v) {
    double sum = 0.0;
    for (int i = 0; i < 8; ++i) sum += (double)v[i];
    return sum;
}

/* Evaluates slopes of the wavefront, in pixels. */
INLINE void survey_slopes(int order, const psf_tables *tables, pupil *own) {
    float sheared = (float)(own->shear / own->root), terms[MOST_TERMS];
    int n_terms = terms_of(order);
    f32x8 per_x = all8((float)(1.0 / own->half[0]));
    f32x8 per_y = all8((float)(1.0 / (own->root * own->half[1])));
    for (int t = 0; t < n_terms; ++t) terms[t] = (float)own->disc[t];
    /* Moments are about the first point, as float32 sums of large slopes would lose their
     * differences. */
    f32x8 low_x = all8(INFINITY), low_y = low_x, high_x = -low_x, high_y = -low_x;
    f32x8 zero = all8(0.0f), largest = zero, mx = zero, my = zero, mxx = zero, mxy = zero,
          myy = zero, about_x = zero, about_y = zero;
    for (int first = 0; first < SURVEY_STRIDE; first += 8) {
        f32x8 gx = zero, gy = zero;
        for (int t = 1; t < n_terms; ++t) {
            f32x8 c = all8(terms[t]);
            gx += c * load8(tables->slope_x + t * SURVEY_STRIDE + first);
            gy += c * load8(tables->slope_y + t * SURVEY_STRIDE + first);
        }
        f32x8 x = (gx - all8(sheared) * gy) * per_x, y = gy * per_y;
        if (first == 0) {
            about_x = all8(x[0]);
            about_y = all8(y[0]);
        }
        low_x = smaller8(low_x, x);
        high_x = larger8(high_x, x);
        low_y = smaller8(low_y, y);
        high_y = larger8(high_y, y);
        largest = larger8(largest, x * x + y * y);
        f32x8 is_point = (f32x8)((i32x8)all8(1.0f)
                                 & (NUMBERS8 + all8((float)first) < all8((float)N_SURVEY)));
        f32x8 dx = (x - about_x) * is_point, dy = (y - about_y) * is_point;
        mx += dx;
        my += dy;
        mxx += dx * dx;
        mxy += dx * dy;
        myy += dy * dy;
        if (first < N_EDGE) {
            store8(own->edge[0] + first, x);
            store8(own->edge[1] + first, y);
            f32x8 nx = load8(tables->edge_xy + first);
            f32x8 ny = load8(tables->edge_xy + N_EDGE + first);
            store8(own->normal[0] + first, (nx - all8(sheared) * ny) * per_x);
            store8(own->normal[1] + first, ny * per_y);
        }
    }
    own->low[0] = least8(low_x);
    own->low[1] = least8(low_y);
    own->high[0] = -least8(-high_x);
    own->high[1] = -least8(-high_y);
    own->blur_px = sqrt((double)-least8(-largest));
    double n = N_SURVEY, x = sum8(mx) / n, y = sum8(my) / n;
    double vxx = (sum8(mxx) / n - x * x) * square(own->half[0]);
    double vyy = (sum8(myy) / n - y * y) * square(own->half[1]);
    double vxy = (sum8(mxy) / n - x * y) * own->half[0] * own->half[1];
    double least = 0.5 * (vxx + vyy) - sqrt(square(0.5 * (vxx - vyy)) + vxy * vxy);
    own->narrow_ratio = sqrt(larger_double(0.0, least)) * 2.0 / own->wavelength_um;
}

static void survey_pupil(const psf_tables *tables, pupil *own) {
    FOR_ORDER(own->order, survey_slopes, tables, own);
}

/* RMS of the wavefront without tilt over the pupil, um. */
INLINE double rms_of_order(int order, const psf_tables *tables, const pupil *own) {
    double terms[MOST_TERMS], sum = 0.0;
    times_matrix(order, own->disc, tables->zernike_terms, terms);
    for (int t = 3; t < terms_of(order); ++t) sum += square(terms[t]);
    return sqrt(sum);
}

/* Share of ray optics, from the predicted error of rays alone. */
static double share_of_rays(const psf_tables *tables, const pupil *own) {
    double rms_um = FOR_ORDER(own->order, rms_of_order, tables, own);
    double rms = larger_double(rms_um / own->wavelength_um, 1e-6);
    double unit_px = own->wavelength_um
                     / (2.0 * smaller_double(own->half[0], own->half[1]));
    double db = tables->base_db + tables->per_rms_db * log10(rms)
                - tables->per_pixel_db * log10(unit_px)
                + tables->per_narrow_db * log10(1.0 + own->narrow_ratio);
    double share = (db - tables->rays_from_db) / tables->fade_db;
    return smaller_double(1.0, larger_double(0.0, share));
}

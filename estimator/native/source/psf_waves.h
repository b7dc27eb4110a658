/* Wave optics.  PSF(p) = |int_pupil exp(2 pi i (W - p.t) / lambda) dt|^2 / (lambda^2 A) in the
 * coordinates of estimator/psf/pupil.py, with A the pupil's area there.  Fields are filled,
 * transformed and summed in strips of sixteen columns that fit in the cache.  All arithmetic
 * is in single precision. */

/* Sampling of one PSF, x before y. */
typedef struct {
    int length_number[2], length[2], per_px[2], size[2];
    double samples[2];        /* of the pupil, across its box */
    int center[2];            /* of the window, in samples */
    int window[4];            /* pixels x0, x1, y0, y1 (inclusive) that it fills */
} grid;

/* Memory of a thread, kept between PSFs. */
typedef struct {
    scratch mask;             /* (strips, rows, STRIP) */
    scratch first, second;    /* rows of a strip */
    scratch between;          /* (columns, 2, padded length of y), real and imaginary */
    scratch sums;             /* (pixels, padded length of y) */
    scratch line;
    scratch phase_terms;      /* (rows, order + 1) */
    double mask_samples[2], mask_shear, mask_amplitudes[LOG_AMPLITUDES];
    int mask_rows, mask_columns;
} wave_work;

static void free_wave_work(wave_work *w) {
    free(w->mask.at);
    free(w->first.at);
    free(w->second.at);
    free(w->between.at);
    free(w->sums.at);
    free(w->line.at);
    free(w->phase_terms.at);
}

/* Plans the smallest grid whose window holds the spot and its margins; 0 if no FFT does. */
static int plan_grid(const psf_job *job, const pupil *own, grid *g) {
    const psf_tables *tables = job->tables;
    for (int axis = 0; axis < 2; ++axis) {
        double unit_px = own->wavelength_um / (2.0 * own->half[axis]);
        double margin_px = larger_double(job->margin * unit_px, tables->least_margin_px);
        double window_px = own->high[axis] - own->low[axis] + 2.0 * margin_px;
        double per_px = larger_double(
            ceil(job->oversampling / unit_px),
            smaller_double(ceil(2.0 / unit_px), (double)job->min_samples_per_px));
        for (;; per_px += 1.0) {
            double wanted = window_px * per_px;
            int number = 0;
            while (number < tables->length_count && tables->lengths[number] < wanted)
                ++number;
            if (number == tables->length_count || per_px > tables->filter_count) return 0;
            int length = tables->lengths[number];
            double samples = length / (per_px * unit_px);
            if (samples + 2 * tables->edge_half_width > length) continue;
            g->length_number[axis] = number;
            g->length[axis] = length;
            g->per_px[axis] = (int)per_px;
            g->samples[axis] = samples;
            g->size[axis] = smaller_int(length,
                                        (int)ceil(samples) + 2 * tables->edge_half_width);
            break;
        }
        double middle_px = 0.5 * (own->low[axis] + own->high[axis]);
        g->center[axis] = (int)rint(middle_px * g->per_px[axis]);
        double inside = g->length[axis] / 2.0 - 1.0;
        g->window[2 * axis] = (int)ceil((g->center[axis] - inside) / per_px + 0.5);
        g->window[2 * axis + 1] = (int)floor((g->center[axis] + inside) / per_px - 0.5);
    }
    return 1;
}

/* First and last column (real numbers) of an ellipse scaled by r, in the row at y. */
static void chord_of(double y, double r, const pupil *own, double samples, double middle,
                  double *first, double *last) {
    double inside = (r * r - y * y) * square(own->root);
    *first = 0.0;
    *last = -1.0;
    if (r <= 0.0 || inside <= 0.0) return;
    double half = 0.5 * samples * sqrt(inside), at = middle + 0.5 * samples * own->shear * y;
    *first = at - half;
    *last = at + half;
}

/* Computes the smoothed pupil, strip by strip, unless it is unchanged. */
static int fill_mask(const psf_tables *tables, const pupil *own, const grid *g,
                     wave_work *w) {
    int columns = g->size[0], rows = g->size[1];
    if (w->mask_rows == rows && w->mask_columns == columns
        && w->mask_samples[0] == g->samples[0] && w->mask_samples[1] == g->samples[1]
        && w->mask_shear == own->shear
        && memcmp(w->mask_amplitudes, own->log_amplitude, sizeof own->log_amplitude) == 0)
        return 1;
    int strips = (columns + STRIP - 1) / STRIP;
    size_t count = (size_t)strips * (size_t)rows * STRIP;
    w->mask_rows = 0;
    float *mask = room_for(&w->mask, count);
    if (mask == NULL) return 0;
    memset(mask, 0, sizeof(float) * count);
    double ax = 0.5 * g->samples[0], ay = 0.5 * g->samples[1];
    double mean = 0.5 * (ax * ax + ay * ay), half = 0.5 * (ax * ax - ay * ay);
    double least = sqrt(mean - hypot(half, own->shear * ax * ay));
    double border = (tables->edge_half_width + 0.5) / least;
    double middle = 0.5 * (columns - 1), middle_y = 0.5 * (rows - 1);
    f32x8 inverse = all8((float)(1.0 / square(own->root))), r = all8((float)own->shear);
    f32x8 per_x = all8((float)(1.0 / ax)), per_y = all8((float)(1.0 / ay));
    int edge_count = 2 * tables->edge_half_width * tables->edge_steps + 1;
    f32x8 steps = all8((float)tables->edge_steps);
    f32x8 inner_half = all8((float)tables->edge_half_width);
    float most_place = (float)(edge_count - 1);
    const double *a = own->log_amplitude;
    f32x8 far_value = all8(tables->edge_response[2 * (edge_count - 1)]);
    for (int j = 0; j < rows; ++j) {
        double y = (j - middle_y) / ay;
        f32x8 v = all8((float)y);
        double outer_first, outer_last, inner_first, inner_last;
        chord_of(y, 1.0 + border, own, g->samples[0], middle, &outer_first, &outer_last);
        chord_of(y, 1.0 - border, own, g->samples[0], middle, &inner_first, &inner_last);
        if (outer_last < outer_first) continue;
        int first = larger_int(0, (int)floor(outer_first)) / 8 * 8;
        int end = smaller_int(columns, (int)ceil(outer_last) + 1);
        int in_first = (int)ceil(inner_first), in_end = (int)floor(inner_last) + 1;
        for (int i = first; i < end; i += 8) {
            f32x8 u = (NUMBERS8 + all8((float)(i - middle))) * per_x;
            f32x8 value = far_value;
            if (i < in_first || i + 8 > in_end) {
                f32x8 across = (u - r * v) * inverse, along = (v - r * u) * inverse;
                f32x8 radius = root8(u * across + v * along);
                f32x8 slope_x = across * per_x, slope_y = along * per_y;
                f32x8 steep = root8(slope_x * slope_x + slope_y * slope_y);
                f32x8 depth = (all8(1.0f) - radius) * radius / (steep + all8(1e-12f));
                f32x8 place = (depth + inner_half) * steps;
                place = smaller8(larger8(place, all8(0.0f)), all8(most_place));
                i32x8 at = whole8(smaller8(place, all8(most_place - 1.0f)));
                f32x8 change;
                pairs8(tables->edge_response, at, &value, &change);
                value += (place - __builtin_convertvector(at, f32x8)) * change;
            }
            for (int k = 0; own->is_apodized && k < 8; ++k)
                value[k] *= (float)exp(a[0] + u[k] * (a[1] + a[3] * u[k] + a[4] * y)
                                       + y * (a[2] + a[5] * y));
            store8(mask + ((size_t)(i / STRIP) * rows + j) * STRIP + i % STRIP, value);
        }
    }
    w->mask_rows = rows;
    w->mask_columns = columns;
    memcpy(w->mask_samples, g->samples, sizeof g->samples);
    w->mask_shear = own->shear;
    memcpy(w->mask_amplitudes, own->log_amplitude, sizeof own->log_amplitude);
    return 1;
}

/* Squared distance from the nearest center of a honeycomb; infinite outside its annulus. */
INLINE f32x8 lattice_distance8(f32x8 u, f32x8 v, const double lattice[3]) {
    float pitch = (float)lattice[0], high = 1.7320508075688772f * pitch;
    f32x8 half = all8(0.5f), per_pitch = all8(1.0f / pitch), per_high = all8(1.0f / high);
    f32x8 x = all8(pitch) * floor8(u * per_pitch + half);
    f32x8 y = all8(high) * floor8(v * per_high + half);
    f32x8 p = all8(pitch) * (floor8(u * per_pitch) + half);
    f32x8 q = all8(high) * (floor8(v * per_high) + half);
    f32x8 one = (u - x) * (u - x) + (v - y) * (v - y);
    f32x8 other = (u - p) * (u - p) + (v - q) * (v - q);
    i32x8 is_other = other < one;
    x = (f32x8)(((i32x8)p & is_other) | ((i32x8)x & ~is_other));
    y = (f32x8)(((i32x8)q & is_other) | ((i32x8)y & ~is_other));
    f32x8 from_middle = x * x + y * y;
    i32x8 is_there = (from_middle >= all8((float)(lattice[1] * lattice[1])))
                     & (from_middle <= all8((float)(lattice[2] * lattice[2])));
    return (f32x8)(((i32x8)smaller8(one, other) & is_there)
                   | ((i32x8)all8(INFINITY) & ~is_there));
}

/* Multiplies a strip by the complex transmission of the rings. */
static void apply_rings(const psf_job *job, const pupil *own, const grid *g,
                        int first_column, strip_row *rows) {
    const double *m = own->from_box_mm;
    f32x8 last = all8((float)(job->ring_count - 1));
    f32x8 steps = all8((float)job->ring_steps_per_mm2);
    for (int j = 0; j < g->size[1]; ++j) {
        double y = (j - 0.5 * (g->size[1] - 1)) * 2.0 / g->samples[1];
        for (int h = 0; h < 2; ++h) {
            f32x8 x = (NUMBERS8 + all8((float)(first_column + 8 * h
                                               - 0.5 * (g->size[0] - 1))))
                      * all8((float)(2.0 / g->samples[0]));
            f32x8 u = all8((float)m[0]) * x + all8((float)(m[1] * y + m[2]));
            f32x8 v = all8((float)m[3]) * x + all8((float)(m[4] * y + m[5]));
            f32x8 distance = u * u + v * v, re, im;
            if (job->ring_lattice_mm[0] > 0.0)
                distance = lattice_distance8(u, v, job->ring_lattice_mm);
            pairs8(own->rings, whole8(smaller8(distance * steps, last)), &re, &im);
            f32x8 own_re = rows[j].re[h], own_im = rows[j].im[h];
            rows[j].re[h] = own_re * re - own_im * im;
            rows[j].im[h] = own_re * im + own_im * re;
        }
    }
}

/* Computes mask times exp(2 pi i W) of one strip; rows beyond the pupil are zero. */
INLINE void fill_strip(int order, const psf_tables *tables, const grid *g,
                       const float *mask, const float *phase_terms, int first_column,
                       strip_row *to) {
    float x[STRIP];
    for (int i = 0; i < STRIP; ++i)
        x[i] = (float)((first_column + i - 0.5 * (g->size[0] - 1)) * 2.0 / g->samples[0]);
    f32x8 half = all8(0.5f), zero = all8(0.0f);
    for (int j = 0; j < g->size[1]; ++j)
        for (int h = 0; h < 2; ++h) {
            f32x8 share = load8(mask + j * STRIP + 8 * h);
            if (!any8(share != zero)) {
                to[j].re[h] = to[j].im[h] = zero;
                continue;
            }
            f32x8 u = load8(x + 8 * h);
            const float *c = phase_terms + (size_t)j * (size_t)(order + 1);
            f32x8 t = all8(c[order]);
            for (int k = order - 1; k >= 0; --k) t = all8(c[k]) + u * t;
            t -= floor8(t + half);
            to[j].re[h] = share * cosine8(tables, t * t);
            to[j].im[h] = share * sine8(tables, t, t * t);
        }
    memset(to + g->size[1], 0, sizeof *to * (size_t)(g->length[1] - g->size[1]));
}

/* Adds the intensity of the strip's rows to the pixels along x that they overlap. */
static void sum_strip(const psf_tables *tables, const grid *g, const strip_row *rows,
                      int x0, int x1, float *sums, size_t stride) {
    int k = g->per_px[0], n = g->length[0], half = n / 2;
    int taps = (k + 1) / 2 + tables->filter_half_width;
    const float *filter = tables->pixel_filters + (size_t)(k - 1) * tables->filter_stride;
    int first = larger_int(0, x0 * k - g->center[0] + half - taps);
    int last = smaller_int(n - 1, x1 * k - g->center[0] + half + taps);
    for (int j = first; j <= last; ++j) {
        const strip_row *row = rows + (j + half) % n;
        f32x8 light[2];
        for (int h = 0; h < 2; ++h)
            light[h] = row->re[h] * row->re[h] + row->im[h] * row->im[h];
        int position = j - half + g->center[0];
        int low = position - taps, high = position + taps; /* in k q */
        int q_low = larger_int(x0, low >= 0 ? (low + k - 1) / k : -(-low / k));
        int q_high = smaller_int(x1, high >= 0 ? high / k : -((-high + k - 1) / k));
        for (int q = q_low; q <= q_high; ++q) {
            f32x8 weight = all8(filter[position - q * k + taps]);
            float *to = sums + (size_t)(q - x0) * stride;
            store8(to, load8(to) + weight * light[0]);
            store8(to + 8, load8(to + 8) + weight * light[1]);
        }
    }
}

/* Coefficients in x of the phase, in turns, for each row of the grid. */
INLINE void fill_phase_terms(int order, double turns[MOST_POWERS][MOST_POWERS],
                             const grid *g, float *terms) {
    enum { BLOCK = 64 };
    for (int first = 0; first < g->size[1]; first += BLOCK) {
        int count = smaller_int(BLOCK, g->size[1] - first);
        double y[BLOCK], value[BLOCK];
        for (int j = 0; j < BLOCK; ++j)
            y[j] = (first + j - 0.5 * (g->size[1] - 1)) * 2.0 / g->samples[1];
        for (int a = 0; a <= order; ++a) {
            for (int j = 0; j < BLOCK; ++j) value[j] = 0.0;
            for (int b = order - a; b >= 0; --b)
                for (int j = 0; j < BLOCK; ++j) value[j] = value[j] * y[j] + turns[b][a];
            /* Whole turns are removed before the cast, which keeps 1e-6 of the rest. */
            float *to = terms + first * (order + 1) + a;
            for (int j = 0; j < count; ++j)
                to[j * (order + 1)] = (float)(a == 0 ? value[j] - floor(value[j]) : value[j]);
        }
    }
}

/* Computes a spot, in shares of the light that the pupil passes; 0 if out of memory. */
static int spot_of_waves(const psf_job *job, const pupil *own, const grid *g, wave_work *w,
                         const canvas *c) {
    const psf_tables *tables = job->tables;
    int columns = g->size[0], rows = g->size[1], n_x = g->length[0], n_y = g->length[1];
    size_t padded = ((size_t)n_y + STRIP - 1) / STRIP * STRIP;
    /* Only pixels within the canvas. */
    int x0 = larger_int(g->window[0], c->left);
    int x1 = smaller_int(g->window[1], c->left + c->width - 1);
    int y0 = larger_int(g->window[2], c->top - c->height + 1);
    int y1 = smaller_int(g->window[3], c->top);
    if (x1 < x0 || y1 < y0) return 1;
    size_t strip_floats = (size_t)larger_int(n_x, n_y) * 2 * STRIP;
    size_t columns_padded = ((size_t)columns + STRIP - 1) / STRIP * STRIP;
    size_t sum_count = (size_t)(x1 - x0 + 1) * padded;
    int k = g->per_px[1], half = n_y / 2, taps = (k + 1) / 2 + tables->filter_half_width;
    int pad = taps + k + 8;
    size_t line_count = (size_t)(n_y + 2 * pad + tables->filter_stride);
    strip_row *rows_of = room_for(&w->first, strip_floats);
    strip_row *other = room_for(&w->second, strip_floats);
    float *between = room_for(&w->between, columns_padded * 2 * padded);
    float *sums = room_for(&w->sums, sum_count), *line = room_for(&w->line, line_count);
    float *phase_terms = room_for(&w->phase_terms, (size_t)rows * MOST_POWERS);
    if (rows_of == NULL || other == NULL || between == NULL || sums == NULL || line == NULL
        || phase_terms == NULL || !fill_mask(tables, own, g, w))
        return 0;
    double turns[MOST_POWERS][MOST_POWERS] = {{0.0}};
    fill_dense(own->order, own->box, own->wavelength_um, turns);
    for (int axis = 0; axis < 2; ++axis) {
        double center_px = (double)g->center[axis] / g->per_px[axis];
        double *tilt = axis == 0 ? &turns[0][1] : &turns[1][0];
        *tilt -= own->half[axis] * center_px / own->wavelength_um;
    }
    FOR_ORDER(own->order, fill_phase_terms, turns, g, phase_terms);
    const float *tw_x = tables->twiddles + 2 * tables->twiddle_first[g->length_number[0]];
    const float *tw_y = tables->twiddles + 2 * tables->twiddle_first[g->length_number[1]];
    for (int first = 0; first < columns; first += STRIP) {
        const float *mask = (const float *)w->mask.at + (size_t)first * (size_t)rows;
        FOR_ORDER(own->order, fill_strip, tables, g, mask, phase_terms, first, rows_of);
        if (own->rings != NULL) apply_rings(job, own, g, first, rows_of);
        const strip_row *done = fft_strip(rows_of, other, n_y, tw_y);
        turn_strip(done, n_y, padded, between + (size_t)first * 2 * padded);
    }
    memset(sums, 0, sizeof(float) * sum_count);
    for (size_t first = 0; first < padded; first += STRIP) {
        for (int i = 0; i < columns; ++i) {
            const float *from = between + (size_t)i * 2 * padded + first;
            for (int h = 0; h < 2; ++h) {
                rows_of[i].re[h] = load8(from + 8 * h);
                rows_of[i].im[h] = load8(from + padded + 8 * h);
            }
        }
        memset(rows_of + columns, 0, sizeof *rows_of * (size_t)(n_x - columns));
        const strip_row *done = fft_strip(rows_of, other, n_x, tw_x);
        sum_strip(tables, g, done, x0, x1, sums + first, padded);
    }
    /* |sum|^2 (area of a pupil sample)^2 / (lambda^2 A) (angle of a sample)^2: areas times
     * angles are lambda^2 / N^2, which leaves 1 / N^2 over A in samples. */
    double area = M_PI / 4.0 * own->root * g->samples[0] * g->samples[1];
    float scale = (float)(1.0 / (area * n_x * n_y) / own->passed_ratio);
    const float *filter = tables->pixel_filters + (size_t)(k - 1) * tables->filter_stride;
    memset(line, 0, sizeof(float) * line_count);
    for (int q = x0; q <= x1; ++q) {
        const float *own_sums = sums + (size_t)(q - x0) * padded;
        memcpy(line + pad, own_sums + half, sizeof(float) * (size_t)(n_y - half));
        memcpy(line + pad + n_y - half, own_sums, sizeof(float) * (size_t)half);
        for (int y = y0; y <= y1; ++y) {
            const float *from = line + pad + y * k - g->center[1] + half - taps;
            f32x8 sum = all8(0.0f);
            for (int i = 0; i < 2 * taps + 1; i += 8) sum += load8(from + i) * load8(filter + i);
            float light = ((sum[0] + sum[1]) + (sum[2] + sum[3]))
                          + ((sum[4] + sum[5]) + (sum[6] + sum[7]));
            c->pixels[(c->top - y) * c->width + q - c->left] = larger_float(scale * light, 0.0f);
        }
    }
    return 1;
}

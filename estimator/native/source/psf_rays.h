/* Ray optics: footprints of pupil cells, plus diffraction at the pupil's edge.
 *
 * If blur is wider than diffraction, light deviates from ray optics only near the image of the
 * edge of the pupil, where it follows Fresnel diffraction at a straight edge.  Without
 * diffraction, the method is exact at any blur; the PSF of a perfect eye is one pixel. */

typedef float f32x2 __attribute__((vector_size(8)));

/* Part of a kernel's plane: pixel (x, y), y upward, is row top - y, column x - left.  Seven
 * floats follow the last pixel. */
typedef struct {
    float *pixels;
    int left, top, width, height;
} canvas;

#define MOST_CELLS 192
#define PROFILE_STEPS 17      /* of 1/2 px near the edge's image, of 1 px farther out */

INLINE void add_pair(float *to, const float *pair) {
    f32x2 sum, more;
    memcpy(&sum, to, sizeof sum);
    memcpy(&more, pair, sizeof more);
    sum += more;
    memcpy(to, &sum, sizeof sum);
}

/* Adds eight squares of 2 x 2 pixels: left and right in the row of `at`, and in the row of
 * `at` plus `other`. */
INLINE void add_squares(float *pixels, int other, i32x8 at, uint32_t lit, f32x8 left,
                        f32x8 right, f32x8 other_left, f32x8 other_right) {
    float pairs[2 * LANES], other_pairs[2 * LANES];
    int32_t places[LANES];
    store8(pairs, MIXED(left, right, 0, 8, 1, 9, 4, 12, 5, 13));
    store8(pairs + 8, MIXED(left, right, 2, 10, 3, 11, 6, 14, 7, 15));
    store8(other_pairs, MIXED(other_left, other_right, 0, 8, 1, 9, 4, 12, 5, 13));
    store8(other_pairs + 8, MIXED(other_left, other_right, 2, 10, 3, 11, 6, 14, 7, 15));
    at = (i32x8)MIXED((f32x8)at, (f32x8)at, 0, 1, 4, 5, 2, 3, 6, 7);
    memcpy(places, &at, sizeof places);
    if (lit == 255u) {
        for (int i = 0; i < LANES; ++i) {
            float *pixel = pixels + places[i];
            add_pair(pixel, pairs + 2 * i);
            add_pair(pixel + other, other_pairs + 2 * i);
        }
        return;
    }
    static const uint8_t lane[LANES] = {0, 1, 4, 5, 2, 3, 6, 7};
    for (int i = 0; i < LANES; ++i) {
        if (!(lit >> lane[i] & 1u)) continue;
        float *pixel = pixels + places[i];
        add_pair(pixel, pairs + 2 * i);
        add_pair(pixel + other, other_pairs + 2 * i);
    }
}

/* Coefficients in x of W, dW/dy and d^2W/dy^2 at several y. */
typedef struct {
    float of_w[MOST_POWERS][MOST_CELLS], of_dy[MOST_POWERS][MOST_CELLS],
        of_dyy[MOST_POWERS][MOST_CELLS];
} cell_terms;

INLINE void fill_cell_terms(int order, double dense[MOST_POWERS][MOST_POWERS],
                            const double *y, int count, cell_terms *rows) {
    double value[MOST_CELLS], first[MOST_CELLS], second[MOST_CELLS];
    for (int a = 0; a <= order; ++a) {
        for (int j = 0; j < count; ++j) value[j] = first[j] = second[j] = 0.0;
        for (int b = order - a; b >= 0; --b)
            for (int j = 0; j < count; ++j) {
                second[j] = second[j] * y[j] + 2.0 * first[j];
                first[j] = first[j] * y[j] + value[j];
                value[j] = value[j] * y[j] + dense[b][a];
            }
        for (int j = 0; j < count; ++j) {
            rows->of_w[a][j] = (float)value[j];
            rows->of_dy[a][j] = (float)first[j];
            rows->of_dyy[a][j] = (float)second[j];
        }
    }
}

/* Distributes a weight over the pixels that a box covers, by area. */
static void add_wide_box(const canvas *c, float x0, float y0, float wide, float high,
                         float weight) {
    double x1 = (double)x0 + wide + 1e-9, y1 = (double)y0 + high + 1e-9;
    double per_area = weight / ((x1 - x0) * (y1 - y0));
    int bottom = c->top - c->height + 1, right = c->left + c->width - 1;
    int first_y = larger_int((int)floor(y0 + 0.5), bottom);
    int last_y = smaller_int((int)floor(y1 + 0.5), c->top);
    int first_x = larger_int((int)floor(x0 + 0.5), c->left);
    int last_x = smaller_int((int)floor(x1 + 0.5), right);
    for (int y = first_y; y <= last_y; ++y) {
        double part = smaller_double(y1, y + 0.5) - larger_double(y0, y - 0.5);
        float *row = c->pixels + (c->top - y) * c->width - c->left;
        for (int x = first_x; x <= last_x; ++x) {
            double share = smaller_double(x1, x + 0.5) - larger_double(x0, x - 0.5);
            row[x] += (float)(per_area * part * share);
        }
    }
}

/* Adds a vector of footprints: those of at most 2 x 2 pixels by four additions, those of
 * 3 x 3 by nine; the plane has spare pixels after its last. */
INLINE void add_footprints(const canvas *c, f32x8 x0, f32x8 y0, f32x8 wide, f32x8 high,
                           f32x8 per_wide, f32x8 per_high, f32x8 weight) {
    f32x8 half = all8(0.5f), one = all8(1.0f), none = all8(0.0f);
    f32x8 column = floor8(x0 + half), row = floor8(y0 + half);
    f32x8 over_x = x0 + wide - column - half, over_y = y0 + high - row - half;
    column -= all8((float)c->left);
    row = all8((float)c->top) - row;
    i32x8 is_lit = weight > none;
    i32x8 is_short = (over_x <= one) & (over_y <= one) & (column >= none)
                     & (column < all8((float)(c->width - 1))) & (row >= one)
                     & (row < all8((float)c->height));
    uint32_t lit = bits_of8(is_lit), most = bits_of8(is_short & is_lit);
    f32x8 right = larger8(over_x, none) * per_wide;
    f32x8 up = weight * (larger8(over_y, none) * per_high), low = weight - up;
    i32x8 at = __builtin_convertvector(row, i32x8) * c->width
               + __builtin_convertvector(column, i32x8);
    add_squares(c->pixels, -c->width, at, most, low - low * right, low * right,
                up - up * right, up * right);
    uint32_t others = lit & ~most;
    if (others == 0) return;
    f32x8 two = all8(2.0f);
    uint32_t three = bits_of8((over_x <= two) & (over_y <= two) & (column >= none)
                              & (column < all8((float)(c->width - 2))) & (row >= two)
                              & (row < all8((float)c->height)));
    f32x8 last_x = larger8(over_x - one, none) * per_wide;
    f32x8 last_y = larger8(over_y - one, none) * per_high;
    f32x8 mid_x = smaller8(larger8(over_x, none), one) * per_wide;
    f32x8 mid_y = smaller8(larger8(over_y, none), one) * per_high;
    for (uint32_t left = others & three; left != 0; left &= left - 1) {
        int i = __builtin_ctz(left);
        f32x4 shares = {1.0f - mid_x[i] - last_x[i], mid_x[i], last_x[i], 0.0f};
        const float rows[3] = {1.0f - mid_y[i] - last_y[i], mid_y[i], last_y[i]};
        float *pixel = c->pixels + at[i];
        for (int j = 0; j < 3; ++j, pixel -= c->width)
            store4(pixel, load4(pixel) + all4(weight[i] * rows[j]) * shares);
    }
    for (uint32_t left = others & ~three; left != 0; left &= left - 1) {
        int i = __builtin_ctz(left);
        add_wide_box(c, x0[i], y0[i], wide[i], high[i], weight[i]);
    }
}

/* Data shared by a row of cells. */
typedef struct {
    const canvas *c;
    /* Polynomials in x of the slopes and of the second derivatives. */
    float sx[MOST_POWERS], sy[MOST_POWERS];
    float hxx[MOST_POWERS], hxy[MOST_POWERS], hyy[MOST_POWERS];
    float cell, factor_x, factor_y, cell_x, cell_y, per_cell_x, per_cell_y;
} pupil_row;

INLINE void take_row(int order, const cell_terms *rows, int j, pupil_row *r) {
    for (int k = 0; k < order; ++k) {
        r->sx[k] = (float)(k + 1) * rows->of_w[k + 1][j];
        r->sy[k] = rows->of_dy[k][j];
    }
    for (int k = 0; k + 1 < order; ++k) {
        r->hxx[k] = (float)((k + 1) * (k + 2)) * rows->of_w[k + 2][j];
        r->hxy[k] = (float)(k + 1) * rows->of_dy[k + 1][j];
        r->hyy[k] = rows->of_dyy[k][j];
    }
}

INLINE f32x8 polynomial8(const float *c, int count, f32x8 x) {
    f32x8 sum = all8(c[count - 1]);
    for (int k = count - 2; k >= 0; --k) sum = all8(c[k]) + x * sum;
    return sum;
}

INLINE void splat_cells(int order, const pupil_row *r, f32x8 x, f32x8 weight) {
    f32x8 half = all8(0.5f);
    f32x8 sx = polynomial8(r->sx, order, x), sy = polynomial8(r->sy, order, x);
    f32x8 hxx = polynomial8(r->hxx, order - 1, x);
    f32x8 hxy = polynomial8(r->hxy, order - 1, x);
    f32x8 hyy = polynomial8(r->hyy, order - 1, x);
    f32x8 tiny = all8(1e-24f);
    f32x8 square_x = hxx * hxx + hxy * hxy + tiny, square_y = hxy * hxy + hyy * hyy + tiny;
    f32x8 per_x = inverse_root8(square_x), per_y = inverse_root8(square_y);
    f32x8 wide = all8(r->cell_x) * square_x * per_x;
    f32x8 high = all8(r->cell_y) * square_y * per_y;
    add_footprints(r->c, all8(r->factor_x) * sx - half * wide,
                   all8(r->factor_y) * sy - half * high, wide, high,
                   all8(r->per_cell_x) * per_x, all8(r->per_cell_y) * per_y, weight);
}

/* Weights of cells that the pupil's edge may cross: their area inside a straight edge. */
INLINE f32x8 edge_weights(const pupil *own, f32x8 x, float y, float cell) {
    f32x8 zero = all8(0.0f), one = all8(1.0f), v = all8(y);
    float room = (float)square(own->root);
    f32x8 r = all8((float)own->shear), slope_x = x - r * v, slope_y = v - r * x;
    f32x8 radius = root8((x * slope_x + v * slope_y) * all8(1.0f / room));
    f32x8 steep = root8(slope_x * slope_x + slope_y * slope_y);
    f32x8 depth = (one - radius) * radius * all8(room) / larger8(steep, all8(1e-9f));
    return larger8(smaller8(depth * all8(1.0f / cell) + all8(0.5f), one), zero);
}

INLINE f32x8 apodized(const pupil *own, f32x8 x, double y, f32x8 weight) {
    const double *a = own->log_amplitude;
    for (int i = 0; i < LANES; ++i) {
        double u = x[i];
        weight[i] *= (float)exp(2.0 * (a[0] + u * (a[1] + a[3] * u + a[4] * y)
                                       + y * (a[2] + a[5] * y)));
    }
    return weight;
}

/* Adds the footprints of all cells of the pupil; returns their weight. */
INLINE double splat_pupil(int order, const pupil *own,
                          double dense[MOST_POWERS][MOST_POWERS], int n_cells,
                          const canvas *c) {
    double cell = 2.0 / n_cells, room = square(own->root), shear = own->shear;
    float factor_x = (float)(1.0 / own->half[0]), factor_y = (float)(1.0 / own->half[1]);
    pupil_row r = {.c = c, .cell = (float)cell, .factor_x = factor_x, .factor_y = factor_y,
                  .cell_x = (float)cell * factor_x, .cell_y = (float)cell * factor_y};
    r.per_cell_x = 1.0f / r.cell_x;
    r.per_cell_y = 1.0f / r.cell_y;
    f32x8 zero = all8(0.0f), one = all8(1.0f), half = all8(0.5f), total = zero;
    /* Cells within this radius lie completely inside the ellipse. */
    double inner = larger_double(0.0, 1.0 - 0.75 * cell / sqrt(1.0 - fabs(shear)));
    double ys[MOST_CELLS];
    cell_terms rows;
    for (int j = 0; j < n_cells; ++j) ys[j] = (j + 0.5) * cell - 1.0;
    fill_cell_terms(order, dense, ys, n_cells, &rows);
    for (int j = 0; j < n_cells; ++j) {
        double y = ys[j], middle = 1.0 + shear * y;
        double edge = square(1.0 + 0.5 * cell) - y * y;
        double chord = sqrt(larger_double(0.0, edge) * room) + cell;
        double core = sqrt(larger_double(0.0, inner * inner - y * y) * room);
        int first = larger_int(0, (int)floor((middle - chord) / cell));
        int end = smaller_int(n_cells, (int)ceil((middle + chord) / cell));
        int core_first = (int)ceil((middle - core) / cell);
        int core_end = (int)floor((middle + core) / cell);
        if (core_end <= core_first) core_first = core_end = end;
        take_row(order, &rows, j, &r);
        /* The lanes are far from each other: neighbors share pixels, and a load would have
         * to wait for the preceding store. */
        int span = (core_end - core_first + LANES - 1) / LANES;
        f32x8 number = NUMBERS8 * all8((float)span) + all8((float)core_first);
        for (int step = 0; step < span; ++step, number += one) {
            f32x8 x = (number + half) * all8(r.cell) - one;
            f32x8 weight = (f32x8)((i32x8)one & (number < all8((float)core_end)));
            if (own->is_apodized) weight = apodized(own, x, y, weight);
            total += weight;
            splat_cells(order, &r, x, weight);
        }
        /* Both ends of the row. */
        int before = core_first - first, count = before + larger_int(0, end - core_end);
        span = (count + LANES - 1) / LANES;
        number = NUMBERS8 * all8((float)span);
        for (int step = 0; step < span; ++step, number += one) {
            i32x8 is_after = number >= all8((float)before);
            f32x8 skipped = (f32x8)((i32x8)all8((float)(core_end - before)) & is_after);
            f32x8 begun = (f32x8)((i32x8)all8((float)first) & ~is_after);
            f32x8 x = (number + skipped + begun + half) * all8(r.cell) - one;
            f32x8 weight = edge_weights(own, x, (float)y, r.cell);
            weight = (f32x8)((i32x8)weight & (number < all8((float)count)));
            if (own->is_apodized) weight = apodized(own, x, y, weight);
            total += weight;
            splat_cells(order, &r, x, weight);
        }
    }
    double sum = 0.0;
    for (int i = 0; i < LANES; ++i) sum += (double)total[i];
    return sum;
}

/* Integral, from the dark side to v, of Fresnel's straight edge minus the step. */
INLINE f32x8 fresnel_integral(const psf_tables *tables, f32x8 v) {
    float limit = (float)tables->fresnel_limit, last = (float)(tables->fresnel_count - 1);
    f32x8 place = (v + all8(limit)) * all8(last / (2.0f * limit));
    place = larger8(smaller8(place, all8(last)), all8(0.0f));
    i32x8 at = whole8(smaller8(place, all8(last - 1.0f)));
    f32x8 value, change;
    pairs8(tables->fresnel, at, &value, &change);
    f32x8 inside = value + (place - __builtin_convertvector(at, f32x8)) * change;
    f32x8 outside = all8(-1.0f / (2.0f * (float)(M_PI * M_PI))) / v;
    i32x8 is_outside = size8(v) >= all8(limit);
    return (f32x8)(((i32x8)outside & is_outside) | ((i32x8)inside & ~is_outside));
}

/* Ends of the profile's steps. */
static const float profile_ends[PROFILE_STEPS + 1] = {
    -6.25f, -5.25f, -4.25f, -3.25f, -2.25f, -1.75f, -1.25f, -0.75f, -0.25f,
    0.25f,  0.75f,  1.25f,  1.75f,  2.25f,  3.25f,  4.25f,  5.25f,  6.25f};

/* Distributes light over the four pixels that boxes of 1 / per_size px about (x, y)
 * overlap. */
INLINE void add_boxes(const canvas *c, f32x8 x, f32x8 y, float per_size, f32x8 light) {
    f32x8 half = all8(0.5f), zero = all8(0.0f), one = all8(1.0f);
    f32x8 at_x = x - all8((float)c->left), at_y = all8((float)c->top) - y;
    f32x8 column = floor8(at_x), row = floor8(at_y); /* to the left, and above */
    uint32_t lit = bits_of8((column >= zero) & (row >= zero)
                            & (column < all8((float)(c->width - 1)))
                            & (row < all8((float)(c->height - 1))));
    f32x8 right = (at_x - column - half) * all8(per_size) + half;
    f32x8 low = (at_y - row - half) * all8(per_size) + half;
    right = larger8(smaller8(right, one), zero);
    low = light * larger8(smaller8(low, one), zero);
    f32x8 above = light - low;
    i32x8 at = __builtin_convertvector(row, i32x8) * c->width
               + __builtin_convertvector(column, i32x8);
    add_squares(c->pixels, c->width, at, lit, above - above * right, above * right,
                low - low * right, low * right);
}

/* Cosine and sine of turns in [-1/2, 1/2]. */
INLINE f32x8 cosine8(const psf_tables *tables, f32x8 z) {
    return polynomial8(tables->cosine, TURN_POWERS, z);
}

INLINE f32x8 sine8(const psf_tables *tables, f32x8 t, f32x8 z) {
    return t * polynomial8(tables->sine, TURN_POWERS, z);
}

/* Adds the effect of diffraction at the pupil's edge to the spot, for eight distant edge
 * points at a time. */
INLINE void add_edge_light(int order, const psf_tables *tables, const pupil *own,
                           double dense[MOST_POWERS][MOST_POWERS], const canvas *c) {
    double extent = larger_double(own->high[0] - own->low[0], own->high[1] - own->low[1]);
    int span = (int)ceil(larger_double(tables->min_edge_points,
                                       tables->edge_points_per_px * extent) / LANES);
    int count = span * LANES;
    float terms[MOST_POWERS][MOST_POWERS];
    for (int b = 0; b <= order; ++b)
        for (int a = 0; a <= order; ++a) terms[b][a] = (float)dense[b][a];
    f32x8 zero = all8(0.0f), two = all8(2.0f), sign = all8(-0.0f);
    f32x8 per_ax = all8((float)(1.0 / own->half[0])), per_ay = all8((float)(1.0 / own->half[1]));
    f32x8 sheared = all8((float)(own->shear / own->root)), shear = all8((float)own->shear);
    f32x8 root = all8((float)own->root), per_root = all8((float)(1.0 / own->root));
    float um = (float)own->wavelength_um;
    for (int step = 0; step < span; ++step) {
        f32x8 turn = NUMBERS8 * all8((float)span) + all8((float)step + 0.5f);
        turn = turn * all8(1.0f / (float)count);
        turn -= floor8(turn + all8(0.5f));
        f32x8 wx = cosine8(tables, turn * turn), wy = sine8(tables, turn, turn * turn);
        f32x8 x = wx, y = shear * wx + root * wy;
        f32x8 nx = (wx - sheared * wy) * per_ax, ny = wy * per_root * per_ay;
        f32x8 length = root8(nx * nx + ny * ny);
        nx /= length;
        ny /= length;
        f32x8 sx = zero, sy = zero, hxx = zero, hxy = zero, hyy = zero, value = zero;
        for (int a = order; a >= 0; --a) {
            f32x8 w = zero, dy = zero, dyy = zero;
            for (int b = order - a; b >= 0; --b) {
                dyy = dyy * y + two * dy;
                dy = dy * y + w;
                w = w * y + all8(terms[b][a]);
            }
            hxx = hxx * x + two * sx;
            sx = sx * x + value;
            value = value * x + w;
            hxy = hxy * x + sy;
            sy = sy * x + dy;
            hyy = hyy * x + dyy;
        }
        sx *= per_ax;
        sy *= per_ay;
        hxx *= per_ax * per_ax;
        hxy *= per_ax * per_ay;
        hyy *= per_ay * per_ay;
        f32x8 across = hxx * nx * nx + two * hxy * nx * ny + hyy * ny * ny;
        f32x8 along = hxx * ny * ny - two * hxy * nx * ny + hyy * nx * nx;
        f32x8 mixed = (hyy - hxx) * nx * ny + hxy * (nx * nx - ny * ny);
        f32x8 least = all8((float)tables->min_curvature_ratio)
                      * (size8(across) + size8(along) + size8(mixed)) + all8(1e-12f);
        f32x8 curvature = across - mixed * mixed * along / (along * along + least * least);
        f32x8 size = larger8(size8(curvature), all8(1e-6f));
        i32x8 turned_sign = ~(i32x8)curvature & (i32x8)sign;
        f32x8 v_per_px = (f32x8)((i32x8)root8(all8(2.0f / um) / size) | turned_sign);
        f32x8 strength = length * all8((float)(2.0 / count / own->passed_ratio))
                         * root8(all8(0.5f * um) / size);
        if (own->is_apodized)
            for (int i = 0; i < LANES; ++i) {
                const double *a = own->log_amplitude;
                double u = x[i], v = y[i];
                strength[i] *= (float)exp(2.0 * (a[0] + u * (a[1] + a[3] * u + a[4] * v)
                                                 + v * (a[2] + a[5] * v)));
            }
        strength = (f32x8)((i32x8)strength | turned_sign);
        f32x8 before = fresnel_integral(tables, all8(profile_ends[0]) * v_per_px);
        for (int i = 0; i < PROFILE_STEPS; ++i) {
            float next = profile_ends[i + 1], own_size = next - profile_ends[i];
            f32x8 after = fresnel_integral(tables, all8(next) * v_per_px);
            f32x8 d = all8(next - 0.5f * own_size);
            add_boxes(c, sx + d * nx, sy + d * ny, 1.0f / own_size,
                      strength * (after - before));
            before = after;
        }
    }
}

/* Raises pixels below zero to zero, and those at least from_px away from the edge to its
 * mean light. */
static void lift_to_tail(const tail *t, const canvas *c, float from_px) {
    f32x8 zero = all8(0.0f), brightest = all8(t->brightest);
    for (int y = c->top; y > c->top - c->height; --y) {
        tail_row row = tail_row_at(t, y);
        float *to = c->pixels + (c->top - y) * c->width;
        for (int i = 0; i < c->width; i += LANES) {
            f32x8 old = load8(to + i), light = larger8(old, zero);
            i32x8 is_own = NUMBERS8 < all8((float)(c->width - i));
            if (any8(light < brightest)) {
                i32x8 is_far;
                f32x8 found = tail_light8(&row, c->left + i, from_px * from_px, &is_far);
                light = larger8(light, (f32x8)((i32x8)found & is_far));
            }
            store8(to + i, (f32x8)(((i32x8)light & is_own) | ((i32x8)old & ~is_own)));
        }
    }
}

/* Computes a spot, in shares of the light that the pupil passes. */
static void spot_of_rays(const psf_tables *tables, const pupil *own, int is_diffracting,
                         const canvas *c) {
    double dense[MOST_POWERS][MOST_POWERS] = {{0.0}};
    fill_dense(own->order, own->box, 1.0, dense);
    double extent = larger_double(own->high[0] - own->low[0], own->high[1] - own->low[1]);
    double cells = larger_double(tables->min_cells / own->root, tables->cells_per_px * extent);
    int n_cells = (int)smaller_double(tables->max_cells, ceil(cells));
    double weight = FOR_ORDER(own->order, splat_pupil, own, dense, n_cells, c);
    float scale = (float)(1.0 / weight);
    for (int i = 0; i < c->width * c->height; ++i) c->pixels[i] *= scale;
    if (!is_diffracting) return;
    FOR_ORDER(own->order, add_edge_light, tables, own, dense, c);
    tail t = tail_of(tables, own);
    lift_to_tail(&t, c, (float)tables->far_px);
}

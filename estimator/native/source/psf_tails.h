/* Mean light of the pupil's edge far outside a spot; derived in estimator/psf/tail.py. */

#define TAIL_EDGES (N_EDGE / 4)
#define LANES 8
#define MOST_PRIMARIES 16

/* Lengths are relative to the mean of the edge. */
typedef struct {
    float edge_x[TAIL_EDGES], edge_y[TAIL_EDGES], square[TAIL_EDGES];
    float center_x, center_y;
    float xx, yy, xy, at_center, factor;
    float brightest;          /* upper limit of pixels at least far_px from the edge */
} tail;

static tail tail_of(const psf_tables *tables, const pupil *own) {
    tail t;
    float x = 0.0f, y = 0.0f;
    for (int i = 0; i < TAIL_EDGES; ++i) {
        x += own->edge[0][4 * i];
        y += own->edge[1][4 * i];
    }
    t.center_x = x / TAIL_EDGES;
    t.center_y = y / TAIL_EDGES;
    for (int i = 0; i < TAIL_EDGES; ++i) {
        t.edge_x[i] = own->edge[0][4 * i] - t.center_x;
        t.edge_y[i] = own->edge[1][4 * i] - t.center_y;
        t.square[i] = t.edge_x[i] * t.edge_x[i] + t.edge_y[i] * t.edge_y[i];
    }
    double a = square(own->half[0]), b = square(own->half[1]);
    double c = own->shear * own->half[0] * own->half[1];
    t.xx = (float)a;
    t.yy = (float)b;
    t.xy = (float)(2.0 * c);
    t.at_center = (float)(own->half[0] * own->half[1]);
    t.factor = (float)(own->edge_um * t.at_center * own->root / (4.0 * M_PI * M_PI * M_PI));
    double least = 0.5 * (a + b) - sqrt(square(0.5 * (a - b)) + c * c);
    double near2 = square(tables->far_px);
    t.brightest = (float)(t.factor * 2.0 / (near2 * tables->far_px * least * sqrt(least)));
    return t;
}

/* A row of pixels. */
typedef struct {
    const tail *t;
    float y, offset[TAIL_EDGES];
} tail_row;

static tail_row tail_row_at(const tail *t, int y) {
    tail_row row = {.t = t, .y = (float)y - t->center_y};
    for (int k = 0; k < TAIL_EDGES; ++k)
        row.offset[k] = t->square[k] - 2.0f * row.y * t->edge_y[k];
    return row;
}

/* Light of the eight pixels from x, and whether each is at least near2^(1/2) away from all
 * points of the edge.  A squared distance is |p|^2 + (|e|^2 - 2 p.e). */
INLINE f32x8 tail_light8(const tail_row *row, int x, float near2, i32x8 *is_far) {
    const tail *t = row->t;
    f32x8 from_x = NUMBERS8 + all8((float)x - t->center_x), two_x = from_x + from_x;
    f32x8 rho2 = from_x * from_x + all8(row->y * row->y);
    f32x8 near = all8(1e30f), far = -near;
    for (int k = 0; k < TAIL_EDGES; ++k) {
        f32x8 distance = all8(row->offset[k]) - two_x * all8(t->edge_x[k]);
        near = smaller8(near, distance);
        far = larger8(far, distance);
    }
    near += rho2;
    *is_far = near >= all8(near2);
    f32x8 close = larger8(near, all8(0.25f)), distant = larger8(far + rho2, close);
    f32x8 chord2 = (all8(t->xx) * from_x + all8(t->xy * row->y)) * from_x
                   + all8(t->yy * row->y * row->y);
    /* Within about this square of the distance, the direction from the center fades. */
    f32x8 little = all8(1e-6f), from2 = rho2 + little;
    chord2 += little * all8(t->at_center);
    f32x8 reach2 = larger8(rho2, close);
    return all8(t->factor) * (close + distant) * from2 * from2
           * inverse_root8(chord2 * from2 * reach2) / (chord2 * close * distant);
}

/* Writes the weighted light of `n` tails to the pixels of a row from `first` up to `end`, not
 * included, except those from gap[0] up to gap[1].  `to` is the pixel at x = 0; seven floats
 * after the last pixel must be readable, and keep their values. */
static void write_tails(const tail *tails, const float *weights, int n, int y, int first,
                        int end, const int gap[2], float *to) {
    tail_row rows[MOST_PRIMARIES];
    for (int p = 0; p < n; ++p) rows[p] = tail_row_at(tails + p, y);
    const int starts[2] = {first, gap[1]}, ends[2] = {gap[0], end};
    for (int part = 0; part < 2; ++part)
        for (int x = starts[part]; x < ends[part]; x += LANES) {
            f32x8 light = all8(0.0f);
            i32x8 is_far, is_own = NUMBERS8 < all8((float)(ends[part] - x));
            for (int p = 0; p < n; ++p)
                light += all8(weights[p]) * tail_light8(rows + p, x, 0.0f, &is_far);
            light = (f32x8)(((i32x8)light & is_own) | ((i32x8)load8(to + x) & ~is_own));
            store8(to + x, light);
        }
}

/* Light of the pupil's edge beyond the line x = end (axis 0) or y = end (axis 1), on the
 * side of the sign, as a share of all light: an edge element sends strength / d^2 along its
 * normal, to both sides; see needed_radius_px in survey.py. */
static double light_beyond(const pupil *own, int axis, double sign, double end) {
    f32x8 sum = all8(0.0f), s = all8((float)sign), e = all8((float)end);
    for (int i = 0; i < N_EDGE; i += 8)
        sum += size8(load8(own->normal[axis] + i)) / (e - s * load8(own->edge[axis] + i));
    return own->edge_um / (2.0 * M_PI * M_PI * N_EDGE) * sum8(sum);
}

/* The same outside the box x0, x1, y0, y1 (inclusive). */
static double light_outside(const pupil *own, const int box[4]) {
    f32x8 sum = all8(0.0f), tiny = all8(1e-12f);
    for (int i = 0; i < N_EDGE; i += 8)
        for (int way = -1; way <= 1; way += 2) {
            f32x8 per_distance = all8(0.0f); /* of the nearest side that the ray leaves by */
            for (int axis = 0; axis < 2; ++axis) {
                f32x8 n = all8((float)way) * load8(own->normal[axis] + i);
                f32x8 s = load8(own->edge[axis] + i);
                f32x8 high = all8((float)box[2 * axis + 1] + 0.5f) - s;
                f32x8 low = s - all8((float)box[2 * axis] - 0.5f);
                i32x8 is_up = n > all8(0.0f);
                f32x8 end = (f32x8)(((i32x8)high & is_up) | ((i32x8)low & ~is_up));
                per_distance = larger8(per_distance, size8(n) / larger8(end, tiny));
            }
            sum += per_distance;
        }
    return own->edge_um / (2.0 * M_PI * M_PI * N_EDGE) * sum8(sum);
}

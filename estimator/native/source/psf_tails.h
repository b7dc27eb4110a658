/* Mean light of the pupil's edge far outside a spot; derived in estimator/psf/tail.py. */

#define TAIL_EDGES (N_EDGE / 4)
#define LANES 8

typedef struct {
    float edge_x[TAIL_EDGES], edge_y[TAIL_EDGES];
    float center_x, center_y;
    float xx, yy, xy, at_center, factor;
    float brightest;          /* upper limit of pixels at least far_px from the edge */
} tail;

static tail tail_of(const psf_tables *tables, const pupil *own) {
    tail t;
    float x = 0.0f, y = 0.0f;
    for (int i = 0; i < TAIL_EDGES; ++i) {
        t.edge_x[i] = own->edge[0][4 * i];
        t.edge_y[i] = own->edge[1][4 * i];
        x += t.edge_x[i];
        y += t.edge_y[i];
    }
    t.center_x = x / TAIL_EDGES;
    t.center_y = y / TAIL_EDGES;
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

/* Squared distances of eight pixels to the nearest and farthest point of the edge. */
INLINE void tail_distances8(const tail *t, f32x8 x, float y, f32x8 *nearest,
                            f32x8 *farthest) {
    f32x8 near = all8(1e30f), far = all8(0.0f);
    for (int k = 0; k < TAIL_EDGES; ++k) {
        f32x8 along = x - all8(t->edge_x[k]);
        f32x8 across = all8((y - t->edge_y[k]) * (y - t->edge_y[k]));
        f32x8 distance = along * along + across;
        near = smaller8(near, distance);
        far = larger8(far, distance);
    }
    *nearest = near;
    *farthest = far;
}

INLINE f32x8 tail_light8(const tail *t, f32x8 x, float y, f32x8 nearest, f32x8 farthest) {
    float from_y = y - t->center_y;
    f32x8 from_x = x - all8(t->center_x);
    f32x8 close = larger8(nearest, all8(0.25f)), distant = larger8(farthest, close);
    f32x8 rho2 = from_x * from_x + all8(from_y * from_y);
    f32x8 chord2 = (all8(t->xx) * from_x + all8(t->xy * from_y)) * from_x
                   + all8(t->yy * from_y * from_y);
    f32x8 little = all8(1e-6f);
    f32x8 ratio2 = (chord2 + little * all8(t->at_center)) / (rho2 + little);
    f32x8 reach2 = larger8(rho2, close);
    return all8(t->factor) * (close + distant)
           / (ratio2 * root8(ratio2 * reach2) * close * distant);
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

/* Pupils and surveys of many wavefronts, and the radii that their PSFs need. */

#define PUPILS_AN_ITEM 64

typedef struct {
    const psf_tables *tables;
    const double *monomials_um, *radius_mm, *ellipse, *jacobian;
    double *box, *disc, *half, *shear;
    int64_t count;
} frames_job;

static void frame_some(void *argument, int item, int thread) {
    frames_job *job = argument;
    (void)thread;
    int64_t first = (int64_t)item * PUPILS_AN_ITEM, end = first + PUPILS_AN_ITEM;
    int n_terms = terms_of(job->tables->order);
    size_t size = sizeof(double) * (size_t)n_terms;
    for (int64_t p = first; p < end && p < job->count; ++p) {
        pupil own;
        frame_pupil(job->tables, job->monomials_um + p * n_terms, job->radius_mm[p],
                    job->ellipse + p * ELLIPSE_COLUMNS, job->jacobian + p * 4, &own);
        memcpy(job->box + p * n_terms, own.box, size);
        memcpy(job->disc + p * n_terms, own.disc, size);
        memcpy(job->half + p * 2, own.half, sizeof own.half);
        job->shear[p] = own.shear;
    }
}

INLINE int items_of(int64_t count, int an_item) {
    return (int)((count + an_item - 1) / an_item);
}

/* Computes `PupilFrames` from monomials (count, n_terms) over circles. */
static void frame_pupils(pool *threads, const psf_tables *tables, int64_t count,
                         const double *monomials_um, const double *radius_mm,
                         const double *ellipse, const double *jacobian, double *box,
                         double *disc, double *half, double *shear) {
    frames_job job = {tables, monomials_um, radius_mm, ellipse, jacobian,
                      box, disc, half, shear, count};
    pool_run(threads, items_of(count, PUPILS_AN_ITEM), frame_some, &job);
}

typedef struct {
    const psf_tables *tables;
    const double *disc, *half, *shear, *wavelength_um;
    double *low, *high, *edge, *normal, *blur, *narrow;
    int64_t count;
} surveys_job;

static void survey_some(void *argument, int item, int thread) {
    surveys_job *job = argument;
    (void)thread;
    int64_t first = (int64_t)item * PUPILS_AN_ITEM, end = first + PUPILS_AN_ITEM;
    int n_terms = terms_of(job->tables->order);
    for (int64_t p = first; p < end && p < job->count; ++p) {
        pupil own;
        own.order = job->tables->order;
        memcpy(own.disc, job->disc + p * n_terms, sizeof(double) * (size_t)n_terms);
        memcpy(own.half, job->half + p * 2, sizeof own.half);
        own.shear = job->shear[p];
        own.root = sqrt(1.0 - square(own.shear));
        own.wavelength_um = job->wavelength_um[p];
        survey_pupil(job->tables, &own);
        memcpy(job->low + p * 2, own.low, sizeof own.low);
        memcpy(job->high + p * 2, own.high, sizeof own.high);
        job->blur[p] = own.blur_px;
        job->narrow[p] = own.narrow_ratio;
        double *edge = job->edge + p * 2 * N_EDGE, *normal = job->normal + p * 2 * N_EDGE;
        for (int i = 0; i < N_EDGE; ++i)
            for (int axis = 0; axis < 2; ++axis) {
                edge[2 * i + axis] = (double)own.edge[axis][i];
                normal[2 * i + axis] = (double)own.normal[axis][i];
            }
    }
}

/* Computes the fields of `PupilSurvey`. */
static void survey_pupils(pool *threads, const psf_tables *tables, int64_t count,
                          const double *disc, const double *half, const double *shear,
                          const double *wavelength_um, double *low, double *high,
                          double *edge, double *normal, double *blur, double *narrow) {
    surveys_job job = {tables, disc, half, shear, wavelength_um, low, high,
                       edge, normal, blur, narrow, count};
    pool_run(threads, items_of(count, PUPILS_AN_ITEM), survey_some, &job);
}

typedef double f64x4 __attribute__((vector_size(32)));
typedef int64_t i64x4 __attribute__((vector_size(32)));

/* An edge for `edge_light_outside`: for an element with slope s and normal n, n.n, (s.n)^2
 * and s.s. */
typedef struct {
    f64x4 normal2[N_EDGE / 4], along2[N_EDGE / 4], slope2[N_EDGE / 4];
    double um_ratio;
} edge_light;

static void fill_edge(const double *edge_px, const double *normal, double edge_um,
                      edge_light *e) {
    for (int i = 0; i < N_EDGE; ++i) {
        double sx = edge_px[2 * i], sy = edge_px[2 * i + 1];
        double nx = normal[2 * i], ny = normal[2 * i + 1];
        e->normal2[i / 4][i % 4] = nx * nx + ny * ny;
        e->along2[i / 4][i % 4] = square(sx * nx + sy * ny);
        e->slope2[i / 4][i % 4] = sx * sx + sy * sy;
    }
    e->um_ratio = edge_um / (2.0 * M_PI * M_PI * N_EDGE);
}

/* Share of the light that an edge sends outside a disc; infinite if its rays reach the rim.
 * Along the normal, the rim is (root - s.n) / n.n and (root + s.n) / n.n away, with
 * root^2 = (s.n)^2 - n.n c. */
static double edge_light_outside(const edge_light *e, double radius_px) {
    f64x4 sum = {0.0}, radius2 = {square(radius_px), square(radius_px), square(radius_px),
                                  square(radius_px)};
    i64x4 reaches = {0};
    for (int i = 0; i < N_EDGE / 4; ++i) {
        f64x4 room = radius2 - e->slope2[i]; /* -c */
        f64x4 root2 = e->along2[i] + e->normal2[i] * room, root;
        for (int k = 0; k < 4; ++k) root[k] = sqrt(root2[k]);
        reaches |= ~(room > 0.0);
        sum += 2.0 * root / room;
    }
    for (int k = 0; k < 4; ++k)
        if (reaches[k]) return INFINITY;
    return e->um_ratio * (sum[0] + sum[1] + sum[2] + sum[3]);
}

/* Writes the smallest radii (count,) of discs outside of which is at most a share of the
 * light. */
static void needed_radii(int64_t count, const double *edge_px, const double *normal,
                         const double *edge_um, const double *blur_px, double share,
                         int64_t limit, int64_t *radius_px) {
    for (int64_t p = 0; p < count; ++p) {
        edge_light e;
        fill_edge(edge_px + p * 2 * N_EDGE, normal + p * 2 * N_EDGE, edge_um[p], &e);
        int64_t low = (int64_t)ceil(blur_px[p] + PIXEL_CORNER_PX) - 1;
        int64_t step = 1, high = low + 1;
        while (high < limit) {
            if (edge_light_outside(&e, (double)high + 0.5) <= share) break;
            low = high;
            step *= 2;
            high = low + step < limit ? low + step : limit;
        }
        while (high - low > 1) {
            int64_t middle = (low + high) / 2;
            if (edge_light_outside(&e, (double)middle + 0.5) <= share) high = middle;
            else low = middle;
        }
        radius_px[p] = high;
    }
}

/* Writes the shares (count,) of the light that edges send outside discs. */
static void edge_lights_outside(int64_t count, const double *edge_px, const double *normal,
                                const double *edge_um, const double *radius_px,
                                double *share) {
    for (int64_t p = 0; p < count; ++p) {
        edge_light e;
        fill_edge(edge_px + p * 2 * N_EDGE, normal + p * 2 * N_EDGE, edge_um[p], &e);
        share[p] = edge_light_outside(&e, radius_px[p]);
    }
}

/* PSFs over discs of given radii, in single precision, for the functions of estimator/psf. */

typedef double f64x8 __attribute__((vector_size(64)));

/* Largest x of the disc x^2 + y^2 <= (radius + 1/2)^2. */
INLINE int disc_reach(int radius, int y) {
    return (int)sqrt(square(radius + 0.5) - square(y));
}

/* Copies the pixels of a canvas that are in the disc to its square, and returns their sum.
 * Other pixels keep their values, or get the mean light of the edge if there is a tail; those
 * outside the disc are zero. */
static double fill_disc(const canvas *c, const tail *t, int radius, float *square_at) {
    f64x8 total = {0.0};
    for (int y = radius; y >= -radius; --y) {
        int reach = disc_reach(radius, y), row = c->top - y, end = reach + 1;
        float *to = square_at + (radius - y) * (2 * radius + 1) + radius;
        int gap[2] = {end, end};
        if (row >= 0 && row < c->height) {
            gap[0] = clamp_int(c->left, -reach, end);
            gap[1] = clamp_int(c->left + c->width, gap[0], end);
            memcpy(to + gap[0], c->pixels + row * c->width + gap[0] - c->left,
                   sizeof *to * (size_t)(gap[1] - gap[0]));
        }
        if (t != NULL) write_tails(t, &one_weight, 1, y, -reach, end, gap, to);
        f32x8 sum = all8(0.0f);
        for (int x = -reach; x <= reach; x += LANES)
            sum += (f32x8)((i32x8)load8(to + x) & (NUMBERS8 < all8((float)(end - x))));
        total += __builtin_convertvector(sum, f64x8);
    }
    double light = 0.0;
    for (int i = 0; i < LANES; ++i) light += total[i];
    return light;
}

/* Reads a surveyed pupil. */
static void take_pupil(const psf_discs_job *discs, int64_t psf, pupil *own) {
    int n_terms = terms_of(discs->job->tables->order);
    own->order = discs->job->tables->order;
    memcpy(own->box, discs->box_um + psf * n_terms, sizeof *own->box * (size_t)n_terms);
    memcpy(own->half, discs->half_width + psf * 2, sizeof own->half);
    own->shear = discs->shear[psf];
    own->root = sqrt(1.0 - square(own->shear));
    own->wavelength_um = discs->wavelength_um[psf];
    memcpy(own->log_amplitude, discs->log_amplitude + psf * LOG_AMPLITUDES,
           sizeof own->log_amplitude);
    own->is_apodized = 0;
    for (int k = 0; k < LOG_AMPLITUDES; ++k) own->is_apodized |= own->log_amplitude[k] != 0.0;
    memcpy(own->low, discs->low_px + psf * 2, sizeof own->low);
    memcpy(own->high, discs->high_px + psf * 2, sizeof own->high);
    const double *edge = discs->edge_px + psf * 2 * N_EDGE;
    const double *normal = discs->normal + psf * 2 * N_EDGE;
    for (int i = 0; i < N_EDGE; ++i)
        for (int axis = 0; axis < 2; ++axis) {
            own->edge[axis][i] = (float)edge[2 * i + axis];
            own->normal[axis][i] = (float)normal[2 * i + axis];
        }
    own->edge_um = discs->edge_um[psf];
    own->passed_ratio = discs->passed_ratio[psf];
    own->rays_ratio = discs->rays_ratio[psf];
    own->weight = 1.0;
    own->rings = NULL;
    if (discs->ring_offset_mm == NULL) return;
    const psf_job *job = discs->job;
    const double *jacobian = discs->pixel_from_mrad + psf * 4;
    own->rings = job->ring_tables + discs->ring_channels[psf] * 2 * job->ring_count;
    for (int axis = 0; axis < 2; ++axis) {
        for (int q = 0; q < 2; ++q)
            own->from_box_mm[3 * axis + q] = jacobian[2 * q + axis] * own->half[q];
        own->from_box_mm[3 * axis + 2] = discs->ring_offset_mm[2 * psf + axis];
    }
}

static int32_t compute_disc(const psf_discs_job *discs, int64_t psf, psf_work *w) {
    const psf_job *job = discs->job;
    pupil own;
    grid g;
    take_pupil(discs, psf, &own);
    int radius = (int)discs->radius_px[psf], side = 2 * radius + 1;
    size_t count = (size_t)side * (size_t)side;
    if (own.rays_ratio < 1.0 && !plan_grid(job, &own, &g)) return PSF_NOT_HERE;
    /* Box of the light that the methods compute. */
    int box[4] = {radius, -radius, radius, -radius};
    widen_box(&own, &g, job->is_diffracting, box);
    for (int i = 0; i < 4; ++i) box[i] = clamp_int(box[i], -radius, radius);
    int width = box[1] - box[0] + 1, height = box[3] - box[2] + 1;
    size_t part_count = (size_t)(width * height);
    float *plane = room_for(&w->plane, count + LANES);
    float *part = room_for(&w->part, part_count + LANES);
    if (plane == NULL || part == NULL) return PSF_NO_MEMORY;
    memset(plane, 0, sizeof *plane * count);
    tail t = tail_of(job->tables, &own);
    float *kernel = discs->kernels + discs->first[psf];
    canvas c = {part, box[0], box[3], width, height};
    double light = 0.0;
    int is_first = 1;
    for (int by_rays = 0; by_rays < 2; ++by_rays) {
        double share = by_rays ? own.rays_ratio : 1.0 - own.rays_ratio;
        if (share <= 0.0) continue;
        memset(part, 0, sizeof *part * part_count);
        if (by_rays) {
            spot_of_rays(job->tables, &own, job->is_diffracting, &c);
        } else {
            if (!spot_of_waves(job, &own, &g, &w->waves, &c)) return PSF_NO_MEMORY;
            lift_beyond(&t, g.window, &c);
        }
        const tail *beyond = is_first && job->is_diffracting ? &t : NULL;
        double total = fill_disc(&c, beyond, radius, plane);
        float scale = total > 0.0 ? (float)(share / total) : 0.0f;
        for (size_t i = 0; i < count && is_first; ++i) kernel[i] = scale * plane[i];
        for (size_t i = 0; i < count && !is_first; ++i) kernel[i] += scale * plane[i];
        light += share * total;
        is_first = 0;
    }
    discs->light_ratio[psf] = light;
    return PSF_DONE;
}

typedef struct {
    const psf_discs_job *discs;
    psf_work *work;           /* one per thread */
} discs_work;

static void compute_disc_item(void *argument, int item, int thread) {
    discs_work *work = argument;
    int64_t first = (int64_t)item * PSFS_AN_ITEM, end = first + PSFS_AN_ITEM;
    for (int64_t psf = first; psf < end && psf < work->discs->count; ++psf)
        work->discs->outcome[psf] = compute_disc(work->discs, psf, work->work + thread);
}

/* Computes PSFs; 0 if out of memory. */
static int psf_discs(const psf_discs_job *discs) {
    pool *threads = discs->job->threads;
    int n_threads = pool_size(threads);
    discs_work work = {discs, calloc((size_t)n_threads, sizeof *work.work)};
    if (work.work == NULL) return 0;
    int items = (int)((discs->count + PSFS_AN_ITEM - 1) / PSFS_AN_ITEM);
    pool_run(threads, items, compute_disc_item, &work);
    for (int thread = 0; thread < n_threads; ++thread) free_work(work.work + thread);
    free(work.work);
    return 1;
}

/* PSFs over discs of given radii, in single precision, for the functions of estimator/psf. */

/* Adds a square to a kernel, with zeros outside the disc and a sum of `share`; returns
 * `share` times the light in the disc. */
static double add_disc(const float *from, int radius, double share, float *to) {
    int side = 2 * radius + 1;
    double total = 0.0;
    for (int y = -radius; y <= radius; ++y) {
        int reach = disc_reach(radius, y);
        total += light_of_row(from + (y + radius) * side + radius - reach, 2 * reach + 1).sum;
    }
    if (!(total > 0.0)) return 0.0;
    float scale = (float)(share / total);
    for (int y = -radius; y <= radius; ++y) {
        int reach = disc_reach(radius, y);
        size_t first = (size_t)((y + radius) * side + radius);
        for (int x = -reach; x <= reach; ++x) to[first + x] += scale * from[first + x];
    }
    return share * total;
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
    float *part = room_for(&w->part, (size_t)side * (size_t)side + LANES);
    if (part == NULL) return PSF_NO_MEMORY;
    double light = 0.0;
    for (int by_rays = 0; by_rays < 2; ++by_rays) {
        double share = by_rays ? own.rays_ratio : 1.0 - own.rays_ratio;
        if (share <= 0.0) continue;
        canvas c = {part, -radius, radius, side, side, radius};
        memset(part, 0, sizeof(float) * (size_t)side * (size_t)side);
        if (by_rays) {
            spot_of_rays(job->tables, &own, job->is_diffracting, &c);
        } else {
            if (!plan_grid(job, &own, &g)) return PSF_NOT_HERE;
            if (!spot_of_waves(job, &own, &g, &w->waves, &c)) return PSF_NO_MEMORY;
            const int *filled = g.window;
            if (filled[0] > -radius || filled[1] < radius || filled[2] > -radius
                || filled[3] < radius) {
                tail t = tail_of(job->tables, &own);
                lift_beyond(&t, &g, &c);
            }
        }
        light += add_disc(part, radius, share, discs->kernels + discs->first[psf]);
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

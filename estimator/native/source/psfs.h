/* From wavefronts to packed kernels: each PSF by the method valid for it, cropped to the box
 * that keeps its light, with 16 bits per weight (filter_service/psfs/pack.py).  Only texels
 * that are kept, and the spot with its surroundings, are computed. */

#include "dither.h"

#define MOST_REACH_PX 255
#define WEIGHT_MAX 65535.0
#define PSFS_AN_ITEM 8
#define RAYS_MARGIN_PX 7.5    /* the edge's light extends 6.25 px, over two pixels */
#define SIDES 4               /* left, right, up, down, as reaches are stored */

static const int side_axis[SIDES] = {0, 0, 1, 1};
static const double side_sign[SIDES] = {-1.0, 1.0, 1.0, -1.0};
static const float one_weight = 1.0f;

/* Memory of a thread. */
typedef struct {
    wave_work waves;
    scratch plane, part, kept;
    uint16_t *words;          /* all kernels of this thread */
    int64_t count, room;
} psf_work;

static void free_work(psf_work *w) {
    free_wave_work(&w->waves);
    free(w->plane.at);
    free(w->part.at);
    free(w->kept.at);
    free(w->words);
}

typedef struct {
    psf_work *work;           /* one per thread */
    int64_t *first;           /* (count,) in the words of the thread */
    int32_t *thread;          /* (count,) */
} psf_results;

INLINE int clamp_int(int value, int low, int high) {
    return value < low ? low : value > high ? high : value;
}

/* Prepares the pupil of one primary. */
static void prepare_pupil(const psf_job *job, int psf, int primary, pupil *own) {
    const psf_tables *tables = job->tables;
    int64_t group = job->groups[psf], node = job->nodes[psf] * job->primaries + primary;
    int64_t color = job->channels[psf] * job->primaries + primary;
    double zernike_um[MOST_TERMS], monomials_um[MOST_TERMS];
    int n_terms = terms_of(tables->order);
    for (int t = 0; t < n_terms; ++t)
        zernike_um[t] = job->zernike_um[node * n_terms + t]
                        + job->total_dpt[psf] * job->per_dpt_um[node * n_terms + t];
    FOR_ORDER(tables->order, times_matrix, zernike_um, tables->monomials, monomials_um);
    const double *ellipse = job->pupil_ellipse + node * ELLIPSE_COLUMNS;
    const double *jacobian = job->pixel_from_mrad + group * 4;
    frame_pupil(tables, monomials_um, job->circle_diameter_mm[node] / 2.0, ellipse, jacobian,
                own);
    own->wavelength_um = job->wavelength_nm[color] / 1000.0;
    memset(own->log_amplitude, 0, sizeof own->log_amplitude);
    own->is_apodized = 0;
    own->passed_ratio = 1.0;
    own->edge_um = own->wavelength_um;
    if (job->apodization_per_mm2 != NULL)
        apodize_pupil(tables, job->apodization_per_mm2[color], job->apodization_center_mm,
                      ellipse, jacobian, own);
    survey_pupil(tables, own);
    own->rays_ratio = job->is_diffracting ? share_of_rays(tables, own) : 1.0;
    own->weight = 1.0 / job->primaries;
    own->rings = NULL;
    if (job->ring_tables == NULL) return;
    own->rings = job->ring_tables + color * 2 * job->ring_count;
    own->rays_ratio = 0.0; /* only wave optics models rings */
    double farther_px = 0.0;
    for (int axis = 0; axis < 2; ++axis) {
        double reach_px = job->ring_reach_mrad[node]
                          * hypot(jacobian[2 * axis], jacobian[2 * axis + 1]);
        own->low[axis] -= reach_px;
        own->high[axis] += reach_px;
        farther_px = larger_double(farther_px, reach_px);
        for (int q = 0; q < 2; ++q)
            own->from_box_mm[3 * axis + q] = jacobian[2 * q + axis] * own->half[q];
        own->from_box_mm[3 * axis + 2] = job->ring_offset_mm[2 * node + axis];
    }
    own->blur_px += farther_px;
}

/* Extends a box x0, x1, y0, y1 to the pixels that a pupil's methods compute. */
static void widen_box(const pupil *own, const grid *g, int is_diffracting, int box[4]) {
    double margin = is_diffracting ? RAYS_MARGIN_PX : 1.5;
    for (int axis = 0; axis < 2; ++axis) {
        int *low = box + 2 * axis, *high = low + 1;
        if (own->rays_ratio > 0.0) {
            *low = smaller_int(*low, (int)floor(own->low[axis] - margin));
            *high = larger_int(*high, (int)ceil(own->high[axis] + margin));
        }
        if (own->rays_ratio < 1.0) {
            *low = smaller_int(*low, g->window[2 * axis]);
            *high = larger_int(*high, g->window[2 * axis + 1]);
        }
    }
}

/* Sets pixels outside a box x0, x1, y0, y1 (inclusive) to the mean light of the edge. */
static void lift_beyond(const tail *t, const int box[4], const canvas *c) {
    int end = c->left + c->width;
    for (int y = c->top; y > c->top - c->height; --y) {
        int gap[2] = {end, end};
        if (y >= box[2] && y <= box[3]) {
            gap[0] = clamp_int(box[0], c->left, end);
            gap[1] = clamp_int(box[1] + 1, gap[0], end);
        }
        write_tails(t, &one_weight, 1, y, c->left, end, gap,
                    c->pixels + (c->top - y) * c->width - c->left);
    }
}

/* Light of a plane, by column and row, for choosing the box. */
typedef struct {
    const pupil *pupils;
    int primaries, is_diffracting;
    const double *lines[2];   /* columns from the left, and rows from the bottom */
    int box[4];
    double total, center[2];
    double strength[2], source[2]; /* of the tail: sum, and mean position, along an axis */
} light_of_plane;

static double all_light_beyond(const light_of_plane *l, int axis, double sign, double end) {
    double sum = 0.0;
    if (!l->is_diffracting) return 0.0;
    for (int p = 0; p < l->primaries; ++p)
        sum += l->pupils[p].weight * light_beyond(l->pupils + p, axis, sign, end);
    return sum;
}

/* Smallest reach on a side beyond which there is no more light than the share; also returns
 * that light and its moment about the center along the axis.  The moment omits the part at
 * infinity, which is equal on the other side. */
static int reach_of_side(const light_of_plane *l, int side, double share, int most,
                         double *cut, double *moment) {
    int axis = side_axis[side];
    double sign = side_sign[side], allowed = share * l->total;
    const double *lines = l->lines[axis];
    int low = l->box[2 * axis], high = l->box[2 * axis + 1];
    int end = sign > 0.0 ? high : -low; /* of the plane, outward */
    double beyond = all_light_beyond(l, axis, sign, end + 0.5);
    double middle = sign * l->center[axis], source = sign * l->source[axis];
    int at = end;
    double added = 0.0;
    if (beyond > allowed) {
        int step = 1, far;
        while (at < most) {   /* outward: doubled steps, then bisection */
            far = smaller_int(at + step, most);
            double light = all_light_beyond(l, axis, sign, far + 0.5);
            if (light <= allowed) {
                int near = at;
                while (far - near > 1) {
                    int between = (near + far) / 2;
                    double here = all_light_beyond(l, axis, sign, between + 0.5);
                    if (here <= allowed) {
                        far = between;
                        light = here;
                    } else near = between;
                }
                at = far;
                beyond = light;
                break;
            }
            at = far;
            beyond = light;
            step *= 2;
        }
        end = at;
    } else {
        double light = beyond;
        while (at > 0) {
            int place = sign > 0.0 ? at - low : -at - low;
            if (light + lines[place] > allowed) break;
            light += lines[place];
            added += lines[place] * (at - middle);
            --at;
        }
        *cut = light;
        *moment = added;
        if (l->is_diffracting)
            *moment += l->strength[axis] * ((source - middle) / (end + 0.5 - source)
                                            - log(end + 0.5 - source));
        return at;
    }
    *cut = beyond;
    *moment = l->strength[axis] * ((source - middle) / (end + 0.5 - source)
                                   - log(end + 0.5 - source));
    return at;
}

/* Chooses reaches that crop a share of the light, less if that shifts the centroid. */
static void choose_box(const psf_job *job, const light_of_plane *l, double spread_px,
                       int most, int reaches[SIDES]) {
    double limit = job->centroid_ratio * larger_double(spread_px, 1.0);
    double share = job->cut_ratio / SIDES;
    for (int step = 0; step <= job->cut_steps; ++step) {
        double cut[SIDES], moment[SIDES];
        if (step == job->cut_steps) share = 0.0;
        for (int side = 0; side < SIDES; ++side)
            reaches[side] = reach_of_side(l, side, share, most, cut + side, moment + side);
        double shift = 0.0;
        for (int axis = 0; axis < 2; ++axis) {
            const double *c = cut + 2 * axis, *m = moment + 2 * axis;
            double held = l->total - c[0] - c[1];
            shift = larger_double(shift, fabs(m[0] - m[1]) / larger_double(held, 1e-12));
        }
        if (shift <= limit) break;
        share /= 2.0;
    }
}

/* Buffer for `count` more words; NULL if out of memory. */
static uint16_t *more_words(psf_work *w, int64_t count) {
    if (w->count + count > w->room) {
        int64_t room = 2 * (w->count + count);
        uint16_t *words = realloc(w->words, sizeof *words * (size_t)room);
        if (words == NULL) return NULL;
        w->words = words;
        w->room = room;
    }
    return w->words + w->count;
}

/* Light of the pupils' edges outside a box. */
static double tail_outside(const psf_job *job, const pupil *pupils, const int box[4]) {
    double sum = 0.0;
    for (int p = 0; p < job->primaries && job->is_diffracting; ++p)
        sum += pupils[p].weight * light_outside(pupils + p, box);
    return sum;
}

typedef struct { double sum, squares, peak; } row_light;

static row_light light_of_row(const float *from, int count) {
    f32x8 sum = all8(0.0f), squares = sum, peak = sum;
    for (int i = 0; i < count; i += LANES) {
        f32x8 value = all8(0.0f);
        if (i + LANES <= count) value = load8(from + i);
        else memcpy(&value, from + i, sizeof(float) * (size_t)(count - i));
        sum += value;
        squares += value * value;
        peak = larger8(peak, value);
    }
    return (row_light){sum8(sum), sum8(squares), (double)-least8(-peak)};
}

/* Crops a plane to its box, adds the tail where the box is larger, and quantizes it in steps
 * of its peak. */
static int32_t pack_plane(const psf_job *job, int psf, const pupil *pupils,
                          const tail *tails, const canvas *c, psf_work *w) {
    double columns[2 * MOST_REACH_PX + 64] = {0.0}, rows[2 * MOST_REACH_PX + 64] = {0.0};
    double squares = 0.0, total = 0.0, moment_x = 0.0, moment_y = 0.0;
    for (int row = 0; row < c->height; ++row) {
        const float *from = c->pixels + row * c->width;
        for (int column = 0; column < c->width; ++column)
            columns[column] += (double)from[column];
        row_light light = light_of_row(from, c->width);
        rows[c->height - 1 - row] = light.sum;
        squares += light.squares;
        total += light.sum;
        moment_y += light.sum * (c->top - row);
    }
    if (!(total > 0.0)) return PSF_NOT_HERE;
    for (int column = 0; column < c->width; ++column)
        moment_x += columns[column] * (c->left + column);
    light_of_plane l = {
        .pupils = pupils, .primaries = job->primaries,
        .is_diffracting = job->is_diffracting, .lines = {columns, rows},
        .box = {c->left, c->left + c->width - 1, c->top - c->height + 1, c->top}};
    double outside = tail_outside(job, pupils, l.box);
    l.total = total + outside;
    for (int axis = 0; axis < 2 && job->is_diffracting; ++axis) {
        double sum = 0.0, places = 0.0;
        for (int p = 0; p < job->primaries; ++p) {
            const pupil *own = pupils + p;
            double scale = own->weight * own->edge_um / (2.0 * M_PI * M_PI * N_EDGE);
            for (int i = 0; i < N_EDGE; ++i) {
                double strength = scale * fabs(own->normal[axis][i]);
                sum += strength;
                places += strength * own->edge[axis][i];
            }
        }
        l.strength[axis] = sum;
        l.source[axis] = places / sum;
    }
    l.center[0] = (moment_x + outside * l.source[0]) / l.total;
    l.center[1] = (moment_y + outside * l.source[1]) / l.total;
    int most = smaller_int(job->max_radius_px, MOST_REACH_PX);
    int reaches[SIDES];
    choose_box(job, &l, total / sqrt(M_PI * squares), most, reaches);
    int left = clamp_int(reaches[0], 0, most), right = clamp_int(reaches[1], 0, most);
    int up = clamp_int(reaches[2], 0, most), down = clamp_int(reaches[3], 0, most);
    int width = left + right + 1, height = up + down + 1;
    float *kept = room_for(&w->kept, (size_t)(width * height) + LANES);
    uint16_t *words = more_words(w, (int64_t)width * height);
    if (kept == NULL || words == NULL) return PSF_NO_MEMORY;
    float weights[MOST_PRIMARIES];
    for (int p = 0; p < job->primaries; ++p) weights[p] = (float)pupils[p].weight;
    double sum = 0.0, peak = 0.0, inside = 0.0; /* inside: light of the plane's own pixels */
    squares = 0.0;
    for (int row = 0; row < height; ++row) {
        int y = up - row, end = right + 1, gap[2] = {end, end};
        float *to = kept + row * width;
        if (!job->is_diffracting) memset(to, 0, sizeof *to * (size_t)width);
        if (y <= c->top && y > c->top - c->height) {
            gap[0] = clamp_int(c->left, -left, end);
            gap[1] = clamp_int(c->left + c->width, gap[0], end);
            int count = gap[1] - gap[0];
            const float *from = c->pixels + (c->top - y) * c->width + gap[0] - c->left;
            inside += light_of_row(from, count).sum;
            memcpy(to + left + gap[0], from, sizeof(float) * (size_t)count);
        }
        if (job->is_diffracting)
            write_tails(tails, weights, job->primaries, y, -left, end, gap, to + left);
        row_light light = light_of_row(to, width);
        sum += light.sum;
        squares += light.squares;
        peak = larger_double(peak, light.peak);
    }
    if (!(sum > 0.0)) return PSF_NOT_HERE;
    int farthest = 0;
    float per_step = (float)(WEIGHT_MAX / peak);
    for (int row = 0; row < height; ++row) {
        int y = up - row, outermost = -1;
        const float *from = kept + row * width;
        uint16_t *to = words + row * width;
        for (int column = 0; column < width; ++column) {
            float steps = from[column] * per_step + before_cut[y & 3][(column - left) & 3];
            to[column] = (uint16_t)smaller_float(steps, 65535.0f);
        }
        for (int x = left; x >= 0 && outermost < 0; --x)
            if (to[left - x] > 0) outermost = x;
        for (int x = right; x > outermost; --x)
            if (to[left + x] > 0) outermost = x;
        if (outermost >= 0) farthest = larger_int(farthest, outermost * outermost + y * y);
    }
    job->reach_px[4 * psf + 0] = left;
    job->reach_px[4 * psf + 1] = right;
    job->reach_px[4 * psf + 2] = up;
    job->reach_px[4 * psf + 3] = down;
    job->radius_px[psf] = (int64_t)ceil(sqrt(farthest) - 0.5);
    job->sizes[psf] = (int64_t)width * height;
    job->peak_ratio[psf] = peak / sum;
    job->spread_px[psf] = sum / sqrt(M_PI * squares);
    const int both[4] = {smaller_int(-left, l.box[0]), larger_int(right, l.box[1]),
                         smaller_int(-down, l.box[2]), larger_int(up, l.box[3])};
    double lost = total - inside + tail_outside(job, pupils, both);
    job->lost_ratio[psf] = smaller_double(1.0, larger_double(0.0, lost / l.total));
    w->count += (int64_t)width * height;
    return PSF_DONE;
}

static int32_t compute_psf(const psf_job *job, int psf, psf_work *w) {
    pupil pupils[MOST_PRIMARIES];
    tail tails[MOST_PRIMARIES];
    grid grids[MOST_PRIMARIES];
    int box[4] = {0, 0, 0, 0}; /* contains the chief ray */
    double rays_ratio = 0.0;
    for (int p = 0; p < job->primaries; ++p) {
        pupil *own = pupils + p;
        prepare_pupil(job, psf, p, own);
        if (!(own->blur_px >= 0.0 && own->blur_px + PIXEL_CORNER_PX <= job->max_radius_px))
            return PSF_NOT_HERE;
        if (own->rays_ratio < 1.0 && !plan_grid(job, own, grids + p)) return PSF_NOT_HERE;
        widen_box(own, grids + p, job->is_diffracting, box);
        tails[p] = tail_of(job->tables, own);
        rays_ratio += own->weight * own->rays_ratio;
    }
    int farthest = MOST_REACH_PX + 16;
    for (int i = 0; i < 4; ++i) box[i] = clamp_int(box[i], -farthest, farthest);
    int width = box[1] - box[0] + 1, height = box[3] - box[2] + 1, count = width * height;
    float *plane = room_for(&w->plane, (size_t)count + LANES);
    float *part = room_for(&w->part, (size_t)count + LANES);
    if (plane == NULL || part == NULL) return PSF_NO_MEMORY;
    int is_first = 1;
    for (int p = 0; p < job->primaries; ++p)
        for (int by_rays = 0; by_rays < 2; ++by_rays) {
            const pupil *own = pupils + p;
            double weight = own->weight
                            * (by_rays ? own->rays_ratio : 1.0 - own->rays_ratio);
            if (weight <= 0.0) continue;
            canvas c = {is_first ? plane : part, box[0], box[3], width, height};
            memset(c.pixels, 0, sizeof(float) * (size_t)count);
            if (by_rays) {
                spot_of_rays(job->tables, own, job->is_diffracting, &c);
            } else {
                if (!spot_of_waves(job, own, grids + p, &w->waves, &c)) return PSF_NO_MEMORY;
                lift_beyond(tails + p, grids[p].window, &c);
            }
            float share = (float)weight;
            if (is_first && share != 1.0f)
                for (int i = 0; i < count; ++i) plane[i] *= share;
            if (!is_first)
                for (int i = 0; i < count; ++i) plane[i] += share * part[i];
            is_first = 0;
        }
    job->rays_ratio[psf] = rays_ratio;
    canvas c = {plane, box[0], box[3], width, height};
    return pack_plane(job, psf, pupils, tails, &c, w);
}

static void compute_psf_item(void *argument, int item, int thread) {
    const psf_job *job = argument;
    psf_results *results = job->results;
    psf_work *w = results->work + thread;
    int first = item * PSFS_AN_ITEM;
    int last = smaller_int(first + PSFS_AN_ITEM, job->count);
    for (int psf = first; psf < last; ++psf) {
        results->thread[psf] = thread;
        results->first[psf] = w->count;
        job->sizes[psf] = 0;
        job->outcome[psf] = compute_psf(job, psf, w);
    }
}

/* Computes the PSFs of a job; 0 if out of memory.  `take_psfs` must follow. */
static int psfs(psf_job *job) {
    size_t n_threads = (size_t)pool_size(job->threads), count = (size_t)job->count;
    psf_results *results = calloc(1, sizeof *results);
    if (results == NULL) return 0;
    job->results = results;
    results->work = calloc(n_threads, sizeof *results->work);
    results->first = calloc(count + 1, sizeof *results->first);
    results->thread = calloc(count + 1, sizeof *results->thread);
    if (results->work == NULL || results->first == NULL || results->thread == NULL) return 0;
    int items = (job->count + PSFS_AN_ITEM - 1) / PSFS_AN_ITEM;
    pool_run(job->threads, items, compute_psf_item, job);
    return 1;
}

/* Copies the kernels, concatenated, and frees the job's memory; with NULL, only frees. */
static void take_psfs(psf_job *job, uint16_t *words) {
    psf_results *results = job->results;
    job->results = NULL;
    if (results == NULL) return;
    for (int psf = 0; words != NULL && psf < job->count; ++psf) {
        size_t size = (size_t)job->sizes[psf];
        if (size == 0) continue; // refused: its thread may hold no words at all
        memcpy(words, results->work[results->thread[psf]].words + results->first[psf],
               sizeof *words * size);
        words += size;
    }
    int n_threads = results->work == NULL ? 0 : pool_size(job->threads);
    for (int thread = 0; thread < n_threads; ++thread) free_work(results->work + thread);
    free(results->work);
    free(results->first);
    free(results->thread);
    free(results);
}

/* The splat of a frame as a linear operator of its colors, and the adjoint of that operator,
 * by the plan of operator_plan.h.
 *
 * The adjoint gathers: each pixel of the input sums the parts' pixels that it lights, times
 * the same weights.  A single thread sums a row of blocks, in the order of its clusters and of
 * their bins.  Twin: tests/numerical/test_operator.py, which compares whole matrices. */

#include <math.h>

#include "frame.h"
#include "vectors.h"

INLINE float finite_or_0(float value) { return isfinite(value) ? value : 0.0f; }

/* Item: a row of blocks.  Sets the light of fragments to their color, or to 1 if there is none,
 * times their coverage. */
static void set_lights(void *argument, int row, int thread) {
    (void)thread;
    const operator_job *job = argument;
    const frame *f = job->f;
    const block_info *blocks = f->blocks + row * f->block_columns;
    int64_t first_row = (int64_t)(row / f->block_rows) * f->image_height;
    for (uint32_t at = blocks->first; at < blocks[f->block_columns - 1].end; ++at) {
        const fragment *one = f->fragments + at;
        float coverage = one->state & SPECIAL_BIT ? f->extras[at].coverage : 1.0f;
        float *rgb = f->lights[at].rgb;
        if (job->color == NULL) {
            for (int c = 0; c < RGB; ++c) rgb[c] = coverage;
            continue;
        }
        int x = clamped_int(one->x - f->border_px, 0, f->image_width - 1);
        int y = clamped_int(one->y - f->border_px, 0, f->image_height - 1);
        const float *color = job->color + RGB * ((first_row + y) * f->image_width + x);
        for (int c = 0; c < RGB; ++c) rgb[c] = coverage * finite_or_0(color[c]);
    }
}

/* Pixels of a bin within the image, with the first pixel of a row of them. */
INLINE size_t first_pixel(const frame *f, const bin_result *inside, int x0, int y0, int y) {
    return RGB * ((size_t)(y0 + y - f->border_px) * (size_t)f->image_width
                  + (size_t)(x0 + inside->left - f->border_px));
}

/* Item: one bin of the image. */
static void apply_bin(void *argument, int item, int thread) {
    (void)thread;
    const operator_job *job = argument;
    const frame *f = job->f;
    const bin_plan *bin = job->plan->bins + item;
    int x0 = item % job->plan->columns * BIN_WIDTH, y0 = item / job->plan->columns * BIN_HEIGHT;
    bin_result inside = inside_of(f, x0, y0);
    if (inside.left >= inside.right || inside.top >= inside.bottom) return;
    bin_sums s;
    window w = open_window(x0, y0, &s);
    float sums[BIN_HEIGHT * PAIRS_ACROSS * PAIR_FLOATS] = {0};
    raster *open = w.open.sizes;
    for (const bin_part *part = bin->parts; part < bin->parts + bin->part_count; ++part) {
        for (int i = part->first; i < part->end; ++i)
            add_light(f, bin->clusters[i], part->group, &w.open);
        int top = larger_int(part->top, open->top);
        int bottom = smaller_int(part->bottom, open->bottom);
        const float *factors = bin->factors + part->first_factor;
        factors += (top - part->top) * PAIRS_ACROSS * PAIR_FLOATS;
        for (int i = top * PAIRS_ACROSS; i < bottom * PAIRS_ACROSS; ++i) {
            float *sum = sums + i * PAIR_FLOATS;
            store8(sum, load8(sum) + load8(factors) * open->pairs[i].light);
            factors += PAIR_FLOATS;
        }
        darken_raster(open);
    }
    for (int y = inside.top; y < inside.bottom; ++y) {
        size_t first = first_pixel(f, &inside, x0, y0, y);
        for (int x = inside.left; x < inside.right; ++x)
            for (int c = 0; c < RGB; ++c) {
                size_t at = first + RGB * (size_t)(x - inside.left) + (size_t)c;
                int from = (y * BIN_WIDTH + x) * 4 + c;
                job->to[at] = sums[from];
                if (bin->own != NULL) job->to[at] += bin->own[from] * finite_or_0(job->color[at]);
            }
    }
}

/* Writes the image (image_height, image_width, 3) of colors (surface_count, image_height,
 * image_width, 3). */
static void apply_operator(frame *f, int64_t address, const float *color, float *image) {
    operator_plan *plan = (operator_plan *)(intptr_t)address;
    operator_job job = {.f = f, .plan = plan, .color = color, .to = image};
    pool_run(f->threads, f->surface_count * f->block_rows, set_lights, &job);
    pool_run(f->threads, plan->columns * plan->rows, apply_bin, &job);
}

/* Item: one bin.  Multiplies the image by the factors of the parts. */
static void weigh_bin(void *argument, int item, int thread) {
    (void)thread;
    const operator_job *job = argument;
    const frame *f = job->f;
    const bin_plan *bin = job->plan->bins + item;
    if (bin->part_count == 0) return;
    int x0 = item % job->plan->columns * BIN_WIDTH, y0 = item / job->plan->columns * BIN_HEIGHT;
    bin_result inside = inside_of(f, x0, y0);
    float seen[BIN_HEIGHT * PAIRS_ACROSS * PAIR_FLOATS] = {0};
    for (int y = inside.top; y < inside.bottom; ++y) {
        const float *from = job->image + first_pixel(f, &inside, x0, y0, y);
        float *to = seen + (y * BIN_WIDTH + inside.left) * 4;
        for (int x = inside.left; x < inside.right; ++x, from += RGB, to += 4)
            for (int c = 0; c < RGB; ++c) to[c] = finite_or_0(from[c]);
    }
    for (const bin_part *part = bin->parts; part < bin->parts + bin->part_count; ++part) {
        const float *factors = bin->factors + part->first_factor;
        float *to = bin->weighted + part->first_factor;
        for (int i = part->top * PAIRS_ACROSS; i < part->bottom * PAIRS_ACROSS; ++i) {
            store8(to, load8(factors) * load8(seen + i * PAIR_FLOATS));
            factors += PAIR_FLOATS;
            to += PAIR_FLOATS;
        }
    }
}

/* Pixels of a part that a member lights. */
typedef struct {
    int rows;                 /* their number; none if not positive */
    int first, last;          /* pairs, the last plus one */
    size_t start;             /* floats of the part before the first row */
    const uint32_t *texels;   /* of the first row at pair 0, which may be outside the kernel */
    ptrdiff_t stride;         /* words */
} footprint;

INLINE footprint footprint_of(const frame *f, const member *one, const level_image *image,
                              const bin_part *part) {
    int row = larger_int(one->top, part->top);
    ptrdiff_t stride = 4 * (ptrdiff_t)row_texels(image);
    return (footprint){
        .rows = smaller_int(one->top + image->height, part->bottom) - row,
        .first = larger_int(one->left, 0) / 2,
        .last = smaller_int((one->left + image->width + 1) / 2, PAIRS_ACROSS),
        .start = (size_t)(row - part->top) * PAIRS_ACROSS * PAIR_FLOATS,
        .texels = f->kernel_texels + 4 * (size_t)image->first_texel + row * stride
                  + 4 * (ptrdiff_t)one->from,
        .stride = stride};
}

/* The compiler generates a loop for each number of pairs: CASE(n), up to PAIRS_ACROSS. */
#define EACH_WIDTH                                                                           \
    CASE(1) CASE(2) CASE(3) CASE(4) CASE(5) CASE(6) CASE(7) CASE(8) CASE(9) CASE(10)         \
    CASE(11) CASE(12) CASE(13) CASE(14) CASE(15) CASE(16)

/* Weights of a kernel at a pair of pixels, in steps. */
INLINE f32x8 weight_of(const uint32_t *texels, i32x8 factors) {
    return __builtin_convertvector(pair_sums(read_pairs(texels), factors), f32x8);
}

/* Sums rows of `pairs` adjacent pairs of pixels, times the weights of a kernel. */
INLINE f32x8 gather_columns(const uint32_t *texels, ptrdiff_t stride, const float *weighted,
                            int rows, i32x8 factors, int pairs) {
    /* Several sums, because additions wait for those before them. */
    f32x8 sums[4] = {all8(0.0f), all8(0.0f), all8(0.0f), all8(0.0f)};
    int row = 0;
    for (int step = pairs > 2 ? 1 : 2; row + step <= rows; row += step)
        for (int n = 0; n < step; ++n) {
            for (int p = 0; p < pairs; ++p)
                sums[(n * pairs + p) % 4] += weight_of(texels + 8 * p, factors)
                                             * load8(weighted + PAIR_FLOATS * p);
            texels += stride;
            weighted += PAIRS_ACROSS * PAIR_FLOATS;
        }
    if (row < rows)
        for (int p = 0; p < pairs; ++p)
            sums[p % 4] += weight_of(texels + 8 * p, factors) * load8(weighted + PAIR_FLOATS * p);
    sums[0] += sums[1];
    sums[2] += sums[3];
    sums[0] += sums[2];
    return sums[0];
}

/* Returns the light of a part that a member receives, of each color. */
INLINE f32x4 gather_member(const frame *f, const member *one, const level_image *image,
                           const bin_part *part, const float *weighted) {
    footprint own = footprint_of(f, one, image, part);
    f32x8 sum = all8(0.0f);
    if (own.rows <= 0 || own.first >= own.last) return all4(0.0f);
    weighted += own.start;
    i32x8 factors = all_ints8(one->factors);
    const uint32_t *from = own.texels + 8 * own.first;
    weighted += PAIR_FLOATS * own.first;
#define CASE(n) \
    case n: sum = gather_columns(from, own.stride, weighted, own.rows, factors, n); break;
    switch (own.last - own.first) { EACH_WIDTH default: break; }
#undef CASE
    f32x4 low = {sum[0], sum[1], sum[2], sum[3]}, high = {sum[4], sum[5], sum[6], sum[7]};
    return (low + high) * one->color;
}

/* Item: a row of blocks.  Sums the light of all parts that its fragments light. */
static void gather_row(void *argument, int row, int thread) {
    (void)thread;
    const operator_job *job = argument;
    const frame *f = job->f;
    const operator_plan *plan = job->plan;
    const block_info *blocks = f->blocks + row * f->block_columns;
    int surface = row / f->block_rows, y0 = row % f->block_rows * TILE_SIZE_PX;
    int height = smaller_int(TILE_SIZE_PX, f->height - y0);
    float *lights = job->lights + RGB * (size_t)surface * (size_t)f->width * (size_t)f->height;
    memset(lights + RGB * (size_t)y0 * (size_t)f->width, 0,
           RGB * (size_t)height * (size_t)f->width * sizeof *lights);
    uint32_t end = blocks[f->block_columns - 1].end_cluster;
    for (uint32_t at = blocks->first_cluster; at < end; ++at) {
        const cluster *own = f->clusters + at;
        const level_image *image = image_of(f, own->state);
        for (uint32_t k = plan->first_place[at]; k < plan->first_place[at + 1]; ++k) {
            part_place place = plan->places[k];
            const bin_plan *bin = plan->bins + place.bin;
            const bin_part *part = bin->parts + place.part;
            raster window_of = {.x0 = (int)place.bin % plan->columns * BIN_WIDTH,
                                .y0 = (int)place.bin / plan->columns * BIN_HEIGHT};
            members all;      /* is not cleared */
            list_members(f, own, part->group, image, &window_of, &all);
            for (const member *one = all.of; one < all.of + all.count; ++one) {
                int x = one->left + image->left + window_of.x0;
                int y = one->top + image->up + window_of.y0;
                f32x4 sum = gather_member(f, one, image, part,
                                          bin->weighted + part->first_factor);
                float *to = lights + RGB * ((size_t)y * (size_t)f->width + (size_t)x);
                for (int c = 0; c < RGB; ++c) to[c] += sum[c];
            }
        }
    }
}

/* Item: a row of a surface's colors.  Sums the pixels of the frame that have its color: also
 * those of the border. */
static void fold_row(void *argument, int row, int thread) {
    (void)thread;
    const operator_job *job = argument;
    const frame *f = job->f;
    int surface = row / f->image_height, y = row % f->image_height, border = f->border_px;
    int top = y == 0 ? 0 : y + border;
    int bottom = y == f->image_height - 1 ? f->height : y + border + 1;
    float *to = job->to + RGB * (size_t)row * (size_t)f->image_width;
    memset(to, 0, RGB * (size_t)f->image_width * sizeof *to);
    for (int from_y = top; from_y < bottom; ++from_y) {
        const float *from = job->lights
                            + RGB * ((size_t)surface * (size_t)f->height + (size_t)from_y)
                                  * (size_t)f->width;
        for (int x = 0; x < f->width; ++x, from += RGB) {
            int own = clamped_int(x - border, 0, f->image_width - 1);
            for (int c = 0; c < RGB; ++c) to[RGB * own + c] += from[c];
        }
    }
}

/* Item: one bin.  Adds the image of pixels that show their own color. */
static void add_own(void *argument, int item, int thread) {
    (void)thread;
    const operator_job *job = argument;
    const float *own = job->plan->bins[item].own;
    if (own == NULL) return;
    int x0 = item % job->plan->columns * BIN_WIDTH, y0 = item / job->plan->columns * BIN_HEIGHT;
    bin_result inside = inside_of(job->f, x0, y0);
    for (int y = inside.top; y < inside.bottom; ++y) {
        size_t first = first_pixel(job->f, &inside, x0, y0, y);
        for (int x = inside.left; x < inside.right; ++x)
            for (int c = 0; c < RGB; ++c) {
                size_t at = first + RGB * (size_t)(x - inside.left) + (size_t)c;
                job->to[at] += own[(y * BIN_WIDTH + x) * 4 + c] * finite_or_0(job->image[at]);
            }
    }
}

/* Writes the adjoint of an image: colors as those of apply_operator.  bordered
 * (surface_count, height, width, 3) is scratch, NULL if the frame has no border. */
static void apply_adjoint(frame *f, int64_t address, const float *image, float *bordered,
                          float *color) {
    operator_plan *plan = (operator_plan *)(intptr_t)address;
    operator_job job = {.f = f, .plan = plan, .image = image, .to = color,
                        .lights = bordered == NULL ? color : bordered};
    int bins = plan->columns * plan->rows;
    pool_run(f->threads, f->surface_count * f->block_rows, set_lights, &job);
    pool_run(f->threads, bins, weigh_bin, &job);
    pool_run(f->threads, f->surface_count * f->block_rows, gather_row, &job);
    if (bordered != NULL)
        pool_run(f->threads, f->surface_count * f->image_height, fold_row, &job);
    pool_run(f->threads, bins, add_own, &job);
}

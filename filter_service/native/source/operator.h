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

/* Light of clusters in a bin; all rows that are not lit are zero. */
typedef struct {
    float rows[BIN_HEIGHT * ROW_FLOATS];
    int top, bottom;          /* lit rows: the first, and the last plus one */
} lit_rows;

/* Weights of a kernel at eight floats of a row, in steps. */
INLINE f32x8 weight_of(const uint32_t *words, i32x8 factors) {
    return __builtin_convertvector(pair_sums(read_pairs(words), factors), f32x8);
}

/* Adds members to `vectors` adjacent vectors of a row, row by row: the sums of a row stay in
 * registers.  The compiler generates a loop for each number of vectors. */
INLINE void add_vectors(const uint32_t *words, ptrdiff_t stride, const members *all, int count,
                        int height, lit_rows *own, int first, int vectors) {
    const member *one = all->of, *end = all->of, *last = all->of + count;
    int row = larger_int(one->top, 0);
    int last_row = smaller_int(last[-1].top + height, BIN_HEIGHT);
    words += row * stride + 8 * first;
    float *to = own->rows + row * ROW_FLOATS + 8 * first;
    i32x8 places = {0, 1, 2, 3, 4, 5, 6, 7}, lanes[RGB];  /* colors of adjacent vectors */
    for (int v = 0; v < RGB; ++v)
        lanes[v] = (places + all_ints8(8 * (first + v))) % all_ints8(RGB);
    for (; row < last_row; ++row, words += stride, to += ROW_FLOATS) {
        while (end < last && end->top <= row) ++end;
        while (one < end && one->top + height <= row) ++one;
        f32x8 light[COLUMN_VECTORS];
        for (int v = 0; v < vectors; ++v) light[v] = all8(0.0f);
        if (one < end) {
            prefetch_row(words + PREFETCHED_ROWS * stride + one->from);
            prefetch_row(words + PREFETCHED_ROWS * stride + end[-1].from);
        }
        for (const member *next = one; next < end; ++next) {
            const uint32_t *from = words + next->from;
            i32x8 factors = all_ints8(next->factors);
            f32x8 color = load_twice4((const float *)&next->color), colors[RGB];
            for (int v = 0; v < RGB; ++v) colors[v] = lanes_of8(color, lanes[v]);
            for (int v = 0; v < vectors; ++v)
                light[v] += weight_of(from + 8 * v, factors) * colors[v % RGB];
        }
        for (int v = 0; v < vectors; ++v) store8(to + 8 * v, load8(to + 8 * v) + light[v]);
    }
}

/* Adds the light of a cluster in a group of depths. */
static void add_light(const frame *f, const operator_plan *plan, uint32_t at, int32_t group,
                      const raster *window_of, lit_rows *own) {
    const cluster *from = f->clusters + at;
    const level_image *image = image_of(f, from->state);
    members all, some;        /* are not cleared */
    list_members(f, from, group, image, window_of, &all);
    if (all.count == 0) return;
    ptrdiff_t stride = packed_row(image);
    for (member *one = all.of; one < all.of + all.count; ++one)
        one->from = (int32_t)(-RGB * one->left - one->top * stride);
    int top = all.of[0].top, bottom = all.of[all.count - 1].top + image->height;
    own->top = smaller_int(own->top, larger_int(top, 0));
    own->bottom = larger_int(own->bottom, smaller_int(bottom, BIN_HEIGHT));
    int leftmost = from->left - image->left - window_of->x0;
    int rightmost = from->right - image->left - window_of->x0;
    int left = RGB * larger_int(leftmost, 0) / 8;
    int right = (RGB * smaller_int(rightmost + image->width, BIN_WIDTH) + 7) / 8;
    int columns = (right - left + COLUMN_VECTORS - 1) / COLUMN_VECTORS;
    const uint32_t *words = plan->words + plan->first_word[from->state & KERNEL_MASK];
    for (int first = left, vectors; first < right; first += vectors, --columns) {
        vectors = (right - first + columns - 1) / columns;
        int x = 8 * first / RGB, end = (8 * (first + vectors) + 2) / RGB, count = all.count;
        const members *touch = &all;
        if (rightmost >= end || leftmost + image->width <= x) {
            count = keep_touching(&all, x, end, image->width, &some);
            touch = &some;
            if (count == 0) continue;
        }
#define CASE(n) \
    case n: add_vectors(words, stride, touch, count, image->height, own, first, n); break;
        switch (vectors) { CASE(1) CASE(2) CASE(3) CASE(4) CASE(5) CASE(6) default: break; }
#undef CASE
    }
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
    raster window_of = {.x0 = x0, .y0 = y0};
    float sums[BIN_HEIGHT * ROW_FLOATS] = {0};
    lit_rows lit = {.top = BIN_HEIGHT};
    for (const bin_part *part = bin->parts; part < bin->parts + bin->part_count; ++part) {
        for (int i = part->first; i < part->end; ++i)
            add_light(f, job->plan, bin->clusters[i], part->group, &window_of, &lit);
        int top = larger_int(part->top, lit.top), bottom = smaller_int(part->bottom, lit.bottom);
        const float *factors = bin->factors + part->first_factor + (top - part->top) * ROW_FLOATS;
        for (int i = top * ROW_FLOATS; i < bottom * ROW_FLOATS; i += 8, factors += 8)
            store8(sums + i, load8(sums + i) + load8(factors) * load8(lit.rows + i));
        if (lit.top < lit.bottom)
            memset(lit.rows + lit.top * ROW_FLOATS, 0,
                   sizeof(float[ROW_FLOATS]) * (size_t)(lit.bottom - lit.top));
        lit.top = BIN_HEIGHT;
        lit.bottom = 0;
    }
    for (int y = inside.top; y < inside.bottom; ++y) {
        size_t first = first_pixel(f, &inside, x0, y0, y);
        int from = y * ROW_FLOATS + RGB * inside.left;
        for (int i = 0; i < RGB * (inside.right - inside.left); ++i) {
            size_t at = first + (size_t)i;
            job->to[at] = sums[from + i];
            if (bin->own != NULL)
                job->to[at] += bin->own[from + i] * finite_or_0(job->color[at]);
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
    float seen[BIN_HEIGHT * ROW_FLOATS] = {0};
    for (int y = inside.top; y < inside.bottom; ++y) {
        const float *from = job->image + first_pixel(f, &inside, x0, y0, y);
        float *to = seen + y * ROW_FLOATS + RGB * inside.left;
        for (int i = 0; i < RGB * (inside.right - inside.left); ++i) to[i] = finite_or_0(from[i]);
    }
    for (const bin_part *part = bin->parts; part < bin->parts + bin->part_count; ++part) {
        const float *factors = bin->factors + part->first_factor;
        float *to = bin->weighted + part->first_factor;
        for (int i = part->top * ROW_FLOATS; i < part->bottom * ROW_FLOATS; i += 8) {
            store8(to, load8(factors) * load8(seen + i));
            factors += 8;
            to += 8;
        }
    }
}

/* Sums `rows` rows of `vectors` adjacent vectors, times the weights of a kernel, in the order
 * of colors in which the rows start. */
INLINE void gather_vectors(const uint32_t *words, ptrdiff_t stride, const float *weighted,
                           int rows, i32x8 factors, int vectors, f32x8 *sums) {
    /* Several sums, because additions wait for those before them. */
    f32x8 even[RGB] = {all8(0.0f), all8(0.0f), all8(0.0f)};
    f32x8 odd[RGB] = {all8(0.0f), all8(0.0f), all8(0.0f)};
    int row = 0;
    for (; row + 2 <= rows; row += 2) {
        for (int v = 0; v < vectors; ++v)
            even[v % RGB] += weight_of(words + 8 * v, factors) * load8(weighted + 8 * v);
        words += stride;
        weighted += ROW_FLOATS;
        for (int v = 0; v < vectors; ++v)
            odd[v % RGB] += weight_of(words + 8 * v, factors) * load8(weighted + 8 * v);
        words += stride;
        weighted += ROW_FLOATS;
    }
    if (row < rows)
        for (int v = 0; v < vectors; ++v)
            even[v % RGB] += weight_of(words + 8 * v, factors) * load8(weighted + 8 * v);
    for (int c = 0; c < RGB; ++c) sums[c] = even[c] + odd[c];
}

/* Sums of each color of three vectors, the first of which starts with red. */
INLINE f32x4 color_sums(f32x8 a, f32x8 b, f32x8 c) {
    f32x4 first = {a[0], a[1], a[2], 0.0f}, second = {a[3], a[4], a[5], 0.0f};
    first += (f32x4){a[6], a[7], b[0], 0.0f};
    second += (f32x4){b[1], b[2], b[3], 0.0f};
    first += (f32x4){b[4], b[5], b[6], 0.0f};
    second += (f32x4){b[7], c[0], c[1], 0.0f};
    first += (f32x4){c[2], c[3], c[4], 0.0f};
    second += (f32x4){c[5], c[6], c[7], 0.0f};
    return first + second;
}

/* Returns the light of a part that a member receives, of each color. */
INLINE f32x4 gather_member(const member *one, const uint32_t *words, const level_image *image,
                           const bin_part *part, const float *weighted) {
    int row = larger_int(one->top, part->top);
    int rows = smaller_int(one->top + image->height, part->bottom) - row;
    int first = RGB * larger_int(one->left, 0) / 8;
    int last = (RGB * smaller_int(one->left + image->width, BIN_WIDTH) + 7) / 8;
    if (rows <= 0 || first >= last) return all4(0.0f);
    ptrdiff_t stride = packed_row(image);
    words += (row - one->top) * stride + 8 * first - RGB * one->left;
    weighted += (row - part->top) * ROW_FLOATS + 8 * first;
    i32x8 factors = all_ints8(one->factors);
    f32x8 sums[RGB];
#define CASE(n) \
    case n: gather_vectors(words, stride, weighted, rows, factors, n, sums); break;
    switch (last - first) {
        CASE(1) CASE(2) CASE(3) CASE(4) CASE(5) CASE(6) CASE(7) CASE(8) CASE(9) CASE(10)
        CASE(11) CASE(12)
        default: return all4(0.0f);
    }
#undef CASE
    int start = 8 * first % RGB;      /* color of the first float */
    f32x4 found = start == 0   ? color_sums(sums[0], sums[1], sums[2])
                  : start == 1 ? color_sums(sums[1], sums[2], sums[0])
                               : color_sums(sums[2], sums[0], sums[1]);
    return found * one->color;
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
        const uint32_t *words = plan->words + plan->first_word[own->state & KERNEL_MASK];
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
                f32x4 sum = gather_member(one, words, image, part,
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
        int from = y * ROW_FLOATS + RGB * inside.left;
        for (int i = 0; i < RGB * (inside.right - inside.left); ++i) {
            size_t at = first + (size_t)i;
            job->to[at] += own[from + i] * finite_or_0(job->image[at]);
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

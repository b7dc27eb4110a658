/* A kernel at one layer: recipes of up to three field nodes, each as stored or mapped to the
 * cell's pixels; and its sums over merged squares.  Twins: blend_cells and merge_psfs of
 * shaders/passes. */

#include <math.h>

#include "cell_maps.h"
#include "frame.h"
#include "vectors.h"

/* A kernel at one layer: floats in fours, and its sums over squares as needed. */
typedef struct {
    int recipes[FIELD_CORNERS];    /* its parts; -1: none */
    double maps[FIELD_CORNERS][4];
    int64_t cell;
    reach box;
    int level_count;               /* computed so far */
    float *texels[MAX_LEVEL + 1];
    float largest[MAX_LEVEL + 1];
} kernel_end;

INLINE int level_extent(int level) { return (1 << level) - 1; }
INLINE int level_width(const kernel_end *end, int level) {
    return reach_width(end->box) + level_extent(level);
}
INLINE int level_height(const kernel_end *end, int level) {
    return reach_height(end->box) + level_extent(level);
}

/* Texels from row to row of a level: an even number.  Those beyond its width are zeros, which
 * the sums of the next level read. */
INLINE int level_stride(const kernel_end *end, int level) {
    int zeros = level < MAX_LEVEL ? 1 << level : 0;
    return (level_width(end, level) + zeros + 1) & ~1;
}

/* Texels before a level, of which the zeros of its row 0 are part. */
#define LEVEL_LEAD 8
#define LEVEL_PAD 6                /* the most that a stride exceeds the width by */

/* Reach in image pixels of a kernel stored in other pixels; twin: cell_maps.mapped_reach. */
static reach mapped_reach(const double *map, reach stored) {
    double area = map[0] * map[3] - map[1] * map[2];
    double inverse[2][2] = {{map[3] / area, -map[1] / area}, {-map[2] / area, map[0] / area}};
    double ends[4];
    for (int axis = 0; axis < 2; ++axis) {
        double a = inverse[axis][0];
        double b = inverse[axis][1];
        double left = -a * (stored.left + 1.0), right = a * (stored.right + 1.0);
        double up = -b * (stored.up + 1.0), down = b * (stored.down + 1.0);
        ends[2 * axis] = -(fmin(left, right) + fmin(up, down));
        ends[2 * axis + 1] = fmax(left, right) + fmax(up, down);
    }
    int sides[4];
    for (int side = 0; side < 4; ++side) {
        int whole = (int)ceil(ends[side] - 1e-9) - 1;
        sides[side] = whole < 0 ? 0 : smaller_int(whole, LONGEST_REACH_PX);
    }
    return (reach){sides[0], sides[1], sides[2], sides[3]};
}

/* Texels that the pixels of a row read along one axis: the first one, and their shares. */
#define MOST_TAPS PAD_TEXELS
#define LONGEST_ROW (2 * LONGEST_REACH_PX + 1)

typedef struct {
    int32_t first[LONGEST_ROW];
    float shares[MOST_TAPS][LONGEST_ROW];
} row_reads;

/* Shares of stored texels that pixels cover, with centers `start + step * n` and a side of
 * 2 * half. */
INLINE void find_covered(float start, float step, float half, int count, int n_taps,
                         int lowest, int highest, row_reads *reads) {
    for (int n = 0; n < count; ++n) {
        float middle = start + step * (float)n;
        float low = middle - half;
        float high = middle + half;
        float first = __builtin_floorf(low + 0.5f);
        first = first < (float)lowest ? (float)lowest : first;
        first = first > (float)highest ? (float)highest : first;
        reads->first[n] = (int32_t)first;
        for (int tap = 0; tap < n_taps; ++tap) {
            float from = first + ((float)tap - 0.5f);
            float to = from + 1.0f;
            from = low > from ? low : from;
            to = high < to ? high : to;
            reads->shares[tap][n] = to > from ? to - from : 0.0f;
        }
    }
}

/* Adds a mapped part: each pixel takes the light of the stored ones that it covers.  n_taps
 * is 2 or 3; the compiler generates a loop for each. */
INLINE void add_mapped_taps(const float *texels, int stride, reach stored, const float *map,
                            float weight, reach box, int n_taps, float *to,
                            int to_stride) {
    float half_x = 0.5f * fabsf(map[0]);
    float half_y = 0.5f * fabsf(map[3]);
    int width = reach_width(box);
    row_reads across, along;
    for (int y = -box.up; y <= box.down; ++y, to += 4 * to_stride) {
        float x = (float)-box.left;
        find_covered(map[0] * x + map[1] * (float)y, map[0], half_x, width, n_taps,
                     -stored.left - n_taps, stored.right + 1, &across);
        find_covered(map[2] * x + map[3] * (float)y, map[2], half_y, width, n_taps,
                     -stored.up - n_taps, stored.down + 1, &along);
        for (int n = 0; n < width; ++n) {
            const float *from = texels + 4 * ((ptrdiff_t)(along.first[n] + stored.up) * stride
                                              + across.first[n] + stored.left);
            f32x4 sum = all4(0.0f);
            for (int j = 0; j < n_taps; ++j, from += 4 * stride) {
                f32x4 line = load4(from) * all4(across.shares[0][n]);
                for (int i = 1; i < n_taps; ++i)
                    line += load4(from + 4 * i) * all4(across.shares[i][n]);
                sum += line * all4(along.shares[j][n]);
            }
            store4(to + 4 * n, load4(to + 4 * n) + sum * all4(weight));
        }
    }
}

/* Texels between `lowest` and `highest` that overlap the range from low to high. */
INLINE void covered(float low, float high, int lowest, int highest, int *first, int *last) {
    float from = __builtin_floorf(low + 0.5f);
    float to = __builtin_ceilf(high - 0.5f);
    *first = from > (float)lowest ? from < (float)(highest + 1) ? (int)from : highest + 1 : lowest;
    *last = to < (float)highest ? to > (float)(lowest - 1) ? (int)to : lowest - 1 : highest;
}

INLINE float share_of(float low, float high, int texel) {
    float from = larger_float(low, (float)texel - 0.5f);
    float to = high < (float)texel + 0.5f ? high : (float)texel + 0.5f;
    return to > from ? to - from : 0.0f;
}

/* The same for pixels that cover more texels than there are zeros between rows, as the
 * pixels of a cell and a node differ that much in fields of 90 degrees.  Reads only within
 * the kernel. */
static void add_mapped_wide(const float *texels, int stride, reach stored, const float *map,
                            float weight, reach box, float *to, int to_stride) {
    float half_x = 0.5f * fabsf(map[0]);
    float half_y = 0.5f * fabsf(map[3]);
    for (int y = -box.up; y <= box.down; ++y, to += 4 * (to_stride - reach_width(box)))
        for (int x = -box.left; x <= box.right; ++x, to += 4) {
            float middle_x = map[0] * (float)x + map[1] * (float)y;
            float middle_y = map[2] * (float)x + map[3] * (float)y;
            float left = middle_x - half_x, right = middle_x + half_x;
            float up = middle_y - half_y, down = middle_y + half_y;
            int column, last_column, row, last_row;
            covered(left, right, -stored.left, stored.right, &column, &last_column);
            covered(up, down, -stored.up, stored.down, &row, &last_row);
            f32x4 sum = all4(0.0f);
            for (; row <= last_row; ++row) {
                const float *from = texels + 4 * ((ptrdiff_t)(row + stored.up) * stride
                                                  + stored.left);
                f32x4 line = all4(0.0f);
                for (int i = column; i <= last_column; ++i)
                    line += load4(from + 4 * i) * all4(share_of(left, right, i));
                sum += line * all4(share_of(up, down, row));
            }
            store4(to, load4(to) + sum * all4(weight));
        }
}

static void add_mapped(const frame *f, const recipe_image *image, const double *map,
                       float weight, reach box, float *to, int to_stride) {
    const float *texels = f->recipe_texels + 4 * image->first_texel;
    reach stored = read_reach(image->reach_px);
    float own[4] = {(float)map[0], (float)map[1], (float)map[2], (float)map[3]};
    float side = larger_float(fabsf(own[0]), fabsf(own[3]));
    int stride = image->stride;
    if (side <= 1.0f)
        add_mapped_taps(texels, stride, stored, own, weight, box, 2, to, to_stride);
    else if (side < 2.0f)
        add_mapped_taps(texels, stride, stored, own, weight, box, 3, to, to_stride);
    else
        add_mapped_wide(texels, stride, stored, own, weight, box, to, to_stride);
}

/* Adds a part to rows of an even number of texels.  The texel beyond an odd width is zero. */
static void add_unmoved(const frame *f, const recipe_image *image, float weight, reach box,
                        float *to, int to_stride) {
    reach stored = read_reach(image->reach_px);
    const float *from = f->recipe_texels + 4 * image->first_texel;
    int count = 4 * reach_width(stored);
    to += 4 * ((box.up - stored.up) * to_stride + box.left - stored.left);
    for (int y = 0; y < reach_height(stored); ++y, to += 4 * to_stride, from += 4 * image->stride)
        for (int x = 0; x < count; x += 8)
            store8(to + x, load8(to + x) + load8(from + x) * all8(weight));
}

/* Largest of red, green and blue of two texels. */
INLINE float largest_color(f32x8 two) {
    float even = larger_float(two[0], larger_float(two[1], two[2]));
    return larger_float(even, larger_float(two[4], larger_float(two[5], two[6])));
}

/* Texels of a part in rows and columns of a kernel's box; columns are floats. */
typedef struct {
    const float *texels;           /* of column 0 in the current row */
    int stride, first, end, top, bottom;
    float weight;
} part_area;

/* Sums n parts between two floats that all of them have; returns the largest sums.  The
 * compiler generates a loop for each n. */
INLINE f32x8 sum_parts(const part_area *parts, int n, ptrdiff_t x, ptrdiff_t end, float *to,
                       f32x8 most) {
    for (; x + 8 <= end; x += 8) {
        f32x8 sum = all8(0.0f);
        for (int j = 0; j < n; ++j) sum += load8(parts[j].texels + x) * all8(parts[j].weight);
        most = larger8(sum, most);
        store8(to + x, sum);
    }
    if (x == end) return most;
    f32x4 sum = all4(0.0f);
    for (int j = 0; j < n; ++j) sum += load4(parts[j].texels + x) * all4(parts[j].weight);
    store4(to + x, sum);
    return larger8(twice4(sum), most);
}

/* Adds a part where not all parts have texels. */
INLINE f32x8 add_part(const part_area *part, int x, int end, float *to, f32x8 most) {
    for (; x < end; x += 4) {
        f32x4 sum = load4(to + x) + load4(part->texels + x) * all4(part->weight);
        store4(to + x, sum);
        most = larger8(twice4(sum), most);
    }
    return most;
}

INLINE void clear_texels(float *to, int x, int end) {
    for (; x < end; x += 4) store4(to + x, all4(0.0f));
}

/* Areas (n,) of a kernel's parts in its box. */
INLINE int part_areas(const frame *f, const int *recipes, const double *weights, int r,
                      reach box, part_area *areas) {
    int n = 0;
    for (int j = 0; j < FIELD_CORNERS; ++j) {
        if (recipes[j] < 0) continue;
        const recipe_image *image = f->recipe_images + RESOLUTIONS * recipes[j] + r;
        reach stored = read_reach(image->reach_px);
        int first = 4 * (box.left - stored.left), top = box.up - stored.up;
        areas[n++] = (part_area){f->recipe_texels + 4 * image->first_texel - first,
                                 4 * image->stride, first, first + 4 * reach_width(stored),
                                 top, top + reach_height(stored), (float)weights[j]};
    }
    return n;
}

/* Sums parts that are not mapped; returns the largest weight. */
static float sum_unmoved(const frame *f, const int *recipes, const double *weights, int r,
                         reach box, float *to, int stride) {
    part_area areas[FIELD_CORNERS], parts[FIELD_CORNERS];
    int count = part_areas(f, recipes, weights, r, box, areas);
    f32x8 most = all8(0.0f);
    for (int y = 0, next; y < reach_height(box); y = next) {
        /* rows up to `next` have the same parts */
        int n = 0, first = 0, end = 4 * reach_width(box);
        next = reach_height(box);
        for (part_area *area = areas; area < areas + count; ++area) {
            if (y < area->top) next = smaller_int(next, area->top);
            if (y < area->top || y >= area->bottom) continue;
            next = smaller_int(next, area->bottom);
            first = larger_int(first, area->first);
            end = smaller_int(end, area->end);
            parts[n] = *area;
            parts[n++].texels += (ptrdiff_t)(y - area->top) * area->stride;
        }
        if (n == 0) end = 0;
        for (int rows = next - y; rows-- > 0; to += 4 * stride) {
            clear_texels(to, 0, first);
            clear_texels(to, end, 4 * stride);
            if (n == 3) most = sum_parts(parts, 3, first, end, to, most);
            else if (n == 2) most = sum_parts(parts, 2, first, end, to, most);
            else if (n == 1) most = sum_parts(parts, 1, first, end, to, most);
            for (int j = 0; j < n; ++j) {
                most = add_part(parts + j, parts[j].first, first, to, most);
                most = add_part(parts + j, end, parts[j].end, to, most);
                parts[j].texels += parts[j].stride;
            }
        }
    }
    return largest_color(most);
}

/* Box of a kernel's end: the union of the boxes of its mapped parts. */
static reach end_box(const frame *f, int kernel, int is_far, const int *recipes, int r) {
    const double *maps = f->part_maps + 4 * first_part(kernel, is_far);
    reach box = {0, 0, 0, 0};
    for (int j = 0; j < FIELD_CORNERS; ++j) {
        if (recipes[j] < 0) continue;
        reach own = read_reach(f->recipe_images[RESOLUTIONS * recipes[j] + r].reach_px);
        box = wider(box, is_unmoved(maps + 4 * j) ? own : mapped_reach(maps + 4 * j, own));
    }
    return box;
}

INLINE int has_mapped(const int *recipes, const double *maps) {
    for (int j = 0; j < FIELD_CORNERS; ++j)
        if (recipes[j] >= 0 && !is_unmoved(maps + 4 * j)) return 1;
    return 0;
}

/* Computes the kernel of a cell at one layer, unless `end` already holds it. */
static void make_end(const frame *f, int kernel, int is_far, int r, kernel_end *end) {
    const double *weights = f->part_weights + first_part(kernel, is_far);
    const double *maps = f->part_maps + 4 * first_part(kernel, is_far);
    int recipes[FIELD_CORNERS];
    kernel_recipes(f, kernel, is_far, recipes);
    if (end->cell == f->kernel_cells[kernel]
        && memcmp(recipes, end->recipes, sizeof recipes) == 0
        && memcmp(maps, end->maps, sizeof end->maps) == 0)
        return;
    end->cell = f->kernel_cells[kernel];
    memcpy(end->recipes, recipes, sizeof recipes);
    memcpy(end->maps, maps, sizeof end->maps);
    reach box = end->box = end_box(f, kernel, is_far, recipes, r);
    int stride = level_stride(end, 0);
    size_t count = 4 * (size_t)stride * (size_t)reach_height(box);
    float *to = end->texels[0];
    end->level_count = 1;
    memset(to - 4 * LEVEL_LEAD, 0, sizeof(float) * 4 * LEVEL_LEAD);
    if (!has_mapped(recipes, maps)) {
        end->largest[0] = sum_unmoved(f, recipes, weights, r, box, to, stride);
        return;
    }
    memset(to, 0, sizeof(float) * count);
    for (int j = 0; j < FIELD_CORNERS; ++j) {
        if (recipes[j] < 0) continue;
        const recipe_image *image = f->recipe_images + RESOLUTIONS * recipes[j] + r;
        float weight = (float)weights[j];
        if (is_unmoved(maps + 4 * j)) add_unmoved(f, image, weight, box, to, stride);
        else add_mapped(f, image, maps + 4 * j, weight, box, to, stride);
    }
    f32x8 most = all8(0.0f);
    for (size_t i = 0; i < count; i += 8) most = larger8(load8(to + i), most);
    end->largest[0] = largest_color(most);
}

/* A row outside a level. */
static const float no_texels[4 * (LEVEL_LEAD + LONGEST_ROW + 2 * LEVEL_LEAD)];

/* Computes sums of the level below over 2 x 2 squares, up to a level. */
static void make_levels(kernel_end *end, int level) {
    for (; end->level_count <= level; ++end->level_count) {
        int own = end->level_count;
        int step = 1 << (own - 1);
        int width = level_width(end, own), height = level_height(end, own);
        int stride = level_stride(end, own), from_stride = level_stride(end, own - 1);
        const float *from = end->texels[own - 1], *outside = no_texels + 4 * LEVEL_LEAD;
        float *to = end->texels[own];
        memset(to - 4 * LEVEL_LEAD, 0, sizeof(float) * 4 * LEVEL_LEAD);
        f32x8 most = all8(0.0f);
        for (int y = 0; y < height; ++y, to += 4 * stride) {
            const float *above = y < step ? outside : from + 4 * (y - step) * from_stride;
            const float *here = y < height - step ? from + 4 * y * from_stride : outside;
            ptrdiff_t x = 0;
            for (; x < 4 * width; x += 8) {
                f32x8 sum = load8(above + x) + load8(above + x - 4 * step)
                            + load8(here + x) + load8(here + x - 4 * step);
                most = larger8(sum, most);
                store8(to + x, sum);
            }
            for (; x < 4 * stride; x += 8) store8(to + x, all8(0.0f));
        }
        end->largest[own] = largest_color(most);
    }
}

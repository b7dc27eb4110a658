/* Light of a window: depth by depth where surfaces meet, otherwise all at once. */

#include "frame.h"
#include "vectors.h"

/* Sums of a row of coarse pixels, not in pairs. */
typedef struct {
    float light[4 * (PAIRS_ACROSS + 2)], coverage[4 * (PAIRS_ACROSS + 2)];
} coarse_row;

/* Interpolates a row of coarse pixels, `share` of the way from one row to the next. */
INLINE void row_between(const raster *coarse, const pixel_pair *above, float share,
                        coarse_row *row) {
    const pixel_pair *below = above + coarse->stride;
    f32x8 part = all8(share);
    for (int x = 0; x < coarse->width / 2; ++x) {
        store8(row->light + 8 * x, above[x].light + part * (below[x].light - above[x].light));
        store8(row->coverage + 8 * x,
               above[x].coverage + part * (below[x].coverage - above[x].coverage));
    }
}

INLINE f32x8 between(const float *left, const float *right, f32x8 part) {
    f32x8 first = load8(left);
    return first + part * (load8(right) - first);
}

/* The same for two pixels that lie between the same coarse pixels. */
INLINE f32x8 between_twice(const float *left, const float *right, f32x8 part) {
    f32x4 a = load4(left), b = load4(right);
    f32x8 first = {a[0], a[1], a[2], a[3], a[0], a[1], a[2], a[3]};
    f32x8 last = {b[0], b[1], b[2], b[3], b[0], b[1], b[2], b[3]};
    return first + part * (last - first);
}

/* Adds a row of pixels of 2 px to one of pixels of 1 px: each pair lies between three
 * coarse pixels. */
INLINE void add_halves(const coarse_row *row, pixel_pair *to, int pairs) {
    f32x8 part = {0.75f, 0.75f, 0.75f, 0.75f, 0.25f, 0.25f, 0.25f, 0.25f};
    for (int pair = 0; pair < pairs; ++pair) {
        int at = 4 * pair;
        to[pair].light += between(row->light + at, row->light + at + 4, part);
        to[pair].coverage += between(row->coverage + at, row->coverage + at + 4, part);
    }
}

/* Adds a row of pixels of 4 px: two pairs per coarse pixel, left and right of its center. */
INLINE void add_quarters(const coarse_row *row, pixel_pair *to, int pairs) {
    f32x8 before = {0.625f, 0.625f, 0.625f, 0.625f, 0.875f, 0.875f, 0.875f, 0.875f};
    f32x8 behind = {0.125f, 0.125f, 0.125f, 0.125f, 0.375f, 0.375f, 0.375f, 0.375f};
    for (int pair = 0; pair < pairs; ++pair) {
        int at = 4 * ((pair + 1) / 2);
        f32x8 part = pair & 1 ? behind : before;
        to[pair].light += between_twice(row->light + at, row->light + at + 4, part);
        to[pair].coverage += between_twice(row->coverage + at, row->coverage + at + 4, part);
    }
}

/* Adds the light of pixels of 2^r px to those of 1 px, interpolated between the centers of
 * four. */
INLINE void add_coarse(depth_group *group, int r) {
    raster *coarse = group->sizes + r;
    raster *fine = group->sizes;
    coarse_row row;
    /* Pixel y lies between the coarse rows (y + 0.5) / 2^r + 0.5, rounded down, and the next. */
    int top = larger_int((coarse->top - 2) * (1 << r), 0);
    int bottom = smaller_int((coarse->bottom + 1) << r, fine->height);
    light_rows(fine, top, bottom);
    for (int y = top; y < bottom; ++y) {
        float down = ((float)y + 0.5f) / (float)(1 << r) + 0.5f;
        row_between(coarse, coarse->pairs + (int)down * coarse->stride, down - (float)(int)down,
                    &row);
        if (r == 1) add_halves(&row, fine->pairs + y * fine->stride, fine->width / 2);
        else add_quarters(&row, fine->pairs + y * fine->stride, fine->width / 2);
    }
    darken_raster(coarse);
}

/* Converts all light of a group to pixels of 1 px; false if it has none. */
static int gather_sizes(depth_group *group) {
    for (int r = 1; r < RESOLUTIONS; ++r)
        if (group->sizes[r].top < group->sizes[r].bottom) add_coarse(group, r);
    return group->sizes[0].top < group->sizes[0].bottom;
}

INLINE float least_color(f32x8 lanes) {
    float least = lanes[0];
    for (int i = 1; i < 8; ++i)
        if (i % 4 != 3) least = smaller_float(lanes[i], least);
    return least;
}

/* Whether groups behind the closed ones matter: for the light by depths and the total, only
 * for the total, or not at all. */
enum { SEEN, COVERED, UNSEEN };

/* Composites two pixels of a group with light in excess.  What lies behind nearer depths has
 * the free coverage as its share of this light, as if the group's coverage were complete:
 * what it lacks is not as bright. */
INLINE void close_excess(const pixel_pair *open, pixel_pair *near, f32x8 room, f32x8 share) {
    f32x8 whole = smaller8(room / larger8(open->coverage, all8(1.0f)), share);
    near->light += (share + excess_shares(open) * (whole - share)) * open->light;
    i32x8 is_excess = {0, 0, 0, -1, 0, 0, 0, -1};
    f32x8 green = second_as_fourth8(whole);
    share = (f32x8)(((i32x8)share & ~is_excess) | ((i32x8)green & is_excess));
    near->coverage += share * open->coverage;
}

/* Whether groups behind the closed ones matter, by the rows of a window. */
INLINE int state_of(const window *w) {
    float least = 1.0f, strength = EDGE_MIX_COVERAGE;
    for (int y = 0; y < w->height; ++y) {
        least = smaller_float(w->least[y], least);
        strength = smaller_float(w->least_strength[y], strength);
    }
    if (least < 1.0f) return SEEN;
    return strength < EDGE_MIX_COVERAGE ? COVERED : UNSEEN;
}

/* Composites a group; its fragments share the coverage that nearer ones leave. */
static int close_group(window *w, depth_group *group) {
    if (!gather_sizes(group)) return SEEN;
    raster *own = group->sizes;
    for (int y = own->top; y < own->bottom; ++y) {
        const pixel_pair *open = own->pairs + y * PAIRS_ACROSS;
        pixel_pair *near = w->near + y * PAIRS_ACROSS;
        pixel_pair *total = w->total + y * PAIRS_ACROSS;
        f32x8 least = all8(1.0f), least_total = all8(1.0f);
        for (int x = 0; x < w->width / 2; ++x) {
            f32x8 light = open[x].light, coverage = open[x].coverage;
            f32x8 most = larger8(coverage, all8(MIN_COVERAGE));
            f32x8 room = all8(1.0f) - near[x].coverage;
            f32x8 share = smaller8(room / most, all8(1.0f));
            if (has_excess(open + x)) {
                close_excess(open + x, near + x, room, share);
            } else {
                near[x].light += share * light;
                near[x].coverage += share * coverage;
            }
            total[x].light += light;
            total[x].coverage += coverage;
            least = smaller8(near[x].coverage, least);
            least_total = smaller8(total[x].light, least_total);
        }
        w->least[y] = least_color(least);
        w->least_strength[y] = smaller_float(least_total[3], least_total[7]);
    }
    darken_raster(own);
    return state_of(w);
}

/* Adds a group to the total alone. */
static void add_total(window *w, depth_group *group) {
    if (!gather_sizes(group)) return;
    for (int y = group->sizes[0].top; y < group->sizes[0].bottom; ++y) {
        const pixel_pair *open = group->sizes[0].pairs + y * PAIRS_ACROSS;
        pixel_pair *total = w->total + y * PAIRS_ACROSS;
        for (int x = 0; x < w->width / 2; ++x) {
            total[x].light += open[x].light;
            total[x].coverage += open[x].coverage;
        }
    }
    darken_raster(group->sizes);
}

/* Light of a bin in which order matters: group of depths by group, nearest first.  Once nearer
 * groups cover everything, all others count alike. */
static void splat_ordered(const frame *f, const bin_list *list, window *w) {
    int state = SEEN;
    for (int i = 0; i < list->count && state != UNSEEN;) {
        uint32_t key = list->keys[i];
        for (; i < list->count && (state != SEEN || list->keys[i] == key); ++i)
            add_cluster(f, list->entries[i], list->first_group + (int32_t)list->keys[i], &w->open);
        if (state == SEEN) {
            state = close_group(w, &w->open);
        } else {
            add_total(w, &w->open);
            break;
        }
    }
}

/* The paper's rule: fragment by fragment. */
static void splat_in_order(const frame *f, const bin_list *list, window *w) {
    for (int i = 0; i < list->count; ++i) cover_with_fragment(f, list->entries[i], w);
}

/* Light of all clusters, or of the visible surface alone, regardless of order. */
static void splat_unordered(const frame *f, const bin_list *list, int with_hidden, window *w) {
    for (int r = 0; r < RESOLUTIONS; ++r) darken_raster(w->open.sizes + r);
    for (int i = 0; i < list->cluster_count; ++i)
        if (with_hidden || !is_hidden(f, list->clusters[i]))
            add_cluster(f, list->clusters[i], ALL_GROUPS, &w->open);
    light_rows(w->open.sizes, 0, 0);
    gather_sizes(&w->open);
}

/* Lists of the clusters of fragments whose light reaches a bin: in scan order or, where two
 * surfaces meet, group of depths by group, nearest first.  Twins: count_bins,
 * scatter_fragments and sort_bins. */

#include <stdlib.h>

#include "frame.h"
#include "vectors.h"

#define BIN_WIDTH 32
#define BIN_HEIGHT 32

/* List of a bin, with the scratch memory of one thread; grows on demand. */
typedef struct {
    uint32_t *clusters;
    uint32_t *entries, *spare;   /* clusters in order; under the paper's rule, fragments */
    uint32_t *keys, *spare_keys; /* of the order of entries: smaller is nearer */
    int capacity;
    int cluster_count, count;
    int x0, y0;                  /* first pixel of the bin */
    int any_edge, any_hidden;
    int32_t first_group;         /* whose key is 0 */
} bin_list;

/* Makes room for entries; false if memory ran out. */
static int reserve(bin_list *list, int count) {
    int capacity = list->capacity ? list->capacity : 1024;
    while (capacity < count) capacity *= 2;
    if (capacity == list->capacity) return 1;
    uint32_t **arrays[] = {&list->clusters, &list->entries, &list->spare, &list->keys,
                           &list->spare_keys};
    for (int i = 0; i < 5; ++i) {
        uint32_t *grown = realloc(*arrays[i], sizeof *grown * (size_t)capacity);
        if (grown == NULL) return 0;
        *arrays[i] = grown;
    }
    list->capacity = capacity;
    return 1;
}

static void free_list(bin_list *list) {
    free(list->clusters);
    free(list->entries);
    free(list->spare);
    free(list->keys);
    free(list->spare_keys);
}

INLINE int gap_between(int first_a, int last_a, int first_b, int last_b) {
    int gap = larger_int(first_b - last_a, first_a - last_b);
    return gap > 0 ? gap : 0;
}

/* Returns whether discs about pixels left..right, top..bottom overlap the bin. */
INLINE int discs_meet(const bin_list *list, int left, int right, int top, int bottom,
                      int radius) {
    int gap_x = gap_between(left, right, list->x0, list->x0 + BIN_WIDTH - 1);
    int gap_y = gap_between(top, bottom, list->y0, list->y0 + BIN_HEIGHT - 1);
    /* gaps are integers: (r + 0.5)^2 = r^2 + r + 0.25 */
    return gap_x * gap_x + gap_y * gap_y <= radius * radius + radius;
}

INLINE int fragment_meets(const frame *f, const bin_list *list, const cluster *own,
                          uint32_t at) {
    const fragment *one = f->fragments + at;
    int extent = (1 << (one->state >> LEVEL_SHIFT & 3)) - 1;
    return discs_meet(list, one->x, one->x + extent, one->y, one->y + extent, own->radius_px);
}

INLINE i16x16 load_sides(const int16_t *from) {
    i16x16 value;
    memcpy(&value, from, sizeof value);
    return value;
}

/* Bit mask of the clusters, out of sixteen, whose boxes overlap the bin. */
INLINE uint32_t boxes_meet(const frame *f, uint32_t first, const bin_list *list) {
    i16x16 beside = (load_sides(f->boxes[BOX_LEFT] + first) >= all16(list->x0 + BIN_WIDTH))
                    | (load_sides(f->boxes[BOX_RIGHT] + first) < all16(list->x0))
                    | (load_sides(f->boxes[BOX_TOP] + first) >= all16(list->y0 + BIN_HEIGHT))
                    | (load_sides(f->boxes[BOX_BOTTOM] + first) < all16(list->y0));
    return bits_of_lanes(~beside);
}

/* Returns whether a fragment next to an edge lights the bin. */
INLINE int edge_meets(const frame *f, const bin_list *list, const cluster *own) {
    for (uint32_t at = own->first; at < own->first + own->count; ++at)
        if (f->fragments[at].state & EDGE_BIT && fragment_meets(f, list, own, at)) return 1;
    return 0;
}

/* Lists those of consecutive clusters that reach the bin; the list has room for all.  Returns
 * the number of their fragments. */
INLINE int64_t list_some(const frame *f, bin_list *list, uint32_t first, uint32_t end) {
    int64_t fragments = 0;
    for (; first < end; first += 16) {
        uint32_t met = boxes_meet(f, first, list);
        if (end - first < 16) met &= (1u << (end - first)) - 1u;
        for (; met; met &= met - 1) {
            uint32_t at = first + (uint32_t)__builtin_ctz(met);
            const cluster *own = f->clusters + at;
            if (!discs_meet(list, own->left, own->right, own->top, own->bottom, own->radius_px))
                continue;
            list->clusters[list->cluster_count++] = at;
            fragments += own->count;
            if (own->state & EDGE_BIT && !list->any_edge)
                list->any_edge = edge_meets(f, list, own);
        }
    }
    return fragments;
}

/* Lists the clusters that reach the bin; returns the number of their fragments, or -1 if memory
 * ran out. */
static int64_t list_clusters(const frame *f, bin_list *list) {
    list->cluster_count = list->any_edge = 0;
    int64_t fragments = 0;
    int search = f->farthest_px;
    int left = larger_int(list->x0 - search, 0) / TILE_SIZE_PX;
    int top = larger_int(list->y0 - search, 0) / TILE_SIZE_PX;
    int right = (list->x0 + BIN_WIDTH - 1 + search) / TILE_SIZE_PX;
    int bottom = (list->y0 + BIN_HEIGHT - 1 + search) / TILE_SIZE_PX;
    right = smaller_int(right, f->block_columns - 1);
    bottom = smaller_int(bottom, f->block_rows - 1);
    for (int surface = 0; surface < f->surface_count; ++surface) {
        int seen = list->cluster_count;
        for (int row = top; row <= bottom; ++row) {
            const block_info *blocks =
                f->blocks + (surface * f->block_rows + row) * f->block_columns;
            uint32_t first = blocks[left].first_cluster, end = blocks[right].end_cluster;
            if (!reserve(list, list->cluster_count + (int)(end - first))) return -1;
            fragments += list_some(f, list, first, end);
        }
        list->any_hidden = surface > 0 && list->cluster_count > seen;
    }
    return fragments;
}

/* Maps a float to bits with the same order. */
INLINE uint32_t ordered_bits(float value) {
    uint32_t bits = bits_of(value);
    return bits & 0x80000000u ? ~bits : bits | 0x80000000u;
}

/* Lists the fragments of the clusters that reach the bin; false if memory ran out. */
static int list_fragments(const frame *f, bin_list *list, int64_t fragments) {
    if (!reserve(list, (int)fragments)) return 0;
    int count = 0;
    for (int i = 0; i < list->cluster_count; ++i) {
        const cluster *own = f->clusters + list->clusters[i];
        for (uint32_t at = own->first; at < own->first + own->count; ++at) {
            if (!fragment_meets(f, list, own, at)) continue;
            list->entries[count] = at;
            list->keys[count++] = ordered_bits(f->lights[at].depth);
        }
    }
    list->count = count;
    return 1;
}

/* Group of a depth, with the fraction within it. */
INLINE float group_place(const frame *f, float depth) {
    return depth * f->blur_px_per_dpt * (1.0f / DISCONTINUITY_PX);
}

INLINE int32_t group_of(float place) { return (int32_t)__builtin_floorf(place); }

/* Share of a fragment that belongs to the group behind its own, so that no depth is special. */
INLINE float share_behind(float place) {
    float within = place - __builtin_floorf(place);
    return larger_float((within - (1.0f - GROUP_BLEND_RATIO)) * (1.0f / GROUP_BLEND_RATIO), 0.0f);
}

/* Lists each cluster once for each of its groups of depths; false if memory ran out. */
static int list_groups(const frame *f, bin_list *list) {
    int count = 0;
    float nearest = INFINITY;
    for (int i = 0; i < list->cluster_count; ++i)
        nearest = smaller_float(f->clusters[list->clusters[i]].nearest, nearest);
    list->first_group = group_of(group_place(f, nearest));
    for (int i = 0; i < list->cluster_count; ++i) {
        uint32_t at = list->clusters[i];
        float farthest = group_place(f, f->clusters[at].farthest);
        int32_t group = group_of(group_place(f, f->clusters[at].nearest));
        int32_t last = group_of(farthest) + (share_behind(farthest) > 0.0f);
        if (!reserve(list, count + (int)(last - group) + 1)) return 0;
        for (; group <= last; ++group) {
            list->entries[count] = at;
            list->keys[count++] = (uint32_t)(group - list->first_group);
        }
    }
    list->count = count;
    return 1;
}

/* Sorts by keys; entries with equal keys keep their order. */
static void sort_list(bin_list *list) {
    if (list->count <= 48) {
        for (int i = 1; i < list->count; ++i) {
            uint32_t key = list->keys[i];
            uint32_t own = list->entries[i];
            int at = i;
            for (; at > 0 && list->keys[at - 1] > key; --at) {
                list->keys[at] = list->keys[at - 1];
                list->entries[at] = list->entries[at - 1];
            }
            list->keys[at] = key;
            list->entries[at] = own;
        }
        return;
    }
    for (int shift = 0; shift < 32; shift += 8) {
        uint32_t starts[257] = {0};
        for (int i = 0; i < list->count; ++i) ++starts[(list->keys[i] >> shift & 255) + 1];
        if (starts[(list->keys[0] >> shift & 255) + 1] == (uint32_t)list->count) continue;
        for (int digit = 0; digit < 256; ++digit) starts[digit + 1] += starts[digit];
        for (int i = 0; i < list->count; ++i) {
            uint32_t at = starts[list->keys[i] >> shift & 255]++;
            list->spare_keys[at] = list->keys[i];
            list->spare[at] = list->entries[i];
        }
        uint32_t *keys = list->keys;
        list->keys = list->spare_keys;
        list->spare_keys = keys;
        uint32_t *entries = list->entries;
        list->entries = list->spare;
        list->spare = entries;
    }
}

/* Lists of the fragments whose light reaches a bin of tiles: in scan order, or nearest first
 * where two surfaces meet.  Twins: count_bins, scatter_fragments and sort_bins. */

#include <stdlib.h>

#include "frame.h"
#include "vectors.h"

#define BIN_TILES_X 2
#define BIN_TILES_Y 2
#define BIN_TILES (BIN_TILES_X * BIN_TILES_Y)
#define ALL_TILES ((1u << BIN_TILES) - 1u)
_Static_assert(BIN_TILES_X == 2 && BIN_TILES_Y == 2, "box_tiles counts on it");
#define BIN_WIDTH (BIN_TILES_X * TILE_SIZE_PX)
#define BIN_HEIGHT (BIN_TILES_Y * TILE_SIZE_PX)

typedef struct {
    uint32_t fragment;
    uint32_t tiles;           /* bit mask of the tiles that it lights */
} entry;

/* Fragment list of a bin, with the scratch memory of one thread; grows on demand. */
typedef struct {
    entry *entries, *spare;
    uint32_t *keys, *spare_keys;
    int capacity;
    int count;
    int x0, y0;               /* first pixel of the bin */
    int any_edge, any_special;
    uint32_t ordered;         /* tiles where order matters */
} bin_list;

static int grow(bin_list *list) {
    int capacity = list->capacity ? 2 * list->capacity : 1024;
    entry *entries = realloc(list->entries, sizeof *entries * (size_t)capacity);
    if (entries == NULL) return 0;
    list->entries = entries;
    entry *spare = realloc(list->spare, sizeof *spare * (size_t)capacity);
    if (spare == NULL) return 0;
    list->spare = spare;
    uint32_t *keys = realloc(list->keys, sizeof *keys * (size_t)capacity);
    if (keys == NULL) return 0;
    list->keys = keys;
    keys = realloc(list->spare_keys, sizeof *keys * (size_t)capacity);
    if (keys == NULL) return 0;
    list->spare_keys = keys;
    list->capacity = capacity;
    return 1;
}

static void free_list(bin_list *list) {
    free(list->entries);
    free(list->spare);
    free(list->keys);
    free(list->spare_keys);
}

INLINE int gap_between(int first_a, int last_a, int first_b, int last_b) {
    int gap = larger_int(first_b - last_a, first_a - last_b);
    return gap > 0 ? gap : 0;
}

/* Returns whether a disc about any of a fragment's pixels overlaps pixels x0..x1, y0..y1. */
INLINE int disc_meets(const fragment *one, int x0, int y0, int x1, int y1) {
    int extent = (1 << (one->state >> LEVEL_SHIFT & 3)) - 1;
    int x = one->x, y = one->y;
    int gap_x = gap_between(x, x + extent, x0, x1);
    int gap_y = gap_between(y, y + extent, y0, y1);
    int radius = one->radius_px; /* gaps are integers: (r + 0.5)^2 = r^2 + r + 0.25 */
    return gap_x * gap_x + gap_y * gap_y <= radius * radius + radius;
}

/* Returns whether a fragment lights the pixels, which must also overlap its kernel's box. */
INLINE int lights(const frame *f, uint32_t at, int x0, int y0, int x1, int y1) {
    return f->boxes[BOX_LEFT][at] <= x1 && f->boxes[BOX_RIGHT][at] >= x0
           && f->boxes[BOX_TOP][at] <= y1 && f->boxes[BOX_BOTTOM][at] >= y0
           && disc_meets(f->fragments + at, x0, y0, x1, y1);
}

INLINE i16x16 load_sides(const int16_t *from) {
    i16x16 value;
    memcpy(&value, from, sizeof value);
    return value;
}

/* Bit mask of the fragments, out of sixteen, whose boxes overlap the bin. */
INLINE uint32_t boxes_meet(const frame *f, uint32_t first, const bin_list *list) {
    i16x16 beside = (load_sides(f->boxes[BOX_LEFT] + first) >= all16(list->x0 + BIN_WIDTH))
                    | (load_sides(f->boxes[BOX_RIGHT] + first) < all16(list->x0))
                    | (load_sides(f->boxes[BOX_TOP] + first) >= all16(list->y0 + BIN_HEIGHT))
                    | (load_sides(f->boxes[BOX_BOTTOM] + first) < all16(list->y0));
    return bits_of_lanes(~beside);
}

/* Lists those of consecutive fragments that reach the bin; the list has room for all. */
INLINE void list_some(const frame *f, bin_list *list, uint32_t first, uint32_t end) {
    int x0 = list->x0, y0 = list->y0;
    int x1 = x0 + BIN_WIDTH - 1, y1 = y0 + BIN_HEIGHT - 1;
    entry *out = list->entries + list->count;
    uint32_t states = 0;
    for (; first < end; first += 16) {
        uint32_t met = boxes_meet(f, first, list);
        if (end - first < 16) met &= (1u << (end - first)) - 1u;
        for (; met; met &= met - 1) {
            uint32_t at = first + (uint32_t)__builtin_ctz(met);
            const fragment *one = f->fragments + at;
            uint32_t meets = (uint32_t)disc_meets(one, x0, y0, x1, y1);
            states |= one->state & (0u - meets);
            *out = (entry){at, ALL_TILES};
            out += meets;
        }
    }
    list->count = (int)(out - list->entries);
    list->any_edge |= (states & EDGE_BIT) != 0;
    list->any_special |= (states & SPECIAL_BIT) != 0;
}

/* Lists the fragments that reach the bin; false if memory ran out. */
static int list_fragments(const frame *f, bin_list *list) {
    list->count = 0;
    list->any_edge = list->any_special = 0;
    int search = f->farthest_px;
    int left = larger_int(list->x0 - search, 0) / TILE_SIZE_PX;
    int top = larger_int(list->y0 - search, 0) / TILE_SIZE_PX;
    int right = (list->x0 + BIN_WIDTH - 1 + search) / TILE_SIZE_PX;
    int bottom = (list->y0 + BIN_HEIGHT - 1 + search) / TILE_SIZE_PX;
    right = smaller_int(right, f->block_columns - 1);
    bottom = smaller_int(bottom, f->block_rows - 1);
    for (int surface = 0; surface < f->surface_count; ++surface) {
        for (int row = top; row <= bottom; ++row) {
            const block_info *blocks =
                f->blocks + (surface * f->block_rows + row) * f->block_columns;
            uint32_t first = blocks[left].first, end = blocks[right].end;
            while (list->capacity < list->count + (int)(end - first))
                if (!grow(list)) return 0;
            list_some(f, list, first, end);
        }
    }
    return 1;
}

/* Bit mask of the tiles that the box of a fragment's kernel overlaps: upper left and right,
 * lower left and right. */
INLINE uint32_t box_tiles(const frame *f, const bin_list *list, uint32_t at) {
    int middle_x = list->x0 + TILE_SIZE_PX, middle_y = list->y0 + TILE_SIZE_PX;
    uint32_t columns = (uint32_t)(f->boxes[BOX_LEFT][at] < middle_x)
                       | (uint32_t)(f->boxes[BOX_RIGHT][at] >= middle_x) << 1;
    uint32_t above = 0u - (uint32_t)(f->boxes[BOX_TOP][at] < middle_y);
    uint32_t below = 0u - (uint32_t)(f->boxes[BOX_BOTTOM][at] >= middle_y);
    return (columns & above) | (columns & below) << BIN_TILES_X;
}

/* Marks the tiles that each entry may light, and the tiles in which order matters, which
 * light from next to an edge reaches. */
static void mark_tiles(const frame *f, bin_list *list) {
    list->ordered = 0;
    for (int i = 0; i < list->count; ++i) {
        uint32_t at = list->entries[i].fragment;
        list->entries[i].tiles = box_tiles(f, list, at);
        if (!(f->fragments[at].state & EDGE_BIT)) continue;
        for (int tile = 0; tile < BIN_TILES; ++tile) {
            int x0 = list->x0 + tile % BIN_TILES_X * TILE_SIZE_PX;
            int y0 = list->y0 + tile / BIN_TILES_X * TILE_SIZE_PX;
            int lit = lights(f, at, x0, y0, x0 + TILE_SIZE_PX - 1, y0 + TILE_SIZE_PX - 1);
            list->ordered |= (uint32_t)lit << tile;
        }
    }
}

/* Maps a float to bits with the same order. */
INLINE uint32_t ordered_bits(float value) {
    uint32_t bits = bits_of(value);
    return bits & 0x80000000u ? ~bits : bits | 0x80000000u;
}

/* Sorts nearest first; equal depths keep their scan order. */
static void sort_list(const frame *f, bin_list *list) {
    for (int i = 0; i < list->count; ++i)
        list->keys[i] = ordered_bits(f->lights[list->entries[i].fragment].depth);
    if (list->count <= 48) {
        for (int i = 1; i < list->count; ++i) {
            uint32_t key = list->keys[i];
            entry own = list->entries[i];
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
        entry *entries = list->entries;
        list->entries = list->spare;
        list->spare = entries;
    }
}

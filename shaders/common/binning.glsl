// Iteration over the fragments whose light reaches a bin, in scan order: blocks row by row
// through the bin's window, surface after surface, and the fragments of each in order.
// Each thread takes one contiguous part of that sequence, so the list is the same for any
// number of threads, and for every run.  The sequence is divided into ranges of a
// block's slots, because without wide blur there are fewer blocks than threads.
// A window (first column and row of blocks, last ones plus one) contains every block that
// reaches the bin, and no row or column without one.
// Needs buffers `blocks`, `places` and uniforms `tile_grid`, `surface_count` in scope.

struct Cursor {
    ivec2 bin;
    ivec2 first;                  // block of the window
    ivec2 size;                   // of the window in blocks
    int next;                     // next range of this thread in the sequence
    int end;
};

struct SlotRange {
    int block;
    uint first;                   // slot
    uint end;
};

const int RANGES_PER_BLOCK = THREADS / RANGE_SLOTS;

Cursor cursor_at(ivec2 bin, ivec4 window) {
    ivec2 size = max(window.zw - window.xy, 0);
    int length = surface_count * size.x * size.y * RANGES_PER_BLOCK;
    int share = (length + GROUP_THREADS - 1) / GROUP_THREADS;
    int start = int(gl_LocalInvocationIndex) * share;
    return Cursor(bin, window.xy, size, start, min(start + share, length));
}

// Whether a block at `at`, of any surface, has a fragment that may reach the bin.
bool block_reaches(int block, ivec2 at, ivec2 bin) {
    float reach = uintBitsToFloat(blocks[block].y);
    ivec2 first = at * TILE_SIZE_PX;
    ivec2 bin_first = bin * BIN_SIZE_PX;
    float gap_squared = distance_squared_between(first, first + TILE_SIZE_PX - 1, bin_first,
                                                 bin_first + BIN_SIZE_PX - 1);
    return blocks[block].x != 0u && gap_squared <= reach * reach;
}

// Next fragments of this thread's part, from a block in reach; false if there are none.
bool next_slots(inout Cursor cursor, out SlotRange slots) {
    while (cursor.next < cursor.end) {
        int place = cursor.next / RANGES_PER_BLOCK;
        int part = cursor.next - place * RANGES_PER_BLOCK;
        int row = place / cursor.size.x;
        ivec2 at = cursor.first + ivec2(place - row * cursor.size.x, row % cursor.size.y);
        int block = (row / cursor.size.y * tile_grid.y + at.y) * tile_grid.x + at.x;
        int count = int(blocks[block].x) - part * RANGE_SLOTS;
        if (count > 0 && block_reaches(block, at, cursor.bin)) {
            int first = block * THREADS + part * RANGE_SLOTS;
            slots = SlotRange(block, uint(first), uint(first + min(count, RANGE_SLOTS)));
            ++cursor.next;
            return true;
        }
        cursor.next = (place + 1) * RANGES_PER_BLOCK;
    }
    return false;
}

// A bit for each tile of the bin that the fragment lights: within the box of its kernel
// and within the discs around the pixels of its square.
uint tiles_in_reach(uvec4 place, ivec2 bin) {
    Reach reach = unpack_reach(place.w);
    ivec2 first = place_origin_px(place);
    ivec2 last = first + place_extent_px(place);
    ivec2 box_first = first - ivec2(reach.left, reach.up);
    ivec2 box_last = last + ivec2(reach.right, reach.down);
    float radius = place_reach_px(place);
    uint tiles = 0u;
    for (int i = 0; i < TILES_PER_BIN; ++i) {
        ivec2 tile_first = (bin * BIN_TILES + ivec2(i % BIN_TILES, i / BIN_TILES)) * TILE_SIZE_PX;
        ivec2 tile_last = tile_first + TILE_SIZE_PX - 1;
        bool in_box = all(lessThanEqual(box_first, tile_last))
                   && all(greaterThanEqual(box_last, tile_first));
        float gap_squared = distance_squared_between(first, last, tile_first, tile_last);
        if (in_box && gap_squared <= radius * radius) tiles |= 1u << uint(i);
    }
    return tiles;
}

// An entry of a list: slot of the fragment, and which tiles of the bin it lights.
uint pack_entry(uint slot, uint tiles) { return (slot << uint(TILES_PER_BIN)) | tiles; }

// Counts the fragments whose light reaches each bin, and marks the tiles in which two
// surfaces meet, so that order matters.
// In:  FRAGMENT_PLACE, BLOCKS, PLAN.   Out: BIN_COUNTS (kept, a bit for each tile whose order
//      matters, entries beyond the capacity of a list, a bit for each tile that light of a
//      hidden surface reaches, and above these that excess light reaches, unless order
//      always matters), WINDOWS (blocks that reach a bin).
// Dispatch: one group of GROUP_THREADS per bin: 8 on a software renderer, so that its
//      vectors are full, THREADS on hardware.
// Twin: tests/numerical/tile_lists.py (lists by comparing all pairs).

#include "common/tiles.glsl"
#include "common/reach.glsl"
#include "common/fragments.glsl"

layout(local_size_x = GROUP_THREADS) in;

layout(std430, binding = BINDING_FRAGMENT_PLACE) readonly buffer Place { uvec4 places[]; };
layout(std430, binding = BINDING_BLOCKS) readonly buffer Blocks { uvec4 blocks[]; };
layout(std430, binding = BINDING_PLAN) readonly buffer Plan { uint plan[]; };
layout(std430, binding = BINDING_WINDOWS) writeonly buffer Windows { ivec4 windows[]; };
layout(std430, binding = BINDING_BIN_COUNTS) writeonly buffer Counts { uvec4 counts[]; };

uniform ivec2 tile_grid;
uniform int surface_count;
uniform uint list_capacity;
uniform int order_always;

#include "common/binning.glsl"

shared uint total;
shared uint ordered_tiles;
shared uint hidden_tiles;
shared uint bright_tiles;
shared int window_low[2];
shared int window_high[2];

// Searches for blocks in reach, up to the largest reach of the frame.  One wide blur thus
// widens only the windows that it reaches; for others it costs only this search.
ivec4 find_window(ivec2 bin) {
    float reach = ceil(float(plan[PLAN_REACH]) + REACH_MARGIN_PX);
    int search_blocks = min((int(reach) + TILE_SIZE_PX - 1) / TILE_SIZE_PX,
                            max(tile_grid.x, tile_grid.y));
    ivec2 from = max(bin * BIN_TILES - search_blocks, 0);
    ivec2 size = min((bin + 1) * BIN_TILES + search_blocks, tile_grid) - from;
    ivec2 low = tile_grid;
    ivec2 high = ivec2(0);
    for (int i = int(gl_LocalInvocationIndex); i < size.x * size.y; i += GROUP_THREADS) {
        ivec2 at = from + ivec2(i % size.x, i / size.x);
        for (int surface = 0; surface < surface_count; ++surface) {
            int block = (surface * tile_grid.y + at.y) * tile_grid.x + at.x;
            bool reaches = block_reaches(block, at, bin);
            low = min(low, reaches ? at : low);
            high = max(high, reaches ? at + 1 : high);
        }
    }
    for (int axis = 0; axis < 2; ++axis) {
        atomicMin(window_low[axis], low[axis]);
        atomicMax(window_high[axis], high[axis]);
    }
    barrier();  // every thread has contributed its blocks
    return ivec4(window_low[0], window_low[1], window_high[0], window_high[1]);
}

void main() {
    if (gl_LocalInvocationIndex == 0u) {
        total = 0u;
        ordered_tiles = order_always != 0 ? uint(ALL_TILES) : 0u;
        hidden_tiles = 0u;
        bright_tiles = 0u;
        for (int axis = 0; axis < 2; ++axis) {
            window_low[axis] = tile_grid[axis];
            window_high[axis] = 0;
        }
    }
    barrier();  // sums are zero, and windows are empty
    ivec2 bin = ivec2(gl_WorkGroupID.xy);
    int index = bin.y * int(gl_NumWorkGroups.x) + bin.x;
    ivec4 window = find_window(bin);
    Cursor cursor = cursor_at(bin, window);
    uint count = 0u;
    uint edges = 0u;
    uint covered = 0u;
    uint bright = 0u;
    SlotRange slots;
    while (next_slots(cursor, slots)) {
        // Where light of a hidden surface arrives, a surface lies in front of it.
        bool is_hidden = slots.block >= tile_grid.x * tile_grid.y;
        for (uint slot = slots.first; slot < slots.end; ++slot) {
            uvec4 place = places[slot];
            uint tiles = tiles_in_reach(place, bin);
            count += tiles != 0u ? 1u : 0u;
            edges |= (place.y & EDGE_BIT) != 0u ? tiles : 0u;
            covered |= is_hidden ? tiles : 0u;
            bright |= (place.y & uint(BRIGHT_BIT)) != 0u ? tiles : 0u;
        }
    }
    atomicAdd(total, count);
    atomicOr(ordered_tiles, edges | covered);
    if (order_always == 0) {
        atomicOr(hidden_tiles, covered);
        atomicOr(bright_tiles, bright);
    }
    barrier();  // all threads have added
    if (gl_LocalInvocationIndex == 0u) {
        uint kept = min(total, list_capacity);
        windows[index] = window;
        counts[index] = uvec4(kept, ordered_tiles, total - kept,
                              hidden_tiles | (bright_tiles << uint(TILES_PER_BIN)));
    }
}

// Counts the fragments whose light reaches each bin, and notes in which of its tiles two
// surfaces meet, so that their order matters.
// In:  FRAGMENT_PLACE, BLOCKS.   Out: BIN_COUNTS (kept, a bit for each tile whose order
//      matters, entries beyond the capacity of a list).
// Dispatch: one group of GROUP_THREADS a bin: 8 on a software renderer, whose vectors
//      then all have work, THREADS on hardware.
// Twin: tests/numerical/tile_lists.py (lists by comparing all pairs).

#include "common/tiles.glsl"
#include "common/reach.glsl"
#include "common/fragments.glsl"

layout(local_size_x = GROUP_THREADS) in;

layout(std430, binding = BINDING_FRAGMENT_PLACE) readonly buffer Place { uvec4 places[]; };
layout(std430, binding = BINDING_BLOCKS) readonly buffer Blocks { uvec4 blocks[]; };
layout(std430, binding = BINDING_BIN_COUNTS) writeonly buffer Counts { uvec4 counts[]; };

uniform ivec2 tile_grid;
uniform int search_blocks;
uniform int surface_count;
uniform uint list_capacity;
uniform int order_always;

#include "common/binning.glsl"

shared uint total;
shared uint ordered_tiles;

void main() {
    if (gl_LocalInvocationIndex == 0u) {
        total = 0u;
        ordered_tiles = order_always != 0 ? uint(ALL_TILES) : 0u;
    }
    barrier();  // sums start from zero
    ivec2 bin = ivec2(gl_WorkGroupID.xy);
    Walk walk = start_walk(bin);
    uint count = 0u;
    uint edges = 0u;
    for (int block = next_block(walk); block >= 0; block = next_block(walk)) {
        uint first = uint(block * THREADS);
        uint end = first + blocks[block].x;
        // Where a hidden surface arrives, something lies in front of it.
        bool hidden = block >= tile_grid.x * tile_grid.y;
        for (uint slot = first; slot < end; ++slot) {
            uvec4 place = places[slot];
            uint tiles = tiles_in_reach(place, bin);
            count += tiles != 0u ? 1u : 0u;
            edges |= hidden || (place.y & EDGE_BIT) != 0u ? tiles : 0u;
        }
    }
    atomicAdd(total, count);
    atomicOr(ordered_tiles, edges);
    barrier();  // all threads have added
    if (gl_LocalInvocationIndex == 0u) {
        uint kept = min(total, list_capacity);
        counts[bin.y * int(gl_NumWorkGroups.x) + bin.x] =
            uvec4(kept, ordered_tiles, total - kept, 0u);
    }
}

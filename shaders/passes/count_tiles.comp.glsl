// Counts the fragments whose light reaches each tile, and whether their order matters.
// In:  FRAGMENT_PLACE, BLOCKS.   Out: TILE_COUNTS (count, order matters).
// Dispatch: one group of GROUP_THREADS a tile: 8 on a software renderer, whose vectors
//      then all have work, THREADS on hardware.
// Twin: tests/numerical/test_renderer_passes.py (lists by comparing all pairs).

#include "common/tiles.glsl"
#include "common/reach.glsl"
#include "common/fragments.glsl"

layout(local_size_x = GROUP_THREADS) in;

layout(std430, binding = BINDING_FRAGMENT_PLACE) readonly buffer Place { uvec4 places[]; };
layout(std430, binding = BINDING_BLOCKS) readonly buffer Blocks { uvec4 blocks[]; };
layout(std430, binding = BINDING_TILE_COUNTS) writeonly buffer Counts { uvec2 counts[]; };

uniform ivec2 tile_grid;
uniform int search_blocks;
uniform int surface_count;
uniform int order_always;

#include "common/binning.glsl"

shared uint total;
shared uint order_matters;

void main() {
    if (gl_LocalInvocationIndex == 0u) {
        total = 0u;
        order_matters = uint(order_always);
    }
    barrier();  // sums start from zero
    ivec2 tile = ivec2(gl_WorkGroupID.xy);
    Walk walk = start_walk(tile);
    uint count = 0u;
    bool edge = false;
    for (int block = next_block(walk); block >= 0; block = next_block(walk)) {
        uint first = uint(block * THREADS);
        uint end = first + blocks[block].x;
        for (uint slot = first; slot < end; ++slot) {
            uvec4 place = places[slot];
            if (!reaches_tile(place, tile)) continue;
            ++count;
            edge = edge || (place.y & EDGE_BIT) != 0u;
        }
    }
    atomicAdd(total, count);
    if (edge) atomicOr(order_matters, 1u);
    barrier();  // all threads have added
    if (gl_LocalInvocationIndex == 0u)
        counts[tile.y * tile_grid.x + tile.x] = uvec2(total, order_matters);
}

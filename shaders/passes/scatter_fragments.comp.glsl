// Writes each tile's list of fragment slots, in the order of the walk.
// In:  FRAGMENT_PLACE, BLOCKS, TILE_OFFSETS.   Out: ENTRIES.
// Dispatch: one group of GROUP_THREADS a tile of the band.
// Twin: tests/numerical/test_renderer_passes.py (lists by comparing all pairs).

#include "common/tiles.glsl"
#include "common/reach.glsl"
#include "common/fragments.glsl"

layout(local_size_x = GROUP_THREADS) in;

layout(std430, binding = BINDING_FRAGMENT_PLACE) readonly buffer Place { uvec4 places[]; };
layout(std430, binding = BINDING_BLOCKS) readonly buffer Blocks { uvec4 blocks[]; };
layout(std430, binding = BINDING_TILE_OFFSETS) readonly buffer Offsets { uint offsets[]; };
layout(std430, binding = BINDING_ENTRIES) writeonly buffer Entries { uint entries[]; };

uniform ivec2 tile_grid;
uniform int search_blocks;
uniform int surface_count;
uniform int first_tile;           // of the band
uniform uint first_entry;

#include "common/binning.glsl"

shared uint counts[GROUP_THREADS];

void main() {
    int index = first_tile + int(gl_WorkGroupID.x);
    ivec2 tile = ivec2(index % tile_grid.x, index / tile_grid.x);
    uint count = 0u;
    Walk walk = start_walk(tile);
    for (int block = next_block(walk); block >= 0; block = next_block(walk)) {
        uint first = uint(block * THREADS);
        uint end = first + blocks[block].x;
        for (uint slot = first; slot < end; ++slot)
            if (reaches_tile(places[slot], tile)) ++count;
    }
    counts[gl_LocalInvocationIndex] = count;
    barrier();  // each thread's share of the list is known
    uint at = offsets[index] - first_entry;
    for (uint other = 0u; other < gl_LocalInvocationIndex; ++other) at += counts[other];
    walk = start_walk(tile);
    for (int block = next_block(walk); block >= 0; block = next_block(walk)) {
        uint first = uint(block * THREADS);
        uint end = first + blocks[block].x;
        for (uint slot = first; slot < end; ++slot)
            if (reaches_tile(places[slot], tile)) entries[at++] = slot;
    }
}

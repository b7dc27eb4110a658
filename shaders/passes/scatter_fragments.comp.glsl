// Writes each bin's list: fragment slots and the tiles that they light, in scan order.
// In:  FRAGMENT_PLACE, BLOCKS, WINDOWS, BIN_OFFSETS.   Out: ENTRIES.
// Dispatch: one group of GROUP_THREADS per bin of the band.
// Twin: tests/numerical/tile_lists.py (lists by comparing all pairs).

#include "common/tiles.glsl"
#include "common/reach.glsl"
#include "common/fragments.glsl"

layout(local_size_x = GROUP_THREADS) in;

layout(std430, binding = BINDING_FRAGMENT_PLACE) readonly buffer Place { uvec4 places[]; };
layout(std430, binding = BINDING_BLOCKS) readonly buffer Blocks { uvec4 blocks[]; };
layout(std430, binding = BINDING_WINDOWS) readonly buffer Windows { ivec4 windows[]; };
layout(std430, binding = BINDING_BIN_OFFSETS) readonly buffer Offsets { uint offsets[]; };
layout(std430, binding = BINDING_ENTRIES) writeonly buffer Entries { uint entries[]; };

uniform ivec2 tile_grid;
uniform int surface_count;
uniform uint list_capacity;
uniform int bin_columns;
uniform int first_bin;            // of the band

#include "common/binning.glsl"

shared uint counts[GROUP_THREADS];

void main() {
    int index = first_bin + int(gl_WorkGroupID.x);
    ivec2 bin = ivec2(index % bin_columns, index / bin_columns);
    uint count = 0u;
    SlotRange slots;
    Cursor cursor = cursor_at(bin, windows[index]);
    while (next_slots(cursor, slots)) {
        for (uint slot = slots.first; slot < slots.end; ++slot)
            count += tiles_in_reach(places[slot], bin) != 0u ? 1u : 0u;
    }
    counts[gl_LocalInvocationIndex] = count;
    barrier();  // each thread's share of the list is known
    uint at = offsets[index];
    uint last = at + list_capacity;
    for (uint other = 0u; other < gl_LocalInvocationIndex; ++other) at += counts[other];
    cursor = cursor_at(bin, windows[index]);
    while (next_slots(cursor, slots)) {
        for (uint slot = slots.first; slot < slots.end; ++slot) {
            uint tiles = tiles_in_reach(places[slot], bin);
            if (tiles == 0u) continue;
            if (at < last) entries[at] = pack_entry(slot, tiles);
            ++at;
        }
    }
}

// Sorts the list of each tile whose order matters, nearest first: stable radix sort of
// the depth within the tile's own range, RADIX_BITS at a time, so that any list length
// goes through one path and equal depths keep their order.
// In:  FRAGMENT_COLOR (sort depth in a), TILE_COUNTS, TILE_OFFSETS.
// In/Out: ENTRIES; ENTRIES_SPARE is scratch of the same size.
// Dispatch: one group of GROUP_THREADS a tile of the band.  KEY_BITS: SORT_KEY_BITS or PAPER_SORT_KEY_BITS.
// Twin: tests/numerical/test_renderer_passes.py (order of the listed depths).

layout(local_size_x = GROUP_THREADS) in;

layout(std430, binding = BINDING_FRAGMENT_COLOR) readonly buffer Color { vec4 colors[]; };
layout(std430, binding = BINDING_TILE_COUNTS) readonly buffer Counts { uvec2 counts[]; };
layout(std430, binding = BINDING_TILE_OFFSETS) readonly buffer Offsets { uint offsets[]; };
layout(std430, binding = BINDING_ENTRIES) buffer Entries { uint entries[]; };
layout(std430, binding = BINDING_ENTRIES_SPARE) buffer Spare { uint spare[]; };

uniform int first_tile;           // of the band
uniform uint first_entry;

shared uint buckets[RADIX * GROUP_THREADS];
shared uint bucket_totals[RADIX];
shared float lowest[GROUP_THREADS];
shared float highest[GROUP_THREADS];

uint depth_key(uint slot, vec2 depth_range) {
    float position = (colors[slot].a - depth_range.x) / depth_range.y;
    return uint(clamp(position, 0.0, 1.0) * float((1 << KEY_BITS) - 1));
}

// Nearest depth and depth range of the list.
vec2 find_depth_range(uint first, uint end) {
    uint thread = gl_LocalInvocationIndex;
    float low = colors[entries[first]].a;
    float high = low;
    for (uint i = first + thread; i < end; i += uint(GROUP_THREADS)) {
        float depth = colors[entries[i]].a;
        low = min(low, depth);
        high = max(high, depth);
    }
    lowest[thread] = low;
    highest[thread] = high;
    barrier();  // every thread has its own extremes
    for (int other = 0; other < GROUP_THREADS; ++other) {
        low = min(low, lowest[other]);
        high = max(high, highest[other]);
    }
    return vec2(low, max(high - low, MIN_BLUR_RANGE));
}

void main() {
    int tile = first_tile + int(gl_WorkGroupID.x);
    uint count = counts[tile].x;
    if (counts[tile].y == 0u || count < 2u) return;  // the same for the whole group
    uint first = offsets[tile] - first_entry;
    uint end = first + count;
    uint thread = gl_LocalInvocationIndex;
    uint share = (count + uint(GROUP_THREADS) - 1u) / uint(GROUP_THREADS);
    uint my_first = min(first + thread * share, end);
    uint my_end = min(my_first + share, end);
    vec2 depth_range = find_depth_range(first, end);

    for (int shift = 0; shift < KEY_BITS; shift += RADIX_BITS) {
        bool forwards = (shift / RADIX_BITS) % 2 == 0;
        for (int digit = 0; digit < RADIX; ++digit) buckets[digit * GROUP_THREADS + int(thread)] = 0u;
        for (uint i = my_first; i < my_end; ++i) {
            uint slot = forwards ? entries[i] : spare[i];
            uint digit = (depth_key(slot, depth_range) >> shift) & uint(RADIX - 1);
            buckets[digit * uint(GROUP_THREADS) + thread] += 1u;
        }
        barrier();  // counts of all threads are in
        for (int bucket = int(thread); bucket < RADIX; bucket += GROUP_THREADS) {
            uint sum = 0u;
            for (int other = 0; other < GROUP_THREADS; ++other) {
                uint value = buckets[bucket * GROUP_THREADS + other];
                buckets[bucket * GROUP_THREADS + other] = sum;
                sum += value;
            }
            bucket_totals[bucket] = sum;
        }
        barrier();  // places within a bucket are known
        uint base = first;
        for (int digit = 0; digit < RADIX; ++digit) {
            buckets[digit * GROUP_THREADS + int(thread)] += base;
            base += bucket_totals[digit];
        }
        for (uint i = my_first; i < my_end; ++i) {
            uint slot = forwards ? entries[i] : spare[i];
            uint digit = (depth_key(slot, depth_range) >> shift) & uint(RADIX - 1);
            uint at = buckets[digit * uint(GROUP_THREADS) + thread];
            buckets[digit * uint(GROUP_THREADS) + thread] = at + 1u;
            if (forwards) spare[at] = slot;
            else entries[at] = slot;
        }
        memoryBarrierBuffer();
        barrier();  // the list is whole before the next digit reads it
    }
}

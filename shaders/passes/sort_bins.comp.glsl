// Sorts the list of each bin in which order matters, nearest first: a stable radix sort by
// depth within the bin's own range, RADIX_BITS at a time; equal depths keep scan order.
// In:  FRAGMENT_COLOR (sort depth in a), BIN_COUNTS, BIN_OFFSETS.   In/Out: ENTRIES.
// Dispatch: one group of GROUP_THREADS per bin of the band, once per size class: lists of
//      more than longest_before and at most CAPACITY entries.
// Variants: CAPACITY > 0 sorts 32-bit keys, depth << SORT_INDEX_BITS | index in the list,
//      in shared memory; 0 sorts lists of any length in global memory, alternating between
//      ENTRIES and ENTRIES_SPARE.  PAPER_RULE: the paper's depths.  KEY_BITS of depth.
// Twin: tests/numerical/tile_lists.py (stable order of the listed depths).

#include "common/depth_keys.glsl"

layout(local_size_x = GROUP_THREADS) in;

layout(std430, binding = BINDING_FRAGMENT_COLOR) readonly buffer Color { vec4 colors[]; };
layout(std430, binding = BINDING_BIN_COUNTS) readonly buffer Counts { uvec4 counts[]; };
layout(std430, binding = BINDING_BIN_OFFSETS) readonly buffer Offsets { uint offsets[]; };
layout(std430, binding = BINDING_ENTRIES) coherent buffer Entries { uint entries[]; };

uniform int first_bin;            // of the band
uniform uint longest_before;      // capacity of the class below

// A bucket's row is one word longer than the group, so that a column of rows is spread
// over the banks of a GPU's shared memory.
const int BUCKET_WORDS = GROUP_THREADS + 1;
shared uint buckets[RADIX * BUCKET_WORDS];
shared uint bucket_totals[RADIX];
shared uint nearest;              // as ordered bits
shared uint farthest;

float entry_depth(uint entry) { return colors[entry >> uint(TILES_PER_BIN)].a; }

#if CAPACITY > 0
shared uint keys[2 * CAPACITY];

uint read_item(uint i, uint first, bool odd) { return keys[odd ? i + uint(CAPACITY) : i]; }

void write_item(uint at, uint first, bool odd, uint item) {
    keys[odd ? at : at + uint(CAPACITY)] = item;
}

uint item_key(uint item) { return item >> uint(SORT_INDEX_BITS); }

void begin(uint first, uint my_first, uint my_end) {
    for (uint i = my_first; i < my_end; ++i) {
        uint key = depth_key(entry_depth(entries[first + i]), nearest, farthest);
        keys[i] = (key << uint(SORT_INDEX_BITS)) | i;
    }
}

// Entries are permuted like their keys, through the free half of the keys.
void finish(uint first, uint my_first, uint my_end, bool odd) {
    for (uint i = my_first; i < my_end; ++i) {
        uint place = read_item(i, first, odd) & uint((1 << SORT_INDEX_BITS) - 1);
        write_item(i, first, odd, entries[first + place]);
    }
    memoryBarrierBuffer();
    barrier();  // no entry is overwritten before it is read
    for (uint i = my_first; i < my_end; ++i)
        entries[first + i] = read_item(i, first, !odd);
}
#else
layout(std430, binding = BINDING_ENTRIES_SPARE) coherent buffer Spare { uint spare[]; };

uint read_item(uint i, uint first, bool odd) {
    return odd ? spare[first + i] : entries[first + i];
}

void write_item(uint at, uint first, bool odd, uint item) {
    if (odd) entries[first + at] = item;
    else spare[first + at] = item;
}

uint item_key(uint item) { return depth_key(entry_depth(item), nearest, farthest); }

void begin(uint first, uint my_first, uint my_end) {}

void finish(uint first, uint my_first, uint my_end, bool odd) {
    if (!odd) return;
    for (uint i = my_first; i < my_end; ++i) entries[first + i] = spare[first + i];
}
#endif

void find_depth_range(uint first, uint my_first, uint my_end) {
    uint low = ~0u;
    uint high = 0u;
    for (uint i = my_first; i < my_end; ++i) {
        uint bits = ordered_bits(entry_depth(entries[first + i]));
        low = min(low, bits);
        high = max(high, bits);
    }
    atomicMin(nearest, low);
    atomicMax(farthest, high);
    barrier();  // every thread has contributed its extremes
}

// Stable sort by one digit of the keys.
void sort_digit(uint first, uint my_first, uint my_end, int shift, bool odd) {
    uint thread = gl_LocalInvocationIndex;
    uint digit_mask = uint(RADIX - 1);
    for (int digit = 0; digit < RADIX; ++digit)
        buckets[digit * BUCKET_WORDS + int(thread)] = 0u;
    for (uint i = my_first; i < my_end; ++i) {
        uint digit = (item_key(read_item(i, first, odd)) >> shift) & digit_mask;
        buckets[digit * uint(BUCKET_WORDS) + thread] += 1u;
    }
    barrier();  // the counts of all threads are complete
    for (int bucket = int(thread); bucket < RADIX; bucket += GROUP_THREADS) {
        uint sum = 0u;
        for (int other = 0; other < GROUP_THREADS; ++other) {
            uint value = buckets[bucket * BUCKET_WORDS + other];
            buckets[bucket * BUCKET_WORDS + other] = sum;
            sum += value;
        }
        bucket_totals[bucket] = sum;
    }
    barrier();  // positions within a bucket are known
    uint base = 0u;
    for (int digit = 0; digit < RADIX; ++digit) {
        buckets[digit * BUCKET_WORDS + int(thread)] += base;
        base += bucket_totals[digit];
    }
    for (uint i = my_first; i < my_end; ++i) {
        uint item = read_item(i, first, odd);
        uint digit = (item_key(item) >> shift) & digit_mask;
        uint at = buckets[digit * uint(BUCKET_WORDS) + thread];
        buckets[digit * uint(BUCKET_WORDS) + thread] = at + 1u;
        write_item(at, first, odd, item);
    }
    memoryBarrierBuffer();
    barrier();  // the list is complete before the next digit reads it
}

void main() {
    int bin = first_bin + int(gl_WorkGroupID.x);
    uint count = counts[bin].x;
    bool in_class = count > longest_before && (CAPACITY == 0 || count <= uint(CAPACITY));
    if (counts[bin].y == 0u || !in_class) return;  // the same for the whole group
    if (gl_LocalInvocationIndex == 0u) {
        nearest = ~0u;
        farthest = 0u;
    }
    barrier();  // extremes are clear
    uint first = offsets[bin];
    uint share = (count + uint(GROUP_THREADS) - 1u) / uint(GROUP_THREADS);
    uint my_first = min(gl_LocalInvocationIndex * share, count);
    uint my_end = min(my_first + share, count);
    find_depth_range(first, my_first, my_end);
    begin(first, my_first, my_end);
    barrier();  // all keys are written
    bool odd = false;
    for (int shift = 0; shift < KEY_BITS; shift += RADIX_BITS) {
        sort_digit(first, my_first, my_end, shift, odd);
        odd = !odd;
    }
    finish(first, my_first, my_end, odd);
}

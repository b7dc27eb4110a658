// Exclusive prefix sum of the bins' counts: the start of each list.
// In:  BIN_COUNTS, PLAN.   Out: BIN_OFFSETS (bin_count starts, then the totals: entries, the same
//      as float bits, which reveal a 32-bit overflow, dropped entries, and the length of
//      the longest list), DISPATCHES (groups of the following passes: scatter, a sort for
//      each size class, splat; zero if the lists or the kernels do not fit their buffers,
//      so that the caller can enlarge them and run the passes then), TILES (bin and tile of
//      the tiles of each kind, filled up with NO_INDEX to whole groups).
// Dispatch: one group.
// Twin: tests/numerical/tile_lists.py (numpy.cumsum).

layout(local_size_x = SCAN_THREADS) in;

layout(std430, binding = BINDING_BIN_COUNTS) readonly buffer Counts { uvec4 counts[]; };
layout(std430, binding = BINDING_BIN_OFFSETS) writeonly buffer Offsets { uint offsets[]; };

layout(std430, binding = BINDING_DISPATCHES) writeonly buffer Dispatches { uvec4 groups[]; };
layout(std430, binding = BINDING_PLAN) readonly buffer Plan { uint plan[]; };

uniform int bin_count;
uniform uint entry_capacity;      // of ENTRIES
uniform uint spare_capacity;      // of ENTRIES_SPARE
uniform int needs_all_psfs;       // whether a frame without some PSFs is not shown

layout(std430, binding = BINDING_TILES) writeonly buffer Tiles { uint tiles[]; };

uniform ivec2 tile_grid;
uniform int bin_columns;

shared uvec4 kind_sums[SCAN_THREADS];
shared uint sums[SCAN_THREADS];
shared float float_sums[SCAN_THREADS];
shared uint lost_count;
shared uint longest;

// Kind of a tile of a bin; TILE_KINDS outside the image.
uint kind_of(int bin, uvec4 count, int in_bin) {
    ivec2 tile = ivec2(bin % bin_columns, bin / bin_columns) * BIN_TILES
               + ivec2(in_bin % BIN_TILES, in_bin / BIN_TILES);
    if (any(greaterThanEqual(tile, tile_grid))) return uint(TILE_KINDS);
    uint hidden = (count.w >> uint(in_bin)) & 1u;
    uint bright = (count.w >> uint(TILES_PER_BIN + in_bin)) & 1u;
    bool is_ordered = ((count.y >> uint(in_bin)) & 1u) != 0u;
    return is_ordered ? 1u + hidden : bright * uint(TILE_KINDS - 1);
}

// Lists the tiles of a thread's bins by kind, after those of the threads before it.
void list_tiles(int first, int end, uvec4 at) {
    uint room = uint(bin_count * TILES_PER_BIN);
    for (int bin = first; bin < end; ++bin) {
        uvec4 count = counts[bin];
        for (int in_bin = 0; in_bin < TILES_PER_BIN; ++in_bin) {
            uint kind = kind_of(bin, count, in_bin);
            if (kind == uint(TILE_KINDS)) continue;
            tiles[kind * room + at[kind]] = uint(bin * TILES_PER_BIN + in_bin);
            at[kind] += 1u;
        }
    }
}

void main() {
    int thread = int(gl_LocalInvocationIndex);
    if (thread == 0) {
        lost_count = 0u;
        longest = 0u;
    }
    int share = (bin_count + SCAN_THREADS - 1) / SCAN_THREADS;
    int first = min(thread * share, bin_count);
    int end = min(first + share, bin_count);
    uint sum = 0u;
    uint lost = 0u;
    uint most = 0u;
    float float_sum = 0.0;
    uvec4 kinds = uvec4(0u);
    for (int bin = first; bin < end; ++bin) {
        uvec4 count = counts[bin];
        sum += count.x;
        float_sum += float(count.x);
        lost += count.z;
        most = max(most, count.x);
        for (int in_bin = 0; in_bin < TILES_PER_BIN; ++in_bin) {
            uint kind = kind_of(bin, count, in_bin);
            if (kind < uint(TILE_KINDS)) kinds[kind] += 1u;
        }
    }
    sums[thread] = sum;
    float_sums[thread] = float_sum;
    kind_sums[thread] = kinds;
    barrier();  // every thread's sum is known, and the totals are clear
    atomicMax(longest, most);
    atomicAdd(lost_count, lost);
    uint start = 0u;
    float float_start = 0.0;
    uvec4 kind_start = uvec4(0u);
    for (int other = 0; other < thread; ++other) {
        kind_start += kind_sums[other];
        start += sums[other];
        float_start += float_sums[other];
    }
    for (int bin = first; bin < end; ++bin) {
        offsets[bin] = start;
        start += counts[bin].x;
    }
    list_tiles(first, end, kind_start);
    barrier();  // all threads have added to the totals
    if (thread == SCAN_THREADS - 1) {
        offsets[bin_count + TOTAL_ENTRIES] = start;
        offsets[bin_count + TOTAL_ENTRIES_FLOAT] = floatBitsToUint(float_start + float_sum);
        offsets[bin_count + TOTAL_LOST] = lost_count;
        offsets[bin_count + TOTAL_LONGEST] = longest;
        bool fits = start <= entry_capacity && float_start + float_sum < ENTRIES_EXACT
                 && (longest <= uint(SORT_LARGE) || start <= spare_capacity);
        fits = fits && plan[PLAN_OVERFLOWS] == 0u
            && (needs_all_psfs == 0 || plan[PLAN_MISSING] == 0u);
        uint bins = fits ? uint(bin_count) : 0u;
        groups[DISPATCH_SCATTER] = uvec4(bins, 1u, 1u, 0u);
        uvec3 before = uvec3(1u, uint(SORT_SMALL), uint(SORT_LARGE));
        for (int size_class = 0; size_class < before.length(); ++size_class) {
            uint sorted = longest > before[size_class] ? bins : 0u;
            groups[DISPATCH_SORT + size_class] = uvec4(sorted, 1u, 1u, 0u);
        }
        for (int kind = 0; kind < TILE_KINDS; ++kind) {
            uint count = kind_start[kind] + kinds[kind];
            uint rows = (count + uint(TILES_PER_BIN) - 1u) / uint(TILES_PER_BIN);
            for (uint i = count; i < rows * uint(TILES_PER_BIN); ++i)
                tiles[uint(kind * bin_count * TILES_PER_BIN) + i] = uint(NO_INDEX);
            groups[DISPATCH_SPLAT + kind] =
                uvec4(uint(TILES_PER_BIN), fits ? rows : 0u, 1u, 0u);
            offsets[bin_count + TOTAL_TILES + kind] = count;
        }
    }
}

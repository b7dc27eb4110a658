// Exclusive sum of the tile counts: where each tile's list starts.
// In:  TILE_COUNTS.   Out: TILE_OFFSETS (tile_count + 1; the last is the total, the next
// word the total as float bits, by which a caller notices a 32-bit overflow).
// Dispatch: one group.
// Twin: tests/numerical/test_renderer_passes.py (numpy.cumsum).

layout(local_size_x = SCAN_THREADS) in;

layout(std430, binding = BINDING_TILE_COUNTS) readonly buffer Counts { uvec2 counts[]; };
layout(std430, binding = BINDING_TILE_OFFSETS) writeonly buffer Offsets { uint offsets[]; };

uniform int tile_count;

shared uint sums[SCAN_THREADS];
shared float float_sums[SCAN_THREADS];

void main() {
    int thread = int(gl_LocalInvocationIndex);
    int share = (tile_count + SCAN_THREADS - 1) / SCAN_THREADS;
    int first = min(thread * share, tile_count);
    int end = min(first + share, tile_count);
    uint sum = 0u;
    float float_sum = 0.0;
    for (int tile = first; tile < end; ++tile) {
        sum += counts[tile].x;
        float_sum += float(counts[tile].x);
    }
    sums[thread] = sum;
    float_sums[thread] = float_sum;
    barrier();  // every thread's share is known
    uint start = 0u;
    float float_start = 0.0;
    for (int other = 0; other < thread; ++other) {
        start += sums[other];
        float_start += float_sums[other];
    }
    for (int tile = first; tile < end; ++tile) {
        offsets[tile] = start;
        start += counts[tile].x;
    }
    if (thread == SCAN_THREADS - 1) {
        offsets[tile_count] = start;
        offsets[tile_count + 1] = floatBitsToUint(float_start + float_sum);
    }
}

// Merges similar pixels where the blur hides the difference: 2 x 2, then 4 x 4, then the
// whole block; and packs the fragments of each 8 x 8 block, in scan order, to the front
// of the block's slots.
// In:  PIXELS, PIXEL_LAYER, KERNELS, KERNEL_OF (kernel of a cell and interval).
// Out: FRAGMENT_COLOR, FRAGMENT_PLACE (THREADS slots a block), BLOCKS (count, largest
//      reach bits, has an edge, pixels merged).
// Dispatch: one group a block, one thread a pixel.
// Twin: tests/numerical/test_renderer_passes.py.  Source: section 6.3 (merging of tiled
// splatting), there one level.

layout(local_size_x = TILE_SIZE_PX, local_size_y = TILE_SIZE_PX) in;

layout(std430, binding = BINDING_PIXELS) readonly buffer Pixels { vec4 pixels[]; };
layout(std430, binding = BINDING_PIXEL_LAYER) readonly buffer Position { float position[]; };
layout(std430, binding = BINDING_KERNELS) readonly buffer Kernels { uvec4 kernels[]; };
layout(std430, binding = BINDING_KERNEL_OF) readonly buffer KernelOf { uint kernel_of[]; };
layout(std430, binding = BINDING_FRAGMENT_COLOR) writeonly buffer Color { vec4 colors[]; };
layout(std430, binding = BINDING_FRAGMENT_PLACE) writeonly buffer Place { uvec4 places[]; };
layout(std430, binding = BINDING_BLOCKS) writeonly buffer Blocks { uvec4 blocks[]; };

#include "common/layers.glsl"
#include "common/cells.glsl"
#include "common/kernels.glsl"
#include "common/reach.glsl"
#include "common/fragments.glsl"

uniform ivec2 frame_size_px;
uniform int layer_count;
uniform float blur_px_per_dpt;    // slope of defocus blur at this pupil
uniform float white_level;
uniform int max_level;            // 0: no merging
uniform ivec2 scan_px;            // of the first pixel, and pixels of the whole frame
uniform int paper_order;          // sort as the paper does: metres plus scan position

shared uint alive[2];             // bit per thread: it keeps a fragment
shared uint largest_reach_bits;   // reach is positive, so its bits order like it
shared uint block_has_edge;
shared uint block_merged_count;
// What the thread's pixel, later the merged square that starts there, is made of.
shared int level_of[THREADS];     // -1: belongs to a square that starts elsewhere
shared vec4 mean[THREADS];        // linear RGB, dpt
shared vec4 low[THREADS];
shared vec4 high[THREADS];
shared vec4 depth[THREADS];       // position: mean, nearest, farthest; least spread px
shared uint edge_of[THREADS];

uint pixel_index(ivec2 at) { return uint(at.y * frame_size_px.x + at.x); }

bool inside(ivec2 at) {
    return all(greaterThanEqual(at, ivec2(0))) && all(lessThan(at, frame_size_px));
}

// Whether a neighbour lies on another surface, seen through this pupil.
bool is_edge_pixel(ivec2 at, float dpt) {
    const ivec2 steps[] = ivec2[](ivec2(1, 0), ivec2(-1, 0), ivec2(0, 1), ivec2(0, -1));
    for (int i = 0; i < steps.length(); ++i) {
        ivec2 other = at + steps[i];
        if (!inside(other)) continue;
        float change = abs(pixels[pixel_index(other)].a - dpt) * blur_px_per_dpt;
        if (change > DISCONTINUITY_PX) return true;
    }
    return false;
}

// Kernel of a pixel's cell at a layer position, and the fraction of its interval.
uint kernel_at(ivec2 at, float place, out float fraction) {
    int interval = position_interval(place, layer_count);
    fraction = place - float(interval);
    return kernel_of[cell_of(at) * interval_count(layer_count) + interval];
}

void note_pixel(ivec2 at, uint thread) {
    vec4 pixel = pixels[pixel_index(at)];
    float place = position[pixel_index(at)];
    float fraction;
    uint kernel = kernel_at(at, place, fraction);
    mean[thread] = pixel;
    low[thread] = pixel;
    high[thread] = pixel;
    depth[thread] = vec4(place, place, place, kernel_spread_px(kernel, fraction));
    edge_of[thread] = is_edge_pixel(at, pixel.a) ? 1u : 0u;
}

// Whether a square of four of the level below may be one fragment.  Seen from a blur of
// half the size, a square of the next level looks the same: so does its error.
bool is_similar(ivec2 at, int level, vec4 least, vec4 most, vec4 place) {
    vec3 contrast = most.rgb - least.rgb;
    float largest = max(contrast.r, max(contrast.g, contrast.b));
    float spread = place.w / float(1 << (level - 1));
    float fraction;
    uint kernel = kernel_at(at, place.x, fraction);
    // Neighbouring intervals at most: the kernel of the mean is then one of theirs.
    return spread >= MERGE_MIN_SPREAD_PX
        && floor(place.z) - floor(place.y) <= 1.0
        && largest <= white_level * MERGE_CONTRAST * pow(spread, MERGE_CONTRAST_POWER)
        && (most.a - least.a) * blur_px_per_dpt <= MERGE_MAX_BLUR_STEP_PX
        && kernel_has_level(kernel, level);
}

void try_merging(ivec2 at, uint thread, int level) {
    int half_side = 1 << (level - 1);
    if (any(notEqual(at & (2 * half_side - 1), ivec2(0)))) return;
    uvec4 members = thread + uint(half_side) * uvec4(0u, 1u, TILE_SIZE_PX, TILE_SIZE_PX + 1);
    for (int i = 0; i < int(QUAD); ++i)
        if (level_of[members[i]] != level - 1) return;
    vec4 least = min(min(low[members.x], low[members.y]), min(low[members.z], low[members.w]));
    vec4 most = max(max(high[members.x], high[members.y]),
                    max(high[members.z], high[members.w]));
    vec4 a = depth[members.x], b = depth[members.y], c = depth[members.z], d = depth[members.w];
    vec4 place = vec4((a.x + b.x + c.x + d.x) / QUAD, min(min(a.y, b.y), min(c.y, d.y)),
                      max(max(a.z, b.z), max(c.z, d.z)), min(min(a.w, b.w), min(c.w, d.w)));
    if (!is_similar(at, level, least, most, place)) return;
    mean[thread] = (mean[members.x] + mean[members.y] + mean[members.z] + mean[members.w])
                 / QUAD;
    low[thread] = least;
    high[thread] = most;
    depth[thread] = place;
    edge_of[thread] = edge_of[members.x] | edge_of[members.y] | edge_of[members.z]
                    | edge_of[members.w];
    for (int i = 1; i < int(QUAD); ++i) level_of[members[i]] = -1;
    level_of[thread] = level;
}

// Smaller is nearer.
float sort_depth(ivec2 at, float dpt) {
    if (paper_order == 0) return -dpt;
    float distance_m = dpt > 0.0 ? min(1.0 / dpt, PAPER_FAR_M) : PAPER_FAR_M;
    float scan = float(scan_px.x + at.y * frame_size_px.x + at.x) / float(scan_px.y);
    return distance_m + PAPER_TIE_BREAK_M * scan;
}

Fragment make_fragment(ivec2 at, uint thread) {
    float fraction;
    uint kernel = kernel_at(at, depth[thread].x, fraction);
    return Fragment(mean[thread].rgb, sort_depth(at, mean[thread].a), at, kernel, fraction,
                    kernel_radius_px(kernel), kernel_reach(kernel), level_of[thread],
                    edge_of[thread] != 0u);
}

void main() {
    uint thread = gl_LocalInvocationIndex;
    uint block = gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x;
    if (thread == 0u) {
        alive[0] = 0u;
        alive[1] = 0u;
        largest_reach_bits = 0u;
        block_has_edge = 0u;
        block_merged_count = 0u;
    }
    ivec2 at = ivec2(gl_GlobalInvocationID.xy);
    bool exists = inside(at);
    level_of[thread] = exists ? 0 : -1;
    if (exists) note_pixel(at, thread);
    barrier();  // counters are clear and every pixel is noted before anyone looks
    for (int level = 1; level <= max_level; ++level) {
        try_merging(at, thread, level);
        barrier();  // the level is whole before the next looks at it
    }
    bool keeps = level_of[thread] >= 0;
    uint word = thread / uint(BITS_PER_WORD);
    uint bit = thread % uint(BITS_PER_WORD);
    Fragment fragment;
    uvec4 place = uvec4(0u);
    if (keeps) {
        fragment = make_fragment(at, thread);
        place = pack_place(fragment);
        atomicOr(alive[word], 1u << bit);
        atomicMax(largest_reach_bits, floatBitsToUint(place_reach_px(place)));
        if (fragment.is_edge) atomicOr(block_has_edge, 1u);
        if (fragment.level > 0)
            atomicAdd(block_merged_count, 1u << uint(2 * fragment.level));
    }
    barrier();  // every survivor is counted before slots are given out

    if (keeps) {
        uint before = bitCount(alive[word] & ((1u << bit) - 1u));
        if (word == 1u) before += bitCount(alive[0]);
        uint slot = block * uint(THREADS) + before;
        colors[slot] = vec4(fragment.linear_rgb, fragment.sort_depth);
        places[slot] = place;
    }
    if (thread == 0u) {
        uint count = bitCount(alive[0]) + bitCount(alive[1]);
        blocks[block] = uvec4(count, largest_reach_bits, block_has_edge, block_merged_count);
    }
}

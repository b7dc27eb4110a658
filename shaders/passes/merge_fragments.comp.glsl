// Merges similar pixels 2 x 2 where the blur hides the difference, and packs the
// fragments of each 8 x 8 block, in scan order, to the front of the block's slots.
// In:  PIXELS, PIXEL_LAYER, KERNELS, KERNEL_OF (kernel of a cell and interval).
// Out: FRAGMENT_COLOR, FRAGMENT_PLACE (THREADS slots a block), BLOCKS (count, largest
//      reach bits, has an edge, 0).
// Dispatch: one group a block, one thread a pixel.
// Twin: reference.merge_fragments.  Source: section 6.3 (merging of tiled splatting).

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
uniform int merge_enabled;
uniform ivec2 scan_px;            // of the first pixel, and pixels of the whole frame
uniform int paper_order;          // sort as the paper does: metres plus scan position

shared uint alive[2];             // bit per thread: it keeps a fragment
shared uint largest_reach_bits;   // reach is positive, so its bits order like it
shared uint block_has_edge;
shared float spread_px[THREADS];  // of each pixel's kernel

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

bool quad_is_similar(ivec2 corner) {
    if (merge_enabled == 0 || !inside(corner + 1)) return false;
    ivec2 local = corner & (TILE_SIZE_PX - 1);
    vec4 low = pixels[pixel_index(corner)];
    vec4 high = low;
    float nearest = position[pixel_index(corner)];
    float farthest = nearest;
    float spread = spread_px[local.y * TILE_SIZE_PX + local.x];
    for (int i = 1; i < int(QUAD); ++i) {
        ivec2 step = ivec2(i & 1, i >> 1);
        uint pixel = pixel_index(corner + step);
        low = min(low, pixels[pixel]);
        high = max(high, pixels[pixel]);
        nearest = min(nearest, position[pixel]);
        farthest = max(farthest, position[pixel]);
        spread = min(spread, spread_px[(local.y + step.y) * TILE_SIZE_PX + local.x + step.x]);
    }
    vec3 contrast = high.rgb - low.rgb;
    float largest = max(contrast.r, max(contrast.g, contrast.b));
    // Neighbouring intervals at most: the kernel of the mean is then one of theirs.
    return spread >= MERGE_MIN_SPREAD_PX
        && floor(farthest) - floor(nearest) <= 1.0
        && largest <= white_level * MERGE_CONTRAST * pow(spread, MERGE_CONTRAST_POWER)
        && (high.a - low.a) * blur_px_per_dpt <= MERGE_MAX_BLUR_STEP_PX;
}

vec4 quad_mean(ivec2 corner) {
    return (pixels[pixel_index(corner)] + pixels[pixel_index(corner + ivec2(1, 0))]
          + pixels[pixel_index(corner + ivec2(0, 1))] + pixels[pixel_index(corner + 1)]) / QUAD;
}

float quad_position(ivec2 corner) {
    return (position[pixel_index(corner)] + position[pixel_index(corner + ivec2(1, 0))]
          + position[pixel_index(corner + ivec2(0, 1))] + position[pixel_index(corner + 1)])
         / QUAD;
}

// Smaller is nearer.
float sort_depth(ivec2 at, float dpt) {
    if (paper_order == 0) return -dpt;
    float distance_m = dpt > 0.0 ? min(1.0 / dpt, PAPER_FAR_M) : PAPER_FAR_M;
    float scan = float(scan_px.x + at.y * frame_size_px.x + at.x) / float(scan_px.y);
    return distance_m + PAPER_TIE_BREAK_M * scan;
}

Fragment make_fragment(ivec2 at, vec4 pixel, float place, bool merged, bool edge) {
    float fraction;
    uint kernel = kernel_at(at, place, fraction);
    return Fragment(pixel.rgb, sort_depth(at, pixel.a), at, kernel, fraction,
                    int(kernel_look(kernel).w), kernel_place(kernel).w, merged, edge);
}

void main() {
    uint thread = gl_LocalInvocationIndex;
    uint block = gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x;
    if (thread == 0u) {
        alive[0] = 0u;
        alive[1] = 0u;
        largest_reach_bits = 0u;
        block_has_edge = 0u;
    }
    ivec2 at = ivec2(gl_GlobalInvocationID.xy);
    bool exists = inside(at);
    if (exists) {
        float fraction;
        uint kernel = kernel_at(at, position[pixel_index(at)], fraction);
        spread_px[thread] = kernel_spread_px(kernel, fraction);
    }
    barrier();  // the counters are clear and the spreads known before anyone uses them

    ivec2 corner = at & ~1;
    bool merged = exists && quad_is_similar(corner);
    bool keeps = exists && (!merged || at == corner);
    uint word = thread / uint(BITS_PER_WORD);
    uint bit = thread % uint(BITS_PER_WORD);
    Fragment fragment;
    uvec4 place = uvec4(0u);
    if (keeps) {
        vec4 pixel = merged ? quad_mean(corner) : pixels[pixel_index(at)];
        float place_in_layers = merged ? quad_position(corner) : position[pixel_index(at)];
        bool edge = is_edge_pixel(at, pixels[pixel_index(at)].a);
        fragment = make_fragment(at, pixel, place_in_layers, merged, edge);
        place = pack_place(fragment);
        atomicOr(alive[word], 1u << bit);
        atomicMax(largest_reach_bits, floatBitsToUint(place_reach_px(place)));
        if (edge) atomicOr(block_has_edge, 1u);
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
        blocks[block] = uvec4(count, largest_reach_bits, block_has_edge, 0u);
    }
}

// Adds up the light that a tile's fragments send to each of its pixels.
// In:  FRAGMENT_COLOR, FRAGMENT_PLACE, TILE_COUNTS, TILE_OFFSETS, ENTRIES, KERNELS,
//      the kernel atlas, PIXELS (own colour where no light arrives).
// Out: COLOR_OUT (vec4: linear RGB, mean coverage).
// Dispatch: one group a tile of the band; a thread serves PIXELS_PER_THREAD pixels of a
//      column (8 on a software renderer, where a staged fragment is then read once by
//      one vector of threads; 1 on hardware).
// Variants: PAPER_RULE (alpha-over by weight, as the paper); otherwise coverage: sums of
//      fragments of one depth (to DISCONTINUITY_PX of blur), front to back, each of which
//      shares what the nearer ones leave free: of a surface that another hides in part,
//      no part is taken before the rest.
// Twin: reference.gather.  Source: section 6.1; accumulation DESIGN 4.

#include "common/reach.glsl"
#include "common/fragments.glsl"
#include "common/atlas.glsl"

layout(local_size_x = TILE_SIZE_PX, local_size_y = GROUP_ROWS) in;

layout(std430, binding = BINDING_FRAGMENT_COLOR) readonly buffer Color { vec4 colors[]; };
layout(std430, binding = BINDING_FRAGMENT_PLACE) readonly buffer Place { uvec4 places[]; };
layout(std430, binding = BINDING_TILE_COUNTS) readonly buffer Counts { uvec2 counts[]; };
layout(std430, binding = BINDING_TILE_OFFSETS) readonly buffer Offsets { uint offsets[]; };
layout(std430, binding = BINDING_ENTRIES) readonly buffer Entries { uint entries[]; };
layout(std430, binding = BINDING_KERNELS) readonly buffer Kernels { uvec4 kernels[]; };
layout(std430, binding = BINDING_PIXELS) readonly buffer Pixels { vec4 pixels[]; };
layout(std430, binding = BINDING_COLOR_OUT) writeonly buffer ColorOut { vec4 color_out[]; };

#include "common/kernels.glsl"

uniform ivec2 frame_size_px;
uniform ivec2 tile_grid;
uniform int first_tile;           // of the band
uniform uint first_entry;
uniform float blur_px_per_dpt;    // slope of defocus blur at this pupil
layout(binding = TEXTURE_ATLAS) uniform usampler2D atlas;

const int GROUP_THREADS = THREADS / PIXELS_PER_THREAD;

// Staged fragments: what the pixel loop needs, ready to use.
shared vec4 staged_color[THREADS];    // linear RGB, layer fraction
shared ivec4 staged_box[THREADS];     // first and last pixel that it lights
shared ivec4 staged_kernel[THREADS];  // first texel, row length, scale bits, depth bits

void stage(uint slot, uint at) {
    vec4 color = colors[slot];
    uvec4 place = places[slot];
    uint kernel = place.y & KERNEL_MASK;
    int level = place_level(place);
    int extent = place_extent_px(place);
    Reach reach = unpack_reach(place.w);
    float scale = kernel_scale(kernel, level) / WEIGHT_MAX;
    ivec2 origin = place_origin_px(place);
    ivec2 first = origin - ivec2(reach.left, reach.up);
    staged_color[at] = vec4(color.rgb, place_fraction(place));
    staged_box[at] = ivec4(first, origin + ivec2(reach.right, reach.down) + extent);
    staged_kernel[at] = ivec4(kernel_offset(kernel, level), reach_width(reach) + extent,
                              floatBitsToInt(scale), floatBitsToInt(color.a));
#ifdef PAPER_RULE
    staged_kernel[at].w = level;
#endif
}

// The light of a pixel: of the fragments at one depth, and of those before them.
struct Sum { vec3 light; vec3 coverage; vec3 near_light; vec3 near_coverage; };

// Adds up a depth; its fragments share what nearer ones leave free.
void close_depth(inout Sum sum) {
    vec3 room = 1.0 - sum.near_coverage;
    vec3 share = min(room / max(sum.coverage, vec3(MIN_COVERAGE)), 1.0);
    sum.near_light += share * sum.light;
    sum.near_coverage += share * sum.coverage;
    sum.light = vec3(0.0);
    sum.coverage = vec3(0.0);
}

#ifdef PAPER_RULE
// What the paper's rule leaves of a weight; it merges once: four pixels.
vec3 paper_weight(vec3 weight, vec3 coverage, int level) {
    if (level > 0) {
        vec3 through = 1.0 - min(weight / QUAD, 1.0);
        through *= through;
        weight = 1.0 - through * through;
    }
    return weight * (1.0 - coverage);
}
#endif

void main() {
    int index = first_tile + int(gl_WorkGroupID.x);
    ivec2 tile = ivec2(index % tile_grid.x, index / tile_grid.x);
    ivec2 at = tile * TILE_SIZE_PX
             + ivec2(gl_LocalInvocationID.xy) * ivec2(1, PIXELS_PER_THREAD);
    uint thread = gl_LocalInvocationIndex;
    bool ordered = counts[index].y != 0u;
    uint first = offsets[index] - first_entry;
    uint end = first + counts[index].x;
    float group_depth = ordered && end > first ? colors[entries[first]].a : 0.0;
    Sum sums[PIXELS_PER_THREAD];
    for (int p = 0; p < PIXELS_PER_THREAD; ++p)
        sums[p] = Sum(vec3(0.0), vec3(0.0), vec3(0.0), vec3(0.0));
    for (uint batch = first; batch < end; batch += uint(THREADS)) {
        barrier();  // the last batch is used up
        for (uint i = thread; i < uint(THREADS); i += uint(GROUP_THREADS))
            if (batch + i < end) stage(entries[batch + i], i);
        barrier();  // the new batch is staged
        int staged = int(min(end - batch, uint(THREADS)));
        for (int i = 0; i < staged; ++i) {
            ivec4 box = staged_box[i];
            ivec4 kernel = staged_kernel[i];
            vec4 color = staged_color[i];
            bool in_columns = at.x >= box.x && at.x <= box.z;
#ifndef PAPER_RULE
            float depth = intBitsToFloat(kernel.w);
            if (ordered && (depth - group_depth) * blur_px_per_dpt > DISCONTINUITY_PX) {
                for (int p = 0; p < PIXELS_PER_THREAD; ++p) close_depth(sums[p]);
                group_depth = depth;
            }
#endif
            int texel = kernel.x + (at.y - box.y) * kernel.y + at.x - box.x;
            for (int p = 0; p < PIXELS_PER_THREAD; ++p) {
                bool lit = in_columns && at.y + p >= box.y && at.y + p <= box.w;
                uvec4 ends = texelFetch(atlas, atlas_position(lit ? texel : 0), 0);
                vec3 weight = mix(near_weights(ends), far_weights(ends), color.a);
                weight *= lit ? intBitsToFloat(kernel.z) : 0.0;
#ifdef PAPER_RULE
                weight = paper_weight(weight, sums[p].coverage, kernel.w);
#endif
                sums[p].light += weight * color.rgb;
                sums[p].coverage += weight;
                texel += kernel.y;
            }
        }
    }
    for (int p = 0; p < PIXELS_PER_THREAD; ++p) {
        ivec2 here = at + ivec2(0, p);
        if (any(greaterThanEqual(here, frame_size_px))) continue;
        int pixel = here.y * frame_size_px.x + here.x;
        vec3 own = pixels[pixel].rgb;
        close_depth(sums[p]);
        vec3 coverage = sums[p].near_coverage;
        vec3 normalised = sums[p].near_light / max(coverage, vec3(MIN_COVERAGE));
        vec3 lit = vec3(greaterThanEqual(coverage, vec3(MIN_COVERAGE)));
        color_out[pixel] = vec4(mix(own, normalised, lit),
                                dot(coverage, vec3(1.0 / float(RGB))));
    }
}

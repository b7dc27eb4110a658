// Merges similar pixels where the blur hides the difference: 2 x 2, then 4 x 4, then the
// whole block.  Packs the fragments of each 8 x 8 block, in scan order, to the front of
// the block's slots.  One surface per dispatch; surfaces never merge with each other.
// The hidden surface makes fragments only where an edge of the visible one is in reach.
// In:  PIXELS, PIXEL_LAYER, KERNELS, KERNEL_OF (kernel of a cell and interval), PLAN,
//      BLOCK_LIGHT; for the hidden surface, BLOCKS of the visible one.
// Out: FRAGMENT_COLOR, FRAGMENT_PLACE, FRAGMENT_EDGE (THREADS slots per block), BLOCKS
//      (count, largest reach bits, order matters, pixels merged), STATS (fragments, pixels
//      merged).
// Dispatch: one group per block, one thread per quad of pixels.
// Twin: tests/numerical/test_peripheral_merging.py.  Source: section 6.3 (merging of tiled
// splatting), which merges one level.

layout(local_size_x = QUADS) in;

layout(std430, binding = BINDING_PIXELS) readonly buffer Pixels { vec4 pixels[]; };
layout(std430, binding = BINDING_PIXEL_LAYER) readonly buffer Position { float position[]; };
layout(std430, binding = BINDING_KERNELS) readonly buffer Kernels { uvec4 kernels[]; };
layout(std430, binding = BINDING_KERNEL_OF) readonly buffer KernelOf { uint kernel_of[]; };
layout(std430, binding = BINDING_FRAGMENT_COLOR) writeonly buffer Color { vec4 colors[]; };
layout(std430, binding = BINDING_FRAGMENT_PLACE) writeonly buffer Place { uvec4 places[]; };
layout(std430, binding = BINDING_FRAGMENT_EDGE) writeonly buffer Edge { vec2 edges[]; };
layout(std430, binding = BINDING_BLOCK_LIGHT) readonly buffer Light { vec4 block_light[]; };
layout(std430, binding = BINDING_BLOCKS) buffer Blocks { uvec4 blocks[]; };
layout(std430, binding = BINDING_STATS) buffer Stats { uint stats[]; };
layout(std430, binding = BINDING_PLAN) readonly buffer Plan { uint plan[]; };

#include "common/layers.glsl"
#include "common/cells.glsl"
#include "common/kernels.glsl"
#include "common/reach.glsl"
#include "common/fragments.glsl"
#include "common/detection.glsl"

uniform ivec2 frame_size_px;
uniform int layer_count;
uniform float blur_px_per_dpt;    // slope of defocus blur at this pupil
uniform float white_level;
uniform int is_encoded;           // for a display, where dark parts need finer steps
uniform float tolerance;          // merging error relative to the default
uniform int max_level;            // 0: no merging
uniform ivec2 scan_px;            // index of the first pixel, pixels of the whole frame
uniform int paper_order;          // sort as in the paper: meters plus scan position
uniform int surface;              // 0: visible, 1: hidden

float gain = 1.0;                 // of the block's limits, away from the gaze

shared uint alive[2];             // bit per pixel of the block: it has a fragment
shared uint largest_reach_bits;   // reach is positive, so its bits are ordered like it
shared uint block_has_edge;
shared uint block_merged_count;
shared uint edge_in_reach;
shared vec3 usual_light;          // above which a pixel's light is in excess
// The merged square whose first quad is the thread's.
shared int level_of[QUADS];       // 0: single pixels; -1: the quad is part of another square
shared vec4 mean[QUADS];          // linear RGB, dpt
shared vec4 low[QUADS];
shared vec4 high[QUADS];
shared vec4 positions[QUADS];     // in layers: mean, nearest, farthest; least spread px
shared float edge_of[QUADS];      // mean strength or coverage

// Pixels of the thread's quad.
vec4 values[int(QUAD)];           // linear RGB, dpt
float edges_of[int(QUAD)];        // strength or coverage (common/fragments.glsl)

uint pixel_index(ivec2 at) {
    return uint((surface * frame_size_px.y + at.y) * frame_size_px.x + at.x);
}

bool inside(ivec2 at) {
    return all(greaterThanEqual(at, ivec2(0))) && all(lessThan(at, frame_size_px));
}

// How far a change of blur exceeds that of a continuous surface: 0 to 1.
float beyond_surface(float change_dpt) {
    return clamp(change_dpt * blur_px_per_dpt / DISCONTINUITY_PX - 1.0, 0.0, 1.0);
}

// How clearly a neighbor lies on another surface, as seen through this pupil.
float edge_strength(ivec2 at, float dpt) {
    const ivec2 steps[] = ivec2[](ivec2(1, 0), ivec2(-1, 0), ivec2(0, 1), ivec2(0, -1));
    float most_dpt = 0.0;
    for (int i = 0; i < steps.length(); ++i) {
        ivec2 other = at + steps[i];
        if (inside(other))
            most_dpt = max(most_dpt, abs(pixels[pixel_index(other)].a - dpt));
    }
    float strength = beyond_surface(most_dpt);
    return strength * strength;
}

// Coverage of a hidden pixel: 0 where it is so close to the surface in front of it that the
// two would blur alike.
float hidden_coverage(ivec2 at, float dpt) {
    float seen_dpt = pixels[uint(at.y * frame_size_px.x + at.x)].a;
    return dpt < 0.0 ? 0.0 : beyond_surface(seen_dpt - dpt);
}

// Finds the light that is usual around a block: a multiple of the mean over 3 x 3 blocks.
void find_usual_light(ivec2 block, ivec2 grid) {
    vec4 sum = vec4(0.0);
    ivec2 last = min(block + 1, grid - 1);
    for (int y = max(block.y - 1, 0); y <= last.y; ++y)
        for (int x = max(block.x - 1, 0); x <= last.x; ++x)
            sum += block_light[y * grid.x + x];
    usual_light = EXCESS_RATIO * sum.rgb / sum.a;
}

// Kernel of a pixel's cell at a layer position, and the fraction of its interval.
uint kernel_at(ivec2 at, float place, out float fraction) {
    int interval = position_interval(place, layer_count);
    fraction = place - float(interval);
    return kernel_of[cell_of(at) * interval_count(layer_count) + interval];
}

// Reads the quad's pixels; returns bits of those that make fragments.
uint read_pixels(ivec2 at) {
    uint held = 0u;
    for (int i = 0; i < int(QUAD); ++i) {
        ivec2 member = at + ivec2(i & 1, i >> 1);
        if (!inside(member) || (surface != 0 && edge_in_reach == 0u)) continue;
        vec4 value = pixels[pixel_index(member)];
        float edge = surface == 0 ? edge_strength(member, value.a)
                                  : hidden_coverage(member, value.a);
        if (surface != 0 && paper_order == 0) value.rgb *= edge;
        values[i] = value;
        edges_of[i] = edge;
        if (surface == 0 || edge > 0.0) held |= 1u << uint(i);
    }
    return held;
}

// Records whether an edge of the visible surface is so close that light from this hidden
// block may pass it.
void find_edge(ivec2 block, ivec2 grid, uint thread) {
    float largest_reach_px = float(plan[PLAN_REACH]) + REACH_MARGIN_PX;
    int search = 2 * (int(largest_reach_px) / TILE_SIZE_PX + 1);
    int width = 2 * search + 1;
    for (int i = int(thread); i < width * width; i += QUADS) {
        ivec2 other = block - search + ivec2(i % width, i / width);
        if (any(lessThan(other, ivec2(0))) || any(greaterThanEqual(other, grid))) continue;
        uvec4 seen = blocks[other.y * grid.x + other.x];
        float reach = uintBitsToFloat(seen.y) + largest_reach_px;
        ivec2 gap = max(abs(other - block) * TILE_SIZE_PX - (TILE_SIZE_PX - 1), 0);
        if (seen.z != 0u && float(gap.x * gap.x + gap.y * gap.y) <= reach * reach)
            atomicOr(edge_in_reach, 1u);
    }
}

// Difference of light; if the image will be encoded, the equivalent difference in a
// midtone.
vec3 seen_contrast(vec3 least, vec3 most) {
    if (is_encoded == 0) return most - least;
    vec3 light = 0.5 * (least + most) / (MERGE_MIDTONE * white_level);
    return (most - least) / sqrt(clamp(light, MERGE_DARKEST, 1.0));
}

// Whether four squares of the level below may become one fragment.  Relative to a blur of
// twice the size, a square of the next level is the same, and so is its error.
bool is_similar(ivec2 at, int level, vec4 least, vec4 most, vec4 place) {
    float spread = place.w / float(1 << (level - 1));
    vec3 contrast = seen_contrast(least.rgb, most.rgb);
    float largest = max(contrast.r, max(contrast.g, contrast.b));
    float fraction;
    uint kernel = kernel_at(at, place.x, fraction);
    // At most neighboring intervals, so that the kernel of the mean is one of theirs.
    return spread >= smallest_spread_px(gain)
        && floor(place.z) - floor(place.y) <= 1.0
        && largest <= gain * tolerance * white_level * MERGE_CONTRAST
                      * pow(spread, MERGE_CONTRAST_POWER)
        && (most.a - least.a) * blur_px_per_dpt
           <= gain * tolerance * max(MERGE_MAX_BLUR_STEP_PX, MERGE_MAX_BLUR_RATIO * place.w)
        && kernel_has_level(kernel, level);
}

// Position of a pixel, three times, and the spread of its kernel.
vec4 pixel_place(ivec2 at) {
    float place = position[pixel_index(at)];
    float fraction;
    uint kernel = kernel_at(at, place, fraction);
    return vec4(place, place, place, kernel_spread_px(kernel, fraction));
}

// Adds a member to the sum, the extremes and the positions of a square.
void take_in(vec4 value, vec4 least, vec4 most, vec4 place, bool is_first, inout vec4 sum,
             inout vec4 all_least, inout vec4 all_most, inout vec4 all_places) {
    sum = is_first ? value : sum + value;
    all_least = is_first ? least : min(all_least, least);
    all_most = is_first ? most : max(all_most, most);
    all_places = is_first ? place
               : vec4(all_places.x + place.x, min(all_places.y, place.y),
                      max(all_places.z, place.z), min(all_places.w, place.w));
}

void keep_square(uint quad, int level, vec4 sum, vec4 least, vec4 most, vec4 place, float edge) {
    mean[quad] = sum / QUAD;
    low[quad] = least;
    high[quad] = most;
    positions[quad] = place;
    edge_of[quad] = edge / QUAD;
    level_of[quad] = level;
}

// Merges the thread's own quad, if all its pixels exist and are alike.
void merge_pixels(ivec2 at, uint quad, uint held) {
    level_of[quad] = 0;
    if (max_level == 0 || held != (1u << uint(QUAD)) - 1u) return;
    float edge = 0.0;
    vec4 sum, least, most, place;
    for (int i = 0; i < int(QUAD); ++i) {
        ivec2 member = at + ivec2(i & 1, i >> 1);
        take_in(values[i], values[i], values[i], pixel_place(member), i == 0, sum, least, most,
                place);
        edge += edges_of[i];
    }
    place.x /= QUAD;
    if (is_similar(at, 1, least, most, place))
        keep_square(quad, 1, sum, least, most, place, edge);
}

// Merges four squares of the level below, the first of which starts at this quad.
void merge_squares(ivec2 at, uint quad, int level) {
    uint side = 1u << uint(level - 2);
    float edge = 0.0;
    vec4 sum, least, most, place;
    uvec4 members = quad + side * uvec4(0u, 1u, QUADS_ACROSS, QUADS_ACROSS + 1);
    for (int i = 0; i < int(QUAD); ++i) {
        uint m = members[i];
        if (level_of[m] != level - 1) return;
        take_in(mean[m], low[m], high[m], positions[m], i == 0, sum, least, most, place);
        edge += edge_of[m];
    }
    place.x /= QUAD;
    if (!is_similar(at, level, least, most, place)) return;
    for (int i = 1; i < int(QUAD); ++i) level_of[members[i]] = -1;
    keep_square(quad, level, sum, least, most, place, edge);
}

// Smaller is nearer.
float sort_depth(ivec2 at, float dpt) {
    if (paper_order == 0) return -dpt;
    float distance_m = dpt > 0.0 ? min(1.0 / dpt, PAPER_FAR_M) : PAPER_FAR_M;
    float scan = float(scan_px.x + at.y * frame_size_px.x + at.x) / float(scan_px.y);
    return distance_m + PAPER_TIE_BREAK_M * scan;
}

Fragment make_fragment(ivec2 at, vec4 value, float place, int level, float edge) {
    float fraction;
    uint kernel = kernel_at(at, place, fraction);
    vec3 excess = max(value.rgb - usual_light * (surface == 0 ? 1.0 : edge), 0.0);
    return Fragment(value.rgb, sort_depth(at, value.a), at, kernel, fraction,
                    kernel_radius_px(kernel), kernel_reach(kernel), level,
                    vec2(edge, dot(excess, vec3(1.0 / float(RGB)))));
}

// Bit of a pixel within the words of `alive`.
uint pixel_bit(ivec2 local) {
    return uint(local.y * TILE_SIZE_PX + local.x);
}

void note_survivor(uint bit, float edge) {
    atomicOr(alive[bit / uint(BITS_PER_WORD)], 1u << (bit % uint(BITS_PER_WORD)));
    if (edge > 0.0) block_has_edge = 1u;
}

void write_fragment(uint block, uint bit, Fragment fragment) {
    uint word = bit / uint(BITS_PER_WORD);
    uint before = bitCount(alive[word] & ((1u << (bit % uint(BITS_PER_WORD))) - 1u));
    if (word == 1u) before += bitCount(alive[0]);
    uint slot = block * uint(THREADS) + before;
    uvec4 place = pack_place(fragment);
    colors[slot] = vec4(fragment.linear_rgb, fragment.sort_depth);
    places[slot] = place;
    edges[slot] = fragment.edge;
    atomicMax(largest_reach_bits, floatBitsToUint(place_reach_px(place)));
}

void main() {
    uint quad = gl_LocalInvocationIndex;
    ivec2 grid = ivec2(gl_NumWorkGroups.xy);
    ivec2 block_at = ivec2(gl_WorkGroupID.xy);
    uint block = uint((surface * grid.y + block_at.y) * grid.x + block_at.x);
    gain = block_gain(block_at, vec2(frame_size_px));
    if (quad == 0u) {
        alive[0] = 0u;
        alive[1] = 0u;
        largest_reach_bits = 0u;
        block_has_edge = 0u;
        block_merged_count = 0u;
        edge_in_reach = 0u;
        find_usual_light(block_at, grid);
    }
    barrier();  // the shared counters are clear, and the usual light is known
    if (surface != 0) {
        find_edge(block_at, grid, quad);
        barrier();  // all surrounding blocks have been searched
    }
    ivec2 local = 2 * ivec2(quad % uint(QUADS_ACROSS), quad / uint(QUADS_ACROSS));
    ivec2 at = block_at * TILE_SIZE_PX + local;
    uint held = read_pixels(at);  // a bit for each of the quad's pixels
    merge_pixels(at, quad, held);
    barrier();  // all quads are decided before they are read
    for (int level = 2; level <= max_level; ++level) {
        if (all(equal(local & ((1 << level) - 1), ivec2(0)))) merge_squares(at, quad, level);
        barrier();  // the level is complete before the next one reads it
    }
    int level = level_of[quad];
    if (level > 0) {
        note_survivor(pixel_bit(local), edge_of[quad]);
        atomicAdd(block_merged_count, 1u << uint(2 * level));
    }
    for (int i = 0; i < int(QUAD); ++i) {
        ivec2 step = ivec2(i & 1, i >> 1);
        if (level == 0 && (held & (1u << uint(i))) != 0u)
            note_survivor(pixel_bit(local + step), edges_of[i]);
    }
    barrier();  // every survivor is counted before slots are assigned

    if (level > 0)
        write_fragment(block, pixel_bit(local),
                       make_fragment(at, mean[quad], positions[quad].x, level, edge_of[quad]));
    for (int i = 0; i < int(QUAD); ++i) {
        ivec2 step = ivec2(i & 1, i >> 1);
        if (level == 0 && (held & (1u << uint(i))) != 0u)
            write_fragment(block, pixel_bit(local + step),
                           make_fragment(at + step, values[i], position[pixel_index(at + step)],
                                         0, edges_of[i]));
    }
    barrier();  // the largest reach is known
    if (quad == 0u) {
        uint count = bitCount(alive[0]) + bitCount(alive[1]);
        blocks[block] = uvec4(count, largest_reach_bits, block_has_edge, block_merged_count);
        uint lane = block % uint(STAT_LANES) * uint(STAT_WORDS);
        atomicAdd(stats[lane + uint(STAT_FRAGMENTS)], count);
        atomicAdd(stats[lane + uint(STAT_MERGED)], block_merged_count);
    }
}

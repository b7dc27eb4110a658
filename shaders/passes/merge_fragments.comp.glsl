// Merges similar pixels where the blur hides the difference: 2 x 2, then 4 x 4, then the
// whole block.  Packs the fragments of each 8 x 8 block, in scan order, to the front of
// the block's slots.  One surface per dispatch; surfaces never merge with each other.
// The members of a square that just fails to merge are moved toward its mean, so that the
// frame does not jump when it merges.
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
uniform int bright_pixels;        // 0: no light is in excess

float gain = 1.0;                 // of the block's limits, away from the gaze

shared uint alive[2];             // bit per pixel of the block: it has a fragment
shared uint largest_reach_bits;   // reach is positive, so its bits are ordered like it
shared uint block_has_edge;
shared uint block_merged_count;
shared uint edge_in_reach;
shared vec3 usual_light;          // above which a pixel's light is in excess
// Squares of all levels: quads, their squares, the block.
const int SQUARES = QUADS + QUADS / int(QUAD) + 1;
shared uint merges[SQUARES];      // whether the square is one fragment
shared float fade[SQUARES];       // share by which members move to the mean; -1 if one of
                                  // them does not exist
shared vec4 mean[SQUARES];        // linear RGB, dpt
shared vec4 low[SQUARES];
shared vec4 high[SQUARES];
shared vec4 positions[SQUARES];   // in layers: mean, nearest, farthest; least spread px
shared float edge_of[SQUARES];    // mean strength or coverage

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

// Largest step of vergence from pixel i of the quad at `at` to its neighbors: the two in the
// quad, and those on the other sides.
float largest_step_dpt(ivec2 at, int i) {
    float dpt = values[i].a;
    float most = 0.0;
    for (int axis = 0; axis < 2; ++axis) {
        int bit = 1 << axis;
        ivec2 outward = ivec2(0);
        outward[axis] = (i & bit) != 0 ? 1 : -1;
        ivec2 other = at + ivec2(i & 1, i >> 1) + outward;
        if (inside(at + ivec2(i & 1, i >> 1) - outward))
            most = max(most, abs(values[i ^ bit].a - dpt));
        if (inside(other)) most = max(most, abs(pixels[pixel_index(other)].a - dpt));
    }
    return most;
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

// Kernel of a pixel's cell at an interval of layers.
uint kernel_in(ivec2 at, int interval) {
    return kernel_of[cell_of(at) * interval_count(layer_count) + interval];
}

// Reads the quad's pixels; returns bits of those that make fragments.
uint read_pixels(ivec2 at) {
    uint held = 0u;
    for (int i = 0; i < int(QUAD); ++i) {
        ivec2 member = at + ivec2(i & 1, i >> 1);
        edges_of[i] = 0.0;
        if (!inside(member) || (surface != 0 && edge_in_reach == 0u)) continue;
        values[i] = pixels[pixel_index(member)];
        if (surface != 0) edges_of[i] = hidden_coverage(member, values[i].a);
        if (surface == 0 || edges_of[i] > 0.0) held |= 1u << uint(i);
    }
    for (int i = 0; i < int(QUAD); ++i) {
        if (surface == 0) {
            float strength = beyond_surface(largest_step_dpt(at, i));
            edges_of[i] = strength * strength;
        } else if (paper_order == 0) values[i].rgb *= edges_of[i];
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

// 1 where a value is at most its limit; 0 where it is beyond by a part of the limit.
float share_within(float value, float limit) {
    float width = max(MERGE_FADE_RATIO * abs(limit), MIN_BLUR_RANGE);
    return clamp(1.0 - (value - limit) / width, 0.0, 1.0);
}

// Whether all positions lie in neighboring intervals, so that the kernel of any position
// between them is one of theirs.
bool are_neighbors(vec4 place) { return floor(place.z) - floor(place.y) <= 1.0; }

// 1 where four squares of the level below are so alike that they may become one fragment;
// 0 where they clearly are not.  Relative to a blur of twice the size, a square of the next
// level is the same, and so is its error.
float similarity(int level, vec4 least, vec4 most, vec4 place) {
    float spread = place.w / float(1 << (level - 1));
    vec3 contrast = seen_contrast(least.rgb, most.rgb);
    float largest = max(contrast.r, max(contrast.g, contrast.b));
    float most_contrast = gain * tolerance * white_level * MERGE_CONTRAST
                        * pow(spread, MERGE_CONTRAST_POWER);
    float most_step = gain * tolerance
                    * max(MERGE_MAX_BLUR_STEP_PX, MERGE_MAX_BLUR_RATIO * place.w);
    float share = share_within(-spread, -smallest_spread_px(gain));
    share = min(share, share_within(largest, most_contrast));
    share = min(share, share_within((most.a - least.a) * blur_px_per_dpt, most_step));
    return paper_order == 0 ? share : floor(share);
}

// Position of a pixel, three times, and the spread of its kernel.
vec4 pixel_place(ivec2 at) {
    float place = position[pixel_index(at)];
    int interval = position_interval(place, layer_count);
    float spread_px = kernel_spread_px(kernel_in(at, interval), place - float(interval));
    return vec4(place, place, place, spread_px);
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

// Index of the square of a level at a pixel of the block.
int square_of(ivec2 local, int level) {
    int first = level == 1 ? 0 : level == 2 ? QUADS : SQUARES - 1;
    return first + (local.y >> level) * (TILE_SIZE_PX >> level) + (local.x >> level);
}

// Decides about a square of four members, by the smallest of their shares and whether all
// of them are single fragments.
void keep_square(ivec2 at, int square, int level, float share, bool are_single, vec4 sum,
                 vec4 least, vec4 most, vec4 place, float edge) {
    place.x = clamp(place.x / QUAD, place.y, place.z);
    mean[square] = sum / QUAD;
    low[square] = least;
    high[square] = most;
    positions[square] = place;
    edge_of[square] = edge / QUAD;
    share *= similarity(level, least, most, place);
    fade[square] = share;
    int interval = position_interval(place.x, layer_count);
    bool is_alike = share == 1.0 && are_single && are_neighbors(place);
    merges[square] = is_alike && kernel_has_level(kernel_in(at, interval), level) ? 1u : 0u;
}

// Merges the thread's own quad, if all its pixels exist and are alike.
void merge_pixels(ivec2 at, int quad, uint held) {
    merges[quad] = 0u;
    fade[quad] = -1.0;
    if (max_level == 0 || held != (1u << uint(QUAD)) - 1u) return;
    float edge = 0.0;
    vec4 sum, least, most, place;
    for (int i = 0; i < int(QUAD); ++i) {
        ivec2 member = at + ivec2(i & 1, i >> 1);
        take_in(values[i], values[i], values[i], pixel_place(member), i == 0, sum, least, most,
                place);
        edge += edges_of[i];
    }
    keep_square(at, quad, 1, 1.0, true, sum, least, most, place, edge);
}

// Merges four squares of the level below, the first of which starts at this quad.
void merge_squares(ivec2 at, ivec2 local, int level) {
    float edge = 0.0;
    float share = 1.0;
    uint single = 1u;
    vec4 sum, least, most, place;
    for (int i = 0; i < int(QUAD); ++i) {
        ivec2 step = ivec2(i & 1, i >> 1) << (level - 1);
        int m = square_of(local + step, level - 1);
        take_in(mean[m], low[m], high[m], positions[m], i == 0, sum, least, most, place);
        edge += edge_of[m];
        share = min(share, fade[m]);
        single &= merges[m];
    }
    int square = square_of(local, level);
    merges[square] = 0u;
    fade[square] = -1.0;
    if (share >= 0.0)
        keep_square(at, square, level, share, single != 0u, sum, least, most, place, edge);
}

// Level of the fragment that a quad starts; 0: single pixels; -1: it is part of another.
int fragment_level(ivec2 local) {
    int level = 0;
    for (int i = 1; i <= max_level; ++i)
        if (merges[square_of(local, i)] != 0u) level = i;
    bool is_first = all(equal(local & ((1 << level) - 1), ivec2(0)));
    return is_first ? level : -1;
}

// How the squares around a fragment move it to their means: its values times `kept`, plus
// the rest.
struct Approach { float kept; vec4 value; float place; float edge; vec2 range; bool is_near; };

Approach find_approach(ivec2 local, int level) {
    Approach all = Approach(1.0, vec4(0.0), 0.0, 0.0, vec2(0.0), true);
    for (int i = level + 1; i <= max_level; ++i) {
        int square = square_of(local, i);
        float share = fade[square];
        if (share <= 0.0) continue;
        vec4 place = positions[square];
        all.kept *= 1.0 - share;
        all.value = mix(all.value, mean[square], share);
        all.place = mix(all.place, place.x, share);
        all.edge = mix(all.edge, edge_of[square], share);
        all.range = place.yz;
        all.is_near = are_neighbors(place);
    }
    return all;
}

// Smaller is nearer.
float sort_depth(ivec2 at, float dpt) {
    if (paper_order == 0) return -dpt;
    float distance_m = dpt > 0.0 ? min(1.0 / dpt, PAPER_FAR_M) : PAPER_FAR_M;
    float scan = float(scan_px.x + at.y * frame_size_px.x + at.x) / float(scan_px.y);
    return distance_m + PAPER_TIE_BREAK_M * scan;
}

// A fragment as its square moves it.  Its kernel is that of an interval in which a member of
// the square lies: others have none, if no pixel uses them.
Fragment make_fragment(ivec2 at, vec4 value, float place, int level, float edge,
                       Approach approach) {
    int interval = position_interval(place, layer_count);
    if (approach.kept < 1.0) {
        value = approach.kept * value + approach.value;
        edge = approach.kept * edge + approach.edge;
        place = clamp(approach.kept * place + approach.place, approach.range.x,
                      approach.range.y);
        if (approach.is_near) interval = position_interval(place, layer_count);
    }
    float fraction = clamp(place - float(interval), 0.0, 1.0);
    uint kernel = kernel_in(at, interval);
    vec3 excess = bright_pixels == 0 ? vec3(0.0)
        : max(value.rgb - usual_light * (surface == 0 ? 1.0 : edge), 0.0);
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
    merge_pixels(at, int(quad), held);
    barrier();  // all quads are decided before they are read
    for (int level = 2; level <= max_level; ++level) {
        if (all(equal(local & ((1 << level) - 1), ivec2(0)))) merge_squares(at, local, level);
        barrier();  // the level is complete before the next one reads it
    }
    int level = fragment_level(local);
    int square = square_of(local, max(level, 1));
    if (level > 0) {
        // The square takes the place of its first pixel.
        held = 1u;
        values[0] = mean[square];
        edges_of[0] = edge_of[square];
        atomicAdd(block_merged_count, 1u << uint(2 * level));
    }
    if (level < 0) held = 0u;
    for (int i = 0; i < int(QUAD); ++i) {
        ivec2 step = ivec2(i & 1, i >> 1);
        if ((held & (1u << uint(i))) != 0u)
            note_survivor(pixel_bit(local + step), edges_of[i]);
    }
    barrier();  // every survivor is counted before slots are assigned

    Approach approach = find_approach(local, max(level, 0));
    for (int i = 0; i < int(QUAD); ++i) {
        ivec2 step = ivec2(i & 1, i >> 1);
        if ((held & (1u << uint(i))) == 0u) continue;
        float place = level > 0 ? positions[square].x : position[pixel_index(at + step)];
        write_fragment(block, pixel_bit(local + step),
                       make_fragment(at + step, values[i], place, max(level, 0), edges_of[i],
                                     approach));
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

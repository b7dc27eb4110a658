// Accumulates the light that a tile's fragments send to each of its pixels: reads the list
// of the tile's bin, stages the fragments that reach the tile, and evaluates them.
// In:  FRAGMENT_COLOR, FRAGMENT_PLACE, BIN_COUNTS, BIN_OFFSETS, ENTRIES, KERNELS,
//      the kernel atlas, PIXELS (own color where no light arrives).
// Out: COLOR_OUT (vec4: linear RGB, mean coverage).
// Dispatch: (tiles of a bin, bins of the band) groups; a thread computes PIXELS_PER_THREAD
//      pixels of a column: 8 on a software renderer, where a staged fragment is then read
//      once by one vector of threads; 2 on hardware, where a tile is one warp.
// Variants: FRAGMENTS_A_TURN fragments whose weights are fetched together; PAPER_RULE
//      (alpha-over by weight, as in the paper), otherwise coverage: fragments of one depth
//      (to DISCONTINUITY_PX of blur) are summed, front to back, and share the coverage
//      that nearer ones leave free, so that no part of a partly hidden surface is
//      accumulated before the rest.
// Twin: reference.gather.
// Source: Csoba & Kunkli 2023, section 6.1; accumulation as in shaders/README.md.

#include "common/reach.glsl"
#include "common/fragments.glsl"
#include "common/atlas.glsl"

layout(local_size_x = TILE_SIZE_PX, local_size_y = GROUP_ROWS) in;

layout(std430, binding = BINDING_FRAGMENT_COLOR) readonly buffer Color { vec4 colors[]; };
layout(std430, binding = BINDING_FRAGMENT_PLACE) readonly buffer Place { uvec4 places[]; };
layout(std430, binding = BINDING_BIN_COUNTS) readonly buffer Counts { uvec4 counts[]; };
layout(std430, binding = BINDING_BIN_OFFSETS) readonly buffer Offsets { uint offsets[]; };
layout(std430, binding = BINDING_ENTRIES) readonly buffer Entries { uint entries[]; };
layout(std430, binding = BINDING_KERNELS) readonly buffer Kernels { uvec4 kernels[]; };
layout(std430, binding = BINDING_PIXELS) readonly buffer Pixels { vec4 pixels[]; };
layout(std430, binding = BINDING_COLOR_OUT) writeonly buffer ColorOut { vec4 color_out[]; };

#include "common/kernels.glsl"

uniform ivec2 frame_size_px;
uniform ivec2 tile_grid;
uniform int bin_columns;
uniform int first_bin;            // of the band
uniform float blur_px_per_dpt;    // slope of defocus blur at this pupil
#ifdef ATLAS_IS_BUFFER
layout(std430, binding = BINDING_ATLAS) readonly buffer Atlas { uvec4 atlas[]; };
#else
layout(binding = TEXTURE_ATLAS) uniform usampler2D atlas;
#endif

const int GROUP_THREADS = THREADS / PIXELS_PER_THREAD;
const int ENTRIES_PER_THREAD = BATCH / GROUP_THREADS;

// Staged fragments: the data of the pixel loop, in as few words as possible, because each
// word read costs a tenth of an evaluation on a software renderer.
shared vec4 staged_color[BATCH];      // linear RGB, multiplied by the scale of the weights
                                      // except for the paper's rule; layer fraction
shared uvec4 staged_mark[BATCH];      // x: lit columns and rows of the tile, a bit each;
                                      // level; length of the kernel's rows.  y: texel of
                                      // the tile's first pixel, as if lit.  z, w: bits of
                                      // the scale and the depth.  Before staging x is the
                                      // slot: with little shared memory many groups can
                                      // run at once
shared uint hits[HIT_WORDS];          // bit per entry of the batch: it reaches the tile

const int ROWS_SHIFT = TILE_SIZE_PX;
const int SHAPE_LEVEL_SHIFT = 2 * TILE_SIZE_PX;
const int WIDTH_SHIFT = SHAPE_LEVEL_SHIFT + 2;

// Bits first to last, clipped to those of a tile.
uint bits_between(int first, int last) {
    uint until = (2u << uint(min(last, TILE_SIZE_PX - 1))) - 1u;
    return until & ~((1u << uint(max(first, 0))) - 1u);
}

// Stages a fragment whose box meets the tile.
void stage(uint slot, int at, ivec2 tile_first) {
    vec4 color = colors[slot];
    uvec4 place = places[slot];
    uint kernel = place.y & KERNEL_MASK;
    int level = place_level(place);
    int extent = place_extent_px(place);
    Reach reach = unpack_reach(place.w);
    int width = reach_width(reach) + extent;
    ivec2 origin = place_origin_px(place) - tile_first;
    ivec2 first = origin - ivec2(reach.left, reach.up);
    ivec2 last = origin + ivec2(reach.right, reach.down) + extent;
    uint columns = bits_between(first.x, last.x);
    uint rows = bits_between(first.y, last.y);
    float scale = kernel_scale(kernel, level) / WEIGHT_MAX;
#ifdef PAPER_RULE
    vec3 light = color.rgb;
#else
    vec3 light = color.rgb * scale;
#endif
    staged_color[at] = vec4(light, place_fraction(place));
    uint shape = columns | (rows << uint(ROWS_SHIFT))
               | (uint(level) << uint(SHAPE_LEVEL_SHIFT)) | (uint(width) << uint(WIDTH_SHIFT));
    int texel = int(kernel_offset(kernel, level)) - first.y * width - first.x;
    staged_mark[at] = uvec4(shape, uint(texel), floatBitsToUint(scale), floatBitsToUint(color.a));
}

float staged_depth(int at) { return uintBitsToFloat(staged_mark[at].w); }

// Bits, from 0 on, of this thread's entries of a batch that reach the tile.
uint find_hits(uint first, uint end, uint tile_bit) {
    uint found = 0u;
    for (uint i = 0u; i < uint(ENTRIES_PER_THREAD); ++i) {
        bool hit = first + i < end && (entries[first + i] & tile_bit) != 0u;
        found |= hit ? 1u << i : 0u;
    }
    return found;
}

// Number of fragments of the batch before an entry.
uint rank_of(uint entry) {
    uint word = entry / uint(BITS_PER_WORD);
    uint rank = bitCount(hits[word] & ((1u << (entry % uint(BITS_PER_WORD))) - 1u));
    for (uint before = 0u; before < word; ++before) rank += bitCount(hits[before]);
    return rank;
}

int hit_count() {
    int count = 0;
    for (int word = 0; word < HIT_WORDS; ++word) count += bitCount(hits[word]);
    return count;
}

// Stages the fragments of a batch that reach the tile, in order; returns their number.
int stage_batch(uint batch, uint end, uint tile_bit, ivec2 tile_first) {
    uint mine = gl_LocalInvocationIndex * uint(ENTRIES_PER_THREAD);
    uint found = find_hits(batch + mine, end, tile_bit);
    if (gl_LocalInvocationIndex < uint(HIT_WORDS)) hits[gl_LocalInvocationIndex] = 0u;
    barrier();  // the last batch is done, and the bits are clear
    atomicOr(hits[mine / uint(BITS_PER_WORD)], found << (mine % uint(BITS_PER_WORD)));
    barrier();  // all hits are known
    uint at = rank_of(mine);
    for (uint i = 0u; i < uint(ENTRIES_PER_THREAD); ++i)
        if ((found & (1u << i)) != 0u)
            staged_mark[at++].x = entries[batch + mine + i] >> uint(TILES_PER_BIN);
    int count = hit_count();
    barrier();  // the fragments of the new batch are known
    for (int i = int(gl_LocalInvocationIndex); i < count; i += GROUP_THREADS)
        stage(staged_mark[i].x, i, tile_first);
    barrier();  // and staged
    return count;
}

// The light of a pixel: of the fragments at the current depth, and of nearer ones.
struct Sum { vec3 light; vec3 coverage; vec3 near_light; vec3 near_coverage; };

// Adds a depth to the total; its fragments share the coverage that nearer ones leave free.
void close_depth(inout Sum sum) {
    vec3 room = 1.0 - sum.near_coverage;
    vec3 share = min(room / max(sum.coverage, vec3(MIN_COVERAGE)), 1.0);
    sum.near_light += share * sum.light;
    sum.near_coverage += share * sum.coverage;
    sum.light = vec3(0.0);
    sum.coverage = vec3(0.0);
}

// Whether a fragment is behind the current depth.
bool is_beyond(float depth, float group_depth) {
    return (depth - group_depth) * blur_px_per_dpt > DISCONTINUITY_PX;
}

#ifdef PAPER_RULE
// Remaining weight by the paper's rule, which merges once: four pixels.
vec3 paper_weight(vec3 weight, vec3 coverage, int level) {
    if (level > 0) {
        vec3 through = 1.0 - min(weight / QUAD, 1.0);
        through *= through;
        weight = 1.0 - through * through;
    }
    return weight * (1.0 - coverage);
}
#endif

// Whether a fragment lights a pixel of the tile.
bool is_lit(uvec4 mark, ivec2 in_tile) {
    return ((mark.x >> uint(in_tile.x)) & (mark.x >> uint(ROWS_SHIFT + in_tile.y)) & 1u) != 0u;
}

uvec4 fetch_weights(uvec4 mark, ivec2 in_tile) {
    int width = int(mark.x >> uint(WIDTH_SHIFT));
    int texel = int(mark.y) + in_tile.y * width + in_tile.x;
    return ATLAS_FETCH(atlas, is_lit(mark, in_tile) ? texel : 0);
}

// Adds a fragment's light at a pixel, if lit, by the weights fetched for it.
void add_fragment(inout Sum sum, uvec4 ends, bool lit, vec4 color, uvec4 mark) {
    vec3 weight = lit ? weights_between(ends, color.a) : vec3(0.0);
    float scale = uintBitsToFloat(mark.z);
#ifdef PAPER_RULE
    int level = int(mark.x >> uint(SHAPE_LEVEL_SHIFT)) & LEVEL_MASK;
    weight = paper_weight(weight * scale, sum.coverage, level);
    sum.coverage += weight;
#else
    sum.coverage += weight * scale;
#endif
    sum.light += weight * color.rgb;
}

void main() {
    int bin = first_bin + int(gl_WorkGroupID.y);
    int in_bin = int(gl_WorkGroupID.x);
    ivec2 tile = ivec2(bin % bin_columns, bin / bin_columns) * BIN_TILES
               + ivec2(in_bin % BIN_TILES, in_bin / BIN_TILES);
    if (any(greaterThanEqual(tile, tile_grid))) return;  // the whole group
    ivec2 in_tile = ivec2(gl_LocalInvocationID.xy) * ivec2(1, PIXELS_PER_THREAD);
    ivec2 at = tile * TILE_SIZE_PX + in_tile;
    uint tile_bit = 1u << uint(in_bin);
    bool ordered = (counts[bin].y & tile_bit) != 0u;
    uint first = offsets[bin];
    uint end = first + counts[bin].x;
    // The nearest of the bin: the tile's own nearest closes an empty depth, or joins it.
    float group_depth = ordered && end > first
                      ? colors[entries[first] >> uint(TILES_PER_BIN)].a : 0.0;
    Sum sums[PIXELS_PER_THREAD];
    for (int p = 0; p < PIXELS_PER_THREAD; ++p)
        sums[p] = Sum(vec3(0.0), vec3(0.0), vec3(0.0), vec3(0.0));
    for (uint batch = first; batch < end; batch += uint(BATCH)) {
        int staged = stage_batch(batch, end, tile_bit, tile * TILE_SIZE_PX);
        for (int i = 0; i < staged;) {
            // Fragments of one depth have their own loop, without a branch for each.
            int run_end = staged;
#ifndef PAPER_RULE
            if (ordered) {
                if (is_beyond(staged_depth(i), group_depth)) {
                    for (int p = 0; p < PIXELS_PER_THREAD; ++p) close_depth(sums[p]);
                    group_depth = staged_depth(i);
                }
                run_end = i + 1;
                while (run_end < staged && !is_beyond(staged_depth(run_end), group_depth))
                    ++run_end;
            }
#endif
#if FRAGMENTS_A_TURN > 1
            // Several fetches in flight at a time.
            for (; i + FRAGMENTS_A_TURN <= run_end; i += FRAGMENTS_A_TURN) {
                uvec4 ends[FRAGMENTS_A_TURN * PIXELS_PER_THREAD];
                for (int n = 0; n < FRAGMENTS_A_TURN; ++n)
                    for (int p = 0; p < PIXELS_PER_THREAD; ++p)
                        ends[n * PIXELS_PER_THREAD + p] =
                            fetch_weights(staged_mark[i + n], in_tile + ivec2(0, p));
                for (int n = 0; n < FRAGMENTS_A_TURN; ++n)
                    for (int p = 0; p < PIXELS_PER_THREAD; ++p)
                        add_fragment(sums[p], ends[n * PIXELS_PER_THREAD + p],
                                     is_lit(staged_mark[i + n], in_tile + ivec2(0, p)),
                                     staged_color[i + n], staged_mark[i + n]);
            }
#endif
            for (; i < run_end; ++i) {
                vec4 color = staged_color[i];
                uvec4 mark = staged_mark[i];
                int width = int(mark.x >> uint(WIDTH_SHIFT));
                uint column = (mark.x >> uint(in_tile.x)) & 1u;
                uint rows = column * (mark.x >> uint(ROWS_SHIFT + in_tile.y));
                int texel = int(mark.y) + in_tile.y * width + in_tile.x;
                for (int p = 0; p < PIXELS_PER_THREAD; ++p) {
                    bool lit = (rows & (1u << uint(p))) != 0u;
                    add_fragment(sums[p], ATLAS_FETCH(atlas, lit ? texel : 0), lit, color, mark);
                    texel += width;
                }
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
        vec3 normalized = sums[p].near_light / max(coverage, vec3(MIN_COVERAGE));
        vec3 lit = vec3(greaterThanEqual(coverage, vec3(MIN_COVERAGE)));
        color_out[pixel] = vec4(mix(own, normalized, lit),
                                dot(coverage, vec3(1.0 / float(RGB))));
    }
}

// Accumulates the light that a tile's fragments send to each of its pixels: reads the list
// of the tile's bin, stages the fragments that reach the tile, and evaluates them.
// In:  FRAGMENT_COLOR, FRAGMENT_PLACE, FRAGMENT_EDGE, TILES, BIN_COUNTS, BIN_OFFSETS, ENTRIES, KERNELS,
//      the kernel atlas, PIXELS (own color where no light arrives).
// Out: COLOR_OUT (vec4: linear RGB, mean coverage).
// Dispatch: one group for each tile of a kind, TILES_PER_BIN in a row; a thread computes
//      PIXELS_PER_THREAD pixels of a column: 8 on a software renderer, where a staged
//      fragment is then read once by one vector of threads; 2 on hardware, where a tile is
//      one warp.
// Variants: FRAGMENTS_A_TURN fragments whose weights are fetched together.  PAPER_RULE:
//      alpha-over by weight, as in the paper.  Otherwise coverage: without IN_ORDER, all
//      fragments are summed.  IN_ORDER: fragments of one group of depths (DISCONTINUITY_PX
//      of blur) are summed, front to back, and share the coverage that nearer ones leave
//      free, so that no part of a partly hidden surface is accumulated before the rest;
//      fragments near the far end of a group belong to the next one in part.  Where little
//      light of edges arrives, part of the sum without order.  HAS_HIDDEN: which leaves
//      out the hidden surface.  HAS_EXCESS: of fragments, some of whose light exceeds that
//      around them.
// Twin: reference.gather.
// Source: Csoba & Kunkli 2023, section 6.1; accumulation as in shaders/README.md.

#include "common/reach.glsl"
#include "common/fragments.glsl"
#include "common/atlas.glsl"

layout(local_size_x = TILE_SIZE_PX, local_size_y = GROUP_ROWS) in;

layout(std430, binding = BINDING_FRAGMENT_COLOR) readonly buffer Color { vec4 colors[]; };
layout(std430, binding = BINDING_FRAGMENT_PLACE) readonly buffer Place { uvec4 places[]; };
layout(std430, binding = BINDING_FRAGMENT_EDGE) readonly buffer Edge { vec2 edges[]; };
layout(std430, binding = BINDING_TILES) readonly buffer Tiles { uint tiles[]; };
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
uniform int first_tile;           // in TILES, of the band
uniform int tile_end;
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
shared vec4 staged_color[BATCH];      // linear RGB; a third of the excess light
shared uvec4 staged_mark[BATCH];      // x: lit columns and rows of the tile, a bit each;
                                      // level; length of the kernel's rows.  y: texel of
                                      // the tile's first pixel, as if lit.  z, w: bits of
                                      // the factors of the kernel's two ends.  Before
                                      // staging x is the slot: with little shared memory
                                      // many groups can run at once
#ifdef HAS_EXCESS
shared uint bright[HIT_WORDS];        // bit per staged fragment: it has excess light
#endif
#ifdef IN_ORDER
shared vec2 staged_order[BATCH];      // group of depths plus the share of the next group;
                                      // a third of the strength of the edge, minus 1 for a
                                      // hidden fragment
#endif
shared uint hits[HIT_WORDS];          // bit per entry of the batch: it reaches the tile

const int ROWS_SHIFT = TILE_SIZE_PX;
const int SHAPE_LEVEL_SHIFT = 2 * TILE_SIZE_PX;
const int WIDTH_SHIFT = SHAPE_LEVEL_SHIFT + 2;

// Bits first to last, clipped to those of a tile.
uint bits_between(int first, int last) {
    uint until = (2u << uint(min(last, TILE_SIZE_PX - 1))) - 1u;
    return until & ~((1u << uint(max(first, 0))) - 1u);
}

#ifdef IN_ORDER
// Group of a depth, plus the share of the fragment that belongs to the next group.
float group_of(float depth) {
    float place = depth * blur_px_per_dpt / DISCONTINUITY_PX;
    float group = floor(place);
    return group + max((place - group - (1.0 - GROUP_BLEND_RATIO)) / GROUP_BLEND_RATIO, 0.0);
}
#endif

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
    float excess = 0.0;
#ifdef HAS_EXCESS
    vec2 edge = edges[slot];
    bool is_hidden = false;
#ifdef HAS_HIDDEN
    // The light of a hidden fragment is multiplied with its coverage, and the weights are, too.
    is_hidden = slot >= uint(tile_grid.x * tile_grid.y * THREADS);
    if (is_hidden) {
        scale *= edge.x;
        color.rgb /= edge.x;
        edge.y /= edge.x;
    }
#endif
#ifdef IN_ORDER
    staged_order[at] = vec2(group_of(color.a), is_hidden ? -1.0 : edge.x / float(RGB));
#endif
    excess = edge.y / float(RGB);
    if (excess > 0.0)
        atomicOr(bright[at / BITS_PER_WORD], 1u << uint(at % BITS_PER_WORD));
#endif
    staged_color[at] = vec4(color.rgb, excess);
    vec2 factors = scale * vec2(1.0 - place_fraction(place), place_fraction(place));
    uint shape = columns | (rows << uint(ROWS_SHIFT))
               | (uint(level) << uint(SHAPE_LEVEL_SHIFT)) | (uint(width) << uint(WIDTH_SHIFT));
    int texel = int(kernel_offset(kernel, level)) - first.y * width - first.x;
    staged_mark[at] = uvec4(shape, uint(texel), floatBitsToUint(factors));
}

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
#ifdef HAS_EXCESS
    if (gl_LocalInvocationIndex < uint(HIT_WORDS)) bright[gl_LocalInvocationIndex] = 0u;
#endif
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

// Sums over fragments at a pixel: light and coverage, and of the light that is in excess of
// its surroundings the mean of the channels.
struct Sum { vec3 light; vec3 coverage; float excess; };

const Sum NOTHING = Sum(vec3(0.0), vec3(0.0), 0.0);

// Share of the light that is in excess of its surroundings.
float excess_share(Sum sum) {
    float light = dot(sum.light, vec3(1.0 / float(RGB)));
    return light > 0.0 ? clamp(sum.excess / light, 0.0, 1.0) : 0.0;
}

// Of each pixel of the thread: the current group of depths.
Sum open_sum[PIXELS_PER_THREAD];
#ifdef IN_ORDER
// The part of it that belongs to the next group; closed groups, whose fragments share the
// coverage that nearer ones leave free; the visible surface without sharing; coverage by
// edges.
Sum next_sum[PIXELS_PER_THREAD];
Sum near_sum[PIXELS_PER_THREAD];
Sum seen_sum[PIXELS_PER_THREAD];
float edge_sum[PIXELS_PER_THREAD];

void add_sum(inout Sum sum, Sum other, float share) {
    sum.light += share * other.light;
    sum.coverage += share * other.coverage;
    sum.excess += share * other.excess;
}

// Adds the fragments of a group.  They share the coverage that nearer ones leave free; light
// in excess has the free coverage as its share, as if the group's coverage were complete:
// what it lacks is not as bright.
void add_behind(inout Sum sum, Sum group) {
    vec3 room = 1.0 - sum.coverage;
    vec3 share = min(room / max(group.coverage, vec3(MIN_COVERAGE)), 1.0);
    vec3 whole = min(room / max(group.coverage, vec3(1.0)), share);
    sum.light += mix(share, whole, excess_share(group)) * group.light;
    sum.coverage += share * group.coverage;
    sum.excess += whole.g * group.excess;
}

// Adds the current group to the total, and continues with the next one.  Each loop has so
// few instructions that Mesa unrolls it: sums that it addresses by a variable are slow.
void close_group() {
    for (int p = 0; p < PIXELS_PER_THREAD; ++p) {
        add_sum(open_sum[p], next_sum[p], -1.0);
#ifndef HAS_HIDDEN
        add_sum(seen_sum[p], open_sum[p], 1.0);
#endif
    }
    for (int p = 0; p < PIXELS_PER_THREAD; ++p) add_behind(near_sum[p], open_sum[p]);
    for (int p = 0; p < PIXELS_PER_THREAD; ++p) {
        open_sum[p] = next_sum[p];
        next_sum[p] = NOTHING;
    }
}
#endif

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

// Weights of a staged fragment at a pixel, zero if it is not lit.  Selected, not computed in
// a branch: llvmpipe executes both sides of a branch and stores the result masked.
vec3 weights_of(uvec4 ends, bool lit, uvec4 mark) {
    return weights_between(ends, mix(vec2(0.0), uintBitsToFloat(mark.zw), bvec2(lit)));
}

// Adds a fragment's light at a pixel by its weights.
void add_light(inout Sum sum, vec3 weight, vec4 color, uvec4 mark) {
#ifdef PAPER_RULE
    int level = int(mark.x >> uint(SHAPE_LEVEL_SHIFT)) & LEVEL_MASK;
    weight = paper_weight(weight, sum.coverage, level);
#endif
    sum.coverage += weight;
    sum.light += weight * color.rgb;
}

// What a staged fragment adds besides its light to the current group.
void add_order(int p, vec3 weight, vec4 color, uvec4 mark, float strength) {
#ifdef IN_ORDER
    edge_sum[p] += dot(weight, vec3(max(strength, 0.0)));
#endif
#ifdef HAS_HIDDEN
    add_light(seen_sum[p], strength < 0.0 ? vec3(0.0) : weight, color, mark);
#endif
}

#ifdef IN_ORDER
#define STRENGTH_OF(at) staged_order[at].y
#else
#define STRENGTH_OF(at) 0.0
#endif

// Adds staged fragments to the current group: those from `at` to `end`.
void add_fragments(int at, int end, ivec2 in_tile) {
#if FRAGMENTS_A_TURN > 1
    // Several fetches in flight at a time.
    for (; at + FRAGMENTS_A_TURN <= end; at += FRAGMENTS_A_TURN) {
        uvec4 ends[FRAGMENTS_A_TURN * PIXELS_PER_THREAD];
        for (int n = 0; n < FRAGMENTS_A_TURN; ++n)
            for (int p = 0; p < PIXELS_PER_THREAD; ++p)
                ends[n * PIXELS_PER_THREAD + p] =
                    fetch_weights(staged_mark[at + n], in_tile + ivec2(0, p));
        for (int n = 0; n < FRAGMENTS_A_TURN; ++n) {
            vec4 color = staged_color[at + n];
            uvec4 mark = staged_mark[at + n];
            float strength = STRENGTH_OF(at + n);
            for (int p = 0; p < PIXELS_PER_THREAD; ++p) {
                bool lit = is_lit(mark, in_tile + ivec2(0, p));
                vec3 weight = weights_of(ends[n * PIXELS_PER_THREAD + p], lit, mark);
                add_light(open_sum[p], weight, color, mark);
                add_order(p, weight, color, mark, strength);
            }
        }
    }
#endif
    for (; at < end; ++at) {
        vec4 color = staged_color[at];
        uvec4 mark = staged_mark[at];
        float strength = STRENGTH_OF(at);
        int width = int(mark.x >> uint(WIDTH_SHIFT));
        uint column = (mark.x >> uint(in_tile.x)) & 1u;
        uint rows = column * (mark.x >> uint(ROWS_SHIFT + in_tile.y));
        int texel = int(mark.y) + in_tile.y * width + in_tile.x;
        for (int p = 0; p < PIXELS_PER_THREAD; ++p) {
            bool lit = (rows & (1u << uint(p))) != 0u;
            uvec4 ends = ATLAS_FETCH(atlas, lit ? texel : 0);
            vec3 weight = weights_of(ends, lit, mark);
            add_light(open_sum[p], weight, color, mark);
            add_order(p, weight, color, mark, strength);
            texel += width;
        }
    }
}

#ifdef HAS_EXCESS
// The first staged fragment from `at` on that has excess light; not before `end` if there is
// none.
int next_bright(int at, int end) {
    int found = end;
    for (int word = HIT_WORDS - 1; word >= 0; --word) {
        int first = word * BITS_PER_WORD;
        uint after = ~0u << uint(clamp(at - first, 0, BITS_PER_WORD - 1));
        uint bits = at - first < BITS_PER_WORD ? bright[word] & after : 0u;
        if (bits != 0u) found = first + findLSB(bits);
    }
    return found;
}

// Adds the excess light of staged fragments, which few have.
void add_excess(int at, int end, ivec2 in_tile, float open_group) {
    for (at = next_bright(at, end); at < end; at = next_bright(at + 1, end)) {
        uvec4 mark = staged_mark[at];
        float excess = staged_color[at].a;
#ifdef IN_ORDER
        float share = clamp(staged_order[at].x - open_group, 0.0, 1.0);
        bool is_hidden = staged_order[at].y < 0.0;
#endif
        for (int p = 0; p < PIXELS_PER_THREAD; ++p) {
            ivec2 here = in_tile + ivec2(0, p);
            vec3 weight = weights_of(fetch_weights(mark, here), is_lit(mark, here), mark);
            float light = dot(weight, vec3(excess));
            open_sum[p].excess += light;
#ifdef IN_ORDER
            next_sum[p].excess += share * light;
#endif
#ifdef HAS_HIDDEN
            seen_sum[p].excess += is_hidden ? 0.0 : light;
#endif
        }
    }
}
#endif

#ifdef IN_ORDER
// Adds staged fragments to the current group, and a share of each to the next one, which
// the group loses when it is closed.
void divide_fragments(int at, int end, ivec2 in_tile, float open_group) {
    for (; at < end; ++at) {
        vec4 color = staged_color[at];
        uvec4 mark = staged_mark[at];
        vec2 order = staged_order[at];
        float share = order.x - open_group;
        int width = int(mark.x >> uint(WIDTH_SHIFT));
        uint column = (mark.x >> uint(in_tile.x)) & 1u;
        uint rows = column * (mark.x >> uint(ROWS_SHIFT + in_tile.y));
        int texel = int(mark.y) + in_tile.y * width + in_tile.x;
        for (int p = 0; p < PIXELS_PER_THREAD; ++p) {
            bool lit = (rows & (1u << uint(p))) != 0u;
            uvec4 ends = ATLAS_FETCH(atlas, lit ? texel : 0);
            vec3 weight = weights_of(ends, lit, mark);
            add_light(open_sum[p], weight, color, mark);
            add_light(next_sum[p], share * weight, color, mark);
            add_order(p, weight, color, mark, order.y);
            texel += width;
        }
    }
}

// Adds a batch front to back.  Fragments of one group have their own loops, without a branch
// for each.
void add_in_order(int count, ivec2 in_tile, inout float open_group) {
    for (int at = 0; at < count;) {
        float group = floor(staged_order[at].x);
        if (group > open_group) {
            close_group();
            if (group > open_group + 1.0) close_group();
            open_group = group;
        }
        // Sorting by quantized depths may leave a fragment behind the next group.
        int end = at;
        while (end < count && staged_order[end].x <= open_group) ++end;
        add_fragments(at, end, in_tile);
        int divided = end;
        while (end < count && staged_order[end].x > open_group
               && staged_order[end].x < open_group + 1.0) ++end;
        divide_fragments(divided, end, in_tile, open_group);
        add_excess(at, end, in_tile, open_group);
        at = end;
    }
}
#endif

// The color of a pixel from its sums.  Coverage changes light in excess of its surroundings
// neither where it is missing, nor where it adds up to more than 1.
vec3 color_of(Sum sum, vec3 own) {
    vec3 normalized = sum.light / max(sum.coverage, vec3(MIN_COVERAGE));
    normalized *= 1.0 - excess_share(sum) * (1.0 - sum.coverage);
    return mix(own, normalized, vec3(greaterThanEqual(sum.coverage, vec3(MIN_COVERAGE))));
}

void main() {
    int index = first_tile + int(gl_WorkGroupID.y) * TILES_PER_BIN + int(gl_WorkGroupID.x);
    if (index >= tile_end || tiles[index] == uint(NO_INDEX)) return;  // the whole group
    int bin = int(tiles[index] / uint(TILES_PER_BIN));
    int in_bin = int(tiles[index] % uint(TILES_PER_BIN));
    ivec2 tile = ivec2(bin % bin_columns, bin / bin_columns) * BIN_TILES
               + ivec2(in_bin % BIN_TILES, in_bin / BIN_TILES);
    ivec2 in_tile = ivec2(gl_LocalInvocationID.xy) * ivec2(1, PIXELS_PER_THREAD);
    ivec2 at = tile * TILE_SIZE_PX + in_tile;
    uint tile_bit = 1u << uint(in_bin);
    uint first = offsets[bin];
    uint end = first + counts[bin].x;
    for (int p = 0; p < PIXELS_PER_THREAD; ++p) {
        open_sum[p] = NOTHING;
#ifdef IN_ORDER
        next_sum[p] = NOTHING;
        near_sum[p] = NOTHING;
        seen_sum[p] = NOTHING;
        edge_sum[p] = 0.0;
#endif
    }
    float open_group = NEAREST_GROUP;
    for (uint batch = first; batch < end; batch += uint(BATCH)) {
        int staged = stage_batch(batch, end, tile_bit, tile * TILE_SIZE_PX);
#ifdef IN_ORDER
        add_in_order(staged, in_tile, open_group);
#else
        add_fragments(0, staged, in_tile);
#ifdef HAS_EXCESS
        add_excess(0, staged, in_tile, open_group);
#endif
#endif
    }
#ifdef IN_ORDER
    close_group();
    close_group();  // the next group, which has a share of the last fragments
    vec3 near[PIXELS_PER_THREAD];
    for (int p = 0; p < PIXELS_PER_THREAD; ++p) {
        ivec2 here = min(at + ivec2(0, p), frame_size_px - 1);
        near[p] = color_of(near_sum[p], pixels[here.y * frame_size_px.x + here.x].rgb);
    }
#endif
    for (int p = 0; p < PIXELS_PER_THREAD; ++p) {
        ivec2 here = at + ivec2(0, p);
        if (any(greaterThanEqual(here, frame_size_px))) continue;
        int pixel = here.y * frame_size_px.x + here.x;
        vec3 own = pixels[pixel].rgb;
#ifdef IN_ORDER
        float order = min(edge_sum[p] / EDGE_MIX_COVERAGE, 1.0);
        vec3 color = mix(color_of(seen_sum[p], own), near[p], order);
        vec3 coverage = near_sum[p].coverage;
#else
        vec3 color = color_of(open_sum[p], own);
        vec3 coverage = min(open_sum[p].coverage, 1.0);
#endif
        color_out[pixel] = vec4(color, dot(coverage, vec3(1.0 / float(RGB))));
    }
}

// Plans the new node kernels: which cached PSFs they are blended from, and their sizes.
// At each end of its interval, a node kernel interpolates between up to three nodes of
// pupil and accommodation, and two nodes of defocus for each.  PSFs that have not been
// computed are counted and marked; the others take their weight.
// In:  NODE_PAIRS, LAYER_DPT, NODE_DEFOCUS (total defocus at layer 0 dpt, three channels
//      per field node), READS (neighbors of the state), STORE_VALUES and STORE_STARTS
//      (nodes of defocus by group), STORE_SHIFTS (shift of the channels by group),
//      STORE_PSFS.
// Out: RECIPES, NODES (near recipe, far recipe, first texel, reach; peak, spread at both
//      ends, radius), WORK, READ_PSFS (a bit per PSF that is read), PLAN.
// Dispatch: groups of GROUP_THREADS take the new nodes in turn.
// Twin: tests/numerical/plan_twin.py (node_kernels).
// Source: Csoba & Kunkli 2023, section 6.4.

layout(local_size_x = GROUP_THREADS) in;

layout(std430, binding = BINDING_NODE_PAIRS) readonly buffer Pairs { uvec2 node_pairs[]; };
layout(std430, binding = BINDING_LAYER_DPT) readonly buffer LayerDpt { float layer_dpt[]; };
layout(std430, binding = BINDING_NODE_DEFOCUS) readonly buffer Zero { float node_zero_dpt[]; };
layout(std430, binding = BINDING_READS) readonly buffer Reads { uint reads[]; };
layout(std430, binding = BINDING_STORE_VALUES) readonly buffer Values { float values_dpt[]; };
layout(std430, binding = BINDING_STORE_STARTS) readonly buffer Starts { uint starts[]; };
layout(std430, binding = BINDING_STORE_SHIFTS) readonly buffer Shifts { float shifts_dpt[]; };
layout(std430, binding = BINDING_STORE_PSFS) readonly buffer Psfs { uint psfs[]; };
layout(std430, binding = BINDING_RECIPES) writeonly buffer Recipes { uint recipes[]; };
layout(std430, binding = BINDING_NODES) writeonly buffer Nodes { uvec4 nodes[]; };
layout(std430, binding = BINDING_WORK) writeonly buffer Work { uvec2 work[]; };
layout(std430, binding = BINDING_READ_PSFS) buffer Read { uint read_psfs[]; };
layout(std430, binding = BINDING_PLAN) buffer Plan { uint plan[]; };

#include "common/reach.glsl"
#include "common/plan.glsl"
#include "common/work_lists.glsl"

uniform int layer_count;
uniform int neighbor_count;       // of the state in pupil and accommodation
uniform uint node_capacity;
uniform uint texel_capacity;      // of the node atlas

const int ENDS = 2;
const int END_TAPS = RGB * RECIPE_TAPS;
const int ALL_TAPS = ENDS * END_TAPS;

shared uint tap_psf[ALL_TAPS];
shared float tap_weight[ALL_TAPS];
shared float tap_peak[ALL_TAPS];
shared float tap_spread[ALL_TAPS];
shared uint side_px[RECIPE_TAPS];  // left, right, up, down, radius; the last is unused
shared uint first_item;
shared uint item_count;

// Lower node of defocus of a group, and the share of the upper one.
uint bracket(uint group, float dpt, out uint upper, out float share) {
    uint first = starts[group];
    uint last = starts[group + 1u] - 1u;
    uint low = first;
    uint high = last;
    dpt = clamp(dpt, values_dpt[first], values_dpt[last]);
    while (low + 1u < high) {
        uint middle = (low + high) / 2u;
        if (values_dpt[middle] < dpt) low = middle;
        else high = middle;
    }
    upper = high;
    float span = values_dpt[high] - values_dpt[low];
    share = clamp((dpt - values_dpt[low]) / (span > 0.0 ? span : 1.0), 0.0, 1.0);
    // At a node, rounding of 32-bit floats must not read its neighbor, too.
    if (share < MIN_NODE_SHARE) share = 0.0;
    if (share > 1.0 - MIN_NODE_SHARE) share = 1.0;
    return low;
}

// Chooses the cached PSF of a tap, and its weight.
void read_tap(int tap, uvec2 pair) {
    int end = tap / END_TAPS;
    uint channel = uint(tap % END_TAPS / RECIPE_TAPS);
    int neighbor = tap % RECIPE_TAPS / ENDS;
    tap_psf[tap] = 0u;
    tap_weight[tap] = 0.0;
    if (neighbor >= neighbor_count) return;
    uint record = uint(neighbor * READ_WORDS);
    uint group = reads[record] + pair.x;
    float scale = uintBitsToFloat(reads[record + 1u]);
    float weight = uintBitsToFloat(reads[record + 2u]);
    float layer = layer_dpt[min(int(pair.y) + end, layer_count - 1)];
    float dpt = (layer + node_zero_dpt[pair.x * uint(RGB) + channel]) * scale
              - shifts_dpt[group * uint(RGB) + channel];
    uint upper;
    float share;
    uint lower = bracket(group, dpt, upper, share);
    bool is_upper = tap % ENDS != 0;
    uint psf = uint(RGB) * (is_upper ? upper : lower) + channel;
    weight *= is_upper ? share : 1.0 - share;
    if (weight <= 0.0) return;
    uint bit = 1u << (psf % uint(BITS_PER_WORD));
    uint word = psf / uint(BITS_PER_WORD);
    if ((read_psfs[word] & bit) == 0u) atomicOr(read_psfs[word], bit);
    float peak = uintBitsToFloat(psfs[psf * uint(PSF_WORDS) + uint(PSF_WORDS) - 1u]);
    if (peak > 0.0) {
        tap_psf[tap] = psf;
        tap_weight[tap] = weight;
    } else {
        atomicAdd(plan[PLAN_MISSING], 1u);
    }
}

// Writes a tap of a recipe, with the weight of the taps without a PSF.
void write_tap(int tap, uint node) {
    int first = tap - tap % RECIPE_TAPS;
    float sum = 0.0;
    for (int other = first; other < first + RECIPE_TAPS; ++other) sum += tap_weight[other];
    float weight = tap_weight[tap] / (sum > 0.0 ? sum : 1.0);
    uint record = tap_psf[tap] * uint(PSF_WORDS);
    uint recipe = (node * uint(ENDS * RGB) + uint(first / RECIPE_TAPS)) * uint(RECIPE_WORDS)
                + uint(tap % RECIPE_TAPS);
    uint reach = psfs[record + 1u];
    tap_peak[tap] = weight * uintBitsToFloat(psfs[record + uint(PSF_WORDS) - 1u]);
    tap_spread[tap] = weight * uintBitsToFloat(psfs[record + uint(PSF_WORDS) - 2u]);
    recipes[recipe] = psfs[record];
    recipes[recipe + uint(RECIPE_TAPS)] = reach;
    recipes[recipe + 2u * uint(RECIPE_TAPS)] = floatBitsToUint(tap_peak[tap] / WEIGHT_MAX);
    if (weight <= 0.0) return;
    Reach sides = unpack_reach(reach);
    atomicMax(side_px[0], uint(sides.left));
    atomicMax(side_px[1], uint(sides.right));
    atomicMax(side_px[2], uint(sides.up));
    atomicMax(side_px[1 + 2], uint(sides.down));
    atomicMax(side_px[2 + 2], psfs[record + 2u]);
}

// Smallest sum of the spreads of a channel's taps, at an end of the interval; highest of
// the peaks.
float narrowest_px(int end, inout float highest) {
    float narrowest = 0.0;
    for (int channel = 0; channel < RGB; ++channel) {
        float peak = 0.0;
        float spread = 0.0;
        int first = end * END_TAPS + channel * RECIPE_TAPS;
        for (int tap = first; tap < first + RECIPE_TAPS; ++tap) {
            peak += tap_peak[tap];
            spread += tap_spread[tap];
        }
        highest = max(highest, peak);
        narrowest = channel == 0 ? spread : min(narrowest, spread);
    }
    return narrowest;
}

void write_node(uint node) {
    float highest = 0.0;
    float near_px = narrowest_px(0, highest);
    float far_px = narrowest_px(1, highest);
    Reach reach = Reach(int(side_px[0]), int(side_px[1]), int(side_px[2]), int(side_px[1 + 2]));
    uint size = uint(reach_width(reach) * reach_height(reach));
    uint start = place_texels(PLAN_NODE_TEXELS, size, texel_capacity);
    item_count = work_items(size);
    first_item = add_items(0, item_count);
    uint record = node * uint(NODE_WORDS);
    nodes[record] = uvec4(2u * node, 2u * node + 1u, start, pack_reach(reach));
    nodes[record + 1u] = uvec4(floatBitsToUint(highest), floatBitsToUint(near_px),
                               floatBitsToUint(far_px), side_px[2 + 2]);
}

void main() {
    int thread = int(gl_LocalInvocationIndex);
    uint count = min(plan[PLAN_NODES], node_capacity);
    uint node = plan[PLAN_OLD_NODES] + gl_WorkGroupID.x;
    for (; node < count; node += gl_NumWorkGroups.x) {
        barrier();  // the previous node has been written
        if (thread < RECIPE_TAPS) side_px[thread] = 0u;
        for (int tap = thread; tap < ALL_TAPS; tap += GROUP_THREADS)
            read_tap(tap, node_pairs[node]);
        barrier();  // all weights are known
        for (int tap = thread; tap < ALL_TAPS; tap += GROUP_THREADS) write_tap(tap, node);
        barrier();  // all peaks, spreads and reaches are known
        if (thread == 0) write_node(node);
        barrier();  // the first item is known
        write_items(0, first_item, item_count, node);
    }
}

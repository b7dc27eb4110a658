// Numbers the kernels of used pairs of cell and interval, and the node kernels that they
// are blended from, unless frames before had them.
// In:  USED (a bit per cell and interval), CELLS (three field nodes, their weights, maps).
// Out: KERNEL_OF, KERNEL_PAIRS (cell, interval), NODE_OF, NODE_PAIRS (field node,
//      interval), PLAN.
// Dispatch: one thread per word of USED.
// Twin: filter_service.rendering.frame_kernels.frame_kernels.

layout(local_size_x = THREADS) in;

#include "common/line.glsl"
#include "common/layers.glsl"

layout(std430, binding = BINDING_USED) readonly buffer Used { uint used[]; };
layout(std430, binding = BINDING_CELLS) readonly buffer Cells { uint cells[]; };
layout(std430, binding = BINDING_KERNEL_OF) buffer KernelOf { uint kernel_of[]; };
layout(std430, binding = BINDING_KERNEL_PAIRS) writeonly buffer Pairs { uvec2 pairs[]; };
layout(std430, binding = BINDING_NODE_OF) buffer NodeOf { uint node_of[]; };
layout(std430, binding = BINDING_NODE_PAIRS) writeonly buffer Nodes { uvec2 node_pairs[]; };
layout(std430, binding = BINDING_PLAN) buffer Plan { uint plan[]; };

#include "common/plan.glsl"

uniform int used_words;
uniform int words_per_cell;
uniform int layer_count;
uniform uint kernel_capacity;
uniform uint node_capacity;

// Next number of a list; if it is full, 0, and the frame is invalid.
uint next_number(int counter, uint capacity) {
    uint number = atomicAdd(plan[counter], 1u);
    if (number < capacity) return number;
    plan[PLAN_OVERFLOWS] = 1u;
    return 0u;
}

void add_node(uint field, uint interval) {
    uint pair = field * uint(interval_count(layer_count)) + interval;
    if (atomicCompSwap(node_of[pair], NO_INDEX, 0u) != NO_INDEX) return;
    uint node = next_number(PLAN_NODES, node_capacity);
    node_of[pair] = node;
    node_pairs[node] = uvec2(field, interval);
    ask_for_groups(PLAN_FOR_NODES, node - min(plan[PLAN_OLD_NODES], node) + 1u);
}

void add_kernel(uint cell, uint interval) {
    uint pair = cell * uint(interval_count(layer_count)) + interval;
    if (kernel_of[pair] != NO_INDEX) return;
    uint kernel = next_number(PLAN_KERNELS, kernel_capacity);
    kernel_of[pair] = kernel;
    pairs[kernel] = uvec2(cell, interval);
    ask_for_groups(PLAN_FOR_KERNELS, kernel - min(plan[PLAN_OLD_KERNELS], kernel) + 1u);
    uint record = cell * uint(CELL_WORDS);
    for (uint corner = 0u; corner < uint(FIELD_CORNERS); ++corner) {
        float weight = uintBitsToFloat(cells[record + uint(FIELD_CORNERS) + corner]);
        if (weight > 0.0) add_node(cells[record + corner], interval);
    }
}

void main() {
    int at = thread_index();
    if (at >= used_words) return;
    uint cell = uint(at / words_per_cell);
    uint first = uint(at % words_per_cell) * uint(BITS_PER_WORD);
    uint bits = used[at];
    while (bits != 0u) {
        uint bit = uint(findLSB(bits));
        bits &= bits - 1u;
        add_kernel(cell, first + bit);
    }
}

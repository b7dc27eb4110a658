// Clears the marks and counters of a frame, and the plan of the eye's kernels: all of it
// for a new state; otherwise the frame keeps the kernels of the frames before.
// In:  PLAN.   Out: PLAN, USED, STATS, READ_PSFS; KERNEL_OF, NODE_OF (for a new state).
// Dispatch: one thread per word of the longest of them.
// Twin: tests/numerical/test_plan_passes.py.

layout(local_size_x = THREADS) in;

#include "common/line.glsl"

layout(std430, binding = BINDING_PLAN) buffer Plan { uint plan[]; };
layout(std430, binding = BINDING_USED) writeonly buffer Used { uint used[]; };
layout(std430, binding = BINDING_STATS) writeonly buffer Stats { uint stats[]; };
layout(std430, binding = BINDING_READ_PSFS) writeonly buffer Read { uint read_psfs[]; };
layout(std430, binding = BINDING_KERNEL_OF) writeonly buffer KernelOf { uint kernel_of[]; };
layout(std430, binding = BINDING_NODE_OF) writeonly buffer NodeOf { uint node_of[]; };

uniform int used_words;
uniform int read_words;
uniform int pair_count;           // of cells and intervals
uniform int node_pair_count;      // of field nodes and intervals
uniform int is_new;               // state of the eye

void main() {
    int at = thread_index();
    if (at < used_words) used[at] = 0u;
    if (at < STAT_LANES * STAT_WORDS) stats[at] = 0u;
    if (at < read_words) read_psfs[at] = 0u;
    if (is_new != 0 && at < pair_count) kernel_of[at] = NO_INDEX;
    if (is_new != 0 && at < node_pair_count) node_of[at] = NO_INDEX;
    if (at >= PLAN_WORDS) return;
    bool is_kept = is_new == 0 && at >= PLAN_KERNELS && at <= PLAN_REACH;
    if (is_kept) return;
    uint value = 0u;
    if (at < PLAN_KERNELS && at % DISPATCH_WORDS != 0) value = 1u;  // groups along y and z
    if (is_new == 0 && at == PLAN_OLD_KERNELS) value = plan[PLAN_KERNELS];
    if (is_new == 0 && at == PLAN_OLD_NODES) value = plan[PLAN_NODES];
    plan[at] = value;
}

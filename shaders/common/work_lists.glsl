// Adds kernels to the work lists of the passes that compute their texels.
// Needs buffers `plan` of uint and `work` of uvec2 in scope, and common/plan.glsl.

uniform uint work_capacity;       // items of one list

uint work_items(uint texels) { return (texels + uint(THREADS) - 1u) / uint(THREADS); }

// Takes items at the end of a list; returns the first.
uint add_items(int list, uint items) {
    uint first = atomicAdd(plan[PLAN_WORK + list], items);
    if (first + items > work_capacity) plan[PLAN_OVERFLOWS] = 1u;
    ask_for_groups(PLAN_FOR_WORK + list, first + items);
    return first;
}

// Writes every GROUP_THREADS-th of a kernel's items.
void write_items(int list, uint first, uint items, uint kernel) {
    for (uint i = gl_LocalInvocationIndex; i < items; i += uint(GROUP_THREADS)) {
        if (first + i < work_capacity)
            work[uint(list) * work_capacity + first + i] = uvec2(kernel, i * uint(THREADS));
    }
}

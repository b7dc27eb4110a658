// Work lists: kernels of different sizes, THREADS texels per item: (kernel, first texel).
// A work group takes every n-th item of a list, because a dispatch may have fewer groups.
// Needs buffers `plan` of uint and `work` of uvec2 in scope.

uniform int work_list;
uniform uint work_capacity;       // items of one list

// Items of the list; none if something of the plan did not fit.
uint work_count() { return plan[PLAN_OVERFLOWS] == 0u ? plan[PLAN_WORK + work_list] : 0u; }

// Item of a list: its kernel, and this thread's texel.
uint work_kernel(uint item, out int texel) {
    uvec2 share = work[uint(work_list) * work_capacity + item];
    texel = int(share.y + gl_LocalInvocationIndex);
    return share.x;
}

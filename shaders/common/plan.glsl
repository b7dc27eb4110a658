// The plan of an eye's kernels: counters of its kernels and node kernels, of their texels
// and of the work lists, and the dispatches of the passes that use them.  Kernels are
// numbered in the order in which threads ask for them; their contents do not depend on it.
// Needs a buffer `plan` of uint in scope.

// Has a pass run at least `groups` work groups along x.
void ask_for_groups(int dispatch, uint groups) {
    atomicMax(plan[dispatch * DISPATCH_WORDS], min(groups, uint(MAX_GROUPS)));
}

// First texel of a kernel of this size; if it does not fit, 0, and the frame is invalid.
uint place_texels(int counter, uint size, uint capacity) {
    uint first = atomicAdd(plan[counter], size);
    if (first + size <= capacity && first < capacity) return first;
    plan[PLAN_OVERFLOWS] = 1u;
    return 0u;
}

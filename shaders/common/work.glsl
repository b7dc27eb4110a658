// One work group's share of kernels of different sizes: (kernel, first texel).
// Needs a buffer `work` of uvec2 in scope.

uniform int group_count;

// This group's share, or false beyond the last.
bool take_work(out uint kernel, out int texel) {
    uint group = gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x;
    if (group >= uint(group_count)) return false;
    uvec2 share = work[group];
    kernel = share.x;
    texel = int(share.y + gl_LocalInvocationIndex);
    return true;
}

// Linear index of a thread in groups of THREADS; the groups are in rows, because one row
// may be too short.

int thread_index() {
    uint group = gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x;
    return int(group * uint(THREADS) + gl_LocalInvocationIndex);
}

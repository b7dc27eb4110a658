// Threads of groups of THREADS as one line: rows of groups, for one may be too short.

int thread_index() {
    uint group = gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x;
    return int(group * uint(THREADS) + gl_LocalInvocationIndex);
}

// Sums kernels over the squares of merged fragments, level by level, so that a merged
// fragment needs one lookup and loses no light.
// In:  KERNELS, the kernel atlas (level below), WORK, PLAN.
// Out: the same (this level).
// Dispatch: groups of THREADS texels take the items of WORK in turn.
// Twin: tests/numerical/test_renderer_passes.py (sums of reference.kernel_pairs).

layout(local_size_x = THREADS) in;

layout(std430, binding = BINDING_KERNELS) readonly buffer Kernels { uvec4 kernels[]; };
layout(std430, binding = BINDING_WORK) readonly buffer Work { uvec2 work[]; };
layout(std430, binding = BINDING_PLAN) readonly buffer Plan { uint plan[]; };
#ifdef ATLAS_IS_BUFFER
layout(std430, binding = BINDING_ATLAS) buffer Atlas { uvec4 atlas[]; };
#else
layout(rgba32ui, binding = IMAGE_ATLAS) uniform uimage2D atlas;
#endif

#include "common/atlas.glsl"
#include "common/kernels.glsl"
#include "common/work.glsl"
#include "common/reach.glsl"

uniform int level;

void sum_level(uint kernel, int texel) {
    float step_size = kernel_scale(kernel, level - 1) / WEIGHT_MAX;
    int half_side = 1 << (level - 1);
    Reach reach = unpack_reach(kernel_reach(kernel));
    ivec2 size = ivec2(reach_width(reach), reach_height(reach)) + half_side - 1;
    int width = size.x + half_side;
    if (texel >= width * (size.y + half_side)) return;
    ivec2 at = ivec2(texel % width, texel / width);
    vec3 near = vec3(0.0);
    vec3 far = vec3(0.0);
    for (int dy = 0; dy < 2; ++dy) {
        for (int dx = 0; dx < 2; ++dx) {
            ivec2 from = at - half_side * ivec2(dx, dy);
            if (any(lessThan(from, ivec2(0))) || any(greaterThanEqual(from, size))) continue;
            int source = int(kernel_offset(kernel, level - 1)) + from.y * size.x + from.x;
            uvec4 ends = ATLAS_LOAD(atlas, source);
            near += near_weights(ends) * step_size;
            far += far_weights(ends) * step_size;
        }
    }
    uvec4 ends = pack_weights(near, far, kernel_scale(kernel, level));
    ATLAS_STORE(atlas, int(kernel_offset(kernel, level)) + texel, ends);
}

void main() {
    uint count = work_count();
    for (uint item = gl_WorkGroupID.x; item < count; item += gl_NumWorkGroups.x) {
        int texel;
        uint kernel = work_kernel(item, texel);
        sum_level(kernel, texel);
    }
}

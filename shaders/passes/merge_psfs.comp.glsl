// Sums each kernel over the four pixels of a merged quad, so that a merged fragment
// costs one look-up and loses no light.
// In:  KERNELS, the kernel atlas (single kernels), WORK.
// Out: the same (merged kernels).
// Dispatch: one group of THREADS texels per item of WORK.
// Twin: tests/numerical/test_renderer_passes.py (sums of reference.kernel_pairs).

layout(local_size_x = THREADS) in;

layout(std430, binding = BINDING_KERNELS) readonly buffer Kernels { uvec4 kernels[]; };
layout(std430, binding = BINDING_WORK) readonly buffer Work { uvec2 work[]; };
layout(rgba32ui, binding = IMAGE_ATLAS) uniform uimage2D atlas;

#include "common/atlas.glsl"
#include "common/kernels.glsl"
#include "common/work.glsl"
#include "common/reach.glsl"

void main() {
    uint kernel;
    int texel;
    if (!take_work(kernel, texel)) return;
    uvec4 place = kernel_place(kernel);
    uvec4 look = kernel_look(kernel);
    float step_size = uintBitsToFloat(look.y) / WEIGHT_MAX;
    Reach reach = unpack_reach(place.w);
    ivec2 size = ivec2(reach_width(reach), reach_height(reach));
    int merged_width = size.x + 1;
    if (texel >= merged_width * (size.y + 1)) return;
    ivec2 at = ivec2(texel % merged_width, texel / merged_width);
    vec3 near = vec3(0.0);
    vec3 far = vec3(0.0);
    for (int dy = 0; dy < 2; ++dy) {
        for (int dx = 0; dx < 2; ++dx) {
            ivec2 from = at - ivec2(dx, dy);
            if (any(lessThan(from, ivec2(0))) || any(greaterThanEqual(from, size)))
                continue;
            int source = int(place.y) + from.y * size.x + from.x;
            uvec4 single = imageLoad(atlas, atlas_position(source));
            near += near_weights(single) * step_size;
            far += far_weights(single) * step_size;
        }
    }
    uvec4 packed_pair = pack_weights(near, far, uintBitsToFloat(look.z));
    imageStore(atlas, atlas_position(int(place.z) + texel), packed_pair);
}

// Sums each kernel over the four pixels of a merged quad, so that a merged fragment
// costs one look-up and loses no light.
// In:  LAYERS, the kernel atlas (single kernels).   Out: the same (merged kernels).
// Dispatch: x over texels of the largest merged kernel / THREADS, y = interval.
// Twin: tests/numerical/test_renderer_passes.py (sums of reference.layer_kernels).

layout(local_size_x = THREADS) in;

layout(std430, binding = BINDING_LAYERS) readonly buffer Layers { uvec4 layers[]; };
layout(rgba32ui, binding = IMAGE_ATLAS) uniform uimage2D atlas;

#include "common/atlas.glsl"

void main() {
    uvec4 place = layers[gl_WorkGroupID.y * uint(LAYER_WORDS)];
    uvec4 look = layers[gl_WorkGroupID.y * uint(LAYER_WORDS) + 1u];
    float step_size = uintBitsToFloat(look.y) / WEIGHT_MAX;
    int width = 2 * int(place.w) + 1;
    int merged_width = width + 1;
    int texel = int(gl_GlobalInvocationID.x);
    if (texel >= merged_width * merged_width) return;
    ivec2 at = ivec2(texel % merged_width, texel / merged_width);
    vec3 near = vec3(0.0);
    vec3 far = vec3(0.0);
    for (int dy = 0; dy < 2; ++dy) {
        for (int dx = 0; dx < 2; ++dx) {
            ivec2 from = at - ivec2(dx, dy);
            if (any(lessThan(from, ivec2(0))) || any(greaterThanEqual(from, ivec2(width))))
                continue;
            int source = int(place.y) + from.y * width + from.x;
            uvec4 single = imageLoad(atlas, atlas_position(source));
            near += near_weights(single) * step_size;
            far += far_weights(single) * step_size;
        }
    }
    uvec4 packed_pair = pack_weights(near, far, uintBitsToFloat(look.z));
    imageStore(atlas, atlas_position(int(place.z) + texel), packed_pair);
}

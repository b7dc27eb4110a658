// Sums each layer's kernel over the four pixels of a merged quad, so that a merged
// fragment costs one look-up and loses no light.
// In:  LAYERS, the kernel atlas (single kernels).   Out: the same (merged kernels).
// Dispatch: x over texels of the largest merged kernel / THREADS, y = layer.
// Twin: reference.merge_psfs.

layout(local_size_x = THREADS) in;

layout(std430, binding = BINDING_LAYERS) readonly buffer Layers { uvec4 layers[]; };
layout(rgba16f, binding = IMAGE_ATLAS) uniform image2D atlas;

#include "common/atlas.glsl"

void main() {
    uvec4 layer = layers[gl_WorkGroupID.y * uint(LAYER_WORDS)];
    int width = 2 * int(layer.w) + 1;
    int merged_width = width + 1;
    int texel = int(gl_GlobalInvocationID.x);
    if (texel >= merged_width * merged_width) return;
    ivec2 at = ivec2(texel % merged_width, texel / merged_width);
    vec4 sum = vec4(0.0);
    for (int dy = 0; dy < 2; ++dy) {
        for (int dx = 0; dx < 2; ++dx) {
            ivec2 from = at - ivec2(dx, dy);
            if (all(greaterThanEqual(from, ivec2(0))) && all(lessThan(from, ivec2(width))))
                sum += imageLoad(atlas, atlas_position(int(layer.y) + from.y * width + from.x));
        }
    }
    imageStore(atlas, atlas_position(int(layer.z) + texel), sum);
}

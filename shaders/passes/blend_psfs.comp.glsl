// Blends the cached PSFs into this frame's layers, one object distance each.
// In:  STORE (f32 kernels), RECIPES (8 words per layer and channel: four kernels as
//      offset and radius, four weights), LAYERS (distance, offset, merged offset, radius).
// Out: the kernel atlas (RGB weight).
// Dispatch: x over texels of the largest kernel / THREADS, y = layer.
// Twin: reference.blend_psfs.  Source: Csoba & Kunkli 2023, section 6.4.

layout(local_size_x = THREADS) in;

layout(std430, binding = BINDING_STORE) readonly buffer Store { float store[]; };
layout(std430, binding = BINDING_RECIPES) readonly buffer Recipes { uvec4 recipes[]; };
layout(std430, binding = BINDING_LAYERS) readonly buffer Layers { uvec4 layers[]; };
layout(rgba16f, binding = IMAGE_ATLAS) writeonly uniform image2D atlas;

#include "common/atlas.glsl"

float cached(uint offset, int radius, ivec2 at) {
    if (abs(at.x) > radius || abs(at.y) > radius) return 0.0;
    int width = 2 * radius + 1;
    return store[offset + uint((at.y + radius) * width + at.x + radius)];
}

float blended(uint recipe, ivec2 at) {
    uvec4 offsets = recipes[recipe];
    uvec4 radii = recipes[recipe + 1u];
    vec4 weights = uintBitsToFloat(recipes[recipe + 2u]);
    return weights.x * cached(offsets.x, int(radii.x), at)
         + weights.y * cached(offsets.y, int(radii.y), at)
         + weights.z * cached(offsets.z, int(radii.z), at)
         + weights.w * cached(offsets.w, int(radii.w), at);
}

void main() {
    uint layer_index = gl_WorkGroupID.y;
    uvec4 layer = layers[layer_index * uint(LAYER_WORDS)];
    int radius = int(layer.w);
    int width = 2 * radius + 1;
    int texel = int(gl_GlobalInvocationID.x);
    if (texel >= width * width) return;
    ivec2 at = ivec2(texel % width, texel / width) - radius;
    uint recipe = layer_index * uint(RGB) * uint(RECIPE_WORDS);
    vec3 weight = vec3(blended(recipe, at), blended(recipe + uint(RECIPE_WORDS), at),
                       blended(recipe + 2u * uint(RECIPE_WORDS), at));
    imageStore(atlas, atlas_position(int(layer.y) + texel), vec4(weight, 0.0));
}

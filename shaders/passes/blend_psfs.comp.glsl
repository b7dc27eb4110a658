// Blends the cached PSFs into this frame's layers and packs neighbours in pairs.
// In:  STORE (kernels, two 16-bit weights a word), RECIPES (per layer and channel offsets, radii and weights of
//      eight kernels: two pupils x two accommodations x two defocus nodes), LAYERS (common/layers.glsl).
// Out: the kernel atlas, single kernels.
// Dispatch: x over texels of the largest kernel / THREADS, y = interval.
// Twin: reference.layer_kernels.  Source: Csoba & Kunkli 2023, section 6.4.

layout(local_size_x = THREADS) in;

layout(std430, binding = BINDING_STORE) readonly buffer Store { uint store[]; };
layout(std430, binding = BINDING_RECIPES) readonly buffer Recipes { uvec4 recipes[]; };
layout(std430, binding = BINDING_LAYERS) readonly buffer Layers { uvec4 layers[]; };
layout(rgba32ui, binding = IMAGE_ATLAS) writeonly uniform uimage2D atlas;

#include "common/atlas.glsl"

uniform int layer_count;

float cached(uint offset, int radius, ivec2 at) {
    if (abs(at.x) > radius || abs(at.y) > radius) return 0.0;
    int width = 2 * radius + 1;
    uint index = offset + uint((at.y + radius) * width + at.x + radius);
    return float((store[index / 2u] >> (uint(WEIGHT_BITS) * (index % 2u))) & WEIGHT_MASK);
}

// Weighted sum of four of a recipe's kernels.
float blended_half(uint recipe, uint half_index, ivec2 at) {
    vec4 weights = uintBitsToFloat(recipes[recipe + uint(RECIPE_WEIGHTS) + half_index]);
    if (all(equal(weights, vec4(0.0)))) return 0.0;
    uvec4 offsets = recipes[recipe + half_index];
    uvec4 radii = recipes[recipe + 2u + half_index];
    return weights.x * cached(offsets.x, int(radii.x), at)
         + weights.y * cached(offsets.y, int(radii.y), at)
         + weights.z * cached(offsets.z, int(radii.z), at)
         + weights.w * cached(offsets.w, int(radii.w), at);
}

float blended(uint recipe, ivec2 at) {
    return blended_half(recipe, 0u, at) + blended_half(recipe, 1u, at);
}

vec3 layer_weight(uint layer, ivec2 at) {
    uint recipe = layer * uint(RGB * RECIPE_WORDS);
    return vec3(blended(recipe, at), blended(recipe + uint(RECIPE_WORDS), at),
                blended(recipe + 2u * uint(RECIPE_WORDS), at));
}

void main() {
    uint interval = gl_WorkGroupID.y;
    uvec4 place = layers[interval * uint(LAYER_WORDS)];
    float scale = uintBitsToFloat(layers[interval * uint(LAYER_WORDS) + 1u].y);
    int radius = int(place.w);
    int width = 2 * radius + 1;
    int texel = int(gl_GlobalInvocationID.x);
    if (texel >= width * width) return;
    ivec2 at = ivec2(texel % width, texel / width) - radius;
    uint far = min(interval + 1u, uint(layer_count - 1));
    uvec4 packed_pair = pack_weights(layer_weight(interval, at), layer_weight(far, at), scale);
    imageStore(atlas, atlas_position(int(place.y) + texel), packed_pair);
}

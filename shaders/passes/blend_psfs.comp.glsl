// Blends cached PSFs into the kernels of field nodes, at both ends of layer intervals.
// In:  the store (16-bit weights, a texture array addressed as one line), RECIPES (per
//      layer and channel offsets, reaches and weights of six cached kernels: three nodes
//      of pupil and accommodation x two of defocus), NODES (records: near recipe, far
//      recipe, first texel, reach; peak, ...), WORK, PLAN.
// Out: the node atlas.
// Dispatch: groups of THREADS texels take the items of WORK in turn.
// Twin: reference.recipe_kernels.  Source: Csoba & Kunkli 2023, section 6.4.

layout(local_size_x = THREADS) in;

layout(std430, binding = BINDING_RECIPES) readonly buffer Recipes { uint recipes[]; };
layout(std430, binding = BINDING_NODES) readonly buffer Nodes { uvec4 nodes[]; };
layout(std430, binding = BINDING_WORK) readonly buffer Work { uvec2 work[]; };
layout(std430, binding = BINDING_PLAN) readonly buffer Plan { uint plan[]; };
layout(binding = TEXTURE_STORE) uniform usampler2DArray store;
#ifdef ATLAS_IS_BUFFER
layout(std430, binding = BINDING_NODE_ATLAS) writeonly buffer NodeAtlas { uvec4 node_atlas[]; };
#else
layout(rgba32ui, binding = IMAGE_NODES) writeonly uniform uimage2D node_atlas;
#endif

#include "common/atlas.glsl"
#include "common/work.glsl"
#include "common/reach.glsl"

float cached(uint offset, uint word, ivec2 at) {
    Reach reach = unpack_reach(word);
    if (!within(reach, at)) return 0.0;
    uint texel = offset + uint(reach_texel(reach, at));
    ivec3 place = ivec3(texel & uint(STORE_SIDE - 1),
                        (texel >> uint(STORE_SIDE_BITS)) & uint(STORE_SIDE - 1),
                        texel >> uint(2 * STORE_SIDE_BITS));
    return float(texelFetch(store, place, 0).r);
}

// Weighted sum of a recipe's kernels.
float blended(uint recipe, ivec2 at) {
    float sum = 0.0;
    for (uint tap = 0u; tap < uint(RECIPE_TAPS); ++tap) {
        float weight = uintBitsToFloat(recipes[recipe + 2u * uint(RECIPE_TAPS) + tap]);
        if (weight > 0.0)
            sum += weight * cached(recipes[recipe + tap],
                                   recipes[recipe + uint(RECIPE_TAPS) + tap], at);
    }
    return sum;
}

vec3 recipe_weight(uint index, ivec2 at) {
    uint recipe = index * uint(RGB * RECIPE_WORDS);
    return vec3(blended(recipe, at), blended(recipe + uint(RECIPE_WORDS), at),
                blended(recipe + 2u * uint(RECIPE_WORDS), at));
}

void blend(uint node, int texel) {
    uvec4 place = nodes[node * uint(NODE_WORDS)];
    float scale = uintBitsToFloat(nodes[node * uint(NODE_WORDS) + 1u].x);
    Reach reach = unpack_reach(place.w);
    if (texel >= reach_width(reach) * reach_height(reach)) return;
    ivec2 at = reach_offset(reach, texel);
    uvec4 ends = pack_weights(recipe_weight(place.x, at), recipe_weight(place.y, at), scale);
    ATLAS_STORE(node_atlas, int(place.z) + texel, ends);
}

void main() {
    uint count = work_count();
    for (uint item = gl_WorkGroupID.x; item < count; item += gl_NumWorkGroups.x) {
        int texel;
        uint node = work_kernel(item, texel);
        blend(node, texel);
    }
}

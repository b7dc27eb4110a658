// Blends the kernels of up to four field nodes into the kernel of an image cell.
// In:  the node atlas, NODES (as in blend_psfs), PARTS (four node kernels, four weights),
//      KERNELS (common/kernels.glsl), WORK.
// Out: the kernel atlas, single kernels.
// Dispatch: one group of THREADS texels per item of WORK.
// Twin: reference.kernel_pairs.  Source: Csoba & Kunkli 2023, section 6.3.

layout(local_size_x = THREADS) in;

layout(std430, binding = BINDING_NODES) readonly buffer Nodes { uvec4 nodes[]; };
layout(std430, binding = BINDING_PARTS) readonly buffer Parts { uvec4 parts[]; };
layout(std430, binding = BINDING_KERNELS) readonly buffer Kernels { uvec4 kernels[]; };
layout(std430, binding = BINDING_WORK) readonly buffer Work { uvec2 work[]; };
layout(binding = TEXTURE_NODES) uniform usampler2D node_atlas;
layout(rgba32ui, binding = IMAGE_ATLAS) writeonly uniform uimage2D atlas;

#include "common/atlas.glsl"
#include "common/kernels.glsl"
#include "common/work.glsl"
#include "common/reach.glsl"

void add_node(uint node, float weight, ivec2 at, inout vec3 near, inout vec3 far) {
    uvec4 place = nodes[node * uint(NODE_WORDS)];
    Reach reach = unpack_reach(place.w);
    if (weight == 0.0 || !within(reach, at)) return;
    float scale = uintBitsToFloat(nodes[node * uint(NODE_WORDS) + 1u].x);
    int texel = int(place.z) + reach_texel(reach, at);
    uvec4 ends = texelFetch(node_atlas, atlas_position(texel), 0);
    near += weight * scale / WEIGHT_MAX * near_weights(ends);
    far += weight * scale / WEIGHT_MAX * far_weights(ends);
}

void main() {
    uint kernel;
    int texel;
    if (!take_work(kernel, texel)) return;
    Reach reach = unpack_reach(kernel_reach(kernel));
    if (texel >= reach_width(reach) * reach_height(reach)) return;
    ivec2 at = reach_offset(reach, texel);
    uvec4 node = parts[kernel * uint(NODE_WORDS)];
    vec4 weight = uintBitsToFloat(parts[kernel * uint(NODE_WORDS) + 1u]);
    vec3 near = vec3(0.0);
    vec3 far = vec3(0.0);
    add_node(node.x, weight.x, at, near, far);
    add_node(node.y, weight.y, at, near, far);
    add_node(node.z, weight.z, at, near, far);
    add_node(node.w, weight.w, at, near, far);
    uvec4 ends = pack_weights(near, far, kernel_scale(kernel, 0));
    imageStore(atlas, atlas_position(int(kernel_offset(kernel, 0)) + texel), ends);
}

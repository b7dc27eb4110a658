// Blends the kernels of up to three field nodes into the kernel of an image cell.
// Each is mapped from the pixels it is stored in to the image's: a pixel receives the
// light of the stored pixels that it covers.
// In:  the node atlas, NODES (as in blend_psfs), PARTS (three node kernels; and at both ends
//      of the interval three weights, and three maps from offsets in the image to those in a
//      node's kernel), KERNELS (common/kernels.glsl), WORK, PLAN.
// Out: the kernel atlas, single kernels.
// Dispatch: groups of THREADS texels take the items of WORK in turn.
// Twin: reference.kernel_pairs.  Source: Csoba & Kunkli 2023, section 6.3.

layout(local_size_x = THREADS) in;

layout(std430, binding = BINDING_NODES) readonly buffer Nodes { uvec4 nodes[]; };
layout(std430, binding = BINDING_PARTS) readonly buffer Parts { uvec4 parts[]; };
layout(std430, binding = BINDING_KERNELS) readonly buffer Kernels { uvec4 kernels[]; };
layout(std430, binding = BINDING_WORK) readonly buffer Work { uvec2 work[]; };
layout(std430, binding = BINDING_PLAN) readonly buffer Plan { uint plan[]; };
#ifdef ATLAS_IS_BUFFER
layout(std430, binding = BINDING_NODE_ATLAS) readonly buffer NodeAtlas { uvec4 node_atlas[]; };
layout(std430, binding = BINDING_ATLAS) writeonly buffer Atlas { uvec4 atlas[]; };
#else
layout(binding = TEXTURE_NODES) uniform usampler2D node_atlas;
layout(rgba32ui, binding = IMAGE_ATLAS) writeonly uniform uimage2D atlas;
#endif

#include "common/atlas.glsl"
#include "common/kernels.glsl"
#include "common/work.glsl"
#include "common/reach.glsl"

// Pixels of a node's kernel that a pixel of the image covers.
struct Cover { vec2 low; vec2 high; };

Cover cover_of(vec4 map, ivec2 at) {
    vec2 middle = vec2(dot(map.xy, vec2(at)), dot(map.zw, vec2(at)));
    return Cover(middle - 0.5 * abs(map.xw), middle + 0.5 * abs(map.xw));
}

float covered(Cover cover, vec2 stored) {
    vec2 sides = min(cover.high, stored + 0.5) - max(cover.low, stored - 0.5);
    sides = max(sides, 0.0);
    return sides.x * sides.y;
}

// Adds one part of a kernel at an offset from its center.  Both ends of the interval have
// maps of their own.
void add_node(uint part, uint index, ivec2 at, inout vec3 near, inout vec3 far) {
    vec2 weight = vec2(uintBitsToFloat(parts[part + 1u][index]),
                       uintBitsToFloat(parts[part + 2u][index]));
    if (weight == vec2(0.0)) return;
    uint node = parts[part][index];
    uvec4 place = nodes[node * uint(NODE_WORDS)];
    Reach reach = unpack_reach(place.w);
    weight *= uintBitsToFloat(nodes[node * uint(NODE_WORDS) + 1u].x) / WEIGHT_MAX;
    uint maps = part + uint(PART_MAPS) + index;
    Cover near_cover = cover_of(uintBitsToFloat(parts[maps]), at);
    Cover far_cover = cover_of(uintBitsToFloat(parts[maps + uint(FIELD_CORNERS)]), at);
    vec2 low = min(near_cover.low, far_cover.low);
    vec2 high = max(near_cover.high, far_cover.high);
    ivec2 first = max(ivec2(floor(low + 0.5)), -ivec2(reach.left, reach.up));
    ivec2 last = min(ivec2(ceil(high - 0.5)), ivec2(reach.right, reach.down));
    if (first.x > last.x) return;
    // One loop: llvmpipe executes each loop once more than its condition holds.
    for (ivec2 stored = first; stored.y <= last.y;) {
        uvec4 ends = ATLAS_FETCH(node_atlas, int(place.z) + reach_texel(reach, stored));
        near += weight.x * covered(near_cover, vec2(stored)) * near_weights(ends);
        far += weight.y * covered(far_cover, vec2(stored)) * far_weights(ends);
        bool row_ends = stored.x == last.x;
        stored = row_ends ? ivec2(first.x, stored.y + 1) : stored + ivec2(1, 0);
    }
}

void blend(uint kernel, int texel) {
    Reach reach = unpack_reach(kernel_reach(kernel));
    if (texel >= reach_width(reach) * reach_height(reach)) return;
    ivec2 at = reach_offset(reach, texel);
    uint part = kernel * uint(PART_WORDS);
    vec3 near = vec3(0.0);
    vec3 far = vec3(0.0);
    for (uint index = 0u; index < uint(FIELD_CORNERS); ++index)
        add_node(part, index, at, near, far);
    uvec4 ends = pack_weights(near, far, kernel_scale(kernel, 0));
    ATLAS_STORE(atlas, int(kernel_offset(kernel, 0)) + texel, ends);
}

void main() {
    uint count = work_count();
    for (uint item = gl_WorkGroupID.x; item < count; item += gl_NumWorkGroups.x) {
        int texel;
        uint kernel = work_kernel(item, texel);
        blend(kernel, texel);
    }
}

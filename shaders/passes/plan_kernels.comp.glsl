// Plans the new kernels: their parts (node kernels with weights and maps), their sizes at
// all levels, and the work of the passes that blend them.
// In:  KERNEL_PAIRS, CELLS, NODE_OF, NODES.
// Out: KERNELS (common/kernels.glsl), PARTS, WORK, PLAN.
// Dispatch: groups of GROUP_THREADS take the new kernels in turn.
// Twin: tests/numerical/plan_twin.py (frame_kernels).

layout(local_size_x = GROUP_THREADS) in;

layout(std430, binding = BINDING_KERNEL_PAIRS) readonly buffer Pairs { uvec2 pairs[]; };
layout(std430, binding = BINDING_CELLS) readonly buffer Cells { uint cells[]; };
layout(std430, binding = BINDING_NODE_OF) readonly buffer NodeOf { uint node_of[]; };
layout(std430, binding = BINDING_NODES) readonly buffer Nodes { uvec4 nodes[]; };
layout(std430, binding = BINDING_KERNELS) writeonly buffer Kernels { uvec4 kernels[]; };
layout(std430, binding = BINDING_PARTS) writeonly buffer Parts { uvec4 parts[]; };
layout(std430, binding = BINDING_WORK) writeonly buffer Work { uvec2 work[]; };
layout(std430, binding = BINDING_PLAN) buffer Plan { uint plan[]; };

#include "common/layers.glsl"
#include "common/reach.glsl"
#include "common/plan.glsl"
#include "common/work_lists.glsl"

uniform int layer_count;
uniform float merge_spread_px;    // smallest spread of kernels that merged squares use
uniform uint kernel_capacity;
uniform uint texel_capacity;      // of the kernel atlas

const int LEVELS = MAX_LEVEL + 1;

shared uint first_item[LEVELS];
shared uint item_count[LEVELS];

// Sum of the parts of a kernel, and the largest of their sides.
struct Sizes { ivec4 reach; int radius; float peak; vec2 spread; };

// A map from the image's pixels to a node's, and what it does to a kernel.
struct Map { vec4 to_node; float area; float box; };

const vec4 UNMOVED = vec4(1.0, 0.0, 0.0, 1.0);

// A map as far as a kernel of this spread needs it: not if it changes little.
Map needed_map(vec4 map, float spread_px) {
    float change = length(map - UNMOVED);
    float shift_px = change * (spread_px + KERNEL_TAIL_PX);
    float share = clamp((change - MIN_SHIFT_RATIO) / MIN_SHIFT_FADE_RATIO, 0.0, 1.0)
                * clamp((shift_px - MIN_SHIFT_PX) / MIN_SHIFT_FADE_PX, 0.0, 1.0);
    map = mix(UNMOVED, map, share);
    float area = abs(map.x * map.w - map.y * map.z);
    return Map(map, area, area / abs(map.x * map.w));
}

// Reaches along an axis of the image, from those in the node's pixels: row of the inverse
// map.  Linear interpolation extends the light by one stored pixel.
ivec2 mapped_sides(vec2 row, vec4 stored) {
    vec4 ends = row.xxyy * vec4(-stored.x, stored.y, -stored.z, stored.w);
    vec2 low = vec2(min(ends.x, ends.y), min(ends.z, ends.w));
    vec2 high = vec2(max(ends.x, ends.y), max(ends.z, ends.w));
    vec2 sides = ceil(vec2(-low.x - low.y, high.x + high.y) - MAP_ROUNDING_PX) - 1.0;
    return clamp(ivec2(sides), 0, MAX_REACH_PX);
}

// Widens a kernel by a part at one end of its interval.
void add_end(Map map, ivec4 sides, int radius, inout Sizes sum) {
    if (map.to_node != UNMOVED) {
        vec4 to_node = map.to_node;
        float determinant = to_node.x * to_node.w - to_node.y * to_node.z;
        float longest = 0.5 * (length(vec2(to_node.x + to_node.w, to_node.y - to_node.z))
                               + length(vec2(to_node.x - to_node.w, to_node.y + to_node.z)));
        vec4 stored = vec4(sides) + 1.0;
        sides = ivec4(mapped_sides(vec2(to_node.w, -to_node.y) / determinant, stored),
                      mapped_sides(vec2(-to_node.z, to_node.x) / determinant, stored));
        radius = int(min(ceil(longest / map.area * float(radius + 1)), float(MAX_REACH_PX)));
    }
    sum.reach = max(sum.reach, sides);
    sum.radius = max(sum.radius, radius);
}

// Writes a part's node, and its weights and maps at both ends, and adds it to the sums.
void add_part(uint kernel, uint corner, uint cell, uint interval, inout uvec4 part,
              inout vec4 near_weights, inout vec4 far_weights, inout Sizes sum) {
    uint record = cell * uint(CELL_WORDS);
    float weight = uintBitsToFloat(cells[record + uint(FIELD_CORNERS) + corner]);
    uint map_at = record + 2u * uint(FIELD_CORNERS) + corner * uint(MAP_WORDS);
    vec4 map = uintBitsToFloat(uvec4(cells[map_at], cells[map_at + 1u], cells[map_at + 2u],
                                     cells[map_at + 1u + 2u]));
    uint node = 0u;
    Map near = Map(UNMOVED, 1.0, 1.0);
    Map far = near;
    if (weight > 0.0) {
        uint field = cells[record + corner];
        node = node_of[field * uint(interval_count(layer_count)) + interval];
        Reach reach = unpack_reach(nodes[node * uint(NODE_WORDS)].w);
        uvec4 sizes = nodes[node * uint(NODE_WORDS) + 1u];
        ivec4 sides = ivec4(reach.left, reach.right, reach.up, reach.down);
        vec2 spread_px = uintBitsToFloat(sizes.yz);
        near = needed_map(map, spread_px.x);
        far = needed_map(map, spread_px.y);
        add_end(near, sides, int(sizes.w), sum);
        add_end(far, sides, int(sizes.w), sum);
        sum.peak += uintBitsToFloat(sizes.x) * weight * max(near.area, far.area);
        sum.spread += spread_px * weight / sqrt(vec2(near.area, far.area));
    }
    part[corner] = node;
    near_weights[corner] = weight * near.box;
    far_weights[corner] = weight * far.box;
    uint maps = kernel * uint(PART_WORDS) + uint(PART_MAPS) + corner;
    parts[maps] = floatBitsToUint(near.to_node);
    parts[maps + uint(FIELD_CORNERS)] = floatBitsToUint(far.to_node);
}

// Writes the record of a kernel, and asks for its texels at every level that blur as wide
// as its own may use.
void write_kernel(uint kernel, Sizes sum) {
    float widest_px = max(max(sum.spread.x, sum.spread.y), MIN_SPREAD_PX);
    int highest = clamp(int(floor(log2(widest_px / merge_spread_px))) + 1, 0, MAX_LEVEL);
    ivec2 box = sum.reach.xz + sum.reach.yw + 1;
    uvec4 sizes = uvec4(0u);
    uvec4 scales;
    uint total = 0u;
    for (int level = 0; level < LEVELS; ++level) {
        int side = 1 << level;
        if (level <= highest) sizes[level] = uint((box.x + side - 1) * (box.y + side - 1));
        total += sizes[level];
        float scale = level == 0 ? sum.peak : min(sum.peak * float(side * side), 1.0);
        scales[level] = floatBitsToUint(scale);
    }
    uint start = place_texels(PLAN_TEXELS, total, texel_capacity);
    atomicAdd(plan[PLAN_BASE_TEXELS], sizes[0]);
    ivec2 farthest = max(sum.reach.xz, sum.reach.yw);
    atomicMax(plan[PLAN_REACH], uint(max(farthest.x, farthest.y)));
    uvec4 starts = uvec4(uint(NO_LEVEL));
    for (int level = 0; level < LEVELS; ++level) {
        item_count[level] = work_items(sizes[level]);
        if (level > highest) continue;
        starts[level] = start;
        start += sizes[level];
        first_item[level] = add_items(1 + level, item_count[level]);
    }
    Reach reach = Reach(sum.reach.x, sum.reach.y, sum.reach.z, sum.reach.w);
    uint record = kernel * uint(KERNEL_WORDS);
    kernels[record] = uvec4(floatBitsToUint(sum.spread), uint(sum.radius), pack_reach(reach));
    kernels[record + 1u] = starts;
    kernels[record + 2u] = scales;
}

void plan_kernel(uint kernel) {
    uvec2 pair = pairs[kernel];
    Sizes sum = Sizes(ivec4(0), 0, 0.0, vec2(0.0));
    uvec4 part = uvec4(0u);
    vec4 near_weights = vec4(0.0);
    vec4 far_weights = vec4(0.0);
    for (uint corner = 0u; corner < uint(FIELD_CORNERS); ++corner)
        add_part(kernel, corner, pair.x, pair.y, part, near_weights, far_weights, sum);
    uint record = kernel * uint(PART_WORDS);
    parts[record] = part;
    parts[record + 1u] = floatBitsToUint(near_weights);
    parts[record + 2u] = floatBitsToUint(far_weights);
    write_kernel(kernel, sum);
}

void main() {
    uint count = min(plan[PLAN_KERNELS], kernel_capacity);
    uint kernel = plan[PLAN_OLD_KERNELS] + gl_WorkGroupID.x;
    for (; kernel < count; kernel += gl_NumWorkGroups.x) {
        barrier();  // the work of the previous kernel has been written
        if (gl_LocalInvocationIndex == 0u) plan_kernel(kernel);
        barrier();  // the items are known
        for (int level = 0; level < LEVELS; ++level)
            write_items(1 + level, first_item[level], item_count[level], kernel);
    }
}

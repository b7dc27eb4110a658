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

// Whether a map changes a kernel noticeably.
bool needs_map(vec4 map, int radius) {
    float change = length(map - vec4(1.0, 0.0, 0.0, 1.0));
    return change > MIN_SHIFT_RATIO && change * float(radius) > MIN_SHIFT_PX;
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

// Writes a part's node, weight and map, and adds it to the sums.
void add_part(uint kernel, uint corner, uint cell, uint interval, inout uvec4 part,
              inout uvec4 weights, inout Sizes sum) {
    uint record = cell * uint(CELL_WORDS);
    float weight = uintBitsToFloat(cells[record + uint(FIELD_CORNERS) + corner]);
    uint map_at = record + 2u * uint(FIELD_CORNERS) + corner * uint(MAP_WORDS);
    vec4 map = uintBitsToFloat(uvec4(cells[map_at], cells[map_at + 1u], cells[map_at + 2u],
                                     cells[map_at + 1u + 2u]));
    uint node = 0u;
    vec4 used_map = vec4(1.0, 0.0, 0.0, 1.0);
    if (weight > 0.0) {
        uint field = cells[record + corner];
        node = node_of[field * uint(interval_count(layer_count)) + interval];
        Reach reach = unpack_reach(nodes[node * uint(NODE_WORDS)].w);
        uvec4 sizes = nodes[node * uint(NODE_WORDS) + 1u];
        ivec4 sides = ivec4(reach.left, reach.right, reach.up, reach.down);
        int radius = int(sizes.w);
        float area = 1.0;
        float box = 1.0;
        if (needs_map(map, radius)) {
            used_map = map;
            float determinant = map.x * map.w - map.y * map.z;
            area = abs(determinant);
            box = area / abs(map.x * map.w);
            float longest = 0.5 * (length(vec2(map.x + map.w, map.y - map.z))
                                   + length(vec2(map.x - map.w, map.y + map.z)));
            vec4 stored = vec4(sides) + 1.0;
            sides = ivec4(mapped_sides(vec2(map.w, -map.y) / determinant, stored),
                          mapped_sides(vec2(-map.z, map.x) / determinant, stored));
            radius = int(min(ceil(longest / area * float(radius + 1)), float(MAX_REACH_PX)));
        }
        sum.peak += uintBitsToFloat(sizes.x) * weight * area;
        sum.spread += uintBitsToFloat(sizes.yz) * (weight / sqrt(area));
        sum.reach = max(sum.reach, sides);
        sum.radius = max(sum.radius, radius);
        weight *= box;
    }
    part[corner] = node;
    weights[corner] = floatBitsToUint(weight);
    parts[kernel * uint(PART_WORDS) + 2u + corner] = floatBitsToUint(used_map);
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
    uvec4 weights = uvec4(0u);
    for (uint corner = 0u; corner < uint(FIELD_CORNERS); ++corner)
        add_part(kernel, corner, pair.x, pair.y, part, weights, sum);
    parts[kernel * uint(PART_WORDS)] = part;
    parts[kernel * uint(PART_WORDS) + 1u] = weights;
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

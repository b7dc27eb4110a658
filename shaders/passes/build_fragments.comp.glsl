// Converts color and depth of the input frame to linear light, vergences and layer
// positions, and marks the kernels that the frame needs, for each surface: the visible
// one and the hidden one.
// In:  COLOR_IN (bytes RGB, sRGB; or linear RGB: f32 when COLOR_IS_LINEAR, halves when
//      COLOR_IS_HALF),
//      DEPTH_IN (f32 meters; hidden pixels are empty unless it is above 0),
//      or both in textures when FROM_TEXTURES, where missing depth is infinite,
//      LAYER_DPT, FIELD_DEFOCUS (change of defocus at the corners of the cells).
// Out: PIXELS (linear RGB, vergence dpt; negative where nothing is hidden),
//      PIXEL_LAYER (position), BLOCK_LIGHT (sum of the visible surface's linear RGB over a
//      block, number of its pixels), USED (a bit per cell and interval), STATS
//      (pixels without depth, outside the prepared distances, and without a finite color,
//      which becomes 0).
// Dispatch: one thread per pixel, 8 x 8 groups, z is the surface.
// Twin: reference.gather (intervals, cells, used pairs).
// Source: Csoba & Kunkli 2023, section 6.1; radial depth as in CONVENTIONS.md.

#include "common/color.glsl"

layout(local_size_x = TILE_SIZE_PX, local_size_y = TILE_SIZE_PX) in;

#ifdef FROM_TEXTURES
#include "common/input_textures.glsl"
#else
layout(std430, binding = BINDING_COLOR_IN) readonly buffer ColorIn { uint color_in[]; };
layout(std430, binding = BINDING_DEPTH_IN) readonly buffer DepthIn { float depth_in[]; };
#endif
layout(std430, binding = BINDING_LAYER_DPT) readonly buffer LayerDpt { float layer_dpt[]; };
layout(std430, binding = BINDING_PIXELS) writeonly buffer Pixels { vec4 pixels[]; };
layout(std430, binding = BINDING_PIXEL_LAYER) writeonly buffer Position { float position[]; };
layout(std430, binding = BINDING_BLOCK_LIGHT) writeonly buffer Light { vec4 block_light[]; };
layout(std430, binding = BINDING_FIELD_DEFOCUS) readonly buffer Field { float field_dpt[]; };
// Coherent: bits set by other groups are visible, and not set again.
layout(std430, binding = BINDING_USED) coherent buffer Used { uint used[]; };
layout(std430, binding = BINDING_STATS) buffer Stats { uint stats[]; };

#include "common/layers.glsl"
#include "common/cells.glsl"

uniform ivec2 frame_size_px;
uniform int layer_count;
uniform int words_per_cell;
uniform vec4 tangents;            // left, right, up, down
uniform int depth_is_planar;
uniform vec2 object_range_dpt;    // prepared distances of objects; others are counted
uniform ivec4 counted_px;         // counted pixels: first column, row; last ones plus one
uniform vec2 vergence_range_dpt;  // to which vergences are clamped
uniform float vergence_scale;     // over distance and offset: vergence at the cornea
uniform float vergence_offset_m;

bool group_lies_in_one_cell() { return cell_px == 0 || cell_px >= TILE_SIZE_PX; }
uniform float blur_px_per_dpt;    // slope of defocus blur at this pupil

shared uint group_used[MAX_LAYERS / BITS_PER_WORD];
shared uint group_stats[STAT_FRAGMENTS];  // counters of this pass
shared vec4 group_light[THREADS];         // linear RGB and 1, of each pixel in the image

#ifdef FROM_TEXTURES
ivec2 image_pixel(uint pixel) {
    return ivec2(int(pixel) % frame_size_px.x, int(pixel) / frame_size_px.x);
}

vec3 read_linear_rgb(uint pixel) {
    return input_color(image_pixel(pixel), frame_size_px).rgb;
}

float read_depth_m(uint pixel) { return input_depth_m(image_pixel(pixel), frame_size_px); }
#else
uint byte_at(uint index) {
    uint word = color_in[index / uint(BYTES_PER_WORD)];
    return (word >> (uint(BYTE_BITS) * (index % uint(BYTES_PER_WORD)))) & BYTE_MASK;
}

float half_at(uint index) {
    vec2 pair = unpackHalf2x16(color_in[index / uint(HALVES_PER_WORD)]);
    return pair[index % uint(HALVES_PER_WORD)];
}

vec3 read_linear_rgb(uint pixel) {
    uint first = pixel * uint(RGB);
#ifdef COLOR_IS_LINEAR
    return vec3(uintBitsToFloat(color_in[first]), uintBitsToFloat(color_in[first + 1u]),
                uintBitsToFloat(color_in[first + 2u]));
#elif defined(COLOR_IS_HALF)
    return vec3(half_at(first), half_at(first + 1u), half_at(first + 2u));
#else
    uvec3 bytes = uvec3(byte_at(first), byte_at(first + 1u), byte_at(first + 2u));
    return linear_from_srgb(vec3(bytes) / BYTE_MAX);
#endif
}

float read_depth_m(uint pixel) { return depth_in[pixel]; }
#endif

// Whether depth is present: above 0, or infinite.  Tested by its bits, because a compiler
// may assume that no value is NaN.
bool is_depth(float depth_m) {
    uint bits = floatBitsToUint(depth_m);
    return bits != 0u && bits <= uint(FLOAT_INFINITY_BITS);
}

vec3 finite(vec3 value, out bool is_finite) {
    uvec3 infinity = uvec3(uint(FLOAT_INFINITY_BITS));
    bvec3 bad = equal(floatBitsToUint(value) & infinity, infinity);
    is_finite = !any(bad);
    return mix(value, vec3(0.0), bad);
}

// Planar view depth to distance from the eye: the ray through a pixel has length
// sqrt(1 + tan_x^2 + tan_y^2) per unit of depth.  Distance to vergence at the cornea.
float stretch_at(vec2 position) {
    vec2 tangent = mix(tangents.xz, tangents.yw, (position + 0.5) / vec2(frame_size_px));
    return depth_is_planar != 0 ? sqrt(1.0 + dot(tangent, tangent)) : 1.0;
}

float vergence_dpt(float depth_m, vec2 position) {
    float distance_m = max(depth_m * stretch_at(position), NEAREST_M) + vergence_offset_m;
    return isinf(depth_m) ? 0.0 : vergence_scale / distance_m;
}

bool is_prepared(float depth_m, vec2 position) {
    float dpt = isinf(depth_m) ? 0.0 : 1.0 / (depth_m * stretch_at(position));
    return dpt >= object_range_dpt.x && dpt <= object_range_dpt.y;
}

// Change of defocus over the field, interpolated between the corners of a pixel's cell.
float field_defocus_dpt(ivec2 at) {
    if (cell_px == 0) return 0.0;
    int cell = cell_of(at);
    int corner = cell + cell / cell_columns;  // each row has one corner more than cells
    vec2 share = (vec2(image_place(at) % cell_px) + 0.5) / float(cell_px);
    float above = mix(field_dpt[corner], field_dpt[corner + 1], share.x);
    int below = corner + cell_columns + 1;
    return mix(above, mix(field_dpt[below], field_dpt[below + 1], share.x), share.y);
}

// Layer position of a distance, between the first and the last layer.
float layer_position(float dpt) {
    int low = 0;
    int high = max(layer_count - 2, 0);
    while (low < high) {
        int middle = (low + high + 1) / 2;
        if (layer_dpt[middle] <= dpt) low = middle;
        else high = middle - 1;
    }
    if (layer_count < 2) return 0.0;
    float span = max(layer_dpt[low + 1] - layer_dpt[low], MIN_BLUR_RANGE);
    return float(low) + clamp((dpt - layer_dpt[low]) / span, 0.0, 1.0);
}

float prepared_dpt(float dpt) {
    return clamp(dpt, vergence_range_dpt.x, vergence_range_dpt.y);
}

// Object distance, or NOTHING_DPT if a hidden pixel is empty, or so close to the surface
// in front of it that the two would blur alike.
float distance_of(uint pixel, uint seen, vec2 at) {
    float depth_m = read_depth_m(pixel);
#ifdef FROM_TEXTURES
    if (!is_depth(depth_m)) return prepared_dpt(0.0);
#endif
    if (pixel == seen) return prepared_dpt(vergence_dpt(depth_m, at));
    if (!is_depth(depth_m)) return NOTHING_DPT;
    float dpt = prepared_dpt(vergence_dpt(depth_m, at));
    float behind = prepared_dpt(vergence_dpt(read_depth_m(seen), at)) - dpt;
    return behind * blur_px_per_dpt > DISCONTINUITY_PX ? dpt : NOTHING_DPT;
}

void note_use(ivec2 at, float place) {
    int interval = position_interval(place, layer_count);
    uint bit = 1u << uint(interval % BITS_PER_WORD);
    uint word = uint(interval / BITS_PER_WORD);
    if (group_lies_in_one_cell()) {
        atomicOr(group_used[word], bit);
        return;
    }
    word += uint(cell_of(at) * words_per_cell);
    if ((used[word] & bit) == 0u) atomicOr(used[word], bit);
}

// Counts the defects of a pixel, once: repeated pixels of a frame are not counted.
void note_faults(ivec2 at, uint pixel, uint seen, bool is_finite) {
    if (any(lessThan(at, counted_px.xy)) || any(greaterThanEqual(at, counted_px.zw))) return;
    float depth_m = read_depth_m(pixel);
    bool holds = is_depth(depth_m);
    if (!holds && pixel == seen) atomicAdd(group_stats[STAT_MISSING], 1u);
    if (!is_finite && (holds || pixel == seen)) atomicAdd(group_stats[STAT_BAD_COLOR], 1u);
    if (holds && !is_prepared(depth_m, vec2(at)))
        atomicAdd(group_stats[STAT_CLAMPED], 1u);
}

// Sums the light of the visible surface in the group's block, row by row.
void sum_light(uint thread) {
    if (thread < uint(TILE_SIZE_PX)) {
        vec4 row = vec4(0.0);
        for (int x = 0; x < TILE_SIZE_PX; ++x)
            row += group_light[int(thread) * TILE_SIZE_PX + x];
        group_light[thread * uint(TILE_SIZE_PX)] = row;
    }
    barrier();  // the sums of the rows are known
    if (thread == 0u) {
        vec4 sum = vec4(0.0);
        for (int y = 0; y < TILE_SIZE_PX; ++y) sum += group_light[y * TILE_SIZE_PX];
        block_light[gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x] = sum;
    }
}

void main() {
    uint thread = gl_LocalInvocationIndex;
    for (uint word = thread; word < uint(words_per_cell); word += uint(THREADS))
        group_used[word] = 0u;
    if (thread < uint(STAT_FRAGMENTS)) group_stats[thread] = 0u;
    group_light[thread] = vec4(0.0);
    barrier();  // all bits are clear
    ivec2 at = ivec2(gl_GlobalInvocationID.xy);
    if (all(lessThan(at, frame_size_px))) {
        uint seen = uint(at.y * frame_size_px.x + at.x);
        uint pixel = seen + gl_WorkGroupID.z * uint(frame_size_px.x * frame_size_px.y);
        bool is_finite;
        vec3 linear_rgb = finite(read_linear_rgb(pixel), is_finite);
        note_faults(at, pixel, seen, is_finite);
        float dpt = distance_of(pixel, seen, vec2(at));
        if (dpt >= 0.0) {
            float place = layer_position(dpt + field_defocus_dpt(at));
            position[pixel] = place;
            note_use(at, place);
        }
        pixels[pixel] = vec4(linear_rgb, dpt);
        group_light[thread] = vec4(linear_rgb, 1.0);
    }
    barrier();  // all pixels of the group have set their bits
    uint lane = (gl_WorkGroupID.x + gl_WorkGroupID.y) % uint(STAT_LANES);
    if (thread < uint(STAT_FRAGMENTS) && group_stats[thread] != 0u)
        atomicAdd(stats[lane * uint(STAT_WORDS) + thread], group_stats[thread]);
    if (gl_WorkGroupID.z == 0u) sum_light(thread);
    if (!group_lies_in_one_cell()) return;
    int first = cell_of(ivec2(gl_WorkGroupID.xy) * TILE_SIZE_PX) * words_per_cell;
    for (uint word = thread; word < uint(words_per_cell); word += uint(THREADS)) {
        uint bits = group_used[word];
        // Most groups find their bits set: thousands of atomics on one word serialize.
        if ((used[uint(first) + word] & bits) != bits) atomicOr(used[uint(first) + word], bits);
    }
}

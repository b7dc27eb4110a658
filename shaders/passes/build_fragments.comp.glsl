// Turns colour and depth of the input frame into linear light, dioptres and layer
// positions, and notes which kernels the frame needs.  Surface after surface: what is
// seen, and what it hides.
// In:  COLOR_IN (bytes RGB, sRGB; or f32 RGB, linear when COLOR_IS_LINEAR),
//      DEPTH_IN (f32 metres; all valid in what is seen, 0 where nothing is hidden),
//      LAYER_DPT.
// Out: PIXELS (linear RGB, object distance dpt; negative where nothing is hidden),
//      PIXEL_LAYER (position), USED (a bit per cell and interval).
// Dispatch: one thread a pixel, 8 x 8 groups, z the surface; a group lies in one cell.
// Twin: reference.gather (intervals, cells, used pairs).  Source: section 6.1; radial depth as DESIGN 3.

#include "common/color.glsl"

layout(local_size_x = TILE_SIZE_PX, local_size_y = TILE_SIZE_PX) in;

layout(std430, binding = BINDING_COLOR_IN) readonly buffer ColorIn { uint color_in[]; };
layout(std430, binding = BINDING_DEPTH_IN) readonly buffer DepthIn { float depth_in[]; };
layout(std430, binding = BINDING_LAYER_DPT) readonly buffer LayerDpt { float layer_dpt[]; };
layout(std430, binding = BINDING_PIXELS) writeonly buffer Pixels { vec4 pixels[]; };
layout(std430, binding = BINDING_PIXEL_LAYER) writeonly buffer Position { float position[]; };
layout(std430, binding = BINDING_USED) buffer Used { uint used[]; };

#include "common/layers.glsl"
#include "common/cells.glsl"

uniform ivec2 frame_size_px;
uniform int layer_count;
uniform int words_per_cell;
uniform vec4 tangents;            // left, right, up, down
uniform int depth_is_planar;
uniform float blur_px_per_dpt;    // slope of defocus blur at this pupil

shared uint group_used[MAX_LAYERS / BITS_PER_WORD];

uint byte_at(uint index) {
    uint word = color_in[index / uint(BYTES_PER_WORD)];
    return (word >> (uint(BYTE_BITS) * (index % uint(BYTES_PER_WORD)))) & BYTE_MASK;
}

vec3 read_linear_rgb(uint pixel) {
    uint first = pixel * uint(RGB);
#ifdef COLOR_IS_LINEAR
    return vec3(uintBitsToFloat(color_in[first]), uintBitsToFloat(color_in[first + 1u]),
                uintBitsToFloat(color_in[first + 2u]));
#else
    uvec3 bytes = uvec3(byte_at(first), byte_at(first + 1u), byte_at(first + 2u));
    return linear_from_srgb(vec3(bytes) / BYTE_MAX);
#endif
}

// Planar view depth to distance from the eye: the ray through a pixel has length
// sqrt(1 + tan_x^2 + tan_y^2) per unit of depth.
float object_dpt(float depth_m, vec2 position) {
    vec2 tangent = mix(tangents.xz, tangents.yw, (position + 0.5) / vec2(frame_size_px));
    float stretch = depth_is_planar != 0 ? sqrt(1.0 + dot(tangent, tangent)) : 1.0;
    return isinf(depth_m) ? 0.0 : 1.0 / (depth_m * stretch);
}

// Layer position of a distance between the first and the last layer.
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

// Object distance, or NOTHING_DPT where a hidden pixel is empty, or as good as on the
// surface before it: the two would blur alike.
float distance_of(uint pixel, uint seen, vec2 at) {
    if (pixel == seen) return object_dpt(depth_in[pixel], at);
    if (depth_in[pixel] == 0.0) return NOTHING_DPT;
    float dpt = object_dpt(depth_in[pixel], at);
    float behind = object_dpt(depth_in[seen], at) - dpt;
    return behind * blur_px_per_dpt > DISCONTINUITY_PX ? dpt : NOTHING_DPT;
}

void main() {
    uint thread = gl_LocalInvocationIndex;
    for (uint word = thread; word < uint(words_per_cell); word += uint(THREADS))
        group_used[word] = 0u;
    barrier();  // no bit is left from before
    ivec2 at = ivec2(gl_GlobalInvocationID.xy);
    if (all(lessThan(at, frame_size_px))) {
        uint seen = uint(at.y * frame_size_px.x + at.x);
        uint pixel = seen + gl_WorkGroupID.z * uint(frame_size_px.x * frame_size_px.y);
        float dpt = distance_of(pixel, seen, vec2(at));
        if (dpt >= 0.0) {
            dpt = clamp(dpt, layer_dpt[0], layer_dpt[layer_count - 1]);
            float place = layer_position(dpt);
            int interval = position_interval(place, layer_count);
            position[pixel] = place;
            atomicOr(group_used[interval / BITS_PER_WORD],
                     1u << uint(interval % BITS_PER_WORD));
        }
        pixels[pixel] = vec4(read_linear_rgb(pixel), dpt);
    }
    barrier();  // all pixels of the group have noted theirs
    int first = cell_of(ivec2(gl_WorkGroupID.xy) * TILE_SIZE_PX) * words_per_cell;
    for (uint word = thread; word < uint(words_per_cell); word += uint(THREADS))
        if (group_used[word] != 0u) atomicOr(used[uint(first) + word], group_used[word]);
}

// Turns colour and depth of the input frame into linear light, dioptres and kernel spread.
// In:  COLOR_IN (bytes RGB, sRGB; or f32 RGB, linear when COLOR_IS_LINEAR),
//      DEPTH_IN (f32 metres, all valid), LAYERS.
// Out: PIXELS (linear RGB, object distance dpt), PIXEL_SPREAD (spread of the kernel, px).
// Dispatch: one thread a pixel, 8 x 8 groups.
// Twin: reference.build_fragments.  Source: section 6.1; radial depth as DESIGN 3.

#include "common/color.glsl"

layout(local_size_x = TILE_SIZE_PX, local_size_y = TILE_SIZE_PX) in;

layout(std430, binding = BINDING_COLOR_IN) readonly buffer ColorIn { uint color_in[]; };
layout(std430, binding = BINDING_DEPTH_IN) readonly buffer DepthIn { float depth_in[]; };
layout(std430, binding = BINDING_LAYERS) readonly buffer Layers { uvec4 layers[]; };
layout(std430, binding = BINDING_PIXELS) writeonly buffer Pixels { vec4 pixels[]; };
layout(std430, binding = BINDING_PIXEL_SPREAD) writeonly buffer Spread { float spread_px[]; };

#include "common/layers.glsl"

uniform ivec2 frame_size_px;
uniform int layer_count;
uniform vec4 tangents;            // left, right, up, down
uniform int depth_is_planar;

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

void main() {
    ivec2 at = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(at, frame_size_px))) return;
    uint pixel = uint(at.y * frame_size_px.x + at.x);
    float dpt = object_dpt(depth_in[pixel], vec2(at));
    dpt = clamp(dpt, layer_object_dpt(0), layer_object_dpt(layer_count - 1));
    int k = find_interval(dpt, layer_count);
    float spread = layer_spread_px(k);
    if (layer_count > 1)
        spread = mix(spread, layer_spread_px(k + 1), interval_fraction(k, dpt, layer_count));
    pixels[pixel] = vec4(read_linear_rgb(pixel), dpt);
    spread_px[pixel] = spread;
}

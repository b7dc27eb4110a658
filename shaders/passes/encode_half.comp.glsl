// Packs the filtered frame as linear half floats, six bytes per pixel.
// In:  COLOR_OUT (vec4 linear).   Out: COLOR_IN, whose first bytes it overwrites.
// Dispatch: one thread per two pixels (three words).
// Twin: filter_service.rendering.srgb.half_from_linear.

layout(local_size_x = THREADS) in;

#include "common/line.glsl"

layout(std430, binding = BINDING_COLOR_OUT) readonly buffer ColorOut { vec4 color_out[]; };
layout(std430, binding = BINDING_COLOR_IN) writeonly buffer Packed { uint packed_rgb[]; };

uniform int pixel_count;

// The nearest half float, ties to even, as a float.  GLSL leaves the rounding of
// packHalf2x16 to the driver, and some truncate.
vec3 rounded(vec3 linear_rgb) {
    uvec3 bits = floatBitsToUint(clamp(linear_rgb, -HALF_MAX, HALF_MAX));
    uint step = 1u << uint(HALF_DROPPED_BITS);
    bits += step / 2u - 1u + ((bits >> uint(HALF_DROPPED_BITS)) & 1u);
    return uintBitsToFloat(bits & ~(step - 1u));
}

void main() {
    int first = thread_index() * HALVES_PER_WORD;
    if (first >= pixel_count) return;
    vec3 left = rounded(color_out[first].rgb);
    vec3 right = rounded(color_out[min(first + 1, pixel_count - 1)].rgb);
    int target = thread_index() * RGB;
    packed_rgb[target] = packHalf2x16(left.rg);
    packed_rgb[target + 1] = packHalf2x16(vec2(left.b, right.r));
    packed_rgb[target + 2] = packHalf2x16(right.gb);
}

// Packs the filtered frame as linear half floats, six bytes per pixel.
// In:  COLOR_OUT (vec4 linear).   Out: COLOR_IN, whose first bytes it overwrites.
// Dispatch: one thread per two pixels (three words).
// Twin: filter_service.rendering.media_effects.half_from_linear.

layout(local_size_x = THREADS) in;

#include "common/line.glsl"
#include "common/color.glsl"

layout(std430, binding = BINDING_COLOR_OUT) readonly buffer ColorOut { vec4 color_out[]; };
layout(std430, binding = BINDING_COLOR_IN) writeonly buffer Packed { uint packed_rgb[]; };

uniform int pixel_count;

void main() {
    int first = thread_index() * HALVES_PER_WORD;
    if (first >= pixel_count) return;
    vec3 left = half_from_linear(color_out[first].rgb);
    vec3 right = half_from_linear(color_out[min(first + 1, pixel_count - 1)].rgb);
    int target = thread_index() * RGB;
    packed_rgb[target] = packHalf2x16(left.rg);
    packed_rgb[target + 1] = packHalf2x16(vec2(left.b, right.r));
    packed_rgb[target + 2] = packHalf2x16(right.gb);
}

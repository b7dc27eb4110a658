// Packs the filtered frame as 8-bit sRGB, three bytes per pixel.
// In:  COLOR_OUT (vec4 linear).   Out: COLOR_IN, whose first bytes it overwrites.
// Dispatch: one thread per four pixels (three words).
// Twin: filter_service.rendering.media_effects.srgb_from_linear.

#include "common/color.glsl"

layout(local_size_x = THREADS) in;

#include "common/line.glsl"

layout(std430, binding = BINDING_COLOR_OUT) readonly buffer ColorOut { vec4 color_out[]; };
layout(std430, binding = BINDING_COLOR_IN) writeonly buffer Packed { uint packed_rgb[]; };

uniform int pixel_count;

void main() {
    int first = thread_index() * BYTES_PER_WORD;
    if (first >= pixel_count) return;
    uint words[RGB] = uint[RGB](0u, 0u, 0u);
    for (int i = 0; i < BYTES_PER_WORD; ++i) {
        vec4 pixel = color_out[min(first + i, pixel_count - 1)];
        uvec3 bytes = uvec3(srgb_from_linear(pixel.rgb) * BYTE_MAX + 0.5);
        for (int channel = 0; channel < RGB; ++channel) {
            int position = i * RGB + channel;
            words[position / BYTES_PER_WORD] |=
                bytes[channel] << (BYTE_BITS * (position % BYTES_PER_WORD));
        }
    }
    int target = thread_index() * RGB;
    for (int channel = 0; channel < RGB; ++channel)
        packed_rgb[target + channel] = words[channel];
}

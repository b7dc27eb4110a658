// Packs the filtered frame as linear floats, twelve bytes per pixel.
// In:  COLOR_OUT (vec4 linear).   Out: COLOR_IN, whose first bytes it overwrites.
// Dispatch: one thread per pixel (three words).
// Twin: reference.gather (the image itself, without its coverage).

layout(local_size_x = THREADS) in;

#include "common/line.glsl"

layout(std430, binding = BINDING_COLOR_OUT) readonly buffer ColorOut { vec4 color_out[]; };
layout(std430, binding = BINDING_COLOR_IN) writeonly buffer Packed { float packed_rgb[]; };

uniform int pixel_count;

void main() {
    int pixel = thread_index();
    if (pixel >= pixel_count) return;
    for (int channel = 0; channel < RGB; ++channel)
        packed_rgb[pixel * RGB + channel] = color_out[pixel][channel];
}

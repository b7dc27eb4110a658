// Reads the input textures at every n-th row and column, for what the CPU follows: focus,
// pupils, and the PSFs that next frames need.
// In:  the input textures.
// Out: SAMPLES (sRGB bytes, depth bits).
// Dispatch: one thread per sample.
// Twin: tests/numerical/test_textures.py.

layout(local_size_x = THREADS) in;

#include "common/line.glsl"
#include "common/color.glsl"
#include "common/input_textures.glsl"

layout(std430, binding = BINDING_SAMPLES) writeonly buffer Samples { uvec2 samples[]; };

uniform ivec2 frame_size_px;
uniform ivec2 sample_grid;
uniform int sample_step_px;

void main() {
    int index = thread_index();
    if (index >= sample_grid.x * sample_grid.y) return;
    ivec2 at = ivec2(index % sample_grid.x, index / sample_grid.x) * sample_step_px;
    vec3 color = srgb_from_linear(input_color(at, frame_size_px).rgb);
    float depth_m = input_depth_m(at, frame_size_px);
    samples[index] = uvec2(packUnorm4x8(vec4(color, 1.0)), floatBitsToUint(depth_m));
}

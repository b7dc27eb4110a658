// Writes the filtered frame to a texture of the caller, with the alpha of its input.  A
// draw, because image stores to sRGB formats write nothing.  If the frame's lists or
// kernels did not fit their buffers, the input is written instead.
// In:  COLOR_OUT, DISPATCHES (group counts of the scatter), the input textures.
// Out: the target: sRGB values, or linear light.
// Twin: filter_service.rendering.media_effects.srgb_from_linear.

#include "common/color.glsl"
#include "common/input_textures.glsl"

layout(std430, binding = BINDING_COLOR_OUT) readonly buffer ColorOut { vec4 color_out[]; };
layout(std430, binding = BINDING_DISPATCHES) readonly buffer Dispatches { uvec4 groups[]; };

uniform ivec2 frame_size_px;
uniform int output_is_encoded;
uniform int target_is_top_first;
uniform vec3 gain;                // transmittance of the ocular media

layout(location = 0) out vec4 shown;

void main() {
    ivec2 at = texture_place(ivec2(gl_FragCoord.xy), frame_size_px.y, target_is_top_first);
    vec4 own = input_color(at, frame_size_px);
    bool is_filtered = groups[DISPATCH_SCATTER].x != 0u;
    vec3 light = own.rgb;
    if (is_filtered) light = gain * color_out[at.y * frame_size_px.x + at.x].rgb;
    // Values of the target's type, so that the driver has nothing to round.
    vec3 stored = output_is_encoded != 0 ? whole_bytes(srgb_from_linear(light))
                                         : half_from_linear(light);
    shown = vec4(stored, own.a);
}

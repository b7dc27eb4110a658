// Integrates wave-optical PSFs over the width of each pixel, puts the edge's mean light
// where no window reaches, cuts to the disc and brings the sum to the method's share.
// In:  PSF_RECORDS, PSF_STRIPES (see psf_wave_columns), PSF_TABLES (pixel filters).
// Out: PSF_KERNELS, PSF_TOTALS (share times the light in the disc).
// Dispatch: y = PSF.
// Twin: estimator.psf.fourier_kernels.integrate_batch.

#include "common/psf_record.glsl"
#include "common/psf_tail.glsl"

layout(local_size_x = PSF_THREADS) in;

layout(std430, binding = BINDING_PSF_RECORDS) readonly buffer Records { PsfRecord records[]; };
layout(std430, binding = BINDING_PSF_STRIPES) readonly buffer Stripes { float stripes[]; };
layout(std430, binding = BINDING_PSF_TABLES) readonly buffer Tables { float tables[]; };
layout(std430, binding = BINDING_PSF_KERNELS) buffer Kernels { float kernels[]; };
layout(std430, binding = BINDING_PSF_TOTALS) writeonly buffer Totals { float totals[]; };

uniform int first_record;
uniform int row_length;

shared float partial[PSF_THREADS];

void main() {
    int index = first_record + int(gl_WorkGroupID.y);
    int thread = int(gl_LocalInvocationIndex);
    ivec4 place = records[index].place;
    ivec4 window = records[index].window;
    ivec4 taps = records[index].taps;
    ivec4 pixels = records[index].pixels;
    vec4 pupil = records[index].pupil;
    vec4 edge_px[PSF_EDGE_PAIRS] = records[index].edge_px;
    vec2 centre = psf_edge_centre(edge_px);
    float scale = records[index].light.z;
    int origin = row_length / 2 - records[index].grid.z - taps.y;
    int radius = place.y;
    int side = 2 * radius + 1;
    int length_count = 2 * taps.y + 1;
    float sum = 0.0;
    for (int i = thread; i < side * side; i += PSF_THREADS) {
        ivec2 at = ivec2(i % side - radius, radius - i / side);
        bool is_reached = at.x >= window.x && at.x <= window.y
                       && at.y >= window.z && at.y <= window.w;
        int from = origin + at.x * pixels.x;
        int line_start = pixels.z + (at.y - window.z) * row_length + from;
        int end = is_reached ? min(length_count, row_length - from) : 0;
        float inside = 0.0;
        for (int l = max(0, -from); l < end; ++l)
            inside += tables[taps.x + l] * stripes[line_start + l];
        float near;
        float outside = psf_tail_light(vec2(at), edge_px, centre, pupil, near);
        float value = is_reached ? scale * inside : outside;
        value = psf_in_disc(at, radius) ? value : 0.0;
        kernels[place.x + i] = value;
        sum += value;
    }
    partial[thread] = sum;
    for (int half_count = PSF_THREADS / 2; half_count > 0; half_count /= 2) {
        barrier();
        if (thread < half_count) partial[thread] += partial[thread + half_count];
    }
    barrier();
    float total = partial[0];
    float share = records[index].more.z;
    if (thread == 0) totals[place.z] = share * total;
    float factor = total > 0.0 ? share / total : 0.0;
    for (int i = thread; i < side * side; i += PSF_THREADS) kernels[place.x + i] *= factor;
}

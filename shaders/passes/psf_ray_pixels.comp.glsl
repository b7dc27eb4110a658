// Turns ray-optical images into kernels: no negative light, the edge's mean light far
// from its image, cut to the disc, and the sum brought to the method's share.
// In:  PSF_RECORDS, PSF_IMAGES (steps of light; used as scratch).
// Out: PSF_KERNELS (added to where waves came before), PSF_TOTALS (share times the light).
// Dispatch: y = PSF.   Variants: DIFFRACTING.
// Twin: estimator.psf.geometric_kernels.trace_batch, its end.

#include "common/psf_record.glsl"
#include "common/psf_tail.glsl"

layout(local_size_x = PSF_THREADS) in;

layout(std430, binding = BINDING_PSF_RECORDS) readonly buffer Records { PsfRecord records[]; };
layout(std430, binding = BINDING_PSF_IMAGES) buffer Images { int images[]; };
layout(std430, binding = BINDING_PSF_KERNELS) buffer Kernels { float kernels[]; };
layout(std430, binding = BINDING_PSF_TOTALS) writeonly buffer Totals { float totals[]; };

uniform int first_record;

shared float partial[PSF_THREADS];

void main() {
    int index = first_record + int(gl_WorkGroupID.y);
    int thread = int(gl_LocalInvocationIndex);
    ivec4 place = records[index].place;
    vec4 pupil = records[index].pupil;
    vec4 more = records[index].more;
    vec4 edge_px[PSF_EDGE_PAIRS] = records[index].edge_px;
    vec2 centre = psf_edge_centre(edge_px);
    int radius = place.y;
    int side = 2 * radius + 1;
    float sum = 0.0;
    for (int i = thread; i < side * side; i += PSF_THREADS) {
        ivec2 at = ivec2(i % side - radius, radius - i / side);
        float value = max(float(images[place.w + i]), 0.0) / PSF_LIGHT_STEPS;
#ifdef DIFFRACTING
        float near;
        float tail = psf_tail_light(vec2(at), edge_px, centre, pupil, near);
        if (near >= PSF_FAR_PX * PSF_FAR_PX) value = max(value, tail);
#endif
        value = psf_in_disc(at, radius) ? value : 0.0;
        images[place.w + i] = floatBitsToInt(value);
        sum += value;
    }
    partial[thread] = sum;
    for (int half_count = PSF_THREADS / 2; half_count > 0; half_count /= 2) {
        barrier();
        if (thread < half_count) partial[thread] += partial[thread + half_count];
    }
    barrier();
    float total = partial[0];
    if (thread == 0) totals[place.z] = more.z * total;
    float safe_total = total > 0.0 ? total : 1.0;
    for (int i = thread; i < side * side; i += PSF_THREADS) {
        float value = more.z * (intBitsToFloat(images[place.w + i]) / safe_total);
        if (more.w > 0.0) value += kernels[place.x + i];
        kernels[place.x + i] = value;
    }
}

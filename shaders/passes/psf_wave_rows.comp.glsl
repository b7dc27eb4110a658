// Fills the pupils of wave-optical PSFs row by row and transforms each row.
// In:  PSF_RECORDS (common/psf_record.glsl).
// Out: PSF_FIELD (vec4: frequencies c and c + FFT_LENGTH/2 of a row, row after row).
// Dispatch: x over pairs of lit rows / FFT_LINES, y = PSF.
// Twin: estimator.psf.fourier_kernels.fill_pupils and a row FFT.

#include "common/psf_record.glsl"
#include "common/psf_pupil.glsl"
#include "common/fft.glsl"

layout(local_size_x = FFT_GROUP) in;

layout(std430, binding = BINDING_PSF_RECORDS) readonly buffer Records { PsfRecord records[]; };
layout(std430, binding = BINDING_PSF_FIELD) writeonly buffer Field { vec4 field[]; };

uniform int first_record;

const float cosine_terms[PSF_TURN_TERMS] = float[PSF_TURN_TERMS](PSF_COSINE_SERIES);
const float sine_terms[PSF_TURN_TERMS] = float[PSF_TURN_TERMS](PSF_SINE_SERIES);
const float edge_terms[PSF_EDGE_TERMS] = float[PSF_EDGE_TERMS](PSF_EDGE_SERIES);

// Cosine and sine of turns within -0.5..0.5.
void turned(vec2 turns, out vec2 cosine, out vec2 sine) {
    vec2 square = turns * turns;
    cosine = vec2(cosine_terms[PSF_TURN_TERMS - 1]);
    sine = vec2(sine_terms[PSF_TURN_TERMS - 1]);
    for (int k = PSF_TURN_TERMS - 2; k >= 0; --k) {
        cosine = cosine_terms[k] + square * cosine;
        sine = sine_terms[k] + square * sine;
    }
    sine *= turns;
}

// Low-passed step at `depth` samples inside the edge: a sine series, by Clenshaw's rule.
vec2 smooth_step(vec2 depth) {
    vec2 inside = clamp(depth, -float(PSF_EDGE_HALF_WIDTH), float(PSF_EDGE_HALF_WIDTH));
    vec2 cosine, sine;
    turned(inside * PSF_EDGE_SLOPE, cosine, sine);
    vec2 twice = 2.0 * cosine;
    vec2 newer = vec2(0.0);
    vec2 older = vec2(0.0);
    for (int m = PSF_EDGE_TERMS - 1; m >= 0; --m) {
        vec2 next = edge_terms[m] + twice * newer - older;
        older = newer;
        newer = next;
    }
    return 0.5 + PSF_EDGE_SLOPE * inside + newer * sine;
}

// Amplitude of the low-passed elliptical pupil in two rows; exact for a circle, right to
// first order otherwise.
vec2 amplitude(float x, vec2 y, float shear, vec2 half_samples) {
    float room = 1.0 / (1.0 - shear * shear);
    vec2 across = (x - shear * y) * room;
    vec2 along = (y - shear * x) * room;
    vec2 radius = sqrt(max(x * across + y * along, vec2(0.0)));
    vec2 slope_x = across / half_samples.x;
    vec2 slope_y = along / half_samples.y;
    vec2 steep = sqrt(slope_x * slope_x + slope_y * slope_y) + PSF_TINY;
    return smooth_step((1.0 - radius) * radius / steep);
}

void main() {
    int index = first_record + int(gl_WorkGroupID.y);
    int thread = int(gl_LocalInvocationIndex);
    int line = thread / FFT_THREADS;
    int j = thread % FFT_THREADS;
    int first_row = 2 * (int(gl_WorkGroupID.x) * FFT_LINES + line);
    ivec4 grid = records[index].grid;
    if (2 * int(gl_WorkGroupID.x) * FFT_LINES >= grid.y) return;  // the whole group
    vec4 light = records[index].light;
    float shear = records[index].pupil.z;
    vec2 half_samples = 0.5 * light.xy;
    vec2 middle = 0.5 * vec2(grid.xy - 1);
    // Never the very centre, where the distance to the edge has no direction.
    vec2 y = (vec2(first_row, first_row + 1) - middle.y) / half_samples.y + PSF_TINY;
    vec2 row[PSF_TERMS];
    psf_row_values(records[index].polynomial, y, row);
#ifdef APODISED
    vec4 low = records[index].log_amplitude;
    vec2 high = records[index].more.xy;
#endif
    vec4 samples[FFT_RADIX_0];
    for (int r = 0; r < FFT_RADIX_0; ++r) {
        int column = j + r * (FFT_LENGTH / FFT_RADIX_0);
        float x = (float(column) - middle.x) / half_samples.x;
        vec2 turns = row[PSF_TERMS - 1];
        for (int a = PSF_TERMS - 2; a >= 0; --a) turns = row[a] + x * turns;
        vec2 cosine, sine;
        turned(turns - floor(turns + 0.5), cosine, sine);
        vec2 size = amplitude(x, y, shear, half_samples);
#ifdef APODISED
        size.x *= exp(psf_log_amplitude(low, high, x, y.x));
        size.y *= exp(psf_log_amplitude(low, high, x, y.y));
#endif
        size = column < grid.x ? size : vec2(0.0);
        vec2 real = size * cosine;
        vec2 imaginary = size * sine;
        samples[r] = vec4(real.x, imaginary.x, real.y, imaginary.y);
    }
    vec4 result[FFT_LAST];
    fft_transform(samples, line, j, result);
    int start = records[index].place.w + first_row * (FFT_LENGTH / 2) + j;
    if (j >= FFT_LENGTH / FFT_LAST || first_row >= grid.y) return;
    for (int r = 0; r < FFT_LAST / 2; ++r) {
        vec4 low_half = result[r];
        vec4 high_half = result[r + FFT_LAST / 2];
        int to = start + r * (FFT_LENGTH / FFT_LAST);
        field[to] = vec4(low_half.xy, high_half.xy);
        if (first_row + 1 < grid.y)
            field[to + FFT_LENGTH / 2] = vec4(low_half.zw, high_half.zw);
    }
}

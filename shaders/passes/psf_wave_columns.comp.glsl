// Transforms the columns of wave-optical PSFs and integrates the intensity over the
// height of each pixel.
// In:  PSF_RECORDS, PSF_FIELD (see psf_wave_rows), PSF_TABLES (pixel filters).
// Out: PSF_STRIPES (a line of angular samples, ascending, for every pixel row).
// Dispatch: x over pairs of columns / FFT_LINES, y = PSF.
// Twin: estimator.psf.fourier_kernels.integrate_pixels, its rows.

#include "common/psf_record.glsl"
#include "common/fft.glsl"

layout(local_size_x = FFT_GROUP) in;

layout(std430, binding = BINDING_PSF_RECORDS) readonly buffer Records { PsfRecord records[]; };
layout(std430, binding = BINDING_PSF_FIELD) readonly buffer Field { vec4 field[]; };
layout(std430, binding = BINDING_PSF_TABLES) readonly buffer Tables { float tables[]; };
layout(std430, binding = BINDING_PSF_STRIPES) writeonly buffer Stripes { float stripes[]; };

uniform int first_record;
uniform int column_pairs;  // half the length of a row

void main() {
    int index = first_record + int(gl_WorkGroupID.y);
    int thread = int(gl_LocalInvocationIndex);
    int line = thread % FFT_LINES;  // neighbours in memory are neighbours in the group
    int j = thread / FFT_LINES;
    int pair = int(gl_WorkGroupID.x) * FFT_LINES + line;
    bool is_column = pair < column_pairs;
    int lit_rows = is_column ? records[index].grid.y : 0;
    int start = records[index].place.w + pair;
    vec4 samples[FFT_RADIX_0];
    for (int r = 0; r < FFT_RADIX_0; ++r) {
        int row = j + r * (FFT_LENGTH / FFT_RADIX_0);
        vec4 sample_pair = vec4(0.0);
        if (row < lit_rows) sample_pair = field[start + row * column_pairs];
        samples[r] = sample_pair;
    }
    vec4 result[FFT_LAST];
    fft_transform(samples, line, j, result);
    barrier();  // the exchange is used up; it takes the intensities, ascending in angle
    int base = line * FFT_LENGTH;
    if (j < FFT_LENGTH / FFT_LAST) {
        for (int r = 0; r < FFT_LAST; ++r) {
            int at = j + ((r + FFT_LAST / 2) % FFT_LAST) * (FFT_LENGTH / FFT_LAST);
            vec4 v = result[r];
            fft_exchange[base + at].xy = vec2(dot(v.xy, v.xy), dot(v.zw, v.zw));
        }
    }
    barrier();
    ivec4 window = records[index].window;
    ivec4 taps = records[index].taps;
    int per_pixel = records[index].pixels.y;
    int n_rows = is_column ? window.w - window.z + 1 : 0;
    int length_count = 2 * taps.w + 1;
    int origin = window.z * per_pixel - records[index].grid.w + FFT_LENGTH / 2 - taps.w;
    int to = records[index].pixels.z + pair;
    for (int q = j; q < n_rows; q += FFT_THREADS) {
        vec2 sum = vec2(0.0);
        int from = origin + q * per_pixel;
        for (int l = max(0, -from); l < min(length_count, FFT_LENGTH - from); ++l)
            sum += tables[taps.z + l] * fft_exchange[base + from + l].xy;
        int line_start = to + q * 2 * column_pairs;
        stripes[line_start + column_pairs] = sum.x;
        stripes[line_start] = sum.y;
    }
}

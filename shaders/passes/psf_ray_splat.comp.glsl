// Spreads the light of every pupil cell over the pixels that its footprint covers.
// In:  PSF_RECORDS.   Out: PSF_IMAGES (light in steps, added).
// Dispatch: x over rows of cells / PSF_ROWS, y = PSF; a thread traces one row.
// Twin: estimator.psf.geometric_kernels.splat_pupil.

#include "common/psf_record.glsl"
#include "common/psf_pupil.glsl"

layout(local_size_x = PSF_ROWS) in;

layout(std430, binding = BINDING_PSF_RECORDS) readonly buffer Records { PsfRecord records[]; };
layout(std430, binding = BINDING_PSF_IMAGES) buffer Images { int images[]; };

uniform int first_record;

// Share of a cell inside the elliptical pupil, whose edge counts as straight.
float cell_share(float x, float y, float shear, float room, float cell) {
    float slope_x = x - shear * y;
    float slope_y = y - shear * x;
    float r = sqrt((x * slope_x + y * slope_y) / room);
    float steep = sqrt(slope_x * slope_x + slope_y * slope_y);
    float depth = (1.0 - r) * r * room / max(steep, PSF_TINY);
    return r < 0.5 ? 1.0 : clamp(depth / cell + 0.5, 0.0, 1.0);
}

void splat(int start, int radius, vec2 low, vec2 size, float steps) {
    vec2 high = low + size;
    ivec2 first = max(ivec2(floor(low + 0.5)), -radius);
    ivec2 last = min(ivec2(floor(high + 0.5)), radius);
    int side = 2 * radius + 1;
    vec2 inverse = 1.0 / size;
    for (int iy = first.y; iy <= last.y; ++iy) {
        float share_y = min(high.y, float(iy) + 0.5) - max(low.y, float(iy) - 0.5);
        float part = steps * share_y * inverse.y;
        int line = start + (radius - iy) * side + radius;
        for (int ix = first.x; ix <= last.x; ++ix) {
            float share_x = min(high.x, float(ix) + 0.5) - max(low.x, float(ix) - 0.5);
            atomicAdd(images[line + ix], int(part * share_x * inverse.x + 0.5));
        }
    }
}

void main() {
    int index = first_record + int(gl_WorkGroupID.y);
    int n_cells = records[index].grid.x;
    int j = int(gl_GlobalInvocationID.x);
    if (j >= n_cells) return;
    vec4 pupil = records[index].pupil;
    vec4 low = records[index].log_amplitude;
    vec4 more = records[index].more;
    ivec4 place = records[index].place;
    float steps = records[index].light.z;
    float shear = pupil.z;
    float room = 1.0 - shear * shear;
    float cell = 2.0 / float(n_cells);
    float y = (float(j) + 0.5) * cell - 1.0;
    float c[PSF_TERMS];
    float d[PSF_TERMS - 1];
    float e[PSF_TERMS - 2];
    psf_row_slopes(records[index].polynomial, y, c, d, e);
    float edge_y = 1.0 + 0.5 * cell;
    float reach = sqrt(max(0.0, edge_y * edge_y - y * y) * room) + cell;
    int first = max(0, int(floor((1.0 + shear * y - reach) / cell)));
    int end = min(n_cells, int(ceil((1.0 + shear * y + reach) / cell)));
    for (int i = first; i < end; ++i) {
        float x = (float(i) + 0.5) * cell - 1.0;
        float weight = cell_share(x, y, shear, room, cell);
#ifdef APODISED
        weight *= exp(2.0 * psf_log_amplitude(low, more.xy, x, y));
#endif
        vec3 curvature;
        vec2 slope = psf_slope(c, d, e, x, curvature) / pupil.xy;
        // Box with the variance of the parallelogram that the cell's corners make; a
        // point fills its pixel.
        vec2 size = cell * vec2(length(curvature.xy), length(curvature.yz)) / pupil.xy;
        size = max(size, vec2(PSF_MIN_BOX_PX));
        splat(place.w, place.y, slope - 0.5 * size, size, weight * steps);
    }
}

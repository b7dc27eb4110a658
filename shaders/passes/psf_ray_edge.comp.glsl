// Lays Fresnel's straight edge along the image of the pupil's edge.
// In:  PSF_RECORDS, PSF_TABLES (Fresnel's edge less its step, integrated).
// Out: PSF_IMAGES (light in steps, added; it may be negative).
// Dispatch: x over points on the edge / PSF_ROWS, y = PSF.
// Twin: estimator.psf.geometric_kernels.add_edge_light, where the formula is explained.

#include "common/psf_record.glsl"
#include "common/psf_pupil.glsl"

layout(local_size_x = PSF_ROWS) in;

layout(std430, binding = BINDING_PSF_RECORDS) readonly buffer Records { PsfRecord records[]; };
layout(std430, binding = BINDING_PSF_TABLES) readonly buffer Tables { float tables[]; };
layout(std430, binding = BINDING_PSF_IMAGES) buffer Images { int images[]; };

uniform int first_record;

float fresnel(float v) {
    float place = (clamp(v / PSF_FRESNEL_LIMIT, -1.0, 1.0) + 1.0) * 0.5
                * float(PSF_FRESNEL_STEPS);
    int i = min(int(place), PSF_FRESNEL_STEPS - 1);
    float value = mix(tables[i], tables[i + 1], place - float(i));
    return abs(v) < PSF_FRESNEL_LIMIT ? value : -PSF_FRESNEL_FAR / v;
}

void add(int at, float steps) { atomicAdd(images[at], int(floor(steps + 0.5))); }

// Spreads light over the up to four pixels that a small box at a point covers.
void lay(int start, int radius, vec2 at, float per_width, float steps) {
    ivec2 pixel = ivec2(floor(at));
    if (any(lessThan(pixel, ivec2(-radius))) || any(greaterThanEqual(pixel, ivec2(radius))))
        return;
    vec2 part = clamp((at - vec2(pixel) - 0.5) * per_width + 0.5, 0.0, 1.0);
    int side = 2 * radius + 1;
    int here = start + (radius - pixel.y) * side + radius + pixel.x;
    float upper = steps * part.y;
    float lower = steps - upper;
    add(here, lower * (1.0 - part.x));
    add(here + 1, lower * part.x);
    add(here - side, upper * (1.0 - part.x));
    add(here - side + 1, upper * part.x);
}

// Curvature (px²/um) of the wavefront across the edge; none along cusps of its image.
float curvature_across(vec3 h, vec2 normal) {
    float across = h.x * normal.x * normal.x + 2.0 * h.y * normal.x * normal.y
                 + h.z * normal.y * normal.y;
    float along = h.x * normal.y * normal.y - 2.0 * h.y * normal.x * normal.y
                + h.z * normal.x * normal.x;
    float mixed = (h.z - h.x) * normal.x * normal.y
                + h.y * (normal.x * normal.x - normal.y * normal.y);
    float least = PSF_MIN_CURVATURE_RATIO * (abs(across) + abs(along) + abs(mixed))
                + PSF_TINY * PSF_TINY;
    return across - mixed * mixed * along / (along * along + least * least);
}

void main() {
    int index = first_record + int(gl_WorkGroupID.y);
    int n_points = records[index].grid.y;
    int i = int(gl_GlobalInvocationID.x);
    if (i >= n_points) return;
    vec4 pupil = records[index].pupil;
    vec4 light = records[index].light;
    ivec4 place = records[index].place;
    float shear = pupil.z;
    float room = sqrt(1.0 - shear * shear);
    float angle = PSF_TURN * (float(i) + 0.5) / float(n_points);
    vec2 disc = vec2(cos(angle), sin(angle));
    vec2 at = vec2(disc.x, shear * disc.x + room * disc.y);
    vec2 normal = vec2(disc.x - shear / room * disc.y, disc.y / room) / pupil.xy;
    float size = length(normal);
    normal /= size;
    float c[PSF_TERMS];
    float d[PSF_TERMS - 1];
    float e[PSF_TERMS - 2];
    psf_row_slopes(records[index].polynomial, at.y, c, d, e);
    vec3 h;
    vec2 start = psf_slope(c, d, e, at.x, h) / pupil.xy;
    float curvature = curvature_across(h / (pupil.xxy * pupil.xyy), normal);
    float bend = max(abs(curvature), PSF_MIN_CURVATURE);
    float way = curvature > 0.0 ? -1.0 : 1.0;
    float v_per_px = way * sqrt(2.0 / (light.y * bend));
    float log_size = psf_log_amplitude(records[index].log_amplitude,
                                       records[index].more.xy, at.x, at.y);
    float steps = way * sqrt(light.y / (2.0 * bend)) * PSF_LIGHT_STEPS * exp(2.0 * log_size)
                * 2.0 * size / (float(n_points) * light.x);
    // Half pixels near the edge's image, one of them centred on it, whole ones beyond.
    float b = -PSF_EDGE_END_PX;
    float before = fresnel(b * v_per_px);
    for (int k = 0; k < PSF_EDGE_PIECES; ++k) {
        bool is_near = k >= PSF_EDGE_FAR_PIECES
                    && k < PSF_EDGE_PIECES - PSF_EDGE_FAR_PIECES;
        float width = is_near ? 0.5 : 1.0;
        float after = fresnel((b + width) * v_per_px);
        vec2 to = start + (b + 0.5 * width) * normal;
        lay(place.w, place.y, to, 1.0 / width, steps * (after - before));
        before = after;
        b += width;
    }
}

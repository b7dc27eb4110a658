// Mean light that the pupil's edge sends far outside the geometric spot.
// Twin: estimator.psf.tail.add_tail, where the formula is explained.

const float PSF_TAIL_CONSTANT = 4.0 * 31.00627668029982;  // 4 pi³

// Middle of the edge's slopes.
vec2 psf_edge_centre(vec4 edge_px[6]) {
    vec4 sum = vec4(0.0);
    for (int k = 0; k < 6; ++k) sum += edge_px[k];
    return (sum.xy + sum.zw) / 12.0;
}

// Light of the pixel at `at`; `near` gets its squared distance from the nearest slope.
float psf_tail_light(vec2 at, vec4 edge_px[6], vec2 centre, vec4 pupil, out float near) {
    near = 1e30;
    float far = 0.0;
    for (int k = 0; k < 6; ++k) {
        vec4 from = at.xyxy - edge_px[k];
        vec2 squares = vec2(dot(from.xy, from.xy), dot(from.zw, from.zw));
        near = min(near, min(squares.x, squares.y));
        far = max(far, max(squares.x, squares.y));
    }
    float close = max(near, 0.25);
    float distant = max(far, close);
    vec2 from = at - centre;
    float square = dot(from, from);
    float at_centre = pupil.x * pupil.y;
    float chord = pupil.x * pupil.x * from.x * from.x + pupil.y * pupil.y * from.y * from.y
                + 2.0 * pupil.z * at_centre * from.x * from.y;
    float ratio = (chord + 1e-6 * at_centre) / (square + 1e-6);
    float area = at_centre * sqrt(1.0 - pupil.z * pupil.z);
    float strength = pupil.w * area / PSF_TAIL_CONSTANT;
    return strength / (ratio * sqrt(ratio * max(square, close)))
         * (1.0 / close + 1.0 / distant);
}

// Whether a pixel lies in a kernel's disc, dx² + dy² <= (R + 0.5)².
bool psf_in_disc(ivec2 at, int radius) {
    return at.x * at.x + at.y * at.y <= radius * (radius + 1);
}

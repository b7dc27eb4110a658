// Threshold contrast of a viewer at an angle from the gaze, relative to that at the gaze
// (filter_service/rendering/frame.py).

uniform vec4 tangents;            // of the frame: left, right, up, down
uniform vec3 gaze_direction;      // right, up, forward; zero: the same everywhere

// Gain of the limits of merging in a block.
float block_gain(ivec2 block_at, vec2 frame_size) {
    if (gaze_direction == vec3(0.0)) return 1.0;
    vec2 center = (vec2(block_at) + 0.5) * float(TILE_SIZE_PX) / frame_size;
    vec3 direction = vec3(mix(tangents.xz, tangents.yw, center), 1.0);
    float eccentricity = degrees(acos(min(dot(normalize(direction), gaze_direction), 1.0)));
    float octaves = DETECTION_OCTAVES_PER_DEG * max(eccentricity - DETECTION_MARGIN_DEG, 0.0);
    return exp2(min(octaves, DETECTION_MAX_OCTAVES));
}

// Smallest spread of kernels that merge; smaller spreads hide as much for a larger gain.
float smallest_spread_px(float gain) {
    if (gain <= 1.0) return MERGE_MIN_SPREAD_PX;
    return MERGE_MIN_SPREAD_PX * pow(gain, -1.0 / MERGE_CONTRAST_POWER);
}

// A fragment: a pixel or a merged square of 2^level pixels of the input, with its blur.
// color.rgb is linear light; color.a the sort depth (smaller = nearer).
// place: x | y << 16 (first pixel), kernel | level | flags, fraction of the kernel's
// interval in 16 bits | radius of the kernel << 16, reach of the kernel (common/reach.glsl).
// edge: strength of the edge, or of a hidden fragment its coverage, with which its light is
// multiplied; light in excess of the surroundings, mean of the channels.

struct Fragment {
    vec3 linear_rgb;
    float sort_depth;
    ivec2 origin_px;
    uint kernel;
    float layer_fraction;
    int radius_px;
    uint reach;
    int level;
    vec2 edge;
};

uvec4 pack_place(Fragment fragment) {
    uint state = fragment.kernel;
    state |= uint(fragment.level) << LEVEL_SHIFT;
    state |= fragment.edge.x > 0.0 ? EDGE_BIT : 0u;
    state |= fragment.edge.y > 0.0 ? uint(BRIGHT_BIT) : 0u;
    uint place = uint(fragment.origin_px.x) | (uint(fragment.origin_px.y) << PLACE_BITS);
    uint fraction = uint(fragment.layer_fraction * float(PLACE_MASK) + 0.5);
    return uvec4(place, state, fraction | (uint(fragment.radius_px) << PLACE_BITS),
                 fragment.reach);
}

ivec2 place_origin_px(uvec4 place) {
    return ivec2(place.x & PLACE_MASK, place.x >> PLACE_BITS);
}

float place_fraction(uvec4 place) {
    return float(place.z & PLACE_MASK) / float(PLACE_MASK);
}

int place_level(uvec4 place) { return int((place.y >> LEVEL_SHIFT) & LEVEL_MASK); }

// Pixels of the fragment's square beyond the first, to the right and down.
int place_extent_px(uvec4 place) { return (1 << place_level(place)) - 1; }

// Largest distance at which the fragment lights a pixel, from its own nearest pixel.
float place_reach_px(uvec4 place) { return float(place.z >> PLACE_BITS) + 0.5; }

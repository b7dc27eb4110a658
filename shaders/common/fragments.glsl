// A fragment: one pixel or one merged 2 x 2 quad of the input, with its blur.
// color.rgb is linear light; color.a the sort depth (smaller = nearer).
// place: x | y << 16 (first pixel), kernel | flags, bits of the fraction of the kernel's
// interval, kernel radius in px.

struct Fragment {
    vec3 linear_rgb;
    float sort_depth;
    ivec2 origin_px;
    uint kernel;
    float layer_fraction;
    int radius_px;
    bool is_merged;
    bool is_edge;
};

uvec4 pack_place(Fragment fragment) {
    uint state = fragment.kernel;
    state |= fragment.is_merged ? MERGED_BIT : 0u;
    state |= fragment.is_edge ? EDGE_BIT : 0u;
    uint place = uint(fragment.origin_px.x) | (uint(fragment.origin_px.y) << PLACE_BITS);
    return uvec4(place, state, floatBitsToUint(fragment.layer_fraction),
                 uint(fragment.radius_px));
}

ivec2 place_origin_px(uvec4 place) {
    return ivec2(place.x & PLACE_MASK, place.x >> PLACE_BITS);
}

// Centre of the fragment's area and the reach of its light from there.
vec2 place_center_px(uvec4 place) {
    float shift = (place.y & MERGED_BIT) != 0u ? 0.5 : 0.0;
    return vec2(place_origin_px(place)) + shift;
}

float place_reach_px(uvec4 place) {
    float corner = (place.y & MERGED_BIT) != 0u ? sqrt(0.5) : 0.0;
    return float(place.w) + 0.5 + corner;
}

// Distances between rectangles of pixels: fragments, blocks, tiles and bins.

// Squared distance between the nearest pixel centers of two rectangles, each given by its
// first and last pixel.
float distance_squared_between(ivec2 first_a, ivec2 last_a, ivec2 first_b, ivec2 last_b) {
    vec2 gap = vec2(max(max(first_b - last_a, first_a - last_b), 0));
    return dot(gap, gap);
}

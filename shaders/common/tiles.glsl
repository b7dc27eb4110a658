// Distances between fragments, blocks and tiles, all in pixels.

// Squared distance from a point to the nearest pixel centre of the tile at origin.
float distance_squared_to_tile(vec2 point, ivec2 tile_origin_px) {
    vec2 low = vec2(tile_origin_px);
    vec2 outside = max(max(low - point, point - (low + float(TILE_SIZE_PX - 1))), 0.0);
    return dot(outside, outside);
}

// Smallest distance between pixel centres of two tiles, squared.
float distance_squared_between_tiles(ivec2 tile_a, ivec2 tile_b) {
    ivec2 gap = max(abs(tile_a - tile_b) * TILE_SIZE_PX - (TILE_SIZE_PX - 1), 0);
    vec2 outside = vec2(gap) * vec2(notEqual(tile_a, tile_b));
    return dot(outside, outside);
}

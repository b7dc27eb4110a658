// Walk over the fragments whose light reaches a tile.  Thread t takes the blocks
// t, t + GROUP_THREADS, ... around the tile and their fragments in order: a fixed order, so
// the same frame gives the same list.  Surface after surface.
// Needs buffers `blocks`, `places` and uniforms `tile_grid`, `search_blocks`,
// `surface_count` in scope.

struct Walk {
    ivec2 tile;
    int next;                     // next block of this thread within the window
    int width;                    // blocks along one side of the window
};

Walk start_walk(ivec2 tile) {
    int width = 2 * search_blocks + 1;
    return Walk(tile, int(gl_LocalInvocationIndex), width);
}

// Next block in reach, or -1.
int next_block(inout Walk walk) {
    int area = walk.width * walk.width;
    while (walk.next < surface_count * area) {
        int place = walk.next % area;
        int surface = walk.next / area;
        ivec2 at = walk.tile - search_blocks
                 + ivec2(place % walk.width, place / walk.width);
        walk.next += GROUP_THREADS;
        if (any(lessThan(at, ivec2(0))) || any(greaterThanEqual(at, tile_grid))) continue;
        int block = (surface * tile_grid.y + at.y) * tile_grid.x + at.x;
        float reach = uintBitsToFloat(blocks[block].y);
        if (distance_squared_between_tiles(at, walk.tile) <= reach * reach) return block;
    }
    return -1;
}

bool reaches_tile(uvec4 place, ivec2 tile) {
    Reach reach = unpack_reach(place.w);
    ivec2 first = place_origin_px(place);
    ivec2 last = first + place_extent_px(place);
    ivec2 tile_first = tile * TILE_SIZE_PX;
    ivec2 tile_last = tile_first + TILE_SIZE_PX - 1;
    if (any(lessThan(last + ivec2(reach.right, reach.down), tile_first))
        || any(greaterThan(first - ivec2(reach.left, reach.up), tile_last))) return false;
    float radius = place_reach_px(place);
    return distance_squared_to_tile(vec2(first), tile_first) <= radius * radius;
}

// Reach of a kernel from its center: columns to the left and right, rows up and down
// (image rows increase downward), a byte each.

struct Reach { int left; int right; int up; int down; };

Reach unpack_reach(uint word) {
    uvec4 shifts = uint(BYTE_BITS) * uvec4(0u, 1u, 2u, 1u + 2u);
    ivec4 sides = ivec4((uvec4(word) >> shifts) & uint(BYTE_MASK));
    return Reach(sides.x, sides.y, sides.z, sides.w);
}

uint pack_reach(Reach reach) {
    uvec4 shifts = uint(BYTE_BITS) * uvec4(0u, 1u, 2u, 1u + 2u);
    uvec4 bytes = uvec4(reach.left, reach.right, reach.up, reach.down) << shifts;
    return bytes.x | bytes.y | bytes.z | bytes.w;
}

int reach_width(Reach reach) { return reach.left + reach.right + 1; }

int reach_height(Reach reach) { return reach.up + reach.down + 1; }

bool within(Reach reach, ivec2 at) {
    return at.x >= -reach.left && at.x <= reach.right && at.y >= -reach.up
        && at.y <= reach.down;
}

// Texel of the kernel at an offset from its center.
int reach_texel(Reach reach, ivec2 at) {
    return (at.y + reach.up) * reach_width(reach) + at.x + reach.left;
}

// Offset of a texel of the kernel from its center.
ivec2 reach_offset(Reach reach, int texel) {
    int width = reach_width(reach);
    return ivec2(texel % width - reach.left, texel / width - reach.up);
}

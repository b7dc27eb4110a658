// The kernel atlas: a 2D texture addressed as one long line of texels.

ivec2 atlas_position(int texel) {
    return ivec2(texel & (ATLAS_WIDTH - 1), texel >> ATLAS_WIDTH_BITS);
}

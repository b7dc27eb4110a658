// Kernels of this frame, each with both ends of its interval of layers.  Record k:
//   (spread bits at the near and the far end px, radius px, reach),
//   (offsets of the kernel by merging level; NO_LEVEL if it has none),
//   (scale bits by level).
// The kernel lies within its reach and within dx^2 + dy^2 <= (radius + 0.5)^2.  Its level
// L is the sum over a square of 2^L pixels, and reaches 2^L - 1 farther to the right and
// down.
// Needs a buffer `kernels` of uvec4 in scope.

uvec4 kernel_size(uint kernel) { return kernels[kernel * uint(KERNEL_WORDS)]; }

uint kernel_reach(uint kernel) { return kernel_size(kernel).w; }

int kernel_radius_px(uint kernel) { return int(kernel_size(kernel).z); }

uint kernel_offset(uint kernel, int level) {
    return kernels[kernel * uint(KERNEL_WORDS) + 1u][level];
}

bool kernel_has_level(uint kernel, int level) {
    return kernel_offset(kernel, level) != NO_LEVEL;
}

float kernel_scale(uint kernel, int level) {
    return uintBitsToFloat(kernels[kernel * uint(KERNEL_WORDS) + 2u][level]);
}

float kernel_spread_px(uint kernel, float fraction) {
    uvec4 size = kernel_size(kernel);
    return mix(uintBitsToFloat(size.x), uintBitsToFloat(size.y), fraction);
}

// Kernels of this frame, each with both ends of its interval of layers.  Record k:
//   (spread bits at the near end px, offset, merged offset, reach),
//   (spread bits at the far end px, scale bits, merged scale bits, radius px).
// The kernel lies within its reach and within dx^2 + dy^2 <= (radius + 0.5)^2.
// Needs a buffer `kernels` of uvec4 in scope.

uvec4 kernel_place(uint kernel) { return kernels[kernel * uint(KERNEL_WORDS)]; }

uvec4 kernel_look(uint kernel) { return kernels[kernel * uint(KERNEL_WORDS) + 1u]; }

float kernel_spread_px(uint kernel, float fraction) {
    return mix(uintBitsToFloat(kernel_place(kernel).x),
               uintBitsToFloat(kernel_look(kernel).x), fraction);
}

// Empties the images that ray optics adds to.
// In:  nothing.   Out: PSF_IMAGES (ivec4).
// Dispatch: x over groups of four pixels / PSF_CLEAR_THREADS.
// Twin: numpy.zeros.

layout(local_size_x = PSF_CLEAR_THREADS) in;

layout(std430, binding = BINDING_PSF_IMAGES) writeonly buffer Images { ivec4 images[]; };

uniform int n_quads;

void main() {
    int i = int(gl_GlobalInvocationID.x);
    if (i < n_quads) images[i] = ivec4(0);
}

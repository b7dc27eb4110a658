// The kernel atlas: one long line of texels.  A texel holds, for red, green and blue, the
// weights at both ends of an interval of layers.
// ATLAS_IS_BUFFER: a storage buffer, which a GPU reads faster (shaders/README.md).
// Otherwise a 2D texture, which costs half on a software renderer.

#ifdef ATLAS_IS_BUFFER
#define ATLAS_FETCH(atlas, texel) atlas[texel]
#define ATLAS_LOAD(atlas, texel) atlas[texel]
#define ATLAS_STORE(atlas, texel, value) atlas[texel] = value
#else
#define ATLAS_FETCH(atlas, texel) texelFetch(atlas, atlas_position(texel), 0)
#define ATLAS_LOAD(atlas, texel) imageLoad(atlas, atlas_position(texel))
#define ATLAS_STORE(atlas, texel, value) imageStore(atlas, atlas_position(texel), value)
#endif

ivec2 atlas_position(int texel) {
    return ivec2(texel & (ATLAS_WIDTH - 1), texel >> ATLAS_WIDTH_BITS);
}

// Weights as fractions of the scale, rounded to the nearest step.
uvec4 pack_weights(vec3 near, vec3 far, float scale) {
    uvec3 low = uvec3(min(near / scale, 1.0) * WEIGHT_MAX + 0.5);
    uvec3 high = uvec3(min(far / scale, 1.0) * WEIGHT_MAX + 0.5);
    return uvec4(low | (high << WEIGHT_BITS), 0u);
}

vec3 near_weights(uvec4 texel) { return vec3(texel.rgb & WEIGHT_MASK); }

// Sum of the weights at both ends, in steps, times factors.  On a GPU, a step number in the
// low bits of 2^23 is the float 2^23 plus that number: it has a lower throughput of
// conversions than of additions.
vec3 weights_between(uvec4 texel, vec2 factors) {
#ifdef ATLAS_IS_BUFFER
    vec3 near = uintBitsToFloat((texel.rgb & WEIGHT_MASK) | uint(EXACT_FLOAT_BITS));
    vec3 far = uintBitsToFloat((texel.rgb >> WEIGHT_BITS) | uint(EXACT_FLOAT_BITS));
    return factors.x * (near - EXACT_FLOAT) + factors.y * (far - EXACT_FLOAT);
#else
    return factors.x * vec3(ivec3(texel.rgb & WEIGHT_MASK))
         + factors.y * vec3(ivec3(texel.rgb >> WEIGHT_BITS));
#endif
}

vec3 far_weights(uvec4 texel) { return vec3(texel.rgb >> WEIGHT_BITS); }

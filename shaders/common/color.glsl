// sRGB transfer curves (IEC 61966-2-1) on linear light in 0..1, and rounding of stored
// values.

vec3 linear_from_srgb(vec3 srgb) {
    vec3 low = srgb / SRGB_SLOPE;
    vec3 high = pow((srgb + SRGB_OFFSET) / SRGB_SCALE, vec3(SRGB_GAMMA));
    return mix(high, low, vec3(lessThanEqual(srgb, vec3(SRGB_DECODE_KNEE))));
}

vec3 srgb_from_linear(vec3 linear_rgb) {
    vec3 clamped = clamp(linear_rgb, 0.0, 1.0);
    vec3 low = clamped * SRGB_SLOPE;
    vec3 high = SRGB_SCALE * pow(clamped, vec3(1.0 / SRGB_GAMMA)) - SRGB_OFFSET;
    return mix(high, low, vec3(lessThanEqual(clamped, vec3(SRGB_ENCODE_KNEE))));
}

// The nearest half floats, ties to even, as floats.  GLSL leaves the rounding of
// packHalf2x16, and of stores to textures, to the driver, and some truncate.
vec3 half_from_linear(vec3 linear_rgb) {
    uvec3 bits = floatBitsToUint(clamp(linear_rgb, -HALF_MAX, HALF_MAX));
    uint step = 1u << uint(HALF_DROPPED_BITS);
    bits += step / 2u - 1u + ((bits >> uint(HALF_DROPPED_BITS)) & 1u);
    return uintBitsToFloat(bits & ~(step - 1u));
}

// The nearest byte, as a fraction of the largest.
vec3 whole_bytes(vec3 value) { return floor(value * BYTE_MAX + 0.5) / BYTE_MAX; }

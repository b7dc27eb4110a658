// Depths as integers of KEY_BITS bits within a range of depths.  In diopters (coverage)
// steps are equal; in meters (PAPER_RULE) they are steps of the float itself, fine near
// the eye, and in a narrow range every depth has its own key.

// Bits of a float whose integer order is that of the floats.
uint ordered_bits(float value) {
    uint bits = floatBitsToUint(value);
    uint sign = 1u << uint(BITS_PER_WORD - 1);
    return (bits & sign) != 0u ? ~bits : bits | sign;
}

float from_ordered_bits(uint ordered) {
    uint sign = 1u << uint(BITS_PER_WORD - 1);
    return uintBitsToFloat((ordered & sign) != 0u ? ordered ^ sign : ~ordered);
}

uint depth_key(float depth, uint lowest, uint highest) {
#ifdef PAPER_RULE
    int spare_bits = max(findMSB(highest - lowest) + 1 - KEY_BITS, 0);
    return (ordered_bits(depth) - lowest) >> uint(spare_bits);
#else
    float low = from_ordered_bits(lowest);
    float range = max(from_ordered_bits(highest) - low, MIN_BLUR_RANGE);
    float position = clamp((depth - low) / range, 0.0, 1.0);
    return uint(position * float((1 << KEY_BITS) - 1));
#endif
}

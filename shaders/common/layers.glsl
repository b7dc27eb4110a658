// Layers of this frame: kernels at increasing object distance in dioptres.
// Record k, for the interval from layer k to k + 1:
//   (distance bits, kernel offset, merged kernel offset, kernel radius px),
//   (spread bits px, scale bits, merged scale bits, 0).
// The last layer only ends an interval; a single layer is its own interval.
// Needs a buffer `layers` of uvec4 in scope.

float layer_object_dpt(int k) { return uintBitsToFloat(layers[k * LAYER_WORDS].x); }

float layer_spread_px(int k) { return uintBitsToFloat(layers[k * LAYER_WORDS + 1].x); }

// Interval that holds a distance; distances beyond the ends go to the end intervals.
int find_interval(float object_dpt, int layer_count) {
    int low = 0;
    int high = max(layer_count - 2, 0);
    while (low < high) {
        int middle = (low + high + 1) / 2;
        if (layer_object_dpt(middle) <= object_dpt) low = middle;
        else high = middle - 1;
    }
    return low;
}

float interval_fraction(int k, float object_dpt, int layer_count) {
    if (layer_count < 2) return 0.0;
    float low = layer_object_dpt(k);
    float span = max(layer_object_dpt(k + 1) - low, MIN_BLUR_RANGE);
    return clamp((object_dpt - low) / span, 0.0, 1.0);
}

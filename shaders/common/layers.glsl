// Layers of this frame: increasing sums, in diopters, of object distance and the change
// of defocus over the field.  Kernels belong to the intervals between them; a single
// layer is its own interval.  A layer position is the interval plus the fraction of the
// way through it.
// Needs a buffer `layer_dpt` of float in scope.

int interval_count(int layer_count) { return max(layer_count - 1, 1); }

// Interval of a position; the last interval includes its far end.
int position_interval(float position, int layer_count) {
    return min(int(position), interval_count(layer_count) - 1);
}

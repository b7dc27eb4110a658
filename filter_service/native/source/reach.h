/* Reach of kernels from their center: columns to the left and right, rows up and down (image
 * rows increase downward). */

#include "frame.h"
#include "vectors.h"

#define LONGEST_REACH_PX 255

typedef struct { int left, right, up, down; } reach;

INLINE reach unpack_reach(uint32_t word) {
    return (reach){(int)(word & 255), (int)(word >> 8 & 255), (int)(word >> 16 & 255),
                   (int)(word >> 24)};
}

INLINE reach read_reach(const uint8_t *bytes) {
    return (reach){bytes[0], bytes[1], bytes[2], bytes[3]};
}

INLINE int reach_width(reach r) { return r.left + r.right + 1; }
INLINE int reach_height(reach r) { return r.up + r.down + 1; }

INLINE reach wider(reach a, reach b) {
    return (reach){larger_int(a.left, b.left), larger_int(a.right, b.right),
                   larger_int(a.up, b.up), larger_int(a.down, b.down)};
}

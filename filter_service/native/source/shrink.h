/* Downsampling of cached kernels to pixels of 2 and 4 px, once for each kernel. */

#include "frame.h"
#include "vectors.h"

#define LONGEST_ROW_PX (2 * LONGEST_REACH_PX + 16)

/* Share of a pixel in a coarse one: pixels half-way between two centers are split. */
INLINE float share_in(int at, int middle, int half) {
    int off = at > middle ? at - middle : middle - at;
    return off < half ? 1.0f : off == half ? 0.5f : 0.0f;
}

/* Total light of a kernel, for kernels that become one coarse pixel. */
static float whole_light(const uint16_t *from, int count) {
    float sum = 0.0f;
    for (int i = 0; i < count; ++i) sum += (float)from[i];
    return sum;
}

/* Computes means over coarse pixels, in steps of the same size.  The central coarse pixel
 * has the same center as the kernel. */
static void shrink_kernel(const shrink_job *job, int64_t kernel) {
    int size = 1 << job->resolution;
    int half = size / 2;
    float per_light = 1.0f / (float)(size * size);
    reach own = unpack_reach(job->from_reach[kernel]);
    reach coarse = unpack_reach(job->to_reach[kernel]);
    int width = reach_width(own);
    const uint16_t *from = job->from + job->from_first[kernel];
    uint16_t *to = job->to + job->to_first[kernel];
    if (reach_width(coarse) == 1 && reach_height(coarse) == 1) {
        float light = whole_light(from, width * reach_height(own));
        to[0] = (uint16_t)smaller_float(light * per_light + 0.5f, 65535.0f);
        return;
    }
    float line[LONGEST_ROW_PX];
    for (int row = -coarse.up; row <= coarse.down; ++row) {
        memset(line, 0, sizeof(float) * (size_t)width);
        int first = larger_int(row * size - half, -own.up);
        int last = smaller_int(row * size + half, own.down);
        for (int y = first; y <= last; ++y)
            add_row(line, from + (y + own.up) * width, width,
                    per_light * share_in(y, row * size, half));
        for (int column = -coarse.left; column <= coarse.right; ++column) {
            float light = 0.0f;
            int left = larger_int(column * size - half, -own.left);
            int right = smaller_int(column * size + half, own.right);
            for (int x = left; x <= right; ++x)
                light += line[x + own.left] * share_in(x, column * size, half);
            *to++ = (uint16_t)(light + 0.5f);
        }
    }
}

/* Item: some kernels. */
#define SHRUNK_AN_ITEM 64

static void shrink_some(void *argument, int item, int thread) {
    const shrink_job *job = argument;
    (void)thread;
    int first = item * SHRUNK_AN_ITEM;
    int last = smaller_int(first + SHRUNK_AN_ITEM, job->count);
    for (int k = first; k < last; ++k) shrink_kernel(job, job->kernels[k]);
}

/* Entry points of the library. */
#include <stdint.h>

#include "entry.h"
#include "edge_job.h"
#include "frame.h"
#include "kernel_job.h"
#include "node_job.h"

/* Sizes of the records, which the caller compares with its own. */
EXPORT void ocu_sizes(int32_t *sizes) {
    int n = 0;
    sizes[n++] = (int32_t)sizeof(frame);
    sizes[n++] = (int32_t)sizeof(fragment);
    sizes[n++] = (int32_t)sizeof(block_info);
    sizes[n++] = (int32_t)sizeof(cluster);
    sizes[n++] = (int32_t)sizeof(kernel_shape);
    sizes[n++] = (int32_t)sizeof(kernel_image);
    sizes[n++] = (int32_t)sizeof(recipe_image);
    sizes[n++] = (int32_t)sizeof(shrink_job);
    sizes[n++] = (int32_t)sizeof(fragment_light);
    sizes[n++] = (int32_t)sizeof(recipe_job);
    sizes[n++] = (int32_t)sizeof(size_job);
    sizes[n++] = (int32_t)sizeof(visibility_job);
    sizes[n++] = (int32_t)sizeof(omitted_job);
    sizes[n++] = (int32_t)sizeof(light_job);
    sizes[n++] = (int32_t)sizeof(node_job);
    sizes[n++] = (int32_t)sizeof(list_job);
    sizes[n++] = (int32_t)sizeof(tails_job);
    sizes[n++] = (int32_t)sizeof(spread_job);
}

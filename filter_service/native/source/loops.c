/* Entry points of the library. */
#include <stdint.h>

#include "entry.h"
#include "frame.h"
#include "kernel_job.h"

/* Sizes of the records, which the caller compares with its own. */
EXPORT void ocu_sizes(int32_t *sizes) {
    sizes[0] = (int32_t)sizeof(frame);
    sizes[1] = (int32_t)sizeof(fragment);
    sizes[2] = (int32_t)sizeof(block_info);
    sizes[3] = (int32_t)sizeof(kernel_shape);
    sizes[4] = (int32_t)sizeof(kernel_image);
    sizes[5] = (int32_t)sizeof(recipe_image);
    sizes[6] = (int32_t)sizeof(shrink_job);
    sizes[7] = (int32_t)sizeof(fragment_light);
    sizes[8] = (int32_t)sizeof(recipe_job);
    sizes[9] = (int32_t)sizeof(size_job);
}

/* What Python calls. */
#include <stdlib.h>

#include "color.h"
#include "loops.h"

#define EXPORT __attribute__((visibility("default")))

extern const loops loops_any;
#if defined(__x86_64__)
extern const loops loops_avx2;
#endif

static const loops *chosen = &loops_any;

/* Makes tables and chooses the loops; `portable` keeps to those for every processor. */
EXPORT const char *ocu_start(int portable) {
    make_color_tables();
    chosen = &loops_any;
#if defined(__x86_64__)
    __builtin_cpu_init();
    if (!portable && __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma"))
        chosen = &loops_avx2;
#else
    (void)portable;
#endif
    return chosen->name;
}

/* Sizes by which the caller sees that its records are ours. */
EXPORT void ocu_sizes(int32_t *sizes) {
    sizes[0] = (int32_t)sizeof(frame);
    sizes[1] = (int32_t)sizeof(fragment);
    sizes[2] = (int32_t)sizeof(block_info);
    sizes[3] = (int32_t)sizeof(kernel_shape);
    sizes[4] = (int32_t)sizeof(kernel_image);
    sizes[5] = (int32_t)sizeof(recipe_image);
    sizes[6] = (int32_t)sizeof(shrink_job);
    sizes[7] = (int32_t)sizeof(fragment_light);
}

EXPORT pool *ocu_pool_new(int n_threads) { return pool_new(n_threads); }
EXPORT void ocu_pool_free(pool *p) { pool_free(p); }
EXPORT int ocu_pool_size(const pool *p) { return pool_size(p); }

EXPORT void ocu_pixels(frame *f) { chosen->pixels(f); }
EXPORT void ocu_merge(frame *f) { chosen->merge(f); }
EXPORT void ocu_place(frame *f) { chosen->place(f); }
EXPORT void ocu_blend(frame *f) { chosen->blend(f); }
EXPORT void ocu_splat(frame *f) { chosen->splat(f); }
EXPORT void ocu_shrink(shrink_job *job) { chosen->shrink(job); }

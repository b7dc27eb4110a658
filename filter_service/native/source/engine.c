/* Functions that Python calls. */
#include <pthread.h>
#include <stdlib.h>
#if defined(__x86_64__)
#include <cpuid.h>
#endif

#include "color.h"
#include "loops.h"

#define EXPORT __attribute__((visibility("default")))

extern const loops loops_any;
#if defined(__x86_64__)
extern const loops loops_avx2;

/* Returns whether the processor and the system support AVX2 and FMA.  Not
 * __builtin_cpu_supports, which reads a variable of the compiler's runtime library: that of
 * zig never sets it. */
static int has_avx2(void) {
    unsigned a, b, c, d, enabled;
    const unsigned needed = bit_FMA | bit_OSXSAVE | bit_AVX;
    if (!__get_cpuid(1, &a, &b, &c, &d) || (c & needed) != needed) return 0;
    if (!__get_cpuid_count(7, 0, &a, &b, &c, &d) || !(b & bit_AVX2)) return 0;
    __asm__("xgetbv" : "=a"(enabled), "=d"(d) : "c"(0));
    return (enabled & 6u) == 6u; /* the system saves the registers */
}
#endif

/* Makes tables and returns the loops for this processor; `portable` selects those for every
 * processor.  The caller passes them to each call, as a process may use both kinds. */
EXPORT const loops *ocu_loops(int portable) {
    static pthread_once_t once = PTHREAD_ONCE_INIT;
    pthread_once(&once, make_color_tables);
#if defined(__x86_64__)
    if (!portable && has_avx2()) return &loops_avx2;
#else
    (void)portable;
#endif
    return &loops_any;
}

EXPORT const char *ocu_name(const loops *own) { return own->name; }

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
    sizes[8] = (int32_t)sizeof(psf_job);
    sizes[9] = (int32_t)sizeof(psf_tables);
}

EXPORT pool *ocu_pool_new(int n_threads) { return pool_new(n_threads); }
EXPORT void ocu_pool_free(pool *p) { pool_free(p); }
EXPORT void ocu_pool_set_between(pool *p, pool_between between, double interval_s) {
    pool_set_between(p, between, interval_s);
}
EXPORT int ocu_pool_size(const pool *p) { return pool_size(p); }

EXPORT void ocu_pixels(const loops *own, frame *f) { own->pixels(f); }
EXPORT void ocu_merge(const loops *own, frame *f) { own->merge(f); }
EXPORT void ocu_place(const loops *own, frame *f) { own->place(f); }
EXPORT void ocu_blend(const loops *own, frame *f) { own->blend(f); }
EXPORT void ocu_splat(const loops *own, frame *f) { own->splat(f); }
EXPORT void ocu_shrink(const loops *own, shrink_job *job) { own->shrink(job); }
EXPORT int ocu_psfs(const loops *own, psf_job *job) { return own->psfs(job); }
EXPORT void ocu_take_psfs(const loops *own, psf_job *job, uint16_t *words) {
    own->take_psfs(job, words);
}

/* Entry points of the library, and the thread pool of the process. */
#include <stdint.h>

#include "defocus_job.h"
#include "entry.h"
#include "pool.h"
#include "psf_job.h"
#include "wavefront_job.h"

/* Sizes of the records, which the caller compares with its own. */
EXPORT void ocu_sizes(int32_t *sizes) {
    int n = 0;
    sizes[n++] = (int32_t)sizeof(psf_job);
    sizes[n++] = (int32_t)sizeof(psf_tables);
    sizes[n++] = (int32_t)sizeof(psf_discs_job);
    sizes[n++] = (int32_t)sizeof(defocus_job);
    sizes[n++] = (int32_t)sizeof(wavefront_job);
}

EXPORT pool *ocu_pool_new(int n_threads) { return pool_new(n_threads); }
EXPORT void ocu_pool_free(pool *p) { pool_free(p); }
EXPORT int ocu_pool_size(const pool *p) { return pool_size(p); }
EXPORT void ocu_pool_set_between(pool *p, pool_between between, double interval_s) {
    pool_set_between(p, between, interval_s);
}

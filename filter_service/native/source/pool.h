/* Thread pool that shares loops. */
#ifndef OCU_POOL_H
#define OCU_POOL_H

typedef struct pool pool;

/* Runs one item of a loop in one thread; `thread` counts from 0. */
typedef void (*pool_item)(void *job, int item, int thread);

/* Starts a pool; n_threads includes the caller.  NULL if out of memory. */
pool *pool_new(int n_threads);
void pool_free(pool *p);
int pool_size(const pool *p);

/* Sets a callback that the caller of a loop runs within it while the other threads pause, not
 * sooner than interval_s after the last time.  NULL: none. */
typedef void (*pool_between)(void);
void pool_set_between(pool *p, pool_between between, double interval_s);

/* Runs items 0..n_items-1, partly in the caller; returns when all are done. */
void pool_run(pool *p, int n_items, pool_item item, void *job);

#endif

/* Thread pool of the process, which loops of several callers share.
 *
 * A caller has a handle.  Another library gets it as a pointer and calls `pool_run` and
 * `pool_size` through the functions in it. */
#ifndef OCU_POOL_H
#define OCU_POOL_H

typedef struct pool pool;

/* Runs one item of a loop in one thread; `thread` counts from 0. */
typedef void (*pool_item)(void *job, int item, int thread);

struct pool {
    void (*run)(pool *p, int n_items, pool_item item, void *job);
    int (*size)(const pool *p);
};

#define MAX_THREADS 256

/* Returns a handle for loops of at most n_threads at a time, including the caller; NULL if
 * out of memory.  The threads end with the last handle. */
pool *pool_new(int n_threads);
void pool_free(pool *p);

/* Sets a callback that the caller of a loop runs between items, not sooner than interval_s
 * after the last time; it may run loops itself.  NULL: none. */
typedef void (*pool_between)(void);
void pool_set_between(pool *p, pool_between between, double interval_s);

/* Number of threads that take part in a loop, including the caller. */
static inline int pool_size(const pool *p) { return p->size(p); }

/* Runs items 0..n_items-1, partly in the caller; returns when all are done.  Threads turn to
 * the loop that began last. */
static inline void pool_run(pool *p, int n_items, pool_item item, void *job) {
    p->run(p, n_items, item, job);
}

#endif

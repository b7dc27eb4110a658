/* A few threads that wait for loops to share. */
#ifndef OCU_POOL_H
#define OCU_POOL_H

typedef struct pool pool;

/* One item of a loop, done by one thread; `thread` counts from 0. */
typedef void (*pool_item)(void *job, int item, int thread);

/* n_threads counts the caller; NULL where threads or memory are lacking. */
pool *pool_new(int n_threads);
void pool_free(pool *p);
int pool_size(const pool *p);

/* Has something done now and then in the middle of loops, by the caller of the loop, while
 * its other threads rest; not sooner than interval_s after the last time.  NULL: nothing. */
typedef void (*pool_between)(void);
void pool_set_between(pool *p, pool_between between, double interval_s);

/* Runs items 0..n_items-1, the caller takes part; returns when all are done. */
void pool_run(pool *p, int n_items, pool_item item, void *job);

#endif

#include "pool.h"

#include <pthread.h>
#include <stdatomic.h>
#include <stdlib.h>
#include <time.h>

typedef struct {
    pool calls; /* first: a handle is a pool */
    int n_threads;
    pool_between between;
    double interval_s, due_s;
} handle;

/* A loop that runs; its caller keeps it on the stack. */
typedef struct loop {
    struct loop *before; /* the loop that began before this one */
    pool_item item;
    void *job;
    int n_items;
    int n_threads; /* most threads at a time, including the caller */
    int helpers;   /* threads in the loop, without the caller */
    atomic_int next;
    unsigned char is_taken[MAX_THREADS]; /* numbers of threads in the loop */
} loop;

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static pthread_mutex_t life = PTHREAD_MUTEX_INITIALIZER; /* of the threads */
static pthread_cond_t begin = PTHREAD_COND_INITIALIZER;
static pthread_cond_t end = PTHREAD_COND_INITIALIZER;
static pthread_once_t once = PTHREAD_ONCE_INIT;
static pthread_t threads[MAX_THREADS];
static int n_helpers; /* threads of the pool */
static int n_handles;
static int stops;
static loop *last;           /* the loop that began last */
static atomic_uint n_begun;  /* counts loops */

static double now_s(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

/* Returns the last loop with work for another thread, or NULL; under the lock. */
static loop *open_loop(void) {
    for (loop *l = last; l != NULL; l = l->before)
        if (l->helpers + 1 < l->n_threads && atomic_load(&l->next) < l->n_items) return l;
    return NULL;
}

static void *help(void *unused) {
    (void)unused;
    pthread_mutex_lock(&lock);
    while (!stops) {
        loop *l = open_loop();
        if (l == NULL) {
            pthread_cond_wait(&begin, &lock);
            continue;
        }
        int number = 1;
        while (l->is_taken[number]) ++number;
        l->is_taken[number] = 1;
        ++l->helpers;
        unsigned seen = atomic_load(&n_begun);
        pthread_mutex_unlock(&lock);
        while (atomic_load_explicit(&n_begun, memory_order_relaxed) == seen) {
            int item = atomic_fetch_add_explicit(&l->next, 1, memory_order_relaxed);
            if (item >= l->n_items) break;
            l->item(l->job, item, number);
        }
        pthread_mutex_lock(&lock);
        l->is_taken[number] = 0;
        if (--l->helpers == 0) pthread_cond_broadcast(&end);
    }
    pthread_mutex_unlock(&lock);
    return NULL;
}

/* A forked child has the handles but none of the threads. */
static void forget_threads(void) {
    pthread_mutex_init(&lock, NULL);
    pthread_mutex_init(&life, NULL);
    pthread_cond_init(&begin, NULL);
    pthread_cond_init(&end, NULL);
    n_helpers = 0;
    last = NULL;
}

static void register_fork(void) { pthread_atfork(NULL, NULL, forget_threads); }

/* Starts threads until there are so many, or the system has no more; under the lock. */
static void start_threads(int count) {
    while (n_helpers < count && pthread_create(&threads[n_helpers], NULL, help, NULL) == 0)
        ++n_helpers;
}

static int size(const pool *p) { return ((const handle *)p)->n_threads; }

static void come_between(handle *own) {
    if (own->between == NULL || now_s() < own->due_s) return;
    own->between();
    own->due_s = now_s() + own->interval_s;
}

static void run(pool *p, int n_items, pool_item item, void *job) {
    handle *own = (handle *)p;
    loop l = {.item = item, .job = job, .n_items = n_items, .n_threads = own->n_threads};
    int is_shared = n_items > 1 && own->n_threads > 1;
    if (is_shared) {
        pthread_mutex_lock(&lock);
        start_threads(own->n_threads - 1); /* in a forked child */
        l.before = last;
        last = &l;
        atomic_fetch_add(&n_begun, 1);
        pthread_cond_broadcast(&begin);
        pthread_mutex_unlock(&lock);
    }
    for (;;) {
        come_between(own);
        int next = atomic_fetch_add_explicit(&l.next, 1, memory_order_relaxed);
        if (next >= n_items) break;
        item(job, next, 0);
    }
    if (!is_shared) return;
    pthread_mutex_lock(&lock);
    loop **at = &last;
    while (*at != &l) at = &(*at)->before;
    *at = l.before;
    while (l.helpers > 0) pthread_cond_wait(&end, &lock);
    pthread_mutex_unlock(&lock);
}

pool *pool_new(int n_threads) {
    handle *own = calloc(1, sizeof *own);
    if (own == NULL) return NULL;
    pthread_once(&once, register_fork);
    own->calls = (pool){run, size};
    own->n_threads = n_threads < 1 ? 1 : n_threads > MAX_THREADS ? MAX_THREADS : n_threads;
    pthread_mutex_lock(&life);
    pthread_mutex_lock(&lock);
    ++n_handles;
    start_threads(own->n_threads - 1);
    /* fewer if the system has no more: callers prepare for this number */
    if (own->n_threads > n_helpers + 1) own->n_threads = n_helpers + 1;
    pthread_mutex_unlock(&lock);
    pthread_mutex_unlock(&life);
    return &own->calls;
}

void pool_free(pool *p) {
    if (p == NULL) return;
    pthread_mutex_lock(&life);
    pthread_mutex_lock(&lock);
    int is_last = --n_handles == 0, count = is_last ? n_helpers : 0;
    if (is_last) {
        stops = 1;
        n_helpers = 0;
        pthread_cond_broadcast(&begin);
    }
    pthread_mutex_unlock(&lock);
    for (int k = 0; k < count; ++k) pthread_join(threads[k], NULL);
    if (is_last) stops = 0; /* otherwise, threads may read it */
    pthread_mutex_unlock(&life);
    free(p);
}

void pool_set_between(pool *p, pool_between between, double interval_s) {
    handle *own = (handle *)p;
    own->between = between;
    own->interval_s = interval_s;
    own->due_s = 0.0;
}

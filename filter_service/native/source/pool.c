#include "pool.h"

#include <pthread.h>
#include <stdatomic.h>
#include <stdlib.h>
#include <time.h>
#include <unistd.h>

struct pool {
    pid_t owner;              /* a forked child has none of the threads */
    int n_threads, n_wanted;
    pthread_t *threads;
    pthread_mutex_t lock;
    pthread_cond_t begin;
    pthread_cond_t end;
    unsigned round;           /* counts loops; a thread joins each once */
    int busy;                 /* threads that have not left the loop */
    int stops;
    pool_item item;
    void *job;
    int n_items;
    atomic_int next;
    pool_between between;
    double interval_s, due_s;
    pthread_cond_t resume;
    atomic_int rests;         /* all threads but the caller wait */
};

typedef struct {
    pool *p;
    int thread;
} seat;

static double now_s(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

/* Runs the callback in the thread of the loop's caller, if it is due. */
static void come_between(pool *p) {
    if (p->between == NULL || now_s() < p->due_s) return;
    atomic_store(&p->rests, 1);
    p->between();
    pthread_mutex_lock(&p->lock);
    atomic_store(&p->rests, 0);
    pthread_cond_broadcast(&p->resume);
    pthread_mutex_unlock(&p->lock);
    p->due_s = now_s() + p->interval_s;
}

static void rest(pool *p) {
    if (!atomic_load_explicit(&p->rests, memory_order_relaxed)) return;
    pthread_mutex_lock(&p->lock);
    while (atomic_load(&p->rests)) pthread_cond_wait(&p->resume, &p->lock);
    pthread_mutex_unlock(&p->lock);
}

static void take_items(pool *p, int thread) {
    for (;;) {
        if (thread == 0) come_between(p);
        else rest(p);
        int item = atomic_fetch_add_explicit(&p->next, 1, memory_order_relaxed);
        if (item >= p->n_items) return;
        p->item(p->job, item, thread);
    }
}

static void *serve(void *argument) {
    seat *own = argument;
    pool *p = own->p;
    int thread = own->thread;
    free(own);
    unsigned seen = 0;
    pthread_mutex_lock(&p->lock);
    for (;;) {
        while (!p->stops && p->round == seen) pthread_cond_wait(&p->begin, &p->lock);
        if (p->stops) break;
        seen = p->round;
        pthread_mutex_unlock(&p->lock);
        take_items(p, thread);
        pthread_mutex_lock(&p->lock);
        if (--p->busy == 0) pthread_cond_signal(&p->end);
    }
    pthread_mutex_unlock(&p->lock);
    return NULL;
}

static void start(pool *p) {
    pthread_mutex_init(&p->lock, NULL);
    pthread_cond_init(&p->begin, NULL);
    pthread_cond_init(&p->end, NULL);
    pthread_cond_init(&p->resume, NULL);
    p->owner = getpid();
    p->round = 0;
    p->busy = 0;
    atomic_store(&p->rests, 0);
    p->n_threads = 1;
    for (int thread = 1; p->threads != NULL && thread < p->n_wanted; ++thread) {
        seat *own = malloc(sizeof *own);
        if (own == NULL) break;
        own->p = p;
        own->thread = thread;
        if (pthread_create(&p->threads[thread], NULL, serve, own) != 0) {
            free(own);
            break; /* continue with fewer threads */
        }
        p->n_threads = thread + 1;
    }
}

pool *pool_new(int n_threads) {
    pool *p = calloc(1, sizeof *p);
    if (p == NULL) return NULL;
    p->threads = calloc((size_t)n_threads, sizeof *p->threads);
    p->n_wanted = n_threads;
    start(p);
    p->n_wanted = p->n_threads; /* the number that callers prepare for */
    return p;
}

void pool_free(pool *p) {
    if (p == NULL) return;
    if (p->owner == getpid()) {
        pthread_mutex_lock(&p->lock);
        p->stops = 1;
        pthread_cond_broadcast(&p->begin);
        pthread_mutex_unlock(&p->lock);
        for (int thread = 1; thread < p->n_threads; ++thread)
            pthread_join(p->threads[thread], NULL);
        pthread_cond_destroy(&p->begin);
        pthread_cond_destroy(&p->end);
        pthread_cond_destroy(&p->resume);
        pthread_mutex_destroy(&p->lock);
    }
    free(p->threads);
    free(p);
}

void pool_set_between(pool *p, pool_between between, double interval_s) {
    p->between = between;
    p->interval_s = interval_s;
    p->due_s = 0.0;
}

int pool_size(const pool *p) { return p->n_threads; }

void pool_run(pool *p, int n_items, pool_item item, void *job) {
    if (p->owner != getpid()) start(p);
    pthread_mutex_lock(&p->lock);
    p->item = item;
    p->job = job;
    p->n_items = n_items;
    atomic_store_explicit(&p->next, 0, memory_order_relaxed);
    p->busy = p->n_threads - 1;
    ++p->round;
    if (p->busy > 0) pthread_cond_broadcast(&p->begin);
    pthread_mutex_unlock(&p->lock);
    take_items(p, 0);
    pthread_mutex_lock(&p->lock);
    while (p->busy > 0) pthread_cond_wait(&p->end, &p->lock);
    pthread_mutex_unlock(&p->lock);
}

#include "pool.h"

#include <pthread.h>
#include <stdatomic.h>
#include <stdlib.h>

struct pool {
    int n_threads;
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
};

typedef struct {
    pool *p;
    int thread;
} seat;

static void take_items(pool *p, int thread) {
    for (;;) {
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

pool *pool_new(int n_threads) {
    pool *p = calloc(1, sizeof *p);
    if (p == NULL) return NULL;
    p->threads = calloc((size_t)n_threads, sizeof *p->threads);
    pthread_mutex_init(&p->lock, NULL);
    pthread_cond_init(&p->begin, NULL);
    pthread_cond_init(&p->end, NULL);
    p->n_threads = 1;
    for (int thread = 1; p->threads != NULL && thread < n_threads; ++thread) {
        seat *own = malloc(sizeof *own);
        if (own == NULL) break;
        own->p = p;
        own->thread = thread;
        if (pthread_create(&p->threads[thread], NULL, serve, own) != 0) {
            free(own);
            break; /* go on with those that there are */
        }
        p->n_threads = thread + 1;
    }
    return p;
}

void pool_free(pool *p) {
    if (p == NULL) return;
    pthread_mutex_lock(&p->lock);
    p->stops = 1;
    pthread_cond_broadcast(&p->begin);
    pthread_mutex_unlock(&p->lock);
    for (int thread = 1; thread < p->n_threads; ++thread)
        pthread_join(p->threads[thread], NULL);
    pthread_cond_destroy(&p->begin);
    pthread_cond_destroy(&p->end);
    pthread_mutex_destroy(&p->lock);
    free(p->threads);
    free(p);
}

int pool_size(const pool *p) { return p->n_threads; }

void pool_run(pool *p, int n_items, pool_item item, void *job) {
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

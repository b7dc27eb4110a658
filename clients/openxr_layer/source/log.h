/* Lines on stderr. */
#ifndef OCU_LAYER_LOG_H
#define OCU_LAYER_LOG_H

#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <time.h>

#define LOG(...)                                                                         \
    do {                                                                                 \
        fprintf(stderr, "ocufilter layer: " __VA_ARGS__);                                \
        fputc('\n', stderr);                                                             \
    } while (0)

/* Reasons that are reported once per session. */
typedef enum {
    SAID_CHAIN,
    SAID_FORMAT,
    SAID_GL_ERROR,
    SAID_MEMORY,
    SAID_NO_HELPER,
    SAID_OTHER_API,
    SAID_RECTANGLE,
    SAID_SPACE,
    SAID_SWAPCHAIN,
    SAID_VIEWS
} said;

#define LOG_ONCE(told, reason, ...)                                                      \
    do {                                                                                 \
        if (!(*(told) >> (reason) & 1u)) {                                               \
            *(told) |= 1u << (reason);                                                   \
            LOG(__VA_ARGS__);                                                            \
        }                                                                                \
    } while (0)

static inline uint64_t now_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000000u + (uint64_t)now.tv_nsec;
}

#endif

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
    REASON_NEXT_CHAIN,
    REASON_COPY,
    REASON_FORMAT,
    REASON_LOST,
    REASON_MEMORY,
    REASON_NO_HELPER,
    REASON_OTHER_API,
    REASON_RECTANGLE,
    REASON_SPACE,
    REASON_SWAPCHAIN,
    REASON_UPLOAD,
    REASON_VIEWS
} reason;

#define LOG_ONCE(reported, why, ...)                                                      \
    do {                                                                                 \
        if (!(*(reported) >> (why) & 1u)) {                                               \
            *(reported) |= 1u << (why);                                                   \
            LOG(__VA_ARGS__);                                                            \
        }                                                                                \
    } while (0)

static inline uint64_t now_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000000u + (uint64_t)now.tv_nsec;
}

#endif

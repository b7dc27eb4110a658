/* The connection to the helper, and the shared memory of images. */
#ifndef OCU_LAYER_LINK_H
#define OCU_LAYER_LINK_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "wire.h"

typedef struct {
    int descriptor;         /* -1 without a connection */
    bool is_accepted;        /* the helper has answered */
    bool is_lost;           /* since the last link_poll */
    uint64_t retry_ns;      /* when to try again */
    char application[128], engine[128];
    const char *graphics;   /* name of the API */
    uint32_t wait_ms, max_age_ms;
    bool leaves_quads;
    uint8_t *memory;        /* NULL without */
    size_t memory_bytes;
    uint64_t retry_memory_ns;
} link_state;

void link_init(link_state *link, const char *application, const char *engine,
               const char *graphics);

/* Connect if it is time to; never blocks. */
void link_connect(link_state *link);

/* Return true with the next result; false if there is none. */
bool link_receive(link_state *link, wire_result *result);

/* Wait for a message, at most that long. */
void link_wait(link_state *link, uint64_t limit_ns);

/* Share memory of at least that size; false if that is impossible. */
bool link_share(link_state *link, size_t size_bytes);

/* Send a frame; false if the helper does not take it. */
bool link_send(link_state *link, const wire_frame *frame);

void link_close(link_state *link);

/* Give up the connection in a child process, which has a copy of it. */
void link_abandon(link_state *link);

#endif

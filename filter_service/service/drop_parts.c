/* Receives parts of a message from a ZeroMQ socket and discards them.
 *
 * Called by dropped_parts.py, which passes libzmq's functions, so this file needs neither
 * libzmq's headers nor its library.
 */

#include <stdint.h>

struct zmq_calls {
    int (*init)(void *message);
    int (*recv)(void *message, void *socket, int flags);
    int (*more)(const void *message);
    int (*close)(void *message);
};

__attribute__((visibility("default"))) int64_t ocu_drop_parts(
    void *socket, const struct zmq_calls *zmq, int64_t max_count, int32_t *has_more)
{
    union {
        unsigned char bytes[64]; /* zmq_msg_t */
        void *aligned;
    } message;
    int64_t count = 0;

    zmq->init(&message);
    while (count < max_count && *has_more) {
        if (zmq->recv(&message, socket, 0) < 0)
            break;
        *has_more = zmq->more(&message);
        count++;
    }
    zmq->close(&message);
    return count;
}

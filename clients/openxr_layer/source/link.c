#define _GNU_SOURCE
#include "link.h"

#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

#include "log.h"

#define RETRY_NS 1000000000u
#define MAX_SHARED_BYTES (UINT64_C(1) << 30)
#define MAX_WAIT_MS 600000u

void link_init(link_state *link, const char *application, const char *engine,
               const char *graphics) {
    *link = (link_state){.descriptor = -1, .graphics = graphics};
    strncpy(link->application, application, sizeof link->application - 1);
    strncpy(link->engine, engine, sizeof link->engine - 1);
}

static void release_memory(link_state *link) {
    if (link->memory) munmap(link->memory, link->memory_bytes);
    link->memory = NULL;
    link->memory_bytes = 0;
}

void link_close(link_state *link) {
    release_memory(link);
    if (link->descriptor >= 0) close(link->descriptor);
    link->descriptor = -1;
    link->is_accepted = false;
    link->retry_ns = now_ns() + RETRY_NS;
}

void link_abandon(link_state *link) {
    if (link->descriptor >= 0) close(link->descriptor);
    link->descriptor = -1;
    link->is_accepted = false;
    link->memory = NULL; /* it is not mapped in the child */
}

static void lose(link_state *link, const char *why) {
    /* A helper that refuses a second program closes without a welcome, every second. */
    if (link->is_accepted) LOG("%s; showing the application's own frames", why);
    link->is_lost |= link->is_accepted;
    link_close(link);
}

/* The address, as in clients/openxr_layer/wire.py; false if it is too long. */
static bool address_of(struct sockaddr_un *address) {
    *address = (struct sockaddr_un){.sun_family = AF_UNIX};
    const char *path = secure_getenv("OCUFILTER_LAYER_SOCKET");
    const char *folder = secure_getenv("XDG_RUNTIME_DIR");
    size_t size = sizeof address->sun_path;
    int length;
    if (path && *path) length = snprintf(address->sun_path, size, "%s", path);
    else if (folder && *folder)
        length = snprintf(address->sun_path, size, "%s/ocufilter-layer.sock", folder);
    else
        length = snprintf(address->sun_path, size, "/run/user/%u/ocufilter-layer.sock",
                          (unsigned)getuid());
    return length > 0 && (size_t)length < size;
}

/* Images of the screen go only to the user of this process, or to root. */
static bool is_trusted(int descriptor) {
    struct ucred peer;
    socklen_t size = sizeof peer;
    return !getsockopt(descriptor, SOL_SOCKET, SO_PEERCRED, &peer, &size) &&
           (peer.uid == getuid() || peer.uid == 0);
}

static bool send_message(int descriptor, const void *message, size_t size, int passed) {
    struct iovec part = {(void *)(uintptr_t)message, size};
    union {
        struct cmsghdr header;
        char space[CMSG_SPACE(sizeof(int))];
    } control = {0};
    struct msghdr packet = {.msg_iov = &part, .msg_iovlen = 1};
    if (passed >= 0) {
        packet.msg_control = control.space;
        packet.msg_controllen = sizeof control.space;
        struct cmsghdr *header = CMSG_FIRSTHDR(&packet);
        header->cmsg_level = SOL_SOCKET;
        header->cmsg_type = SCM_RIGHTS;
        header->cmsg_len = CMSG_LEN(sizeof(int));
        memcpy(CMSG_DATA(header), &passed, sizeof passed);
    }
    return sendmsg(descriptor, &packet, MSG_NOSIGNAL | MSG_DONTWAIT) == (ssize_t)size;
}

void link_connect(link_state *link) {
    if (link->descriptor >= 0 || now_ns() < link->retry_ns) return;
    link->retry_ns = now_ns() + RETRY_NS;
    struct sockaddr_un address;
    if (!address_of(&address)) return;
    int made = socket(AF_UNIX, SOCK_SEQPACKET | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
    if (made < 0) return;
    wire_hello hello = {.kind = WIRE_HELLO,
                        .magic = WIRE_MAGIC,
                        .version = WIRE_VERSION,
                        .process_id = (uint32_t)getpid()};
    memcpy(hello.application, link->application, sizeof hello.application);
    memcpy(hello.engine, link->engine, sizeof hello.engine);
    strncpy(hello.graphics, link->graphics, sizeof hello.graphics - 1);
    if (connect(made, (struct sockaddr *)&address, sizeof address) || !is_trusted(made) ||
        !send_message(made, &hello, sizeof hello, -1)) {
        close(made);
        return;
    }
    link->descriptor = made;
}

static void welcome(link_state *link, const wire_welcome *message) {
    if (message->magic != WIRE_MAGIC || message->version != WIRE_VERSION) {
        LOG("the helper is of another version of ocufilter");
        link_close(link);
        return;
    }
    link->is_accepted = true;
    link->wait_ms = message->wait_ms < MAX_WAIT_MS ? message->wait_ms : MAX_WAIT_MS;
    link->max_age_ms = message->max_age_ms;
    link->leaves_quads = message->leaves_quads;
    LOG("connected to the helper");
}

bool link_receive(link_state *link, wire_result *result) {
    while (link->descriptor >= 0) {
        union {
            uint32_t kind;
            wire_welcome welcome;
            wire_result result;
        } message;
        ssize_t size = recv(link->descriptor, &message, sizeof message, MSG_DONTWAIT);
        if (size < 0 && (errno == EAGAIN || errno == EINTR)) return false;
        if (size <= 0) {
            lose(link, "the helper has ended");
        } else if (size == sizeof message.welcome && message.kind == WIRE_WELCOME &&
                   !link->is_accepted) {
            welcome(link, &message.welcome);
        } else if (size == sizeof message.result && message.kind == WIRE_RESULT) {
            *result = message.result;
            return true;
        } else {
            lose(link, "the helper has sent an unknown message");
        }
    }
    return false;
}

void link_wait(link_state *link, uint64_t limit_ns) {
    struct pollfd wanted = {.fd = link->descriptor, .events = POLLIN};
    struct timespec limit = {(time_t)(limit_ns / 1000000000u), (long)(limit_ns % 1000000000u)};
    if (link->descriptor >= 0) ppoll(&wanted, 1, &limit, NULL);
}

/* Allocate all pages now: later, a lack of memory would be a bus error.  Beyond the limit
 * of file sizes, allocation would end the process with SIGXFSZ. */
static bool allocate(int descriptor, size_t size) {
    struct rlimit limit;
    if (!getrlimit(RLIMIT_FSIZE, &limit) && limit.rlim_cur < size) return false;
    int error;
    do error = posix_fallocate(descriptor, 0, (off_t)size);
    while (error == EINTR);
    return !error;
}

/* Its size is sealed, so that no process can cause a bus error in the other one. */
static int make_memory(size_t size) {
    int made = memfd_create("ocufilter-layer", MFD_CLOEXEC | MFD_ALLOW_SEALING);
    if (made < 0) return -1;
    if (!allocate(made, size) ||
        fcntl(made, F_ADD_SEALS, F_SEAL_SHRINK | F_SEAL_GROW | F_SEAL_SEAL)) {
        close(made);
        return -1;
    }
    return made;
}

static bool share(link_state *link, size_t size_bytes) {
    int made = make_memory(size_bytes);
    if (made < 0) return false;
    void *mapped = mmap(NULL, size_bytes, PROT_READ | PROT_WRITE, MAP_SHARED, made, 0);
    wire_memory message = {.kind = WIRE_MEMORY, .size_bytes = size_bytes};
    bool is_sent = mapped != MAP_FAILED &&
                   send_message(link->descriptor, &message, sizeof message, made);
    close(made);
    if (mapped == MAP_FAILED) return false;
    madvise(mapped, size_bytes, MADV_DONTFORK);
    link->memory = mapped;
    link->memory_bytes = size_bytes;
    if (!is_sent) release_memory(link);
    return is_sent;
}

bool link_share(link_state *link, size_t size_bytes) {
    if (link->memory && size_bytes <= link->memory_bytes) return true;
    if (size_bytes > MAX_SHARED_BYTES || now_ns() < link->retry_memory_ns) return false;
    release_memory(link);
    bool is_shared = share(link, (size_bytes + 4095) & ~(size_t)4095);
    if (!is_shared) link->retry_memory_ns = now_ns() + RETRY_NS;
    return is_shared;
}

bool link_send(link_state *link, const wire_frame *frame) {
    if (send_message(link->descriptor, frame, sizeof *frame, -1)) return true;
    if (errno != EAGAIN) lose(link, "the helper has ended");
    return false;
}

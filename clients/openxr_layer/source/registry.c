/* Lists of the application's handles.
 *
 * The lock protects the lists and not their items: the specification requires that the
 * application does not destroy a handle while another thread uses it. */
#include "registry.h"

static pthread_mutex_t registry = PTHREAD_MUTEX_INITIALIZER;
static instance *instances;
static session *sessions;
static swapchain *swapchains;
static space *spaces;

#define LIST(type, list, handle_type)                                                    \
    void add_##type(type *item) {                                                        \
        pthread_mutex_lock(&registry);                                                   \
        item->next = list;                                                               \
        list = item;                                                                     \
        pthread_mutex_unlock(&registry);                                                 \
    }                                                                                    \
                                                                                         \
    void remove_##type(type *item) {                                                     \
        pthread_mutex_lock(&registry);                                                   \
        type **at = &list;                                                               \
        while (*at != item) at = &(*at)->next;                                           \
        *at = item->next;                                                                \
        pthread_mutex_unlock(&registry);                                                 \
    }                                                                                    \
                                                                                         \
    type *find_##type(handle_type handle) {                                              \
        pthread_mutex_lock(&registry);                                                   \
        type *found = list;                                                              \
        while (found && found->handle != handle) found = found->next;                    \
        pthread_mutex_unlock(&registry);                                                 \
        return found;                                                                    \
    }

LIST(instance, instances, XrInstance)
LIST(session, sessions, XrSession)
LIST(swapchain, swapchains, XrSwapchain)
LIST(space, spaces, XrSpace)

#define DETACH(type, list, is_own)                                                       \
    type *detached = NULL;                                                               \
    pthread_mutex_lock(&registry);                                                       \
    for (type **next = &list; *next;) {                                                  \
        type *item = *next;                                                              \
        if (!(is_own)) {                                                                 \
            next = &item->next;                                                          \
            continue;                                                                    \
        }                                                                                \
        *next = item->next;                                                              \
        item->next = detached;                                                           \
        detached = item;                                                                 \
    }                                                                                    \
    pthread_mutex_unlock(&registry);                                                     \
    return detached

swapchain *detach_swapchains(const session *at) {
    DETACH(swapchain, swapchains, item->session == at);
}

space *detach_spaces(const session *at) {
    DETACH(space, spaces, item->session == at->handle);
}

instance *next_instance(const instance *after) {
    pthread_mutex_lock(&registry);
    instance *found = after ? after->next : instances;
    pthread_mutex_unlock(&registry);
    return found;
}

session *session_of_instance(const instance *own) {
    pthread_mutex_lock(&registry);
    session *found = sessions;
    while (found && found->instance != own) found = found->next;
    pthread_mutex_unlock(&registry);
    return found;
}

bool find_reference_space(XrSpace handle, reference_space *found) {
    const space *known = find_space(handle);
    if (known) *found = known->kind;
    return known;
}

void note_recentered(XrSession handle, XrTime time) {
    pthread_mutex_lock(&registry);
    session *at = sessions;
    while (at && at->handle != handle) at = at->next;
    if (at) at->recentered[at->recentered_count++ % MAX_RECENTERED] = time;
    pthread_mutex_unlock(&registry);
}

bool is_recentered_between(session *at, XrTime first, XrTime last) {
    bool is_between = false;
    pthread_mutex_lock(&registry);
    for (int i = 0; i < MAX_RECENTERED; ++i)
        is_between |= first < at->recentered[i] && at->recentered[i] <= last;
    pthread_mutex_unlock(&registry);
    return is_between;
}

/* A forked child has a copy of the connections, which would keep the helper occupied. */
void abandon_links(void) {
    for (session *at = sessions; at; at = at->next) link_abandon(&at->link);
}

/* Reports, settings, what handles name, and the structures that are given. */
#include <stdarg.h>

#include <openxr/openxr_reflection.h>

#include "mock.h"

struct mock mock = {.lock = PTHREAD_MUTEX_INITIALIZER,
                    .frame_has_begun = PTHREAD_COND_INITIALIZER};
const char *const KINDS[] = {"instance",   "session", "space",    "swapchain",
                             "action set", "action",  "messenger"};

const char *code_name(XrResult code) {
    switch (code) {
#define NAME(name, value) \
    case name: return #name;
        XR_LIST_ENUM_XrResult(NAME)
    default: return "XrResult";
    }
}

XrResult violation(XrResult code, const char *words, ...) {
    char text[512];
    va_list arguments;
    va_start(arguments, words);
    vsnprintf(text, sizeof text, words, arguments);
    va_end(arguments);
    fprintf(stderr, "mock: violation: %s: %s (%s)\n", mock.call, text, code_name(code));
    return code;
}

const char *setting(const char *name, const char *otherwise) {
    const char *value = getenv(name);
    return value && *value ? value : otherwise;
}

long number_setting(const char *name, long otherwise) {
    const char *value = setting(name, NULL);
    return value ? strtol(value, NULL, 10) : otherwise;
}

/* Return the next word of a list, and its length; move the list on. */
const char *next_word(const char **list, size_t *length) {
    *list += strspn(*list, ", ");
    const char *word = *list;
    *length = strcspn(word, ", ");
    *list += *length;
    return *length ? word : NULL;
}

struct object *create(enum kind kind, struct object *parent) {
    struct object *made = calloc(1, sizeof *made);
    mock.objects =
        realloc(mock.objects, (mock.object_count + 1) * sizeof *mock.objects);
    mock.objects[mock.object_count++] = made;
    made->kind = kind;
    made->is_alive = true;
    made->id = mock.object_count;
    made->parent = parent;
    return made;
}

struct object *find(enum kind kind, uint64_t id) {
    if (!id || id > mock.object_count) return NULL;
    struct object *found = mock.objects[id - 1];
    return found->is_alive && found->kind == kind ? found : NULL;
}

struct object *session_of(struct object *object) {
    while (object && object->kind != SESSION) object = object->parent;
    return object;
}

XrResult check_chain(const void *next, const XrStructureType *allowed) {
    for (const XrBaseInStructure *at = next; at; at = at->next) {
        bool is_known = false;
        for (int i = 1; allowed[i]; i++) is_known |= at->type == allowed[i];
        REQUIRE(
            is_known, XR_ERROR_VALIDATION_FAILURE,
            "a structure of type %d is chained, which is unknown there or not enabled",
            (int)at->type);
    }
    return XR_SUCCESS;
}

const void *chained_structure(const void *next, XrStructureType type) {
    const XrBaseInStructure *at = next;
    while (at && at->type != type) at = at->next;
    return at;
}

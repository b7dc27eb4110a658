/* How the driver ends where it cannot go on. */
#include "driver.h"

#include <openxr/openxr_reflection.h>

const char *code_name(XrResult code) {
    switch (code) {
#define NAME(name, value) \
    case name: return #name;
        XR_LIST_ENUM_XrResult(NAME)
    default: return "XrResult";
    }
}

void fail(const char *call, const char *why) {
    printf("{\"error\": \"%s\", \"call\": \"%s\"}\n", why, call);
    fflush(stdout);
    fprintf(stderr, "driver: %s: %s\n", call, why);
    _Exit(1); /* other threads may be in the middle of a frame */
}

XrResult must(XrResult result, const char *call) {
    if (XR_FAILED(result)) fail(call, code_name(result));
    return result;
}

void skip(const char *why) {
    printf("{\"skipped\": \"%s\"}\n", why);
    exit(77);
}

/* Entry points of a library with the variants `variant_any` and `variant_avx2`. */
#include <stddef.h>
#include <string.h>
#if defined(__x86_64__)
#include <cpuid.h>
#endif

#include "variant.h"

#define EXPORT __attribute__((visibility("default")))

extern const variant variant_any;
#if defined(__x86_64__)
extern const variant variant_avx2;

/* Returns whether the processor and the system support AVX2 and FMA.  Not
 * __builtin_cpu_supports, which reads a variable of the compiler's runtime library: that of
 * zig never sets it. */
static int has_avx2(void) {
    unsigned a, b, c, d, enabled;
    const unsigned needed = bit_FMA | bit_OSXSAVE | bit_AVX;
    if (!__get_cpuid(1, &a, &b, &c, &d) || (c & needed) != needed) return 0;
    if (!__get_cpuid_count(7, 0, &a, &b, &c, &d) || !(b & bit_AVX2)) return 0;
    __asm__("xgetbv" : "=a"(enabled), "=d"(d) : "c"(0));
    return (enabled & 6u) == 6u; /* the system saves the registers */
}
#endif

EXPORT int ocu_abi(void) { return OCU_ABI; }

/* Returns the variant for this processor; `portable` selects that for every processor. */
EXPORT const variant *ocu_variant(int portable) {
#if defined(__x86_64__)
    if (!portable && has_avx2()) return &variant_avx2;
#else
    (void)portable;
#endif
    return &variant_any;
}

EXPORT const char *ocu_name(const variant *own) { return own->name; }

/* Returns the address of a function, or NULL if there is no such name. */
EXPORT any_function ocu_function(const variant *own, const char *name) {
    for (const named_function *f = own->functions; f->name != NULL; ++f)
        if (strcmp(f->name, name) == 0) return f->function;
    return NULL;
}

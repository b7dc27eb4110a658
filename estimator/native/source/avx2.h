/* Compiles the functions of OCU_FUNCTIONS, a header, for x86-64 processors of the last ten
 * years: eight floats at a time. */
#if defined(__x86_64__)
#if defined(__clang__)
#pragma clang attribute push(__attribute__((target("avx2,fma"))), apply_to = function)
#else
#pragma GCC target("avx2,fma")
#endif
#define OCU_AVX2
#define OCU_VARIANT variant_avx2
#define OCU_NAME "avx2"
#include OCU_FUNCTIONS
#if defined(__clang__)
#pragma clang attribute pop
#endif
#endif

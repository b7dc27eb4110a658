/* Variant for every processor that the compiler supports. */
#define OCU_VARIANT variant_any
#define OCU_NAME "portable"
#include "loops.h"

/* For every processor that the compiler knows. */
#define OCU_VARIANT loops_any
#define OCU_NAME "portable"
#include "loops.h"

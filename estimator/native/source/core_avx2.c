#define OCU_FUNCTIONS "core.h"
#include "avx2.h"

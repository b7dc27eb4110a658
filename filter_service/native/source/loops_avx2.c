#define OCU_FUNCTIONS "loops.h"
#include "avx2.h"

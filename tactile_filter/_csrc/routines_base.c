// The instruction set that every machine of this kind has: SSE2 on x86-64, NEON on aarch64.
#define ROUTINES routines_base
#define ROUTINES_NAME "base"
#include "routines_table.h"

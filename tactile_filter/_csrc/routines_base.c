// The instruction set that every machine of this kind has: SSE2 on x86-64, NEON on aarch64.
#define ROUTINES routines_base
#ifdef __aarch64__
#define HAS_FMA 1
#else
#define HAS_FMA 0
#endif
#define ROUTINES_NAME "base"
#include "routines_table.h"

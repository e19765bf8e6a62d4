// x86-64 with AVX2, chosen at runtime.
#ifdef __x86_64__
#if defined(__clang__)
#pragma clang attribute push(__attribute__((target("avx2,fma"))), apply_to = function)
#else
#pragma GCC target("avx2,fma")
#endif

#define ROUTINES se3_routines_avx2
#define ROUTINES_NAME "avx2"
#include "se3_routines_table.h"

#if defined(__clang__)
#pragma clang attribute pop
#endif
#else
typedef int se3_routines_avx2_not_here;
#endif

// x86-64 with AVX512, chosen at runtime.
#ifdef __x86_64__
#if defined(__clang__)
#pragma clang attribute push(__attribute__((target("avx2,fma,avx512f,avx512vl,avx512dq"))), \
                             apply_to = function)
#else
#pragma GCC target("avx2,fma,avx512f,avx512vl,avx512dq,tune=icelake-server")
#endif

#define ROUTINES routines_avx512
#define VECTOR_BYTES 64
#define HAS_FMA 1
#define ROUTINES_NAME "avx512"
#include "routines_table.h"

#if defined(__clang__)
#pragma clang attribute pop
#endif
#else
typedef int routines_avx512_not_here;
#endif

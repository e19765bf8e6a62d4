#include "routines.h"

#include <stddef.h>
#include <string.h>


const Routines* routines_select(const char* name) {
#ifdef __x86_64__
  // vectors of 512 bits pay where there are many fusions; one alone is faster in the code for AVX2
  static Routines wide;
  wide = routines_avx2;
  wide.name = routines_avx512.name;
  wide.fuse_batch = routines_avx512.fuse_batch;
  wide.fuse_batch_float = routines_avx512.fuse_batch_float;
  const Routines* const all[] = {&wide, &routines_avx2, &routines_base};
  __builtin_cpu_init();
  int has_avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
  int has_avx512 = has_avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512vl")
                   && __builtin_cpu_supports("avx512dq");
  const int here[] = {has_avx512, has_avx2, 1};
#else
  const Routines* const all[] = {&routines_base};
  const int here[] = {1};
#endif
  for (size_t i = 0; i < sizeof(all)/sizeof(all[0]); i++) {
    if (here[i] && (!name || strcmp(name, all[i]->name) == 0)) {
      return all[i];
    }
  }
  return NULL;
}

#include "routines.h"

#include <stddef.h>
#include <string.h>


const Routines* routines_select(const char* name) {
#ifdef __x86_64__
  __builtin_cpu_init();
  int has_avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
  if (has_avx2 && (!name || strcmp(name, routines_avx2.name) == 0)) {
    return &routines_avx2;
  }
#endif
  return !name || strcmp(name, routines_base.name) == 0 ? &routines_base : NULL;
}

// The choice among the routines, and those for the instruction set that every machine of this kind has.
#include "se3_routines.h"

#include <stddef.h>
#include <string.h>

#define ROUTINES se3_routines_base
#define ROUTINES_NAME "base"
#include "se3_routines_table.h"


const Se3Routines* se3_routines_select(const char* name) {
#ifdef __x86_64__
  __builtin_cpu_init();
  int has_avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
  if (has_avx2 && (!name || strcmp(name, se3_routines_avx2.name) == 0)) {
    return &se3_routines_avx2;
  }
#endif
  return !name || strcmp(name, se3_routines_base.name) == 0 ? &se3_routines_base : NULL;
}

#include "routines.h"

#include <stddef.h>
#include <string.h>


const Routines* routines_select(const char* name) {
#ifdef __x86_64__
  const Routines* const all[] = {&routines_avx2, &routines_base};
  __builtin_cpu_init();
  int has_avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
  const int here[] = {has_avx2, 1};
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

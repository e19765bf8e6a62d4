// The routines of which there is one build for each instruction set; the same sources give the same
// bits.
#ifndef TACTILE_ROUTINES_H_
#define TACTILE_ROUTINES_H_

#include "fusion.h"

typedef struct {
  const char* name;  // of the instruction set

  // one fusion; returns 0 or a fault. `order` is a Jacobian's or TO_CONVERGENCE, with `iterations`
  // at most
  int (*fuse)(FusionOutput* res, const FusionInput input[2], int iterations, int order);

  // returns 0 or the fault that one of the two would be, as argument 0 (mean) or 1 (covariance)
  int (*check)(const FusionInput* input);
} Routines;

extern const Routines routines_base;
#ifdef __x86_64__
extern const Routines routines_avx2;
#endif

#endif  // TACTILE_ROUTINES_H_

// Included by routines_*.c, which define ROUTINES, ROUTINES_NAME and HAS_FMA, and set the target.
#include <float.h>
#include <math.h>
#include <stdint.h>
#include <string.h>

#include "fusion.h"
#include "routines.h"
#include "se3.h"

#if defined(__clang__)
#define UNROLL _Pragma("unroll")
#else
#define UNROLL _Pragma("GCC unroll 36")
#endif

// with a choice of its own the compiler leaves calls in the middle of what has to stay in registers
#define INLINE static inline __attribute__((always_inline))

// below this fraction of its diagonal element a pivot in twice the precision is rounding
#define SMALLEST_PIVOT 1e-28

#define TWO_PI 6.283185307179586
#define FOUR_PI_SQUARED 39.47841760435743

#include "coefficients.h"
#include "dd.h"
#include "lanes.h"
#include "fusion_pair.h"
#include "se3_exact.h"
#include "fusion_robust.h"
#include "fusion_exact.h"


// whether every number is finite; that of a covariance's element follows from its diagonal's
static int is_finite(const FusionOutput* res) {
  double sum = 0;
  for (int i = 0; i < 16; i++) { sum += 0 * res->mean[i]; }
  for (int i = 0; i < 6; i++) { sum += 0 * res->cov[7 * i]; }
  return sum == 0;
}


static int fuse(FusionOutput* res, const FusionInput input[2], int iterations, int order) {
  if (order != TO_CONVERGENCE && pair_fixed(res, input, iterations, order)) {
    return 0;  // its pivots have been looked at
  }
  int fault = order == TO_CONVERGENCE ? fuse_exactly(res, input, iterations)
                                      : robust_fixed(res, input, iterations, order);
  return !fault && !is_finite(res) ? FUSION_NO_INFORMATION : fault;
}


static int check(const FusionInput* input) {
  int lack = fusion_lack(input->mean, input->cov);
  if (lack) { return lack == FUSION_NO_POSE ? lack : 16 + lack; }
  for (int i = 0; i < 6; i++) {
    if (i < 3 && fabs(input->mean[4 * i + 3]) > LARGEST_POSITION) { return FUSION_OUT_OF_RANGE; }
    if (input->cov[7 * i] > LARGEST_VARIANCE ||
        (input->cov[7 * i] > 0 && input->cov[7 * i] < SMALLEST_VARIANCE)) {
      return 16 + FUSION_OUT_OF_RANGE;
    }
  }
  V full[36], packed[21];
  FactorPair factor;
  M poor = {0};
  for (int i = 0; i < 36; i++) { full[i] = SPLAT(input->cov[i]); }
  symmetric_part(packed, full, &poor);
  factorize(&factor, packed, &poor);
  Dd lower[36];
  return !any(poor) || dd_whitening(lower, input->cov) ? 0 : 16 + FUSION_NO_COVARIANCE;
}


const Routines ROUTINES = {
    .name = ROUTINES_NAME,
    .fuse = fuse,
    .check = check,
};

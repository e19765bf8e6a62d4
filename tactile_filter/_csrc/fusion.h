// Fusion of two Gaussians over poses: the paper's algorithm "SE(3) data fusion".
// test/filter/fusion_reference.py is the same to be read.
#ifndef TACTILE_FUSION_H_
#define TACTILE_FUSION_H_

#include "se3.h"

// an order (se3.h) that is none: the exact Jacobian, and the mode "exact"
enum { TO_CONVERGENCE = -1 };

// how a fusion ended (FusionStatus in fusion.py)
enum { FUSION_CONVERGED = 0, FUSION_NOT_CONVERGED = 1, FUSION_STALLED = 2 };

// why there is none: 16*k + one of these for argument k of mean_1, cov_1, mean_2, cov_2
enum {
  FUSION_NO_POSE = 3,         // not finite, last row not 0 0 0 1, or rotation not orthonormal
  FUSION_NO_COVARIANCE = 4,   // not finite, asymmetric or not positive definite
  FUSION_NO_INFORMATION = 5,  // the two together are out of the range of doubles
  FUSION_OUT_OF_RANGE = 6     // of `check` alone: what is made of it may overflow
};

// as in fusion.py
#define CONVERGED_STEP 1e-3

// what a filter takes, beside LARGEST_POSITION of se3.h: all that is made of it stays finite (m^2,
// rad^2)
#define LARGEST_VARIANCE 1e18
#define SMALLEST_VARIANCE 1e-30

// below this fraction of its diagonal element a pivot asks for twice the precision
#define POOR_PIVOT 1e-7

// largest difference of a covariance and its transpose, relative to the standard deviations
#define SYMMETRY_TOLERANCE 1e-8

typedef struct {
  double mean[16];
  double cov[36];
  double factor[36];  // lower, cov = factor * factor'
  double step;        // length of the last step in posterior standard deviations
  int iterations;
  int status;
} FusionOutput;

// one of the two as the caller has it
typedef struct {
  const double* mean;  // homogeneous matrix
  const double* cov;
} FusionInput;

#endif  // TACTILE_FUSION_H_

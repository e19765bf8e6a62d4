// Fusion of two Gaussians over poses: the paper's algorithm "SE(3) data fusion".
// tactile_filter/fusion_reference.py is the same to be read.
#ifndef TACTILE_FUSION_H_
#define TACTILE_FUSION_H_

#include "se3.h"

// how a fusion ended (FusionStatus in fusion_result.py), or what an input lacks
enum {
  FUSION_CONVERGED = 0,
  FUSION_NOT_CONVERGED = 1,
  FUSION_STALLED = 2,
  FUSION_NO_POSE = 3,        // not finite, last row not 0 0 0 1, or rotation not orthonormal
  FUSION_NO_COVARIANCE = 4,  // not finite, asymmetric or not positive definite
  FUSION_NO_INFORMATION = 5  // normal equations not positive definite or not finite: out of range
};

// one of the two: its mean and what whitens its errors, the upper triangular [[ul, ur], [0, lr]] with
// covariance^-1 = upper' * upper; ul and lr are upper triangular and hold 00, 01, 02, 11, 12, 22
typedef struct {
  Pose mean;
  double ul[6], ur[9], lr[6];
} FusionInput;

typedef struct {
  Pose mean;
  double cov[36];
  double factor[36];  // lower, cov = factor * factor'
  double step;        // length of the last step in posterior standard deviations
  int iterations;
  int status;
} FusionOutput;

// mean from a homogeneous matrix; returns 0 or FUSION_NO_POSE
int fusion_set_mean(FusionInput* input, const double mat[16]);

// whitening from a covariance; returns 0 or FUSION_NO_COVARIANCE
int fusion_set_covariance(FusionInput* input, const double cov[36]);

// fixed number of iterations, covariance as evaluated before the last update; returns the status
int fusion_fixed(FusionOutput* res, const FusionInput input[2], int iterations, int order);

// Gauss-Newton with line search to convergence, at most this many iterations; returns the status
int fusion_exact(FusionOutput* res, const FusionInput input[2], int iterations);

#endif  // TACTILE_FUSION_H_

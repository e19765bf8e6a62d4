// The filter's prediction, and how far a measurement is from it.
#ifndef TACTILE_PROPAGATE_H_
#define TACTILE_PROPAGATE_H_

#include "se3.h"

// moved = now^-1 * before * pose and its left covariance, Ad cov Ad' + diag(variances), exactly
// symmetric
void propagate(Pose* moved, double moved_cov[36], const Pose* pose, const double cov[36],
               const Pose* before, const Pose* now, const double variances[6]);

// innovation of one Gaussian against another, as a vector that is standard normal if both are true;
// returns its squared length, infinite if their joint covariance is not positive definite in double
// precision
double innovation(double whitened[6], const Pose* pose_1, const double cov_1[36],
                  const Pose* pose_2, const double cov_2[36]);

#endif  // TACTILE_PROPAGATE_H_

#include "fusion.h"

#include <math.h>

#include "se3.h"


int fusion_lack(const double mean[16], const double cov[36]) {
  Pose pose;
  if (mean[12] != 0 || mean[13] != 0 || mean[14] != 0 || mean[15] != 1) {
    return FUSION_NO_POSE;
  }
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) {
      pose.rot[3*i+j] = mean[4*i+j];
    }
    if (!isfinite(mean[4*i+3])) {
      return FUSION_NO_POSE;
    }
  }
  if (!(se3_rotation_error(pose.rot) <= ROTATION_TOLERANCE) || !(se3_determinant(pose.rot) > 0)) {
    return FUSION_NO_POSE;
  }
  for (int i = 0; i < 6; i++) {
    for (int j = 0; j <= i; j++) {
      double difference = cov[6*i+j] - cov[6*j+i];
      double scale = SYMMETRY_TOLERANCE*SYMMETRY_TOLERANCE * (cov[7*i]*cov[7*j]);
      if (!(difference*difference <= scale) || !isfinite(cov[6*i+j])) {
        return FUSION_NO_COVARIANCE;
      }
    }
  }
  return 0;
}

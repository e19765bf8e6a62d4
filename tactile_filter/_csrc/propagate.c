#include "propagate.h"

#include <math.h>


// res = Ad(pose) * cov * Ad(pose)', the lower half, by blocks
static void transport(double res[36], const Pose* pose, const double cov[36]) {
  const double *r = pose->rot, *p = pose->pos;
  double ad[36] = {0}, product[36];
  for (int j = 0; j < 3; j++) {
    for (int i = 0; i < 3; i++) {
      int k = (i + 1) % 3, l = (i + 2) % 3;
      ad[6 * i + j] = ad[6 * (3 + i) + 3 + j] = r[3 * i + j];
      ad[6 * i + 3 + j] = p[k] * r[3 * l + j] - p[l] * r[3 * k + j];
    }
  }
  for (int i = 0; i < 6; i++) {
    for (int j = 0; j < 6; j++) {
      double sum = 0;
      for (int k = i < 3 ? 0 : 3; k < 6; k++) { sum += ad[6 * i + k] * cov[6 * k + j]; }
      product[6 * i + j] = sum;
    }
  }
  for (int i = 0; i < 6; i++) {
    for (int j = 0; j <= i; j++) {
      double sum = 0;
      for (int k = j < 3 ? 0 : 3; k < 6; k++) { sum += product[6 * i + k] * ad[6 * j + k]; }
      res[6 * i + j] = sum;
    }
  }
}


void propagate(Pose* moved, double moved_cov[36], const Pose* pose, const double cov[36],
               const Pose* before, const Pose* now, const double variances[6]) {
  Pose motion;
  double lower[36];
  se3_inverse_product(&motion, now, before);
  se3_product(moved, &motion, pose);
  se3_orthonormalize(moved);
  transport(lower, &motion, cov);
  for (int i = 0; i < 6; i++) {
    for (int j = 0; j <= i; j++) {
      moved_cov[6 * i + j] = moved_cov[6 * j + i] = lower[6 * i + j] + (i == j ? variances[i] : 0);
    }
  }
}


double innovation(double whitened[6], const Pose* pose_1, const double cov_1[36],
                  const Pose* pose_2, const double cov_2[36]) {
  double joint[36], nu[6], square = 0;
  Pose difference;
  se3_difference(&difference, pose_1, pose_2);
  se3_log(nu, &difference);
  transport(joint, &difference, cov_2);

  // Cholesky factor in place, row by row, and the innovation by it
  for (int i = 0; i < 6; i++) {
    for (int j = 0; j <= i; j++) {
      double sum = joint[6 * i + j] + cov_1[6 * i + j];
      for (int k = 0; k < j; k++) { sum -= joint[6 * i + k] * joint[6 * j + k]; }
      if (i == j && !(sum > 0 && isfinite(sum))) {
        for (int k = 0; k < 6; k++) { whitened[k] = HUGE_VAL; }
        return HUGE_VAL;
      }
      joint[6 * i + j] = i == j ? sqrt(sum) : sum / joint[7 * j];
    }
    double rest = nu[i];
    for (int k = 0; k < i; k++) { rest -= joint[6 * i + k] * whitened[k]; }
    whitened[i] = rest / joint[7 * i];
    square += whitened[i] * whitened[i];
  }
  return square;
}

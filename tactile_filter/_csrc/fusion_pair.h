// One fusion: the two inputs lie side by side in the two lanes of a vector, what they have in common is scalar.

#define LANES 2
#define SUFFIX d2
#include "lanes_begin.h"
#include "fusion_lanes.h"
#include "lanes_end.h"

#define LANES 1
#define SUFFIX d1
#include "lanes_begin.h"
#include "fusion_lanes.h"
#include "lanes_end.h"

typedef struct {
  Pose_d2 relative;  // Z_k of both inputs
  Side_d2 side;
  Pose_d1 base;      // mean of the first
} Pair;

// Gauss-Newton model at a motion
typedef struct {
  Factor_d1 information;
  double step[6];
  double square;  // squared length of the step in posterior standard deviations
  double cost;    // squared whitened residual
} PairModel;


// both inputs; returns 0 if one is no Gaussian or close enough to none for another way
static inline int pair_set(Pair* pair, const FusionInput input[2]) {
  Pose_d2 pose, first;
  Factor_d2 factor;
  Vec_d2 packed[21], full[36], root[6];
  Mask_d2 bad = {0};
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) {
      pose.rot[3*i+j] = (Vec_d2){input[0].mean[4*i+j], input[1].mean[4*i+j]};
      first.rot[3*i+j] = (Vec_d2){input[0].mean[4*i+j], input[0].mean[4*i+j]};
      pair->base.rot[3*i+j] = input[0].mean[4*i+j];
    }
    pose.pos[i] = (Vec_d2){input[0].mean[4*i+3], input[1].mean[4*i+3]};
    first.pos[i] = (Vec_d2){input[0].mean[4*i+3], input[0].mean[4*i+3]};
    pair->base.pos[i] = input[0].mean[4*i+3];
  }
  for (int i = 0; i < 36; i++) {
    full[i] = (Vec_d2){input[0].cov[i], input[1].cov[i]};
  }
  int rows = 1;
  for (int k = 0; k < 2; k++) {
    const double* row = input[k].mean + 12;
    rows &= row[0] == 0 && row[1] == 0 && row[2] == 0 && row[3] == 1;
  }
  check_pose_d2(&pose, &bad);
  symmetric_part_d2(packed, full, &bad);
  factorize_d2(&factor, packed, &bad);
  set_roots_d2(root, &factor);
  set_whitening_d2(&pair->side, &factor, root);
  set_relative_d2(&pair->relative, &first, &pose);

  // the first relative to itself is exactly the identity
  for (int i = 0; i < 9; i++) {
    pair->relative.rot[i][0] = i % 4 == 0;
  }
  for (int i = 0; i < 3; i++) {
    pair->relative.pos[i][0] = 0;
  }
  return rows && !any_d2(bad);
}


static inline void spread_d2(Pose_d2* res, const Pose_d1* pose) {
  for (int i = 0; i < 9; i++) {
    res->rot[i] = (Vec_d2){pose->rot[i], pose->rot[i]};
  }
  for (int i = 0; i < 3; i++) {
    res->pos[i] = (Vec_d2){pose->pos[i], pose->pos[i]};
  }
}


// returns 0 if the information's pivots ask for another way
static inline int pair_model(PairModel* model, const Pair* pair, const Pose_d1* y, int order) {
  Pose_d2 both, difference;
  Vec_d2 information[21], gradient[6], xi[6], e, de;
  spread_d2(&both, y);
  product_d2(&difference, &both, &pair->relative);
  log_d2(xi, &e, &de, &difference);
  Vec_d2 cost = contribution_d2(information, gradient, xi, e, de, &pair->side, order);

  double sum[21], slope[6];
  UNROLL
  for (int i = 0; i < 21; i++) {
    sum[i] = information[i][0] + information[i][1];
  }
  UNROLL
  for (int i = 0; i < 6; i++) {
    slope[i] = gradient[i][0] + gradient[i][1];
  }
  model->cost = cost[0] + cost[1];
  int poor = 0;
  factorize_d1(&model->information, sum, &poor);
  model->square = gauss_newton_d1(model->step, slope, &model->information);
  return !poor && model->square <= DBL_MAX;
}


// mean, covariance and factor
static inline void pair_finish(FusionOutput* res, const Pair* pair, const Pose_d1* y, const Factor_d1* information) {
  Pose_d1 mean;
  double factor[21], cov[21], root[6];
  set_roots_d1(root, information);
  product_d1(&mean, y, &pair->base);
  orthonormalize_d1(mean.rot);
  inverse_factor_d1(factor, information, root);
  square_lower_d1(cov, factor);
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) {
      res->mean[4*i+j] = mean.rot[3*i+j];
    }
    res->mean[4*i+3] = mean.pos[i];
  }
  res->mean[12] = res->mean[13] = res->mean[14] = 0;
  res->mean[15] = 1;
  UNROLL
  for (int i = 0; i < 6; i++) {
    UNROLL
    for (int j = 0; j <= i; j++) {
      res->cov[6*i+j] = res->cov[6*j+i] = cov[i*(i+1)/2+j];
      res->factor[6*j+i] = 0;
      res->factor[6*i+j] = factor[i*(i+1)/2+j];
    }
  }
}


// fixed number of iterations, the covariance as evaluated before the last; returns 0 if it needs another way
static int pair_fixed(FusionOutput* res, const FusionInput input[2], int iterations, int order) {
  Pair pair;
  PairModel model;
  Pose_d1 y;
  if (!pair_set(&pair, input)) {
    return 0;
  }
  set_identity_d1(&y);
  int done = 0;
  do {
    if (!pair_model(&model, &pair, &y, order)) {
      return 0;
    }
    perturb_d1(&y, model.step);
  } while (++done < iterations);
  pair_finish(res, &pair, &y, &model.information);
  res->step = sqrt(model.square);
  res->iterations = iterations;
  res->status = res->step <= CONVERGED_STEP ? FUSION_CONVERGED : FUSION_NOT_CONVERGED;
  return 1;
}

// One fusion with a fixed number of iterations: the two inputs lie side by side in the two lanes of
// a vector, what they have in common stands in both.
#include "fusion_lanes.h"

typedef struct {
  PosePair relative;  // Z_k of both inputs
  SidePair side;
  PosePair base;  // mean of the first
} Pair;

// Gauss-Newton model at a motion
typedef struct {
  FactorPair information;
  V step[6];
  V square;  // squared length of the step in posterior standard deviations
  V cost;    // squared whitened residual
} PairModel;


// both inputs; returns 0 if one is no Gaussian or close enough to none for another way
static inline int pair_set(Pair* pair, const FusionInput input[2]) {
  PosePair pose;
  FactorPair factor;
  V packed[21], full[36], root[6];
  M bad = {0};
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) {
      pose.rot[3 * i + j] = (V){input[0].mean[4 * i + j], input[1].mean[4 * i + j]};
      pair->base.rot[3 * i + j] = SPLAT(input[0].mean[4 * i + j]);
    }
    pose.pos[i] = (V){input[0].mean[4 * i + 3], input[1].mean[4 * i + 3]};
    pair->base.pos[i] = SPLAT(input[0].mean[4 * i + 3]);
  }
  for (int i = 0; i < 36; i++) { full[i] = (V){input[0].cov[i], input[1].cov[i]}; }
  int rows = 1;
  for (int k = 0; k < 2; k++) {
    const double* row = input[k].mean + 12;
    rows &= row[0] == 0 && row[1] == 0 && row[2] == 0 && row[3] == 1;
  }
  check_pose(&pose, &bad);
  symmetric_part(packed, full, &bad);
  factorize(&factor, packed, &bad);
  set_roots(root, &factor);
  set_whitening(&pair->side, &factor, root);
  set_relative(&pair->relative, &pair->base, &pose);

  // the first relative to itself is exactly the identity
  for (int i = 0; i < 9; i++) { pair->relative.rot[i][0] = i % 4 == 0; }
  for (int i = 0; i < 3; i++) { pair->relative.pos[i][0] = 0; }
  return rows && !any(bad);
}


// returns 0 if the information's pivots ask for another way
static inline int pair_model(PairModel* model, const Pair* pair, const PosePair* y, int order) {
  PosePair difference;
  V information[21], gradient[6], xi[6], e, de;
  product(&difference, y, &pair->relative);
  logarithm(xi, &e, &de, &difference);
  model->cost = total(contribution(information, gradient, xi, e, de, &pair->side, order));
  UNROLL
  for (int i = 0; i < 21; i++) { information[i] = total(information[i]); }
  UNROLL
  for (int i = 0; i < 6; i++) { gradient[i] = total(gradient[i]); }
  M poor = {0};
  factorize(&model->information, information, &poor);
  model->square = gauss_newton(model->step, gradient, &model->information);
  return !any(poor) && model->square[0] <= DBL_MAX;
}


// mean, covariance and factor
static inline void pair_finish(FusionOutput* res, const Pair* pair, const PosePair* y,
                               const FactorPair* information) {
  PosePair mean;
  V factor[21], cov[21], root[6];
  set_roots(root, information);
  product(&mean, y, &pair->base);
  orthonormalize(mean.rot);
  inverse_factor(factor, information, root);
  square_lower(cov, factor);
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) { res->mean[4 * i + j] = mean.rot[3 * i + j][0]; }
    res->mean[4 * i + 3] = mean.pos[i][0];
  }
  res->mean[12] = res->mean[13] = res->mean[14] = 0;
  res->mean[15] = 1;
  UNROLL
  for (int i = 0; i < 6; i++) {
    for (int j = 0; j <= i; j++) {
      res->cov[6 * i + j] = res->cov[6 * j + i] = cov[i * (i + 1) / 2 + j][0];
      res->factor[6 * j + i] = 0;
      res->factor[6 * i + j] = factor[i * (i + 1) / 2 + j][0];
    }
  }
}


// what a fixed number of iterations ends with, the last step having this squared length
static void end_fixed(FusionOutput* res, double square, int iterations) {
  res->step = sqrt(square);
  res->iterations = iterations;
  res->status = res->step <= CONVERGED_STEP ? FUSION_CONVERGED : FUSION_NOT_CONVERGED;
}


// the covariance as evaluated before the last iteration; returns 0 if it needs another way
static int pair_fixed(FusionOutput* res, const FusionInput input[2], int iterations, int order) {
  Pair pair;
  PairModel model;
  PosePair y;
  if (!pair_set(&pair, input)) { return 0; }
  set_identity(&y);
  int done = 0;
  do {
    if (!pair_model(&model, &pair, &y, order)) { return 0; }
    perturb(&y, model.step);
  } while (++done < iterations);
  pair_finish(res, &pair, &y, &model.information);
  end_fixed(res, model.square[0], iterations);
  return 1;
}

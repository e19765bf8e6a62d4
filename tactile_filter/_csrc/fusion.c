#include "fusion.h"

#include <math.h>

#include "linalg.h"

// as in fusion_reference.py, fusion_result.py, se3.py
#define CONVERGED_STEP 1e-3
#define EXACT_TOLERANCE 1e-13
#define FLOOR_TOLERANCE 1e-9
#define ARMIJO 1e-4
#define SEARCH_FROM 1e-3
#define SLACK 1e-12
#define SHORTEST_STEP (1.0/1073741824)
#define ROTATION_TOLERANCE 1e-6

// largest difference of a covariance and its transpose, relative to the standard deviations
#define SYMMETRY_TOLERANCE 1e-8

// in loops over three elements the compiler's vectors cost more than they bring: a fifth of the time
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC optimize("no-tree-vectorize", "no-tree-slp-vectorize")
#endif

// Gauss-Newton model at a pose
typedef struct {
  Factor6 information;
  double step[6];
  double length;  // of the step in posterior standard deviations
  double cost;    // squared whitened residual
} Model;

// whitened Jacobian [[ul, ur], [0, lr]] and residual of one input
typedef struct {
  double ul[9], ur[9], lr[9];
  double residual[6];
} Whitened;


int fusion_set_mean(FusionInput* input, const double mat[16]) {
  if (mat[12] != 0 || mat[13] != 0 || mat[14] != 0 || mat[15] != 1) {
    return FUSION_NO_POSE;
  }
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) {
      input->mean.rot[3*i+j] = mat[4*i+j];
    }
    input->mean.pos[i] = mat[4*i+3];
    if (!isfinite(input->mean.pos[i])) {
      return FUSION_NO_POSE;
    }
  }
  if (!(se3_rotation_error(input->mean.rot) <= ROTATION_TOLERANCE)) {
    return FUSION_NO_POSE;
  }

  return se3_determinant(input->mean.rot) > 0 ? 0 : FUSION_NO_POSE;
}


int fusion_set_covariance(FusionInput* input, const double cov[36]) {
  double sym[36];
  for (int i = 0; i < 6; i++) {
    for (int j = 0; j <= i; j++) {
      double difference = cov[6*i+j] - cov[6*j+i];
      double scale = SYMMETRY_TOLERANCE*SYMMETRY_TOLERANCE * (cov[7*i]*cov[7*j]);
      if (!(difference*difference <= scale) || !isfinite(cov[6*i+j])) {
        return FUSION_NO_COVARIANCE;
      }
      sym[6*i+j] = 0.5*cov[6*i+j] + 0.5*cov[6*j+i];
    }
  }
  Factor6 factor;
  double lower[36];
  if (!factorize6(&factor, sym)) {
    return FUSION_NO_COVARIANCE;
  }

  // the transpose of the inverse's lower factor, by blocks
  inverse_factor6(lower, &factor);
  for (int i = 0, n = 0; i < 3; i++) {
    for (int j = i; j < 3; j++, n++) {
      input->ul[n] = lower[6*j+i];
      input->lr[n] = lower[6*(3+j)+3+i];
    }
    for (int j = 0; j < 3; j++) {
      input->ur[3*i+j] = lower[6*(3+j)+i];
    }
  }
  return 0;
}


// res = upper * mat, upper triangular as in FusionInput
static void multiply_upper(double res[9], const double upper[6], const double mat[9]) {
  for (int j = 0; j < 3; j++) {
    res[j] = upper[0]*mat[j] + upper[1]*mat[3+j] + upper[2]*mat[6+j];
    res[3+j] = upper[3]*mat[3+j] + upper[4]*mat[6+j];
    res[6+j] = upper[5]*mat[6+j];
  }
}


// res += a * b
static void add_product(double res[9], const double a[9], const double b[9]) {
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) {
      res[3*i+j] += a[3*i]*b[j] + a[3*i+1]*b[3+j] + a[3*i+2]*b[6+j];
    }
  }
}


// res += a' * b
static void add_transposed_product(double res[9], const double a[9], const double b[9]) {
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) {
      res[3*i+j] += a[i]*b[j] + a[3+i]*b[3+j] + a[6+i]*b[6+j];
    }
  }
}


// xi = log(pose * mean^-1) and the same whitened; returns its squared norm
static double residual_at(double res[6], double xi[6], const Pose* pose, const FusionInput* input) {
  Pose difference;
  se3_difference(&difference, pose, &input->mean);
  se3_log(xi, &difference);

  const double *ul = input->ul, *ur = input->ur, *lr = input->lr;
  res[0] = ul[0]*xi[0] + ul[1]*xi[1] + ul[2]*xi[2] + ur[0]*xi[3] + ur[1]*xi[4] + ur[2]*xi[5];
  res[1] = ul[3]*xi[1] + ul[4]*xi[2] + ur[3]*xi[3] + ur[4]*xi[4] + ur[5]*xi[5];
  res[2] = ul[5]*xi[2] + ur[6]*xi[3] + ur[7]*xi[4] + ur[8]*xi[5];
  res[3] = lr[0]*xi[3] + lr[1]*xi[4] + lr[2]*xi[5];
  res[4] = lr[3]*xi[4] + lr[4]*xi[5];
  res[5] = lr[5]*xi[5];
  return res[0]*res[0] + res[1]*res[1] + res[2]*res[2] + res[3]*res[3] + res[4]*res[4] + res[5]*res[5];
}


static double cost_at(const Pose* pose, const FusionInput input[2]) {
  double residual[6], xi[6];
  double first = residual_at(residual, xi, pose, input);
  return first + residual_at(residual, xi, pose, input + 1);
}


// whitened Jacobian and residual of one input; returns the squared residual
static double whiten(Whitened* res, const Pose* pose, const FusionInput* input, int order) {
  double xi[6];
  InverseJacobian jac;
  double cost = residual_at(res->residual, xi, pose, input);
  se3_inverse_jacobian(&jac, xi, order);
  multiply_upper(res->ul, input->ul, jac.diag);
  multiply_upper(res->ur, input->ul, jac.corner);
  add_product(res->ur, input->ur, jac.diag);
  multiply_upper(res->lr, input->lr, jac.diag);
  return cost;
}


// lower half of the information matrix and the gradient from both inputs
static void normal_equations(double information[36], double gradient[6], const Whitened part[2]) {
  double ul[9] = {0}, ll[9] = {0}, lr[9] = {0};
  for (int k = 0; k < 2; k++) {
    add_transposed_product(ul, part[k].ul, part[k].ul);
    add_transposed_product(ll, part[k].ur, part[k].ul);
    add_transposed_product(lr, part[k].ur, part[k].ur);
    add_transposed_product(lr, part[k].lr, part[k].lr);
  }
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) {
      information[6*i+j] = ul[3*i+j];
      information[6*(3+i)+j] = ll[3*i+j];
      information[6*(3+i)+3+j] = lr[3*i+j];
    }
  }

  for (int i = 0; i < 3; i++) {
    double upper = 0, lower = 0;
    for (int k = 0; k < 2; k++) {
      const Whitened* p = part + k;
      for (int j = 0; j < 3; j++) {
        upper += p->ul[3*j+i]*p->residual[j];
        lower += p->ur[3*j+i]*p->residual[j] + p->lr[3*j+i]*p->residual[3+j];
      }
    }
    gradient[i] = upper;
    gradient[3+i] = lower;
  }
}


// Gauss-Newton model at a pose; returns 0 if its normal equations are out of range
static int build_model(Model* model, const Pose* pose, const FusionInput input[2], int order) {
  double information[36], gradient[6];
  Whitened part[2];
  model->cost = whiten(part, pose, input, order) + whiten(part + 1, pose, input + 1, order);
  normal_equations(information, gradient, part);
  if (!factorize6(&model->information, information)) {
    return 0;
  }

  // unit' * diag(pivot) * unit * step = -gradient
  double square = 0;
  solve_transposed6(gradient, &model->information);
  for (int i = 0; i < 6; i++) {
    model->step[i] = -gradient[i] * model->information.inverse[i];
    square -= gradient[i] * model->step[i];
  }
  solve6(model->step, &model->information);
  model->length = sqrt(square);
  return isfinite(square);
}


// fill in the output from the last model; returns the status
static int finish(FusionOutput* res, const Model* model, int iterations, int status) {
  inverse_factor6(res->factor, &model->information);
  square_lower6(res->cov, res->factor);
  se3_orthonormalize(&res->mean);
  res->step = model->length;
  res->iterations = iterations;
  res->status = status;
  return status;
}


int fusion_fixed(FusionOutput* res, const FusionInput input[2], int iterations, int order) {
  Model model;
  res->mean = input[0].mean;
  for (int i = 0; i < iterations; i++) {
    if (!build_model(&model, &res->mean, input, order)) {
      return FUSION_NO_INFORMATION;
    }
    se3_perturb(&res->mean, model.step);
  }
  int status = model.length <= CONVERGED_STEP ? FUSION_CONVERGED : FUSION_NOT_CONVERGED;
  return finish(res, &model, iterations, status);
}


// move by the longest of step, step/2, step/4, ... that lowers the cost enough; returns 0 if none does
static int line_search(Pose* pose, const Model* model, const FusionInput input[2]) {
  // shorter steps change the cost by less than its rounding
  if (model->length <= SEARCH_FROM) {
    se3_perturb(pose, model->step);
    return 1;
  }

  for (double fraction = 1; fraction >= SHORTEST_STEP; fraction *= 0.5) {
    double step[6];
    Pose moved = *pose;
    for (int i = 0; i < 6; i++) {
      step[i] = fraction * model->step[i];
    }
    se3_perturb(&moved, step);
    double predicted = 2*ARMIJO * fraction * model->length*model->length;
    if (cost_at(&moved, input) <= model->cost*(1 + SLACK) - predicted) {
      *pose = moved;
      return 1;
    }
  }
  return 0;
}


int fusion_exact(FusionOutput* res, const FusionInput input[2], int iterations) {
  Model model;
  double previous = HUGE_VAL;
  res->mean = input[0].mean;
  for (int i = 1; i <= iterations; i++) {
    if (!build_model(&model, &res->mean, input, JACOBIAN_EXACT)) {
      return FUSION_NO_INFORMATION;
    }

    // converged: the step is rounding, or is small and no longer shrinks
    double scale = 1 + sqrt(model.cost);
    int at_floor = model.length <= FLOOR_TOLERANCE*scale && model.length > 0.5*previous;
    if (model.length <= EXACT_TOLERANCE*scale || at_floor) {
      return finish(res, &model, i, FUSION_CONVERGED);
    }
    if (!line_search(&res->mean, &model, input)) {
      return finish(res, &model, i, FUSION_STALLED);
    }
    previous = model.length;
  }
  return finish(res, &model, iterations, FUSION_NOT_CONVERGED);
}

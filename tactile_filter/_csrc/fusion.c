#include "fusion.h"

#include <math.h>

#include "linalg.h"

// as in fusion_reference.py, fusion_result.py, se3.py
#define CONVERGED_STEP 1e-3
#define EXACT_TOLERANCE 1e-13
#define FLOOR_TOLERANCE 1e-9
#define ARMIJO 1e-4
#define SHORTEST_STEP (1.0/1073741824)
#define ROTATION_TOLERANCE 1e-6

// largest difference of a covariance and its transpose, relative to the standard deviations
#define SYMMETRY_TOLERANCE 1e-8

// Gauss-Newton model at a pose: information = normal' * normal
typedef struct {
  double normal[36];  // lower
  double step[6];
  double length;      // |normal * step|: the step in posterior standard deviations
  double cost;        // squared whitened residual
} Model;


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

  // a rotation, not a reflection: the third row is the cross product of the others
  const double* r = input->mean.rot;
  return (r[0]*r[4] - r[1]*r[3])*r[8] + (r[1]*r[5] - r[2]*r[4])*r[6]
         + (r[2]*r[3] - r[0]*r[5])*r[7] > 0 ? 0 : FUSION_NO_POSE;
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
  return chol6(input->factor, sym) ? 0 : FUSION_NO_COVARIANCE;
}


// whitened residual factor^-1 log(pose * mean^-1), also the logarithm itself; returns the squared norm
static double whiten_residual(double res[6], double xi[6], const Pose* pose, const FusionInput* input) {
  Pose difference;
  se3_difference(&difference, pose, &input->mean);
  se3_log(xi, &difference);
  solve_lower6(res, input->factor, xi);
  double norm = 0;
  for (int i = 0; i < 6; i++) {
    norm += res[i]*res[i];
  }
  return norm;
}


static double cost_at(const Pose* pose, const FusionInput input[2]) {
  double residual[6], xi[6];
  double first = whiten_residual(residual, xi, pose, input);
  return first + whiten_residual(residual, xi, pose, input + 1);
}


// res = factor^-1 * inverse Jacobian
static void whiten_jacobian(double res[36], const double factor[36], const InverseJacobian* jac) {
  for (int i = 0; i < 6; i++) {
    // row i of the Jacobian
    double row[6] = {0};
    for (int j = 0; j < 3; j++) {
      if (i < 3) {
        row[j] = jac->diag[3*i+j];
        row[3+j] = jac->corner[3*i+j];
      } else {
        row[3+j] = jac->diag[3*(i-3)+j];
      }
    }

    // forward substitution, all columns at once
    for (int k = 0; k < i; k++) {
      for (int j = 0; j < 6; j++) {
        row[j] -= factor[6*i+k] * res[6*k+j];
      }
    }
    double inv = 1 / factor[7*i];
    for (int j = 0; j < 6; j++) {
      res[6*i+j] = row[j] * inv;
    }
  }
}


// add the normal equations of one input; returns the squared whitened residual
static double add_normal(double information[36], double gradient[6], const Pose* pose,
                         const FusionInput* input, int order) {
  double xi[6], residual[6], whitened[36];
  InverseJacobian jac;
  double cost = whiten_residual(residual, xi, pose, input);
  se3_inverse_jacobian(&jac, xi, order);
  whiten_jacobian(whitened, input->factor, &jac);

  for (int k = 0; k < 6; k++) {
    const double* row = whitened + 6*k;
    for (int i = 0; i < 6; i++) {
      for (int j = 0; j < 6; j++) {
        information[6*i+j] += row[i] * row[j];
      }
      gradient[i] += row[i] * residual[k];
    }
  }
  return cost;
}


// Gauss-Newton model at a pose; returns 0 if its normal equations are out of range
static int build_model(Model* model, const Pose* pose, const FusionInput input[2], int order) {
  double information[36] = {0}, gradient[6] = {0};
  model->cost = add_normal(information, gradient, pose, input, order);
  model->cost += add_normal(information, gradient, pose, input + 1, order);
  if (!reverse_chol6(model->normal, information)) {
    return 0;
  }

  // normal' * normal * step = -gradient
  solve_lower_transposed6(gradient, model->normal, gradient);
  double square = 0;
  for (int i = 0; i < 6; i++) {
    gradient[i] = -gradient[i];
    square += gradient[i]*gradient[i];
  }
  model->length = sqrt(square);
  solve_lower6(model->step, model->normal, gradient);
  return isfinite(model->length);
}


// fill in the output from the last model; returns the status
static int finish(FusionOutput* res, const Model* model, int iterations, int status) {
  invert_lower6(res->factor, model->normal);
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
  double slack = 1e-14 * model->cost;
  for (double fraction = 1; fraction >= SHORTEST_STEP; fraction *= 0.5) {
    double step[6];
    Pose moved = *pose;
    for (int i = 0; i < 6; i++) {
      step[i] = fraction * model->step[i];
    }
    se3_perturb(&moved, step);
    double predicted = 2*ARMIJO * fraction * model->length*model->length;
    if (cost_at(&moved, input) <= model->cost - predicted + slack) {
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

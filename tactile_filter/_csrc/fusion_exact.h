// The fusion to convergence: Gauss-Newton with a line search, Newton's method where that is slow or
// goes in circles, from several starts where the means are far apart. Plain or, where the pivots
// ask for it, robust arithmetic.

#define EXACT_TOLERANCE \
  1e-14  // step, relative to 1 + the whitened residual: where rounding takes over
#define FLOOR_TOLERANCE 1e-9  // below this, a step that no longer shrinks is rounding, too
#define SLOW 0.02  // a step longer than this fraction of the last one: Newton's method from here on
#define ARMIJO 1e-4  // fraction of the predicted decrease that a step has to bring
#define SEARCH_FROM \
  1e-3  // shorter steps are taken whole: they change the cost by less than its rounding
#define SLACK 1e-12  // differences of costs below this fraction are rounding
#define SHORTEST_STEP (1.0 / 1073741824)
#define STARTS 8

typedef struct {
  Pair pair;  // rounded from `robust` if that is used
  Robust robust;
  int is_robust;
} Problem;

typedef struct {
  PosePair y;
  DdPose y_robust;
} Motion;

typedef struct {
  PairModel pair;
  RobustModel robust;
  double factor[36];  // lower, of the covariance
  double descent[6];  // in posterior standard deviations: step = factor * descent
  double step[6];
  double square, cost;
} Model;


static void round_motion(Motion* motion) {
  for (int i = 0; i < 9; i++) { motion->y.rot[i] = SPLAT(dd_round(motion->y_robust.rot[i])); }
  for (int i = 0; i < 3; i++) { motion->y.pos[i] = SPLAT(dd_round(motion->y_robust.pos[i])); }
}


static void perturb_by(PosePair* y, const double step[6]) {
  V xi[6];
  for (int i = 0; i < 6; i++) { xi[i] = SPLAT(step[i]); }
  perturb(y, xi);
}


static void problem_perturb(const Problem* problem, Motion* motion, const double step[6]) {
  if (problem->is_robust) {
    robust_perturb(&motion->y_robust, step);
    round_motion(motion);
  } else {
    perturb_by(&motion->y, step);
  }
}


static int problem_model(Model* model, const Problem* problem, const Motion* motion) {
  if (problem->is_robust) {
    if (!robust_model(&model->robust, &problem->robust, &motion->y_robust, JACOBIAN_EXACT)) {
      return 0;
    }
    for (int i = 0; i < 36; i++) { model->factor[i] = dd_round(model->robust.factor[i]); }
    memcpy(model->step, model->robust.step, sizeof(model->step));
    memcpy(model->descent, model->robust.y, sizeof(model->descent));
    model->square = model->robust.square;
    model->cost = model->robust.cost;
    return 1;
  }

  if (!pair_model(&model->pair, &problem->pair, &motion->y, JACOBIAN_EXACT)) { return 0; }
  V packed[21], root[6];
  set_roots(root, &model->pair.information);
  inverse_factor(packed, &model->pair.information, root);
  memset(model->factor, 0, sizeof(model->factor));
  model->square = model->pair.square[0];
  model->cost = model->pair.cost[0];

  // descent = factor^-1 * step
  for (int i = 0; i < 6; i++) {
    double rest = model->step[i] = model->pair.step[i][0];
    for (int j = 0; j <= i; j++) {
      model->factor[6 * i + j] = packed[i * (i + 1) / 2 + j][0];
      rest -= j < i ? model->factor[6 * i + j] * model->descent[j] : 0;
    }
    model->descent[i] = rest / model->factor[7 * i];
  }
  return 1;
}


static double problem_cost(const Problem* problem, const Motion* motion) {
  if (problem->is_robust) {
    double cost = 0;
    for (int k = 0; k < 2; k++) {
      Dd rows[6][7];
      robust_rows(rows, &motion->y_robust, problem->robust.side + k, JACOBIAN_EXACT);
      for (int i = 0; i < 6; i++) { cost += dd_round(dd_mul(rows[i][6], rows[i][6])); }
    }
    return cost;
  }
  PosePair difference;
  V xi[6], residual[6], e, de;
  product(&difference, &motion->y, &problem->pair.relative);
  logarithm(xi, &e, &de, &difference);
  return total(whitened_residual(residual, xi, &problem->pair.side))[0];
}


static double dot(const double a[3], const double b[3]) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}


// w' (A B + B A) c for the hats of a and b
static double mixed_form(const double a[3], const double b[3], const double w[3],
                         const double c[3]) {
  return dot(w, a) * dot(b, c) + dot(w, b) * dot(a, c) - 2 * dot(a, b) * dot(w, c);
}


// what the inverse Jacobian's second derivative needs: e(x) and its derivatives over the angle,
// each over it
typedef struct {
  double phi[3], e, de, dde;
} Bend;


// w' D(r) c, where D(r) is the derivative along r of the 3x3 inverse Jacobian
static double first_form(const Bend* bend, const double r[3], const double w[3],
                         const double c[3]) {
  const double* p = bend->phi;
  double turn = w[0] * (r[1] * c[2] - r[2] * c[1]) + w[1] * (r[2] * c[0] - r[0] * c[2]) +
                w[2] * (r[0] * c[1] - r[1] * c[0]);
  return -0.5 * turn + bend->e * mixed_form(p, r, w, c) +
         0.5 * bend->de * dot(p, r) * mixed_form(p, p, w, c);
}


// the same of the second derivative, along r and q
static double second_form(const Bend* bend, const double r[3], const double q[3], const double w[3],
                          const double c[3]) {
  const double* p = bend->phi;
  double pr = dot(p, r), pq = dot(p, q);
  return bend->e * mixed_form(r, q, w, c) +
         bend->de * (pq * mixed_form(p, r, w, c) + pr * mixed_form(p, q, w, c)) +
         0.5 * (bend->de * dot(q, r) + bend->dde * pr * pq) * mixed_form(p, p, w, c);
}


// what the curvature of the logarithms adds to the cost's half Hessian
static void add_curvature(double hessian[36], const Problem* problem, const Motion* motion) {
  PosePair difference;
  const SidePair* side = &problem->pair.side;
  V xi[6], residual[6], diag[9], corner[9], e, de;
  product(&difference, &motion->y, &problem->pair.relative);
  logarithm(xi, &e, &de, &difference);
  whitened_residual(residual, xi, side);
  inverse_jacobian(diag, corner, xi, e, de);
  for (int k = 0; k < 2; k++) {
    double rho[3] = {xi[0][k], xi[1][k], xi[2][k]}, weighted[6], directions[6][6] = {{0}};
    Bend bend = {{xi[3][k], xi[4][k], xi[5][k]}, e[k], de[k], 0};
    for (int n = 1; n <= 20; n++) {
      double pole = 1 / (n * n * FOUR_PI_SQUARED - dot(bend.phi, bend.phi));
      bend.dde += 16 * pole * pole * pole;
    }

    // covariance^-1 * xi = upper' * residual, and where a unit step takes xi
    for (int j = 0; j < 3; j++) {
      weighted[j] = weighted[3 + j] = 0;
      for (int i = 0; i < 3; i++) {
        int n = i * (5 - i) / 2 + j;
        weighted[j] += i <= j ? side->ul[n][k] * residual[i][k] : 0;
        weighted[3 + j] += side->ur[3 * i + j][k] * residual[i][k] +
                           (i <= j ? side->lr[n][k] * residual[3 + i][k] : 0);
        directions[j][i] = directions[3 + j][3 + i] = diag[3 * i + j][k];
        directions[3 + j][i] = corner[3 * i + j][k];
      }
    }
    for (int i = 0; i < 6; i++) {
      const double *shift = directions[i], *turn = directions[i] + 3;
      for (int j = 0; j < 6; j++) {
        double axis[3] = {j % 3 == 0, j % 3 == 1, j % 3 == 2}, value;
        if (j < 3) {
          value = first_form(&bend, turn, weighted, axis);
        } else {
          value = first_form(&bend, shift, weighted, axis) +
                  second_form(&bend, rho, turn, weighted, axis) +
                  first_form(&bend, turn, weighted + 3, axis);
        }
        hessian[6 * i + j] += 0.5 * value;
        hessian[6 * j + i] += 0.5 * value;
      }
    }
  }
}


// Newton's step instead of Gauss-Newton's, if the Hessian is positive definite; returns whether it
// is
static int newton(Model* model, const Problem* problem, const Motion* motion) {
  double hessian[36] = {0}, product[36];
  V packed[21], direction[6];
  add_curvature(hessian, problem, motion);

  // in posterior standard deviations: I + factor' * hessian * factor
  for (int i = 0; i < 6; i++) {
    for (int j = 0; j < 6; j++) {
      product[6 * i + j] = 0;
      for (int k = j; k < 6; k++) {
        product[6 * i + j] += hessian[6 * i + k] * model->factor[6 * k + j];
      }
    }
  }
  for (int i = 0; i < 6; i++) {
    for (int j = 0; j <= i; j++) {
      double sum = i == j;
      for (int k = i; k < 6; k++) { sum += model->factor[6 * k + i] * product[6 * k + j]; }
      packed[i * (i + 1) / 2 + j] = SPLAT(sum);
    }
    direction[i] = SPLAT(model->descent[i]);
  }
  FactorPair factor;
  M poor = {0};
  factorize(&factor, packed, &poor);
  if (any(poor)) { return 0; }
  solve_transposed(direction, &factor);
  for (int i = 0; i < 6; i++) { direction[i] *= factor.inverse[i]; }
  solve(direction, &factor);
  model->square = 0;
  for (int i = 0; i < 6; i++) {
    model->square += model->descent[i] * direction[i][0];
    model->step[i] = 0;
    for (int j = 0; j <= i; j++) { model->step[i] += model->factor[6 * i + j] * direction[j][0]; }
  }
  return 1;
}


// move by the longest of step, step/2, step/4, ... that lowers the cost enough; returns 0 if none
// does
static int line_search(Motion* motion, const Model* model, const Problem* problem) {
  if (model->square <= SEARCH_FROM * SEARCH_FROM) {
    problem_perturb(problem, motion, model->step);
    return 1;
  }
  for (double fraction = 1; fraction >= SHORTEST_STEP; fraction *= 0.5) {
    double step[6];
    Motion moved = *motion;
    for (int i = 0; i < 6; i++) { step[i] = fraction * model->step[i]; }
    problem_perturb(problem, &moved, step);
    double predicted = 2 * ARMIJO * fraction * model->square;
    if (problem_cost(problem, &moved) <= model->cost * (1 + SLACK) - predicted) {
      *motion = moved;
      return 1;
    }
  }
  return 0;
}


// descend from a start; returns 0, or -1 if the plain arithmetic does not suffice, or a fault
static int descend(FusionOutput* res, double* cost, Motion* motion, const Problem* problem,
                   int iterations) {
  Model model;
  double previous = HUGE_VAL;
  int use_newton = 0;
  res->status = FUSION_NOT_CONVERGED;
  for (res->iterations = 1;; res->iterations++) {
    if (!problem_model(&model, problem, motion)) {
      return problem->is_robust ? FUSION_NO_INFORMATION : -1;
    }
    res->step = sqrt(model.square);

    // converged: the step is rounding, or is small and no longer shrinks; it is still taken
    double scale = 1 + sqrt(model.cost);
    int at_floor = res->step <= FLOOR_TOLERANCE * scale && res->step > 0.5 * previous;
    if (res->step <= EXACT_TOLERANCE * scale || at_floor) {
      res->status = FUSION_CONVERGED;
      problem_perturb(problem, motion, model.step);
      break;
    }
    use_newton |= res->iterations > 1 && res->step > SLOW * previous;
    previous = res->step;
    if (res->iterations == iterations) {
      problem_perturb(problem, motion, model.step);
      break;
    }
    if (use_newton && newton(&model, problem, motion) && line_search(motion, &model, problem)) {
      continue;
    }
    if (use_newton && !problem_model(&model, problem, motion)) {
      return problem->is_robust ? FUSION_NO_INFORMATION : -1;
    }
    if (!line_search(motion, &model, problem)) {
      res->status = FUSION_STALLED;
      break;
    }
  }
  *cost = problem_cost(problem, motion);
  if (problem->is_robust) {
    robust_finish(res, &problem->robust, &motion->y_robust, &model.robust);
  } else {
    pair_finish(res, &problem->pair, &motion->y, &model.pair.information);
  }
  return 0;
}


// whether either mean is so far in angle that there may be several minima
static int is_far(const Problem* problem, const Motion* motion) {
  const PosePair* relative = &problem->pair.relative;
  PosePair difference;
  product(&difference, &motion->y, relative);
  return any(~(versine_of(relative->rot) <= SPLAT(REGULAR_VERSINE))) ||
         any(~(versine_of(difference.rot) <= SPLAT(REGULAR_VERSINE)));
}


// the motions to start from: the first mean, the second, and points in between on both ways round
static void set_starts(Motion start[STARTS], const Problem* problem) {
  const PosePair* relative = &problem->pair.relative;
  PosePair* second = &start[1].y;
  V xi[6], e, de;
  double pos[3] = {0};
  for (int n = 2; n < STARTS; n++) { set_identity(&start[n].y); }
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) {
      second->rot[3 * i + j] = SPLAT(relative->rot[3 * j + i][1]);
      pos[i] -= relative->rot[3 * j + i][1] * relative->pos[j][1];
    }
    second->pos[i] = SPLAT(pos[i]);
  }
  logarithm(xi, &e, &de, second);
  double phi[3] = {xi[3][0], xi[4][0], xi[5][0]}, angle = sqrt(dot(phi, phi));
  for (int n = 2; n < STARTS; n++) {
    // a fraction of the logarithm of X_2 X_1^-1 that turns the short or, from 5 on, the long way
    // round
    double fraction = 0.25 * ((n - 2) % 3 + 1), turn = n < 5 || angle == 0 ? 1 : 1 - TWO_PI / angle;
    double jac[36], around[6] = {0, 0, 0, turn * phi[0], turn * phi[1], turn * phi[2]}, part[6];
    se3_exact_inverse_left_jacobian(jac, around);
    for (int i = 0; i < 3; i++) {
      part[i] = fraction * dot(jac + 6 * i, pos);
      part[3 + i] = fraction * around[3 + i];
    }
    perturb_by(&start[n].y, part);
  }
}


// the start in twice the precision, if that is used
static void set_robust(Motion* motion, const Problem* problem) {
  if (!problem->is_robust) { return; }
  double mat[16];
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) { mat[4 * i + j] = motion->y.rot[3 * i + j][0]; }
    mat[4 * i + 3] = motion->y.pos[i][0];
  }
  dd_set_pose(&motion->y_robust, mat);
}


// the plain sides from the robust ones
static void round_sides(Problem* problem) {
  SidePair* plain = &problem->pair.side;
  for (int k = 0; k < 2; k++) {
    const RobustSide* side = problem->robust.side + k;
    for (int i = 0; i < 3; i++) {
      problem->pair.relative.pos[i][k] = dd_round(side->relative.pos[i]);
      for (int j = 0; j < 3; j++) {
        problem->pair.relative.rot[3 * i + j][k] = dd_round(side->relative.rot[3 * i + j]);
        plain->ur[3 * i + j][k] = dd_round(side->lower[6 * (3 + j) + i]);
        if (j >= i) {
          plain->ul[i * (5 - i) / 2 + j][k] = dd_round(side->lower[6 * j + i]);
          plain->lr[i * (5 - i) / 2 + j][k] = dd_round(side->lower[6 * (3 + j) + 3 + i]);
        }
      }
    }
  }
}


// returns 0, -1 if the plain arithmetic does not suffice, or a fault
static int exact_from_all_starts(FusionOutput* res, const Problem* problem, int iterations) {
  Motion start[STARTS];
  double lowest;
  set_identity(&start[0].y);
  set_robust(start, problem);
  int fault = descend(res, &lowest, start, problem, iterations);
  if (fault || (res->status == FUSION_CONVERGED && !is_far(problem, start))) { return fault; }
  set_starts(start, problem);
  for (int n = 1; n < STARTS; n++) {
    FusionOutput found;
    double cost;
    set_robust(start + n, problem);
    fault = descend(&found, &cost, start + n, problem, iterations);
    if (fault) { return fault; }

    // what has converged wins over what has not, then the lower cost, but not by rounding
    int settled = found.status == FUSION_CONVERGED, was = res->status == FUSION_CONVERGED;
    if (settled > was || (settled == was && cost < lowest - 1e-9 * (1 + lowest))) {
      *res = found;
      lowest = cost;
    }
  }
  return 0;
}


// returns 0 or a fault
static int fuse_exactly(FusionOutput* res, const FusionInput input[2], int iterations) {
  Problem problem;
  problem.is_robust = !pair_set(&problem.pair, input);
  int fault = problem.is_robust ? -1 : exact_from_all_starts(res, &problem, iterations);
  if (fault == -1) {
    problem.is_robust = 1;
    fault = robust_set(&problem.robust, input);
    if (fault) { return fault; }
    round_sides(&problem);
    fault = exact_from_all_starts(res, &problem, iterations);
  }
  return fault;
}

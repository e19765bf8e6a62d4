// The fusion where doubles do not suffice: square-root information by an orthogonal transformation
// (QL), all of it with twice the precision. It takes what the pivots of the quick path refuse:
// covariances whose correlations are nearly singular, and pairs whose sum of informations is.

typedef struct {
  Dd rot[9], pos[3];
} DdPose;

typedef struct {
  DdPose relative;  // X_1 X_k^-1
  Dd lower[36];     // covariance^-1 = lower * lower'
} RobustSide;

typedef struct {
  RobustSide side[2];
  DdPose base;
} Robust;

typedef struct {
  Dd factor[36];  // lower, of the covariance
  double y[6];    // the step in posterior standard deviations: step = factor * y
  double step[6];
  double square, cost;
} RobustModel;


static void dd_product_pose(DdPose* res, const DdPose* a, const DdPose* b) {
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) {
      Dd column[3] = {b->rot[j], b->rot[3 + j], b->rot[6 + j]};
      res->rot[3 * i + j] = dd_dot3(a->rot + 3 * i, column);
    }
    res->pos[i] = dd_add(dd_dot3(a->rot + 3 * i, b->pos), a->pos[i]);
  }
}


static void dd_inverse_pose(DdPose* res, const DdPose* pose) {
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) { res->rot[3 * i + j] = pose->rot[3 * j + i]; }
  }
  for (int i = 0; i < 3; i++) { res->pos[i] = dd_neg(dd_dot3(res->rot + 3 * i, pose->pos)); }
}


// the pose of a homogeneous matrix with the nearest rotation, by Newton's method
static void dd_set_pose(DdPose* res, const double mat[16]) {
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) { res->rot[3 * i + j] = dd_from(mat[4 * i + j]); }
    res->pos[i] = dd_from(mat[4 * i + 3]);
  }
  for (int n = 0; n < 3; n++) {
    Dd gram[9], rot[9];
    for (int i = 0; i < 3; i++) {
      for (int j = 0; j < 3; j++) {
        Dd a[3] = {res->rot[i], res->rot[3 + i], res->rot[6 + i]},
           b[3] = {res->rot[j], res->rot[3 + j], res->rot[6 + j]};
        gram[3 * i + j] = dd_dot3(a, b);
      }
    }
    for (int i = 0; i < 3; i++) {
      for (int j = 0; j < 3; j++) {
        Dd column[3] = {gram[j], gram[3 + j], gram[6 + j]};
        Dd triple = dd_mul(dd_from(3), res->rot[3 * i + j]);
        rot[3 * i + j] = dd_scale(dd_sub(triple, dd_dot3(res->rot + 3 * i, column)), 0.5);
      }
    }
    memcpy(res->rot, rot, sizeof(rot));
  }
}


// what a Gaussian lacks, of FUSION_NO_POSE and FUSION_NO_COVARIANCE, or 0; definiteness is not
// looked at
static int fusion_lack(const double mean[16], const double cov[36]) {
  Pose pose;
  if (mean[12] != 0 || mean[13] != 0 || mean[14] != 0 || mean[15] != 1) { return FUSION_NO_POSE; }
  se3_from_matrix(&pose, mean);
  if (!(se3_rotation_error(pose.rot) <= ROTATION_TOLERANCE) || !(se3_determinant(pose.rot) > 0) ||
      !isfinite(pose.pos[0]) || !isfinite(pose.pos[1]) || !isfinite(pose.pos[2])) {
    return FUSION_NO_POSE;
  }
  for (int i = 0; i < 6; i++) {
    for (int j = 0; j <= i; j++) {
      double difference = cov[6 * i + j] - cov[6 * j + i];
      double scale = SYMMETRY_TOLERANCE * SYMMETRY_TOLERANCE * (cov[7 * i] * cov[7 * j]);
      if (!(difference * difference <= scale) || !isfinite(cov[6 * i + j])) {
        return FUSION_NO_COVARIANCE;
      }
    }
  }
  return 0;
}


// lower with cov^-1 = lower * lower'; returns 0 if cov is not positive definite
static int dd_whitening(Dd lower[36], const double cov[36]) {
  Dd left[36], unit[36] = {{0, 0}}, scale[6];
  for (int i = 0; i < 36; i++) {
    left[i] = dd_scale(dd_sum(cov[i], cov[6 * (i % 6) + i / 6]), 0.5);
    lower[i] = dd_from(0);
  }
  for (int i = 5; i >= 0; i--) {
    Dd pivot = left[7 * i];
    if (!(pivot.hi > SMALLEST_PIVOT * cov[7 * i]) || !(pivot.hi <= DBL_MAX)) { return 0; }
    scale[i] = dd_div(dd_from(1), dd_sqrt(pivot));
    for (int j = 0; j < i; j++) {
      unit[6 * i + j] = dd_div(left[6 * i + j], pivot);
      for (int k = j; k < i; k++) {
        left[6 * k + j] = dd_sub(left[6 * k + j], dd_mul(left[6 * i + k], unit[6 * i + j]));
      }
    }
  }
  for (int j = 0; j < 6; j++) {
    lower[7 * j] = scale[j];
    for (int i = j + 1; i < 6; i++) {
      Dd sum = dd_from(0);
      for (int k = j; k < i; k++) { sum = dd_add(sum, dd_mul(unit[6 * i + k], lower[6 * k + j])); }
      lower[6 * i + j] = dd_neg(sum);
    }
  }
  return 1;
}


// returns 0, or 16 * (index of the argument) + what it lacks
static int robust_set(Robust* res, const FusionInput input[2]) {
  DdPose pose[2], inverse;
  for (int k = 0; k < 2; k++) {
    int lack = fusion_lack(input[k].mean, input[k].cov);
    if (lack) { return lack == FUSION_NO_POSE ? 32 * k + lack : 32 * k + 16 + lack; }
    if (!dd_whitening(res->side[k].lower, input[k].cov)) {
      return 32 * k + 16 + FUSION_NO_COVARIANCE;
    }
    dd_set_pose(pose + k, input[k].mean);
  }
  res->base = pose[0];
  for (int k = 0; k < 2; k++) {
    dd_inverse_pose(&inverse, pose + k);
    dd_product_pose(&res->side[k].relative, pose, &inverse);
  }
  return 0;
}


// whitened Jacobian and, in the last column, residual of one input
static void robust_rows(Dd rows[6][7], const DdPose* y, const RobustSide* side, int order) {
  DdPose difference;
  Dd xi[6], jac[36], diag[9], corner[9];
  dd_product_pose(&difference, y, &side->relative);
  exact_log(xi, xi + 3, difference.rot, difference.pos);
  exact_inverse_jacobian(diag, corner, xi, xi + 3, order);
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) {
      jac[6 * i + j] = jac[6 * (3 + i) + 3 + j] = diag[3 * i + j];
      jac[6 * i + 3 + j] = corner[3 * i + j];
      jac[6 * (3 + i) + j] = dd_from(0);
    }
  }
  for (int i = 0; i < 6; i++) {
    for (int j = 0; j < 7; j++) {
      Dd sum = dd_from(0);
      for (int k = i; k < 6; k++) {
        sum = dd_add(sum, dd_mul(side->lower[6 * k + i], j < 6 ? jac[6 * k + j] : xi[k]));
      }
      rows[i][j] = sum;
    }
  }
}


// reflections turn the first six columns into rows 6 to 11, lower triangular; the last column goes
// along
static void triangularize(Dd rows[12][7]) {
  for (int c = 5; c >= 0; c--) {
    int last = 6 + c;
    Dd square = dd_from(0), vec[12];
    for (int i = 0; i <= last; i++) {
      vec[i] = rows[i][c];
      square = dd_add(square, dd_mul(vec[i], vec[i]));
    }
    if (!(square.hi > 0)) { continue; }
    Dd norm = dd_sqrt(square);
    norm = vec[last].hi > 0 ? dd_neg(norm) : norm;
    vec[last] = dd_sub(vec[last], norm);
    Dd half = dd_neg(dd_mul(norm, vec[last]));  // half the squared length of vec
    for (int n = -1; n < c; n++) {
      int j = n < 0 ? 6 : n;
      Dd sum = dd_from(0);
      for (int i = 0; i <= last; i++) { sum = dd_add(sum, dd_mul(vec[i], rows[i][j])); }
      sum = dd_div(sum, half);
      for (int i = 0; i <= last; i++) { rows[i][j] = dd_sub(rows[i][j], dd_mul(sum, vec[i])); }
    }
    rows[last][c] = norm;
  }
}


// Gauss-Newton model at the motion y; returns 0 if the two together determine nothing in doubles
static int robust_model(RobustModel* model, const Robust* robust, const DdPose* y, int order) {
  Dd rows[12][7], cost = dd_from(0), step[6];
  robust_rows(rows, y, robust->side, order);
  robust_rows(rows + 6, y, robust->side + 1, order);
  for (int i = 0; i < 12; i++) { cost = dd_add(cost, dd_mul(rows[i][6], rows[i][6])); }
  triangularize(rows);

  // factor = triangle^-1 with a positive diagonal, step = -factor * residual
  Dd* factor = model->factor;
  memset(factor, 0, sizeof(model->factor));
  model->cost = dd_round(cost);
  model->square = 0;
  for (int i = 0; i < 6; i++) {
    Dd *row = rows[6 + i], inverse = dd_div(dd_from(1), row[i]);
    if (!isfinite(inverse.hi)) { return 0; }
    for (int j = 0; j < i; j++) {
      Dd sum = dd_from(0);
      for (int k = j; k < i; k++) { sum = dd_add(sum, dd_mul(row[k], factor[6 * k + j])); }
      factor[6 * i + j] = dd_neg(dd_mul(sum, inverse));
    }
    factor[7 * i] = inverse;
    step[i] = dd_from(0);
    for (int k = 0; k <= i; k++) {
      step[i] = dd_sub(step[i], dd_mul(factor[6 * i + k], rows[6 + k][6]));
    }
    model->step[i] = dd_round(step[i]);
  }
  for (int j = 0; j < 6; j++) {
    // a column's sign is free: the diagonal is made positive
    double sign = factor[7 * j].hi < 0 ? -1 : 1;
    for (int i = j; i < 6; i++) { factor[6 * i + j] = dd_scale(factor[6 * i + j], sign); }
    model->y[j] = -sign * dd_round(rows[6 + j][6]);
    model->square += model->y[j] * model->y[j];
  }
  return isfinite(model->square) && isfinite(model->cost);
}


static void robust_perturb(DdPose* y, const double step[6]) {
  DdPose motion, before = *y;
  Dd rho[3], phi[3];
  to_dd3(rho, step);
  to_dd3(phi, step + 3);
  Argument arg = argument(phi);
  if (arg.x.hi <= SERIES_LIMIT) {
    exact_exp(motion.rot, motion.pos, rho, phi, &arg);
  } else {
    double mat[16];
    exp_beyond(mat, step);
    dd_set_pose(&motion, mat);
  }
  dd_product_pose(y, &motion, &before);
}


static void robust_finish(FusionOutput* res, const Robust* robust, const DdPose* y,
                          const RobustModel* model) {
  DdPose mean;
  dd_product_pose(&mean, y, &robust->base);
  round_pose(res->mean, mean.rot, mean.pos);
  for (int i = 0; i < 6; i++) {
    for (int j = 0; j <= i; j++) {
      Dd sum = dd_from(0);
      for (int k = 0; k <= j; k++) {
        sum = dd_add(sum, dd_mul(model->factor[6 * i + k], model->factor[6 * j + k]));
      }
      res->cov[6 * i + j] = res->cov[6 * j + i] = dd_round(sum);
      res->factor[6 * j + i] = 0;
      res->factor[6 * i + j] = dd_round(model->factor[6 * i + j]);
    }
  }
}


// as pair_fixed; returns 0 or a fault
static int robust_fixed(FusionOutput* res, const FusionInput input[2], int iterations, int order) {
  Robust robust;
  RobustModel model;
  int fault = robust_set(&robust, input);
  if (fault) { return fault; }
  DdPose y = robust.side[0].relative;
  for (int i = 0; i < iterations; i++) {
    if (!robust_model(&model, &robust, &y, order)) { return FUSION_NO_INFORMATION; }
    robust_perturb(&y, model.step);
  }
  robust_finish(res, &robust, &y, &model);
  end_fixed(res, model.square, iterations);
  return 0;
}

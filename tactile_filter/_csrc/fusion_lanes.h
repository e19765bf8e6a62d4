// The arithmetic of the fusion on both inputs side by side in the two lanes of a vector.
//
// All poses are relative to the first mean: Y = X X_1^-1 and Z_k = X_1 X_k^-1. So the error of an
// input is log(Y Z_k), and what is sought is a small motion known to its own last digit.

#include "lanes_algebra.h"

// what whitens the errors of one of the two inputs, the upper triangular [[ul, ur], [0, lr]] with
// covariance^-1 = upper' * upper; ul and lr are upper triangular and hold 00, 01, 02, 11, 12, 22
typedef struct {
  V ul[6], ur[9], lr[6];
} SidePair;


// packed symmetric part of a covariance; `bad` gets the lanes that are not symmetric.
INLINE void symmetric_part(V res[21], const V cov[36], M* bad) {
  UNROLL
  for (int i = 0; i < 6; i++) {
    V scale = SPLAT(SYMMETRY_TOLERANCE * SYMMETRY_TOLERANCE) * cov[7 * i];
    res[i * (i + 1) / 2 + i] = cov[7 * i];
    for (int j = 0; j < i; j++) {
      V difference = cov[6 * i + j] - cov[6 * j + i];
      *bad |= ~(FNMA(difference, difference, scale * cov[7 * j]) >= SPLAT(0));
      res[i * (i + 1) / 2 + j] = FMA(SPLAT(-0.5), difference, cov[6 * i + j]);
    }
  }
}


// `bad` gets the lanes whose pose is none
INLINE void check_pose(const PosePair* pose, M* bad) {
  const V *r = pose->rot, *p = pose->pos;
  UNROLL
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j <= i; j++) {
      V error =
          FMA(r[6 + i], r[6 + j], FMA(r[3 + i], r[3 + j], r[i] * r[j])) - SPLAT(i == j ? 1 : 0);
      *bad |= ~(FNMA(error, error, SPLAT(ROTATION_TOLERANCE * ROTATION_TOLERANCE)) >= SPLAT(0));
    }
  }

  // a position that is not finite makes this zero no number
  V det = (r[0] * r[4] - r[1] * r[3]) * r[8] + (r[1] * r[5] - r[2] * r[4]) * r[6] +
          (r[2] * r[3] - r[0] * r[5]) * r[7];
  V zero = SPLAT(0) * p[0] + SPLAT(0) * p[1] + SPLAT(0) * p[2];
  *bad |= ~(det > SPLAT(0)) | ~(zero == SPLAT(0));
}


// whitening of an input from the factor of its covariance
INLINE void set_whitening(SidePair* side, const FactorPair* factor, const V root[6]) {
  V lower[21];

  // the transpose of the inverse's lower factor, by blocks
  inverse_factor(lower, factor, root);
  UNROLL
  for (int i = 0; i < 3; i++) {
    for (int j = i; j < 3; j++) {
      int n = i * (5 - i) / 2 + j;
      side->ul[n] = lower[j * (j + 1) / 2 + i];
      side->lr[n] = lower[(3 + j) * (4 + j) / 2 + 3 + i];
    }
    for (int j = 0; j < 3; j++) { side->ur[3 * i + j] = lower[(3 + j) * (4 + j) / 2 + i]; }
  }
}


// res = X_1 X_2^-1, its rotation made orthonormal
INLINE void set_relative(PosePair* res, const PosePair* first, const PosePair* second) {
  UNROLL
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) {
      res->rot[3 * i + j] = dot3(first->rot + 3 * i, second->rot + 3 * j);
    }
  }
  orthonormalize(res->rot);
  UNROLL
  for (int i = 0; i < 3; i++) { res->pos[i] = first->pos[i] - dot3(res->rot + 3 * i, second->pos); }
}


INLINE void set_identity(PosePair* res) {
  UNROLL
  for (int i = 0; i < 9; i++) { res->rot[i] = SPLAT(i % 4 == 0 ? 1 : 0); }
  res->pos[0] = res->pos[1] = res->pos[2] = SPLAT(0);
}


// the lanes whose angle is too large for the polynomials, one after another
static __attribute__((noinline, cold)) void log_irregular(V phi[3], V* e, V* de,
                                                          const PosePair* pose, M irregular) {
  for (int lane = 0; lane < 2; lane++) {
    if (irregular[lane]) {
      double rot[9], vec[3], coef[2];
      for (int i = 0; i < 9; i++) { rot[i] = pose->rot[i][lane]; }
      se3_rotation_vector(vec, rot);
      se3_inverse_coefficients(coef, vec[0] * vec[0] + vec[1] * vec[1] + vec[2] * vec[2]);
      for (int i = 0; i < 3; i++) { phi[i][lane] = vec[i]; }
      (*e)[lane] = coef[0];
      (*de)[lane] = coef[1];
    }
  }
}


// 1 - cos of the angle of a rotation
INLINE V versine_of(const V r[9]) {
  return SPLAT(0.5) * (((SPLAT(1) - r[0]) + (SPLAT(1) - r[4])) + (SPLAT(1) - r[8]));
}


// xi = log(pose), with the coefficients of the inverse Jacobian at xi
INLINE void logarithm(V xi[6], V* e, V* de, const PosePair* pose) {
  const V *r = pose->rot, *t = pose->pos;
  V* phi = xi + 3;
  V versine = versine_of(r);
  V half_turn = SPLAT(0.5) * polynomial(FIT_TURN, 12, versine);
  phi[0] = half_turn * (r[7] - r[5]);
  phi[1] = half_turn * (r[2] - r[6]);
  phi[2] = half_turn * (r[3] - r[1]);
  V x = dot3(phi, phi);
  *e = polynomial(FIT_COT, 6, x);
  *de = polynomial(FIT_D_COT, 6, x);
  M irregular = ~(versine <= SPLAT(REGULAR_VERSINE));
  if (any(irregular)) { log_irregular(phi, e, de, pose, irregular); }

  // rho = t - phi x t / 2 + e phi x (phi x t)
  V turned[3], twice[3];
  UNROLL
  for (int i = 0; i < 3; i++) {
    int j = (i + 1) % 3, k = (i + 2) % 3;
    turned[i] = FMA(phi[j], t[k], -(phi[k] * t[j]));
  }
  UNROLL
  for (int i = 0; i < 3; i++) {
    int j = (i + 1) % 3, k = (i + 2) % 3;
    twice[i] = FMA(phi[j], turned[k], -(phi[k] * turned[j]));
    xi[i] = FMA(*e, twice[i], FMA(SPLAT(-0.5), turned[i], t[i]));
  }
}


// blocks of the inverse left Jacobian [[diag, corner], [0, diag]] with its coefficients e and de
INLINE void inverse_jacobian(V diag[9], V corner[9], const V xi[6], V e, V de) {
  const V *r = xi, *p = xi + 3;
  V along = dot3(p, r), scale = de * along;

  // I - P/2 + e P P and -R/2 + e (P R + R P) + de (p.r) P P,
  // with P P = p p' - (p.p) I and P R + R P = p r' + r p' - 2 (p.r) I
  UNROLL
  for (int i = 0; i < 3; i++) {
    int j = (i + 1) % 3, k = (i + 2) % 3;
    V squares = FMA(p[j], p[j], p[k] * p[k]);
    diag[4 * i] = FNMA(e, squares, SPLAT(1));
    V mixed = FMA(p[j], r[j], p[k] * r[k]);
    corner[4 * i] = FMA(SPLAT(-2) * e, mixed, -(scale * squares));

    V ep = e * p[i], product = ep * p[j];
    V other = FMA(scale * p[i], p[j], FMA(ep, r[j], (e * r[i]) * p[j]));
    diag[3 * i + j] = FMA(SPLAT(0.5), p[k], product);
    diag[3 * j + i] = FMA(SPLAT(-0.5), p[k], product);
    corner[3 * i + j] = FMA(SPLAT(0.5), r[k], other);
    corner[3 * j + i] = FMA(SPLAT(-0.5), r[k], other);
  }
}


// residual of one input, whitened; returns its squared norm
INLINE V whitened_residual(V res[6], const V xi[6], const SidePair* side) {
  const V *ul = side->ul, *ur = side->ur, *lr = side->lr, *rho = xi, *phi = xi + 3;
  UNROLL
  for (int i = 0; i < 3; i++) {
    V upper = dot3(ur + 3 * i, phi), lower = SPLAT(0);
    for (int j = i; j < 3; j++) {
      int n = i * (5 - i) / 2 + j;
      upper = FMA(ul[n], rho[j], upper);
      lower = j == i ? lr[n] * phi[j] : FMA(lr[n], phi[j], lower);
    }
    res[i] = upper;
    res[3 + i] = lower;
  }
  return dot3(res, res) + dot3(res + 3, res + 3);
}


// res = upper * mat, upper triangular as in Side; res may be mat
INLINE void multiply_upper(V res[9], const V upper[6], const V mat[9]) {
  UNROLL
  for (int i = 0; i < 3; i++) {
    const V* row = upper + i * (5 - i) / 2;
    for (int j = 0; j < 3; j++) {
      V sum = row[i] * mat[3 * i + j];
      for (int k = i + 1; k < 3; k++) { sum = FMA(row[k], mat[3 * k + j], sum); }
      res[3 * i + j] = sum;
    }
  }
}


// column i of a by column j of b
INLINE V columns(const V a[9], int i, const V b[9], int j) {
  return FMA(a[6 + i], b[6 + j], FMA(a[3 + i], b[3 + j], a[i] * b[j]));
}


// what one input has in the information (packed) and the gradient, where its error is xi and the
// coefficients of the inverse Jacobian are e and de; returns its squared residual. The order is one
// that needs few registers
INLINE V contribution(V information[21], V gradient[6], const V xi[6], V e, V de,
                      const SidePair* side, int order) {
  V residual[6], ul[9], ur[9], lr[9], lower[6], slope[3];
  V cost = whitened_residual(residual, xi, side);
  if (order == JACOBIAN_ORDER_2) {
    e = SPLAT(1.0 / 12);
    de = SPLAT(0);
  } else if (order == JACOBIAN_ORDER_4) {
    e = FMA(dot3(xi + 3, xi + 3), SPLAT(1.0 / 720), SPLAT(1.0 / 12));
    de = SPLAT(1.0 / 360);
  }
  inverse_jacobian(ul, ur, xi, e, de);

  // of the whitened Jacobian [[ul, ur], [0, lr]] first the lower rows
  multiply_upper(lr, side->lr, ul);
  UNROLL
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j <= i; j++) { lower[i * (i + 1) / 2 + j] = columns(lr, i, lr, j); }
    slope[i] = FMA(lr[6 + i], residual[5], FMA(lr[3 + i], residual[4], lr[i] * residual[3]));
  }

  // the upper ones take the place of the Jacobian
  multiply_upper(ur, side->ul, ur);
  UNROLL
  for (int i = 0; i < 3; i++) {
    const V* row = side->ur + 3 * i;
    for (int j = 0; j < 3; j++) {
      ur[3 * i + j] =
          FMA(row[2], ul[6 + j], FMA(row[1], ul[3 + j], FMA(row[0], ul[j], ur[3 * i + j])));
    }
  }
  multiply_upper(ul, side->ul, ul);
  UNROLL
  for (int i = 0; i < 3; i++) {
    gradient[i] = FMA(ul[6 + i], residual[2], FMA(ul[3 + i], residual[1], ul[i] * residual[0]));
    gradient[3 + i] =
        FMA(ur[6 + i], residual[2], FMA(ur[3 + i], residual[1], FMA(ur[i], residual[0], slope[i])));
    for (int j = 0; j < 3; j++) {
      int n = i * (i + 1) / 2 + j, m = (3 + i) * (4 + i) / 2 + j;
      information[m] = columns(ur, i, ul, j);
      if (j <= i) {
        information[n] = columns(ul, i, ul, j);
        information[m + 3] =
            FMA(ur[6 + i], ur[6 + j], FMA(ur[3 + i], ur[3 + j], FMA(ur[i], ur[j], lower[n])));
      }
    }
  }
  return cost;
}


// gradient -> Gauss-Newton step by the information's factor; returns its squared length in standard
// deviations
INLINE V gauss_newton(V step[6], V gradient[6], const FactorPair* factor) {
  solve_transposed(gradient, factor);
  V square = SPLAT(0);
  UNROLL
  for (int i = 0; i < 6; i++) {
    step[i] = -gradient[i] * factor->inverse[i];
    square = FNMA(gradient[i], step[i], square);
  }
  solve(step, factor);
  return square;
}


static __attribute__((noinline, cold)) void exp_irregular(V coef[3], V x, M irregular) {
  for (int lane = 0; lane < 2; lane++) {
    if (irregular[lane]) {
      double res[3];
      se3_exp_coefficients(res, x[lane]);
      for (int i = 0; i < 3; i++) { coef[i][lane] = res[i]; }
    }
  }
}


// y = exp(xi^) * y
INLINE void perturb(PosePair* y, const V xi[6]) {
  const V *rho = xi, *phi = xi + 3;
  V x = dot3(phi, phi), coef[3];
  coef[0] = polynomial(FIT_SIN, 6, x);
  coef[1] = polynomial(FIT_COS, 6, x);
  coef[2] = polynomial(FIT_CUBIC, 6, x);
  M irregular = ~(x <= SPLAT(REGULAR_SQUARE));
  if (any(irregular)) { exp_irregular(coef, x, irregular); }

  // rotation: I + c0 phi^ + c1 phi^ phi^; translation: rho + c1 phi x rho + c2 phi x (phi x rho)
  PosePair motion, before = *y;
  V turned[3];
  UNROLL
  for (int i = 0; i < 3; i++) {
    int j = (i + 1) % 3, k = (i + 2) % 3;
    V product = (coef[1] * phi[i]) * phi[j];
    motion.rot[4 * i] = FNMA(coef[1], FMA(phi[j], phi[j], phi[k] * phi[k]), SPLAT(1));
    motion.rot[3 * i + j] = FNMA(coef[0], phi[k], product);
    motion.rot[3 * j + i] = FMA(coef[0], phi[k], product);
    turned[i] = FMA(phi[j], rho[k], -(phi[k] * rho[j]));
  }
  UNROLL
  for (int i = 0; i < 3; i++) {
    int j = (i + 1) % 3, k = (i + 2) % 3;
    V twice = FMA(phi[j], turned[k], -(phi[k] * turned[j]));
    motion.pos[i] = FMA(coef[2], twice, FMA(coef[1], turned[i], rho[i]));
  }
  product(y, &motion, &before);
}

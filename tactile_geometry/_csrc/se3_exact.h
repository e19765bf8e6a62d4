// exp, log, adjoint, left Jacobian and its inverse on matrices as Python sees them, correct to
// about the last bit at all angles: the arithmetic is done with twice the precision and rounded
// once at the end.
//
// Poses are homogeneous matrices mat[16], row-major; tangent vectors are xi[6] = [rho, phi].
// Included once by each instruction set , hence all static.
#ifndef TACTILE_SE3_EXACT_H_
#define TACTILE_SE3_EXACT_H_

#include "coefficients.h"
#include "dd.h"
#include "se3.h"

// beyond this t^2, a little over a full turn, the series are left for trigonometric functions
#define SERIES_LIMIT 40.0

// R^T R - I of a rotation that is good to rounding; one that is further off is replaced by the
// nearest rotation
#define ROUNDING 1e-14

// of a unit quaternion: below it a component is rounding
#define NO_COMPONENT 1e-25

#define MOST_TERMS 26

typedef struct {
  Dd x;               // t^2
  int full, double_;  // terms of a series in twice the precision, and in all
} Argument;


// how many terms reach 1e-20 at x = t^2
static inline Argument argument(const Dd phi[3]) {
  Argument res = {dd_dot3(phi, phi), 12, MOST_TERMS};
  double x = res.x.hi;
  if (x <= 1e-12) {
    res.full = 2, res.double_ = 3;
  } else if (x <= 0.1) {
    res.full = 4, res.double_ = 10;
  } else if (x <= 1) {
    res.full = 5, res.double_ = 12;
  } else if (x <= 10) {
    res.full = 9, res.double_ = 19;
  }
  return res;
}


// sum of coef[k]*x^k: the small terms in double, the first ones in twice the precision
static inline Dd series(const Dd* coef, const Argument* arg) {
  double tail = 0;
  for (int k = arg->double_ - 1; k >= arg->full; k--) { tail = tail * arg->x.hi + coef[k].hi; }
  Dd res = dd_from(tail);
  for (int k = arg->full - 1; k >= 0; k--) { res = dd_add(dd_mul(res, arg->x), coef[k]); }
  return res;
}


// twice the derivative of a series by x: that by t, over t
static inline Dd slope(const Dd* coef, const Argument* arg) {
  Dd scaled[MOST_TERMS] = {{0, 0}};
  for (int k = 0; k < arg->double_; k++) { scaled[k] = dd_mul(dd_from(2 * (k + 1)), coef[k + 1]); }
  return series(scaled, arg);
}


static inline void to_dd3(Dd res[3], const double vec[3]) {
  for (int i = 0; i < 3; i++) { res[i] = dd_from(vec[i]); }
}


// angles beyond a full turn: the axis apart from the angle, so that nothing overflows
static inline void exp_beyond(double res[16], const double xi[6]) {
  double t = hypot(hypot(xi[3], xi[4]), xi[5]);
  double axis[3] = {xi[3] / t, xi[4] / t, xi[5] / t};
  double sine = sin(t), half = sin(0.5 * t), one_cos = 2 * half * half;
  double along = axis[0] * xi[0] + axis[1] * xi[1] + axis[2] * xi[2];
  double turned[3] = {axis[1] * xi[2] - axis[2] * xi[1], axis[2] * xi[0] - axis[0] * xi[2],
                      axis[0] * xi[1] - axis[1] * xi[0]};
  double skew[9] = {0, -axis[2], axis[1], axis[2], 0, -axis[0], -axis[1], axis[0], 0};
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) {
      res[4 * i + j] =
          (i == j) * (1 - one_cos) + sine * skew[3 * i + j] + one_cos * axis[i] * axis[j];
    }
    res[4 * i + 3] = sine / t * xi[i] + one_cos / t * turned[i] + (1 - sine / t) * along * axis[i];
  }
}


// rotation and translation of exp([rho, phi]), for angles within the series
// (t - sin t)/t^3 is the series of sin(t)/t from its second term on, negated
static inline void exact_exp(Dd rot[9], Dd pos[3], const Dd rho[3], const Dd phi[3],
                             const Argument* arg) {
  Dd a = series(SIN, arg), b = series(COS, arg), c = dd_neg(series(SIN + 1, arg)), turned[3],
     twice[3];

  // rotation: I + a phi^ + b phi^ phi^
  Dd diagonal = dd_sub(dd_from(1), dd_mul(b, arg->x));
  for (int i = 0; i < 3; i++) {
    int j = (i + 1) % 3, k = (i + 2) % 3;
    Dd product = dd_mul(b, dd_mul(phi[i], phi[j])), sine = dd_mul(a, phi[k]);
    rot[4 * i] = dd_add(diagonal, dd_mul(b, dd_mul(phi[i], phi[i])));
    rot[3 * i + j] = dd_sub(product, sine);
    rot[3 * j + i] = dd_add(product, sine);
  }

  // translation: rho + b phi x rho + c phi x (phi x rho)
  dd_cross3(turned, phi, rho);
  dd_cross3(twice, phi, turned);
  for (int i = 0; i < 3; i++) {
    pos[i] = dd_add(dd_add(rho[i], dd_mul(b, turned[i])), dd_mul(c, twice[i]));
  }
}


static inline void round_pose(double res[16], const Dd rot[9], const Dd pos[3]) {
  Pose pose;
  for (int i = 0; i < 9; i++) { pose.rot[i] = dd_round(rot[i]); }
  for (int i = 0; i < 3; i++) { pose.pos[i] = dd_round(pos[i]); }
  se3_to_matrix(res, &pose);
}


static inline void se3_exact_exp(double res[16], const double xi[6]) {
  Dd rot[9], pos[3], rho[3], phi[3];
  to_dd3(rho, xi);
  to_dd3(phi, xi + 3);
  res[12] = res[13] = res[14] = 0;
  res[15] = 1;
  Argument arg = argument(phi);
  if (!(arg.x.hi <= SERIES_LIMIT)) {
    exp_beyond(res, xi);
    return;
  }
  exact_exp(rot, pos, rho, phi, &arg);
  round_pose(res, rot, pos);
}


// quaternion (x, y, z, w), not normalized, that has its largest component computed without
// cancellation
static inline void quaternion(Dd res[4], const Dd rot[9]) {
  Dd trace = dd_add(dd_add(rot[0], rot[4]), rot[8]);
  int i = rot[4].hi > rot[0].hi;
  i = rot[8].hi > rot[4 * i].hi ? 2 : i;
  if (trace.hi >= rot[4 * i].hi) {
    res[0] = dd_sub(rot[7], rot[5]);
    res[1] = dd_sub(rot[2], rot[6]);
    res[2] = dd_sub(rot[3], rot[1]);
    res[3] = dd_add(dd_from(1), trace);
    return;
  }
  int j = (i + 1) % 3, k = (i + 2) % 3;
  res[i] = dd_sub(dd_add(dd_from(1), rot[4 * i]), dd_add(rot[4 * j], rot[4 * k]));
  res[j] = dd_add(rot[3 * j + i], rot[3 * i + j]);
  res[k] = dd_add(rot[3 * k + i], rot[3 * i + k]);
  res[3] = dd_sub(rot[3 * k + j], rot[3 * j + k]);
}


// q and -q are one rotation: w >= 0, at w = 0 the first other component that is not zero is
// positive
static inline void normalize_sign(Dd q[4]) {
  double largest = fmax(fmax(fabs(q[0].hi), fabs(q[1].hi)), fmax(fabs(q[2].hi), fabs(q[3].hi)));
  static const int order[4] = {3, 0, 1, 2};
  for (int n = 0; n < 4; n++) {
    double component = q[order[n]].hi;
    if (fabs(component) > NO_COMPONENT * largest) {
      for (int i = 0; component < 0 && i < 4; i++) { q[i] = dd_neg(q[i]); }
      return;
    }
  }
}


// atan(s/w), s >= 0, w >= 0: the double result with one step of Newton's method
static inline Dd arctangent(Dd s, Dd w) {
  Dd angle[3] = {dd_from(atan2(s.hi, w.hi)), dd_from(0), dd_from(0)};
  Argument arg = argument(angle);
  Dd sine = dd_mul(angle[0], series(SIN, &arg));
  Dd cosine = dd_sub(dd_from(1), dd_mul(arg.x, series(COS, &arg)));
  Dd excess = dd_sub(dd_mul(s, cosine), dd_mul(w, sine));
  Dd length = dd_add(dd_mul(s, sine), dd_mul(w, cosine));
  return dd_add(angle[0], dd_div(excess, length));
}


// rotation vector; returns 0 if the matrix has no direction
static inline int rotation_vector(Dd res[3], const Dd rot[9]) {
  Dd q[4], scale;
  quaternion(q, rot);
  normalize_sign(q);
  Dd square = dd_dot3(q, q);
  if (square.hi <= 1e-12 * q[3].hi * q[3].hi) {
    // 2 atan(u)/u / w with u^2 = square/w^2
    Dd ratio = dd_div(square, dd_mul(q[3], q[3]));
    if (!(q[3].hi > 0)) { return 0; }
    Dd third = dd_div(ratio, dd_from(3)), fifth = dd_scale(dd_mul(ratio, ratio), 0.2);
    scale = dd_div(dd_scale(dd_add(dd_sub(dd_from(1), third), fifth), 2), q[3]);
  } else {
    Dd sine = dd_sqrt(square);
    scale = dd_div(dd_scale(arctangent(sine, q[3]), 2), sine);
  }
  for (int i = 0; i < 3; i++) { res[i] = dd_mul(scale, q[i]); }
  return 1;
}


// e = (1 - (t/2) cot(t/2)) / t^2 and, unless it is null, (de/dt)/t of t^2 = x
static inline void inverse_coefficients(Dd* e, Dd* de, const Argument* arg) {
  double x = arg->x.hi;
  if (!(x <= SERIES_LIMIT)) {
    double t = sqrt(x), sine = sin(0.5 * t), c = 0.5 * t * cos(0.5 * t) / sine;
    *e = dd_from((1 - c) / x);
    if (de) { *de = dd_from((c - 2 + x / (4 * sine * sine)) / (x * x)); }
    return;
  }
  Dd first = dd_div(dd_from(1), dd_sub(POLES[0], arg->x));
  Dd second = dd_div(dd_from(1), dd_sub(POLES[1], arg->x));
  *e = dd_add(dd_scale(dd_add(first, second), 2), series(COT, arg));
  if (!de) { return; }
  Dd squares = dd_add(dd_mul(first, first), dd_mul(second, second));
  *de = dd_add(dd_scale(squares, 4), slope(COT, arg));
}


// logarithm [rho, phi] of a rotation and a position; returns 0 if the matrix is no rotation at all
static inline int exact_log(Dd rho[3], Dd phi[3], const Dd rot[9], const Dd pos[3]) {
  Dd turned[3], twice[3], e;
  if (!rotation_vector(phi, rot)) { return 0; }
  Argument arg = argument(phi);
  inverse_coefficients(&e, NULL, &arg);

  // rho = t - phi x t / 2 + e phi x (phi x t)
  dd_cross3(turned, phi, pos);
  dd_cross3(twice, phi, turned);
  for (int i = 0; i < 3; i++) {
    rho[i] = dd_add(dd_sub(pos[i], dd_scale(turned[i], 0.5)), dd_mul(e, twice[i]));
  }
  return 1;
}


// |phi| <= pi; at a half turn the first component of phi that is not zero is positive; returns 0 if
// the matrix is no rotation at all
static inline int se3_exact_log(double res[6], const double mat[16]) {
  Dd rot[9], pos[3], rho[3], phi[3];
  Pose pose;
  se3_from_matrix(&pose, mat);
  double error = se3_rotation_error(pose.rot);
  if (error > ROUNDING && error <= ROTATION_TOLERANCE) { se3_orthonormalize(&pose); }
  for (int i = 0; i < 3; i++) {
    to_dd3(rot + 3 * i, pose.rot + 3 * i);
    pos[i] = dd_from(mat[4 * i + 3]);
  }
  if (!exact_log(rho, phi, rot, pos)) { return 0; }
  for (int i = 0; i < 3; i++) {
    res[i] = dd_round(rho[i]);
    res[3 + i] = dd_round(phi[i]);
  }
  return 1;
}


// res = [[diag, corner], [0, diag]]
static inline void fill_blocks(double res[36], const Dd diag[9], const Dd corner[9]) {
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) {
      res[6 * i + j] = res[6 * (3 + i) + 3 + j] = dd_round(diag[3 * i + j]);
      res[6 * i + 3 + j] = dd_round(corner[3 * i + j]);
      res[6 * (3 + i) + j] = 0;
    }
  }
}


static inline void se3_exact_adjoint(double res[36], const double mat[16]) {
  Dd diag[9], corner[9];
  for (int j = 0; j < 3; j++) {
    Dd pos[3], column[3], turned[3];
    for (int i = 0; i < 3; i++) {
      pos[i] = dd_from(mat[4 * i + 3]);
      column[i] = diag[3 * i + j] = dd_from(mat[4 * i + j]);
    }
    dd_cross3(turned, pos, column);
    for (int i = 0; i < 3; i++) { corner[3 * i + j] = turned[i]; }
  }
  fill_blocks(res, diag, corner);
}


// I + b ad + c ad^2 with ad the curly hat of xi; db and dc are (db/dt)/t and (dc/dt)/t: the upper
// right block is the derivative of the others along rho
static inline void polynomial_of_ad(Dd diag[9], Dd corner[9], const Dd rho[3], const Dd phi[3],
                                    Dd x, const Dd coef[4]) {
  Dd b = coef[0], c = coef[1], db = coef[2], dc = coef[3];
  Dd along = dd_dot3(phi, rho);
  Dd skew = dd_mul(db, along), square = dd_mul(dc, along);
  Dd on_diag = dd_sub(dd_from(1), dd_mul(c, x));
  Dd on_corner = dd_neg(dd_add(dd_scale(dd_mul(c, along), 2), dd_mul(square, x)));
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) {
      Dd product = dd_mul(phi[i], phi[j]);
      Dd mixed = dd_add(dd_mul(phi[i], rho[j]), dd_mul(rho[i], phi[j]));
      diag[3 * i + j] = dd_mul(c, product);
      corner[3 * i + j] = dd_add(dd_mul(c, mixed), dd_mul(square, product));
    }
    diag[4 * i] = dd_add(diag[4 * i], on_diag);
    corner[4 * i] = dd_add(corner[4 * i], on_corner);
  }

  // the skew parts
  for (int i = 0; i < 3; i++) {
    int at = 3 * ((i + 2) % 3) + (i + 1) % 3, opposite = 3 * ((i + 1) % 3) + (i + 2) % 3;
    Dd turn = dd_mul(b, phi[i]), shift = dd_add(dd_mul(b, rho[i]), dd_mul(skew, phi[i]));
    diag[at] = dd_add(diag[at], turn);
    diag[opposite] = dd_sub(diag[opposite], turn);
    corner[at] = dd_add(corner[at], shift);
    corner[opposite] = dd_sub(corner[opposite], shift);
  }
}


static inline void se3_exact_left_jacobian(double res[36], const double xi[6]) {
  Dd rho[3], phi[3], coef[4], diag[9], corner[9];
  to_dd3(rho, xi);
  to_dd3(phi, xi + 3);
  Argument arg = argument(phi);
  if (arg.x.hi <= SERIES_LIMIT) {
    coef[0] = series(COS, &arg);
    coef[1] = dd_neg(series(SIN + 1, &arg));
    coef[2] = slope(COS, &arg);
    coef[3] = dd_neg(slope(SIN + 1, &arg));
  } else {
    double x = arg.x.hi, t = sqrt(x), half = sin(0.5 * t) / t, sine = sin(t) / t;
    coef[0] = dd_from(2 * half * half);
    coef[1] = dd_from((1 - sine) / x);
    coef[2] = dd_from((sine - 4 * half * half) / x);
    coef[3] = dd_from((3 * sine - 2 - cos(t)) / (x * x));
  }
  polynomial_of_ad(diag, corner, rho, phi, arg.x, coef);
  fill_blocks(res, diag, corner);
}


// blocks of the inverse left Jacobian [[diag, corner], [0, diag]]; `order` as in se3.h
static inline void exact_inverse_jacobian(Dd diag[9], Dd corner[9], const Dd rho[3],
                                          const Dd phi[3], int order) {
  static const Dd twelfth = {0.08333333333333333, 4.625929269271485e-18};
  Argument arg = argument(phi);
  Dd coef[4] = {{-0.5, 0}, twelfth, {0, 0}, {0, 0}};
  if (order == JACOBIAN_ORDER_4) {
    coef[1] = dd_add(twelfth, dd_div(arg.x, dd_from(720)));
    coef[3] = dd_div(dd_from(1), dd_from(360));
  } else if (order == JACOBIAN_EXACT) {
    inverse_coefficients(coef + 1, coef + 3, &arg);
  }
  polynomial_of_ad(diag, corner, rho, phi, arg.x, coef);
}


// not at |phi| = 2 pi n, n > 0
static inline void se3_exact_inverse_left_jacobian(double res[36], const double xi[6]) {
  Dd rho[3], phi[3], diag[9], corner[9];
  to_dd3(rho, xi);
  to_dd3(phi, xi + 3);
  exact_inverse_jacobian(diag, corner, rho, phi, JACOBIAN_EXACT);
  fill_blocks(res, diag, corner);
}

#endif  // TACTILE_SE3_EXACT_H_

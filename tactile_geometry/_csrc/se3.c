#include "se3.h"

#include <float.h>
#include <math.h>
#include <string.h>

#include "coefficients.h"
#include "vec3.h"

#define PI_SQUARED 9.869604401089358618834490999876151135

// below this theta^2 the coefficients of exp come from their power series
#define SERIES_LIMIT 1.0


static double polynomial(const double* coef, int n, double x) {
  double res = coef[n - 1];
  for (int i = n - 2; i >= 0; i--) { res = res * x + coef[i]; }
  return res;
}


// the first n terms of a series of coefficients.h, in doubles
static double series(const Dd* coef, int n, double x) {
  double res = coef[n - 1].hi;
  for (int i = n - 2; i >= 0; i--) { res = res * x + coef[i].hi; }
  return res;
}


void se3_exp_coefficients(double res[3], double x) {
  if (x <= SERIES_LIMIT) {
    // so many terms reach the last digit
    int n = x <= 0.02 ? 5 : 9;
    res[0] = series(SIN, n, x);
    res[1] = series(COS, n, x);
    res[2] = -series(SIN + 1, n, x);
    return;
  }

  // beyond the limit the two quotients do not cancel, the third does less and less
  double t = sqrt(x);
  double half = sin(0.5 * t) / t;
  res[0] = sin(t) / t;
  res[1] = 2 * half * half;
  res[2] = x <= PI_SQUARED ? -series(SIN + 1, 15, x) : (1 - res[0]) / x;
}


// two poles and the rest as a power series
void se3_inverse_coefficients(double res[2], double x) {
  static const double coef[] = {
      0.020007593556872226,   2.5438120688625627e-05, 5.584568390494416e-08,
      1.4088241574761053e-10, 3.7567162002157994e-13, 1.0280125375360467e-15,
      2.8500221292137926e-18, 7.95557541071985e-21,   2.228932664553703e-23,
      6.257471150805777e-26,  1.7586730492909698e-28, 4.945846950057944e-31};
  static const double derivative[] = {
      5.0876241377251254e-05, 2.2338273561977663e-07, 8.452944944856632e-10, 3.0053729601726395e-12,
      1.0280125375360467e-14, 3.420026555056551e-17,  1.113780557500779e-19, 3.5662922632859247e-22,
      1.1263448071450399e-24, 3.51734609858194e-27,   1.0880863290127476e-29};
  double first = 4 * PI_SQUARED - x, second = 16 * PI_SQUARED - x;
  double scale = 1 / (first * second);
  double to_first = second * scale, to_second = first * scale;
  int n = x <= 1 ? 7 : 12;
  res[0] = 2 * (to_first + to_second) + polynomial(coef, n, x);
  res[1] = 4 * (to_first * to_first + to_second * to_second) + polynomial(derivative, n - 1, x);
}


// rotation vector through the quaternion that has its largest component computed without
// cancellation
void se3_rotation_vector(double res[3], const double r[9]) {
  double q[4], trace = r[0] + r[4] + r[8];
  if (trace >= r[0] && trace >= r[4] && trace >= r[8]) {
    q[0] = r[7] - r[5];
    q[1] = r[2] - r[6];
    q[2] = r[3] - r[1];
    q[3] = 1 + trace;
  } else {
    int i = r[0] >= r[4] && r[0] >= r[8] ? 0
            : r[4] >= r[8]               ? 1
                                         : 2,
        j = (i + 1) % 3, k = (i + 2) % 3;
    q[i] = 1;
    for (int n = 0; n < 3; n++) { q[i] += n == i ? r[4 * n] : -r[4 * n]; }
    q[j] = r[3 * j + i] + r[3 * i + j];
    q[k] = r[3 * k + i] + r[3 * i + k];
    q[3] = r[3 * k + j] - r[3 * j + k];
  }

  // q and -q are one rotation: w >= 0, at w = 0 the first other component that is not zero is
  // positive
  double leading = q[3] != 0 ? q[3] : q[0] != 0 ? q[0] : q[1] != 0 ? q[1] : q[2];
  double sign = leading < 0 ? -1 : 1;
  double sine = sqrt(dot3(q, q));
  double scale = sine > 0 ? 2 * atan2(sine, sign * q[3]) / sine : 2 / (sign * q[3]);
  for (int i = 0; i < 3; i++) { res[i] = sign * scale * q[i]; }
}


void se3_log(double res[6], const Pose* pose) {
  double e[2], turned[3], twice[3];
  double* phi = res + 3;
  se3_rotation_vector(phi, pose->rot);
  se3_inverse_coefficients(e, dot3(phi, phi));

  // rho = t - phi x t / 2 + e phi x (phi x t)
  cross3(turned, phi, pose->pos);
  cross3(twice, phi, turned);
  for (int i = 0; i < 3; i++) { res[i] = pose->pos[i] - 0.5 * turned[i] + e[0] * twice[i]; }
}


void se3_from_matrix(Pose* res, const double mat[16]) {
  for (int i = 0; i < 3; i++) {
    memcpy(res->rot + 3 * i, mat + 4 * i, 3 * sizeof(double));
    res->pos[i] = mat[4 * i + 3];
  }
}


void se3_to_matrix(double res[16], const Pose* pose) {
  for (int i = 0; i < 3; i++) {
    memcpy(res + 4 * i, pose->rot + 3 * i, 3 * sizeof(double));
    res[4 * i + 3] = pose->pos[i];
  }
  res[12] = res[13] = res[14] = 0;
  res[15] = 1;
}


int se3_from_euler(double m[16], const double euler[6]) {
  double ca = cos(euler[3]), sa = sin(euler[3]), cb = cos(euler[4]), sb = sin(euler[4]);
  double cg = cos(euler[5]), sg = sin(euler[5]);
  double found[16] = {cg * cb,
                      cg * sb * sa - sg * ca,
                      cg * sb * ca + sg * sa,
                      euler[0],
                      sg * cb,
                      sg * sb * sa + cg * ca,
                      sg * sb * ca - cg * sa,
                      euler[1],
                      -sb,
                      cb * sa,
                      cb * ca,
                      euler[2],
                      0,
                      0,
                      0,
                      1};
  memcpy(m, found, sizeof(found));
  return 1;
}


int se3_to_euler(double euler[6], const double m[16]) {
  if (m[12] != 0 || m[13] != 0 || m[14] != 0 || m[15] != 1) { return 0; }
  double cos_beta = hypot(m[0], m[4]);
  int defined = cos_beta > 4 * DBL_EPSILON;
  for (int i = 0; i < 3; i++) { euler[i] = m[4 * i + 3]; }
  euler[3] = defined ? atan2(m[9], m[10]) : atan2(-m[6], m[5]);
  euler[4] = atan2(-m[8], cos_beta);
  euler[5] = defined ? atan2(m[4], m[0]) : 0;
  return 1;
}


void se3_product(Pose* res, const Pose* a, const Pose* b) {
  for (int i = 0; i < 3; i++) {
    const double* row = a->rot + 3 * i;
    for (int j = 0; j < 3; j++) {
      res->rot[3 * i + j] = row[0] * b->rot[j] + row[1] * b->rot[3 + j] + row[2] * b->rot[6 + j];
    }
    res->pos[i] = dot3(row, b->pos) + a->pos[i];
  }
}


void se3_difference(Pose* res, const Pose* a, const Pose* b) {
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) { res->rot[3 * i + j] = dot3(a->rot + 3 * i, b->rot + 3 * j); }
  }
  for (int i = 0; i < 3; i++) { res->pos[i] = a->pos[i] - dot3(res->rot + 3 * i, b->pos); }
}


void se3_inverse(Pose* res, const Pose* pose) {
  for (int i = 0; i < 3; i++) {
    double sum = 0;
    for (int j = 0; j < 3; j++) {
      res->rot[3 * i + j] = pose->rot[3 * j + i];
      sum += pose->rot[3 * j + i] * pose->pos[j];
    }
    res->pos[i] = -sum;
  }
}


void se3_inverse_product(Pose* res, const Pose* a, const Pose* b) {
  for (int i = 0; i < 3; i++) {
    res->pos[i] = 0;
    for (int j = 0; j < 3; j++) {
      res->rot[3 * i + j] =
          a->rot[i] * b->rot[j] + a->rot[3 + i] * b->rot[3 + j] + a->rot[6 + i] * b->rot[6 + j];
      res->pos[i] += a->rot[3 * j + i] * (b->pos[j] - a->pos[j]);
    }
  }
}


// transpose(rot) * rot
static void gram3(double res[9], const double rot[9]) {
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) {
      res[3 * i + j] = rot[i] * rot[j] + rot[3 + i] * rot[3 + j] + rot[6 + i] * rot[6 + j];
    }
  }
}


void se3_orthonormalize(Pose* pose) {
  double excess[9], factor[9], rot[9];
  gram3(excess, pose->rot);
  for (int i = 0; i < 3; i++) { excess[4 * i] -= 1; }

  // rot * (I + excess)^(-1/2); the next term of the series is below rounding
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) {
      double square = excess[3 * i] * excess[j] + excess[3 * i + 1] * excess[3 + j] +
                      excess[3 * i + 2] * excess[6 + j];
      factor[3 * i + j] = 0.5 * excess[3 * i + j] - 0.375 * square;
    }
  }
  for (int i = 0; i < 3; i++) {
    const double* row = pose->rot + 3 * i;
    for (int j = 0; j < 3; j++) {
      rot[3 * i + j] =
          row[j] - (row[0] * factor[j] + row[1] * factor[3 + j] + row[2] * factor[6 + j]);
    }
  }
  for (int i = 0; i < 9; i++) { pose->rot[i] = rot[i]; }
}


double se3_rotation_error(const double rot[9]) {
  double gram[9], res = 0;
  gram3(gram, rot);
  for (int i = 0; i < 9; i++) {
    double error = fabs(gram[i] - (i % 4 == 0));

    // not less, so that a NaN comes through
    res = !(error <= res) ? error : res;
  }
  return res;
}


double se3_determinant(const double r[9]) {
  return (r[0] * r[4] - r[1] * r[3]) * r[8] + (r[1] * r[5] - r[2] * r[4]) * r[6] +
         (r[2] * r[3] - r[0] * r[5]) * r[7];
}

// Numbers of twice the precision: the unevaluated sum of two doubles, about 32 digits.
//
// Needs fma() to be exact, which the C library gives on every machine, and no contraction by the
// compiler.
#ifndef TACTILE_DD_H_
#define TACTILE_DD_H_

#include <math.h>

typedef struct {
  double hi, lo;
} Dd;


static inline Dd dd_from(double a) {
  Dd res = {a, 0};
  return res;
}


static inline double dd_round(Dd a) {
  return a.hi + a.lo;
}


// a + b, |a| >= |b|
static inline Dd dd_quick_sum(double a, double b) {
  double sum = a + b;
  Dd res = {sum, b - (sum - a)};
  return res;
}


static inline Dd dd_sum(double a, double b) {
  double sum = a + b, back = sum - a;
  Dd res = {sum, (a - (sum - back)) + (b - back)};
  return res;
}


static inline Dd dd_product(double a, double b) {
  double product = a * b;
  Dd res = {product, fma(a, b, -product)};
  return res;
}


static inline Dd dd_neg(Dd a) {
  Dd res = {-a.hi, -a.lo};
  return res;
}


// exact multiple by a power of two
static inline Dd dd_scale(Dd a, double power) {
  Dd res = {a.hi * power, a.lo * power};
  return res;
}


static inline Dd dd_add(Dd a, Dd b) {
  Dd high = dd_sum(a.hi, b.hi), low = dd_sum(a.lo, b.lo);
  high = dd_quick_sum(high.hi, high.lo + low.hi);
  return dd_quick_sum(high.hi, high.lo + low.lo);
}


static inline Dd dd_sub(Dd a, Dd b) {
  return dd_add(a, dd_neg(b));
}


static inline Dd dd_mul(Dd a, Dd b) {
  Dd res = dd_product(a.hi, b.hi);
  return dd_quick_sum(res.hi, res.lo + (a.hi * b.lo + a.lo * b.hi));
}


static inline Dd dd_div(Dd a, Dd b) {
  double first = a.hi / b.hi;
  Dd rest = dd_sub(a, dd_mul(dd_from(first), b));
  double second = rest.hi / b.hi;
  rest = dd_sub(rest, dd_mul(dd_from(second), b));
  return dd_add(dd_quick_sum(first, second), dd_from(rest.hi / b.hi));
}


// square root of a > 0
static inline Dd dd_sqrt(Dd a) {
  double root = sqrt(a.hi);
  Dd rest = dd_sub(a, dd_product(root, root));
  return dd_quick_sum(root, rest.hi / (2 * root));
}


static inline Dd dd_dot3(const Dd a[3], const Dd b[3]) {
  return dd_add(dd_add(dd_mul(a[0], b[0]), dd_mul(a[1], b[1])), dd_mul(a[2], b[2]));
}


static inline void dd_cross3(Dd res[3], const Dd a[3], const Dd b[3]) {
  res[0] = dd_sub(dd_mul(a[1], b[2]), dd_mul(a[2], b[1]));
  res[1] = dd_sub(dd_mul(a[2], b[0]), dd_mul(a[0], b[2]));
  res[2] = dd_sub(dd_mul(a[0], b[1]), dd_mul(a[1], b[0]));
}

#endif  // TACTILE_DD_H_

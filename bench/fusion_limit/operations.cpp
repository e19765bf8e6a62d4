// How many floating-point operations a fusion takes: the sources of the fusion, run with a number that counts.
// Prints the count of instructions (a multiply-add is one) and of divisions and roots among them, with 1 and 5
// iterations of order 2. Built and run by bench/fusion.py.
#include <cfloat>
#include <cmath>
#include <cstdint>
#include <cstdio>

static long instructions = 0, divisions = 0;

struct Number {
  double value;
  Number() = default;
  Number(double v) : value(v) {}
  explicit operator double() const { return value; }
  double& operator[](int) { return value; }
  double operator[](int) const { return value; }
};

struct Mask {
  bool value;
  bool operator[](int) const { return value; }
};

static Number counted(double value) {
  instructions++;
  return Number(value);
}

static Number operator+(Number a, Number b) { return counted(a.value + b.value); }
static Number operator-(Number a, Number b) { return counted(a.value - b.value); }
static Number operator*(Number a, Number b) { return counted(a.value*b.value); }
static Number operator-(Number a) { return Number(-a.value); }  // folded into the multiply-add
static Number operator/(Number a, Number b) {
  divisions++;
  return counted(a.value/b.value);
}
static Mask compared(bool value) {
  instructions++;
  return Mask{value};
}

static Mask operator>(Number a, Number b) { return compared(a.value > b.value); }
static Mask operator>=(Number a, Number b) { return compared(a.value >= b.value); }
static Mask operator<=(Number a, Number b) { return compared(a.value <= b.value); }
static Mask operator==(Number a, Number b) { return compared(a.value == b.value); }
static Mask operator~(Mask a) { return Mask{!a.value}; }
static Mask operator|(Mask a, Mask b) { return Mask{a.value || b.value}; }
static Mask& operator|=(Mask& a, Mask b) { return a = a | b; }
static int any(Mask mask) { return mask.value; }

static Number FMA(Number a, Number b, Number c) { return counted(std::fma(a.value, b.value, c.value)); }
static Number FNMA(Number a, Number b, Number c) { return counted(std::fma(-a.value, b.value, c.value)); }
static Number SQRT(Number a) {
  divisions++;
  return counted(std::sqrt(a.value));
}

#include "fusion.h"
extern "C" {
#include "se3.h"
}
#include "coefficients.h"

typedef Number V;
typedef Mask M;
#define SPLAT(x) Number(x)
#define UNROLL
#define INLINE static inline
#include "fusion_lanes.h"


// the counts of a fusion with so many iterations
static void count(int iterations) {
  PosePair first, second, y, mean, relative;
  SidePair side[2];
  FactorPair factor;
  V full[36], packed[21], root[6], step[6], lower[21], cov[21], square = Number(0);
  M bad = {false};
  set_identity(&first);
  set_identity(&second);
  set_identity(&y);
  second.pos[0] = Number(1e-3);
  instructions = divisions = 0;
  check_pose(&first, &bad);
  check_pose(&second, &bad);
  for (int k = 0; k < 2; k++) {
    for (int i = 0; i < 36; i++) {
      full[i] = Number(i % 7 == 0 ? 1.0 + k : 0.1);
    }
    symmetric_part(packed, full, &bad);
    factorize(&factor, packed, &bad);
    set_roots(root, &factor);
    set_whitening(side + k, &factor, root);
  }
  set_relative(&relative, &first, &second);
  for (int i = 0; i < iterations; i++) {
    V information[2][21], gradient[2][6], xi[6], e, de;
    PosePair difference[2] = {y};
    product(difference + 1, &y, &relative);
    for (int k = 0; k < 2; k++) {
      logarithm(xi, &e, &de, difference + k);
      contribution(information[k], gradient[k], xi, e, de, side + k, JACOBIAN_ORDER_2);
    }
    for (int k = 0; k < 21; k++) {
      information[0][k] = information[0][k] + information[1][k];
    }
    for (int k = 0; k < 6; k++) {
      gradient[0][k] = gradient[0][k] + gradient[1][k];
    }
    factorize(&factor, information[0], &bad);
    square = gauss_newton(step, gradient[0], &factor);
    perturb(&y, step);
  }
  product(&mean, &y, &first);
  orthonormalize(mean.rot);
  set_roots(root, &factor);
  inverse_factor(lower, &factor, root);
  square_lower(cov, lower);
  square = SQRT(square);
  std::printf("instructions_%d %ld\ndivisions_%d %ld\n", iterations, instructions, iterations, divisions);
}


int main() {
  count(1);
  count(5);
  return 0;
}

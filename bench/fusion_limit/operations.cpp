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
static int operator>(Number a, Number b) { return (int)(counted(0), a.value > b.value); }
static int operator<=(Number a, Number b) { return (int)(counted(0), a.value <= b.value); }
static int operator==(Number a, Number b) { return (int)(counted(0), a.value == b.value); }

static Number FMA(Number a, Number b, Number c) { return counted(std::fma(a.value, b.value, c.value)); }
static Number FNMA(Number a, Number b, Number c) { return counted(std::fma(-a.value, b.value, c.value)); }
static Number MIN(Number a, Number b) { return counted(a.value < b.value ? a.value : b.value); }
static Number SQRT(Number a) {
  divisions++;
  return counted(std::sqrt(a.value));
}

#include "fusion.h"
extern "C" {
#include "se3.h"
}
#include "coefficients.h"

#define V Number
#define M int
#define LANES 1
#define NAME(name) name##_counted
#define LANE(v, lane) (*(double*)(&(v) + (lane)))
#define NOT(mask) (!(mask))
#define SPLAT(x) Number(x)
#define UNROLL
#define INLINE static inline
static int any_counted(int mask) { return mask; }
#include "fusion_lanes.h"


// the counts of a fusion with so many iterations
static void count(int iterations) {
  Pose_counted first, second, y, mean;
  Pose_counted relative;
  Side_counted side[2];
  Factor_counted factor;
  V full[36], packed[21], root[6], step[6], lower[21], cov[21], square = Number(0);
  M bad = 0;
  set_identity_counted(&first);
  set_identity_counted(&second);
  set_identity_counted(&y);
  second.pos[0] = Number(1e-3);
  instructions = divisions = 0;
  check_pose_counted(&first, &bad);
  check_pose_counted(&second, &bad);
  for (int k = 0; k < 2; k++) {
    for (int i = 0; i < 36; i++) {
      full[i] = Number(i % 7 == 0 ? 1.0 + k : 0.1);
    }
    symmetric_part_counted(packed, full, &bad);
    factorize_counted(&factor, packed, &bad);
    set_roots_counted(root, &factor);
    set_whitening_counted(side + k, &factor, root);
  }
  set_relative_counted(&relative, &first, &second);
  for (int i = 0; i < iterations; i++) {
    V information[2][21], gradient[2][6], xi[6], e, de;
    Pose_counted difference[2] = {y};
    product_counted(difference + 1, &y, &relative);
    for (int k = 0; k < 2; k++) {
      log_counted(xi, &e, &de, difference + k);
      contribution_counted(information[k], gradient[k], xi, e, de, side + k, JACOBIAN_ORDER_2);
    }
    for (int k = 0; k < 21; k++) {
      information[0][k] = information[0][k] + information[1][k];
    }
    for (int k = 0; k < 6; k++) {
      gradient[0][k] = gradient[0][k] + gradient[1][k];
    }
    factorize_counted(&factor, information[0], &bad);
    square = gauss_newton_counted(step, gradient[0], &factor);
    perturb_counted(&y, step);
  }
  product_counted(&mean, &y, &first);
  orthonormalize_counted(mean.rot);
  set_roots_counted(root, &factor);
  inverse_factor_counted(lower, &factor, root);
  square_lower_counted(cov, lower);
  square = SQRT(square);
  std::printf("instructions_%d %ld\ndivisions_%d %ld\n", iterations, instructions, iterations, divisions);
}


int main() {
  count(1);
  count(5);
  return 0;
}

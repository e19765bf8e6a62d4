// What this machine can do: nanoseconds a multiply-add instruction, many of them independent; and
// of one fusion without Python. Prints `name value` lines. Built and run by bench/fusion.py.
#define _POSIX_C_SOURCE 199309L
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "routines.h"

#define CHAINS 12
#define ROUNDS 2000
#define TRIES 400


static double now(void) {
  struct timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return 1e9 * (double)t.tv_sec + (double)t.tv_nsec;
}


// best of many short runs, nanoseconds an instruction
#define MEASURE_PEAK(name, type, target, operation)                          \
  target static double name(void) {                                          \
    double best = 1e9;                                                       \
    for (int i = 0; i < TRIES; i++) {                                        \
      type x[CHAINS], a = (type){0} + 1.0000001, b = (type){0} + 1e-9;       \
      for (int k = 0; k < CHAINS; k++) { x[k] = (type){0} + 1.0 / (k + 1); } \
      double start = now();                                                  \
      for (int n = 0; n < ROUNDS; n++) {                                     \
        _Pragma("GCC unroll 12") for (int k = 0; k < CHAINS; k++) {          \
          operation;                                                         \
          __asm__ volatile("" : "+" REGISTER(x[k]));                         \
        }                                                                    \
      }                                                                      \
      double time = (now() - start) / (ROUNDS * CHAINS);                     \
      best = time < best ? time : best;                                      \
    }                                                                        \
    return best;                                                             \
  }

#ifdef __x86_64__
#define REGISTER(x) "x"(x)
MEASURE_PEAK(peak_1, double, __attribute__((target("avx2,fma"))), x[k] = __builtin_fma(x[k], a, b))
#else
#define REGISTER(x) "w"(x)
MEASURE_PEAK(peak_1, double, , x[k] = __builtin_fma(x[k], a, b))
#endif


// two estimates of one contact: standard deviations in m and rad, means a few of them apart
static double time_fusion(const Routines* routines, int iterations, int order) {
  static const double mean_1[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
  static const double mean_2[16] = {1,
                                    0,
                                    0,
                                    1e-3,
                                    0,
                                    0.99995000041666526,
                                    -0.0099998333341666645,
                                    -5e-4,
                                    0,
                                    0.0099998333341666645,
                                    0.99995000041666526,
                                    3e-4,
                                    0,
                                    0,
                                    0,
                                    1};
  static const double sigma[6] = {5e-4, 5e-4, 2e-4, 8e-3, 8e-3, 2e-2};
  double cov[2][36], best = 1e9;
  for (int i = 0; i < 36; i++) {
    cov[0][i] = sigma[i / 6] * sigma[i % 6] * (i / 6 == i % 6 ? 1 : 0.3);
    cov[1][i] = sigma[i / 6] * sigma[i % 6] * (i / 6 == i % 6 ? 2 : -0.2);
  }
  FusionInput input[2] = {{mean_1, cov[0]}, {mean_2, cov[1]}};
  FusionOutput output;
  for (int i = 0; i < TRIES; i++) {
    double start = now();
    for (int n = 0; n < 200; n++) {
      if (routines->fuse(&output, input, iterations, order)) { exit(1); }
    }
    double time = (now() - start) / 200;
    best = time < best ? time : best;
  }
  return best;
}


int main(void) {
  const Routines* routines = &routines_base;
#ifdef __x86_64__
  __builtin_cpu_init();
  if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) {
    routines = &routines_avx2;
  }
#endif
  printf("peak_1 %.5f\n", peak_1());
  printf("fusion_paper %.2f\n", time_fusion(routines, 5, JACOBIAN_ORDER_2));
  printf("fusion_fast %.2f\n", time_fusion(routines, 3, JACOBIAN_EXACT));
  printf("fusion_exact %.2f\n", time_fusion(routines, 100, TO_CONVERGENCE));
  return 0;
}

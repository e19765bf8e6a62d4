// The functions of se3_exact.h, built once for each instruction set; all of them give the same
// bits.
#ifndef TACTILE_SE3_ROUTINES_H_
#define TACTILE_SE3_ROUTINES_H_

typedef struct {
  const char* name;  // of the instruction set
  void (*exp)(double res[16], const double xi[6]);
  int (*log)(double res[6], const double mat[16]);
  void (*adjoint)(double res[36], const double mat[16]);
  void (*left_jacobian)(double res[36], const double xi[6]);
  void (*inverse_left_jacobian)(double res[36], const double xi[6]);
} Se3Routines;

extern const Se3Routines se3_routines_base;
#ifdef __x86_64__
extern const Se3Routines se3_routines_avx2;
#endif

#endif  // TACTILE_SE3_ROUTINES_H_

// Included by routines_*.c, which define ROUTINES and ROUTINES_NAME.
#include "routines.h"

#include "se3_exact.h"

const Routines ROUTINES = {
  .name = ROUTINES_NAME,
  .exp = se3_exact_exp,
  .log = se3_exact_log,
  .adjoint = se3_exact_adjoint,
  .left_jacobian = se3_exact_left_jacobian,
  .inverse_left_jacobian = se3_exact_inverse_left_jacobian,
};

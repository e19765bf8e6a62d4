// Included by se3_routines*.c, which define ROUTINES and ROUTINES_NAME, and set the target.
#include <float.h>
#include <math.h>
#include <string.h>

#include "se3_exact.h"
#include "se3_routines.h"


const Se3Routines ROUTINES = {
    .name = ROUTINES_NAME,
    .exp = se3_exact_exp,
    .log = se3_exact_log,
    .adjoint = se3_exact_adjoint,
    .left_jacobian = se3_exact_left_jacobian,
    .inverse_left_jacobian = se3_exact_inverse_left_jacobian,
};

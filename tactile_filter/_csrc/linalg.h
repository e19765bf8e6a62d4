// Small dense linear algebra of size 6, row-major, no heap.
#ifndef TACTILE_LINALG_H_
#define TACTILE_LINALG_H_

// lower factor of symmetric positive definite mat = res * res', the upper half of res is zero;
// returns 0 if a pivot is not above rounding, that is, mat is not positive definite
int chol6(double res[36], const double mat[36]);

// lower factor of symmetric positive definite mat = res' * res; returns 0 as chol6
int reverse_chol6(double res[36], const double mat[36]);

// res = inverse of lower triangular mat
void invert_lower6(double res[36], const double mat[36]);

// solve mat * res = vec, mat lower triangular; res may be vec
void solve_lower6(double res[6], const double mat[36], const double vec[6]);

// solve mat' * res = vec, mat lower triangular; res may be vec
void solve_lower_transposed6(double res[6], const double mat[36], const double vec[6]);

// res = mat * mat', mat lower triangular; exactly symmetric
void square_lower6(double res[36], const double mat[36]);

#endif  // TACTILE_LINALG_H_

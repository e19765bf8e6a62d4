// Dense linear algebra of size 6, row-major, no heap: triangular factors from the last row up.
//
// mat = unit' * diag(pivot) * unit with unit lower triangular. Counted from the last row, so that the inverse has
// the lower factor unit^-1 * diag(pivot)^-1/2.
#ifndef TACTILE_LINALG_H_
#define TACTILE_LINALG_H_

typedef struct {
  double unit[36];    // strictly lower half; the rest is not set
  double inverse[6];  // of the pivots
} Factor6;

// factorize a symmetric matrix of which the lower half is read; returns 0 if a pivot is not above rounding or not
// finite, that is, if mat is not positive definite
int factorize6(Factor6* res, const double mat[36]);

// vec = unit^-T vec
void solve_transposed6(double vec[6], const Factor6* factor);

// vec = unit^-1 vec
void solve6(double vec[6], const Factor6* factor);

// lower factor of the inverse: mat^-1 = res * res'
void inverse_factor6(double res[36], const Factor6* factor);

// res = mat * mat', mat lower triangular; exactly symmetric
void square_lower6(double res[36], const double mat[36]);

#endif  // TACTILE_LINALG_H_

#include "linalg.h"

#include <float.h>
#include <math.h>

// a pivot below this fraction of its diagonal element is rounding
#define MIN_PIVOT (4 * DBL_EPSILON)

// in loops over three elements the compiler's vectors cost more than they bring: a fifth of the time
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC optimize("no-tree-vectorize", "no-tree-slp-vectorize")
#endif


int factorize6(Factor6* res, const double mat[36]) {
  double left[36];
  for (int i = 0; i < 6; i++) {
    for (int j = 0; j <= i; j++) {
      left[6*i+j] = mat[6*i+j];
    }
  }

  // eliminate row i from those above it
  for (int i = 5; i >= 0; i--) {
    double pivot = left[7*i];
    if (!(pivot > MIN_PIVOT * mat[7*i]) || !(pivot <= DBL_MAX)) {
      return 0;
    }
    double inverse = 1 / pivot;
    res->inverse[i] = inverse;
    for (int j = 0; j < i; j++) {
      double scaled = left[6*i+j] * inverse;
      res->unit[6*i+j] = scaled;
      for (int k = j; k < i; k++) {
        left[6*k+j] -= left[6*i+k] * scaled;
      }
    }
  }
  return 1;
}


void solve_transposed6(double vec[6], const Factor6* factor) {
  for (int i = 5; i > 0; i--) {
    for (int j = 0; j < i; j++) {
      vec[j] -= factor->unit[6*i+j] * vec[i];
    }
  }
}


void solve6(double vec[6], const Factor6* factor) {
  for (int j = 0; j < 5; j++) {
    for (int i = j + 1; i < 6; i++) {
      vec[i] -= factor->unit[6*i+j] * vec[j];
    }
  }
}


void inverse_factor6(double res[36], const Factor6* factor) {
  double scale[6];
  for (int i = 0; i < 6; i++) {
    scale[i] = sqrt(factor->inverse[i]);
  }

  // column j of unit^-1, scaled
  for (int j = 0; j < 6; j++) {
    double column[6] = {0};
    column[j] = scale[j];
    for (int k = j; k < 5; k++) {
      for (int i = k + 1; i < 6; i++) {
        column[i] -= factor->unit[6*i+k] * column[k];
      }
    }
    for (int i = 0; i < 6; i++) {
      res[6*i+j] = column[i];
    }
  }
}


void square_lower6(double res[36], const double mat[36]) {
  for (int i = 0; i < 6; i++) {
    for (int j = 0; j <= i; j++) {
      double sum = 0;
      for (int k = 0; k <= j; k++) {
        sum += mat[6*i+k] * mat[6*j+k];
      }
      res[6*i+j] = res[6*j+i] = sum;
    }
  }
}

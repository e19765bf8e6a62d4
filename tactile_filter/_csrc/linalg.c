#include "linalg.h"

#include <float.h>
#include <math.h>

// a pivot below this fraction of its diagonal element is rounding
#define MIN_PIVOT (4 * DBL_EPSILON)


int chol6(double res[36], const double mat[36]) {
  for (int i = 0; i < 6; i++) {
    // row i left of the diagonal
    double pivot = mat[7*i];
    for (int j = 0; j < i; j++) {
      double sum = mat[6*i+j];
      for (int k = 0; k < j; k++) {
        sum -= res[6*i+k] * res[6*j+k];
      }
      res[6*i+j] = sum / res[7*j];
      pivot -= res[6*i+j] * res[6*i+j];
    }

    // not greater also where pivot is not a number
    if (!(pivot > MIN_PIVOT * mat[7*i])) {
      return 0;
    }
    res[7*i] = sqrt(pivot);
    for (int j = i + 1; j < 6; j++) {
      res[6*i+j] = 0;
    }
  }
  return 1;
}


int reverse_chol6(double res[36], const double mat[36]) {
  for (int i = 5; i >= 0; i--) {
    // column i below the diagonal
    double pivot = mat[7*i];
    for (int j = 5; j > i; j--) {
      double sum = mat[6*j+i];
      for (int k = 5; k > j; k--) {
        sum -= res[6*k+i] * res[6*k+j];
      }
      res[6*j+i] = sum / res[7*j];
      pivot -= res[6*j+i] * res[6*j+i];
    }
    if (!(pivot > MIN_PIVOT * mat[7*i])) {
      return 0;
    }
    res[7*i] = sqrt(pivot);
    for (int j = i + 1; j < 6; j++) {
      res[6*i+j] = 0;
    }
  }
  return 1;
}


void invert_lower6(double res[36], const double mat[36]) {
  for (int i = 0; i < 6; i++) {
    double inv = 1 / mat[7*i];
    for (int j = 0; j < 6; j++) {
      double sum = 0;
      for (int k = j; k < i; k++) {
        sum -= mat[6*i+k] * res[6*k+j];
      }
      res[6*i+j] = j < i ? sum * inv : (j == i ? inv : 0);
    }
  }
}


void solve_lower6(double res[6], const double mat[36], const double vec[6]) {
  for (int i = 0; i < 6; i++) {
    double sum = vec[i];
    for (int k = 0; k < i; k++) {
      sum -= mat[6*i+k] * res[k];
    }
    res[i] = sum / mat[7*i];
  }
}


void solve_lower_transposed6(double res[6], const double mat[36], const double vec[6]) {
  for (int i = 5; i >= 0; i--) {
    double sum = vec[i];
    for (int k = i + 1; k < 6; k++) {
      sum -= mat[6*k+i] * res[k];
    }
    res[i] = sum / mat[7*i];
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

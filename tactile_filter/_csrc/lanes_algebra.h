// Poses, polynomials and triangular factors, two of each side by side in the lanes of a vector.
//
// Packed lower triangles hold 00, 10, 11, 20, ...

typedef struct {
  V rot[9], pos[3];
} PosePair;

// mat = unit' * diag(pivot) * unit with unit lower triangular of which the strictly lower part is
// held
typedef struct {
  V unit[15], inverse[6];  // of pivot
} FactorPair;


// polynomial of even degree, even and odd powers apart
INLINE V polynomial(const double* coef, int degree, V x) {
  V square = x * x, res = SPLAT(coef[degree]), odd = SPLAT(coef[degree - 1]);
  UNROLL
  for (int i = degree - 2; i >= 0; i -= 2) {
    res = FMA(res, square, SPLAT(coef[i]));
    odd = i > 0 ? FMA(odd, square, SPLAT(coef[i - 1])) : odd;
  }
  return FMA(odd, x, res);
}


INLINE V dot3(const V a[3], const V b[3]) {
  return FMA(a[2], b[2], FMA(a[1], b[1], a[0] * b[0]));
}


// res = a * b
INLINE void product(PosePair* res, const PosePair* a, const PosePair* b) {
  UNROLL
  for (int i = 0; i < 3; i++) {
    const V* row = a->rot + 3 * i;
    for (int j = 0; j < 3; j++) {
      res->rot[3 * i + j] =
          FMA(row[2], b->rot[6 + j], FMA(row[1], b->rot[3 + j], row[0] * b->rot[j]));
    }
    res->pos[i] = FMA(row[2], b->pos[2], FMA(row[1], b->pos[1], FMA(row[0], b->pos[0], a->pos[i])));
  }
}


// replace the rotation by the nearest one, which is near
INLINE void orthonormalize(V rot[9]) {
  V excess[9], factor[9], res[9];
  UNROLL
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j <= i; j++) {
      V sum = FMA(rot[6 + i], rot[6 + j], FMA(rot[3 + i], rot[3 + j], rot[i] * rot[j]));
      excess[3 * i + j] = excess[3 * j + i] = i == j ? sum - SPLAT(1) : sum;
    }
  }

  // rot * (I + excess)^(-1/2); the next term of the series is below rounding
  UNROLL
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) {
      V square = FMA(excess[3 * i + 2], excess[6 + j],
                     FMA(excess[3 * i + 1], excess[3 + j], excess[3 * i] * excess[j]));
      factor[3 * i + j] = FMA(SPLAT(-0.375), square, SPLAT(0.5) * excess[3 * i + j]);
    }
  }
  UNROLL
  for (int i = 0; i < 3; i++) {
    const V* row = rot + 3 * i;
    for (int j = 0; j < 3; j++) {
      res[3 * i + j] =
          row[j] - FMA(row[2], factor[6 + j], FMA(row[1], factor[3 + j], row[0] * factor[j]));
    }
  }
  UNROLL
  for (int i = 0; i < 9; i++) { rot[i] = res[i]; }
}


// factorize a packed matrix from the last row up; `poor` gets the lanes whose pivots are not well
// above rounding
INLINE void factorize(FactorPair* res, const V packed[21], M* poor) {
  V left[21];
  UNROLL
  for (int i = 0; i < 21; i++) { left[i] = packed[i]; }
  UNROLL
  for (int i = 5; i >= 0; i--) {
    V *row = left + i * (i + 1) / 2, inverse = SPLAT(1) / row[i];
    res->inverse[i] = inverse;
    for (int j = 0; j < i; j++) {
      V scaled = row[j] * inverse;
      res->unit[i * (i - 1) / 2 + j] = scaled;
      for (int k = j; k < i; k++) {
        left[k * (k + 1) / 2 + j] = FNMA(row[k], scaled, left[k * (k + 1) / 2 + j]);
      }
    }
  }

  V trace = SPLAT(0);
  UNROLL
  for (int i = 5; i >= 0; i--) {
    int ii = i * (i + 1) / 2 + i;
    trace = trace + packed[ii];
    *poor |= ~(FNMA(SPLAT(POOR_PIVOT), packed[ii], left[ii]) > SPLAT(0));
  }
  *poor |= ~(trace <= SPLAT(DBL_MAX));
}


// vec = unit^-T vec
INLINE void solve_transposed(V vec[6], const FactorPair* factor) {
  UNROLL
  for (int i = 5; i > 0; i--) {
    for (int j = 0; j < i; j++) {
      vec[j] = FNMA(factor->unit[i * (i - 1) / 2 + j], vec[i], vec[j]);
    }
  }
}


// vec = unit^-1 vec
INLINE void solve(V vec[6], const FactorPair* factor) {
  UNROLL
  for (int j = 0; j < 5; j++) {
    for (int i = j + 1; i < 6; i++) {
      vec[i] = FNMA(factor->unit[i * (i - 1) / 2 + j], vec[j], vec[i]);
    }
  }
}


// what inverse_factor needs: apart from it, as roots take time in which there is something else to
// do
INLINE void set_roots(V root[6], const FactorPair* factor) {
  UNROLL
  for (int i = 5; i >= 0; i--) { root[i] = SQRT(factor->inverse[i]); }
}


// packed lower factor of the inverse: mat^-1 = res * res'
INLINE void inverse_factor(V res[21], const FactorPair* factor, const V root[6]) {
  UNROLL
  for (int j = 0; j < 6; j++) {
    V column[6];
    column[j] = root[j];
    for (int i = j + 1; i < 6; i++) {
      column[i] = FNMA(factor->unit[i * (i - 1) / 2 + j], column[j], SPLAT(0));
    }
    for (int k = j + 1; k < 5; k++) {
      for (int i = k + 1; i < 6; i++) {
        column[i] = FNMA(factor->unit[i * (i - 1) / 2 + k], column[k], column[i]);
      }
    }
    for (int i = j; i < 6; i++) { res[i * (i + 1) / 2 + j] = column[i]; }
  }
}


// res = mat * mat', both packed, mat lower triangular
INLINE void square_lower(V res[21], const V mat[21]) {
  UNROLL
  for (int i = 0; i < 6; i++) {
    for (int j = 0; j <= i; j++) {
      V sum = mat[i * (i + 1) / 2] * mat[j * (j + 1) / 2];
      for (int k = 1; k <= j; k++) {
        sum = FMA(mat[i * (i + 1) / 2 + k], mat[j * (j + 1) / 2 + k], sum);
      }
      res[i * (i + 1) / 2 + j] = sum;
    }
  }
}

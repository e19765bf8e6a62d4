// Many fusions side by side, LANES of them at a time: a template as fusion_lanes.h, which comes first.
//
// Matrices lie one after the other, as NumPy has them; what is computed with lies element by element.


// the matrices of `size` elements from n on, element by element; beyond the end, the last one again
static inline void NAME(load)(V* res, const ELEM* array, int size, int64_t n, int64_t count) {
#if HAS_TRANSPOSE
  if (n + LANES <= count && size >= LANES) {
    // squares of the matrices' elements; the last one may overlap the one before
    for (int i = 0; i < size; i += LANES) {
      int first = i + LANES <= size ? i : size - LANES;
      V square[LANES];
      UNROLL
      for (int lane = 0; lane < LANES; lane++) {
        memcpy(square + lane, array + (n + lane)*size + first, sizeof(V));
      }
      NAME(transpose)(square);
      UNROLL
      for (int lane = 0; lane < LANES; lane++) {
        res[first+lane] = square[lane];
      }
    }
    return;
  }
#endif
  const ELEM* from[LANES];
  for (int lane = 0; lane < LANES; lane++) {
    from[lane] = array + (n + lane < count ? n + lane : count - 1)*size;
  }
  for (int i = 0; i < size; i++) {
    for (int lane = 0; lane < LANES; lane++) {
      LANE(res[i], lane) = from[lane][i];
    }
  }
}


static inline void NAME(store)(ELEM* array, const V* v, int size, int64_t n, int64_t count) {
#if HAS_TRANSPOSE
  if (n + LANES <= count && size >= LANES) {
    for (int i = 0; i < size; i += LANES) {
      int first = i + LANES <= size ? i : size - LANES;
      V square[LANES];
      UNROLL
      for (int lane = 0; lane < LANES; lane++) {
        square[lane] = v[first+lane];
      }
      NAME(transpose)(square);
      UNROLL
      for (int lane = 0; lane < LANES; lane++) {
        memcpy(array + (n + lane)*size + first, square + lane, sizeof(V));
      }
    }
    return;
  }
#endif
  ELEM* to = array + n*size;
  for (int lane = 0; lane < LANES && n + lane < count; lane++) {
    for (int i = 0; i < size; i++) {
      to[i] = LANE(v[i], lane);
    }
    to += size;
  }
}


static inline void NAME(load_pose)(NAME(Pose)* res, M* bad, const ELEM* mean, int64_t n, int64_t count) {
  V mat[16];
  NAME(load)(mat, mean, 16, n, count);
  UNROLL
  for (int i = 0; i < 3; i++) {
    UNROLL
    for (int j = 0; j < 3; j++) {
      res->rot[3*i+j] = mat[4*i+j];
    }
    res->pos[i] = mat[4*i+3];
  }
  *bad |= NOT(mat[12] == SPLAT(0)) | NOT(mat[13] == SPLAT(0)) | NOT(mat[14] == SPLAT(0))
          | NOT(mat[15] == SPLAT(1));
  NAME(check_pose)(res, bad);
}


static inline void NAME(load_side)(NAME(Side)* side, M* bad, const ELEM* cov, int64_t n, int64_t count) {
  V full[36], packed[21];
  NAME(load)(full, cov, 36, n, count);
  NAME(symmetric_part)(packed, full, bad);
  NAME(set_whitening)(side, packed, bad);
}


static void NAME(store_output)(const FusionBatch* batch, const NAME(Pose)* mean, const V factor[21],
                               const V cov[21], V step, int64_t n) {
  V mat[16], full_cov[36], full_factor[36];
  UNROLL
  for (int i = 0; i < 3; i++) {
    UNROLL
    for (int j = 0; j < 3; j++) {
      mat[4*i+j] = mean->rot[3*i+j];
    }
    mat[4*i+3] = mean->pos[i];
    mat[12+i] = SPLAT(0);
  }
  mat[15] = SPLAT(1);
  UNROLL
  for (int i = 0; i < 6; i++) {
    UNROLL
    for (int j = 0; j <= i; j++) {
      full_cov[6*i+j] = full_cov[6*j+i] = cov[i*(i+1)/2+j];
      full_factor[6*j+i] = SPLAT(0);
      full_factor[6*i+j] = factor[i*(i+1)/2+j];
    }
  }
  NAME(store)(batch->mean, mat, 16, n, batch->count);
  NAME(store)(batch->cov, full_cov, 36, n, batch->count);
  NAME(store)(batch->factor, full_factor, 36, n, batch->count);
  NAME(store)(batch->step, &step, 1, n, batch->count);
}


// fusion n by itself, for what the lanes do not take; returns 0 or a fault
static __attribute__((noinline, cold)) int NAME(fuse_alone)(const FusionBatch* batch, int64_t n) {
  double mean[2][16], cov[2][36];
  FusionOutput output;
  for (int k = 0; k < 2; k++) {
    for (int i = 0; i < 36; i++) {
      mean[k][i % 16] = ((const ELEM*)batch->input_mean[k])[16*n + i % 16];
      cov[k][i] = ((const ELEM*)batch->input_cov[k])[36*n + i];
    }
  }
  for (int i = 0; ELEM_BYTES == 4 && i < 72; i++) {
    // symmetric to the precision of floats is symmetric
    double *matrix = cov[i/36], *a = matrix + i % 36, *b = matrix + 6*(i % 6) + i % 36/6;
    if (fabs(*a - *b) <= ASYMMETRY*sqrt(matrix[7*(i % 6)]*matrix[7*(i % 36/6)])) {
      *a = *b = 0.5*(*a + *b);
    }
  }
  FusionInput input[2] = {{mean[0], cov[0]}, {mean[1], cov[1]}};
  int fault = 0;
  if (batch->order == TO_CONVERGENCE) {
    fault = fuse_exactly(&output, input, batch->iterations);
  } else if (ELEM_BYTES == 8 || !pair_fixed(&output, input, batch->iterations, batch->order)) {
    fault = robust_fixed(&output, input, batch->iterations, batch->order);
  }
  if (fault) {
    return fault;
  }
  for (int i = 0; i < 36; i++) {
    ((ELEM*)batch->cov)[36*n + i] = (ELEM)output.cov[i];
    ((ELEM*)batch->factor)[36*n + i] = (ELEM)output.factor[i];
    ((ELEM*)batch->mean)[16*n + i % 16] = (ELEM)output.mean[i % 16];
  }
  ((ELEM*)batch->step)[n] = (ELEM)output.step;
  batch->status[n] = output.status;
  return 0;
}


// the fusions from n on; `bad` gets the lanes that have to be done alone
static void NAME(fuse_lanes)(const FusionBatch* batch, int64_t n, M* bad) {
  int64_t count = batch->count;
  NAME(Pose) first, second, y, mean;
  NAME(Side) side[2];
  NAME(Factor) factor;
  V step[6], square;
  NAME(load_pose)(&first, bad, batch->input_mean[0], n, count);
  NAME(load_pose)(&second, bad, batch->input_mean[1], n, count);
  NAME(load_side)(side, bad, batch->input_cov[0], n, count);
  NAME(load_side)(side + 1, bad, batch->input_cov[1], n, count);
  NAME(set_identity)(&side[0].relative);
  NAME(set_relative)(&side[1].relative, &first, &second);
  NAME(set_identity)(&y);
  int done = 0;
  do {
    V information[2][21], gradient[2][6];
    for (int k = 0; k < 2; k++) {
      NAME(contribution)(information[k], gradient[k], &y, side + k, batch->order);
    }
    UNROLL
    for (int j = 0; j < 21; j++) {
      information[0][j] = information[0][j] + information[1][j];
    }
    UNROLL
    for (int j = 0; j < 6; j++) {
      gradient[0][j] = gradient[0][j] + gradient[1][j];
    }
    NAME(factorize)(&factor, information[0], bad);
    square = NAME(gauss_newton)(step, gradient[0], &factor);
    *bad |= NOT(square <= SPLAT(LARGEST));
    NAME(perturb)(&y, step);
  } while (++done < batch->iterations);

  V lower[21], cov[21];
  NAME(product)(&mean, &y, &first);
  NAME(orthonormalize)(mean.rot);
  NAME(inverse_factor)(lower, &factor);
  NAME(square_lower)(cov, lower);
  V length = SQRT(square);
  NAME(store_output)(batch, &mean, lower, cov, length, n);
  for (int lane = 0; lane < LANES && n + lane < count; lane++) {
    batch->status[n+lane] = LANE(length, lane) <= CONVERGED_STEP ? FUSION_CONVERGED : FUSION_NOT_CONVERGED;
  }
}


// returns 0 or the fault of the fusion *at
static int NAME(fuse_batch)(const FusionBatch* batch, int64_t* at) {
  for (int64_t n = 0; n < batch->count; n += LANES) {
    M bad = {0};
    if (batch->order == TO_CONVERGENCE) {
      bad = NOT(bad);
    } else {
      NAME(fuse_lanes)(batch, n, &bad);
    }
    if (NAME(any)(bad)) {
      for (int lane = 0; lane < LANES && n + lane < batch->count; lane++) {
        if (LANE(bad, lane)) {
          int fault = NAME(fuse_alone)(batch, n + lane);
          if (fault) {
            *at = n + lane;
            return fault;
          }
        }
      }
    }
  }
  return 0;
}

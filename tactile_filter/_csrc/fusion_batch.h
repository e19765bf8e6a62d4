// Many fusions side by side, LANES of them at a time: a template as fusion_lanes.h, which comes first.
//
// Matrices lie one after the other, as NumPy has them; what is computed with lies element by element.


// LANES fusions under way
typedef struct {
  NAME(Pose) base, y;    // mean of the first input, and its motion
  NAME(Pose) relative;   // Z of the second
  NAME(Side) side[2];
  V information[21];
  NAME(Factor) factor;   // of it
  V step[6], square;     // first the gradient
  M bad;                 // lanes that have to be done alone
} NAME(Group);


// matrices of `size` elements, one after the other, element by element
INLINE void NAME(load)(V* res, const ELEM* array, int size) {
  UNROLL
  for (int i = 0; i < size; i += BLOCK) {
    UNROLL
    for (int j = 0; j < BLOCK; j++) {
      res[i+j] = NAME(load_blocks)(array + j*size + i, BLOCK*size);
    }
    NAME(transpose_blocks)(res + i);
  }
}


// the other way; the blocks of 64 bytes of a matrix, which mostly are one line of the cache, together
INLINE void NAME(store)(ELEM* array, const V* v, int size) {
  UNROLL
  for (int i = 0; i < size; i += 4*BLOCK) {
    int count = size - i < 4*BLOCK ? size - i : 4*BLOCK;
    V block[4*BLOCK];
    UNROLL
    for (int j = 0; j < count; j++) {
      block[j] = v[i+j];
    }
    UNROLL
    for (int j = 0; j < count; j += BLOCK) {
      NAME(transpose_blocks)(block + j);
    }
    UNROLL
    for (int row = 0; row < LANES; row++) {
      UNROLL
      for (int j = 0; j < count; j += BLOCK) {
        NAME(store_block)(array + row*size + i + j, block[j+row%BLOCK], row/BLOCK);
      }
    }
  }
}


INLINE void NAME(load_pose)(NAME(Pose)* res, M* bad, const ELEM* mean) {
  V mat[16];
  NAME(load)(mat, mean, 16);
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


INLINE void NAME(load_covariance)(V packed[21], M* bad, const ELEM* cov) {
  V full[36];
  NAME(load)(full, cov, 36);
  NAME(symmetric_part)(packed, full, bad);
}


// what can be computed meanwhile lies between the divisions and roots and what waits for them
INLINE void NAME(load_group)(NAME(Group)* group, const FusionBatch* batch, int64_t n) {
  NAME(Pose) second;
  NAME(Factor) factor[2];
  V packed[2][21], root[2][6];
  group->bad = (M){0};
  NAME(load_covariance)(packed[0], &group->bad, (const ELEM*)batch->input_cov[0] + 36*n);
  NAME(factorize)(factor, packed[0], &group->bad);
  NAME(set_roots)(root[0], factor);
  NAME(load_covariance)(packed[1], &group->bad, (const ELEM*)batch->input_cov[1] + 36*n);
  NAME(set_whitening)(group->side, factor, root[0]);
  NAME(load_pose)(&group->base, &group->bad, (const ELEM*)batch->input_mean[0] + 16*n);
  NAME(factorize)(factor + 1, packed[1], &group->bad);
  NAME(set_roots)(root[1], factor + 1);
  NAME(load_pose)(&second, &group->bad, (const ELEM*)batch->input_mean[1] + 16*n);
  NAME(set_relative)(&group->relative, &group->base, &second);
  NAME(set_identity)(&group->y);
  NAME(set_whitening)(group->side + 1, factor + 1, root[1]);
}


INLINE void NAME(store_group)(const FusionBatch* batch, const NAME(Group)* group, int64_t n) {
  NAME(Pose) mean;
  V mat[16], full[36], lower[21], cov[21], root[6];
  NAME(set_roots)(root, &group->factor);
  V length = SQRT(group->square);
  NAME(product)(&mean, &group->y, &group->base);
  NAME(orthonormalize)(mean.rot);
  UNROLL
  for (int i = 0; i < 3; i++) {
    UNROLL
    for (int j = 0; j < 3; j++) {
      mat[4*i+j] = mean.rot[3*i+j];
    }
    mat[4*i+3] = mean.pos[i];
    mat[12+i] = SPLAT(0);
  }
  mat[15] = SPLAT(1);
  NAME(store)((ELEM*)batch->mean + 16*n, mat, 16);

  memcpy((ELEM*)batch->step + n, &length, sizeof(V));
  for (int lane = 0; lane < LANES; lane++) {
    batch->status[n+lane] = LANE(length, lane) <= CONVERGED_STEP ? FUSION_CONVERGED : FUSION_NOT_CONVERGED;
  }

  NAME(inverse_factor)(lower, &group->factor, root);
  UNROLL
  for (int i = 0; i < 6; i++) {
    UNROLL
    for (int j = 0; j < 6; j++) {
      full[6*i+j] = j <= i ? lower[i*(i+1)/2+j] : SPLAT(0);
    }
  }
  NAME(store)((ELEM*)batch->factor + 36*n, full, 36);
  NAME(square_lower)(cov, lower);
  UNROLL
  for (int i = 0; i < 6; i++) {
    UNROLL
    for (int j = 0; j <= i; j++) {
      full[6*i+j] = full[6*j+i] = cov[i*(i+1)/2+j];
    }
  }
  NAME(store)((ELEM*)batch->cov + 36*n, full, 36);
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


// information and gradient of both inputs
INLINE void NAME(linearize)(NAME(Group)* group, int order) {
  NAME(Pose) difference[2] = {group->y};
  V xi[2][6], e[2], de[2];
  NAME(product)(difference + 1, &group->y, &group->relative);
  NAME(log_all)(xi, e, de, difference, 2);
  UNROLL
  for (int k = 0; k < 2; k++) {
    NAME(contribution)(group->information, group->step, xi[k], e[k], de[k], group->side + k, order, k);
  }
}


// steps from information and gradient
INLINE void NAME(solve_groups)(NAME(Group)* group, int groups) {
  NAME(Factor) factor[MOST], *factors[MOST];
  const V* matrices[MOST];
  M* bad[MOST];
  UNROLL
  for (int g = 0; g < groups; g++) {
    factors[g] = factor + g;
    matrices[g] = group[g].information;
    bad[g] = &group[g].bad;
  }
  NAME(factorize_all)(factors, matrices, bad, groups);
  UNROLL
  for (int g = 0; g < groups; g++) {
    V step[6];
    group[g].square = NAME(gauss_newton)(step, group[g].step, factor + g);
    group[g].bad |= NOT(group[g].square <= SPLAT(LARGEST));
    group[g].factor = factor[g];
    UNROLL
    for (int i = 0; i < 6; i++) {
      group[g].step[i] = step[i];
    }
  }
}


// fusions n to n + groups*LANES; the groups tell which lanes have to be done alone
static void NAME(fuse_groups)(NAME(Group)* group, int groups, const FusionBatch* batch, int64_t n) {
  for (int g = 0; g < groups; g++) {
    NAME(load_group)(group + g, batch, n + g*LANES);
  }
  int done = 0;
  do {
    for (int g = 0; g < groups; g++) {
      NAME(linearize)(group + g, batch->order);
    }
    if (groups == MOST) {
      NAME(solve_groups)(group, MOST);
    } else {
      NAME(solve_groups)(group, 1);
    }
    for (int g = 0; g < groups; g++) {
      NAME(perturb)(&group[g].y, group[g].step);
    }
  } while (++done < batch->iterations);
  for (int g = 0; g < groups; g++) {
    NAME(store_group)(batch, group + g, n + g*LANES);
  }
}


// fewer than LANES fusions from n on: filled up with the last one
static __attribute__((noinline)) void NAME(fuse_rest)(NAME(Group)* group, const FusionBatch* batch, int64_t n) {
  ELEM mean[3][16*LANES], cov[4][36*LANES], step[LANES];
  int status[LANES];
  size_t count = (size_t)(batch->count - n);
  for (int lane = 0; lane < LANES; lane++) {
    int64_t from = n + lane < batch->count ? n + lane : batch->count - 1;
    for (int k = 0; k < 2; k++) {
      memcpy(mean[k] + 16*lane, (const ELEM*)batch->input_mean[k] + 16*from, 16*sizeof(ELEM));
      memcpy(cov[k] + 36*lane, (const ELEM*)batch->input_cov[k] + 36*from, 36*sizeof(ELEM));
    }
  }
  FusionBatch filled = {
    LANES, batch->iterations, batch->order, {mean[0], mean[1]}, {cov[0], cov[1]},
    mean[2], cov[2], cov[3], step, status};
  NAME(fuse_groups)(group, 1, &filled, 0);
  memcpy((ELEM*)batch->mean + 16*n, mean[2], 16*count*sizeof(ELEM));
  memcpy((ELEM*)batch->cov + 36*n, cov[2], 36*count*sizeof(ELEM));
  memcpy((ELEM*)batch->factor + 36*n, cov[3], 36*count*sizeof(ELEM));
  memcpy((ELEM*)batch->step + n, step, count*sizeof(ELEM));
  memcpy(batch->status + n, status, count*sizeof(int));
}


// returns 0 or the fault of the fusion *at
static int NAME(fuse_batch)(const FusionBatch* batch, int64_t* at) {
  NAME(Group) group[MOST];
  int64_t taken;
  for (int64_t n = 0; n < batch->count; n += taken) {
    int64_t full = (batch->count - n)/LANES;
    int groups = full < MOST ? (int)full : MOST;
    taken = groups ? groups*LANES : batch->count - n;
    if (batch->order == TO_CONVERGENCE) {
      for (int g = 0; g < MOST; g++) {
        group[g].bad = NOT((M){0});
      }
    } else if (groups) {
      NAME(fuse_groups)(group, groups, batch, n);
    } else {
      NAME(fuse_rest)(group, batch, n);
    }
    for (int64_t i = 0; i < taken; i++) {
      if (i % LANES == 0 && !NAME(any)(group[i/LANES].bad)) {
        i += LANES - 1;
      } else if (LANE(group[i/LANES].bad, i % LANES)) {
        int fault = NAME(fuse_alone)(batch, n + i);
        if (fault) {
          *at = n + i;
          return fault;
        }
      }
    }
  }
  return 0;
}

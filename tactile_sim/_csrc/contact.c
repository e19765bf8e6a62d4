// Frictional contact of the skin by projected block Gauss-Seidel on its compliance.
//
// Every contact node carries a force f (3) and a residual r (3): along the normal the gap, in the
// tangent plane the offset from the anchor where the node sticks. Displacement is linear in the
// forces, so a change df at node i adds C[:, i] df to all residuals; the three rows of a node are
// contiguous and C is symmetric.

#include "contact.h"
#include "vec3.h"

#include <math.h>
#include <string.h>

#if defined(__x86_64__) && defined(__GLIBC__) && defined(__GNUC__) && !defined(__clang__)
#define CLONES __attribute__((target_clones("avx2", "default")))
#else
#define CLONES
#endif


// y += a x0 + b x1 + c x2
CLONES static void add_rows(float* restrict y, const float* restrict x0, const float* restrict x1,
                            const float* restrict x2, float a, float b, float c, int n) {
  for (int k = 0; k < n; k++) { y[k] += a * x0[k] + b * x1[k] + c * x2[k]; }
}


static void mul3(double res[3], const double mat[9], const double vec[3]) {
  for (int i = 0; i < 3; i++) { res[i] = dot3(mat + 3 * i, vec); }
}


// inverse of a symmetric positive definite 3x3 by cofactors
static void inverse3(double res[9], const double m[9]) {
  res[0] = m[4] * m[8] - m[5] * m[7];
  res[1] = m[2] * m[7] - m[1] * m[8];
  res[2] = m[1] * m[5] - m[2] * m[4];
  res[3] = m[5] * m[6] - m[3] * m[8];
  res[4] = m[0] * m[8] - m[2] * m[6];
  res[5] = m[2] * m[3] - m[0] * m[5];
  res[6] = m[3] * m[7] - m[4] * m[6];
  res[7] = m[1] * m[6] - m[0] * m[7];
  res[8] = m[0] * m[4] - m[1] * m[3];
  double det = m[0] * res[0] + m[1] * res[3] + m[2] * res[6];
  for (int i = 0; i < 9; i++) { res[i] /= det; }
}


// force of one node that meets its own contact law while all others are held; returns its state
static int local_force(double force[3], const double old[3], const double r[3],
                       const double normal[3], const double block[9], const double inverse[9],
                       double friction) {
  // stick: the force that takes the whole residual away
  double step[3];
  mul3(step, inverse, r);
  for (int k = 0; k < 3; k++) { force[k] = old[k] - step[k]; }
  double press = dot3(normal, force), tangent[3];
  for (int k = 0; k < 3; k++) { tangent[k] = force[k] - press * normal[k]; }
  double shear = sqrt(dot3(tangent, tangent));
  if (press > 0 && shear <= friction * press) { return CONTACT_STICK; }

  // slip: on the cone, in the direction of the sticking force, with the gap closed
  double ray[3], response[3], pulled[3];
  for (int k = 0; k < 3; k++) {
    ray[k] = normal[k] + (shear > 0 ? friction * tangent[k] / shear : 0);
  }
  mul3(response, block, ray);
  mul3(pulled, block, old);
  double closing = dot3(normal, pulled) - dot3(normal, r);
  double gain = dot3(normal, response);
  if (closing <= 0) {
    memset(force, 0, 3 * sizeof(double));
    return CONTACT_FREE;
  }
  // a steep cone can make the gap grow with the force: fall back to the frictionless response
  if (gain <= 0) {
    mul3(response, block, normal);
    gain = dot3(normal, response);
  }
  for (int k = 0; k < 3; k++) { force[k] = ray[k] * closing / gain; }
  return CONTACT_SLIP;
}


// submatrix of the nodes in contact, packed
static void gather(float* packed, const float* compliance, int dof, const int32_t* active, int m) {
  for (int i = 0; i < m; i++) {
    for (int a = 0; a < 3; a++) {
      const float* row = compliance + (size_t)(3 * active[i] + a) * dof;
      float* out = packed + (size_t)(3 * i + a) * 3 * m;
      for (int j = 0; j < m; j++) { memcpy(out + 3 * j, row + 3 * active[j], 3 * sizeof(float)); }
    }
  }
}


int contact_solve(double* force, uint8_t* state, float* residual, const double* normal,
                  const float* compliance, int dof, const int32_t* active, int m, double friction,
                  int max_sweeps, double tolerance, float* packed, double* blocks) {
  gather(packed, compliance, dof, active, m);
  for (int i = 0; i < m; i++) {
    double* block = blocks + 18 * i;
    for (int a = 0; a < 9; a++) {
      block[a] = packed[(size_t)(3 * i + a / 3) * 3 * m + 3 * i + a % 3];
    }
    inverse3(block + 9, block);
  }

  int sweep = 0;
  while (sweep < max_sweeps) {
    double moved = 0;
    for (int i = 0; i < m; i++) {
      double next[3], change[3], shift[3], r[3];
      double* old = force + 3 * i;
      const double* block = blocks + 18 * i;
      for (int k = 0; k < 3; k++) { r[k] = residual[3 * i + k]; }
      state[i] = (uint8_t)local_force(next, old, r, normal + 3 * i, block, block + 9, friction);
      for (int k = 0; k < 3; k++) { change[k] = next[k] - old[k]; }
      if (change[0] == 0 && change[1] == 0 && change[2] == 0) { continue; }

      // residuals follow, and the largest own displacement decides when to stop
      const float* row = packed + (size_t)3 * i * 3 * m;
      add_rows(residual, row, row + 3 * m, row + 6 * m, (float)change[0], (float)change[1],
               (float)change[2], 3 * m);
      memcpy(old, next, sizeof(next));
      mul3(shift, block, change);
      moved = fmax(moved, dot3(shift, shift));
    }
    sweep++;
    if (moved < tolerance * tolerance) { break; }
  }
  return sweep;
}


void contact_displacement(float* displacement, const double* force, const float* compliance,
                          int dof, const int32_t* active, int m) {
  memset(displacement, 0, dof * sizeof(float));
  for (int i = 0; i < m; i++) {
    const double* f = force + 3 * i;
    const float* row = compliance + (size_t)3 * active[i] * dof;
    if (f[0] == 0 && f[1] == 0 && f[2] == 0) { continue; }
    add_rows(displacement, row, row + dof, row + 2 * dof, (float)f[0], (float)f[1], (float)f[2],
             dof);
  }
}

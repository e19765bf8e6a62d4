#include "limit_surface.h"

#include <math.h>
#include <string.h>

#define NEWTON_STEPS 60
#define CONVERGED 1e-12
#define SWEEPS 30
#define UNHELD 1e-9  // of the stiffest direction: no spring


static double inside_edge(const double edge[5], const double point[2]) {
  return edge[2] * point[0] + edge[3] * point[1] - edge[4];
}


double foot_inside(int* edge, const Foot* foot, const double point[2]) {
  double least = HUGE_VAL;
  *edge = 0;
  for (int i = 0; i < foot->count; i++) {
    double inside = inside_edge(foot->edges + 5 * i, point);
    if (inside < least) {
      least = inside;
      *edge = i;
    }
  }
  return least;
}


double foot_edge_share(const Foot* foot, const double center[2]) {
  const double *middle = foot->center, *m = foot->spread;
  double ahead[2] = {center[0] - middle[0], center[1] - middle[1]};
  double det = m[0] * m[3] - m[1] * m[2];
  double slope[2] = {(m[3] * ahead[0] - m[1] * ahead[1]) / det,
                     (m[0] * ahead[1] - m[2] * ahead[0]) / det};
  double over = -HUGE_VAL, there = -HUGE_VAL;
  for (int i = 0; i < foot->count; i++) {
    const double* edge = foot->edges + 5 * i;
    over = fmax(over, -((edge[0] - middle[0]) * slope[0] + (edge[1] - middle[1]) * slope[1]));
    there = fmax(there, 1 - inside_edge(edge, center) / inside_edge(edge, middle));
  }
  if (over <= 1) { return 0; }
  return there >= 1 ? 1 : (over - 1) / (over / there - 1);
}


// Eigenvalues and eigenvectors (columns) of a symmetric matrix, which is lost: Jacobi's rotations.
static void eigen3(double value[3], double vector[9], double a[9]) {
  for (int i = 0; i < 9; i++) { vector[i] = i % 4 == 0; }
  for (int sweep = 0; sweep < SWEEPS; sweep++) {
    int turned = 0;
    for (int k = 0; k < 3; k++) {
      int p = k == 2 ? 1 : 0, q = k == 0 ? 1 : 2;
      double off = a[3 * p + q];
      if (fabs(off) <= 1e-18 * sqrt(fabs(a[4 * p]) * fabs(a[4 * q])) || off == 0) { continue; }
      turned = 1;
      double theta = (a[4 * q] - a[4 * p]) / (2 * off);
      double t = (theta < 0 ? -1 : 1) / (fabs(theta) + sqrt(theta * theta + 1));
      double c = 1 / sqrt(t * t + 1), s = t * c;
      int r = 3 - p - q;
      double rp = a[3 * r + p], rq = a[3 * r + q];
      a[4 * p] -= t * off;
      a[4 * q] += t * off;
      a[3 * p + q] = a[3 * q + p] = 0;
      a[3 * r + p] = a[3 * p + r] = c * rp - s * rq;
      a[3 * r + q] = a[3 * q + r] = s * rp + c * rq;
      for (int i = 0; i < 3; i++) {
        double vp = vector[3 * i + p], vq = vector[3 * i + q];
        vector[3 * i + p] = c * vp - s * vq;
        vector[3 * i + q] = s * vp + c * vq;
      }
    }
    if (!turned) { break; }
  }
  for (int i = 0; i < 3; i++) { value[i] = a[4 * i]; }
}


// The x > 0 at which sum(squares / (1 + x softness)^2) = 1, by Newton's method; negative where
// there is none.
static double multiplier(const double squares[3], const double softness[3], double largest) {
  double unheld = 0, x = 0;
  for (int i = 0; i < 3; i++) {
    if (softness[i] <= UNHELD * largest) { unheld += squares[i]; }
  }
  if (unheld >= 1) { return -1; }
  for (int step = 0; step < NEWTON_STEPS; step++) {
    double total = 0, slope = 0;
    for (int i = 0; i < 3; i++) {
      double grown = 1 + x * softness[i], part = squares[i] / (grown * grown);
      total += part;
      slope += 2 * part * softness[i] / grown;
    }
    // in 1 / sqrt(sum) the root is nearly a line: converges in a few steps from any start
    double change = 2 * total * (sqrt(total) - 1) / slope;
    x += change;
    if (fabs(total - 1) < CONVERGED || fabs(change) < CONVERGED * x) { break; }
  }
  return x;
}


int limit_surface_return(double motion[3], double left[3], const double load[3],
                         const double stiffness[9], double force, double torque) {
  double scale[3] = {1 / force, 1 / force, 1 / torque}, used[3], scaled[9], softness[3], axes[9];
  memset(motion, 0, 3 * sizeof(double));
  memcpy(left, load, 3 * sizeof(double));
  for (int i = 0; i < 3; i++) { used[i] = scale[i] * load[i]; }
  if (used[0] * used[0] + used[1] * used[1] + used[2] * used[2] <= 1) { return 1; }

  for (int i = 0; i < 9; i++) { scaled[i] = scale[i / 3] * stiffness[i] * scale[i % 3]; }
  eigen3(softness, axes, scaled);
  double part[3], squares[3], held[3], largest = 0;
  for (int i = 0; i < 3; i++) {
    part[i] = axes[i] * used[0] + axes[3 + i] * used[1] + axes[6 + i] * used[2];
    squares[i] = part[i] * part[i];
    held[i] = fmax(softness[i], 0);
    largest = fmax(largest, fabs(softness[i]));
  }
  double x = multiplier(squares, held, largest);
  if (x < 0) { return 0; }
  for (int i = 0; i < 3; i++) { part[i] /= 1 + x * softness[i]; }
  for (int i = 0; i < 3; i++) {
    double rest = axes[3 * i] * part[0] + axes[3 * i + 1] * part[1] + axes[3 * i + 2] * part[2];
    motion[i] = x * scale[i] * rest;
    left[i] = rest / scale[i];
  }
  return 1;
}

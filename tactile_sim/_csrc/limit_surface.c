#include "limit_surface.h"

#include <math.h>
#include <string.h>

#include "vec3.h"

#define NEWTON_STEPS 60
#define CONVERGED 1e-12
#define UNHELD 1e12  // over the stiffest spring's: a motion as large is held by none


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


int solve_linear(double* x, double* a, double* b, int n) {
  for (int k = 0; k < n; k++) {
    int top = k;
    for (int i = k + 1; i < n; i++) {
      if (fabs(a[n * i + k]) > fabs(a[n * top + k])) { top = i; }
    }
    if (a[n * top + k] == 0) { return 0; }
    for (int j = 0; j < n; j++) {
      double moved = a[n * k + j];
      a[n * k + j] = a[n * top + j];
      a[n * top + j] = moved;
    }
    double moved = b[k];
    b[k] = b[top];
    b[top] = moved;
    for (int i = k + 1; i < n; i++) {
      double part = a[n * i + k] / a[n * k + k];
      for (int j = k; j < n; j++) { a[n * i + j] -= part * a[n * k + j]; }
      b[i] -= part * b[k];
    }
  }
  for (int k = n - 1; k >= 0; k--) {
    double rest = b[k];
    for (int j = k + 1; j < n; j++) { rest -= a[n * k + j] * x[j]; }
    x[k] = rest / a[n * k + k];
  }
  return 1;
}


// (1 + x A)^-1 b
static int relaxed(double res[3], const double a[9], double x, const double b[3]) {
  double grown[9], rest[3] = {b[0], b[1], b[2]};
  for (int i = 0; i < 9; i++) { grown[i] = (i % 4 == 0) + x * a[i]; }
  return solve_linear(res, grown, rest, 3);
}


int relax_onto(double* x, double u[3], const double b[3], const double a[9], const double m[9]) {
  double softness[9], slope[3], pulled[3], normal[3], stiffest = 0;
  *x = 0;
  for (int i = 0; i < 9; i++) {
    const double *row = a + i / 3 * 3, *column = m + i % 3;
    softness[i] = row[0] * column[0] + row[1] * column[3] + row[2] * column[6];
    stiffest = fmax(stiffest, fabs(softness[i]));
  }
  for (int step = 0;; step++) {
    if (!relaxed(u, softness, *x, b)) { return 0; }
    for (int i = 0; i < 3; i++) {
      pulled[i] = dot3(softness + 3 * i, u);
      normal[i] = dot3(m + 3 * i, u);
    }
    double square = dot3(u, normal);
    if (fabs(square - 1) < CONVERGED) { return 1; }
    if (step == NEWTON_STEPS || !relaxed(slope, softness, *x, pulled)) { return 0; }
    double falls = dot3(normal, slope);
    if (falls <= 0) { return 0; }
    *x += square * (sqrt(square) - 1) / falls;  // in 1 / sqrt(square) it is nearly a line
    if (*x < 0 || *x * stiffest > UNHELD) { return 0; }
  }
}


int limit_surface_return(double motion[3], double left[3], const double load[3],
                         const double stiffness[9], double force, double torque) {
  static const double round[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1};
  double scale[3] = {1 / force, 1 / force, 1 / torque}, b[3], a[9], u[3], x;
  memset(motion, 0, 3 * sizeof(double));
  memcpy(left, load, 3 * sizeof(double));
  for (int i = 0; i < 3; i++) { b[i] = scale[i] * load[i]; }
  if (dot3(b, b) <= 1) { return 1; }
  for (int i = 0; i < 9; i++) { a[i] = scale[i / 3] * stiffness[i] * scale[i % 3]; }
  if (!relax_onto(&x, u, b, a, round)) { return 0; }
  for (int i = 0; i < 3; i++) {
    motion[i] = x * scale[i] * u[i];
    left[i] = u[i] / scale[i];
  }
  return 1;
}

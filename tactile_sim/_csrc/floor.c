#include "floor.h"

#include <math.h>
#include <string.h>

#include "limit_surface.h"
#include "vec3.h"

#define NEWTON_STEPS 60
#define HALVINGS 12
#define ROUNDS 30  // of a polynomial, and Newton's steps in each
#define QUICK 6
#define CONVERGED 1e-10  // of the friction
#define STILL 1e-8       // m: the motion below which a point of support is taken to stay
#define SMOOTH 1e-4      // m: where Coulomb's corner at rest begins to be approached


// Part of the load on each point: that of a pressure which is linear over them, around its centre.
static void shares_of(double* share, const Floor* floor) {
  const double* p = floor->model.numbers;
  int n = floor->model.count;
  double middle[2] = {0}, m[3] = {0}, total = 0;
  for (int i = 0; i < n; i++) {
    for (int k = 0; k < 2; k++) { middle[k] += p[2 * i + k] / n; }
  }
  for (int i = 0; i < n; i++) {
    double x = p[2 * i] - middle[0], y = p[2 * i + 1] - middle[1];
    m[0] += x * x;
    m[1] += x * y;
    m[2] += y * y;
  }
  double off[2] = {floor->center[0] - middle[0], floor->center[1] - middle[1]};
  double det = m[0] * m[2] - m[1] * m[1];
  double slope[2] = {(m[2] * off[0] - m[1] * off[1]) / det, (m[0] * off[1] - m[1] * off[0]) / det};
  for (int i = 0; i < n; i++) {
    double part =
        1.0 / n + (p[2 * i] - middle[0]) * slope[0] + (p[2 * i + 1] - middle[1]) * slope[1];
    share[i] = fmax(part, 0);
    total += share[i];
  }
  for (int i = 0; i < n; i++) { share[i] /= total; }
}


// Load (gradient) and its change (hessian) of points that slide by p, each smooth at rest.
static void slide(double load[3], double hessian[9], double* fastest, const double p[3],
                  const double* share, const Floor* floor, double smooth) {
  memset(load, 0, 3 * sizeof(double));
  memset(hessian, 0, 9 * sizeof(double));
  *fastest = 0;
  for (int i = 0; i < floor->model.count; i++) {
    double x = (floor->model.numbers[2 * i] - floor->center[0]) / floor->model.length;
    double y = (floor->model.numbers[2 * i + 1] - floor->center[1]) / floor->model.length;
    double vx = p[0] - p[2] * y, vy = p[1] + p[2] * x, square = vx * vx + vy * vy;
    double speed = sqrt(square + smooth * smooth), part = share[i] / speed;
    double cube = part / (speed * speed);
    double xx = part - cube * vx * vx, xy = -cube * vx * vy, yy = part - cube * vy * vy;
    *fastest = fmax(*fastest, sqrt(square));
    load[0] += part * vx;
    load[1] += part * vy;
    load[2] += part * (x * vy - y * vx);
    double by_x = x * xy - y * xx, by_y = x * yy - y * xy;
    double more[9] = {xx, xy, by_x, xy, yy, by_y, by_x, by_y, x * by_y - y * by_x};
    for (int k = 0; k < 9; k++) { hessian[k] += more[k]; }
  }
}


// What of a load the springs still carry and points of support do not, after motion p.
static double points_off(double off[3], double slope[9], double* fastest, const double p[3],
                         const double b[3], const double a[9], const double* share,
                         const Floor* floor, double smooth) {
  double load[3];
  slide(load, slope, fastest, p, share, floor, smooth);
  for (int i = 0; i < 3; i++) { off[i] = b[i] - dot3(a + 3 * i, p) - load[i]; }
  for (int i = 0; i < 9; i++) { slope[i] += a[i]; }
  return dot3(off, off);
}


// Newton's method on Coulomb's law at the points, rounded where they rest, less and less.
static int points_return(double p[3], const double b[3], const double a[9], const Floor* floor) {
  double share[MOST_POINTS], off[3], next[3], change[3], slope[9], fastest;
  shares_of(share, floor);
  memset(p, 0, 3 * sizeof(double));
  for (double at = SMOOTH; at > 0.5 * STILL; at *= 0.1) {
    double smooth = at * floor->force;
    double square = points_off(off, slope, &fastest, p, b, a, share, floor, smooth);
    for (int step = 0; square > CONVERGED * CONVERGED; step++) {
      if (step == NEWTON_STEPS || !solve_linear(change, slope, off, 3)) { return 0; }
      double part = 1, reached = HUGE_VAL;
      for (int half = 0; half < HALVINGS && !(reached < square); half++, part *= 0.5) {
        for (int i = 0; i < 3; i++) { next[i] = p[i] + part * change[i]; }
        reached = points_off(off, slope, &fastest, next, b, a, share, floor, smooth);
      }
      // at the limit of rounding nothing falls any more
      if (!(reached < square)) { return sqrt(square) < 1e3 * CONVERGED * (1 + sqrt(dot3(b, b))); }
      square = reached;
      memcpy(p, next, sizeof(next));
    }
  }
  if (fastest < 10 * STILL * floor->force) { memset(p, 0, 3 * sizeof(double)); }
  return 1;
}


// H = u M u, with M (u); its gradient is 4 M u. And its hessian, unless that is NULL.
static double polynomial(double m[9], double* hessian, const double u[3], const FloorModel* model) {
  double value = 0;
  memset(m, 0, 9 * sizeof(double));
  for (int k = 0; k < model->count; k++) {
    const double* a = model->numbers + 9 * k;
    double pulled[3] = {dot3(a, u), dot3(a + 3, u), dot3(a + 6, u)}, square = dot3(pulled, u);
    value += square * square;
    for (int i = 0; i < 9; i++) {
      m[i] += square * a[i];
      if (hessian) { hessian[i] = 8 * pulled[i / 3] * pulled[i % 3] + (k ? hessian[i] : 0); }
    }
  }
  for (int i = 0; hessian && i < 9; i++) { hessian[i] += 4 * m[i]; }
  return value;
}


// What a load u and a motion p = x M u miss of the springs' law and of H = 1.
static double polynomial_off(double off[4], double slope[16], const double u[3], double x,
                             const double b[3], const double a[9], const FloorModel* model) {
  double m[9], hessian[9];
  off[3] = 1 - polynomial(m, hessian, u, model);
  double square = off[3] * off[3], normal[3] = {dot3(m, u), dot3(m + 3, u), dot3(m + 6, u)};
  for (int i = 0; i < 3; i++) {
    double pulled = dot3(a + 3 * i, normal);
    off[i] = b[i] - u[i] - x * pulled;
    square += off[i] * off[i];
    for (int k = 0; k < 3; k++) {
      slope[4 * i + k] = i == k;
      for (int j = 0; j < 3; j++) {
        slope[4 * i + k] += 0.25 * x * a[3 * i + j] * hessian[3 * j + k];
      }
    }
    slope[4 * i + 3] = pulled;
    slope[12 + i] = 4 * normal[i];
  }
  slope[15] = 0;
  return square;
}


// The ellipsoid with M as it is at the last u comes nearer each time; Newton's method ends it.
static int polynomial_return(double p[3], const double b[3], const double a[9],
                             const FloorModel* model) {
  double m[9], off[4], slope[16], change[4], u[3] = {b[0], b[1], b[2]}, x;
  memset(p, 0, 3 * sizeof(double));
  double size = sqrt(sqrt(polynomial(m, NULL, b, model)));
  if (size <= 1) { return 1; }
  for (int i = 0; i < 9; i++) { m[i] /= size * size; }  // of b / size, on the surface
  for (int round = 0; round < ROUNDS; round++) {
    if (!relax_onto(&x, u, b, a, m)) { return 0; }
    double at[4] = {u[0], u[1], u[2], x};
    double square = polynomial_off(off, slope, at, at[3], b, a, model);
    for (int step = 0; step < QUICK && square > CONVERGED * CONVERGED; step++) {
      if (!solve_linear(change, slope, off, 4)) { break; }
      for (int i = 0; i < 4; i++) { at[i] += change[i]; }
      square = polynomial_off(off, slope, at, at[3], b, a, model);
    }
    if (square <= 1e4 * CONVERGED * CONVERGED * dot3(b, b) && at[3] >= 0) {
      polynomial(m, NULL, at, model);
      for (int i = 0; i < 3; i++) { p[i] = at[3] * dot3(m + 3 * i, at); }
      return 1;
    }
    size = sqrt(sqrt(polynomial(m, NULL, u, model)));
    for (int i = 0; i < 9; i++) { m[i] /= size * size; }
  }
  return 0;
}


// of a load or motion, into the body's axes at the start (way = -1) or out of them
static void turn_by(double res[3], double angle, const double v[3]) {
  double c = cos(angle), s = sin(angle), x = v[0], y = v[1];
  res[0] = c * x - s * y;
  res[1] = s * x + c * y;
  res[2] = v[2];
}


int floor_return(double motion[3], double left[3], const double load[3], const double stiffness[9],
                 const Floor* floor) {
  if (floor->model.kind == ELLIPSOID) {
    return limit_surface_return(motion, left, load, stiffness, floor->force, floor->torque);
  }
  double torque = floor->force * floor->model.length, b[3], a[9], column[3], p[3];
  double scale[3] = {1 / floor->force, 1 / floor->force, 1 / torque};
  turn_by(b, -floor->turn, load);
  for (int k = 0; k < 3; k++) {  // columns, then rows
    double axis[3] = {k == 0, k == 1, k == 2};
    turn_by(axis, floor->turn, axis);
    for (int i = 0; i < 3; i++) { column[i] = dot3(stiffness + 3 * i, axis); }
    turn_by(column, -floor->turn, column);
    for (int i = 0; i < 3; i++) { a[3 * i + k] = scale[i] * column[i] * scale[k]; }
  }
  for (int i = 0; i < 3; i++) { b[i] *= scale[i]; }
  if (!(floor->model.kind == POINTS ? points_return(p, b, a, floor)
                                    : polynomial_return(p, b, a, &floor->model))) {
    return 0;
  }
  for (int i = 0; i < 3; i++) { motion[i] = scale[i] * p[i]; }
  turn_by(motion, floor->turn, motion);
  for (int i = 0; i < 3; i++) { left[i] = load[i] - dot3(stiffness + 3 * i, motion); }
  return 1;
}

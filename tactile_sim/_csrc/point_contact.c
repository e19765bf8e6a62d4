#include "point_contact.h"

#include <math.h>
#include <string.h>

#include "se3.h"
#include "vec3.h"

// Of the depth, by which the skin that touches is pressed in on average: the simulated TacTip,
// rolled by up to 20 degrees over a plane at depths of 2 and 4 mm, shears as if it rolled on the
// radius less this part of it.
#define PRESSED 0.42


// of a table over growing x; at its ends beyond them
static double interpolated(double x, const double* at, const double* value, int count) {
  int i = 0;
  while (i < count && at[i] <= x) { i++; }
  if (i == 0 || i == count) { return value[i == 0 ? 0 : count - 1]; }
  return value[i - 1] + (x - at[i - 1]) * (value[i] - value[i - 1]) / (at[i] - at[i - 1]);
}


// from one pose of the sensor to the next, about an axis of any length, in the surface's frame
// (rad)
static double turn_between(const double T0[16], const double T1[16], const double axis[3]) {
  double rot[9], phi[3];
  for (int i = 0; i < 9; i++) { rot[i] = dot3(T1 + i / 3 * 4, T0 + i % 3 * 4); }
  se3_rotation_vector(phi, rot);
  return dot3(phi, axis) / sqrt(dot3(axis, axis));
}


int point_contact_drag(double anchor[3], double* turn, const PointContact* before,
                       const PointContact* now, const ShearLimits* limits) {
  double limit = interpolated(now->depth, limits->depth, limits->shear, limits->count);
  double turn_limit = interpolated(now->depth, limits->depth, limits->turn, limits->count);
  const double *T0 = before->T, *T1 = now->T, *n = now->normal;

  // the way of the tip's matter over the surface: a tip that rolls moves its centre without it
  double matter[3], own[3], offset[3], axis[3];
  for (int i = 0; i < 3; i++) {
    matter[i] = before->point[i] - (1 - PRESSED) * before->depth * before->normal[i];
  }
  for (int i = 0; i < 3; i++) {
    own[i] = T0[i] * (matter[0] - T0[3]) + T0[4 + i] * (matter[1] - T0[7]) +
             T0[8 + i] * (matter[2] - T0[11]);
  }
  for (int i = 0; i < 3; i++) {
    offset[i] = dot3(T1 + 4 * i, own) + T1[4 * i + 3] - matter[i] + before->point[i] - anchor[i];
    axis[i] = -(n[i] + before->normal[i]);
  }
  double along = dot3(offset, n);
  for (int i = 0; i < 3; i++) { offset[i] -= along * n[i]; }
  double length = sqrt(dot3(offset, offset)), turned = *turn + turn_between(T0, T1, axis);
  double kept = length > limit ? limit / length : 1;
  for (int i = 0; i < 3; i++) { anchor[i] = now->point[i] - kept * offset[i]; }
  *turn = fmin(fmax(turned, -turn_limit), turn_limit);
  return length > limit || fabs(turned) > turn_limit;
}


void point_contact_pose(double res[16], const double T_fs[16], double turn, const PointContact* now,
                        const double* anchor) {
  double c = cos(turn), s = sin(turn), way[3], own[3];
  memcpy(res, T_fs, 16 * sizeof(double));
  for (int j = 0; j < 3; j++) {
    res[j] = c * T_fs[j] - s * T_fs[4 + j];
    res[4 + j] = s * T_fs[j] + c * T_fs[4 + j];
  }
  if (!anchor) { return; }
  for (int i = 0; i < 3; i++) { way[i] = now->point[i] - anchor[i]; }
  for (int i = 0; i < 3; i++) {
    own[i] = now->T[i] * way[0] + now->T[4 + i] * way[1] + now->T[8 + i] * way[2];
  }
  res[3] = dot3(res, own);
  res[7] = dot3(res + 4, own);
}


void skin_force(double force[3], const double T[16], const double T_fs[16], double press,
                double stiffness, double friction) {
  double pushed[3] = {stiffness * T_fs[3], stiffness * T_fs[7], press}, own[3];
  double size = sqrt(pushed[0] * pushed[0] + pushed[1] * pushed[1]), limit = friction * press;
  for (int i = 0; size > limit && i < 2; i++) { pushed[i] *= limit / size; }
  for (int i = 0; i < 3; i++) {
    own[i] = T_fs[i] * pushed[0] + T_fs[4 + i] * pushed[1] + T_fs[8 + i] * pushed[2];
  }
  for (int i = 0; i < 3; i++) { force[i] = dot3(T + 4 * i, own); }
}

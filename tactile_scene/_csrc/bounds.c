#include "bounds.h"
#include "vec3.h"

#include <math.h>
#include <string.h>

#define ROUNDING \
  1e-6  // m: further than this beyond a reach, rounding does not decide whether a bound counts
#define ROUNDS \
  4  // a bound that another one has pushed the velocity over is met by going through all again


double braking_distance(const Braking* b, double speed) {
  return speed * (speed / (2 * b->acceleration) + b->lead);
}


double braking_speed(const Braking* b, double distance) {
  double a = b->acceleration, lead = b->lead;
  return a * (sqrt(lead * lead + 2 * fmax(distance, 0) / a) - lead);
}


int shorten(double twist[6], double linear, double angular) {
  int changed = 0;
  for (int part = 0; part < 2; part++) {
    double *v = twist + 3 * part, limit = part ? angular : linear, norm = sqrt(dot3(v, v));
    for (int i = 0; norm > limit && i < 3; i++) { v[i] *= limit / norm; }
    changed |= norm > limit;
  }
  return changed;
}


// bounds of a velocity near to something, in the frame of the rotation of T
typedef struct {
  Bound* bounds;
  int count;
  double reach;  // m: what is further away does not count
  Braking braking;
} Found;


static void add(Found* found, const double direction[3], double sign, double room, int reason) {
  if (room >= found->reach) { return; }
  Bound* bound = found->bounds + found->count++;
  for (int i = 0; i < 3; i++) { bound->direction[i] = sign * direction[i]; }
  bound->speed = room > 0 ? braking_speed(&found->braking, room) : 0;
  bound->reason = reason;
}


// the direction in which a point is nearest to a box, and how far; negative inside of it
static double way_into(double towards[3], const double box[6], const double p[3]) {
  double way[3], least = HUGE_VAL;
  int face = 0;
  for (int i = 0; i < 3; i++) { way[i] = fmin(fmax(p[i], box[i]), box[3 + i]) - p[i]; }
  double distance = sqrt(dot3(way, way));
  for (int i = 0; i < 3; i++) { towards[i] = distance > 0 ? way[i] / distance : 0; }
  if (distance > 0) { return distance; }
  for (int k = 0; k < 6; k++) {
    double depth = k < 3 ? p[k] - box[k] : box[k] - p[k - 3];
    if (depth < least) {
      least = depth;
      face = k;
    }
  }
  towards[face % 3] = face < 3 ? 1 : -1;
  return -least;
}


static void find_space(Found* found, const Room* room, const double* boxes, int count,
                       const double T[16]) {
  double p[3] = {T[3], T[7], T[11]}, towards[3], direction[3];
  for (int axis = 0; axis < 3; axis++) {
    add(found, T + 4 * axis, 1, room->upper[axis] - p[axis], WORKSPACE + 2 * axis);
    add(found, T + 4 * axis, -1, p[axis] - room->lower[axis], WORKSPACE + 2 * axis + 1);
  }
  for (int box = 0; box < count; box++) {
    double distance = way_into(towards, boxes + 6 * box, p);
    for (int i = 0; i < 3; i++) {
      direction[i] = T[i] * towards[0] + T[4 + i] * towards[1] + T[8 + i] * towards[2];
    }
    add(found, direction, 1, distance - room->radius, BOXES + box);
  }
}


// what the sensor's skin bounds: no deeper and sheared no further, as the contact is now
static void find_contact(Found* found, const Room* room, const double T[16], const double F[16]) {
  double X[3][3], at[3], outward[3];  // of the sensor in the feature frame
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) {
      X[i][j] = F[i] * T[j] + F[4 + i] * T[4 + j] + F[8 + i] * T[8 + j];
    }
    at[i] = F[i] * (T[3] - F[3]) + F[4 + i] * (T[7] - F[7]) + F[8 + i] * (T[11] - F[11]);
  }
  add(found, X[2], 1, room->largest_depth - at[2], DEPTH);
  double shear = hypot(at[0], at[1]);
  if (!(shear > 0)) { return; }
  for (int i = 0; i < 3; i++) { outward[i] = (X[0][i] * at[0] + X[1][i] * at[1]) / shear; }
  add(found, outward, 1, room->largest_shear - shear, SHEAR);
}


static int note(int* reasons, int count, int reason) {
  for (int i = 0; i < count; i++) {
    if (reasons[i] == reason) { return count; }
  }
  reasons[count] = reason;
  return count + 1;
}


int bounded(double twist[6], int* reasons, Bound* bounds, const Room* room, const double* boxes,
            int count, const double T[16], const double* T_feature) {
  int said = 0, round;
  if (shorten(twist, room->linear_velocity, room->angular_velocity)) { reasons[said++] = SPEED; }
  Found found = {bounds, 0, 0, {room->acceleration, room->lead}};
  found.reach = braking_distance(&found.braking, sqrt(dot3(twist, twist))) + ROUNDING;
  find_space(&found, room, boxes, count, T);
  if (T_feature) { find_contact(&found, room, T, T_feature); }
  for (round = 0; round < ROUNDS; round++) {
    int any = 0;
    for (Bound* b = bounds; b < bounds + found.count; b++) {
      b->passed = dot3(b->direction, twist) > b->speed * (1 + 1e-9) + 1e-12;
      any |= b->passed;
    }
    if (!any) { break; }
    for (Bound* b = bounds; b < bounds + found.count; b++) {
      if (!b->passed) { continue; }
      double over = fmax(0, dot3(b->direction, twist) - b->speed);
      for (int k = 0; k < 3; k++) { twist[k] -= over * b->direction[k]; }
      said = note(reasons, said, b->reason);
    }
  }
  if (round == ROUNDS) { memset(twist, 0, 3 * sizeof(double)); }
  return said;
}

#include "pushed.h"
#include "vec3.h"

#include <math.h>
#include <string.h>

#define LEAST_LOAD \
  0.05  // part of the weight on the floor: below, it would be carried, which is not modelled
#define NEWTON_STEPS 12
#define BALANCED 1e-5  // of the floor's friction: how far tips and floor may differ after a step
#define STAGES 60      // from a floor that carries all to the one there is


// a point (one = 1) or direction (0) in the frame that T leads to
static void moved_by(double res[3], const double T[16], const double v[3], double one) {
  for (int i = 0; i < 3; i++) {
    res[i] = T[4 * i] * v[0] + T[4 * i + 1] * v[1] + T[4 * i + 2] * v[2] + T[4 * i + 3] * one;
  }
}


static void product(double res[16], const double a[16], const double b[16]) {
  for (int i = 0; i < 16; i++) {
    const double *row = a + i / 4 * 4, *column = b + i % 4;
    res[i] = row[0] * column[0] + row[1] * column[4] + row[2] * column[8] + row[3] * column[12];
  }
}


static void turned(double res[2], double angle, const double v[2]) {
  double c = cos(angle), s = sin(angle), x = v[0], y = v[1];
  res[0] = c * x - s * y;
  res[1] = s * x + c * y;
}


void pushed_tip(Tip* tip, const double T_tool_sensor[16], const double T[16], const double point[3],
                const double normal[3], const double force[3], double along, double across) {
  double way[3] = {point[0] - T[3], point[1] - T[7], point[2] - T[11]};
  memcpy(tip->T_tool_sensor, T_tool_sensor, sizeof(tip->T_tool_sensor));
  memcpy(tip->point, point, sizeof(tip->point));
  memcpy(tip->normal, normal, sizeof(tip->normal));
  memcpy(tip->force, force, sizeof(tip->force));
  for (int i = 0; i < 3; i++) {
    tip->matter[i] = T[i] * way[0] + T[4 + i] * way[1] + T[8 + i] * way[2];
  }
  tip->along = along;
  tip->across = across;
}


// What stretches the skin is the way of the tip's matter at the contact over that of the body: a
// tip that rolls stretches nothing. What friction does not carry slips, along the shear.
static void push(Touch* touch, const Tip* tip, const double T_body[16], const double T_sensor[16],
                 double friction) {
  double f[3], way[3];
  const double* n = touch->normal;
  moved_by(touch->point, T_body, tip->point, 1);
  moved_by(touch->normal, T_body, tip->normal, 0);
  moved_by(f, T_body, tip->force, 0);
  moved_by(touch->matter, T_sensor, tip->matter, 1);
  for (int i = 0; i < 3; i++) { way[i] = touch->matter[i] - touch->point[i]; }
  double more = (tip->along - tip->across) * dot3(way, n);
  for (int i = 0; i < 3; i++) { f[i] += tip->across * way[i] + more * n[i]; }
  double press = -dot3(f, n), shear[3];
  for (int i = 0; i < 3; i++) { shear[i] = f[i] + press * n[i]; }
  double limit = friction * fmax(0, press), size = sqrt(dot3(shear, shear));
  touch->slips = size > limit;
  double left = touch->slips ? limit / size : 1;
  for (int i = 0; i < 3; i++) {
    touch->force[i] = left * shear[i] - fmax(0, press) * n[i];
    touch->shear[i] = touch->slips ? shear[i] / size : 0;
  }
  for (int i = 0; i < 3; i++) { touch->stuck[i] = press > 0 ? f[i] : 0; }
  touch->along = press > 0 ? tip->along : 0;
  touch->across = press > 0 ? tip->across : 0;
  touch->turning = left * touch->across;
}


static void push_all(Touch* touch, const Pushed* body, const Tip* tip,
                     const double* const* T_world_tool, int count) {
  double T_sensor[16];
  for (int i = 0; i < count; i++) {
    product(T_sensor, T_world_tool[i], tip[i].T_tool_sensor);
    push(touch + i, tip + i, body->T, T_sensor, body->friction_tip);
  }
}


// f_x, f_y and the torque about a center; with `sticks` as if no tip slipped
static void load_of(double load[3], const Touch* touch, int count, const double center[2],
                    int sticks) {
  memset(load, 0, 3 * sizeof(double));
  for (int i = 0; i < count; i++) {
    const double *f = sticks ? touch[i].stuck : touch[i].force, *p = touch[i].point;
    load[0] += f[0];
    load[1] += f[1];
    load[2] += (p[0] - center[0]) * f[1] - (p[1] - center[1]) * f[0];
  }
}


// How the force of a tip falls as the body's matter goes along `way` where the tip's is. A tip that
// slips has friction times its press along its shear, so that not all of it is symmetric.
static void falls_along(double res[3], const Touch* touch, const double way[3], double friction,
                        int sticks) {
  const double *n = touch->normal, *t = touch->shear;
  double normal = dot3(way, n), press = touch->along * normal;
  if (sticks || !touch->slips) {
    for (int i = 0; i < 3; i++) {
      res[i] = touch->across * (way[i] - normal * n[i]) + press * n[i];
    }
    return;
  }
  double along = dot3(way, t);
  for (int i = 0; i < 3; i++) {
    double aside = way[i] - normal * n[i] - along * t[i];
    res[i] = touch->turning * aside + press * (n[i] - friction * t[i]);
  }
}


// How fast the load falls as the object moves and turns about a center.
static void stiffness_of(double res[9], const Touch* touch, int count, const double center[2],
                         double friction, int sticks) {
  memset(res, 0, 9 * sizeof(double));
  for (int i = 0; i < count; i++, touch++) {
    const double *f = sticks ? touch->stuck : touch->force, *m = touch->matter;
    double x = touch->point[0] - center[0], y = touch->point[1] - center[1];
    double ways[3][3] = {{1, 0, 0}, {0, 1, 0}, {center[1] - m[1], m[0] - center[0], 0}};
    for (int k = 0; k < 3; k++) {
      double fall[3];
      falls_along(fall, touch, ways[k], friction, sticks);
      res[k] += fall[0] + (k == 2) * f[1];  // as the object turns, the force turns with it
      res[3 + k] += fall[1] - (k == 2) * f[0];
      res[6 + k] += x * fall[1] - y * fall[0];
    }
  }
}


// The object before a step, and the floor's friction on it, about a center in the world.
typedef struct {
  double T[16], upright[16], turn, center[2];
  Floor floor;
} Start;

static Start start_of(const Pushed* body) {
  Start start;
  double at[2];
  memcpy(start.T, body->T, sizeof(start.T));
  memcpy(start.upright, body->upright, sizeof(start.upright));
  start.turn = body->turn;
  start.floor.model = body->floor;
  start.floor.turn = body->turn;
  for (int i = 0; i < 2; i++) {
    start.floor.center[i] = body->pressure[i] + body->center_of_friction[i];
  }
  turned(at, body->turn, start.floor.center);
  for (int i = 0; i < 2; i++) { start.center[i] = body->upright[4 * i + 3] + at[i]; }
  start.floor.force = body->friction * body->load * body->weight;
  start.floor.torque = start.floor.force * body->arm;
  if (body->tilted > 0) {
    start.floor.model.kind = ELLIPSOID;
    start.floor.torque = start.floor.force * body->tilted;
  }
  return start;
}


// Take it to where it is after moving by x, y and turning about the center.
static void go(Pushed* body, const Start* start, const double motion[3]) {
  const double* center = start->center;
  double around[2], c = cos(motion[2]), s = sin(motion[2]);
  turned(around, motion[2], center);
  double T[16] = {c, -s, 0, center[0] + motion[0] - around[0],
                  s, c,  0, center[1] + motion[1] - around[1],
                  0, 0,  1, 0,
                  0, 0,  0, 1};
  body->turn = start->turn + motion[2];
  product(body->upright, T, start->upright);
  product(body->T, T, start->T);
  body->moved = hypot(motion[0], motion[1]) + fabs(motion[2]) * body->arm;
}


// The tips' pushes where the object is after a motion; their load is about the center that moved.
static void push_after(double load[3], double center[2], const double motion[3], const Start* start,
                       Pushed* body, Touch* touch, const Tip* tip,
                       const double* const* T_world_tool, int count) {
  go(body, start, motion);
  push_all(touch, body, tip, T_world_tool, count);
  for (int i = 0; i < 2; i++) { center[i] = start->center[i] + motion[i]; }
  load_of(load, touch, count, center, 0);
}


// Newton's method, from a motion to one after which a floor with `share` times the friction carries
// the pushes that are left: the tips' forces linearized, the floor's law as it is. Where the tips
// that slip would take it along without end, and with `stuck` at first, they are taken to stick.
// Returns 0 where it did not get there.
static int balance(double motion[3], double share, int stuck, const Start* start, Pushed* body,
                   Touch* touch, const Tip* tip, const double* const* T_world_tool, int count) {
  Floor floor = start->floor;
  double load[3], center[2], force = floor.force *= share, torque = floor.torque *= share;
  push_after(load, center, motion, start, body, touch, tip, T_world_tool, count);
  for (int step = 0; step < NEWTON_STEPS; step++) {
    int found = 0;
    double at[3], next[3], left[3], stiffness[9];
    for (int sticks = step == 0 && stuck; sticks < 2 && !found; sticks++) {
      if (sticks) { load_of(load, touch, count, center, 1); }
      stiffness_of(stiffness, touch, count, center, body->friction_tip, sticks);
      for (int i = 0; i < 3; i++) { at[i] = load[i] + dot3(stiffness + 3 * i, motion); }
      found = floor_return(next, left, at, stiffness, &floor);
    }
    if (!found) { return 0; }
    memcpy(motion, next, sizeof(next));
    push_after(load, center, motion, start, body, touch, tip, T_world_tool, count);
    double off[3] = {(load[0] - left[0]) / force, (load[1] - left[1]) / force,
                     (load[2] - left[2]) / torque};
    if (dot3(off, off) < BALANCED * BALANCED) { return 1; }
  }
  return 0;
}


// Where Newton's method does not get there at once, follow the answer from a floor that carries all
// of it down to the one that is there.
static int slide(Pushed* body, Touch* touch, const Tip* tip, const double* const* T_world_tool,
                 int count) {
  Start start = start_of(body);
  double motion[3], load[3], center[2];
  for (int stuck = 0; stuck < 2; stuck++) {
    memset(motion, 0, sizeof(motion));
    if (balance(motion, 1, stuck, &start, body, touch, tip, T_world_tool, count)) { return 1; }
  }
  double still[3] = {0}, step = 0.5;
  push_after(load, center, still, &start, body, touch, tip, T_world_tool, count);
  double share =
      2 * hypot(hypot(load[0], load[1]) / start.floor.force, load[2] / start.floor.torque);
  for (int stage = 0; stage < STAGES; stage++) {
    double next = fmax(1, share * step);
    memcpy(motion, still, sizeof(motion));
    if (balance(motion, next, 0, &start, body, touch, tip, T_world_tool, count)) {
      if (next == 1) { return 1; }
      share = next;
      memcpy(still, motion, sizeof(still));
    } else {
      step = sqrt(step);
    }
  }
  return 0;
}


// Where the floor presses, and how much, from moments about the floor and vertical forces.
static void settle(Pushed* body, const Touch* touch, int count) {
  double middle[3];
  moved_by(middle, body->T, body->center_of_gravity, 1);
  double x = body->weight * middle[0], y = body->weight * middle[1], lifted = 0;
  for (int i = 0; i < count; i++) {
    const double *f = touch[i].force, *p = touch[i].point;
    x += p[2] * f[0] - f[2] * p[0];
    y += p[2] * f[1] - f[2] * p[1];
    lifted += f[2];
  }
  body->load = fmax(1 - lifted / body->weight, LEAST_LOAD);
  double floor = body->load * body->weight;
  double at[2] = {x / floor - body->upright[3], y / floor - body->upright[7]};
  turned(body->pressure, -body->turn, at);
}


int pushed_step(Pushed* body, Touch* touch, const Tip* tip, const double* const* T_world_tool,
                int count) {
  int edge;
  if (!slide(body, touch, tip, T_world_tool, count)) { return 0; }
  settle(body, touch, count);
  body->inside = foot_inside(&edge, &body->foot, body->pressure);
  return 1;
}


void pushed_tilt(Pushed* body, const double edge[4]) {
  if (body->edge_friction > 0) {
    double share = body->tilted > 0 ? 1 : foot_edge_share(&body->foot, body->pressure);
    body->slid = share > 0 ? body->slid + body->moved : 0;
    share = body->slid > body->edge_way ? share : 0;
    body->friction = body->friction_foot + share * (body->edge_friction - body->friction_foot);
  }
  if (body->inside < 0 || body->tilted > 0) {
    double along[2] = {edge[2] - edge[0], edge[3] - edge[1]}, *p = body->pressure;
    double share = ((p[0] - edge[0]) * along[0] + (p[1] - edge[1]) * along[1]) /
                   (along[0] * along[0] + along[1] * along[1]);
    share = fmin(fmax(share, 0), 1);
    for (int i = 0; i < 2; i++) { p[i] = edge[i] + share * along[i]; }
  }
}

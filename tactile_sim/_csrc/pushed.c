#include "pushed.h"
#include "vec3.h"

#include <math.h>
#include <string.h>

#define LEAST_LOAD \
  0.05  // part of the weight on the floor: below, it would be carried, which is not modelled
#define ROUNDS 5    // of return mapping in a step, while a tip slips
#define STILL 1e-7  // m: motion that ends them


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
// tip that rolls stretches nothing.
static void push(Touch* touch, const Tip* tip, const double T_body[16], const double T_sensor[16],
                 double friction) {
  double f[3], way[3];
  const double* n = touch->normal;
  moved_by(touch->point, T_body, tip->point, 1);
  moved_by(touch->normal, T_body, tip->normal, 0);
  moved_by(f, T_body, tip->force, 0);
  moved_by(way, T_sensor, tip->matter, 1);
  for (int i = 0; i < 3; i++) { way[i] -= touch->point[i]; }
  double more = (tip->along - tip->across) * dot3(way, n);
  for (int i = 0; i < 3; i++) { f[i] += tip->across * way[i] + more * n[i]; }
  double press = -dot3(f, n), shear[3];
  for (int i = 0; i < 3; i++) { shear[i] = f[i] + press * n[i]; }
  press = fmax(0, press);
  double limit = friction * press, size = sqrt(dot3(shear, shear));
  double left = size > limit ? limit / size : 1;
  for (int i = 0; i < 3; i++) { touch->force[i] = left * shear[i] - press * n[i]; }
  touch->along = tip->along;
  touch->across = tip->across;
  touch->slips = size > limit;
}


static int push_all(Touch* touch, const Pushed* body, const Tip* tip,
                    const double* const* T_world_tool, int count) {
  int slips = 0;
  double T_sensor[16];
  for (int i = 0; i < count; i++) {
    product(T_sensor, T_world_tool[i], tip[i].T_tool_sensor);
    push(touch + i, tip + i, body->T, T_sensor, body->friction_tip);
    slips |= touch[i].slips;
  }
  return slips;
}


// How fast f_x, f_y and the torque about a centre fall as the object moves and turns there; with
// `sticks` that of tips that slip, too, as if they stuck.
static void planar_stiffness(double res[9], const Touch* touch, int count, const double center[2],
                             int sticks) {
  double a = 0, b = 0, c = 0, d = 0, e = 0, g = 0;
  for (int i = 0; i < count; i++, touch++) {
    double across = sticks || !touch->slips ? touch->across : 0, more = touch->along - across;
    double nx = touch->normal[0], ny = touch->normal[1];
    double xx = across + more * nx * nx, xy = more * nx * ny, yy = across + more * ny * ny;
    double x = touch->point[0] - center[0], y = touch->point[1] - center[1];
    double by_x = x * xy - y * xx, by_y = x * yy - y * xy;
    a += xx;
    b += xy;
    c += yy;
    d += by_x;
    e += by_y;
    g += x * by_y - y * by_x;
  }
  double found[9] = {a, b, d, b, c, e, d, e, g};
  memcpy(res, found, sizeof(found));
}


// Move by dx, dy and turn about a centre.
static double go(Pushed* body, const double motion[3], const double center[2]) {
  double around[2], before[16], c = cos(motion[2]), s = sin(motion[2]);
  turned(around, motion[2], center);
  double T[16] = {c, -s, 0, center[0] + motion[0] - around[0],
                  s, c,  0, center[1] + motion[1] - around[1],
                  0, 0,  1, 0,
                  0, 0,  0, 1};
  body->turn += motion[2];
  memcpy(before, body->upright, sizeof(before));
  product(body->upright, T, before);
  memcpy(before, body->T, sizeof(before));
  product(body->T, T, before);
  return hypot(motion[0], motion[1]) + fabs(motion[2]) * body->arm;
}


// Move until friction carries these pushes; returns how far (m), negative where no motion does.
static double slide(Pushed* body, const Touch* touch, int count) {
  double pressed[2], off[2], load[3] = {0}, stiffness[9], motion[3], left[3];
  turned(pressed, body->turn, body->pressure);
  turned(off, body->turn, body->center_of_friction);
  double center[2] = {body->upright[3] + pressed[0] + off[0],
                      body->upright[7] + pressed[1] + off[1]};
  for (int i = 0; i < count; i++) {
    const double *f = touch[i].force, *p = touch[i].point;
    load[0] += f[0];
    load[1] += f[1];
    load[2] += (p[0] - center[0]) * f[1] - (p[1] - center[1]) * f[0];
  }
  double force = body->friction * body->load * body->weight;
  double torque = force * (body->tilted > 0 ? body->tilted : body->arm);
  if (hypot(hypot(load[0] / force, load[1] / force), load[2] / torque) <= 1) { return 0; }
  planar_stiffness(stiffness, touch, count, center, 0);
  if (!limit_surface_return(motion, left, load, stiffness, force, torque)) {
    // where tips that slip carry it along, it goes until they stick
    planar_stiffness(stiffness, touch, count, center, 1);
    if (!limit_surface_return(motion, left, load, stiffness, force, torque)) { return -1; }
  }
  return go(body, motion, center);
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
  body->moved = 0;
  for (int round = 0; round < ROUNDS; round++) {
    int slips = push_all(touch, body, tip, T_world_tool, count);
    double moved = slide(body, touch, count);
    if (moved < 0) { return 0; }
    body->moved += moved;
    if (moved < STILL || !slips) { break; }
  }
  push_all(touch, body, tip, T_world_tool, count);
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

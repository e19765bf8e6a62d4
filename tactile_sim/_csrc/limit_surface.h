// A foot on a floor: where in it a point lies, and how it moves when its load exceeds friction.
// tactile_sim/limit_surface.py says what all of it means.

#ifndef TACTILE_DRIVERS_SIM_LIMIT_SURFACE_H_
#define TACTILE_DRIVERS_SIM_LIMIT_SURFACE_H_

// A convex polygon, counter-clockwise: of each edge its first corner (x, y), its inward normal (x,
// y) and the normal's product with the corner.
typedef struct {
  int count;
  const double* edges;  // count x 5
  double center[2], spread[4];
} Foot;

// How far a point lies inside the nearest edge, negative outside; *edge is that edge.
double foot_inside(int* edge, const Foot* foot, const double point[2]);

// Part of the load on the edge that a centre of pressure is ahead to.
double foot_edge_share(const Foot* foot, const double center[2]);

// x (n) of A x = b, by elimination with the largest pivot; A and b are lost. Returns 0 where A is
// singular.
int solve_linear(double* x, double* a, double* b, int n);

// The least x > 0 for which the load that springs A leave of b after a motion x M u, which is
// u = (1 + x A M)^-1 b, lies on the ellipsoid u M u = 1. Returns 0 where there is none.
int relax_onto(double* x, double u[3], const double b[3], const double a[9], const double m[9]);

// Motion of a foot on springs until it carries the rest of its load, and that load; returns 0 where
// no position of the foot carries it.
int limit_surface_return(double motion[3], double left[3], const double load[3],
                         const double stiffness[9], double force, double torque);

#endif  // TACTILE_DRIVERS_SIM_LIMIT_SURFACE_H_

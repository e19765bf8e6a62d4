// The friction of a floor on a foot that slides: an ellipsoid, points of support, or a convex
// polynomial. tactile_sim/floor_models.py says what the numbers are.

#ifndef TACTILE_DRIVERS_SIM_FLOOR_H_
#define TACTILE_DRIVERS_SIM_FLOOR_H_

#define MOST_POINTS 400

typedef enum { ELLIPSOID, POINTS, POLYNOMIAL } FloorKind;

// `numbers` are count x 2 of points, from the body's origin along the world's axes at the start, or
// count x 9 of a polynomial; its loads are in units of the friction and, of torques, `length` times
// that.
typedef struct {
  FloorKind kind;
  int count;
  const double* numbers;
  double length;
} FloorModel;

// The floor of a step: the friction in all, N; of an ellipsoid the largest torque, N m; how far the
// body has turned, and where in it the centre of friction lies.
typedef struct {
  FloorModel model;
  double force, torque, turn, center[2];
} Floor;

// As limit_surface_return, about the centre of friction, in the world.
int floor_return(double motion[3], double left[3], const double load[3], const double stiffness[9],
                 const Floor* floor);

#endif  // TACTILE_DRIVERS_SIM_FLOOR_H_

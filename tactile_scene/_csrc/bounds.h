// How much of a twist the safe command stage passes on; tactile_drivers/safety.py says why.

#ifndef TACTILE_DRIVERS_BOUNDS_H_
#define TACTILE_DRIVERS_BOUNDS_H_

// How an arm brakes: the acceleration (m/s^2), and for how long (s) it goes on at its speed before.
typedef struct {
  double acceleration, lead;
} Braking;

double braking_distance(const Braking* braking, double speed);
double braking_speed(const Braking* braking, double distance);

// Both speeds of a twist within limits, directions kept; returns whether that changed it.
int shorten(double twist[6], double linear, double angular);

// Numbers of `Room`, in this order; boxes follow in arrays of lower and upper corners.
typedef struct {
  double linear_velocity, angular_velocity, acceleration, lead;
  double lower[3], upper[3];  // workspace
  double radius, largest_depth, largest_shear;
} Room;

enum { ROOM_NUMBERS = 13 };

// What can bound a velocity: `SPEED`, then each axis's upper and lower end of the workspace, then
// depth, shear and the boxes.
enum { SPEED, WORKSPACE, DEPTH = WORKSPACE + 6, SHEAR, BOXES };

typedef struct {
  double direction[3], speed;
  int reason, passed;
} Bound;

// The part of a twist that is followed where the controlled frame is at T and, unless it is NULL,
// feels a contact whose feature frame is at T_feature. `bounds` is scratch for 8 more than there
// are boxes, `reasons` for 9 more, which it fills with what makes the twist less; returns how many
// these are.
int bounded(double twist[6], int* reasons, Bound* bounds, const Room* room, const double* boxes,
            int count, const double T[16], const double* T_feature);

#endif  // TACTILE_DRIVERS_BOUNDS_H_

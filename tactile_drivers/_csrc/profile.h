// The fastest way of a velocity to another within limits of acceleration and jerk, to end there at no acceleration.

#ifndef TACTILE_DRIVERS_PROFILE_H_
#define TACTILE_DRIVERS_PROFILE_H_

// Go on for `dt` with velocity and acceleration towards a target; the way meanwhile. At the target both are exact.
double profile_advance(double* velocity, double* acceleration, double target, double largest_acceleration,
                       double jerk, double dt);

#endif  // TACTILE_DRIVERS_PROFILE_H_

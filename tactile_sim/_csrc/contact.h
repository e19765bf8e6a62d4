// Frictional contact of the skin, and its displacement under contact forces.

#ifndef TACTILE_DRIVERS_SIM_CONTACT_H_
#define TACTILE_DRIVERS_SIM_CONTACT_H_

#include <stdint.h>

enum { CONTACT_FREE = 0, CONTACT_STICK = 1, CONTACT_SLIP = 2 };

// Sweep over `m` nodes until none moves by more than `tolerance` (m); returns the sweeps done.
//   force      m x 3    N, in and out (warm start)
//   state      m        out
//   residual   m x 3    m, in for the given forces and out for the new ones
//   normal     m x 3    unit, out of the surface
//   compliance dof x dof, m/N, symmetric
//   packed     3m x 3m, blocks m x 18: scratch
int contact_solve(double* force, uint8_t* state, float* residual, const double* normal,
                  const float* compliance, int dof, const int32_t* active, int m, double friction,
                  int max_sweeps, double tolerance, float* packed, double* blocks);

// displacement (dof) of all nodes under the forces of the active ones
void contact_displacement(float* displacement, const double* force, const float* compliance,
                          int dof, const int32_t* active, int m);

#endif  // TACTILE_DRIVERS_SIM_CONTACT_H_

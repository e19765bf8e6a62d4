// The arithmetic of a step of control: six channels, translation first. pid.py and limiter.py say
// what it means.

#ifndef TACTILE_CONTROL_LAWS_H_
#define TACTILE_CONTROL_LAWS_H_

enum { CHANNELS = 6 };

// Rows of a PID's state and of its gains, six numbers each.
enum { INTEGRAL, ERROR, SMOOTH, DERIVATIVE, TRANSFER, STATES };
enum { KP, KI, KD, INTEGRAL_LIMIT, OUTPUT_LIMIT, GAINS };

// Rows of what a step answers.
enum { FEEDBACK, PROPORTIONAL, INTEGRAL_PART, DERIVATIVE_PART, TRANSFER_PART, PARTS };

// What was done to a twist, by bits: the linear part's, and those of the angular part two bits
// further on.
enum { SPEED_LIMITED = 1, ACCELERATION_LIMITED = 2 };

// The law before its limits.
void pid_law(double res[CHANNELS], const double* state, const double* gains);

// A step with the error of `dt` s later; after a gap the derivative starts again.
void pid_step(double* parts, double* state, const double* gains, const double error[CHANNELS],
              double dt, int gap, int integrate, double decay, double transfer_time);

// The twist that is nearest to the wanted one in norm and change of each part; returns what was
// done to it.
int limit_twist(double twist[CHANNELS], const double last[CHANNELS], const double wanted[CHANNELS],
                const double speed[2], const double change[2]);

#endif  // TACTILE_CONTROL_LAWS_H_

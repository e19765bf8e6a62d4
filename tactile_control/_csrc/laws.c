#include "laws.h"

#include <math.h>


static double clip(double value, double limit) {
  return value > limit ? limit : value < -limit ? -limit : value;
}


static double row(const double* rows, int name, int channel) {
  return rows[CHANNELS * name + channel];
}


static double law(const double* state, const double* gains, int i) {
  return row(gains, KP, i) * row(state, ERROR, i) + row(gains, KI, i) * row(state, INTEGRAL, i) +
         row(gains, KD, i) * row(state, DERIVATIVE, i) + row(state, TRANSFER, i);
}


void pid_law(double res[CHANNELS], const double* state, const double* gains) {
  for (int i = 0; i < CHANNELS; i++) { res[i] = law(state, gains, i); }
}


// backward Euler with clipping; a channel whose output is clipped does not integrate outwards
static void grow_integral(double* state, const double* gains, int i, double dt) {
  double before = state[i], output = law(state, gains, i);
  double grown = clip(before + row(state, ERROR, i) * dt, row(gains, INTEGRAL_LIMIT, i));
  int outwards = output > 0 ? grown > before : output < 0 && grown < before;
  if (!(outwards && fabs(output) > row(gains, OUTPUT_LIMIT, i))) { state[i] = grown; }
}


void pid_step(double* parts, double* state, const double* gains, const double error[CHANNELS],
              double dt, int gap, int integrate, double decay, double transfer_time) {
  double fade = transfer_time > 0 ? exp(-dt / transfer_time) : 0;
  for (int i = 0; i < CHANNELS; i++) {
    double *smooth = state + CHANNELS * SMOOTH + i, *derivative = state + CHANNELS * DERIVATIVE + i;
    double before = *smooth;
    *smooth = gap ? error[i] : decay * before + (1 - decay) * error[i];
    *derivative = gap ? 0 : (*smooth - before) / dt;
    state[CHANNELS * TRANSFER + i] *= fade;
    state[CHANNELS * ERROR + i] = error[i];
    if (integrate) { grow_integral(state, gains, i, dt); }
    parts[CHANNELS * FEEDBACK + i] = clip(law(state, gains, i), row(gains, OUTPUT_LIMIT, i));
    parts[CHANNELS * PROPORTIONAL + i] = row(gains, KP, i) * error[i];
    parts[CHANNELS * INTEGRAL_PART + i] = row(gains, KI, i) * row(state, INTEGRAL, i);
    parts[CHANNELS * DERIVATIVE_PART + i] = row(gains, KD, i) * *derivative;
    parts[CHANNELS * TRANSFER_PART + i] = row(state, TRANSFER, i);
  }
}


static double norm(const double v[3]) {
  return sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]);
}


static int limit_part(double res[3], const double last[3], const double wanted[3], double speed,
                      double change) {
  int done = 0;
  double size = norm(wanted), scale = 1, step[3];
  if (size > speed) {
    scale = speed / size;
    done |= SPEED_LIMITED;
  }
  for (int i = 0; i < 3; i++) {
    res[i] = wanted[i] * scale;
    step[i] = res[i] - last[i];
  }
  size = norm(step);
  if (size > change * (1 + 1e-9)) {
    for (int i = 0; i < 3; i++) { res[i] = last[i] + step[i] * (change / size); }
    done |= ACCELERATION_LIMITED;
  }
  return done;
}


int limit_twist(double twist[CHANNELS], const double last[CHANNELS], const double wanted[CHANNELS],
                const double speed[2], const double change[2]) {
  int linear = limit_part(twist, last, wanted, speed[0], change[0]);
  return linear | limit_part(twist + 3, last + 3, wanted + 3, speed[1], change[1]) << 2;
}

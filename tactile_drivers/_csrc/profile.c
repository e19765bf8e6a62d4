#include "profile.h"

#include <math.h>


// a stretch of constant jerk, no longer than what is left of the time
static double stretch(double* v, double* a, double* left, double jerk, double duration) {
  double t = fmin(*left, duration);
  double way = t * (*v + t * (*a / 2 + t * jerk / 6));
  *v += t * (*a + t * jerk / 2);
  *a += t * jerk;
  *left -= t;
  return way;
}


double profile_advance(double* velocity, double* acceleration, double target, double most, double jerk,
                       double dt) {
  double v = *velocity, a = *acceleration, left = dt;

  // up or down: the target against where the velocity goes while the acceleration is taken away
  double sign = target - v >= a * fabs(a) / (2 * jerk) ? 1 : -1;
  double begin = sign * a, gain = sign * (target - v);
  double peak = sqrt(fmax(0, jerk * gain + begin * begin / 2)), steady = 0;
  if (peak > most) {
    double squares = (begin > most ? -1 : 1) * (most * most - begin * begin) + most * most;
    steady = fmax(0, (gain - squares / (2 * jerk)) / most);
    peak = most;
  }
  // an acceleration over the limit comes down to it first
  double first = fabs(peak - begin) / jerk, last = peak / jerk;
  double way = stretch(&v, &a, &left, begin > peak ? -sign * jerk : sign * jerk, first);
  way += stretch(&v, &a, &left, 0, steady);
  way += stretch(&v, &a, &left, -sign * jerk, last);
  int there = dt >= first + steady + last;
  *velocity = there ? target : v;
  *acceleration = there ? 0 : a;
  return way + left * target;
}

// Vectors of three numbers.
#ifndef TACTILE_VEC3_H_
#define TACTILE_VEC3_H_


static inline double dot3(const double a[3], const double b[3]) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}


// res = a x b, res not among them
static inline void cross3(double res[3], const double a[3], const double b[3]) {
  res[0] = a[1] * b[2] - a[2] * b[1];
  res[1] = a[2] * b[0] - a[0] * b[2];
  res[2] = a[0] * b[1] - a[1] * b[0];
}

#endif  // TACTILE_VEC3_H_

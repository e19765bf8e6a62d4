#include "shapes.h"

#include <math.h>
#include <string.h>

#define PI 3.14159265358979323846


double box_query(double normal[3], const double point[3], const double* shape) {
  double beyond[3], outer[3], sign[3], square = 0;
  int face = 0;
  for (int i = 0; i < 3; i++) {
    beyond[i] = fabs(point[i]) - shape[i];
    outer[i] = fmax(beyond[i], 0);
    sign[i] = point[i] < 0 ? -1 : 1;
    square += outer[i] * outer[i];
    if (beyond[i] > beyond[face]) { face = i; }
  }
  double from_core = sqrt(square);
  for (int i = 0; i < 3; i++) {
    normal[i] = from_core > 0 ? sign[i] * outer[i] / from_core : i == face ? sign[i] : 0;
  }
  return (from_core > 0 ? from_core : beyond[face]) - shape[3];
}


double prism_query(double normal[3], const double point[3], const double* shape) {
  double x = point[0], y = point[1], z = point[2], sector = 2 * PI / shape[0], inner = shape[1];
  double facing = PI / 2 + sector * rint((atan2(y, x) - PI / 2) / sector);  // of the nearest side
  double c = cos(facing), s = sin(facing);
  double beyond = c * x + s * y - inner, along = c * y - s * x;
  double past = copysign(fmax(fabs(along) - inner * tan(sector / 2), 0), along);  // the corner
  double above = fabs(z) - shape[2], up = z < 0 ? -1 : 1;
  double out = fmax(beyond, 0), over = fmax(above, 0);
  double from_core = sqrt(out * out + past * past + over * over);
  if (from_core > 0) {
    normal[0] = (c * out - s * past) / from_core;
    normal[1] = (s * out + c * past) / from_core;
    normal[2] = up * over / from_core;
    return from_core - shape[3];
  }
  int side = beyond >= above;
  normal[0] = side ? c : 0;
  normal[1] = side ? s : 0;
  normal[2] = side ? 0 : up;
  return fmax(beyond, above) - shape[3];
}


double cylinder_query(double normal[3], const double point[3], const double* shape) {
  int turn = (int)shape[3];
  double p[3], n[3] = {1, 0, 0};  // on the axis any direction is as good
  for (int i = 0; i < 3; i++) { p[i] = point[(i + turn) % 3]; }
  double across = hypot(p[0], p[1]), side = across - shape[0], end = fabs(p[2]) - shape[1];
  if (across > 0) {
    n[0] = p[0] / across;
    n[1] = p[1] / across;
  }
  double distance = side, up = p[2] < 0 ? -1 : 1;
  if (shape[2] != 0 && side > 0 && end > 0) {  // the rim
    distance = hypot(side, end);
    n[0] *= side / distance;
    n[1] *= side / distance;
    n[2] = up * end / distance;
  } else if (shape[2] != 0 && end > side) {
    distance = end;
    n[0] = n[1] = 0;
    n[2] = up;
  }
  for (int i = 0; i < 3; i++) { normal[(i + turn) % 3] = n[i]; }
  return distance;
}


void meet(Meeting* res, double distance, const double normal[3], const double T[16],
          double radius) {
  double inward[3];  // {f}'s z axis in {s}
  for (int i = 0; i < 3; i++) {
    inward[i] = -(T[i] * normal[0] + T[4 + i] * normal[1] + T[8 + i] * normal[2]);
    res->point[i] = T[4 * i + 3] - distance * normal[i];
  }
  res->depth = radius - distance;
  res->angle = atan2(hypot(inward[0], inward[1]), inward[2]);

  // Ry(beta) Rx(alpha) whose third row is that axis
  double x = inward[0], y = inward[1], z = inward[2], cos_beta = hypot(y, z);
  double sa = cos_beta > 0 ? y / cos_beta : 0, ca = cos_beta > 0 ? z / cos_beta : 1;
  double T_fs[16] = {cos_beta, -x * sa,       -x * ca,       0,          0, ca, -sa, 0,
                     x,        cos_beta * sa, cos_beta * ca, res->depth, 0, 0,  0,   1};
  memcpy(res->T_fs, T_fs, sizeof(T_fs));
}

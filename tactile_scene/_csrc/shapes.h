// Signed distance and outward normal of shapes, and where a tip meets one; tactile_scene/shapes
// says what they mean.

#ifndef TACTILE_DRIVERS_SHAPES_H_
#define TACTILE_DRIVERS_SHAPES_H_

// Distance (m) and normal at a point, of a shape that these numbers describe.
typedef double ShapeQuery(double normal[3], const double point[3], const double* shape);

enum { BOX_NUMBERS = 4, PRISM_NUMBERS = 4, CYLINDER_NUMBERS = 4 };

// half the core's size (3), radius of the edges
double box_query(double normal[3], const double point[3], const double* shape);

// number of sides, distance of the core's sides and ends from the middle, radius of the edges
double prism_query(double normal[3], const double point[3], const double* shape);

// radius, half the height, whether it has ends, and the steps of x -> y -> z -> x that take z to
// its axis
double cylinder_query(double normal[3], const double point[3], const double* shape);

typedef struct {
  double depth, angle, T_fs[16], point[3];
} Meeting;

// Where a tip of a radius about the origin of T meets a surface at a distance, with that normal.
void meet(Meeting* res, double distance, const double normal[3], const double T_surface_sensor[16],
          double radius);

#endif  // TACTILE_DRIVERS_SHAPES_H_

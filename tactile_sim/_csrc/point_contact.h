// The contact of the ideal sensor: one point that sticks until the shear reaches its limit, then
// drags along, and the force of a skin so pressed. tactile_sim/ideal_sensor.py and skin_force.py
// say what is meant; poses are 4 x 4.

#ifndef TACTILE_DRIVERS_SIM_POINT_CONTACT_H_
#define TACTILE_DRIVERS_SIM_POINT_CONTACT_H_

// Where the undeformed tip meets the surface, with the sensor's pose in the surface's frame.
typedef struct {
  const double *T, *point, *normal;
  double depth;
} PointContact;

// Tables of the largest shear (m) and turn (rad) over depth (m).
typedef struct {
  int count;
  const double *depth, *shear, *turn;
} ShearLimits;

// Carry the point that sticks, and the turn, on to the contact `now`; returns whether it slips.
int point_contact_drag(double anchor[3], double* turn, const PointContact* before,
                       const PointContact* now, const ShearLimits* limits);

// X_fs of a contact: its geometry `T_fs`, turned, and sheared by the way from the anchor unless
// that is NULL.
void point_contact_pose(double res[16], const double T_fs[16], double turn, const PointContact* now,
                        const double* anchor);

// Force of a tip on a body, in its frame, that presses and is sheared with a stiffness, up to its
// friction.
void skin_force(double force[3], const double T_body_sensor[16], const double T_fs[16],
                double press, double stiffness, double friction);

#endif  // TACTILE_DRIVERS_SIM_POINT_CONTACT_H_

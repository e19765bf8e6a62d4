// A step of an object that stands on the floor z = 0 and is pushed over it by tips.
// tactile_sim/pushed.py says what is modelled; poses are 4 x 4, row-major.

#ifndef TACTILE_DRIVERS_SIM_PUSHED_H_
#define TACTILE_DRIVERS_SIM_PUSHED_H_

#include "floor.h"
#include "limit_surface.h"

// A sensor's contact as of its last exposure, from which its force is carried on.
typedef struct {
  double T_tool_sensor[16];
  double point[3], normal[3], force[3];  // in the body
  double matter[3];                      // the tip's, at the contact, in the sensor
  double along, across;                  // stiffness of the skin, N/m
} Tip;

// The force of a tip while the object stays where it is, in the world.
typedef struct {
  double force[3], point[3], normal[3], along, across;
  int slips;
  double matter[3];  // the tip's, at the contact
  double stuck[3];   // the force if the tip did not slip
  double
      shear[3];  // of a tip that slips, unit vector; what is left of its stiffness to turn it, N/m
  double turning;
} Touch;

typedef struct {
  // what it is
  Foot foot;
  FloorModel floor;
  double arm;  // of friction over the foot, m
  double center_of_gravity[3], weight, friction_foot, center_of_friction[2];
  double edge_friction, edge_way, friction_tip;
  // where it is, and was before it tilted; how far it has turned since the start
  double T[16], upright[16], turn;
  double tilted;  // arm of friction over the edge that it is tilted about, m; 0 while it stands
  double pressure[2];  // its centre, from the body's origin along the world's axes at the start
  double inside;       // how far that is inside the foot, m; before it is moved onto an edge
  double load;         // on the floor, over the weight
  double friction;     // over all of the foot
  double slid;         // way of the edge under load, m
  double moved;        // in this step, m
} Pushed;

void pushed_tip(Tip* tip, const double T_tool_sensor[16], const double T_body_sensor[16],
                const double point[3], const double normal[3], const double force[3], double along,
                double across);

// Move until friction carries the pushes of `count` tips, and find where the floor presses then;
// `touch` are the pushes there, T_world_tool one pose a tip. Returns 0 where no motion was found.
int pushed_step(Pushed* body, Touch* touch, const Tip* tip, const double* const* T_world_tool,
                int count);

// Take it that the object has tilted, or has not: what the edge carries, and where on it the floor
// presses.
void pushed_tilt(Pushed* body, const double edge[4]);

#endif  // TACTILE_DRIVERS_SIM_PUSHED_H_

// Poses to and from Python, with what is wrong with an argument; for the one file that imports
// NumPy.
#ifndef TACTILE_POSES_H_
#define TACTILE_POSES_H_

#include "arrays.h"
#include "se3.h"


static inline PyObject* new_pose(const Pose* pose) {
  double mat[16];
  se3_to_matrix(mat, pose);
  return new_array(mat, 4, 4);
}


// returns 0 with an error set if the rotation is none within ROTATION_TOLERANCE
static inline int check_rotation(const double rot[9], const char* name) {
  double error = se3_rotation_error(rot);
  if (!(error <= ROTATION_TOLERANCE)) {
    char text[32];
    PyOS_snprintf(text, sizeof(text), "%.3g", error);
    PyErr_Format(PyExc_ValueError,
                 "%s: its rotation is not orthonormal, R^T R is off the identity by %s", name,
                 text);
    return 0;
  }
  if (se3_determinant(rot) < 0) {
    PyErr_Format(PyExc_ValueError, "%s: its rotation is a reflection, det R = -1", name);
    return 0;
  }
  return 1;
}

#endif  // TACTILE_POSES_H_

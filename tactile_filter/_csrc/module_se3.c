// Documentation of the functions: tactile_filter/se3.py and propagation.py.
#include "arrays.h"

#include "module_se3.h"

#include "propagate.h"
#include "se3.h"

// a rotation off by less is as orthonormal as doubles are
#define ORTHONORMAL 1e-15

const Routines* module_routines = NULL;


int module_se3_select(const char* name) {
  const Routines* found = routines_select(name);
  if (!found) {
    PyErr_Format(PyExc_ValueError, "instruction set '%s': this machine does not have it", name);
    return 0;
  }
  module_routines = found;
  return 1;
}


static int has_count(const char* name, Py_ssize_t nargs, Py_ssize_t expected) {
  if (nargs == expected) {
    return 1;
  }
  PyErr_Format(PyExc_TypeError, "%s takes %zd arguments, got %zd", name, expected, nargs);
  return 0;
}


static void to_pose(Pose* res, const double mat[16]) {
  for (int i = 0; i < 3; i++) {
    memcpy(res->rot + 3*i, mat + 4*i, 3 * sizeof(double));
    res->pos[i] = mat[4*i+3];
  }
}


static void to_matrix(double res[16], const Pose* pose) {
  for (int i = 0; i < 3; i++) {
    memcpy(res + 4*i, pose->rot + 3*i, 3 * sizeof(double));
    res[4*i+3] = pose->pos[i];
  }
  res[12] = res[13] = res[14] = 0;
  res[15] = 1;
}


// returns 0 with an error set if the rotation is none within ROTATION_TOLERANCE
static int check_rotation(const double rot[9], const char* name) {
  double error = se3_rotation_error(rot);
  if (!(error <= ROTATION_TOLERANCE)) {
    char text[32];
    PyOS_snprintf(text, sizeof(text), "%.3g", error);
    PyErr_Format(
      PyExc_ValueError, "%s: its rotation is not orthonormal, R^T R is off the identity by %s", name, text);
    return 0;
  }
  if (se3_determinant(rot) < 0) {
    PyErr_Format(PyExc_ValueError, "%s: its rotation is a reflection, det R = -1", name);
    return 0;
  }
  return 1;
}


static int log_of(double xi[6], const double mat[16]) {
  if (!module_routines->log(xi, mat)) {
    PyErr_SetString(PyExc_ValueError, "T: its upper left block is not a rotation");
    return 0;
  }
  return 1;
}


// tuple of two new references, of which either may be null with an error set
static PyObject* pack_two(PyObject* first, PyObject* second) {
  PyObject* res = first && second ? PyTuple_Pack(2, first, second) : NULL;
  Py_XDECREF(first);
  Py_XDECREF(second);
  return res;
}


PyObject* module_exp(PyObject* module, PyObject* const* args, Py_ssize_t nargs) {
  (void)module;
  double xi[6], mat[16];
  if (!has_count("exp", nargs, 1) || !read_finite(xi, args[0], 6, 0, "xi")) {
    return NULL;
  }
  module_routines->exp(mat, xi);
  return new_array(mat, 4, 4);
}


PyObject* module_log(PyObject* module, PyObject* const* args, Py_ssize_t nargs) {
  (void)module;
  double mat[16], xi[6];
  if (!has_count("log", nargs, 1) || !read_pose(mat, args[0], "T") || !log_of(xi, mat)) {
    return NULL;
  }
  return new_array(xi, 6, 0);
}


PyObject* module_inverse(PyObject* module, PyObject* const* args, Py_ssize_t nargs) {
  (void)module;
  double mat[16], res[16];
  Pose pose, inverse;
  if (!has_count("inverse", nargs, 1) || !read_pose(mat, args[0], "T")) {
    return NULL;
  }
  to_pose(&pose, mat);
  se3_inverse(&inverse, &pose);
  to_matrix(res, &inverse);
  return new_array(res, 4, 4);
}


PyObject* module_adjoint(PyObject* module, PyObject* const* args, Py_ssize_t nargs) {
  (void)module;
  double mat[16], res[36];
  if (!has_count("adjoint", nargs, 1) || !read_pose(mat, args[0], "T")) {
    return NULL;
  }
  module_routines->adjoint(res, mat);
  return new_array(res, 6, 6);
}


PyObject* module_left_jacobian(PyObject* module, PyObject* const* args, Py_ssize_t nargs) {
  (void)module;
  double xi[6], res[36];
  if (!has_count("left_jacobian", nargs, 1) || !read_finite(xi, args[0], 6, 0, "xi")) {
    return NULL;
  }
  module_routines->left_jacobian(res, xi);
  return new_array(res, 6, 6);
}


PyObject* module_inverse_left_jacobian(PyObject* module, PyObject* const* args, Py_ssize_t nargs) {
  (void)module;
  double xi[6], res[36];
  if (!has_count("inverse_left_jacobian", nargs, 1) || !read_finite(xi, args[0], 6, 0, "xi")) {
    return NULL;
  }
  module_routines->inverse_left_jacobian(res, xi);
  return new_array(res, 6, 6);
}


PyObject* module_orthonormalized(PyObject* module, PyObject* const* args, Py_ssize_t nargs) {
  (void)module;
  double mat[16];
  Pose pose;
  if (!has_count("orthonormalized", nargs, 1) || !read_pose(mat, args[0], "T")) {
    return NULL;
  }
  to_pose(&pose, mat);
  if (!check_rotation(pose.rot, "T")) {
    return NULL;
  }
  se3_orthonormalize(&pose);
  to_matrix(mat, &pose);
  return new_array(mat, 4, 4);
}


PyObject* module_interpolate(PyObject* module, PyObject* const* args, Py_ssize_t nargs) {
  (void)module;
  double start[16], end[16], between[16], xi[6];
  if (!has_count("interpolate", nargs, 3) || !read_pose(start, args[0], "T0")
      || !read_pose(end, args[1], "T1")) {
    return NULL;
  }
  double s = PyFloat_AsDouble(args[2]);
  if (s == -1 && PyErr_Occurred()) {
    return NULL;
  }
  if (!isfinite(s)) {
    return PyErr_Format(PyExc_ValueError, "s = %S: must be finite", args[2]);
  }
  if (s == 0 || s == 1) {
    return new_array(s == 0 ? start : end, 4, 4);
  }

  // start * exp(s * log(start^-1 * end))
  Pose from, to, inverse, motion;
  to_pose(&from, start);
  to_pose(&to, end);
  se3_inverse_product(&motion, &from, &to);
  to_matrix(between, &motion);
  if (!log_of(xi, between)) {
    return NULL;
  }
  for (int i = 0; i < 6; i++) {
    xi[i] *= s;
  }
  module_routines->exp(between, xi);
  to_pose(&motion, between);
  se3_product(&inverse, &from, &motion);
  to_matrix(between, &inverse);
  return new_array(between, 4, 4);
}


PyObject* module_usable_pose(PyObject* module, PyObject* const* args, Py_ssize_t nargs) {
  (void)module;
  double mat[16];
  Pose pose;
  if (!has_count("usable_pose", nargs, 1) || !read_array(mat, args[0], 4, 4, "T")) {
    if (PyErr_ExceptionMatches(PyExc_ValueError)) {
      PyErr_Clear();
      Py_RETURN_NONE;
    }
    return NULL;
  }
  to_pose(&pose, mat);
  double error = se3_rotation_error(pose.rot);
  if (mat[12] != 0 || mat[13] != 0 || mat[14] != 0 || mat[15] != 1 || !(error <= ROTATION_TOLERANCE)
      || !(se3_determinant(pose.rot) > 0) || !isfinite(mat[3]) || !isfinite(mat[7]) || !isfinite(mat[11])) {
    Py_RETURN_NONE;
  }
  if (error > ORTHONORMAL) {
    se3_orthonormalize(&pose);
  }
  to_matrix(mat, &pose);
  return new_array(mat, 4, 4);
}


PyObject* module_predict(PyObject* module, PyObject* const* args, Py_ssize_t nargs) {
  (void)module;
  static const char* const names[] = {"mean", "T_before", "T_now"};
  double mat[16], cov[36], moved_cov[36], variances[6];
  Pose pose[3], moved;
  if (!has_count("predict", nargs, 5)) {
    return NULL;
  }
  PyObject* const poses[] = {args[0], args[2], args[3]};
  for (int i = 0; i < 3; i++) {
    if (!read_pose(mat, poses[i], names[i])) {
      return NULL;
    }
    to_pose(pose + i, mat);
    if (!check_rotation(pose[i].rot, names[i])) {
      return NULL;
    }
  }
  if (!read_finite(cov, args[1], 6, 6, "cov") || !read_finite(variances, args[4], 6, 0, "variances")) {
    return NULL;
  }
  propagate(&moved, moved_cov, pose, cov, pose + 1, pose + 2, variances);
  to_matrix(mat, &moved);
  return pack_two(new_array(mat, 4, 4), new_array(moved_cov, 6, 6));
}


PyObject* module_innovation(PyObject* module, PyObject* const* args, Py_ssize_t nargs) {
  (void)module;
  double mat_1[16], cov_1[36], mat_2[16], cov_2[36], whitened[6];
  if (!has_count("innovation", nargs, 4) || !read_pose(mat_1, args[0], "mean_1")
      || !read_finite(cov_1, args[1], 6, 6, "cov_1") || !read_pose(mat_2, args[2], "mean_2")
      || !read_finite(cov_2, args[3], 6, 6, "cov_2")) {
    return NULL;
  }
  Pose pose_1, pose_2;
  to_pose(&pose_1, mat_1);
  to_pose(&pose_2, mat_2);
  double nis = innovation(whitened, &pose_1, cov_1, &pose_2, cov_2);
  return pack_two(PyFloat_FromDouble(nis), new_array(whitened, 6, 0));
}

// Python module tactile_geometry._se3: the interface is tactile_geometry/se3.py.
#include "poses.h"
#include "se3_routines.h"

#define ROUTINES Se3Routines
#define ROUTINES_BASE se3_routines_base
#define ROUTINES_AVX2 se3_routines_avx2
#include "instruction_sets.h"

// a rotation off by less is as orthonormal as doubles are
#define ORTHONORMAL 1e-15

static int log_of(double xi[6], const double mat[16]) {
  if (!routines->log(xi, mat)) {
    PyErr_SetString(PyExc_ValueError, "T: its upper left block is not a rotation");
    return 0;
  }
  return 1;
}


// the functions of one tangent vector xi that answer a square matrix
#define OF_TANGENT(name, rows)                                      \
  static PyObject* module_##name(PyObject* module, PyObject* arg) { \
    double xi[6], res[rows * rows];                                 \
    (void)module;                                                   \
    if (!read_finite(xi, arg, 6, 0, "xi")) { return NULL; }         \
    routines->name(res, xi);                                        \
    return new_array(res, rows, rows);                              \
  }

OF_TANGENT(exp, 4)
OF_TANGENT(left_jacobian, 6)
OF_TANGENT(inverse_left_jacobian, 6)


static PyObject* module_log(PyObject* module, PyObject* arg) {
  (void)module;
  double mat[16], xi[6];
  return read_pose(mat, arg, "T") && log_of(xi, mat) ? new_array(xi, 6, 0) : NULL;
}


static PyObject* module_inverse(PyObject* module, PyObject* arg) {
  (void)module;
  double mat[16];
  Pose pose, inverse;
  if (!read_pose(mat, arg, "T")) { return NULL; }
  se3_from_matrix(&pose, mat);
  se3_inverse(&inverse, &pose);
  return new_pose(&inverse);
}


// the product of two poses, or of the inverse of one with the other
static PyObject* product_of(PyObject* const* args, Py_ssize_t nargs, const char* name,
                            void product(Pose*, const Pose*, const Pose*)) {
  double first[16], second[16];
  Pose a, b, res;
  if (!has_count(name, nargs, 2) || !read_pose(first, args[0], "A") ||
      !read_pose(second, args[1], "B")) {
    return NULL;
  }
  se3_from_matrix(&a, first);
  se3_from_matrix(&b, second);
  product(&res, &a, &b);
  return new_pose(&res);
}


static PyObject* module_compose(PyObject* module, PyObject* const* args, Py_ssize_t nargs) {
  (void)module;
  return product_of(args, nargs, "compose", se3_product);
}


static PyObject* module_between(PyObject* module, PyObject* const* args, Py_ssize_t nargs) {
  (void)module;
  return product_of(args, nargs, "between", se3_inverse_product);
}


static PyObject* module_point_in(PyObject* module, PyObject* const* args, Py_ssize_t nargs) {
  (void)module;
  double mat[16], point[3], res[3] = {0};
  if (!has_count("point_in", nargs, 2) || !read_pose(mat, args[0], "T") ||
      !read_finite(point, args[1], 3, 0, "point")) {
    return NULL;
  }
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) { res[i] += mat[4 * j + i] * (point[j] - mat[4 * j + 3]); }
  }
  return new_array(res, 3, 0);
}


static PyObject* module_carry(PyObject* module, PyObject* const* args, Py_ssize_t nargs) {
  (void)module;
  double mat[16], xi[6], adjoint[36], res[6] = {0};
  if (!has_count("carry", nargs, 2) || !read_pose(mat, args[0], "T") ||
      !read_finite(xi, args[1], 6, 0, "xi")) {
    return NULL;
  }
  routines->adjoint(adjoint, mat);
  for (int i = 0; i < 36; i++) { res[i / 6] += adjoint[i] * xi[i % 6]; }
  return new_array(res, 6, 0);
}


// a C function of `from` numbers that answers `to`, of each in a stack of arrays of the shape
// (rows, columns), or (rows,) for columns = 0, behind any others; returns 0 where there is none
typedef int Conversion(double* res, const double* value);
typedef struct {
  int rows, columns;
} Extents;

static PyObject* convert_each(PyObject* arg, Extents from, Extents to, Conversion* convert,
                              const char* name) {
  npy_intp shape[NPY_MAXDIMS];
  int own = from.columns ? 2 : 1, count = from.rows * (from.columns ? from.columns : 1);
  PyArrayObject* array = (PyArrayObject*)PyArray_FROM_OTF(arg, NPY_DOUBLE, NPY_ARRAY_IN_ARRAY);
  if (!array) { return NULL; }
  int others = PyArray_NDIM(array) - own, result = others + (to.columns ? 2 : 1);
  PyArrayObject* res = NULL;
  const double* data = PyArray_DATA(array);
  if (others < 0 || result > NPY_MAXDIMS || PyArray_DIM(array, others) != from.rows ||
      (own == 2 && PyArray_DIM(array, others + 1) != from.columns)) {
    set_stack_error(array, from.rows, from.columns, name);
  } else if (all_finite(data, PyArray_SIZE(array), arg, name)) {
    memcpy(shape, PyArray_DIMS(array), (size_t)others * sizeof(npy_intp));
    shape[others] = to.rows;
    shape[result - 1] = to.columns ? to.columns : to.rows;
    res = (PyArrayObject*)PyArray_SimpleNew(result, shape, NPY_DOUBLE);
  }
  npy_intp stack = res ? PyArray_SIZE(array) / count : 0;
  for (npy_intp i = 0; i < stack; i++) {
    double* one = (double*)PyArray_DATA(res) + i * to.rows * (to.columns ? to.columns : 1);
    if (!convert(one, data + i * count)) {
      const double* row = data + i * count + 12;
      PyObject* last = Py_BuildValue("[dddd]", row[0], row[1], row[2], row[3]);
      PyErr_Format(PyExc_ValueError, "%s: last row must be [0, 0, 0, 1], is %S", name, last);
      Py_XDECREF(last);
      Py_CLEAR(res);
      break;
    }
  }
  Py_DECREF(array);
  return (PyObject*)res;
}


static PyObject* module_pose_from_euler(PyObject* module, PyObject* arg) {
  (void)module;
  return convert_each(arg, (Extents){6, 0}, (Extents){4, 4}, se3_from_euler, "pose6");
}


static PyObject* module_euler_from_pose(PyObject* module, PyObject* arg) {
  (void)module;
  return convert_each(arg, (Extents){4, 4}, (Extents){6, 0}, se3_to_euler, "T");
}


static PyObject* module_adjoint(PyObject* module, PyObject* arg) {
  (void)module;
  double mat[16], res[36];
  if (!read_pose(mat, arg, "T")) { return NULL; }
  routines->adjoint(res, mat);
  return new_array(res, 6, 6);
}


static PyObject* module_orthonormalized(PyObject* module, PyObject* arg) {
  (void)module;
  double mat[16];
  Pose pose;
  if (!read_pose(mat, arg, "T")) { return NULL; }
  se3_from_matrix(&pose, mat);
  if (!check_rotation(pose.rot, "T")) { return NULL; }
  se3_orthonormalize(&pose);
  return new_pose(&pose);
}


static PyObject* module_interpolate(PyObject* module, PyObject* const* args, Py_ssize_t nargs) {
  (void)module;
  double start[16], end[16], between[16], xi[6];
  if (!has_count("interpolate", nargs, 3) || !read_pose(start, args[0], "T0") ||
      !read_pose(end, args[1], "T1")) {
    return NULL;
  }
  double s = PyFloat_AsDouble(args[2]);
  if (s == -1 && PyErr_Occurred()) { return NULL; }
  if (!isfinite(s)) { return PyErr_Format(PyExc_ValueError, "s = %S: must be finite", args[2]); }
  if (s == 0 || s == 1) { return new_array(s == 0 ? start : end, 4, 4); }

  // start * exp(s * log(start^-1 * end))
  Pose from, to, motion;
  se3_from_matrix(&from, start);
  se3_from_matrix(&to, end);
  se3_inverse_product(&motion, &from, &to);
  se3_to_matrix(between, &motion);
  if (!log_of(xi, between)) { return NULL; }
  for (int i = 0; i < 6; i++) { xi[i] *= s; }
  routines->exp(between, xi);
  se3_from_matrix(&motion, between);
  se3_product(&to, &from, &motion);
  return new_pose(&to);
}


// how far the rotation of a pose is off, negative for an argument that is none; -2 with an error
// set
static double usable(Pose* pose, PyObject* arg) {
  double buffer[16];
  const double* mat = borrow_array(buffer, arg, 4, 4, "T");
  if (!mat) {
    if (!PyErr_ExceptionMatches(PyExc_ValueError)) { return -2; }
    PyErr_Clear();
    return -1;
  }
  se3_from_matrix(pose, mat);
  double error = se3_rotation_error(pose->rot);
  int is_pose = mat[12] == 0 && mat[13] == 0 && mat[14] == 0 && mat[15] == 1 &&
                error <= ROTATION_TOLERANCE && se3_determinant(pose->rot) > 0 &&
                fabs(mat[3]) <= LARGEST_POSITION && fabs(mat[7]) <= LARGEST_POSITION &&
                fabs(mat[11]) <= LARGEST_POSITION;
  return is_pose ? error : -1;
}


static PyObject* module_usable_pose(PyObject* module, PyObject* arg) {
  (void)module;
  Pose pose;
  double error = usable(&pose, arg);
  if (error == -2) { return NULL; }
  if (error < 0) { Py_RETURN_NONE; }
  if (error > ORTHONORMAL) { se3_orthonormalize(&pose); }
  return new_pose(&pose);
}


static PyObject* module_is_pose(PyObject* module, PyObject* arg) {
  (void)module;
  Pose pose;
  double error = usable(&pose, arg);
  return error == -2 ? NULL : PyBool_FromLong(error >= 0);
}


#define METHOD(name, kind) {#name, (PyCFunction)(void (*)(void))module_##name, kind, NULL}

static PyMethodDef methods[] = {{"instruction_set", (PyCFunction)(void (*)(void))instruction_set,
                                 METH_FASTCALL, instruction_set_doc},
                                METHOD(exp, METH_O),
                                METHOD(log, METH_O),
                                METHOD(inverse, METH_O),
                                METHOD(compose, METH_FASTCALL),
                                METHOD(between, METH_FASTCALL),
                                METHOD(point_in, METH_FASTCALL),
                                METHOD(carry, METH_FASTCALL),
                                METHOD(adjoint, METH_O),
                                METHOD(pose_from_euler, METH_O),
                                METHOD(euler_from_pose, METH_O),
                                METHOD(left_jacobian, METH_O),
                                METHOD(inverse_left_jacobian, METH_O),
                                METHOD(orthonormalized, METH_O),
                                METHOD(usable_pose, METH_O),
                                METHOD(is_pose, METH_O),
                                METHOD(interpolate, METH_FASTCALL),
                                {NULL, NULL, 0, NULL}};

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "_se3", "SE(3) in C.", -1, methods, NULL, NULL, NULL, NULL};


PyMODINIT_FUNC PyInit__se3(void) {
  import_array();
  if (!select_routines(NULL)) { return NULL; }
  return PyModule_Create(&definition);
}

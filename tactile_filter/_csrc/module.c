// Python module tactile_filter._fusion: the interface is tactile_filter/fusion.py, se3.py and propagation.py.
#include "arrays.h"
#include "fusion.h"
#include "propagate.h"
#include "routines.h"
#include "se3.h"

#define MAX_ITERATIONS 100000
#define MAX_STATUS 3

// a rotation off by less is as orthonormal as doubles are
#define ORTHONORMAL 1e-15

static const Routines* routines = NULL;

// what fusion.py gives the module with set_up
static PyTypeObject* result_type = NULL;  // a tuple of these six: mean, cov, factor, iterations, status, step
static PyObject* statuses[MAX_STATUS] = {NULL};
static PyObject* plans = NULL;            // dict, mode -> (iterations, order)
static PyObject* refuse = NULL;           // raises for (fault, (mean_1, cov_1, mean_2, cov_2))


static int has_count(const char* name, Py_ssize_t nargs, Py_ssize_t expected) {
  if (nargs == expected) {
    return 1;
  }
  PyErr_Format(PyExc_TypeError, "%s takes %zd arguments, got %zd", name, expected, nargs);
  return 0;
}


static PyObject* new_result(const FusionOutput* output) {
  PyObject* items[6] = {
    new_array(output->mean, 4, 4), new_array(output->cov, 6, 6), new_array(output->factor, 6, 6),
    PyLong_FromLong(output->iterations), statuses[output->status], PyFloat_FromDouble(output->step)};
  Py_XINCREF(items[4]);
  PyObject* res = result_type->tp_alloc(result_type, 6);
  for (int i = 0; i < 6; i++) {
    if (!items[i] || !res) {
      for (int j = i; j < 6; j++) {
        Py_XDECREF(items[j]);
      }
      Py_XDECREF(res);
      return NULL;
    }
    PyTuple_SET_ITEM(res, i, items[i]);
  }
  return res;
}


// mean and covariance of one of the Gaussians; the buffers are used where an argument has to be converted
static int read_input(FusionInput* input, double mean[16], double cov[36], PyObject* const* args, int index) {
  static const char* const names[4] = {"mean_1", "cov_1", "mean_2", "cov_2"};
  input->mean = borrow_array(mean, args[0], 4, 4, names[2*index]);
  input->cov = input->mean ? borrow_array(cov, args[1], 6, 6, names[2*index+1]) : NULL;
  return input->cov != NULL;
}


// number of iterations and order; returns 0 with an error set
static int read_plan(int* iterations, int* order, PyObject* const* args) {
  long count = PyLong_AsLong(args[0]), kind = PyLong_AsLong(args[1]);
  if (PyErr_Occurred()) {
    return 0;
  }
  if (count < 1 || count > MAX_ITERATIONS || kind < -1 || kind > 4 || kind == 1 || kind == 3) {
    PyErr_Format(PyExc_ValueError, "iterations = %ld, order = %ld: out of range", count, kind);
    return 0;
  }
  *iterations = (int)count;
  *order = (int)kind;
  return 1;
}


// as read_plan, from a mode or from a tuple of both
static int read_mode(int* iterations, int* order, PyObject* arg) {
  PyObject* plan = PyTuple_CheckExact(arg) ? arg : PyDict_GetItemWithError(plans, arg);
  if (!plan) {
    if (!PyErr_Occurred()) {
      PyErr_SetObject(PyExc_KeyError, arg);
    }
    return 0;
  }
  if (!PyTuple_CheckExact(plan) || PyTuple_GET_SIZE(plan) != 2) {
    PyErr_SetString(PyExc_TypeError, "fuse: a plan is a tuple of two");
    return 0;
  }
  return read_plan(iterations, order, &PyTuple_GET_ITEM(plan, 0));
}


static const char fuse_doc[] =
  "fuse(mean_1, cov_1, mean_2, cov_2, plan, /)\n--\n\n"
  "The FusionResult. plan: a mode (else KeyError), or the number of iterations and the order: 2, 4, 0 for the\n"
  "exact Jacobian, or -1 for iterations to convergence, at most so many.";

static PyObject* fuse(PyObject* module, PyObject* const* args, Py_ssize_t nargs) {
  (void)module;
  int iterations, order;
  if (!has_count("fuse", nargs, 5)) {
    return NULL;
  }
  if (!result_type) {
    PyErr_SetString(PyExc_RuntimeError, "set_up has not been called");
    return NULL;
  }
  double mean[2][16], cov[2][36];
  FusionInput input[2];
  if (!read_mode(&iterations, &order, args[4]) || !read_input(input, mean[0], cov[0], args, 0)
      || !read_input(input + 1, mean[1], cov[1], args + 2, 1)) {
    return NULL;
  }
  FusionOutput output;
  int fault = routines->fuse(&output, input, iterations, order);
  return fault ? PyObject_CallFunction(refuse, "i(OOOO)", fault, args[0], args[1], args[2], args[3])
               : new_result(&output);
}


static const char check_doc[] =
  "check(mean, cov, /)\n--\n\n0 if the two are a Gaussian that can be fused, else as fuse.";

static PyObject* check(PyObject* module, PyObject* const* args, Py_ssize_t nargs) {
  (void)module;
  double mean[16], cov[36];
  FusionInput input;
  return has_count("check", nargs, 2) && read_input(&input, mean, cov, args, 0)
         ? PyLong_FromLong(routines->check(&input)) : NULL;
}


static const char set_up_doc[] =
  "set_up(type, statuses, plans, refuse, /)\n--\n\n"
  "The class of results, a named tuple of six, its statuses, (iterations, order) by mode, and what is called with a\n"
  "fault, 16 * (index of the argument at fault) + what it lacks, and the four arguments, and raises.";

static PyObject* set_up(PyObject* module, PyObject* const* args, Py_ssize_t nargs) {
  (void)module;
  if (nargs != 4 || !PyType_Check(args[0]) || !PyType_IsSubtype((PyTypeObject*)args[0], &PyTuple_Type)
      || !PyTuple_Check(args[1]) || PyTuple_GET_SIZE(args[1]) != MAX_STATUS || !PyDict_CheckExact(args[2])
      || !PyCallable_Check(args[3])) {
    PyErr_SetString(PyExc_TypeError, "set_up takes a class of tuples, a tuple of three, a dict and a callable");
    return NULL;
  }
  Py_XSETREF(result_type, (PyTypeObject*)Py_NewRef(args[0]));
  for (int i = 0; i < MAX_STATUS; i++) {
    Py_XSETREF(statuses[i], Py_NewRef(PyTuple_GET_ITEM(args[1], i)));
  }
  Py_XSETREF(plans, Py_NewRef(args[2]));
  Py_XSETREF(refuse, Py_NewRef(args[3]));
  Py_RETURN_NONE;
}


// use the routines of this instruction set, or the best for null; returns 0 with an error set
static int select_routines(const char* name) {
  const Routines* found = routines_select(name);
  if (!found) {
    PyErr_Format(PyExc_ValueError, "instruction set '%s': this machine does not have it", name);
    return 0;
  }
  routines = found;
  return 1;
}


static const char instruction_set_doc[] =
  "instruction_set(name=None, /)\n--\n\n"
  "Use the routines for this instruction set: base, and on x86-64 avx2. Answers the one in use.";

static PyObject* instruction_set(PyObject* module, PyObject* const* args, Py_ssize_t nargs) {
  (void)module;
  if (nargs > 1) {
    return PyErr_Format(PyExc_TypeError, "instruction_set takes at most 1 argument, got %zd", nargs);
  }
  if (nargs == 1) {
    const char* name = PyUnicode_AsUTF8(args[0]);
    if (!name || !select_routines(name)) {
      return NULL;
    }
  }
  return PyUnicode_FromString(routines->name);
}


// ---- SE(3): documentation in tactile_filter/se3.py and propagation.py ----

static PyObject* new_pose(const Pose* pose) {
  double mat[16];
  se3_to_matrix(mat, pose);
  return new_array(mat, 4, 4);
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
  if (!routines->log(xi, mat)) {
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


// the functions of one tangent vector xi that answer a square matrix
#define OF_TANGENT(name, rows)                                   \
  static PyObject* module_##name(PyObject* module, PyObject* arg) { \
    double xi[6], res[rows*rows];                                \
    (void)module;                                                \
    if (!read_finite(xi, arg, 6, 0, "xi")) {                     \
      return NULL;                                               \
    }                                                            \
    routines->name(res, xi);                                     \
    return new_array(res, rows, rows);                           \
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
  if (!read_pose(mat, arg, "T")) {
    return NULL;
  }
  se3_from_matrix(&pose, mat);
  se3_inverse(&inverse, &pose);
  return new_pose(&inverse);
}


// the product of two poses, or of the inverse of one with the other
static PyObject* product_of(PyObject* const* args, Py_ssize_t nargs, const char* name,
                            void product(Pose*, const Pose*, const Pose*)) {
  double first[16], second[16];
  Pose a, b, res;
  if (!has_count(name, nargs, 2) || !read_pose(first, args[0], "A") || !read_pose(second, args[1], "B")) {
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
  if (!has_count("point_in", nargs, 2) || !read_pose(mat, args[0], "T")
      || !read_finite(point, args[1], 3, 0, "point")) {
    return NULL;
  }
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) {
      res[i] += mat[4*j+i] * (point[j] - mat[4*j+3]);
    }
  }
  return new_array(res, 3, 0);
}


static PyObject* module_carry(PyObject* module, PyObject* const* args, Py_ssize_t nargs) {
  (void)module;
  double mat[16], xi[6], adjoint[36], res[6] = {0};
  if (!has_count("carry", nargs, 2) || !read_pose(mat, args[0], "T") || !read_finite(xi, args[1], 6, 0, "xi")) {
    return NULL;
  }
  routines->adjoint(adjoint, mat);
  for (int i = 0; i < 36; i++) {
    res[i / 6] += adjoint[i] * xi[i % 6];
  }
  return new_array(res, 6, 0);
}


// a C function of `from` numbers that answers `to`, of each in a stack of arrays of the shape (rows, columns), or
// (rows,) for columns = 0, behind any others; returns 0 where there is none
typedef int Conversion(double* res, const double* value);
typedef struct {
  int rows, columns;
} Extents;

static PyObject* convert_each(PyObject* arg, Extents from, Extents to, Conversion* convert, const char* name) {
  npy_intp shape[NPY_MAXDIMS];
  int own = from.columns ? 2 : 1, count = from.rows * (from.columns ? from.columns : 1);
  PyArrayObject* array = (PyArrayObject*)PyArray_FROM_OTF(arg, NPY_DOUBLE, NPY_ARRAY_IN_ARRAY);
  if (!array) {
    return NULL;
  }
  int others = PyArray_NDIM(array) - own, result = others + (to.columns ? 2 : 1);
  PyArrayObject* res = NULL;
  const double* data = PyArray_DATA(array);
  if (others < 0 || result > NPY_MAXDIMS || PyArray_DIM(array, others) != from.rows
      || (own == 2 && PyArray_DIM(array, others + 1) != from.columns)) {
    set_stack_error(array, from.rows, from.columns, name);
  } else if (all_finite(data, PyArray_SIZE(array), arg, name)) {
    memcpy(shape, PyArray_DIMS(array), (size_t)others * sizeof(npy_intp));
    shape[others] = to.rows;
    shape[result-1] = to.columns ? to.columns : to.rows;
    res = (PyArrayObject*)PyArray_SimpleNew(result, shape, NPY_DOUBLE);
  }
  npy_intp stack = res ? PyArray_SIZE(array) / count : 0;
  for (npy_intp i = 0; i < stack; i++) {
    double* one = (double*)PyArray_DATA(res) + i * to.rows * (to.columns ? to.columns : 1);
    if (!convert(one, data + i*count)) {
      const double* row = data + i*count + 12;
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
  if (!read_pose(mat, arg, "T")) {
    return NULL;
  }
  routines->adjoint(res, mat);
  return new_array(res, 6, 6);
}


static PyObject* module_orthonormalized(PyObject* module, PyObject* arg) {
  (void)module;
  double mat[16];
  Pose pose;
  if (!read_pose(mat, arg, "T")) {
    return NULL;
  }
  se3_from_matrix(&pose, mat);
  if (!check_rotation(pose.rot, "T")) {
    return NULL;
  }
  se3_orthonormalize(&pose);
  return new_pose(&pose);
}


static PyObject* module_interpolate(PyObject* module, PyObject* const* args, Py_ssize_t nargs) {
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
  Pose from, to, motion;
  se3_from_matrix(&from, start);
  se3_from_matrix(&to, end);
  se3_inverse_product(&motion, &from, &to);
  se3_to_matrix(between, &motion);
  if (!log_of(xi, between)) {
    return NULL;
  }
  for (int i = 0; i < 6; i++) {
    xi[i] *= s;
  }
  routines->exp(between, xi);
  se3_from_matrix(&motion, between);
  se3_product(&to, &from, &motion);
  return new_pose(&to);
}


// how far the rotation of a pose is off, negative for an argument that is none; -2 with an error set
static double usable(Pose* pose, PyObject* arg) {
  double buffer[16];
  const double* mat = borrow_array(buffer, arg, 4, 4, "T");
  if (!mat) {
    if (!PyErr_ExceptionMatches(PyExc_ValueError)) {
      return -2;
    }
    PyErr_Clear();
    return -1;
  }
  se3_from_matrix(pose, mat);
  double error = se3_rotation_error(pose->rot);
  int is_pose = mat[12] == 0 && mat[13] == 0 && mat[14] == 0 && mat[15] == 1 && error <= ROTATION_TOLERANCE
                && se3_determinant(pose->rot) > 0 && fabs(mat[3]) <= LARGEST_POSITION
                && fabs(mat[7]) <= LARGEST_POSITION && fabs(mat[11]) <= LARGEST_POSITION;
  return is_pose ? error : -1;
}


static PyObject* module_usable_pose(PyObject* module, PyObject* arg) {
  (void)module;
  Pose pose;
  double error = usable(&pose, arg);
  if (error == -2) {
    return NULL;
  }
  if (error < 0) {
    Py_RETURN_NONE;
  }
  if (error > ORTHONORMAL) {
    se3_orthonormalize(&pose);
  }
  return new_pose(&pose);
}


static PyObject* module_is_pose(PyObject* module, PyObject* arg) {
  (void)module;
  Pose pose;
  double error = usable(&pose, arg);
  return error == -2 ? NULL : PyBool_FromLong(error >= 0);
}


// limits of a contact's pose and of its covariance; tactile_filter/contact_bounds.py says what they mean
enum {SHEAR, LEAST_DEPTH, DEPTH, TILT, TWIST, LEAST_SIGMA, SIGMA, LEAST_TURN_SIGMA, TURN_SIGMA, LIMITS};

// the first of the limits that X_sf is beyond, with its value there; LIMITS if none
static int beyond_limits(double* value, const double m[16], const double limits[LIMITS]) {
  Pose X_sf, X_fs;
  se3_from_matrix(&X_sf, m);
  se3_inverse(&X_fs, &X_sf);
  const double* r = X_fs.rot;
  double found[5] = {hypot(X_fs.pos[0], X_fs.pos[1]), X_fs.pos[2], X_fs.pos[2],
                     atan2(hypot(r[6], r[7]), r[8]), atan2(r[3], r[0])};
  for (int i = 0; i < 5; i++) {
    double size = i == TWIST ? fabs(found[i]) : found[i];
    if (!(i == LEAST_DEPTH ? size >= limits[i] : size <= limits[i])) {
      *value = found[i];
      return i;
    }
  }
  return LIMITS;
}


static PyObject* module_contact_fault(PyObject* module, PyObject* const* args, Py_ssize_t nargs) {
  (void)module;
  double mat[16], limits[LIMITS], value;
  if (!has_count("contact_fault", nargs, 2) || !read_array(mat, args[0], 4, 4, "X_sf")
      || !read_finite(limits, args[1], LIMITS, 0, "limits")) {
    return NULL;
  }
  int fault = beyond_limits(&value, mat, limits);
  if (fault == LIMITS) {
    Py_RETURN_NONE;
  }
  return Py_BuildValue("id", fault, value);
}


static PyObject* module_sigma_fault(PyObject* module, PyObject* const* args, Py_ssize_t nargs) {
  (void)module;
  double buffer[36], limits[LIMITS];
  const double* cov = has_count("sigma_fault", nargs, 2) ? borrow_array(buffer, args[0], 6, 6, "cov") : NULL;
  if (!cov || !read_finite(limits, args[1], LIMITS, 0, "limits")) {
    return NULL;
  }
  for (int i = 0; i < 6; i++) {
    int part = i / 3;
    double least = limits[LEAST_SIGMA + 2*part], largest = limits[SIGMA + 2*part], variance = cov[7*i];
    if (!(least*least <= variance && variance <= largest*largest)) {
      return PyLong_FromLong(part);
    }
  }
  Py_RETURN_NONE;
}


static PyObject* module_predict(PyObject* module, PyObject* const* args, Py_ssize_t nargs) {
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
    se3_from_matrix(pose + i, mat);
    if (!check_rotation(pose[i].rot, names[i])) {
      return NULL;
    }
  }
  if (!read_finite(cov, args[1], 6, 6, "cov") || !read_finite(variances, args[4], 6, 0, "variances")) {
    return NULL;
  }
  propagate(&moved, moved_cov, pose, cov, pose + 1, pose + 2, variances);
  return pack_two(new_pose(&moved), new_array(moved_cov, 6, 6));
}


static PyObject* module_innovation(PyObject* module, PyObject* const* args, Py_ssize_t nargs) {
  (void)module;
  double mat_1[16], cov_1[36], mat_2[16], cov_2[36], whitened[6];
  if (!has_count("innovation", nargs, 4) || !read_pose(mat_1, args[0], "mean_1")
      || !read_finite(cov_1, args[1], 6, 6, "cov_1") || !read_pose(mat_2, args[2], "mean_2")
      || !read_finite(cov_2, args[3], 6, 6, "cov_2")) {
    return NULL;
  }
  Pose pose_1, pose_2;
  se3_from_matrix(&pose_1, mat_1);
  se3_from_matrix(&pose_2, mat_2);
  double nis = innovation(whitened, &pose_1, cov_1, &pose_2, cov_2);
  return pack_two(PyFloat_FromDouble(nis), new_array(whitened, 6, 0));
}


#define METHOD(name) {#name, (PyCFunction)(void(*)(void))name, METH_FASTCALL, name##_doc}
#define SE3_METHOD(name, kind) {#name, (PyCFunction)(void(*)(void))module_##name, kind, NULL}

static PyMethodDef methods[] = {
  METHOD(check),
  METHOD(fuse),
  METHOD(instruction_set),
  METHOD(set_up),
  SE3_METHOD(exp, METH_O),
  SE3_METHOD(log, METH_O),
  SE3_METHOD(inverse, METH_O),
  SE3_METHOD(compose, METH_FASTCALL),
  SE3_METHOD(between, METH_FASTCALL),
  SE3_METHOD(point_in, METH_FASTCALL),
  SE3_METHOD(carry, METH_FASTCALL),
  SE3_METHOD(adjoint, METH_O),
  SE3_METHOD(pose_from_euler, METH_O),
  SE3_METHOD(euler_from_pose, METH_O),
  SE3_METHOD(left_jacobian, METH_O),
  SE3_METHOD(inverse_left_jacobian, METH_O),
  SE3_METHOD(orthonormalized, METH_O),
  SE3_METHOD(usable_pose, METH_O),
  SE3_METHOD(is_pose, METH_O),
  SE3_METHOD(contact_fault, METH_FASTCALL),
  SE3_METHOD(sigma_fault, METH_FASTCALL),
  SE3_METHOD(interpolate, METH_FASTCALL),
  SE3_METHOD(predict, METH_FASTCALL),
  SE3_METHOD(innovation, METH_FASTCALL),
  {NULL, NULL, 0, NULL}
};

static struct PyModuleDef definition = {
  PyModuleDef_HEAD_INIT, "_fusion", "SE(3) and fusion of Gaussians over it, in C.", -1, methods,
  NULL, NULL, NULL, NULL
};


PyMODINIT_FUNC PyInit__fusion(void) {
  import_array();
  if (!select_routines(NULL)) {
    return NULL;
  }
  return PyModule_Create(&definition);
}

// Python module tactile_filter._fusion: the interface is tactile_filter/fusion.py, propagation.py
// and contact_bounds.py.
#include "fusion.h"
#include "poses.h"
#include "propagate.h"
#include "routines.h"

#define ROUTINES Routines
#define ROUTINES_BASE routines_base
#define ROUTINES_AVX2 routines_avx2
#include "instruction_sets.h"

#define MAX_ITERATIONS 100000
#define MAX_STATUS 3

// what fusion.py gives the module with set_up
static PyTypeObject* result_type =
    NULL;  // a tuple of these six: mean, cov, factor, iterations, status, step
static PyObject* statuses[MAX_STATUS] = {NULL};
static PyObject* plans = NULL;   // dict, mode -> (iterations, order)
static PyObject* refuse = NULL;  // raises for (fault, (mean_1, cov_1, mean_2, cov_2))


static PyObject* new_result(const FusionOutput* output) {
  PyObject* items[6] = {new_array(output->mean, 4, 4),   new_array(output->cov, 6, 6),
                        new_array(output->factor, 6, 6), PyLong_FromLong(output->iterations),
                        statuses[output->status],        PyFloat_FromDouble(output->step)};
  Py_XINCREF(items[4]);
  PyObject* res = result_type->tp_alloc(result_type, 6);
  for (int i = 0; i < 6; i++) {
    if (!items[i] || !res) {
      for (int j = i; j < 6; j++) { Py_XDECREF(items[j]); }
      Py_XDECREF(res);
      return NULL;
    }
    PyTuple_SET_ITEM(res, i, items[i]);
  }
  return res;
}


// mean and covariance of one of the Gaussians; the buffers are used where an argument has to be
// converted
static int read_input(FusionInput* input, double mean[16], double cov[36], PyObject* const* args,
                      int index) {
  static const char* const names[4] = {"mean_1", "cov_1", "mean_2", "cov_2"};
  input->mean = borrow_array(mean, args[0], 4, 4, names[2 * index]);
  input->cov = input->mean ? borrow_array(cov, args[1], 6, 6, names[2 * index + 1]) : NULL;
  return input->cov != NULL;
}


// number of iterations and order; returns 0 with an error set
static int read_plan(int* iterations, int* order, PyObject* const* args) {
  long count = PyLong_AsLong(args[0]), kind = PyLong_AsLong(args[1]);
  if (PyErr_Occurred()) { return 0; }
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
    if (!PyErr_Occurred()) { PyErr_SetObject(PyExc_KeyError, arg); }
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
    "The FusionResult. plan: a mode (else KeyError), or the number of iterations and the order:\n"
    "2, 4, 0 for the exact Jacobian, or -1 for iterations to convergence, at most so many.";

static PyObject* fuse(PyObject* module, PyObject* const* args, Py_ssize_t nargs) {
  (void)module;
  int iterations, order;
  if (!has_count("fuse", nargs, 5)) { return NULL; }
  if (!result_type) {
    PyErr_SetString(PyExc_RuntimeError, "set_up has not been called");
    return NULL;
  }
  double mean[2][16], cov[2][36];
  FusionInput input[2];
  if (!read_mode(&iterations, &order, args[4]) || !read_input(input, mean[0], cov[0], args, 0) ||
      !read_input(input + 1, mean[1], cov[1], args + 2, 1)) {
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
             ? PyLong_FromLong(routines->check(&input))
             : NULL;
}


static const char set_up_doc[] =
    "set_up(type, statuses, plans, refuse, /)\n--\n\n"
    "The class of results, a named tuple of six, its statuses, (iterations, order) by mode, and\n"
    "what is called with a fault, 16 * (index of the argument at fault) + what it lacks, and the\n"
    "four arguments, and raises.";

static PyObject* set_up(PyObject* module, PyObject* const* args, Py_ssize_t nargs) {
  (void)module;
  if (nargs != 4 || !PyType_Check(args[0]) ||
      !PyType_IsSubtype((PyTypeObject*)args[0], &PyTuple_Type) || !PyTuple_Check(args[1]) ||
      PyTuple_GET_SIZE(args[1]) != MAX_STATUS || !PyDict_CheckExact(args[2]) ||
      !PyCallable_Check(args[3])) {
    PyErr_SetString(PyExc_TypeError,
                    "set_up takes a class of tuples, a tuple of three, a dict and a callable");
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


// limits of a contact's pose and of its covariance; tactile_filter/contact_bounds.py says what they
// mean
enum {
  SHEAR,
  LEAST_DEPTH,
  DEPTH,
  TILT,
  TWIST,
  LEAST_SIGMA,
  SIGMA,
  LEAST_TURN_SIGMA,
  TURN_SIGMA,
  LIMITS
};

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
  if (!has_count("contact_fault", nargs, 2) || !read_array(mat, args[0], 4, 4, "X_sf") ||
      !read_finite(limits, args[1], LIMITS, 0, "limits")) {
    return NULL;
  }
  int fault = beyond_limits(&value, mat, limits);
  if (fault == LIMITS) { Py_RETURN_NONE; }
  return Py_BuildValue("id", fault, value);
}


static PyObject* module_sigma_fault(PyObject* module, PyObject* const* args, Py_ssize_t nargs) {
  (void)module;
  double buffer[36], limits[LIMITS];
  const double* cov =
      has_count("sigma_fault", nargs, 2) ? borrow_array(buffer, args[0], 6, 6, "cov") : NULL;
  if (!cov || !read_finite(limits, args[1], LIMITS, 0, "limits")) { return NULL; }
  for (int i = 0; i < 6; i++) {
    int part = i / 3;
    double least = limits[LEAST_SIGMA + 2 * part], largest = limits[SIGMA + 2 * part],
           variance = cov[7 * i];
    if (!(least * least <= variance && variance <= largest * largest)) {
      return PyLong_FromLong(part);
    }
  }
  Py_RETURN_NONE;
}


// tuple of two new references, of which either may be null with an error set
static PyObject* pack_two(PyObject* first, PyObject* second) {
  PyObject* res = first && second ? PyTuple_Pack(2, first, second) : NULL;
  Py_XDECREF(first);
  Py_XDECREF(second);
  return res;
}


static PyObject* module_predict(PyObject* module, PyObject* const* args, Py_ssize_t nargs) {
  (void)module;
  static const char* const names[] = {"mean", "T_before", "T_now"};
  double mat[16], cov[36], moved_cov[36], variances[6];
  Pose pose[3], moved;
  if (!has_count("predict", nargs, 5)) { return NULL; }
  PyObject* const poses[] = {args[0], args[2], args[3]};
  for (int i = 0; i < 3; i++) {
    if (!read_pose(mat, poses[i], names[i])) { return NULL; }
    se3_from_matrix(pose + i, mat);
    if (!check_rotation(pose[i].rot, names[i])) { return NULL; }
  }
  if (!read_finite(cov, args[1], 6, 6, "cov") ||
      !read_finite(variances, args[4], 6, 0, "variances")) {
    return NULL;
  }
  propagate(&moved, moved_cov, pose, cov, pose + 1, pose + 2, variances);
  return pack_two(new_pose(&moved), new_array(moved_cov, 6, 6));
}


static PyObject* module_innovation(PyObject* module, PyObject* const* args, Py_ssize_t nargs) {
  (void)module;
  double mat_1[16], cov_1[36], mat_2[16], cov_2[36], whitened[6];
  if (!has_count("innovation", nargs, 4) || !read_pose(mat_1, args[0], "mean_1") ||
      !read_finite(cov_1, args[1], 6, 6, "cov_1") || !read_pose(mat_2, args[2], "mean_2") ||
      !read_finite(cov_2, args[3], 6, 6, "cov_2")) {
    return NULL;
  }
  Pose pose_1, pose_2;
  se3_from_matrix(&pose_1, mat_1);
  se3_from_matrix(&pose_2, mat_2);
  double nis = innovation(whitened, &pose_1, cov_1, &pose_2, cov_2);
  return pack_two(PyFloat_FromDouble(nis), new_array(whitened, 6, 0));
}


#define METHOD(name) {#name, (PyCFunction)(void (*)(void))name, METH_FASTCALL, name##_doc}
#define MODULE_METHOD(name, kind) {#name, (PyCFunction)(void (*)(void))module_##name, kind, NULL}

static PyMethodDef methods[] = {METHOD(check),
                                METHOD(fuse),
                                METHOD(instruction_set),
                                METHOD(set_up),
                                MODULE_METHOD(contact_fault, METH_FASTCALL),
                                MODULE_METHOD(sigma_fault, METH_FASTCALL),
                                MODULE_METHOD(predict, METH_FASTCALL),
                                MODULE_METHOD(innovation, METH_FASTCALL),
                                {NULL, NULL, 0, NULL}};

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT,
    "_fusion",
    "Fusion of Gaussians over SE(3), and the filter's steps, in C.",
    -1,
    methods,
    NULL,
    NULL,
    NULL,
    NULL};


PyMODINIT_FUNC PyInit__fusion(void) {
  import_array();
  if (!select_routines(NULL)) { return NULL; }
  return PyModule_Create(&definition);
}

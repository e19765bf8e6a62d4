// Python module tactile_control._laws: the interface is pid.py and limiter.py.

#include "arrays.h"
#include "laws.h"


// six numbers that are at most so large, or NULL; no error for ones that are not
static const double* six(double buffer[CHANNELS], PyObject* arg, double largest) {
  const double* res = borrow_array(buffer, arg, CHANNELS, 0, "vector");
  for (int i = 0; res && i < CHANNELS; i++) {
    if (!(fabs(res[i]) <= largest)) { return NULL; }
  }
  if (!res && PyErr_ExceptionMatches(PyExc_ValueError)) { PyErr_Clear(); }
  return res;
}


PyDoc_STRVAR(vector_doc,
             "vector(value, largest, /)\n--\n\n"
             "A copy (6,) of six numbers that are all within +- largest, else None.");

static PyObject* vector(PyObject* module, PyObject* const* args, Py_ssize_t count) {
  double buffer[CHANNELS], largest;
  (void)module;
  if (!has_count("vector", count, 2) || !read_numbers(&largest, args + 1, 1)) { return NULL; }
  const double* found = six(buffer, args[0], largest);
  if (found) { return new_array(found, CHANNELS, 0); }
  if (PyErr_Occurred()) { return NULL; }
  Py_RETURN_NONE;
}


// the state (5, 6), to be written to, and the gains (5, 6)
static double* read_pid(const double** gains, double buffer[GAINS * CHANNELS],
                        PyObject* const* args) {
  if (!PyArray_CheckExact(args[0])) {
    PyErr_SetString(PyExc_TypeError, "state: must be an array");
    return NULL;
  }
  PyArrayObject* state = (PyArrayObject*)args[0];
  if (PyArray_TYPE(state) != NPY_DOUBLE || !PyArray_ISCARRAY(state) ||
      !has_shape(state, STATES, CHANNELS)) {
    PyErr_SetString(PyExc_ValueError, "state: must be writable float64 of shape (5, 6)");
    return NULL;
  }
  *gains = borrow_array(buffer, args[1], GAINS, CHANNELS, "gains");
  return *gains ? PyArray_DATA(state) : NULL;
}


PyDoc_STRVAR(
    pid_law_doc,
    "pid_law(state, gains, /)\n--\n\n"
    "Output (6,) before its limits. Rows of state (5, 6): integral, error, its average, derivative, "
    "transfer;\nof gains (5, 6): kp, ki, kd, integral limit, output limit.");

static PyObject* py_pid_law(PyObject* module, PyObject* const* args, Py_ssize_t count) {
  double buffer[GAINS * CHANNELS], res[CHANNELS];
  const double* gains;
  (void)module;
  double* state = has_count("pid_law", count, 2) ? read_pid(&gains, buffer, args) : NULL;
  if (!state) { return NULL; }
  pid_law(res, state, gains);
  return new_array(res, CHANNELS, 0);
}


PyDoc_STRVAR(
    pid_step_doc,
    "pid_step(state, gains, error, dt, gap, integrate, decay, transfer_time, /)\n--\n\n"
    "Advance the state in place; feedback, proportional, integral, derivative and transfer, (5, 6).");

static PyObject* py_pid_step(PyObject* module, PyObject* const* args, Py_ssize_t count) {
  double buffer[GAINS * CHANNELS], error[CHANNELS], parts[PARTS * CHANNELS], numbers[5];
  const double* gains;
  (void)module;
  double* state = has_count("pid_step", count, 8) ? read_pid(&gains, buffer, args) : NULL;
  if (!state || !read_finite(error, args[2], CHANNELS, 0, "error") ||
      !read_numbers(numbers, args + 3, 5)) {
    return NULL;
  }
  pid_step(parts, state, gains, error, numbers[0], numbers[1] != 0, numbers[2] != 0, numbers[3],
           numbers[4]);
  return new_array(parts, PARTS, CHANNELS);
}


PyDoc_STRVAR(
    limit_twist_doc,
    "limit_twist(last, wanted, linear_speed, linear_change, angular_speed, angular_change, /)\n--\n\n"
    "The twist (6,) within these, and what was done to it, by bits: speed 1, acceleration 2 of the "
    "linear part,\n4 and 8 of the angular part.");

static PyObject* py_limit_twist(PyObject* module, PyObject* const* args, Py_ssize_t count) {
  double last[CHANNELS], wanted[CHANNELS], twist[CHANNELS], n[4];
  (void)module;
  if (!has_count("limit_twist", count, 6) || !read_finite(last, args[0], CHANNELS, 0, "last") ||
      !read_finite(wanted, args[1], CHANNELS, 0, "wanted") || !read_numbers(n, args + 2, 4)) {
    return NULL;
  }
  int done = limit_twist(twist, last, wanted, (double[2]){n[0], n[2]}, (double[2]){n[1], n[3]});
  return Py_BuildValue("Ni", new_array(twist, CHANNELS, 0), done);
}


#define METHOD(name, function) \
  {#name, (PyCFunction)(void (*)(void))function, METH_FASTCALL, name##_doc}

static PyMethodDef methods[] = {
    METHOD(vector, vector),        METHOD(pid_law, py_pid_law),
    METHOD(pid_step, py_pid_step), METHOD(limit_twist, py_limit_twist),
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef definition = {PyModuleDef_HEAD_INIT, .m_name = "_laws",
                                        .m_doc = "Arithmetic of control, in C.", .m_size = -1,
                                        .m_methods = methods};


PyMODINIT_FUNC PyInit__laws(void) {
  import_array();
  return PyModule_Create(&definition);
}

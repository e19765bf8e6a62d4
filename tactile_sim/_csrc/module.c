// Python bindings of the contact solver and the renderer; other files add theirs.

#define IMPORTS_NUMPY
#include "numpy_api.h"

#include <limits.h>

#include "bindings.h"
#include "contact.h"
#include "draw_input.h"
#include "render.h"


// check type, shape and layout; extents below zero match anything
static int check(PyArrayObject* array, const char* name, int type, int rows, int columns) {
  int ndim = columns == 0 ? 1 : 2;
  if (PyArray_TYPE(array) != type || !PyArray_ISCARRAY_RO(array) || PyArray_NDIM(array) != ndim) {
    PyErr_Format(PyExc_TypeError,
                 "%s: wrong type or number of dimensions, or not contiguous, aligned and in native "
                 "byte order",
                 name);
    return 0;
  }
  npy_intp* shape = PyArray_DIMS(array);
  if ((rows >= 0 && shape[0] != rows) || (columns > 0 && shape[1] != columns)) {
    PyErr_Format(PyExc_ValueError, "%s: wrong shape", name);
    return 0;
  }
  // elements are counted in int
  if (PyArray_SIZE(array) > INT_MAX) {
    PyErr_Format(PyExc_ValueError, "%s: too large", name);
    return 0;
  }
  return 1;
}


// the same of an array that is written to
static int check_result(PyArrayObject* array, const char* name, int type, int rows, int columns) {
  return check(array, name, type, rows, columns) && PyArray_FailUnlessWriteable(array, name) == 0;
}


static int check_active(PyArrayObject* active, int nodes) {
  const int32_t* index = PyArray_DATA(active);
  for (npy_intp i = 0; i < PyArray_DIM(active, 0); i++) {
    if (index[i] < 0 || index[i] >= nodes) {
      PyErr_Format(PyExc_IndexError, "active[%zd] = %d: must lie in 0..%d", i, (int)index[i],
                   nodes - 1);
      return 0;
    }
  }
  return 1;
}


PyDoc_STRVAR(
    solve_doc,
    "solve(force, state, residual, normal, compliance, active, friction, max_sweeps, tolerance) -> "
    "int\n\n"
    "Projected Gauss-Seidel over the m active nodes, in place; returns the number of sweeps.\n"
    "force (m,3) float64 N; state (m,) uint8: 0 free, 1 stick, 2 slip; residual (m,3) float32 m;\n"
    "normal (m,3) float64; compliance (3n,3n) float32 m/N; active (m,) int32.");

static PyObject* py_solve(PyObject* self, PyObject* args) {
  PyArrayObject *force, *state, *residual, *normal, *compliance, *active;
  double friction, tolerance;
  int max_sweeps;
  (void)self;
  if (!PyArg_ParseTuple(args, "O!O!O!O!O!O!did", &PyArray_Type, &force, &PyArray_Type, &state,
                        &PyArray_Type, &residual, &PyArray_Type, &normal, &PyArray_Type,
                        &compliance, &PyArray_Type, &active, &friction, &max_sweeps, &tolerance)) {
    return NULL;
  }
  if (!check(active, "active", NPY_INT32, -1, 0)) { return NULL; }
  int m = (int)PyArray_DIM(active, 0);
  if (!check_result(force, "force", NPY_DOUBLE, m, 3) ||
      !check_result(state, "state", NPY_UINT8, m, 0) ||
      !check_result(residual, "residual", NPY_FLOAT, m, 3) ||
      !check(normal, "normal", NPY_DOUBLE, m, 3) ||
      !check(compliance, "compliance", NPY_FLOAT, -1, -1)) {
    return NULL;
  }
  int dof = (int)PyArray_DIM(compliance, 0);
  if (PyArray_DIM(compliance, 1) != dof || !check_active(active, dof / 3)) {
    if (!PyErr_Occurred()) { PyErr_SetString(PyExc_ValueError, "compliance: must be square"); }
    return NULL;
  }

  float* packed = PyMem_RawMalloc((size_t)9 * m * m * sizeof(float) + 1);
  double* blocks = PyMem_RawMalloc((size_t)18 * m * sizeof(double) + 1);
  if (!packed || !blocks) {
    PyMem_RawFree(packed);
    PyMem_RawFree(blocks);
    return PyErr_NoMemory();
  }
  int sweeps;
  Py_BEGIN_ALLOW_THREADS;
  sweeps = contact_solve(PyArray_DATA(force), PyArray_DATA(state), PyArray_DATA(residual),
                         PyArray_DATA(normal), PyArray_DATA(compliance), dof, PyArray_DATA(active),
                         m, friction, max_sweeps, tolerance, packed, blocks);
  Py_END_ALLOW_THREADS;
  PyMem_RawFree(packed);
  PyMem_RawFree(blocks);
  return PyLong_FromLong(sweeps);
}


PyDoc_STRVAR(displacement_doc,
             "displacement(out, force, compliance, active)\n\n"
             "Displacement out (n,3) float32 of all nodes under force (m,3) float64 on the active "
             "ones (m,) int32.");

static PyObject* py_displacement(PyObject* self, PyObject* args) {
  PyArrayObject *out, *force, *compliance, *active;
  (void)self;
  if (!PyArg_ParseTuple(args, "O!O!O!O!", &PyArray_Type, &out, &PyArray_Type, &force, &PyArray_Type,
                        &compliance, &PyArray_Type, &active)) {
    return NULL;
  }
  if (!check(active, "active", NPY_INT32, -1, 0) ||
      !check(compliance, "compliance", NPY_FLOAT, -1, -1)) {
    return NULL;
  }
  int m = (int)PyArray_DIM(active, 0), dof = (int)PyArray_DIM(compliance, 0);
  if (PyArray_DIM(compliance, 1) != dof || dof % 3) {
    PyErr_SetString(PyExc_ValueError, "compliance: must be square, three rows a node");
    return NULL;
  }
  if (!check_result(out, "out", NPY_FLOAT, dof / 3, 3) ||
      !check(force, "force", NPY_DOUBLE, m, 3) || !check_active(active, dof / 3)) {
    return NULL;
  }
  Py_BEGIN_ALLOW_THREADS;
  contact_displacement(PyArray_DATA(out), PyArray_DATA(force), PyArray_DATA(compliance), dof,
                       PyArray_DATA(active), m);
  Py_END_ALLOW_THREADS;
  Py_RETURN_NONE;
}


PyDoc_STRVAR(render_doc,
             "render(image, background, blobs, softness, noise, seed, canvas)\n\n"
             "Draw blobs (n,4) float64 (column, row, radius, gray) over background (h,w) float32 "
             "into image (h,w) uint8;\n"
             "noise (4096,) float32 is drawn from at random by seed, or None; canvas (h,w) float32 "
             "is scratch.");

static PyObject* py_render(PyObject* self, PyObject* args) {
  PyArrayObject *image, *background, *blobs, *canvas;
  PyObject* noise;
  double softness;
  unsigned long long seed;
  (void)self;
  if (!PyArg_ParseTuple(args, "O!O!O!dOKO!", &PyArray_Type, &image, &PyArray_Type, &background,
                        &PyArray_Type, &blobs, &softness, &noise, &seed, &PyArray_Type, &canvas)) {
    return NULL;
  }
  if (!check_result(image, "image", NPY_UINT8, -1, -1)) { return NULL; }
  int height = (int)PyArray_DIM(image, 0), width = (int)PyArray_DIM(image, 1);
  if (!check(background, "background", NPY_FLOAT, height, width) ||
      !check_result(canvas, "canvas", NPY_FLOAT, height, width) ||
      !check(blobs, "blobs", NPY_DOUBLE, -1, 4)) {
    return NULL;
  }
  const float* table = NULL;
  if (noise != Py_None) {
    if (!PyArray_Check(noise) || !check((PyArrayObject*)noise, "noise", NPY_FLOAT, 4096, 0)) {
      if (!PyErr_Occurred()) {
        PyErr_SetString(PyExc_TypeError, "noise: must be an array or None");
      }
      return NULL;
    }
    table = PyArray_DATA((PyArrayObject*)noise);
  }
  Py_BEGIN_ALLOW_THREADS;
  render(PyArray_DATA(image), PyArray_DATA(background), height, width, PyArray_DATA(blobs),
         (int)PyArray_DIM(blobs, 0), softness, table, seed, PyArray_DATA(canvas));
  Py_END_ALLOW_THREADS;
  Py_RETURN_NONE;
}


PyDoc_STRVAR(
    draw_input_doc,
    "draw_input(input, discs, ground, mask, view)\n\n"
    "Draw discs (n,4) float64 (column, row, radius, gray) over the gray levels ground (s,s) "
    "float32 into a\nnetwork's input (s,s) uint8, of which mask (s,s) float32 is left; view: "
    "left, top, width and height of a\ncell, softness, bend, block, level, noise.");

static PyObject* py_draw_input(PyObject* self, PyObject* args) {
  PyArrayObject *input, *discs, *ground, *mask;
  InputView view;
  (void)self;
  if (!PyArg_ParseTuple(args, "O!O!O!O!(ddddddddd)", &PyArray_Type, &input, &PyArray_Type, &discs,
                        &PyArray_Type, &ground, &PyArray_Type, &mask, &view.left, &view.top,
                        &view.width, &view.height, &view.softness, &view.bend, &view.block,
                        &view.level, &view.noise)) {
    return NULL;
  }
  if (!check_result(input, "input", NPY_UINT8, -1, -1)) { return NULL; }
  view.size = (int)PyArray_DIM(input, 0);
  if (!check(input, "input", NPY_UINT8, view.size, view.size) ||
      !check(discs, "discs", NPY_DOUBLE, -1, 4) ||
      !check(ground, "ground", NPY_FLOAT, view.size, view.size) ||
      !check(mask, "mask", NPY_FLOAT, view.size, view.size)) {
    return NULL;
  }
  if (!(view.width > 0 && view.height > 0 && view.softness > 0 && view.block > 0 &&
        view.noise > 0)) {
    PyErr_SetString(PyExc_ValueError,
                    "view: width, height, softness, block and noise must be above 0");
    return NULL;
  }
  float* scratch = PyMem_RawMalloc(draw_input_scratch(&view) * sizeof(float));
  if (!scratch) { return PyErr_NoMemory(); }
  Py_BEGIN_ALLOW_THREADS;
  draw_input(PyArray_DATA(input), &view, PyArray_DATA(discs), (int)PyArray_DIM(discs, 0),
             PyArray_DATA(ground), PyArray_DATA(mask), scratch);
  Py_END_ALLOW_THREADS;
  PyMem_RawFree(scratch);
  Py_RETURN_NONE;
}


static PyMethodDef methods[] = {
    {"solve", py_solve, METH_VARARGS, solve_doc},
    {"displacement", py_displacement, METH_VARARGS, displacement_doc},
    {"render", py_render, METH_VARARGS, render_doc},
    {"draw_input", py_draw_input, METH_VARARGS, draw_input_doc},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef module = {
    PyModuleDef_HEAD_INIT,
    "_contact",
    "Contact and images of simulated sensors, and objects that are pushed.",
    -1,
    methods,
    NULL,
    NULL,
    NULL,
    NULL,
};

PyMODINIT_FUNC PyInit__contact(void) {
  import_array();
  PyObject* made = PyModule_Create(&module);
  if (made && (add_pushed(made) < 0 || add_point_contact(made) < 0)) { Py_CLEAR(made); }
  return made;
}

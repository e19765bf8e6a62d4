// Python bindings of the ideal sensor's contact.

#include "numpy_api.h"

#include "arrays.h"
#include "bindings.h"
#include "point_contact.h"

#define MOST_DEPTHS 1000


// arguments that are borrowed as they are, or from `space` where they have to be converted
typedef struct {
  double space[8][16];
  int used;
} Borrowed;


static const double* borrow(Borrowed* from, PyObject* arg, int rows, int columns,
                            const char* name) {
  return borrow_array(from->space[from->used++], arg, rows, columns, name);
}


// T, point, normal and depth of a contact; returns 0 with an error set
static int read_contact(PointContact* contact, Borrowed* from, PyObject* const* args) {
  contact->T = borrow(from, args[0], 4, 4, "T_surface_sensor");
  contact->point = contact->T ? borrow(from, args[1], 3, 0, "point") : NULL;
  contact->normal = contact->point ? borrow(from, args[2], 3, 0, "normal") : NULL;
  contact->depth = contact->normal ? PyFloat_AsDouble(args[3]) : 0;
  return contact->normal && !PyErr_Occurred();
}


PyDoc_STRVAR(
    drag_doc,
    "point_contact_drag(anchor, turn, *before, *now, limits, /)\n--\n\n"
    "Anchor (3,), turn (rad) and whether it slips. before and now: pose of the sensor, point, normal and "
    "depth;\nlimits (3, n): depths, and the largest shear and turn there.");

static PyObject* py_point_contact_drag(PyObject* module, PyObject* const* args, Py_ssize_t count) {
  Borrowed from = {.used = 0};
  PointContact before, now;
  double anchor[3];
  (void)module;
  if (count != 11) {
    return PyErr_Format(PyExc_TypeError, "point_contact_drag takes 11 arguments");
  }
  if (!read_array(anchor, args[0], 3, 0, "anchor") || !read_contact(&before, &from, args + 2) ||
      !read_contact(&now, &from, args + 6)) {
    return NULL;
  }
  double turn = PyFloat_AsDouble(args[1]);
  if (PyErr_Occurred()) { return NULL; }
  PyArrayObject* tables =
      (PyArrayObject*)PyArray_FROM_OTF(args[10], NPY_DOUBLE, NPY_ARRAY_IN_ARRAY);
  if (!tables) { return NULL; }
  PyObject* res = NULL;
  if (PyArray_NDIM(tables) == 2 && PyArray_DIM(tables, 0) == 3 && PyArray_DIM(tables, 1) > 0 &&
      PyArray_DIM(tables, 1) <= MOST_DEPTHS) {
    int n = (int)PyArray_DIM(tables, 1);
    const double* depth = PyArray_DATA(tables);
    ShearLimits limits = {n, depth, depth + n, depth + 2 * n};
    int slips = point_contact_drag(anchor, &turn, &before, &now, &limits);
    res = Py_BuildValue("NdO", new_array(anchor, 3, 0), turn, slips ? Py_True : Py_False);
  } else {
    PyErr_Format(PyExc_ValueError, "limits: must have shape (3, n), n from 1 to %d", MOST_DEPTHS);
  }
  Py_DECREF(tables);
  return res;
}


PyDoc_STRVAR(
    pose_doc,
    "point_contact_pose(T_fs, turn, *now, anchor, /)\n--\n\n"
    "X_fs (4, 4) of a contact by its geometry's, its turn, and its anchor; None: nothing is sheared.");

static PyObject* py_point_contact_pose(PyObject* module, PyObject* const* args, Py_ssize_t count) {
  Borrowed from = {.used = 0};
  PointContact now;
  double res[16];
  (void)module;
  if (count != 7) { return PyErr_Format(PyExc_TypeError, "point_contact_pose takes 7 arguments"); }
  const double* T_fs = borrow(&from, args[0], 4, 4, "T_fs");
  double turn = PyFloat_AsDouble(args[1]);
  if (!T_fs || PyErr_Occurred() || !read_contact(&now, &from, args + 2)) { return NULL; }
  const double* anchor = args[6] == Py_None ? NULL : borrow(&from, args[6], 3, 0, "anchor");
  if (!anchor && args[6] != Py_None) { return NULL; }
  point_contact_pose(res, T_fs, turn, &now, anchor);
  return new_array(res, 4, 4);
}


PyDoc_STRVAR(
    skin_force_doc,
    "skin_force(T_body_sensor, T_fs, press, stiffness, friction, /)\n--\n\n"
    "Force (3,) N of a tip on a body, in its frame: what presses (N), and its shear times a stiffness "
    "(N/m) up to\nfriction.");

static PyObject* py_skin_force(PyObject* module, PyObject* const* args, Py_ssize_t count) {
  Borrowed from = {.used = 0};
  double numbers[3], res[3];
  (void)module;
  if (count != 5) { return PyErr_Format(PyExc_TypeError, "skin_force takes 5 arguments"); }
  const double* T = borrow(&from, args[0], 4, 4, "T_body_sensor");
  const double* T_fs = T ? borrow(&from, args[1], 4, 4, "T_fs") : NULL;
  if (!T_fs) { return NULL; }
  for (int i = 0; i < 3; i++) { numbers[i] = PyFloat_AsDouble(args[2 + i]); }
  if (PyErr_Occurred()) { return NULL; }
  skin_force(res, T, T_fs, numbers[0], numbers[1], numbers[2]);
  return new_array(res, 3, 0);
}


#define METHOD(name, doc) {#name, (PyCFunction)(void (*)(void))py_##name, METH_FASTCALL, doc}

static PyMethodDef methods[] = {
    METHOD(point_contact_drag, drag_doc),
    METHOD(point_contact_pose, pose_doc),
    METHOD(skin_force, skin_force_doc),
    {NULL, NULL, 0, NULL},
};


int add_point_contact(PyObject* module) {
  return PyModule_AddFunctions(module, methods);
}

// Python module tactile_scene._native: the interface is tactile_scene/shapes, arm.py and safety.py.

#include "arrays.h"
#include "bounds.h"
#include "shapes.h"

#define MOST_BOXES 1000


// ---- shapes ----

// distance (n,) and normal (n, 3) of points (n, 3)
static PyObject* query(PyObject* const* args, Py_ssize_t count, const char* name, ShapeQuery* shape,
                       int numbers) {
  double shape_numbers[8];
  if (!has_count(name, count, 1 + numbers) || !read_numbers(shape_numbers, args + 1, numbers)) {
    return NULL;
  }
  PyArrayObject* points = (PyArrayObject*)PyArray_FROM_OTF(args[0], NPY_DOUBLE, NPY_ARRAY_IN_ARRAY);
  if (!points) { return NULL; }
  if (PyArray_NDIM(points) != 2 || PyArray_DIM(points, 1) != 3) {
    Py_DECREF(points);
    return PyErr_Format(PyExc_ValueError, "points: must have shape (n, 3)");
  }
  npy_intp extents[2] = {PyArray_DIM(points, 0), 3};
  PyObject* distance = PyArray_SimpleNew(1, extents, NPY_DOUBLE);
  PyObject* normal = PyArray_SimpleNew(2, extents, NPY_DOUBLE);
  if (distance && normal) {
    const double* p = PyArray_DATA(points);
    double *d = PyArray_DATA((PyArrayObject*)distance), *n = PyArray_DATA((PyArrayObject*)normal);
    for (npy_intp i = 0; i < extents[0]; i++) { d[i] = shape(n + 3 * i, p + 3 * i, shape_numbers); }
  }
  Py_DECREF(points);
  return Py_BuildValue("NN", distance, normal);
}

#define SHAPE(name, numbers)                                                              \
  static PyObject* py_##name(PyObject* module, PyObject* const* args, Py_ssize_t count) { \
    (void)module;                                                                         \
    return query(args, count, #name, name, numbers);                                      \
  }

SHAPE(box_query, BOX_NUMBERS)
SHAPE(prism_query, PRISM_NUMBERS)
SHAPE(cylinder_query, CYLINDER_NUMBERS)


static PyObject* py_meet(PyObject* module, PyObject* const* args, Py_ssize_t count) {
  double distance, normal[3], T[16], radius;
  Meeting found;
  (void)module;
  if (!has_count("meet", count, 4) || !read_numbers(&distance, args, 1) ||
      !read_array(normal, args[1], 3, 0, "normal") ||
      !read_array(T, args[2], 4, 4, "T_surface_sensor") || !read_numbers(&radius, args + 3, 1)) {
    return NULL;
  }
  meet(&found, distance, normal, T, radius);
  return Py_BuildValue("dNdNN", found.depth, new_array(found.T_fs, 4, 4), found.angle,
                       new_array(found.point, 3, 0), new_array(normal, 3, 0));
}


// ---- arms ----

static PyObject* braked(PyObject* const* args, Py_ssize_t count, const char* name,
                        double result(const Braking*, double)) {
  double n[3];
  if (!has_count(name, count, 3) || !read_numbers(n, args, 3)) { return NULL; }
  Braking braking = {n[1], n[2]};
  return PyFloat_FromDouble(result(&braking, n[0]));
}


static PyObject* py_braking_distance(PyObject* module, PyObject* const* args, Py_ssize_t count) {
  (void)module;
  return braked(args, count, "braking_distance", braking_distance);
}


static PyObject* py_braking_speed(PyObject* module, PyObject* const* args, Py_ssize_t count) {
  (void)module;
  return braked(args, count, "braking_speed", braking_speed);
}


static PyObject* py_shortened(PyObject* module, PyObject* const* args, Py_ssize_t count) {
  double twist[6], limits[2];
  (void)module;
  if (!has_count("shortened", count, 3) || !read_array(twist, args[0], 6, 0, "twist") ||
      !read_numbers(limits, args + 1, 2)) {
    return NULL;
  }
  shorten(twist, limits[0], limits[1]);
  return new_array(twist, 6, 0);
}


// the reasons' numbers in a tuple, which is always the same where there are none
static PyObject* numbers_of(const int* reasons, int count) {
  PyObject* res = PyTuple_New(count);
  for (int i = 0; res && i < count; i++) {
    PyObject* number = PyLong_FromLong(reasons[i]);
    if (number) {
      PyTuple_SET_ITEM(res, i, number);
    } else {
      Py_CLEAR(res);
    }
  }
  return res;
}


PyDoc_STRVAR(
    bounded_doc,
    "bounded(twist, room, boxes, T_base_controlled, T_base_feature, /)\n--\n\n"
    "The part (6,) of a twist that is followed, and the numbers of what makes it less: 0 speed;\n"
    "from 1 on the upper and lower end of each axis of the workspace; 7 depth; 8 shear; from 9 on\n"
    "boxes. room (13,): largest linear and angular speed, acceleration and lead of braking, corners\n"
    "of the workspace, radius of the tip, largest depth and shear; boxes (n, 6): their corners;\n"
    "T_base_feature may be None.");

static PyObject* py_bounded(PyObject* module, PyObject* const* args, Py_ssize_t count) {
  double twist[6], T[16], feature[16];
  union {
    double numbers[ROOM_NUMBERS];
    Room room;
  } space;
  (void)module;
  int felt = count == 5 && args[4] != Py_None;
  if (!has_count("bounded", count, 5) || !read_finite(twist, args[0], 6, 0, "twist") ||
      !read_array(space.numbers, args[1], ROOM_NUMBERS, 0, "room") ||
      !read_pose(T, args[3], "T_base_controlled") ||
      (felt && !read_pose(feature, args[4], "T_base_feature"))) {
    return NULL;
  }
  PyArrayObject* boxes = (PyArrayObject*)PyArray_FROM_OTF(args[2], NPY_DOUBLE, NPY_ARRAY_IN_ARRAY);
  if (!boxes) { return NULL; }
  PyObject* res = NULL;
  npy_intp number = PyArray_NDIM(boxes) == 2 ? PyArray_DIM(boxes, 0) : -1;
  if (number < 0 || PyArray_DIM(boxes, 1) != 6 || number > MOST_BOXES) {
    PyErr_Format(PyExc_ValueError, "boxes: must have shape (n, 6), n at most %d", MOST_BOXES);
  } else {
    Bound few[16], *bounds = number ? PyMem_RawMalloc((size_t)(number + 8) * sizeof(Bound)) : few;
    int some[16], *reasons = number ? PyMem_RawMalloc((size_t)(number + 9) * sizeof(int)) : some;
    if (bounds && reasons) {
      int said = bounded(twist, reasons, bounds, &space.room, PyArray_DATA(boxes), (int)number, T,
                         felt ? feature : NULL);
      res = Py_BuildValue("NN", new_array(twist, 6, 0), numbers_of(reasons, said));
    } else {
      PyErr_NoMemory();
    }
    if (number) {
      PyMem_RawFree(bounds);
      PyMem_RawFree(reasons);
    }
  }
  Py_DECREF(boxes);
  return res;
}


PyDoc_STRVAR(distance_doc,
             "distance(A, B, /)\n--\n\nDistance (m) between the origins of two poses.");

static PyObject* py_distance(PyObject* module, PyObject* const* args, Py_ssize_t count) {
  double buffer[2][16], square = 0;
  const double* T[2];
  (void)module;
  if (!has_count("distance", count, 2)) { return NULL; }
  for (int i = 0; i < 2; i++) {
    T[i] = borrow_array(buffer[i], args[i], 4, 4, i ? "B" : "A");
    if (!T[i]) { return NULL; }
  }
  for (int i = 3; i < 12; i += 4) { square += (T[0][i] - T[1][i]) * (T[0][i] - T[1][i]); }
  return PyFloat_FromDouble(sqrt(square));
}


PyDoc_STRVAR(
    any_differs_doc,
    "any_differs(a, b, by, /)\n--\n\nWhether two twists (6,) differ by more than this in a component; never "
    "where one is not a number.");

static PyObject* py_any_differs(PyObject* module, PyObject* const* args, Py_ssize_t count) {
  double a[6], b[6], by;
  int differs = 0;
  (void)module;
  if (!has_count("any_differs", count, 3) || !read_array(a, args[0], 6, 0, "a") ||
      !read_array(b, args[1], 6, 0, "b") || !read_numbers(&by, args + 2, 1)) {
    return NULL;
  }
  for (int i = 0; i < 6; i++) { differs |= fabs(a[i] - b[i]) > by; }
  return PyBool_FromLong(differs);
}


PyDoc_STRVAR(is_moving_doc,
             "is_moving(twist, /)\n--\n\nWhether any of a twist's six components is not zero.");

static PyObject* py_is_moving(PyObject* module, PyObject* arg) {
  double buffer[6];
  int moves = 0;
  (void)module;
  const double* twist = borrow_array(buffer, arg, 6, 0, "twist");
  for (int i = 0; twist && i < 6; i++) { moves |= twist[i] != 0; }
  return twist ? PyBool_FromLong(moves) : NULL;
}


PyDoc_STRVAR(speed_doc, "speed(twist, /)\n--\n\nThe norm of a twist's translation, m/s.");

static PyObject* py_speed(PyObject* module, PyObject* arg) {
  double buffer[6];
  (void)module;
  const double* v = borrow_array(buffer, arg, 6, 0, "twist");
  return v ? PyFloat_FromDouble(sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])) : NULL;
}


PyDoc_STRVAR(finite_doc,
             "finite(twist, /)\n--\n\nWhether all of a twist's six components are finite.");

static PyObject* py_finite(PyObject* module, PyObject* arg) {
  double buffer[6], zero = 0;
  (void)module;
  const double* twist = borrow_array(buffer, arg, 6, 0, "twist");
  for (int i = 0; twist && i < 6; i++) { zero += 0 * twist[i]; }
  return twist ? PyBool_FromLong(zero == 0) : NULL;
}


#define METHOD(name, doc) {#name, (PyCFunction)(void (*)(void))py_##name, METH_FASTCALL, doc}

static PyMethodDef methods[] = {
    METHOD(box_query, NULL),
    METHOD(prism_query, NULL),
    METHOD(cylinder_query, NULL),
    METHOD(meet, NULL),
    METHOD(braking_distance, NULL),
    METHOD(braking_speed, NULL),
    METHOD(shortened, NULL),
    METHOD(bounded, bounded_doc),
    METHOD(distance, distance_doc),
    METHOD(any_differs, any_differs_doc),
    {"finite", py_finite, METH_O, finite_doc},
    {"is_moving", py_is_moving, METH_O, is_moving_doc},
    {"speed", py_speed, METH_O, speed_doc},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef definition = {PyModuleDef_HEAD_INIT, .m_name = "_native",
                                        .m_doc = "What shapes and arms do at each step, in C.",
                                        .m_size = -1, .m_methods = methods};


PyMODINIT_FUNC PyInit__native(void) {
  import_array();
  return PyModule_Create(&definition);
}

// The Python type of a pushed object's state, and the functions of its foot.

#include "numpy_api.h"

#include "arrays.h"
#include "bindings.h"
#include "pushed.h"

#include <structmember.h>

#define MOST_TIPS 16
#define MOST_EDGES 100000


typedef struct {
  PyObject_HEAD PyObject* edges;  // holds the foot's numbers
  PyObject* numbers;              // and these the floor's
  Pushed body;
} PushedObject;


// the numbers of a foot; returns the array that holds its edges, or NULL with an error set
static PyObject* read_foot(Foot* foot, PyObject* parts) {
  PyObject *edges, *center, *spread;
  if (!PyTuple_Check(parts)) { return PyErr_Format(PyExc_TypeError, "foot: must be a tuple"); }
  if (!PyArg_ParseTuple(parts, "OOO", &edges, &center, &spread)) { return NULL; }
  PyArrayObject* array = (PyArrayObject*)PyArray_FROM_OTF(edges, NPY_DOUBLE, NPY_ARRAY_IN_ARRAY);
  if (!array) { return NULL; }
  if (PyArray_NDIM(array) != 2 || PyArray_DIM(array, 1) != 5 || PyArray_DIM(array, 0) < 3 ||
      PyArray_DIM(array, 0) > MOST_EDGES) {
    PyErr_Format(PyExc_ValueError, "edges: must have shape (n, 5), with 3 to %d rows", MOST_EDGES);
  } else if (read_finite(foot->center, center, 2, 0, "center") &&
             read_finite(foot->spread, spread, 2, 2, "spread")) {
    foot->count = (int)PyArray_DIM(array, 0);
    foot->edges = PyArray_DATA(array);
    return (PyObject*)array;
  }
  Py_DECREF(array);
  return NULL;
}


// the model of a floor: its kind, its numbers (n, 2) or (n, 9), its length; returns the array that
// holds the numbers, None for an ellipsoid, or NULL with an error set
static PyObject* read_floor(FloorModel* model, PyObject* parts) {
  static const char* kinds[] = {"ellipsoid", "points", "polynomial"};
  const char* kind;
  PyObject* numbers;
  *model = (FloorModel){.kind = ELLIPSOID};
  if (!parts || parts == Py_None) { return Py_NewRef(Py_None); }
  if (!PyTuple_Check(parts)) { return PyErr_Format(PyExc_TypeError, "floor: must be a tuple"); }
  if (!PyArg_ParseTuple(parts, "sOd", &kind, &numbers, &model->length)) { return NULL; }
  while (model->kind <= POLYNOMIAL && strcmp(kind, kinds[model->kind])) { model->kind++; }
  if (model->kind > POLYNOMIAL) { return PyErr_Format(PyExc_ValueError, "floor: no '%s'", kind); }
  if (model->kind == ELLIPSOID) { return Py_NewRef(Py_None); }
  PyArrayObject* array = (PyArrayObject*)PyArray_FROM_OTF(numbers, NPY_DOUBLE, NPY_ARRAY_IN_ARRAY);
  if (!array) { return NULL; }
  int width = model->kind == POINTS ? 2 : 9;
  if (PyArray_NDIM(array) != 2 || PyArray_DIM(array, 1) != width || PyArray_DIM(array, 0) < 1 ||
      PyArray_DIM(array, 0) > MOST_POINTS || !(model->length > 0)) {
    Py_DECREF(array);
    return PyErr_Format(PyExc_ValueError,
                        "floor: must have numbers (n, %d), n up to %d, and a length above 0", width,
                        MOST_POINTS);
  }
  model->count = (int)PyArray_DIM(array, 0);
  model->numbers = PyArray_DATA(array);
  return (PyObject*)array;
}


static int init(PyObject* self, PyObject* args, PyObject* keywords) {
  static char* names[] = {"foot",
                          "arm",
                          "T_world_body",
                          "center_of_gravity",
                          "weight",
                          "friction",
                          "center_of_friction",
                          "edge_friction",
                          "edge_way",
                          "friction_tip",
                          "floor",
                          NULL};
  PyObject *foot, *pose, *gravity, *off, *floor = NULL;
  Pushed b = {0};
  if (!PyArg_ParseTupleAndKeywords(args, keywords, "OdOOddOddd|O", names, &foot, &b.arm, &pose,
                                   &gravity, &b.weight, &b.friction_foot, &off, &b.edge_friction,
                                   &b.edge_way, &b.friction_tip, &floor) ||
      !read_pose(b.T, pose, "T_world_body") ||
      !read_finite(b.center_of_gravity, gravity, 3, 0, "center_of_gravity") ||
      !read_finite(b.center_of_friction, off, 2, 0, "center_of_friction")) {
    return -1;
  }
  PyObject* held = read_foot(&b.foot, foot);
  if (!held) { return -1; }
  PyObject* numbers = read_floor(&b.floor, floor);
  if (!numbers) {
    Py_DECREF(held);
    return -1;
  }
  const double* g = b.center_of_gravity;
  for (int i = 0; i < 2; i++) {
    b.pressure[i] = b.T[4 * i] * g[0] + b.T[4 * i + 1] * g[1] + b.T[4 * i + 2] * g[2];
  }
  memcpy(b.upright, b.T, sizeof(b.T));
  b.load = 1;
  b.friction = b.friction_foot;
  PushedObject* object = (PushedObject*)self;
  object->body = b;
  Py_XSETREF(object->edges, held);
  Py_XSETREF(object->numbers, numbers);
  return 0;
}


static void release(PyObject* self) {
  Py_XDECREF(((PushedObject*)self)->edges);
  Py_XDECREF(((PushedObject*)self)->numbers);
  Py_TYPE(self)->tp_free(self);
}


PyDoc_STRVAR(
    tip_doc,
    "tip(T_tool_sensor, T_body_sensor, point, normal, force, along, across)\n--\n\n"
    "What `step` needs to know of a contact: where it is in the body, the tip's force on it and the "
    "skin's stiffness.");

static PyObject* tip(PyObject* self, PyObject* const* args, Py_ssize_t count) {
  double T_tool[16], T_body[16], point[3], normal[3], force[3], stiffness[2];
  Tip known;
  (void)self;
  if (count != 7) { return PyErr_Format(PyExc_TypeError, "tip takes 7 arguments, got %zd", count); }
  if (!read_pose(T_tool, args[0], "T_tool_sensor") ||
      !read_pose(T_body, args[1], "T_body_sensor") || !read_finite(point, args[2], 3, 0, "point") ||
      !read_finite(normal, args[3], 3, 0, "normal") ||
      !read_finite(force, args[4], 3, 0, "force")) {
    return NULL;
  }
  for (int i = 0; i < 2; i++) { stiffness[i] = PyFloat_AsDouble(args[5 + i]); }
  if (PyErr_Occurred()) { return NULL; }
  pushed_tip(&known, T_tool, T_body, point, normal, force, stiffness[0], stiffness[1]);
  return PyBytes_FromStringAndSize((const char*)&known, sizeof(known));
}


static PyObject* touches_of(const Touch* touch, int count) {
  PyObject* res = PyList_New(count);
  for (int i = 0; res && i < count; i++, touch++) {
    PyObject* row = Py_BuildValue("NNNddN", new_array(touch->force, 3, 0),
                                  new_array(touch->point, 3, 0), new_array(touch->normal, 3, 0),
                                  touch->along, touch->across, PyBool_FromLong(touch->slips));
    if (row) {
      PyList_SET_ITEM(res, i, row);
    } else {
      Py_CLEAR(res);
    }
  }
  return res;
}


PyDoc_STRVAR(
    step_doc,
    "step(T_world_tool, tip, ...)\n--\n\n"
    "Move as the tips, each after the pose of its tool, push it. None, or for an object that tilts, or "
    "begins to,\nits touches (force, point, normal, along, across, slips) for `lean`, which is due then.");

static PyObject* step(PyObject* self, PyObject* const* args, Py_ssize_t count) {
  PushedObject* object = (PushedObject*)self;
  Pushed* body = &object->body;
  int tips = (int)(count / 2), edge;
  double poses[MOST_TIPS][16];
  const double* tools[MOST_TIPS];
  Tip tip[MOST_TIPS];
  Touch touch[MOST_TIPS];
  if (!object->edges || count % 2 || tips > MOST_TIPS) {
    return PyErr_Format(PyExc_TypeError, "step takes a pose and a tip for each of at most %d tips",
                        MOST_TIPS);
  }
  for (int i = 0; i < tips; i++) {
    PyObject* known = args[2 * i + 1];
    tools[i] = borrow_array(poses[i], args[2 * i], 4, 4, "T_world_tool");
    if (!tools[i]) { return NULL; }
    if (!PyBytes_Check(known) || PyBytes_GET_SIZE(known) != sizeof(Tip)) {
      return PyErr_Format(PyExc_TypeError, "step: a tip is what the method of this name answers");
    }
    memcpy(tip + i, PyBytes_AS_STRING(known), sizeof(Tip));
  }
  if (!pushed_step(body, touch, tip, tools, tips)) {
    return PyErr_Format(PyExc_ValueError,
                        "pushed object: no motion found after which the floor's friction balances "
                        "its %d tips; take shorter steps, a softer skin or less friction_tip",
                        tips);
  }
  if (body->edge_friction > 0 && (body->inside < 0 || body->tilted > 0)) {
    return touches_of(touch, tips);
  }
  const Foot* foot = &body->foot;
  foot_inside(&edge, foot, body->pressure);
  const double *first = foot->edges + 5 * edge,
               *second = foot->edges + 5 * ((edge + 1) % foot->count);
  pushed_tilt(body, (double[4]){first[0], first[1], second[0], second[1]});
  Py_RETURN_NONE;
}


PyDoc_STRVAR(set_floor_doc,
             "set_floor(friction, center_of_friction)\n--\n\n"
             "The floor where the object is: friction over its foot and the centre, off that of "
             "pressure (m).");

static PyObject* set_floor(PyObject* self, PyObject* const* args, Py_ssize_t count) {
  Pushed* body = &((PushedObject*)self)->body;
  double center[2];
  if (count != 2) {
    return PyErr_Format(PyExc_TypeError, "set_floor takes 2 arguments, got %zd", count);
  }
  double friction = PyFloat_AsDouble(args[0]);
  if (PyErr_Occurred() || !read_finite(center, args[1], 2, 0, "center_of_friction")) {
    return NULL;
  }
  body->friction += friction - body->friction_foot;
  body->friction_foot = friction;
  memcpy(body->center_of_friction, center, sizeof(center));
  Py_RETURN_NONE;
}


PyDoc_STRVAR(
    lean_doc,
    "lean(T_world_body, tilted, edge)\n--\n\n"
    "Take the pose of an object that tilts about an edge (2, 2), the arm (m) of friction over that edge, "
    "0 for one\nthat stands again.");

static PyObject* lean(PyObject* self, PyObject* const* args, Py_ssize_t count) {
  Pushed* body = &((PushedObject*)self)->body;
  double T[16], edge[4];
  if (count != 3) {
    return PyErr_Format(PyExc_TypeError, "lean takes 3 arguments, got %zd", count);
  }
  double tilted = PyFloat_AsDouble(args[1]);
  if (PyErr_Occurred() || !read_pose(T, args[0], "T_world_body") ||
      !read_finite(edge, args[2], 2, 2, "edge")) {
    return NULL;
  }
  memcpy(body->T, T, sizeof(T));
  body->tilted = tilted;
  pushed_tilt(body, edge);
  Py_RETURN_NONE;
}


static PyObject* get_pose(PyObject* self, void* upright) {
  const Pushed* body = &((PushedObject*)self)->body;
  return new_array(upright ? body->upright : body->T, 4, 4);
}


static PyObject* get_pressure(PyObject* self, void* unused) {
  const Pushed* body = &((PushedObject*)self)->body;
  (void)unused;
  return Py_BuildValue("(dd)", body->pressure[0], body->pressure[1]);
}


#define NUMBER(name, text) {#name, T_DOUBLE, offsetof(PushedObject, body.name), READONLY, text}

static PyMemberDef members[] = {
    NUMBER(turn, "since the start, rad"),
    NUMBER(inside, "how far the centre of pressure is inside the foot, m; negative outside"),
    NUMBER(load, "on the floor, over the weight"),
    NUMBER(friction, "over all of the foot"),
    NUMBER(moved, "in the last step, m"),
    {NULL, 0, 0, 0, NULL},
};

static PyGetSetDef properties[] = {
    {"T_world_body", get_pose, NULL, "where it is (4, 4)", NULL},
    {"T_world_upright", get_pose, NULL, "where it would be if it did not tilt (4, 4)", properties},
    {"pressure", get_pressure, NULL,
     "its centre, m, from the origin along the world's axes at the start", NULL},
    {NULL, NULL, NULL, NULL, NULL},
};

#define METHOD(name) {#name, (PyCFunction)(void (*)(void))name, METH_FASTCALL, name##_doc}

static PyMethodDef methods[] = {
    METHOD(tip), METHOD(step), METHOD(set_floor), METHOD(lean), {NULL, NULL, 0, NULL},
};

static PyTypeObject type = {
    PyVarObject_HEAD_INIT(NULL, 0).tp_name = "tactile_sim._contact.PushedBody",
    .tp_doc = "An object on the floor that tips push; tactile_sim/pushed.py is its interface.",
    .tp_basicsize = sizeof(PushedObject),
    .tp_flags = Py_TPFLAGS_DEFAULT,
    .tp_new = PyType_GenericNew,
    .tp_init = init,
    .tp_dealloc = release,
    .tp_methods = methods,
    .tp_members = members,
    .tp_getset = properties,
};


// ---- the foot and its limit surface: documentation in tactile_sim/limit_surface.py ----

// foot and point; returns the array that holds the foot, or NULL with an error set
static PyObject* read_point(Foot* foot, double point[2], PyObject* const* args, Py_ssize_t count) {
  if (count != 2) {
    return PyErr_Format(PyExc_TypeError, "takes a foot and a point, got %zd arguments", count);
  }
  return read_finite(point, args[1], 2, 0, "point") ? read_foot(foot, args[0]) : NULL;
}


static PyObject* py_foot_inside(PyObject* self, PyObject* const* args, Py_ssize_t count) {
  Foot foot;
  double point[2];
  int edge;
  (void)self;
  PyObject* held = read_point(&foot, point, args, count);
  if (!held) { return NULL; }
  double inside = foot_inside(&edge, &foot, point);
  Py_DECREF(held);
  return Py_BuildValue("di", inside, edge);
}


static PyObject* py_foot_edge_share(PyObject* self, PyObject* const* args, Py_ssize_t count) {
  Foot foot;
  double point[2];
  (void)self;
  PyObject* held = read_point(&foot, point, args, count);
  if (!held) { return NULL; }
  double share = foot_edge_share(&foot, point);
  Py_DECREF(held);
  return PyFloat_FromDouble(share);
}


static PyObject* py_return_to_surface(PyObject* self, PyObject* const* args, Py_ssize_t count) {
  double load[3], stiffness[9], motion[3], left[3];
  Floor floor = {0};
  (void)self;
  if (count != 4 && count != 5) {
    return PyErr_Format(PyExc_TypeError, "return_to_surface takes 4 or 5 arguments, got %zd",
                        count);
  }
  floor.force = PyFloat_AsDouble(args[2]);
  floor.torque = PyFloat_AsDouble(args[3]);
  if (PyErr_Occurred() || !read_finite(load, args[0], 3, 0, "load") ||
      !read_finite(stiffness, args[1], 3, 3, "stiffness")) {
    return NULL;
  }
  PyObject* numbers = read_floor(&floor.model, count == 5 ? args[4] : NULL);
  if (!numbers) { return NULL; }
  int found = floor_return(motion, left, load, stiffness, &floor);
  Py_DECREF(numbers);
  if (!found) {
    return PyErr_Format(PyExc_ValueError,
                        "the load exceeds friction where no spring holds the foot");
  }
  return Py_BuildValue("NN", new_array(motion, 3, 0), new_array(left, 3, 0));
}


#define FUNCTION(name) {#name, (PyCFunction)(void (*)(void))py_##name, METH_FASTCALL, NULL}

static PyMethodDef functions[] = {
    FUNCTION(foot_inside),
    FUNCTION(foot_edge_share),
    FUNCTION(return_to_surface),
    {NULL, NULL, 0, NULL},
};


int add_pushed(PyObject* module) {
  return PyModule_AddType(module, &type) < 0 ? -1 : PyModule_AddFunctions(module, functions);
}

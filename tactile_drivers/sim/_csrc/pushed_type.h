// What pushed_type.c adds to the module.

#ifndef TACTILE_DRIVERS_SIM_PUSHED_TYPE_H_
#define TACTILE_DRIVERS_SIM_PUSHED_TYPE_H_

#include <Python.h>

// Add the type of a pushed object; returns -1 with an error set.
int add_pushed_body(PyObject* module);

// A foot is a tuple of its edges (n, 5), centre (2,) and spread (2, 2).
PyObject* py_foot_inside(PyObject* self, PyObject* const* args, Py_ssize_t count);
PyObject* py_foot_edge_share(PyObject* self, PyObject* const* args, Py_ssize_t count);
PyObject* py_return_to_surface(PyObject* self, PyObject* const* args, Py_ssize_t count);

#endif  // TACTILE_DRIVERS_SIM_PUSHED_TYPE_H_

// The part of the Python module that is about SE(3) and the filter's prediction.
#ifndef TACTILE_MODULE_SE3_H_
#define TACTILE_MODULE_SE3_H_

#include <Python.h>

#include "routines.h"

extern const Routines* module_routines;

// use the routines of this instruction set, or the best for null; returns 0 with an error set
int module_se3_select(const char* name);

#define MODULE_SE3_FUNCTIONS(_) \
  _(exp) _(log) _(inverse) _(adjoint) _(left_jacobian) _(inverse_left_jacobian) _(orthonormalized) \
  _(interpolate) _(usable_pose) _(predict) _(innovation)

#define DECLARE(name) \
  PyObject* module_##name(PyObject* module, PyObject* const* args, Py_ssize_t nargs);
MODULE_SE3_FUNCTIONS(DECLARE)
#undef DECLARE

#define MODULE_SE3_METHOD(name) \
  {#name, (PyCFunction)(void(*)(void))module_##name, METH_FASTCALL, NULL},
#define MODULE_SE3_METHODS MODULE_SE3_FUNCTIONS(MODULE_SE3_METHOD)

#endif  // TACTILE_MODULE_SE3_H_

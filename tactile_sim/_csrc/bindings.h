// What the other files of bindings add to the module; each returns -1 with an error set.

#ifndef TACTILE_DRIVERS_SIM_BINDINGS_H_
#define TACTILE_DRIVERS_SIM_BINDINGS_H_

#include <Python.h>

int add_pushed(PyObject* module);
int add_point_contact(PyObject* module);

#endif  // TACTILE_DRIVERS_SIM_BINDINGS_H_

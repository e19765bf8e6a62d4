// Python and NumPy for several files of one module, of which the one that defines IMPORTS_NUMPY
// imports it.

#ifndef TACTILE_DRIVERS_SIM_NUMPY_API_H_
#define TACTILE_DRIVERS_SIM_NUMPY_API_H_

#define PY_SSIZE_T_CLEAN
#define PY_ARRAY_UNIQUE_SYMBOL tactile_sim_contact_numpy
#ifndef IMPORTS_NUMPY
#define NO_IMPORT_ARRAY
#endif
#include <Python.h>
#include <numpy/arrayobject.h>

#endif  // TACTILE_DRIVERS_SIM_NUMPY_API_H_

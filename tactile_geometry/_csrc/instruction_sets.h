// The choice among builds of the same routines for several instruction sets, as a function of the
// Python module. Before it stand Python.h and the names of the table's type and of its two builds:
// ROUTINES, ROUTINES_BASE, ROUTINES_AVX2. A table begins with the `name` of its instruction set.
#ifndef TACTILE_INSTRUCTION_SETS_H_
#define TACTILE_INSTRUCTION_SETS_H_

#include <string.h>

static const ROUTINES* routines = NULL;


// use the routines of this instruction set, or the best for null; returns 0 with an error set
static int select_routines(const char* name) {
  const ROUTINES* found = !name || strcmp(name, ROUTINES_BASE.name) == 0 ? &ROUTINES_BASE : NULL;
#ifdef __x86_64__
  __builtin_cpu_init();
  int has_avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
  if (has_avx2 && (!name || strcmp(name, ROUTINES_AVX2.name) == 0)) { found = &ROUTINES_AVX2; }
#endif
  if (!found) {
    PyErr_Format(PyExc_ValueError, "instruction set '%s': this machine does not have it", name);
    return 0;
  }
  routines = found;
  return 1;
}


static const char instruction_set_doc[] =
    "instruction_set(name=None, /)\n--\n\n"
    "Use the routines for this instruction set: base, and on x86-64 avx2. Answers the one in use.";

static PyObject* instruction_set(PyObject* module, PyObject* const* args, Py_ssize_t nargs) {
  (void)module;
  if (nargs > 1) {
    return PyErr_Format(PyExc_TypeError, "instruction_set takes at most 1 argument, got %zd",
                        nargs);
  }
  if (nargs == 1) {
    const char* name = PyUnicode_AsUTF8(args[0]);
    if (!name || !select_routines(name)) { return NULL; }
  }
  return PyUnicode_FromString(routines->name);
}

#endif  // TACTILE_INSTRUCTION_SETS_H_

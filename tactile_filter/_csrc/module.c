// Python module tactile_filter._fusion: the interface is tactile_filter/fusion.py.
#define TACTILE_IMPORTS_NUMPY
#include "arrays.h"
#include "fusion.h"
#include "module_se3.h"

#define MAX_ITERATIONS 100000


static PyObject* new_pose(const Pose* pose) {
  double mat[16] = {0};
  for (int i = 0; i < 3; i++) {
    memcpy(mat + 4*i, pose->rot + 3*i, 3 * sizeof(double));
    mat[4*i+3] = pose->pos[i];
  }
  mat[15] = 1;
  return new_array(mat, 4, 4);
}


// mean, cov, factor, iterations, status, step
static PyObject* new_result(const FusionOutput* output) {
  PyObject* items[6] = {
    new_pose(&output->mean), new_array(output->cov, 6, 6), new_array(output->factor, 6, 6),
    PyLong_FromLong(output->iterations), PyLong_FromLong(output->status),
    PyFloat_FromDouble(output->step)};
  PyObject* res = PyTuple_New(6);
  for (int i = 0; i < 6; i++) {
    if (!items[i] || !res) {
      for (int j = i; j < 6; j++) {
        Py_XDECREF(items[j]);
      }
      Py_XDECREF(res);
      return NULL;
    }
    PyTuple_SET_ITEM(res, i, items[i]);
  }
  return res;
}


// read one of the Gaussians; returns 0, or -1 with an error set, or 16 * (index of the argument) + what it lacks
static int read_input(FusionInput* input, PyObject* const* args, int index) {
  static const char* const names[4] = {"mean_1", "cov_1", "mean_2", "cov_2"};
  double mean[16], cov[36];
  if (!read_array(mean, args[0], 4, 4, names[2*index])
      || !read_array(cov, args[1], 6, 6, names[2*index+1])) {
    return -1;
  }
  int lack = fusion_set_mean(input, mean);
  if (lack) {
    return 32*index + lack;
  }
  lack = fusion_set_covariance(input, cov);
  return lack ? 32*index + 16 + lack : 0;
}


static const char fuse_doc[] =
  "fuse(mean_1, cov_1, mean_2, cov_2, iterations, order, /)\n--\n\n"
  "The tuple (mean, cov, factor, iterations, status, step), or an int if the inputs cannot be fused:\n"
  "16 * (index of the argument at fault) + what it lacks. order: 2, 4, 0 for the exact Jacobian, or -1\n"
  "for iterations to convergence, `iterations` at most.";

static PyObject* fuse(PyObject* module, PyObject* const* args, Py_ssize_t nargs) {
  (void)module;
  if (nargs != 6) {
    return PyErr_Format(PyExc_TypeError, "fuse takes 6 arguments, got %zd", nargs);
  }
  long iterations = PyLong_AsLong(args[4]), order = PyLong_AsLong(args[5]);
  if (PyErr_Occurred()) {
    return NULL;
  }
  if (iterations < 1 || iterations > MAX_ITERATIONS || order < -1 || order > 4 || order == 1 || order == 3) {
    return PyErr_Format(PyExc_ValueError, "iterations = %ld, order = %ld: out of range", iterations, order);
  }

  FusionInput input[2];
  for (int i = 0; i < 2; i++) {
    int lack = read_input(input + i, args + 2*i, i);
    if (lack) {
      return lack < 0 ? NULL : PyLong_FromLong(lack);
    }
  }
  FusionOutput output;
  int status = order < 0 ? fusion_exact(&output, input, (int)iterations)
                         : fusion_fixed(&output, input, (int)iterations, (int)order);
  return status == FUSION_NO_INFORMATION ? PyLong_FromLong(status) : new_result(&output);
}


static const char check_doc[] =
  "check(mean, cov, /)\n--\n\n0 if the two are a Gaussian that can be fused, else as fuse.";

static PyObject* check(PyObject* module, PyObject* const* args, Py_ssize_t nargs) {
  (void)module;
  if (nargs != 2) {
    return PyErr_Format(PyExc_TypeError, "check takes 2 arguments, got %zd", nargs);
  }
  FusionInput input;
  int lack = read_input(&input, args, 0);
  return lack < 0 ? NULL : PyLong_FromLong(lack);
}


static PyMethodDef methods[] = {
  {"check", (PyCFunction)(void(*)(void))check, METH_FASTCALL, check_doc},
  {"fuse", (PyCFunction)(void(*)(void))fuse, METH_FASTCALL, fuse_doc},
  MODULE_SE3_METHODS
  {NULL, NULL, 0, NULL}
};

static struct PyModuleDef definition = {
  PyModuleDef_HEAD_INIT, "_fusion", "Fusion of Gaussians over SE(3) in C.", -1, methods,
  NULL, NULL, NULL, NULL
};


PyMODINIT_FUNC PyInit__fusion(void) {
  import_array();
  if (!module_se3_select(NULL)) {
    return NULL;
  }
  return PyModule_Create(&definition);
}

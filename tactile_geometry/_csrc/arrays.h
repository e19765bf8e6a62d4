// Arguments and NumPy arrays to and from C arrays, for the one file that imports NumPy.
#ifndef TACTILE_ARRAYS_H_
#define TACTILE_ARRAYS_H_

#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <numpy/arrayobject.h>

#include <math.h>
#include <string.h>


// returns 0 with an error set unless a function was given as many arguments as expected
static inline int has_count(const char* name, Py_ssize_t count, Py_ssize_t expected) {
  if (count == expected) { return 1; }
  PyErr_Format(PyExc_TypeError, "%s takes %zd arguments, got %zd", name, expected, count);
  return 0;
}


// the numbers of some arguments; returns 0 with an error set
static inline int read_numbers(double* res, PyObject* const* args, int count) {
  for (int i = 0; i < count; i++) { res[i] = PyFloat_AsDouble(args[i]); }
  return !PyErr_Occurred();
}


// whether the array has the shape (rows, columns), or (rows,) for columns = 0
static inline int has_shape(PyArrayObject* array, npy_intp rows, npy_intp columns) {
  if (columns == 0) { return PyArray_NDIM(array) == 1 && PyArray_DIM(array, 0) == rows; }
  return PyArray_NDIM(array) == 2 && PyArray_DIM(array, 0) == rows &&
         PyArray_DIM(array, 1) == columns;
}


static inline void set_shape_error(PyArrayObject* array, npy_intp rows, npy_intp columns,
                                   const char* name) {
  PyObject* shape = PyObject_GetAttrString((PyObject*)array, "shape");
  if (!shape) { return; }
  if (columns == 0) {
    PyErr_Format(PyExc_ValueError, "%s: must have shape (%d,), has %S", name, (int)rows, shape);
  } else {
    PyErr_Format(PyExc_ValueError, "%s: must have shape (%d, %d), has %S", name, (int)rows,
                 (int)columns, shape);
  }
  Py_DECREF(shape);
}


// the elements of an argument of this shape (see has_shape): where they lie, or in the buffer if it
// has to be converted; valid as long as the argument; NULL with an error set
static inline const double* borrow_array(double* buffer, PyObject* arg, npy_intp rows,
                                         npy_intp columns, const char* name) {
  if (PyArray_CheckExact(arg)) {
    PyArrayObject* array = (PyArrayObject*)arg;
    if (PyArray_TYPE(array) == NPY_DOUBLE && PyArray_ISCARRAY_RO(array) &&
        has_shape(array, rows, columns)) {
      return PyArray_DATA(array);
    }
  }
  PyArrayObject* array = (PyArrayObject*)PyArray_FROM_OTF(arg, NPY_DOUBLE, NPY_ARRAY_IN_ARRAY);
  if (!array) { return NULL; }
  int fits = has_shape(array, rows, columns);
  if (fits) {
    memcpy(buffer, PyArray_DATA(array), (size_t)(rows * (columns ? columns : 1)) * sizeof(double));
  } else {
    set_shape_error(array, rows, columns, name);
  }
  Py_DECREF(array);
  return fits ? buffer : NULL;
}


// a copy of them; returns 0 with an error set
static inline int read_array(double* res, PyObject* arg, npy_intp rows, npy_intp columns,
                             const char* name) {
  const double* data = borrow_array(res, arg, rows, columns, name);
  if (data && data != res) {
    memcpy(res, data, (size_t)(rows * (columns ? columns : 1)) * sizeof(double));
  }
  return data != NULL;
}


// an array that is neither (rows, columns) nor a stack of these
static inline void set_stack_error(PyArrayObject* array, int rows, int columns, const char* name) {
  PyObject* shape = PyObject_GetAttrString((PyObject*)array, "shape");
  if (shape && columns == 0) {
    PyErr_Format(PyExc_ValueError, "%s: must have shape (%d,), or that behind others, has %S", name,
                 rows, shape);
  } else if (shape) {
    PyErr_Format(PyExc_ValueError, "%s: must have shape (%d, %d), or that behind others, has %S",
                 name, rows, columns, shape);
  }
  Py_XDECREF(shape);
}


// returns 0 with an error set if one of the numbers of an argument is not finite
static inline int all_finite(const double* data, npy_intp count, PyObject* arg, const char* name) {
  double zero = 0;
  for (npy_intp i = 0; i < count; i++) { zero += 0 * data[i]; }
  if (zero == 0) { return 1; }
  PyObject* array = PyArray_FROM_OTF(arg, NPY_DOUBLE, NPY_ARRAY_IN_ARRAY);
  PyObject* list = array ? PyArray_ToList((PyArrayObject*)array) : NULL;
  if (list) { PyErr_Format(PyExc_ValueError, "%s: must be finite, is %S", name, list); }
  Py_XDECREF(list);
  Py_XDECREF(array);
  return 0;
}


// as read_array; not finite is an error, too
static inline int read_finite(double* res, PyObject* arg, npy_intp rows, npy_intp columns,
                              const char* name) {
  return read_array(res, arg, rows, columns, name) &&
         all_finite(res, rows * (columns ? columns : 1), arg, name);
}


// homogeneous matrix of a pose; returns 0 with an error set
static inline int read_pose(double mat[16], PyObject* arg, const char* name) {
  if (!read_finite(mat, arg, 4, 4, name)) { return 0; }
  if (mat[12] == 0 && mat[13] == 0 && mat[14] == 0 && mat[15] == 1) { return 1; }
  PyObject* row = Py_BuildValue("[dddd]", mat[12], mat[13], mat[14], mat[15]);
  if (row) {
    PyErr_Format(PyExc_ValueError, "%s: last row must be [0, 0, 0, 1], is %S", name, row);
    Py_DECREF(row);
  }
  return 0;
}


// new array (rows, columns), or (rows,) for columns = 0
static inline PyObject* new_array(const double* data, npy_intp rows, npy_intp columns) {
  npy_intp dims[2] = {rows, columns};
  PyObject* res = PyArray_SimpleNew(columns ? 2 : 1, dims, NPY_DOUBLE);
  if (res) {
    size_t bytes = (size_t)(rows * (columns ? columns : 1)) * sizeof(double);
    memcpy(PyArray_DATA((PyArrayObject*)res), data, bytes);
  }
  return res;
}

#endif  // TACTILE_ARRAYS_H_

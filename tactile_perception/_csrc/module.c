// Python module tactile_perception._image: the interface is tactile_perception/preprocessing.py.
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <numpy/arrayobject.h>

#include "image.h"

enum { MAX_PIXELS = 1 << 24, SHRINK_MAX_RATIO = 255 };


// 1 if the pixels of a 2-D array are as many as the C functions can count; else 0 with an error set
static int check_size(PyArrayObject* array, const char* name) {
  npy_intp rows = PyArray_DIM(array, 0), cols = PyArray_DIM(array, 1);
  if (rows < 1 || cols < 1 || rows > (MAX_PIXELS - 1) / cols) {
    PyErr_Format(PyExc_ValueError, "%s: must have 1 to 2^24 - 1 pixels, has %zd x %zd", name,
                 (Py_ssize_t)rows, (Py_ssize_t)cols);
    return 0;
  }
  return 1;
}


// 1 if an array is a 2-D image of bytes whose pixels lie side by side; else 0 with an error set
static int check_image(PyArrayObject* array, const char* name, int contiguous) {
  if (PyArray_TYPE(array) != NPY_UINT8 || PyArray_NDIM(array) != 2 ||
      (PyArray_DIM(array, 1) > 1 && PyArray_STRIDE(array, 1) != 1) ||
      (contiguous && !PyArray_IS_C_CONTIGUOUS(array))) {
    PyErr_Format(PyExc_TypeError, "%s: must be uint8 with two axes%s", name,
                 contiguous ? ", contiguous" : " and adjacent columns");
    return 0;
  }
  return check_size(array, name);
}


// 1 if an array is a contiguous image of the shape of `image`; else 0 with an error set
static int check_alike(PyArrayObject* array, const char* name, PyArrayObject* image) {
  if (!check_image(array, name, 1)) { return 0; }
  if (!PyArray_SAMESHAPE(array, image)) {
    PyErr_Format(PyExc_ValueError, "%s: must have the shape of the image", name);
    return 0;
  }
  return 1;
}


// 1 if a result can be written, as check_alike; else 0 with an error set
static int check_result(PyArrayObject* array, const char* name, PyArrayObject* image) {
  return check_alike(array, name, image) && PyArray_FailUnlessWriteable(array, name) == 0;
}


static int rows_of(PyArrayObject* image) {
  return (int)PyArray_DIM(image, 0);
}


static int cols_of(PyArrayObject* image) {
  return (int)PyArray_DIM(image, 1);
}


static const char median5_doc[] =
    "median5(res, image, /)\n--\n\n"
    "res (rows, cols) uint8 = median of 5 x 5 pixels of image (rows, cols).";

static PyObject* py_median5(PyObject* module, PyObject* args) {
  PyArrayObject *res, *image;
  (void)module;
  if (!PyArg_ParseTuple(args, "O!O!", &PyArray_Type, &res, &PyArray_Type, &image) ||
      !check_image(image, "image", 0) || !check_result(res, "res", image)) {
    return NULL;
  }
  median5(PyArray_DATA(res), PyArray_DATA(image), rows_of(image), cols_of(image),
          PyArray_STRIDE(image, 0));
  Py_RETURN_NONE;
}


static const char threshold_doc[] =
    "threshold_mean(res, image, block, offset, mask, /)\n--\n\n"
    "res (rows, cols) uint8 = mask where image is above the rounded mean of block x block pixels\n"
    "less offset, else 0. block: odd, 3 to 255; offset: -255 to 255.";

static PyObject* py_threshold_mean(PyObject* module, PyObject* args) {
  PyArrayObject *res, *image, *mask;
  int block, offset;
  (void)module;
  if (!PyArg_ParseTuple(args, "O!O!iiO!", &PyArray_Type, &res, &PyArray_Type, &image, &block,
                        &offset, &PyArray_Type, &mask) ||
      !check_image(image, "image", 0) || !check_result(res, "res", image) ||
      !check_alike(mask, "mask", image)) {
    return NULL;
  }
  if (block < 3 || block > THRESHOLD_MAX_BLOCK || block % 2 == 0 || offset < -255 || offset > 255) {
    return PyErr_Format(PyExc_ValueError, "block = %d, offset = %d: out of range", block, offset);
  }
  int32_t* scratch = PyMem_Malloc(threshold_scratch(cols_of(image), block) * sizeof(int32_t));
  if (!scratch) { return PyErr_NoMemory(); }
  threshold_mean(PyArray_DATA(res), PyArray_DATA(image), rows_of(image), cols_of(image),
                 PyArray_STRIDE(image, 0), block, offset, PyArray_DATA(mask), scratch);
  PyMem_Free(scratch);
  Py_RETURN_NONE;
}


static const char shrink_doc[] =
    "shrink(res, image, /)\n--\n\n"
    "res (size, size) uint8 = means over equal areas of image (rows, cols).";

static PyObject* py_shrink(PyObject* module, PyObject* args) {
  PyArrayObject *res, *image;
  (void)module;
  if (!PyArg_ParseTuple(args, "O!O!", &PyArray_Type, &res, &PyArray_Type, &image) ||
      !check_image(image, "image", 0) || !check_image(res, "res", 1) ||
      PyArray_FailUnlessWriteable(res, "res") < 0) {
    return NULL;
  }
  int size = rows_of(res);
  if (cols_of(res) != size || size > rows_of(image) || size > cols_of(image) ||
      rows_of(image) / size > SHRINK_MAX_RATIO) {
    return PyErr_Format(PyExc_ValueError, "res: must be square, 1 to 1/%d of the image's size",
                        SHRINK_MAX_RATIO);
  }
  uint32_t* scratch = PyMem_Malloc(shrink_scratch(size, cols_of(image)) * sizeof(uint32_t));
  if (!scratch) { return PyErr_NoMemory(); }
  shrink(PyArray_DATA(res), size, PyArray_DATA(image), rows_of(image), cols_of(image),
         PyArray_STRIDE(image, 0), scratch);
  PyMem_Free(scratch);
  Py_RETURN_NONE;
}


static const char largest_change_doc[] =
    "largest_change(image, reference, noise, window, /)\n--\n\n"
    "Largest mean over window x window pixels of max(0, |image - reference| - noise), to 1e-5.\n"
    "All (rows, cols) float32 within 0 and 1; window: 1 to 129. More than 1, or NaN, counts as 1.";

static PyObject* py_largest_change(PyObject* module, PyObject* args) {
  PyArrayObject* images[3];
  int window;
  (void)module;
  if (!PyArg_ParseTuple(args, "O!O!O!i", &PyArray_Type, images, &PyArray_Type, images + 1,
                        &PyArray_Type, images + 2, &window)) {
    return NULL;
  }
  for (int i = 0; i < 3; i++) {
    if (PyArray_TYPE(images[i]) != NPY_FLOAT || PyArray_NDIM(images[i]) != 2 ||
        !PyArray_ISCARRAY_RO(images[i]) || !PyArray_SAMESHAPE(images[i], images[0])) {
      return PyErr_Format(PyExc_TypeError,
                          "image, reference, noise: must be float32 of one shape with two "
                          "axes, contiguous, aligned and in native byte order");
    }
  }
  if (!check_size(images[0], "image")) { return NULL; }
  if (window < 1 || window > CHANGE_MAX_WINDOW) {
    return PyErr_Format(PyExc_ValueError, "window = %d: must be 1 to %d", window,
                        CHANGE_MAX_WINDOW);
  }
  uint32_t* scratch = PyMem_Malloc(change_scratch(cols_of(images[0]), window) * sizeof(uint32_t));
  if (!scratch) { return PyErr_NoMemory(); }
  double res =
      largest_change(PyArray_DATA(images[0]), PyArray_DATA(images[1]), PyArray_DATA(images[2]),
                     rows_of(images[0]), cols_of(images[0]), window, scratch);
  PyMem_Free(scratch);
  return PyFloat_FromDouble(res);
}


static PyMethodDef methods[] = {
    {"median5", py_median5, METH_VARARGS, median5_doc},
    {"threshold_mean", py_threshold_mean, METH_VARARGS, threshold_doc},
    {"shrink", py_shrink, METH_VARARGS, shrink_doc},
    {"largest_change", py_largest_change, METH_VARARGS, largest_change_doc},
    {NULL, NULL, 0, NULL}};

static struct PyModuleDef definition = {PyModuleDef_HEAD_INIT,
                                        "_image",
                                        "Pre-processing of images in C.",
                                        -1,
                                        methods,
                                        NULL,
                                        NULL,
                                        NULL,
                                        NULL};


PyMODINIT_FUNC PyInit__image(void) {
  import_array();
  return PyModule_Create(&definition);
}

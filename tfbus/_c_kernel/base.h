/* What all parts of the kernel share: the types' names, references, arguments, and the arithmetic of a row.
 *
 * A row is a rigid transform as seven floats: the translation x, y, z and the quaternion x, y, z, w. `compose` and
 * `invert` are those of tfbus/rows.py, term by term, so both kernels give the same bits. The types are static and made
 * once a process, by the module's exec slot. A name that the kernel keeps is a plain str (`plain_string`): comparing
 * and hashing it runs no Python code, and so nothing can change while the kernel compares.
 */
#ifndef Py_LIMITED_API
#define Py_LIMITED_API 0x030b0000
#endif
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <structmember.h>

#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>
#ifdef _WIN32
#include <windows.h>
#else
#include <time.h>
#endif

#if defined(_MSC_VER)
#pragma fp_contract(off)
#elif defined(__clang__)
#pragma STDC FP_CONTRACT OFF
#endif

#define OBJECT(pointer) ((PyObject *)(pointer))
#define FAST(function) ((PyCFunction)(void (*)(void))(function))

enum { WIDTH = 7 };             /* floats in a row: translation x, y, z and quaternion x, y, z, w */
#define ROW_SIZE (WIDTH * sizeof(double))
#define SAMPLE_SIZE (sizeof(int64_t) + ROW_SIZE)
#define ROUNDING 1e-15 /* as in tfbus.rows */
#define NORM_TOLERANCE 0.01 /* as in tfbus.rows */
#define EXACT_GAP ((uint64_t)1 << 53) /* ns; a greater difference of stamps is inexact as a float, and Python divides */

static PyTypeObject *ColumnsType, *SampleType, *BlockType, *HistoryType, *ChainType, *HeldType, *PathsType, *EdgeType;
static PyTypeObject *JudgeType, *ParkedType, *LineType, *FeedType, *IntakeType, *MethodType;
static PyObject *empty_string, *raise_string, *drop_string, *at_string, *paths_string, *memory_string;
static PyObject *child_string, *source_at_string, *fixed_string, *max_age_string, *not_before_string;
static PyObject *not_after_string, *tolerance_string, *max_gap_string, *extrapolate_string, *nanoseconds_string;
static PyObject *policy_use_string, *error_string, *namers_string, *passed_string, *create_future_string, *set_result_string;
static PyObject *end_string, *name_string, *expire_string, *abort_string, *orders_string, *forget_string;
static PyObject *locked_string, *mask_string; /* CPython keeps each new object of a name that it looks up in a class */
static PyObject *bound_method; /* types.MethodType */
static PyObject *array_type;   /* numpy.ndarray; NULL until somebody asks with an array */

static const double identity[WIDTH] = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0};

/* References ------------------------------------------------------------------------------------------------------- */

/* The functions for the garbage collector of a type whose first fields are references: `fields` of them. */
#define REFERENCES(name, fields)                                                                        \
    static int name##_traverse(PyObject *self, visitproc visit, void *arg)                              \
    {                                                                                                   \
        return visit_references(self, fields, visit, arg);                                              \
    }                                                                                                   \
    static int name##_clear(PyObject *self)                                                             \
    {                                                                                                   \
        return clear_references(self, fields);                                                          \
    }                                                                                                   \
    static void name##_dealloc(PyObject *self)                                                          \
    {                                                                                                   \
        PyObject_GC_UnTrack(self);                                                                      \
        clear_references(self, fields);                                                                 \
        let_go_of(self);                                                                                \
    }

static int
visit_references(PyObject *self, int fields, visitproc visit, void *arg)
{
    PyObject **references = (PyObject **)(self + 1);
    Py_VISIT(Py_TYPE(self));
    for (int i = 0; i < fields; i++) {
        Py_VISIT(references[i]);
    }
    return 0;
}

static int
clear_references(PyObject *self, int fields)
{
    PyObject **references = (PyObject **)(self + 1);
    for (int i = 0; i < fields; i++) {
        Py_CLEAR(references[i]);
    }
    return 0;
}

/* The end of each deallocation. */
static void
let_go_of(PyObject *self)
{
    PyTypeObject *type = Py_TYPE(self);
    ((freefunc)PyType_GetSlot(type, Py_tp_free))(self);
    Py_DECREF(type);
}

static PyObject *
imported(const char *module, const char *name)
{
    PyObject *found = PyImport_ImportModule(module);
    PyObject *value = found == NULL ? NULL : PyObject_GetAttrString(found, name);
    Py_XDECREF(found);
    return value;
}

/* Whether an object is an array of numpy, and of no derived class; -1 for an error. */
static int
is_array(PyObject *object)
{
    /* Not when the kernel is loaded, because `tfbus --version` does without numpy. */
    if (array_type == NULL && (array_type = imported("numpy", "ndarray")) == NULL) {
        return -1;
    }
    return OBJECT(Py_TYPE(object)) == array_type;
}

/* Whether a call has no keyword arguments; else there is an error. */
static int
has_no_keywords(PyObject *kwargs)
{
    if (kwargs != NULL && PyDict_Size(kwargs) > 0) {
        PyErr_SetString(PyExc_TypeError, "this takes no keyword arguments");
        return 0;
    }
    return 1;
}

/* Open the buffers of two arguments, each as its flags say; 0 for an error, and then neither is open. */
static int
open_buffers(PyObject *const *args, Py_ssize_t nargs, Py_buffer *buffers, int first, int second)
{
    if (nargs != 2) {
        PyErr_SetString(PyExc_TypeError, "this takes two buffers");
        return 0;
    }
    if (PyObject_GetBuffer(args[0], &buffers[0], first) < 0) {
        return 0;
    }
    if (PyObject_GetBuffer(args[1], &buffers[1], second) < 0) {
        PyBuffer_Release(&buffers[0]);
        return 0;
    }
    return 1;
}

static void
close_buffers(Py_buffer *buffers)
{
    PyBuffer_Release(&buffers[1]);
    PyBuffer_Release(&buffers[0]);
}

/* Rows ------------------------------------------------------------------------------------------------------------ */

static PyObject *
boxed_row(const double *row)
{
    PyObject *boxed = PyTuple_New(WIDTH);
    if (boxed == NULL) {
        return NULL;
    }
    for (int i = 0; i < WIDTH; i++) {
        PyObject *number = PyFloat_FromDouble(row[i]);
        if (number == NULL || PyTuple_SetItem(boxed, i, number) < 0) {
            Py_DECREF(boxed);
            return NULL;
        }
    }
    return boxed;
}

static int
read_row(PyObject *boxed, double *row)
{
    if (!PyTuple_Check(boxed) || PyTuple_Size(boxed) != WIDTH) {
        PyErr_SetString(PyExc_TypeError, "a row is a tuple of seven floats");
        return -1;
    }
    for (int i = 0; i < WIDTH; i++) {
        row[i] = PyFloat_AsDouble(PyTuple_GetItem(boxed, i));
        if (row[i] == -1.0 && PyErr_Occurred()) {
            return -1;
        }
    }
    return 0;
}

static int
read_stamp(PyObject *number, int64_t *stamp)
{
    long long value = PyLong_AsLongLong(number);
    if (value == -1 && PyErr_Occurred()) {
        return -1;
    }
    *stamp = value;
    return 0;
}

/* As `read_stamp`, for a question about stored samples. The sum of a stamp and a duration may be beyond all stamps:
 * then `*beyond` is the side, 1 or -1, else 0. */
static int
read_instant(PyObject *number, int64_t *stamp, int *beyond)
{
    const long long value = PyLong_AsLongLongAndOverflow(number, beyond);
    if (value == -1 && *beyond == 0 && PyErr_Occurred()) {
        return -1;
    }
    *stamp = value;
    return 0;
}

/* A plain str, so that comparing and hashing it runs no Python code; a new reference. */
static PyObject *
plain_string(PyObject *value)
{
    if (PyUnicode_CheckExact(value)) {
        Py_INCREF(value);
        return value;
    }
    if (!PyUnicode_Check(value)) {
        PyErr_SetString(PyExc_TypeError, "a name must be a str");
        return NULL;
    }
    return PyUnicode_FromObject(value);
}

/* A plain str of an object, whose offset is `closure`. */
static PyObject *
string_of(PyObject *self, void *closure)
{
    PyObject *value = *(PyObject **)((char *)self + (size_t)closure);
    if (value == NULL) {
        PyErr_SetString(PyExc_AttributeError, "it was not initialised");
        return NULL;
    }
    Py_INCREF(value);
    return value;
}

static int
set_string_of(PyObject *self, PyObject *value, void *closure)
{
    PyObject **place = (PyObject **)((char *)self + (size_t)closure);
    if (value == NULL) {
        PyErr_SetString(PyExc_AttributeError, "it cannot be deleted");
        return -1;
    }
    if ((value = plain_string(value)) == NULL) {
        return -1;
    }
    PyObject *old = *place;
    *place = value;
    Py_XDECREF(old);
    return 0;
}

/* The row of a @ b: tfbus.rows.compose. `out` may be `b`. Inlined, so that a product of many rows stays in registers. */
static inline Py_ALWAYS_INLINE void
compose(const double *a, const double *b, double *out)
{
    const double ai = a[3], aj = a[4], ak = a[5], aw = a[6];
    const double x = b[0], y = b[1], z = b[2], bi = b[3], bj = b[4], bk = b[5], bw = b[6];
    const double tx = 2.0 * (aj * z - ak * y);
    const double ty = 2.0 * (ak * x - ai * z);
    const double tz = 2.0 * (ai * y - aj * x);
    out[0] = a[0] + (x + aw * tx + aj * tz - ak * ty);
    out[1] = a[1] + (y + aw * ty + ak * tx - ai * tz);
    out[2] = a[2] + (z + aw * tz + ai * ty - aj * tx);
    out[3] = aw * bi + ai * bw + aj * bk - ak * bj;
    out[4] = aw * bj - ai * bk + aj * bw + ak * bi;
    out[5] = aw * bk + ai * bj - aj * bi + ak * bw;
    out[6] = aw * bw - ai * bi - aj * bj - ak * bk;
}

/* The row of the inverse: tfbus.rows.invert. */
static void
invert(const double *a, double *out)
{
    const double x = a[0], y = a[1], z = a[2], qx = -a[3], qy = -a[4], qz = -a[5], qw = a[6];
    const double tx = 2.0 * (qy * z - qz * y);
    const double ty = 2.0 * (qz * x - qx * z);
    const double tz = 2.0 * (qx * y - qy * x);
    out[0] = -(x + qw * tx + qy * tz - qz * ty);
    out[1] = -(y + qw * ty + qz * tx - qx * tz);
    out[2] = -(z + qw * tz + qx * ty - qy * tx);
    out[3] = qx;
    out[4] = qy;
    out[5] = qz;
    out[6] = qw;
}

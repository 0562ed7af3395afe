/* The compiled kernel: samples, the history of an edge, a path, the plain answer and the plain commit.
 *
 * The Python twins, which tfbus/_kernel.pyi names, are its definition. Both give the same bits, so every sum below is
 * added in the order of tfbus/rows.py, and the compiler must not fuse a multiplication with an addition
 * (-ffp-contract=off). A case that is not plain is handed back to Python by None, False or a count. There is no policy
 * and no text of a transform error here.
 *
 * While a function touches a history, it runs no Python code, allocates no object that the garbage collector tracks,
 * and keeps the interpreter's lock, so other threads see each call as one step. Only the answers at many stamps are
 * made without that lock, from blocks that nobody changes while they have a reader.
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
#define EXACT_GAP ((uint64_t)1 << 53) /* ns; a greater difference of stamps is inexact as a float, and Python divides */

static PyTypeObject *SampleType, *BlockType, *HistoryType, *ChainType, *HeldType, *PathsType, *EdgeType;
static PyTypeObject *JudgeType, *ParkedType, *LineType, *FeedType, *IntakeType, *MethodType;
static PyObject *empty_string, *raise_string, *drop_string, *at_string, *paths_string, *memory_string;
static PyObject *bound_method; /* types.MethodType */
static PyObject *array_type;   /* numpy.ndarray */

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

/* The row of a @ b: tfbus.rows.compose. `out` may be `b`. */
static void
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

/* Sample: the base of TransformStamped ----------------------------------------------------------------------------- */

typedef struct {
    PyObject_HEAD
    PyObject *parent, *child, *authority; /* plain str; NULL until `_fields` was set */
    PyObject *fields;                     /* the six fields as a tuple, once somebody has read it */
    int64_t stamp;
    double row[WIDTH];
    char is_static;
} Sample;

static int
sample_is_set(const Sample *self)
{
    if (self->authority == NULL) {
        PyErr_SetString(PyExc_AttributeError, "_fields");
        return 0;
    }
    return 1;
}

static PyObject *
sample_row(Sample *self, void *Py_UNUSED(closure))
{
    if (!sample_is_set(self)) {
        return NULL;
    }
    if (self->fields != NULL) {
        PyObject *row = PyTuple_GetItem(self->fields, 3);
        Py_XINCREF(row);
        return row;
    }
    return boxed_row(self->row);
}

static PyObject *
sample_square(Sample *self, void *Py_UNUSED(closure))
{
    const double *row = self->row;
    return sample_is_set(self) ? PyFloat_FromDouble(row[0] * row[0] + row[1] * row[1] + row[2] * row[2]) : NULL;
}

static PyObject *
sample_fields(Sample *self, void *Py_UNUSED(closure))
{
    if (!sample_is_set(self)) {
        return NULL;
    }
    if (self->fields == NULL) {
        PyObject *row = boxed_row(self->row);
        PyObject *stamp = PyLong_FromLongLong(self->stamp);
        if (row != NULL && stamp != NULL) {
            PyObject *is_static = self->is_static ? Py_True : Py_False;
            PyObject *made = PyTuple_Pack(6, self->parent, self->child, stamp, row, self->authority, is_static);
            /* While the garbage collector ran, another thread may have made it. */
            if (self->fields == NULL) {
                self->fields = made;
            } else {
                Py_XDECREF(made);
            }
        }
        Py_XDECREF(row);
        Py_XDECREF(stamp);
    }
    Py_XINCREF(self->fields);
    return self->fields;
}

static int
sample_set_fields(Sample *self, PyObject *fields, void *Py_UNUSED(closure))
{
    if (fields == NULL || !PyTuple_Check(fields) || PyTuple_Size(fields) != 6) {
        PyErr_SetString(PyExc_TypeError, "the fields are parent, child, stamp, row, authority and static");
        return -1;
    }
    int64_t stamp;
    double row[WIDTH];
    int is_static = PyObject_IsTrue(PyTuple_GetItem(fields, 5));
    if (is_static < 0 || read_stamp(PyTuple_GetItem(fields, 2), &stamp) < 0
        || read_row(PyTuple_GetItem(fields, 3), row) < 0) {
        return -1;
    }
    PyObject *parent = plain_string(PyTuple_GetItem(fields, 0));
    PyObject *child = parent == NULL ? NULL : plain_string(PyTuple_GetItem(fields, 1));
    PyObject *authority = child == NULL ? NULL : plain_string(PyTuple_GetItem(fields, 4));
    if (authority == NULL) {
        Py_XDECREF(parent);
        Py_XDECREF(child);
        return -1;
    }
    PyObject *old[] = {self->parent, self->child, self->authority, self->fields};
    self->parent = parent;
    self->child = child;
    self->authority = authority;
    self->fields = NULL;
    self->stamp = stamp;
    memcpy(self->row, row, ROW_SIZE);
    self->is_static = (char)is_static;
    for (int i = 0; i < 4; i++) {
        Py_XDECREF(old[i]);
    }
    return 0;
}

static PyObject *
sample_stamp(Sample *self, void *Py_UNUSED(closure))
{
    return sample_is_set(self) ? PyLong_FromLongLong(self->stamp) : NULL;
}

static PyObject *
sample_static(Sample *self, void *Py_UNUSED(closure))
{
    return sample_is_set(self) ? PyBool_FromLong(self->is_static) : NULL;
}

static void
sample_dealloc(Sample *self)
{
    Py_XDECREF(self->parent);
    Py_XDECREF(self->child);
    Py_XDECREF(self->authority);
    Py_XDECREF(self->fields);
    let_go_of(OBJECT(self));
}

static PyMemberDef sample_members[] = {
    {"parent", T_OBJECT_EX, offsetof(Sample, parent), READONLY,
     PyDoc_STR("The frame that the transform maps into; the target, in an answer.")},
    {"child", T_OBJECT_EX, offsetof(Sample, child), READONLY,
     PyDoc_STR("The frame that the transform maps from; the source, in an answer.")},
    {"authority", T_OBJECT_EX, offsetof(Sample, authority), READONLY, PyDoc_STR("The sender; empty in an answer.")},
    {NULL}
};

static PyGetSetDef sample_getset[] = {
    {"_fields", (getter)sample_fields, (setter)sample_set_fields,
     PyDoc_STR("Parent, child, stamp, row, authority and static."), NULL},
    {"_row", (getter)sample_row, NULL, PyDoc_STR("The transform as seven floats."), NULL},
    {"_square", (getter)sample_square, NULL, PyDoc_STR("The square of the magnitude of the translation, in m2."), NULL},
    {"stamp", (getter)sample_stamp, NULL, PyDoc_STR("Nanoseconds; never `LATEST`."), NULL},
    {"static", (getter)sample_static, NULL, PyDoc_STR("Whether it holds at every stamp."), NULL},
    {NULL}
};

static PyType_Slot sample_slots[] = {
    {Py_tp_doc, (void *)PyDoc_STR("The fields of a stamped transform; they become objects when they are read.")},
    {Py_tp_dealloc, sample_dealloc},
    {Py_tp_members, sample_members},
    {Py_tp_getset, sample_getset},
    {0, NULL}
};

static PyType_Spec sample_spec = {
    "tfbus._kernel.Sample", sizeof(Sample), 0, Py_TPFLAGS_DEFAULT | Py_TPFLAGS_BASETYPE, sample_slots
};

/* Block: the memory of a history ----------------------------------------------------------------------------------- */

/* The stamps of all samples, then their rows. A reader reads the samples that the block had when the reading began.
 * While a block has readers, its history only appends samples, and takes another block for every other change. */
typedef struct {
    PyObject_VAR_HEAD
    Py_ssize_t readers; /* how many read it besides its history */
} Block;

static int64_t *
block_stamps(const Block *block)
{
    return (int64_t *)((char *)block + sizeof(Block));
}

static double *
block_rows(const Block *block)
{
    return (double *)(block_stamps(block) + Py_SIZE((PyObject *)block));
}

static Py_ssize_t
block_capacity(const Block *block)
{
    return Py_SIZE((PyObject *)block);
}

static int
block_getbuffer(Block *self, Py_buffer *view, int flags)
{
    const Py_ssize_t size = block_capacity(self) * (Py_ssize_t)SAMPLE_SIZE;
    if (PyBuffer_FillInfo(view, (PyObject *)self, block_stamps(self), size, 1, flags) < 0) {
        return -1;
    }
    self->readers++;
    return 0;
}

static void
block_releasebuffer(Block *self, Py_buffer *Py_UNUSED(view))
{
    self->readers--;
}

static void
block_dealloc(PyObject *self)
{
    let_go_of(OBJECT(self));
}

static PyType_Slot block_slots[] = {
    {Py_tp_doc, (void *)PyDoc_STR("The samples of a history as a read-only buffer.")},
    {Py_tp_dealloc, block_dealloc},
    {Py_bf_getbuffer, block_getbuffer},
    {Py_bf_releasebuffer, block_releasebuffer},
    {0, NULL}
};

static PyType_Spec block_spec = {
    "tfbus._kernel.Block", sizeof(Block), (int)SAMPLE_SIZE,
    Py_TPFLAGS_DEFAULT | Py_TPFLAGS_DISALLOW_INSTANTIATION | Py_TPFLAGS_IMMUTABLETYPE, block_slots
};

/* History ---------------------------------------------------------------------------------------------------------- */

typedef struct {
    PyObject_HEAD
    PyObject *parent, *authority; /* plain str, of the newest sample */
    Block *block;                 /* NULL until there is a sample */
    Py_ssize_t start, end;        /* the samples in the window */
    int64_t keep;                 /* ns; -1 for ever */
    char mixed;                   /* whether the samples name several parents */
} History;

/* The stamp before which samples have left the window. */
static int64_t
horizon_at(const History *self, int64_t newest)
{
    if (self->keep < 0 || newest < INT64_MIN + self->keep) {
        return INT64_MIN;
    }
    return newest - self->keep;
}

/* The first of `count` sorted stamps that is not less than `at`. */
static Py_ssize_t
lower_bound(const int64_t *stamps, Py_ssize_t count, int64_t at)
{
    Py_ssize_t low = 0;
    if (count > 16 && stamps[0] < at && at < stamps[count - 1]) {
        /* Samples mostly come at a steady rate: look first at the place that a steady rate gives. */
        const double part = (double)((uint64_t)at - (uint64_t)stamps[0]);
        const double whole = (double)((uint64_t)stamps[count - 1] - (uint64_t)stamps[0]);
        const Py_ssize_t guess = (Py_ssize_t)(part / whole * (double)(count - 1));
        const Py_ssize_t before = guess - 2, behind = guess + 3;
        if (behind < count && stamps[behind] >= at) {
            count = behind + 1;
        }
        if (before > 0 && stamps[before] < at) {
            low = before + 1;
            count -= low;
        }
    }
    /* Without a branch that depends on the stamps, because no processor can foresee it. */
    while (count > 1) {
        const Py_ssize_t half = count >> 1;
        low += stamps[low + half - 1] < at ? half : 0;
        count -= half;
    }
    return low + (count == 1 && stamps[low] < at);
}

/* Put the samples in the window into a block of its own, at the front, with room for `more`, and some beyond. */
static int
history_rehouse(History *self, Py_ssize_t more)
{
    const Py_ssize_t most = PY_SSIZE_T_MAX / (Py_ssize_t)SAMPLE_SIZE / 4;
    const Py_ssize_t count = self->end - self->start;
    if (count > most || more > most) {
        PyErr_NoMemory();
        return -1;
    }
    Block *block = (Block *)PyType_GenericAlloc(BlockType, count + more + (count + more) / 8 + 7);
    if (block == NULL) {
        return -1;
    }
    if (count > 0) {
        memcpy(block_stamps(block), block_stamps(self->block) + self->start, count * sizeof(int64_t));
        memcpy(block_rows(block), block_rows(self->block) + WIDTH * self->start, count * ROW_SIZE);
    }
    Block *old = self->block;
    self->block = block;
    self->start = 0;
    self->end = count;
    Py_XDECREF(OBJECT(old));
    return 0;
}

/* Make room for some samples behind the last. */
static int
history_reserve(History *self, Py_ssize_t more)
{
    if (self->block != NULL && more <= block_capacity(self->block) - self->end) {
        return 0;
    }
    const Py_ssize_t count = self->end - self->start;
    /* In place, if nobody else reads the block and the move pays off. */
    if (self->block != NULL && self->block->readers == 0 && self->start > count / 8
        && more <= block_capacity(self->block) - count && block_capacity(self->block) <= 2 * count + 16) {
        memmove(block_stamps(self->block), block_stamps(self->block) + self->start, count * sizeof(int64_t));
        memmove(block_rows(self->block), block_rows(self->block) + WIDTH * self->start, count * ROW_SIZE);
        self->start = 0;
        self->end = count;
        return 0;
    }
    return history_rehouse(self, more);
}

static int
history_push(History *self, int64_t stamp, const double *row)
{
    if (history_reserve(self, 1) < 0) {
        return -1;
    }
    block_stamps(self->block)[self->end] = stamp;
    memcpy(block_rows(self->block) + WIDTH * self->end, row, ROW_SIZE);
    self->end++;
    return 0;
}

/* Forget the samples that have left the window. */
static void
history_slide(History *self)
{
    const int64_t *stamps = block_stamps(self->block);
    const int64_t horizon = horizon_at(self, stamps[self->end - 1]);
    while (stamps[self->start] < horizon) {
        self->start++;
    }
}

static int
same_string(PyObject *a, PyObject *b)
{
    return a == b || (a != NULL && b != NULL && PyUnicode_Compare(a, b) == 0);
}

/* Whether a sample only continues a history. All strings are plain ones. */
static int
history_continues(const History *self, PyObject *parent, int64_t stamp, PyObject *authority)
{
    return self->end > self->start && !self->mixed && stamp > block_stamps(self->block)[self->end - 1]
        && same_string(parent, self->parent) && same_string(authority, self->authority);
}

static int
history_init(History *self, PyObject *args, PyObject *kwargs)
{
    PyObject *parent, *keep;
    int64_t window = -1;
    if (!has_no_keywords(kwargs) || !PyArg_ParseTuple(args, "UO:History", &parent, &keep)) {
        return -1;
    }
    if (keep != Py_None && read_stamp(keep, &window) < 0) {
        return -1;
    }
    if ((parent = plain_string(parent)) == NULL) {
        return -1;
    }
    PyObject *old[] = {self->parent, self->authority, (PyObject *)self->block};
    self->parent = parent;
    Py_INCREF(empty_string);
    self->authority = empty_string;
    self->block = NULL;
    self->start = self->end = 0;
    self->keep = window;
    self->mixed = 0;
    for (int i = 0; i < 3; i++) {
        Py_XDECREF(old[i]);
    }
    return 0;
}

static PyObject *
history_append(History *self, PyObject *const *args, Py_ssize_t count)
{
    int64_t stamp;
    double row[WIDTH];
    if (count != 4) {
        PyErr_SetString(PyExc_TypeError, "append takes parent, stamp, row and authority");
        return NULL;
    }
    if (!PyUnicode_CheckExact(args[0]) || !PyUnicode_CheckExact(args[3])) {
        Py_RETURN_FALSE;
    }
    if (read_stamp(args[1], &stamp) < 0 || read_row(args[2], row) < 0) {
        return NULL;
    }
    if (!history_continues(self, args[0], stamp, args[3])) {
        Py_RETURN_FALSE;
    }
    if (history_push(self, stamp, row) < 0) {
        return NULL;
    }
    history_slide(self);
    Py_RETURN_TRUE;
}

static PyObject *
history_push_method(History *self, PyObject *const *args, Py_ssize_t count)
{
    int64_t stamp;
    double row[WIDTH];
    if (count != 2) {
        PyErr_SetString(PyExc_TypeError, "push takes a stamp and a row");
        return NULL;
    }
    if (read_stamp(args[0], &stamp) < 0 || read_row(args[1], row) < 0) {
        return NULL;
    }
    if (self->end > self->start && stamp <= block_stamps(self->block)[self->end - 1]) {
        PyErr_SetString(PyExc_ValueError, "a pushed sample must be newer than all others");
        return NULL;
    }
    if (history_push(self, stamp, row) < 0) {
        return NULL;
    }
    history_slide(self);
    Py_RETURN_NONE;
}

/* push_many(stamps, rows): int64 of shape (n,) and float64 of shape (n, 7), both contiguous. */
static PyObject *
history_push_many(History *self, PyObject *const *args, Py_ssize_t nargs)
{
    Py_buffer buffers[2], *const stamps = &buffers[0], *const rows = &buffers[1];
    if (!open_buffers(args, nargs, buffers, PyBUF_SIMPLE, PyBUF_SIMPLE)) {
        return NULL;
    }
    const Py_ssize_t size = (Py_ssize_t)sizeof(int64_t), count = stamps->len / size;
    int done = 0;
    if (stamps->len % size != 0 || rows->len % (Py_ssize_t)ROW_SIZE != 0
        || rows->len / (Py_ssize_t)ROW_SIZE != count) {
        PyErr_SetString(PyExc_ValueError, "each stamp needs a row of seven floats");
    } else if (count == 0) {
        done = 1;
    } else if (history_reserve(self, count) == 0) {
        int64_t *own = block_stamps(self->block) + self->end;
        Py_ssize_t i = self->end == self->start ? 1 : 0;
        memcpy(own, stamps->buf, stamps->len);
        while (i < count && own[i - 1] < own[i]) {
            i++;
        }
        if (i < count) {
            PyErr_SetString(PyExc_ValueError, "pushed samples must be newer than all others, and in order");
        } else {
            memcpy(block_rows(self->block) + WIDTH * self->end, rows->buf, rows->len);
            self->end += count;
            history_slide(self);
            done = 1;
        }
    }
    close_buffers(buffers);
    if (!done) {
        return NULL;
    }
    Py_RETURN_NONE;
}

/* The number of samples in the window before an instant. */
static Py_ssize_t
history_before(const History *self, int64_t stamp, int beyond)
{
    const Py_ssize_t count = self->end - self->start;
    if (count == 0 || beyond != 0) {
        return beyond > 0 ? count : 0;
    }
    return lower_bound(block_stamps(self->block) + self->start, count, stamp);
}

static PyObject *
history_find(History *self, PyObject *number)
{
    int64_t stamp;
    int beyond;
    if (read_instant(number, &stamp, &beyond) < 0) {
        return NULL;
    }
    return PyLong_FromSsize_t(history_before(self, stamp, beyond));
}

static PyObject *
history_between(History *self, PyObject *const *args, Py_ssize_t nargs)
{
    int64_t low, high;
    int low_beyond, high_beyond;
    if (nargs != 2) {
        PyErr_SetString(PyExc_TypeError, "between takes two stamps");
        return NULL;
    }
    if (read_instant(args[0], &low, &low_beyond) < 0 || read_instant(args[1], &high, &high_beyond) < 0) {
        return NULL;
    }
    const Py_ssize_t count = self->end - self->start;
    if (count == 0) {
        return Py_BuildValue("nn", (Py_ssize_t)0, (Py_ssize_t)0);
    }
    const int64_t *stamps = block_stamps(self->block) + self->start;
    const Py_ssize_t from_low = history_before(self, low, low_beyond);
    const Py_ssize_t from_high = history_before(self, high, high_beyond);
    const int hits = low_beyond == 0 && from_low < count && stamps[from_low] == low;
    return Py_BuildValue("nn", from_low > 0 && !hits ? from_low - 1 : from_low, from_high < count ? from_high + 1 : count);
}

/* The place of a sample in the block, by its index in the window; -1 for an error. */
static Py_ssize_t
place_of(const History *self, PyObject *number)
{
    const Py_ssize_t index = PyLong_AsSsize_t(number);
    if (index == -1 && PyErr_Occurred()) {
        return -1;
    }
    if (index < 0 || index >= self->end - self->start) {
        PyErr_SetString(PyExc_IndexError, "no sample has this index");
        return -1;
    }
    return self->start + index;
}

static PyObject *
history_stamp(History *self, PyObject *number)
{
    const Py_ssize_t place = place_of(self, number);
    return place < 0 ? NULL : PyLong_FromLongLong(block_stamps(self->block)[place]);
}

static PyObject *
history_sample(History *self, PyObject *number)
{
    double row[WIDTH];
    const Py_ssize_t place = place_of(self, number);
    if (place < 0) {
        return NULL;
    }
    /* Copied, because making a tuple may run Python code, by the garbage collector. */
    const long long stamp = block_stamps(self->block)[place];
    memcpy(row, block_rows(self->block) + WIDTH * place, ROW_SIZE);
    PyObject *boxed = boxed_row(row);
    return boxed == NULL ? NULL : Py_BuildValue("LN", stamp, boxed);
}

static PyObject *
history_put(History *self, PyObject *const *args, Py_ssize_t count)
{
    int64_t stamp;
    double row[WIDTH];
    if (count != 3) {
        PyErr_SetString(PyExc_TypeError, "put takes an index, a stamp and a row");
        return NULL;
    }
    /* The place last, because reading a row may run Python code. */
    if (read_stamp(args[1], &stamp) < 0 || read_row(args[2], row) < 0) {
        return NULL;
    }
    Py_ssize_t place = place_of(self, args[0]);
    if (place < 0) {
        return NULL;
    }
    const Py_ssize_t index = place - self->start;
    const int replaces = block_stamps(self->block)[place] == stamp;
    if (!replaces && history_reserve(self, 1) < 0) {
        return NULL;
    }
    if (self->block->readers > 0 && history_rehouse(self, 1) < 0) {
        return NULL;
    }
    /* It may have been moved. */
    place = self->start + index;
    const Py_ssize_t behind = self->end - place;
    int64_t *stamps = block_stamps(self->block) + place;
    double *rows = block_rows(self->block) + WIDTH * place;
    if (!replaces) {
        memmove(stamps + 1, stamps, behind * sizeof(int64_t));
        memmove(rows + WIDTH, rows, behind * ROW_SIZE);
        self->end++;
        stamps[0] = stamp;
    }
    memcpy(rows, row, ROW_SIZE);
    Py_RETURN_NONE;
}

static PyObject *
history_clear(History *self, PyObject *Py_UNUSED(ignored))
{
    Block *old = self->block;
    self->block = NULL;
    self->start = self->end = 0;
    Py_XDECREF(OBJECT(old));
    Py_RETURN_NONE;
}

static PyObject *
history_take(History *self, PyObject *other)
{
    if (!PyObject_TypeCheck(other, HistoryType)) {
        PyErr_SetString(PyExc_TypeError, "take takes a History");
        return NULL;
    }
    const History *from = (const History *)other;
    if (other == (PyObject *)self) {
        Py_RETURN_NONE;
    }
    Block *old = self->block;
    const Py_ssize_t start = self->start, end = self->end;
    Py_XINCREF(OBJECT(from->block));
    self->block = from->block;
    self->start = from->start;
    self->end = from->end;
    if (history_rehouse(self, 1) < 0) {
        Py_XDECREF(OBJECT(self->block));
        self->block = old;
        self->start = start;
        self->end = end;
        return NULL;
    }
    Py_XDECREF(OBJECT(old));
    Py_RETURN_NONE;
}

/* columns(first, end, wanted): a view of the block, where the stamps begin (bytes), the same view, where the rows begin,
 * the number of floats a row, and the number of samples. As nothing is copied, the unwanted samples are not left out. */
static PyObject *
history_columns(History *self, PyObject *const *args, Py_ssize_t nargs)
{
    if (nargs != 2 && nargs != 3) {
        PyErr_SetString(PyExc_TypeError, "columns takes the first index, the end and the wanted stamps");
        return NULL;
    }
    Py_ssize_t first = PyLong_AsSsize_t(args[0]), end = PyLong_AsSsize_t(args[1]);
    if ((first == -1 || end == -1) && PyErr_Occurred()) {
        return NULL;
    }
    const Py_ssize_t count = self->end - self->start;
    end = end < count ? end : count;
    if (first < 0 || first >= end) {
        return Py_BuildValue("ynynin", "", (Py_ssize_t)0, "", (Py_ssize_t)0, WIDTH, (Py_ssize_t)0);
    }
    Block *block = self->block;
    const Py_ssize_t at = self->start + first;
    const Py_ssize_t rows = (Py_ssize_t)sizeof(int64_t) * block_capacity(block) + (Py_ssize_t)ROW_SIZE * at;
    /* Making the view may run Python code, by the garbage collector. */
    Py_INCREF(OBJECT(block));
    block->readers++;
    PyObject *view = PyMemoryView_FromObject(OBJECT(block));
    block->readers--;
    Py_DECREF(OBJECT(block));
    if (view == NULL) {
        return NULL;
    }
    PyObject *found = Py_BuildValue("OnOnin", view, (Py_ssize_t)sizeof(int64_t) * at, view, rows, WIDTH, end - first);
    Py_DECREF(view);
    return found;
}

static PyObject *
history_oldest(History *self, void *Py_UNUSED(closure))
{
    if (self->end == self->start) {
        Py_RETURN_NONE;
    }
    return PyLong_FromLongLong(block_stamps(self->block)[self->start]);
}

static PyObject *
history_newest(History *self, void *Py_UNUSED(closure))
{
    if (self->end == self->start) {
        Py_RETURN_NONE;
    }
    return PyLong_FromLongLong(block_stamps(self->block)[self->end - 1]);
}

static PyObject *
history_newest_record(History *self, void *Py_UNUSED(closure))
{
    if (self->end == self->start) {
        return PyBytes_FromStringAndSize(NULL, 0);
    }
    char record[sizeof(int64_t) + ROW_SIZE];
    memcpy(record, block_stamps(self->block) + self->end - 1, sizeof(int64_t));
    memcpy(record + sizeof(int64_t), block_rows(self->block) + WIDTH * (self->end - 1), ROW_SIZE);
    return PyBytes_FromStringAndSize(record, sizeof record);
}

static PyObject *
history_count(History *self, void *Py_UNUSED(closure))
{
    return PyLong_FromSsize_t(self->end - self->start);
}

static PyObject *
history_horizon(History *self, void *Py_UNUSED(closure))
{
    if (self->end == self->start) {
        return PyLong_FromLongLong(INT64_MIN);
    }
    return PyLong_FromLongLong(horizon_at(self, block_stamps(self->block)[self->end - 1]));
}

static PyObject *
history_keep(History *self, void *Py_UNUSED(closure))
{
    if (self->keep < 0) {
        Py_RETURN_NONE;
    }
    return PyLong_FromLongLong(self->keep);
}

static int
history_set_keep(History *self, PyObject *value, void *Py_UNUSED(closure))
{
    int64_t keep = -1;
    if (value == NULL || (value != Py_None && read_stamp(value, &keep) < 0)) {
        if (value == NULL) {
            PyErr_SetString(PyExc_AttributeError, "keep");
        }
        return -1;
    }
    if (keep < 0 && value != Py_None) {
        keep = 0;
    }
    self->keep = keep;
    if (self->end > self->start) {
        history_slide(self);
    }
    return 0;
}

static void
history_dealloc(History *self)
{
    Py_XDECREF(self->parent);
    Py_XDECREF(self->authority);
    Py_XDECREF(OBJECT(self->block));
    let_go_of(OBJECT(self));
}

static PyObject *history_row(History *self, PyObject *number);

static PyMethodDef history_methods[] = {
    {"append", FAST(history_append), METH_FASTCALL,
     PyDoc_STR("append(parent, stamp, row, authority): store a sample that continues the history; else do nothing.")},
    {"push", FAST(history_push_method), METH_FASTCALL, PyDoc_STR("push(stamp, row): store the newest sample.")},
    {"push_many", FAST(history_push_many), METH_FASTCALL,
     PyDoc_STR("push_many(stamps, rows): store the newest samples, from contiguous arrays of shape (n,) and (n, 7).")},
    {"put", FAST(history_put), METH_FASTCALL,
     PyDoc_STR("put(index, stamp, row): store a sample before another, or in its place if the stamps are equal.")},
    {"find", (PyCFunction)history_find, METH_O, PyDoc_STR("find(stamp): the index of the first sample not before it.")},
    {"between", FAST(history_between), METH_FASTCALL,
     PyDoc_STR("between(low, high): the index of the last sample up to `low`, and behind the first from `high` on.")},
    {"stamp", (PyCFunction)history_stamp, METH_O, PyDoc_STR("stamp(index): the stamp of a sample.")},
    {"sample", (PyCFunction)history_sample, METH_O, PyDoc_STR("sample(index): the stamp and the row of a sample.")},
    {"row", (PyCFunction)history_row, METH_O, PyDoc_STR("row(at): the row at a stamp; None if it is not plain.")},
    {"clear", (PyCFunction)history_clear, METH_NOARGS, PyDoc_STR("Forget all samples.")},
    {"take", (PyCFunction)history_take, METH_O, PyDoc_STR("take(other): hold a copy of another history's samples.")},
    {"columns", FAST(history_columns), METH_FASTCALL,
     PyDoc_STR("columns(first, end, wanted=None): the memory of some samples, which nothing changes while it is held.")},
    {NULL}
};

static PyGetSetDef history_getset[] = {
    {"parent", string_of, set_string_of, PyDoc_STR("Of the newest sample."), (void *)offsetof(History, parent)},
    {"authority", string_of, set_string_of, PyDoc_STR("Of the newest sample."), (void *)offsetof(History, authority)},
    {"keep", (getter)history_keep, (setter)history_set_keep, PyDoc_STR("Length of the window in ns, or None."), NULL},
    {"count", (getter)history_count, NULL, PyDoc_STR("The number of samples in the window."), NULL},
    {"oldest", (getter)history_oldest, NULL, PyDoc_STR("The oldest stamp in the window, or None."), NULL},
    {"newest", (getter)history_newest, NULL, PyDoc_STR("The newest stamp, or None."), NULL},
    {"newest_record", (getter)history_newest_record, NULL,
     PyDoc_STR("The newest stamp and its row, 64 bytes; empty if there is no moving sample."), NULL},
    {"horizon", (getter)history_horizon, NULL, PyDoc_STR("Samples before this stamp have left the window."), NULL},
    {NULL}
};

static PyMemberDef history_members[] = {
    {"mixed", T_BOOL, offsetof(History, mixed), 0, PyDoc_STR("Whether the samples name several parents.")},
    {NULL}
};

static PyType_Slot history_slots[] = {
    {Py_tp_doc, (void *)PyDoc_STR("The moving samples of one edge in its window, in the order of their stamps.")},
    {Py_tp_new, PyType_GenericNew},
    {Py_tp_init, history_init},
    {Py_tp_dealloc, history_dealloc},
    {Py_tp_methods, history_methods},
    {Py_tp_members, history_members},
    {Py_tp_getset, history_getset},
    {0, NULL}
};

static PyType_Spec history_spec = {
    "tfbus._kernel.History", sizeof(History), 0, Py_TPFLAGS_DEFAULT | Py_TPFLAGS_BASETYPE, history_slots
};

/* Interpolation ---------------------------------------------------------------------------------------------------- */

/* The samples of an edge, as they were at one moment. */
typedef struct {
    const int64_t *stamps;
    const double *rows;
    Py_ssize_t count;
} Samples;

/* The two samples round a stamp. */
typedef struct {
    int64_t before, after;
    const double *a, *b; /* their rows; `a` is NULL if `b` has the stamp */
} Segment;

/* The rotation from one sample to the next: tfbus.rows.interpolate up to the fraction. */
typedef struct {
    double angle, scale;
    char turns, flipped;
} Turn;

typedef enum { ANSWERED, MISSING, NOT_PLAIN } Status;

static Samples
samples_of(const History *edge)
{
    Samples samples = {NULL, NULL, edge->end - edge->start};
    if (samples.count > 0) {
        samples.stamps = block_stamps(edge->block) + edge->start;
        samples.rows = block_rows(edge->block) + WIDTH * edge->start;
    }
    return samples;
}

static Status
find_segment(const Samples *samples, int64_t at, Segment *segment)
{
    if (samples->count == 0 || at < samples->stamps[0] || at > samples->stamps[samples->count - 1]) {
        return MISSING;
    }
    const Py_ssize_t i = lower_bound(samples->stamps, samples->count, at);
    segment->after = samples->stamps[i];
    segment->a = NULL;
    segment->b = samples->rows + WIDTH * i;
    if (segment->after == at) {
        return ANSWERED;
    }
    segment->before = samples->stamps[i - 1];
    segment->a = segment->b - WIDTH;
    return (uint64_t)segment->after - (uint64_t)segment->before > EXACT_GAP ? NOT_PLAIN : ANSWERED;
}

enum { LANES = 32 }; /* rows that are made at once */

/* Each step for all rows, because the steps of one row depend on each other, and the rows do not. */
static void
find_turns(const Segment *segments, Turn *turns, Py_ssize_t count)
{
    for (Py_ssize_t i = 0; i < count; i++) {
        const double *a = segments[i].a, *b = segments[i].b;
        turns[i].turns = turns[i].flipped = 0;
        if (a != NULL) {
            const double dot = a[3] * b[3] + a[4] * b[4] + a[5] * b[5] + a[6] * b[6];
            turns[i].angle = fabs(dot);
            turns[i].turns = -1.0 < dot && dot < 1.0;
            turns[i].flipped = dot < 0.0;
        }
    }
    for (Py_ssize_t i = 0; i < count; i++) {
        if (turns[i].turns) {
            const double cosine = turns[i].angle;
            turns[i].scale = 1.0 / sqrt((1.0 - cosine) * (1.0 + cosine));
            turns[i].angle = acos(cosine);
        }
    }
}

/* The rows of `count` lanes; lane i lies in segments[which[i]] at stamps[i]. In `out`, the next lane is `lane_step`
 * floats on, and the next float of the same row `float_step`. */
static inline void
blend(const Segment *segments, const Turn *turns, const unsigned char *which, const int64_t *stamps, Py_ssize_t count,
      double *out, Py_ssize_t lane_step, Py_ssize_t float_step)
{
    double fractions[LANES], of_a[LANES], of_b[LANES];
    for (Py_ssize_t i = 0; i < count; i++) {
        const Segment *segment = &segments[which[i]];
        const Turn *turn = &turns[which[i]];
        if (segment->a != NULL) {
            /* Neither is more than EXACT_GAP. */
            const int64_t elapsed = (int64_t)((uint64_t)stamps[i] - (uint64_t)segment->before);
            const int64_t gap = (int64_t)((uint64_t)segment->after - (uint64_t)segment->before);
            const double fraction = fractions[i] = (double)elapsed / (double)gap;
            of_a[i] = turn->turns ? turn->angle - fraction * turn->angle : 1.0 - fraction;
            of_b[i] = turn->turns ? fraction * turn->angle : fraction;
        }
    }
    for (Py_ssize_t i = 0; i < count; i++) {
        const Turn *turn = &turns[which[i]];
        if (turn->turns) {
            of_a[i] = sin(of_a[i]) * turn->scale;
            of_b[i] = sin(of_b[i]) * turn->scale;
        }
    }
    for (Py_ssize_t i = 0; i < count; i++) {
        const double *a = segments[which[i]].a, *b = segments[which[i]].b;
        double *row = out + lane_step * i;
        if (a == NULL) {
            for (int k = 0; k < WIDTH; k++) {
                row[float_step * k] = b[k];
            }
            continue;
        }
        const double share = turns[which[i]].flipped ? -of_b[i] : of_b[i];
        for (int k = 0; k < 3; k++) {
            row[float_step * k] = a[k] + fractions[i] * (b[k] - a[k]);
        }
        for (int k = 3; k < WIDTH; k++) {
            row[float_step * k] = of_a[i] * a[k] + share * b[k];
        }
    }
}

static PyObject *
history_row(History *self, PyObject *number)
{
    int overflow;
    double row[WIDTH];
    const long long at = PyLong_AsLongLongAndOverflow(number, &overflow);
    if (at == -1 && PyErr_Occurred()) {
        return NULL;
    }
    const Samples samples = samples_of(self);
    Segment segment;
    if (overflow || self->mixed || find_segment(&samples, at, &segment) != ANSWERED) {
        Py_RETURN_NONE;
    }
    Turn turn;
    const int64_t stamp = at;
    const unsigned char first = 0;
    find_turns(&segment, &turn, 1);
    blend(&segment, &turn, &first, &stamp, 1, row, WIDTH, 1);
    return boxed_row(row);
}

/* Chain: the edges between two frames ------------------------------------------------------------------------------ */

typedef struct {
    History *edge; /* borrowed; NULL for a run of static edges, which is one row */
    double row[WIDTH];
} Step;

typedef struct {
    PyObject_HEAD
    PyObject *sides[2];   /* the steps from the source up and from the target up, as tuples, which own the edges */
    Step *steps;          /* the same in a row */
    Py_ssize_t up, down;  /* the number of each */
    Py_ssize_t moving;    /* how many are edges */
} Chain;

static int
chain_clear(Chain *self)
{
    Step *steps = self->steps;
    self->steps = NULL;
    self->up = self->down = self->moving = 0;
    PyMem_Free(steps);
    Py_CLEAR(self->sides[0]);
    Py_CLEAR(self->sides[1]);
    return 0;
}

static int
chain_init(Chain *self, PyObject *args, PyObject *kwargs)
{
    PyObject *sides[2];
    if (!has_no_keywords(kwargs)
        || !PyArg_ParseTuple(args, "O!O!:Chain", &PyTuple_Type, &sides[0], &PyTuple_Type, &sides[1])) {
        return -1;
    }
    const Py_ssize_t up = PyTuple_Size(sides[0]), down = PyTuple_Size(sides[1]);
    Step *steps = PyMem_Calloc((size_t)(up + down + 1), sizeof(Step));
    if (steps == NULL) {
        PyErr_NoMemory();
        return -1;
    }
    Py_ssize_t moving = 0;
    for (Py_ssize_t i = 0; i < up + down; i++) {
        PyObject *step = i < up ? PyTuple_GetItem(sides[0], i) : PyTuple_GetItem(sides[1], i - up);
        if (PyObject_TypeCheck(step, HistoryType)) {
            steps[i].edge = (History *)step;
            moving++;
        } else if (read_row(step, steps[i].row) < 0) {
            PyMem_Free(steps);
            return -1;
        }
    }
    /* Not before, because reading a row may run Python code. */
    if (self->steps != NULL) {
        PyMem_Free(steps);
        PyErr_SetString(PyExc_RuntimeError, "a Chain is initialised once, because another thread may read it");
        return -1;
    }
    Py_INCREF(sides[0]);
    Py_INCREF(sides[1]);
    self->sides[0] = sides[0];
    self->sides[1] = sides[1];
    self->steps = steps;
    self->up = up;
    self->down = down;
    self->moving = moving;
    return 0;
}

static const unsigned char each[LANES] = {0,  1,  2,  3,  4,  5,  6,  7,  8,  9,  10, 11, 12, 13, 14, 15,
                                          16, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 29, 30, 31};

/* Source in target at a stamp. */
static Status
chain_at(const Chain *self, int64_t at, double *out)
{
    const Py_ssize_t steps = self->up + self->down;
    double below[WIDTH];
    memcpy(out, identity, ROW_SIZE);
    for (Py_ssize_t first = 0; first < steps; first += LANES) {
        const Py_ssize_t count = steps - first < LANES ? steps - first : LANES;
        Segment segments[LANES];
        Turn turns[LANES];
        int64_t stamps[LANES];
        double rows[LANES][WIDTH];
        for (Py_ssize_t i = 0; i < count; i++) {
            const Step *step = &self->steps[first + i];
            stamps[i] = at;
            if (step->edge == NULL) {
                segments[i].a = NULL;
                segments[i].b = step->row;
                continue;
            }
            if (step->edge->mixed) {
                return NOT_PLAIN;
            }
            const Samples samples = samples_of(step->edge);
            const Status status = find_segment(&samples, at, &segments[i]);
            if (status != ANSWERED) {
                return status;
            }
        }
        find_turns(segments, turns, count);
        blend(segments, turns, each, stamps, count, rows[0], WIDTH, 1);
        for (Py_ssize_t i = 0; i < count; i++) {
            double *side = first + i < self->up ? out : below;
            if (first + i == 0 || first + i == self->up) {
                memcpy(side, rows[i], ROW_SIZE);
            } else {
                compose(rows[i], side, side);
            }
        }
    }
    if (self->down > 0) {
        double inverse[WIDTH];
        invert(below, inverse);
        compose(inverse, out, out);
    }
    return ANSWERED;
}

/* Whether every edge has samples and something moves; then `stamp` is the newest one that all have reached. */
static int
chain_newest(const Chain *self, int64_t *stamp)
{
    int64_t common = INT64_MAX;
    for (Py_ssize_t i = 0; i < self->up + self->down; i++) {
        const History *edge = self->steps[i].edge;
        if (edge == NULL) {
            continue;
        }
        if (edge->end == edge->start) {
            return 0;
        }
        const int64_t newest = block_stamps(edge->block)[edge->end - 1];
        if (newest < common) {
            common = newest;
        }
    }
    *stamp = common;
    return self->moving > 0;
}

static PyObject *
chain_row(Chain *self, PyObject *number)
{
    int overflow;
    double row[WIDTH];
    const long long at = PyLong_AsLongLongAndOverflow(number, &overflow);
    if (at == -1 && PyErr_Occurred()) {
        return NULL;
    }
    if (overflow || chain_at(self, at, row) != ANSWERED) {
        Py_RETURN_NONE;
    }
    return boxed_row(row);
}

static PyObject *
chain_latest(Chain *self, PyObject *Py_UNUSED(ignored))
{
    int64_t stamp;
    if (!chain_newest(self, &stamp)) {
        Py_RETURN_NONE;
    }
    return PyLong_FromLongLong(stamp);
}

/* Held: the samples of a chain as they were at one moment, for many answers ----------------------------------------- */

/* The state of each step of a chain; empty for static ones. */
typedef struct {
    Samples samples;
    Segment last; /* the segment that was used last, which holds for all stamps between its two; none if equal */
    Turn turn;    /* the turn of `last` */
    Block *block; /* which it reads, or NULL */
} Seen;

typedef struct {
    PyObject_HEAD
    Chain *chain;
    Seen *seen; /* one a step */
    Py_ssize_t count; /* of these; the garbage collector may have cleared the chain before this ends */
    char busy;  /* whether a thread works on `seen` */
} Held;

/* Note the samples of each edge as they are now; NULL without an error if an edge is not plain. */
static Seen *
chain_look(const Chain *self)
{
    const Py_ssize_t count = self->up + self->down;
    Seen *seen = PyMem_Calloc((size_t)count + 1, sizeof(Seen));
    if (seen == NULL) {
        PyErr_NoMemory();
        return NULL;
    }
    for (Py_ssize_t i = 0; i < count; i++) {
        const History *edge = self->steps[i].edge;
        if (edge != NULL) {
            if (edge->mixed) {
                PyMem_Free(seen);
                return NULL;
            }
            seen[i].samples = samples_of(edge);
        }
    }
    return seen;
}

/* Keep others from changing the samples that were noted, until `let_go`. */
static void
keep_hold(const Chain *chain, Seen *seen)
{
    for (Py_ssize_t i = 0; i < chain->up + chain->down; i++) {
        Block *block = chain->steps[i].edge == NULL ? NULL : chain->steps[i].edge->block;
        if (block != NULL) {
            Py_INCREF(OBJECT(block));
            block->readers++;
            seen[i].block = block;
        }
    }
}

static void
let_go(Seen *seen, Py_ssize_t count)
{
    for (Py_ssize_t i = 0; i < count; i++) {
        if (seen[i].block != NULL) {
            seen[i].block->readers--;
            Py_DECREF(OBJECT(seen[i].block));
        }
    }
    PyMem_Free(seen);
}

typedef double Column[LANES];

static void
fill_row(const double *row, Column *out, Py_ssize_t count)
{
    for (int k = 0; k < WIDTH; k++) {
        for (Py_ssize_t j = 0; j < count; j++) {
            out[k][j] = row[k];
        }
    }
}

/* The rows of an edge at some stamps. Where there is none, `missing` is set and the row is meaningless. */
static Status
edge_rows(Seen *edge, const int64_t *stamps, Py_ssize_t count, Column *out, char *missing)
{
    Segment segments[LANES + 1];
    Turn turns[LANES + 1];
    unsigned char which[LANES];
    Py_ssize_t used = 1, last = 0;
    segments[0] = edge->last;
    turns[0] = edge->turn;
    for (Py_ssize_t j = 0; j < count; j++) {
        const int64_t at = stamps[j];
        if (segments[last].before < at && at < segments[last].after) {
            which[j] = (unsigned char)last;
            continue;
        }
        Segment *segment = &segments[used];
        const Status status = find_segment(&edge->samples, at, segment);
        if (status == NOT_PLAIN) {
            return NOT_PLAIN;
        }
        if (status == MISSING) {
            missing[j] = 1;
            segment->a = NULL;
            segment->b = identity;
        }
        which[j] = (unsigned char)used;
        last = segment->a == NULL ? last : used;
        used++;
    }
    find_turns(segments + 1, turns + 1, used - 1);
    blend(segments, turns, which, stamps, count, out[0], 1, LANES);
    edge->last = segments[last];
    edge->turn = turns[last];
    return ANSWERED;
}

/* b = a @ b, or the inverse of a @ b. */
static void
compose_columns(Column *a, Column *b, Py_ssize_t count, int of_inverse)
{
    for (Py_ssize_t j = 0; j < count; j++) {
        double first[WIDTH], second[WIDTH];
        for (int k = 0; k < WIDTH; k++) {
            first[k] = a[k][j];
            second[k] = b[k][j];
        }
        if (of_inverse) {
            invert(first, first);
        }
        compose(first, second, second);
        for (int k = 0; k < WIDTH; k++) {
            b[k][j] = second[k];
        }
    }
}

/* The answers at `count` stamps as seven columns; NaN where there is none. The first such place, -1 for none, or -2 if
 * an answer is not plain. Neither `stamps` nor `columns` need be aligned. */
static Py_ssize_t
fill_columns(const Chain *self, Seen *seen, const char *stamps, Py_ssize_t count, char *columns)
{
    const Py_ssize_t steps = self->up + self->down;
    Py_ssize_t first_missing = -1;
    for (Py_ssize_t done = 0; done < count; done += LANES) {
        const Py_ssize_t here = count - done < LANES ? count - done : LANES;
        int64_t at[LANES];
        char missing[LANES] = {0};
        Column above[WIDTH], below[WIDTH], step[WIDTH];
        memcpy(at, stamps + done * (Py_ssize_t)sizeof(int64_t), (size_t)here * sizeof(int64_t));
        if (self->up == 0) {
            fill_row(identity, above, here);
        }
        for (Py_ssize_t i = 0; i < steps; i++) {
            const int begins = i == 0 || i == self->up;
            Column *side = i < self->up ? above : below, *rows = begins ? side : step;
            if (self->steps[i].edge == NULL) {
                fill_row(self->steps[i].row, rows, here);
            } else if (edge_rows(&seen[i], at, here, rows, missing) == NOT_PLAIN) {
                return -2;
            }
            if (!begins) {
                compose_columns(rows, side, here, 0);
            }
        }
        if (self->down > 0) {
            compose_columns(below, above, here, 1);
        }
        for (Py_ssize_t j = 0; j < here; j++) {
            if (missing[j]) {
                first_missing = first_missing < 0 ? done + j : first_missing;
                for (int k = 0; k < WIDTH; k++) {
                    above[k][j] = NAN;
                }
            }
        }
        for (int k = 0; k < WIDTH; k++) {
            memcpy(columns + (k * count + done) * (Py_ssize_t)sizeof(double), above[k], (size_t)here * sizeof(double));
        }
    }
    return first_missing;
}

enum { FEW_STAMPS = 256 }; /* for fewer answers, releasing the interpreter costs more than it gains */

/* As `fill_columns`, of samples that others may not change: see Block. */
static Py_ssize_t
fill_columns_unlocked(Chain *chain, Seen *seen, const char *stamps, Py_ssize_t count, char *columns)
{
    Py_ssize_t missing;
    if (count < FEW_STAMPS) {
        return fill_columns(chain, seen, stamps, count, columns);
    }
    Py_BEGIN_ALLOW_THREADS
    missing = fill_columns(chain, seen, stamps, count, columns);
    Py_END_ALLOW_THREADS
    return missing;
}

static PyObject *
held_rows(Held *self, PyObject *const *args, Py_ssize_t nargs)
{
    Py_buffer buffers[2], *const stamps = &buffers[0], *const columns = &buffers[1];
    if (self->busy) {
        PyErr_SetString(PyExc_RuntimeError, "another thread reads these samples");
        return NULL;
    }
    if (!open_buffers(args, nargs, buffers, PyBUF_SIMPLE, PyBUF_WRITABLE)) {
        return NULL;
    }
    PyObject *result = NULL;
    const Py_ssize_t size = (Py_ssize_t)sizeof(int64_t), count = stamps->len / size;
    if (columns->len != count * (Py_ssize_t)ROW_SIZE || stamps->len % size != 0) {
        PyErr_SetString(PyExc_ValueError, "columns must have room for seven floats a stamp");
    } else {
        self->busy = 1;
        Py_INCREF(OBJECT(self));
        const Py_ssize_t missing = fill_columns_unlocked(self->chain, self->seen, stamps->buf, count, columns->buf);
        self->busy = 0;
        Py_DECREF(OBJECT(self));
        if (missing == -2) {
            Py_INCREF(Py_None);
            result = Py_None;
        } else {
            result = PyLong_FromSsize_t(missing);
        }
    }
    close_buffers(buffers);
    return result;
}

static int
held_traverse(Held *self, visitproc visit, void *arg)
{
    Py_VISIT(Py_TYPE(OBJECT(self)));
    Py_VISIT(self->chain);
    return 0;
}

static void
held_dealloc(Held *self)
{
    PyObject_GC_UnTrack(self);
    if (self->seen != NULL) {
        let_go(self->seen, self->count);
    }
    Py_XDECREF(OBJECT(self->chain));
    let_go_of(OBJECT(self));
}

static PyMethodDef held_methods[] = {
    {"rows", FAST(held_rows), METH_FASTCALL,
     PyDoc_STR("rows(stamps, columns): fill columns of shape (7, n), NaN without an answer; the first such place, -1 if "
               "there is none, None if an answer is not plain.")},
    {NULL}
};

static PyType_Slot held_slots[] = {
    {Py_tp_doc, (void *)PyDoc_STR("The samples of a chain as they were at one moment.")},
    {Py_tp_dealloc, held_dealloc},
    {Py_tp_traverse, held_traverse},
    {Py_tp_methods, held_methods},
    {0, NULL}
};

static PyType_Spec held_spec = {
    "tfbus._kernel.Held", sizeof(Held), 0,
    Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC | Py_TPFLAGS_DISALLOW_INSTANTIATION | Py_TPFLAGS_IMMUTABLETYPE, held_slots
};

static PyObject *
chain_hold(Chain *self, PyObject *Py_UNUSED(ignored))
{
    Held *held = (Held *)PyType_GenericAlloc(HeldType, 0);
    if (held == NULL) {
        return NULL;
    }
    Py_INCREF(OBJECT(self));
    held->chain = self;
    held->count = self->up + self->down;
    held->seen = chain_look(self);
    if (held->seen == NULL) {
        Py_DECREF(OBJECT(held));
        if (PyErr_Occurred()) {
            return NULL;
        }
        Py_RETURN_NONE;
    }
    keep_hold(self, held->seen);
    return OBJECT(held);
}

static int
chain_traverse(Chain *self, visitproc visit, void *arg)
{
    Py_VISIT(Py_TYPE(OBJECT(self)));
    Py_VISIT(self->sides[0]);
    Py_VISIT(self->sides[1]);
    return 0;
}

static void
chain_dealloc(Chain *self)
{
    PyObject_GC_UnTrack(self);
    chain_clear(self);
    let_go_of(OBJECT(self));
}

static PyMethodDef chain_methods[] = {
    {"row", (PyCFunction)chain_row, METH_O, PyDoc_STR("row(at): source in target at a stamp; None if it is not plain.")},
    {"latest", (PyCFunction)chain_latest, METH_NOARGS,
     PyDoc_STR("The newest stamp that all edges have reached; None if one has no samples, or nothing moves.")},
    {"hold", (PyCFunction)chain_hold, METH_NOARGS,
     PyDoc_STR("The present samples of all edges, for many answers; None if they are not plain.")},
    {NULL}
};

static PyMemberDef chain_members[] = {
    {"up", T_OBJECT_EX, offsetof(Chain, sides[0]), READONLY, PyDoc_STR("The steps from the source up.")},
    {"down", T_OBJECT_EX, offsetof(Chain, sides[1]), READONLY, PyDoc_STR("The steps from the target up.")},
    {NULL}
};

static PyType_Slot chain_slots[] = {
    {Py_tp_doc, (void *)PyDoc_STR("The edges between two frames, and one row for each run of static ones.")},
    {Py_tp_new, PyType_GenericNew},
    {Py_tp_init, chain_init},
    {Py_tp_dealloc, chain_dealloc},
    {Py_tp_traverse, chain_traverse},
    {Py_tp_clear, chain_clear},
    {Py_tp_methods, chain_methods},
    {Py_tp_members, chain_members},
    {0, NULL}
};

static PyType_Spec chain_spec = {
    "tfbus._kernel.Chain", sizeof(Chain), 0, Py_TPFLAGS_DEFAULT | Py_TPFLAGS_BASETYPE | Py_TPFLAGS_HAVE_GC, chain_slots
};

/* The plain commit -------------------------------------------------------------------------------------------------- */

enum { FEW = 64 }; /* samples whose histories fit on the stack */

/* Store the samples of a batch from the index `first` on, up to the first that is not plain; its index, or -1 for an
 * error. If `whole` is set and not all are plain, or out of memory, all histories are as before. */
static Py_ssize_t
store(PyObject *frames, PyObject *batch, Py_ssize_t first, int whole)
{
    const Py_ssize_t size = PyTuple_Size(batch);
    if (first < 0 || first >= size) {
        return size;
    }
    History *few[FEW], **histories = few;
    if (size - first > FEW && (histories = PyMem_Malloc((size_t)(size - first) * sizeof(History *))) == NULL) {
        PyErr_NoMemory();
        return -1;
    }
    Py_ssize_t stored = 0;
    int failed = 0;
    while (first + stored < size) {
        PyObject *item = PyTuple_GetItem(batch, first + stored);
        const Sample *sample = (const Sample *)item;
        if (!PyObject_TypeCheck(item, SampleType) || sample->authority == NULL || sample->is_static) {
            break;
        }
        PyObject *known = PyDict_GetItemWithError(frames, sample->child);
        if (known == NULL || !PyObject_TypeCheck(known, HistoryType)) {
            failed = PyErr_Occurred() != NULL;
            break;
        }
        History *history = (History *)known;
        if (!history_continues(history, sample->parent, sample->stamp, sample->authority)) {
            break;
        }
        if (history_push(history, sample->stamp, sample->row) < 0) {
            failed = 1;
            break;
        }
        histories[stored++] = history;
    }
    const int keep = !failed && !(whole && first + stored < size);
    for (Py_ssize_t i = 0; i < stored; i++) {
        if (keep) {
            history_slide(histories[i]);
        } else {
            histories[i]->end--;
        }
    }
    if (histories != few) {
        PyMem_Free(histories);
    }
    if (failed) {
        return -1;
    }
    return keep ? first + stored : first;
}

/* commit(frames, batch, first) */
static PyObject *
commit(PyObject *Py_UNUSED(module), PyObject *const *args, Py_ssize_t nargs)
{
    if (nargs != 3 || !PyDict_Check(args[0]) || !PyTuple_CheckExact(args[1])) {
        PyErr_SetString(PyExc_TypeError, "commit takes a dict of histories, a tuple of samples and an index");
        return NULL;
    }
    const Py_ssize_t first = PyLong_AsSsize_t(args[2]);
    if (first == -1 && PyErr_Occurred()) {
        return NULL;
    }
    const Py_ssize_t end = store(args[0], args[1], first, 0);
    return end < 0 ? NULL : PyLong_FromSsize_t(end);
}

/* Paths: the plain answer ------------------------------------------------------------------------------------------ */

typedef struct {
    PyObject_HEAD
    PyObject *recent;        /* {target: {source: Chain}} */
    PyObject *lock_is_held;  /* the method of the tree's lock that says so */
    PyObject *latest;        /* the sentinel */
    PyObject *kind;          /* the class of an answer, made of Sample */
    long long inserted;      /* samples at new stamps */
    long long version;       /* another one after each change */
} Paths;

/* Whether nobody holds the lock. Its holder may be in the middle of a change, or of reading several histories. Nothing
 * here lets go of the interpreter, so a free lock need not be taken. -1 for an error. */
static int
paths_are_free(const Paths *self)
{
    PyObject *held = PyObject_CallNoArgs(self->lock_is_held);
    if (held == NULL) {
        return -1;
    }
    Py_DECREF(held);
    return held == Py_False;
}

REFERENCES(paths, 4)

static int
paths_init(Paths *self, PyObject *args, PyObject *kwargs)
{
    PyObject *lock, *latest, *kind;
    if (!has_no_keywords(kwargs) || !PyArg_ParseTuple(args, "OOO!:Paths", &lock, &latest, &PyType_Type, &kind)) {
        return -1;
    }
    if (!PyType_IsSubtype((PyTypeObject *)kind, SampleType)) {
        PyErr_SetString(PyExc_TypeError, "answers must be samples");
        return -1;
    }
    PyObject *is_held = PyObject_GetAttrString(lock, "locked");
    PyObject *recent = is_held == NULL ? NULL : PyDict_New();
    if (recent == NULL) {
        Py_XDECREF(is_held);
        return -1;
    }
    paths_clear(OBJECT(self));
    self->recent = recent;
    self->lock_is_held = is_held;
    Py_INCREF(latest);
    self->latest = latest;
    Py_INCREF(kind);
    self->kind = kind;
    return 0;
}

/* The chain that is known between two frames, borrowed. NULL without an error if there is none, or somebody holds the
 * lock. */
static Chain *
paths_find(const Paths *self, PyObject *target, PyObject *source)
{
    if (self->recent == NULL || !PyUnicode_CheckExact(target) || !PyUnicode_CheckExact(source)
        || paths_are_free(self) <= 0) {
        return NULL;
    }
    PyObject *by_source = PyDict_GetItemWithError(self->recent, target);
    PyObject *chain = by_source == NULL ? NULL : PyDict_GetItemWithError(by_source, source);
    return chain != NULL && PyObject_TypeCheck(chain, ChainType) ? (Chain *)chain : NULL;
}

/* None where Python has to look closer. */
static PyObject *
paths_answer(Paths *self, PyObject *const *args, Py_ssize_t count)
{
    int64_t at;
    double row[WIDTH];
    if (count != 3) {
        PyErr_SetString(PyExc_TypeError, "answer takes target, source and at");
        return NULL;
    }
    PyObject *target = args[0], *source = args[1];
    const Chain *path = paths_find(self, target, source);
    if (path == NULL) {
        if (PyErr_Occurred()) {
            return NULL;
        }
        Py_RETURN_NONE;
    }
    if (args[2] == self->latest) {
        if (!chain_newest(path, &at)) {
            Py_RETURN_NONE;
        }
    } else {
        int overflow;
        if (path->moving == 0 || !PyLong_CheckExact(args[2])) {
            Py_RETURN_NONE;
        }
        at = PyLong_AsLongLongAndOverflow(args[2], &overflow);
        if (overflow) {
            Py_RETURN_NONE;
        }
    }
    if (chain_at(path, at, row) != ANSWERED) {
        Py_RETURN_NONE;
    }
    Sample *sample = (Sample *)PyType_GenericAlloc((PyTypeObject *)self->kind, 0);
    if (sample == NULL) {
        return NULL;
    }
    Py_INCREF(target);
    Py_INCREF(source);
    Py_INCREF(empty_string);
    sample->parent = target;
    sample->child = source;
    sample->authority = empty_string;
    sample->stamp = at;
    memcpy(sample->row, row, ROW_SIZE);
    return (PyObject *)sample;
}

/* Bytes that end with the given stamps, and have room for seven floats a stamp before. NULL without an error if they
 * are not a list or a tuple of int, or an array of int64; or if there are none. */
static PyObject *
room_for_rows(PyObject *stamps)
{
    const int is_list = PyList_CheckExact(stamps), is_tuple = PyTuple_CheckExact(stamps);
    Py_buffer view = {0};
    Py_ssize_t count;
    if (is_list || is_tuple) {
        count = is_list ? PyList_Size(stamps) : PyTuple_Size(stamps);
    } else {
        /* Python judges arrays with a mask. */
        if (OBJECT(Py_TYPE(stamps)) != array_type
            && (!PyObject_CheckBuffer(stamps) || PyObject_HasAttrString(stamps, "mask"))) {
            return NULL;
        }
        if (PyObject_GetBuffer(stamps, &view, PyBUF_STRIDES | PyBUF_FORMAT) < 0) {
            if (PyErr_ExceptionMatches(PyExc_ValueError) || PyErr_ExceptionMatches(PyExc_TypeError)
                || PyErr_ExceptionMatches(PyExc_BufferError)) {
                PyErr_Clear();
            }
            return NULL;
        }
        const char *format = view.format == NULL ? "B" : view.format;
        const int is_int64 = strcmp(format, "q") == 0 || (strcmp(format, "l") == 0 && sizeof(long) == sizeof(int64_t));
        count = is_int64 && view.ndim == 1 && view.itemsize == (Py_ssize_t)sizeof(int64_t) ? view.shape[0] : 0;
    }
    PyObject *memory = NULL;
    if (count > 0 && count <= PY_SSIZE_T_MAX / (Py_ssize_t)SAMPLE_SIZE / 2) {
        memory = PyBytes_FromStringAndSize(NULL, count * (Py_ssize_t)SAMPLE_SIZE);
    }
    char *own = memory == NULL ? NULL : PyBytes_AsString(memory) + count * (Py_ssize_t)ROW_SIZE;
    for (Py_ssize_t i = 0; own != NULL && i < count; i++) {
        int64_t stamp;
        if (is_list || is_tuple) {
            PyObject *item = is_list ? PyList_GetItem(stamps, i) : PyTuple_GetItem(stamps, i);
            int overflow = 1;
            stamp = item != NULL && PyLong_CheckExact(item) ? PyLong_AsLongLongAndOverflow(item, &overflow) : 0;
            if (overflow) {
                Py_CLEAR(memory);
                break;
            }
        } else {
            memcpy(&stamp, (const char *)view.buf + i * view.strides[0], sizeof(stamp));
        }
        memcpy(own + i * (Py_ssize_t)sizeof(stamp), &stamp, sizeof(stamp));
    }
    if (view.obj != NULL) {
        PyBuffer_Release(&view);
    }
    return memory;
}

/* None where Python has to look closer. */
static PyObject *
paths_answer_many(Paths *self, PyObject *const *args, Py_ssize_t nargs)
{
    if (nargs != 3) {
        PyErr_SetString(PyExc_TypeError, "answer_many takes target, source and stamps");
        return NULL;
    }
    /* Before all else, because it may run Python code. */
    PyObject *memory = room_for_rows(args[2]);
    Chain *path = memory == NULL ? NULL : paths_find(self, args[0], args[1]);
    Seen *seen = path == NULL ? NULL : chain_look(path);
    if (seen == NULL) {
        Py_XDECREF(memory);
        if (PyErr_Occurred()) {
            return NULL;
        }
        Py_RETURN_NONE;
    }
    const Py_ssize_t count = PyBytes_Size(memory) / (Py_ssize_t)SAMPLE_SIZE;
    char *columns = PyBytes_AsString(memory);
    Py_INCREF(OBJECT(path));
    if (count >= FEW_STAMPS) {
        keep_hold(path, seen);
    }
    const Py_ssize_t missing = fill_columns_unlocked(path, seen, columns + count * (Py_ssize_t)ROW_SIZE, count, columns);
    let_go(seen, path->up + path->down);
    Py_DECREF(OBJECT(path));
    if (missing != -1) {
        Py_DECREF(memory);
        Py_RETURN_NONE;
    }
    return memory;
}

/* commit(frames, readers, batch): store the whole batch if it is plain, the lock is free and there are no readers. */
static PyObject *
paths_commit(Paths *self, PyObject *const *args, Py_ssize_t nargs)
{
    if (nargs != 3 || !PyDict_Check(args[0]) || !PyDict_Check(args[1]) || !PyTuple_CheckExact(args[2])) {
        PyErr_SetString(PyExc_TypeError, "commit takes a dict of histories, a dict of readers and a tuple of samples");
        return NULL;
    }
    if (self->recent == NULL || PyDict_Size(args[1]) > 0) {
        Py_RETURN_FALSE;
    }
    const int free = paths_are_free(self);
    if (free < 0) {
        return NULL;
    }
    const Py_ssize_t size = PyTuple_Size(args[2]);
    const Py_ssize_t end = free ? store(args[0], args[2], 0, 1) : 0;
    if (end < 0) {
        return NULL;
    }
    if (!free || end < size) {
        Py_RETURN_FALSE;
    }
    self->inserted += size;
    self->version++;
    Py_RETURN_TRUE;
}

static PyObject *
paths_recent(Paths *self, void *Py_UNUSED(closure))
{
    if (self->recent == NULL) {
        PyErr_SetString(PyExc_AttributeError, "recent");
        return NULL;
    }
    Py_INCREF(self->recent);
    return self->recent;
}

static int
paths_set_recent(Paths *self, PyObject *value, void *Py_UNUSED(closure))
{
    if (value == NULL || !PyDict_CheckExact(value)) {
        PyErr_SetString(PyExc_TypeError, "recent must be a dict");
        return -1;
    }
    PyObject *old = self->recent;
    Py_INCREF(value);
    self->recent = value;
    Py_XDECREF(OBJECT(old));
    return 0;
}

static PyMethodDef paths_methods[] = {
    {"answer", FAST(paths_answer), METH_FASTCALL,
     PyDoc_STR("answer(target, source, at): the plain answer; None if Python has to look closer.")},
    {"answer_many", FAST(paths_answer_many), METH_FASTCALL,
     PyDoc_STR("answer_many(target, source, stamps): the plain answers as bytes, seven columns of floats, and the stamps; "
               "None if Python has to look closer.")},
    {"commit", FAST(paths_commit), METH_FASTCALL,
     PyDoc_STR("commit(frames, readers, batch): store a batch if it is plain and has no readers; else nothing.")},
    {NULL}
};

static PyGetSetDef paths_getset[] = {
    {"recent", (getter)paths_recent, (setter)paths_set_recent, PyDoc_STR("{target: {source: Chain}}"), NULL},
    {NULL}
};

static PyMemberDef paths_members[] = {
    {"inserted", T_LONGLONG, offsetof(Paths, inserted), 0, PyDoc_STR("The number of samples at new stamps.")},
    {"version", T_LONGLONG, offsetof(Paths, version), 0, PyDoc_STR("Another number after each change.")},
    {NULL}
};

static PyType_Slot paths_slots[] = {
    {Py_tp_doc, (void *)PyDoc_STR("The paths that were asked for lately, and their plain answers.")},
    {Py_tp_new, PyType_GenericNew},
    {Py_tp_init, paths_init},
    {Py_tp_dealloc, paths_dealloc},
    {Py_tp_traverse, paths_traverse},
    {Py_tp_clear, paths_clear},
    {Py_tp_methods, paths_methods},
    {Py_tp_members, paths_members},
    {Py_tp_getset, paths_getset},
    {0, NULL}
};

static PyType_Spec paths_spec = {
    "tfbus._kernel.Paths", sizeof(Paths), 0, Py_TPFLAGS_DEFAULT | Py_TPFLAGS_BASETYPE | Py_TPFLAGS_HAVE_GC, paths_slots
};

/* Method: a method in Python that runs only if there is no plain answer ----------------------------------------------- */

typedef struct Method {
    PyObject_HEAD
    PyObject *function; /* the method in Python */
    PyObject *many;     /* the class of the answers at many stamps; NULL if it asks for one */
    PyObject *defaults; /* the defaults of its keywords, a dict or None */
    PyObject *(*vectorcall)(struct Method *, PyObject *const *, size_t, PyObject *);
} Method;

/* Py_TPFLAGS_HAVE_VECTORCALL, which has this value since 3.8, and is in the limited API since 3.12. */
#define HAVE_VECTORCALL (1UL << 11)

static PyObject *method_vectorcall(Method *self, PyObject *const *args, size_t flagged, PyObject *names);

REFERENCES(method, 3)

static PyObject *
method_new(PyTypeObject *type, PyObject *args, PyObject *kwargs)
{
    PyObject *function, *many;
    if (!has_no_keywords(kwargs) || !PyArg_ParseTuple(args, "OO:Method", &function, &many)) {
        return NULL;
    }
    if (many != Py_None && !PyType_Check(many)) {
        PyErr_SetString(PyExc_TypeError, "the answers at many stamps need a class, or None");
        return NULL;
    }
    PyObject *defaults = PyObject_GetAttrString(function, "__kwdefaults__");
    if (defaults == NULL) {
        return NULL;
    }
    Method *self = (Method *)PyType_GenericAlloc(type, 0);
    if (self == NULL) {
        Py_DECREF(defaults);
    } else {
        Py_INCREF(function);
        self->function = function;
        self->defaults = defaults;
        self->vectorcall = method_vectorcall;
        Py_XINCREF(many == Py_None ? NULL : many);
        self->many = many == Py_None ? NULL : many;
    }
    return OBJECT(self);
}

/* The plain answer for source in target; None if there is none. Without stamps it is the latest. */
static PyObject *
method_answer(const Method *self, PyObject *asker, PyObject *target, PyObject *source, PyObject *at)
{
    PyObject *paths = PyObject_GetAttr(asker, paths_string);
    if (paths == NULL || !PyObject_TypeCheck(paths, PathsType)) {
        PyErr_Clear();
        Py_XDECREF(paths);
        Py_RETURN_NONE;
    }
    PyObject *question[3] = {target, source, at == NULL ? ((Paths *)paths)->latest : at};
    PyObject *found = self->many == NULL ? paths_answer((Paths *)paths, question, 3)
                                         : paths_answer_many((Paths *)paths, question, 3);
    Py_DECREF(paths);
    if (self->many == NULL || found == NULL || found == Py_None) {
        return found;
    }
    PyObject *answers = PyType_GenericAlloc((PyTypeObject *)self->many, 0);
    if (answers != NULL && PyObject_SetAttr(answers, memory_string, found) < 0) {
        Py_CLEAR(answers);
    }
    Py_DECREF(found);
    return answers;
}

/* The call of the method in Python, with `count` arguments and as many more as there are names. */
static PyObject *
method_run(const Method *self, PyObject *const *args, Py_ssize_t count, PyObject *names)
{
    PyObject *first = PyTuple_New(count), *result = NULL;
    PyObject *named = first == NULL || names == NULL ? NULL : PyDict_New();
    int failed = first == NULL || (names != NULL && named == NULL) || self->function == NULL;
    for (Py_ssize_t i = 0; !failed && i < count; i++) {
        Py_INCREF(args[i]);
        failed = PyTuple_SetItem(first, i, args[i]) < 0;
    }
    for (Py_ssize_t i = 0; !failed && names != NULL && i < PyTuple_Size(names); i++) {
        failed = PyDict_SetItem(named, PyTuple_GetItem(names, i), args[count + i]) < 0;
    }
    if (!failed) {
        result = PyObject_Call(self->function, first, named);
    } else if (!PyErr_Occurred()) {
        PyErr_SetString(PyExc_RuntimeError, "the garbage collector has taken the method");
    }
    Py_XDECREF(first);
    Py_XDECREF(named);
    return result;
}

/* Whether the named arguments from the index `first` on are the defaults of the method. Inlined, it would cost each call
 * without names a twentieth of its time: more registers are saved. */
Py_NO_INLINE static int
method_has_defaults(const Method *self, PyObject *const *named, PyObject *names, Py_ssize_t first)
{
    const Py_ssize_t size = PyTuple_Size(names);
    for (Py_ssize_t i = first; i < size; i++) {
        if (self->defaults == NULL || !PyDict_CheckExact(self->defaults)
            || PyDict_GetItem(self->defaults, PyTuple_GetItem(names, i)) != named[i]) {
            return 0;
        }
    }
    return 1;
}

/* By PEP 590. A plain call has only the object, target, source, and the stamp or stamps; all else are defaults. */
static PyObject *
method_vectorcall(Method *self, PyObject *const *args, size_t flagged, PyObject *names)
{
    const Py_ssize_t count = (Py_ssize_t)(flagged & ~((size_t)1 << (8 * sizeof(size_t) - 1)));
    const int at_is_named = count == 3 && names != NULL && PyTuple_Size(names) > 0 && PyTuple_GetItem(names, 0) == at_string;
    if ((count == 4 || (self->many == NULL && count == 3))
        && (names == NULL || method_has_defaults(self, args + count, names, at_is_named))) {
        PyObject *found = method_answer(self, args[0], args[1], args[2], count == 4 || at_is_named ? args[3] : NULL);
        if (found != Py_None) {
            return found;
        }
        Py_DECREF(found);
    }
    return method_run(self, args, count, names);
}

static PyObject *
method_call(Method *self, PyObject *args, PyObject *kwargs)
{
    if (self->function == NULL) {
        return method_run(self, NULL, 0, NULL);
    }
    return PyObject_Call(self->function, args, kwargs);
}

static PyObject *
method_bind(PyObject *self, PyObject *instance, PyObject *Py_UNUSED(owner))
{
    if (instance == NULL || instance == Py_None) {
        Py_INCREF(self);
        return self;
    }
    return PyObject_CallFunctionObjArgs(bound_method, self, instance, NULL);
}

/* Attributes come from the method in Python, so that its signature and its documentation are found. */
static PyObject *
method_attribute(Method *self, PyObject *name)
{
    PyObject *found = self->function == NULL ? NULL : PyObject_GetAttr(self->function, name);
    if (found == NULL) {
        PyErr_Clear();
        found = PyObject_GenericGetAttr(OBJECT(self), name);
    }
    return found;
}

static PyMemberDef method_members[] = {
    {"__wrapped__", T_OBJECT_EX, offsetof(Method, function), READONLY, PyDoc_STR("The method in Python.")},
    {"__vectorcalloffset__", T_PYSSIZET, offsetof(Method, vectorcall), READONLY, NULL},
    {NULL}
};

static PyType_Slot method_slots[] = {
    {Py_tp_doc, (void *)PyDoc_STR("Method(function, many): a method that runs only if there is no plain answer.")},
    {Py_tp_new, method_new},
    {Py_tp_dealloc, method_dealloc},
    {Py_tp_traverse, method_traverse},
    {Py_tp_clear, method_clear},
    {Py_tp_call, method_call},
    {Py_tp_descr_get, method_bind},
    {Py_tp_getattro, method_attribute},
    {Py_tp_members, method_members},
    {0, NULL}
};

static PyType_Spec method_spec = {
    "tfbus._kernel.Method", sizeof(Method), 0,
    Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC | Py_TPFLAGS_METHOD_DESCRIPTOR | HAVE_VECTORCALL | Py_TPFLAGS_IMMUTABLETYPE,
    method_slots
};

/* Edge: the newest edge of a frame on a bus, and the plain judgement of a batch --------------------------------------- */

typedef struct {
    PyObject_HEAD
    PyObject *parent;  /* plain str */
    PyObject *trusted; /* plain str, or NULL for nobody */
    int64_t newest;
    char has_newest;
    char late; /* whether its old stamps were reported */
} Edge;

static PyObject *
edge_trusted(Edge *self, void *Py_UNUSED(closure))
{
    PyObject *trusted = self->trusted == NULL ? Py_None : self->trusted;
    Py_INCREF(trusted);
    return trusted;
}

static PyObject *
edge_newest(Edge *self, void *Py_UNUSED(closure))
{
    if (!self->has_newest) {
        Py_RETURN_NONE;
    }
    return PyLong_FromLongLong(self->newest);
}

static int
edge_set_trusted(PyObject *self, PyObject *value, void *closure)
{
    if (value != Py_None) {
        return set_string_of(self, value, closure);
    }
    Py_CLEAR(((Edge *)self)->trusted);
    return 0;
}

static int
edge_set_newest(Edge *self, PyObject *value, void *Py_UNUSED(closure))
{
    if (value == NULL) {
        PyErr_SetString(PyExc_AttributeError, "an edge keeps all its fields");
        return -1;
    }
    if (value != Py_None && read_stamp(value, &self->newest) < 0) {
        return -1;
    }
    self->has_newest = value != Py_None;
    return 0;
}

static void
edge_dealloc(Edge *self)
{
    Py_XDECREF(self->parent);
    Py_XDECREF(self->trusted);
    let_go_of(OBJECT(self));
}

static PyGetSetDef edge_getset[] = {
    {"parent", string_of, set_string_of, PyDoc_STR("The newest parent."), (void *)offsetof(Edge, parent)},
    {"trusted", (getter)edge_trusted, edge_set_trusted,
     PyDoc_STR("The authority whose moving samples under this parent need no judgement, or None."),
     (void *)offsetof(Edge, trusted)},
    {"newest", (getter)edge_newest, (setter)edge_set_newest, PyDoc_STR("The newest stamp, or None."), NULL},
    {NULL}
};

static PyMemberDef edge_members[] = {
    {"late", T_BOOL, offsetof(Edge, late), 0, PyDoc_STR("Whether its old stamps were reported.")},
    {NULL}
};

static PyType_Slot edge_slots[] = {
    {Py_tp_doc, (void *)PyDoc_STR("The part of a frame's newest edge that the judge needs.")},
    {Py_tp_new, PyType_GenericNew},
    {Py_tp_dealloc, edge_dealloc},
    {Py_tp_members, edge_members},
    {Py_tp_getset, edge_getset},
    {0, NULL}
};

static PyType_Spec edge_spec = {
    "tfbus._kernel.Edge", sizeof(Edge), 0, Py_TPFLAGS_DEFAULT | Py_TPFLAGS_BASETYPE, edge_slots
};

/* Judge: the plain judgement of a batch by the newest edges. */

typedef struct {
    PyObject_HEAD
    PyObject *edges;   /* {child: Edge} */
    double square;     /* m^2 */
    long long earliest, horizon; /* ns */
    long long until;   /* ns of `elapsed`; the two are out of date then */
    long long behind;  /* how many stamps were older than the first */
} Judge;

REFERENCES(judge, 1)

/* A monotonic time in ns, to some milliseconds. The exact one takes a tenth of the time of a publish. */
static int64_t
elapsed(void)
{
#ifdef _WIN32
    return (int64_t)GetTickCount64() * 1000000;
#else
#ifdef CLOCK_MONOTONIC_COARSE
    const clockid_t clock = CLOCK_MONOTONIC_COARSE;
#else
    const clockid_t clock = CLOCK_MONOTONIC;
#endif
    struct timespec now = {0, 0};
    clock_gettime(clock, &now);
    return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
#endif
}

static int
judge_init(Judge *self, PyObject *args, PyObject *kwargs)
{
    PyObject *edges;
    double square;
    if (!has_no_keywords(kwargs) || !PyArg_ParseTuple(args, "O!d:Judge", &PyDict_Type, &edges, &square)) {
        return -1;
    }
    Py_INCREF(edges);
    judge_clear(OBJECT(self));
    self->edges = edges;
    self->square = square;
    self->earliest = self->horizon = INT64_MIN;
    self->until = INT64_MAX;
    self->behind = 0;
    return 0;
}

/* allow(earliest, horizon, lasting): set both for `lasting` ns of the machine's time; after that, no batch is plain. */
static PyObject *
judge_allow(Judge *self, PyObject *args)
{
    long long earliest, horizon, lasting;
    if (!PyArg_ParseTuple(args, "LLL:allow", &earliest, &horizon, &lasting)) {
        return NULL;
    }
    self->earliest = earliest;
    self->horizon = horizon;
    const int64_t now = elapsed();
    self->until = lasting < INT64_MAX - now ? now + lasting : INT64_MAX;
    Py_RETURN_NONE;
}

/* accepts(batch): whether all samples continue known edges, none is newer than `horizon`, older than `earliest` unless
 * its edge is late, and no translation longer than the root of `square`; then their stamps are noted, else nothing. */
static PyObject *
judge_accepts(Judge *self, PyObject *batch)
{
    if (!PyTuple_CheckExact(batch)) {
        PyErr_SetString(PyExc_TypeError, "a batch is a tuple of samples");
        return NULL;
    }
    if (self->until != INT64_MAX && elapsed() >= self->until) {
        Py_RETURN_FALSE;
    }
    const Py_ssize_t size = PyTuple_Size(batch);
    Edge *few[FEW], **edges = few;
    if (size > FEW && (edges = PyMem_Malloc((size_t)size * sizeof(Edge *))) == NULL) {
        return PyErr_NoMemory();
    }
    Py_ssize_t judged = 0;
    for (; self->edges != NULL && judged < size; judged++) {
        PyObject *item = PyTuple_GetItem(batch, judged);
        const Sample *sample = (const Sample *)item;
        if (!PyObject_TypeCheck(item, SampleType) || sample->authority == NULL || sample->is_static
            || sample->stamp > self->horizon) {
            break;
        }
        const double *row = sample->row;
        /* Not `>`, which is false for NaN. */
        if (!(row[0] * row[0] + row[1] * row[1] + row[2] * row[2] <= self->square)) {
            break;
        }
        PyObject *known = PyDict_GetItemWithError(self->edges, sample->child);
        if (known == NULL || !PyObject_TypeCheck(known, EdgeType)) {
            break;
        }
        edges[judged] = (Edge *)known;
        if (!same_string(sample->parent, edges[judged]->parent)
            || !same_string(sample->authority, edges[judged]->trusted)
            || (sample->stamp < self->earliest && !edges[judged]->late)) {
            break;
        }
    }
    const int plain = judged == size;
    const int64_t earliest = self->earliest;
    long long behind = 0;
    for (Py_ssize_t i = 0; plain && i < size; i++) {
        const int64_t stamp = ((const Sample *)PyTuple_GetItem(batch, i))->stamp;
        if (!edges[i]->has_newest || stamp > edges[i]->newest) {
            edges[i]->newest = stamp;
            edges[i]->has_newest = 1;
        }
        behind += stamp < earliest;
    }
    self->behind += behind;
    if (edges != few) {
        PyMem_Free(edges);
    }
    if (!plain && PyErr_Occurred()) {
        return NULL;
    }
    return PyBool_FromLong(plain);
}

static PyMethodDef judge_methods[] = {
    {"accepts", (PyCFunction)judge_accepts, METH_O,
     PyDoc_STR("accepts(batch): whether the whole batch is plain; then its stamps are noted.")},
    {"allow", (PyCFunction)judge_allow, METH_VARARGS,
     PyDoc_STR("allow(earliest, horizon, lasting): set both for `lasting` ns of the machine's time.")},
    {NULL}
};

static PyMemberDef judge_members[] = {
    {"behind", T_LONGLONG, offsetof(Judge, behind), 0, PyDoc_STR("How many stamps were older than the first bound.")},
    {"earliest", T_LONGLONG, offsetof(Judge, earliest), 0, PyDoc_STR("The oldest accepted stamp but of late edges.")},
    {"horizon", T_LONGLONG, offsetof(Judge, horizon), 0, PyDoc_STR("The newest accepted stamp in ns.")},
    {NULL}
};

static PyType_Slot judge_slots[] = {
    {Py_tp_doc, (void *)PyDoc_STR("The plain judgement of batches by the newest edges of a bus.")},
    {Py_tp_new, PyType_GenericNew},
    {Py_tp_init, judge_init},
    {Py_tp_dealloc, judge_dealloc},
    {Py_tp_traverse, judge_traverse},
    {Py_tp_clear, judge_clear},
    {Py_tp_methods, judge_methods},
    {Py_tp_members, judge_members},
    {0, NULL}
};

static PyType_Spec judge_spec = {
    "tfbus._kernel.Judge", sizeof(Judge), 0, Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC, judge_slots
};

/* Waiting: the plain insertion and its plain wake-ups ---------------------------------------------------------------- */

typedef struct {
    PyObject_HEAD
    PyObject *plain;   /* target, source and at of a plain question; None of another */
    PyObject *wake;    /* called without arguments, once */
    PyObject *place;   /* its place in a line, if it has one */
    PyObject *answer;  /* the answer of the insertion that woke it */
    long long version; /* of the paths, when they had this answer */
    char elsewhere;    /* whether it is noted elsewhere than in a line and among all parked lookups */
} Parked;

REFERENCES(parked, 4)

static PyMemberDef parked_members[] = {
    {"plain", T_OBJECT, offsetof(Parked, plain), 0, PyDoc_STR("Target, source and at of a plain question, or None.")},
    {"wake", T_OBJECT, offsetof(Parked, wake), 0, PyDoc_STR("Called once, after it was taken out of its line.")},
    {"place", T_OBJECT, offsetof(Parked, place), 0, PyDoc_STR("Its place in a line, or None.")},
    {"answer", T_OBJECT, offsetof(Parked, answer), 0, PyDoc_STR("The answer of the insertion that woke it, or None.")},
    {"version", T_LONGLONG, offsetof(Parked, version), 0, PyDoc_STR("The version of the paths that gave this answer.")},
    {"elsewhere", T_BOOL, offsetof(Parked, elsewhere), 0, PyDoc_STR("Whether more than its line has to forget it.")},
    {NULL}
};

static PyType_Slot parked_slots[] = {
    {Py_tp_doc, (void *)PyDoc_STR("The part of a parked lookup that a wake-up needs.")},
    {Py_tp_new, PyType_GenericNew},
    {Py_tp_dealloc, parked_dealloc},
    {Py_tp_traverse, parked_traverse},
    {Py_tp_clear, parked_clear},
    {Py_tp_members, parked_members},
    {0, NULL}
};

static PyType_Spec parked_spec = {
    "tfbus._kernel.Parked", sizeof(Parked), 0, Py_TPFLAGS_DEFAULT | Py_TPFLAGS_BASETYPE | Py_TPFLAGS_HAVE_GC,
    parked_slots
};

typedef struct {
    PyObject_HEAD
    PyObject *places;  /* list of (-stamp, -order, Parked), sorted: the next due is the last */
    PyObject *for_any; /* dict of the lookups that any sample wakes */
    PyObject *limits;  /* list of (-stamp, -order, Parked), sorted */
} Line;

REFERENCES(line, 3)

static int
line_init(Line *self, PyObject *Py_UNUSED(args), PyObject *Py_UNUSED(kwargs))
{
    line_clear(OBJECT(self));
    self->places = PyList_New(0);
    self->for_any = PyDict_New();
    self->limits = PyList_New(0);
    if (self->places == NULL || self->for_any == NULL || self->limits == NULL) {
        line_clear(OBJECT(self));
        return -1;
    }
    return 0;
}

static int
line_has_places_only(const Line *self)
{
    return self->places != NULL && PyDict_Size(self->for_any) == 0 && PyList_Size(self->limits) == 0;
}

static PyMemberDef line_members[] = {
    {"places", T_OBJECT_EX, offsetof(Line, places), READONLY, PyDoc_STR("Lookups that need a stamp, the next due last.")},
    {"for_any", T_OBJECT_EX, offsetof(Line, for_any), READONLY, PyDoc_STR("The lookups that any sample wakes.")},
    {"limits", T_OBJECT_EX, offsetof(Line, limits), READONLY, PyDoc_STR("The lookups that a newer stamp wakes.")},
    {NULL}
};

static PyType_Slot line_slots[] = {
    {Py_tp_doc, (void *)PyDoc_STR("The parked lookups under one frame.")},
    {Py_tp_new, PyType_GenericNew},
    {Py_tp_init, line_init},
    {Py_tp_dealloc, line_dealloc},
    {Py_tp_traverse, line_traverse},
    {Py_tp_clear, line_clear},
    {Py_tp_members, line_members},
    {0, NULL}
};

static PyType_Spec line_spec = {
    "tfbus._kernel.Line", sizeof(Line), 0, Py_TPFLAGS_DEFAULT | Py_TPFLAGS_BASETYPE | Py_TPFLAGS_HAVE_GC, line_slots
};

enum { PATHS, FRAMES, READERS, LINES, PARKED, LIMITS, WATCHES, FORGET, PARTS };

typedef struct {
    PyObject_HEAD
    PyObject *parts[PARTS];
} Feed;

REFERENCES(feed, PARTS)

static int
feed_init(Feed *self, PyObject *args, PyObject *kwargs)
{
    PyObject *parts[PARTS];
    if (!has_no_keywords(kwargs)
        || !PyArg_ParseTuple(args, "O!O!O!O!O!O!O!O:Feed", PathsType, &parts[PATHS], &PyDict_Type, &parts[FRAMES],
                             &PyDict_Type, &parts[READERS], &PyDict_Type, &parts[LINES], &PyDict_Type, &parts[PARKED],
                             &PyList_Type, &parts[LIMITS], &PyDict_Type, &parts[WATCHES], &parts[FORGET])) {
        return -1;
    }
    if (self->parts[PATHS] != NULL) {
        PyErr_SetString(PyExc_RuntimeError, "a Feed is initialised once, because it may be at work");
        return -1;
    }
    for (int i = 0; i < PARTS; i++) {
        Py_INCREF(parts[i]);
        self->parts[i] = parts[i];
    }
    return 0;
}

/* Whether a stamp is at a place, or beyond it; -1 for an error. */
static int
is_reached(PyObject *place, int64_t stamp)
{
    if (!PyTuple_CheckExact(place) || PyTuple_Size(place) != 3) {
        PyErr_SetString(PyExc_TypeError, "a place is a tuple of three");
        return -1;
    }
    int overflow;
    const long long negative = PyLong_AsLongLongAndOverflow(PyTuple_GetItem(place, 0), &overflow);
    if (negative == -1 && !overflow && PyErr_Occurred()) {
        return -1;
    }
    /* The negative of the least stamp is too great, and every stamp has reached that. */
    return overflow > 0 || (overflow == 0 && (stamp != INT64_MIN && negative >= -stamp));
}

/* Whether the wake-ups of a batch are plain: only lookups that need a stamp wait for its frames, nobody watches them,
 * and no sample has passed the first limit. -1 for an error. */
static int
feed_is_plain(const Feed *self, PyObject *batch)
{
    PyObject *lines = self->parts[LINES], *limits = self->parts[LIMITS];
    const Py_ssize_t size = PyTuple_Size(batch);
    for (Py_ssize_t i = 0; i < size; i++) {
        PyObject *item = PyTuple_GetItem(batch, i);
        const Sample *sample = (const Sample *)item;
        if (!PyObject_TypeCheck(item, SampleType) || sample->authority == NULL) {
            return 0;
        }
        /* Anew each time, because comparing names may run Python code. */
        const Py_ssize_t limited = PyList_Size(limits);
        if (limited > 0) {
            const int reached = sample->stamp == INT64_MIN
                ? 0 : is_reached(PyList_GetItem(limits, limited - 1), sample->stamp - 1);
            if (reached != 0) {
                return reached < 0 ? -1 : 0;
            }
        }
        const int watched = PyDict_Contains(self->parts[WATCHES], sample->child);
        if (watched != 0) {
            return watched < 0 ? -1 : 0;
        }
        PyObject *line = PyDict_GetItemWithError(lines, sample->child);
        if (line == NULL) {
            if (PyErr_Occurred()) {
                return -1;
            }
        } else if (!PyObject_TypeCheck(line, LineType) || !line_has_places_only((Line *)line)) {
            return 0;
        }
    }
    return 1;
}

/* The first error of several, kept while the others go on. */
typedef struct {
    PyObject *type, *value, *traceback;
} Trouble;

static void
set_aside(Trouble *trouble)
{
    if (trouble->type == NULL) {
        PyErr_Fetch(&trouble->type, &trouble->value, &trouble->traceback);
    } else {
        PyErr_Clear();
    }
}

/* Whether there was an error, which is then raised. */
static int
raise_trouble(const Trouble *trouble)
{
    if (trouble->type == NULL) {
        return 0;
    }
    PyErr_Restore(trouble->type, trouble->value, trouble->traceback);
    return 1;
}

/* Take the last waiter out of its line; a new reference. NULL for an error, and then it still waits. */
static PyObject *
feed_pop(PyObject *lines, PyObject *child, Line *line, Py_ssize_t last)
{
    PyObject *item = PyTuple_GetItem(PyList_GetItem(line->places, last), 2);
    if (!PyObject_TypeCheck(item, ParkedType)) {
        PyErr_SetString(PyExc_TypeError, "only a parked lookup has a place");
        return NULL;
    }
    Py_INCREF(item);
    if (PyList_SetSlice(line->places, last, last + 1, NULL) < 0) {
        Py_DECREF(item);
        return NULL;
    }
    /* The place refers to the waiter. */
    Py_CLEAR(((Parked *)item)->place);
    if (last == 0 && line_has_places_only(line) && PyDict_DelItem(lines, child) < 0) {
        PyErr_Clear();
    }
    return item;
}

/* Give a waiter its answer, if that is plain. */
static void
feed_answer(const Feed *self, Parked *waiter)
{
    PyObject *plain = waiter->plain;
    if (plain == NULL || !PyTuple_CheckExact(plain) || PyTuple_Size(plain) != 3) {
        return;
    }
    Paths *paths = (Paths *)self->parts[PATHS];
    PyObject *asked[3] = {PyTuple_GetItem(plain, 0), PyTuple_GetItem(plain, 1), PyTuple_GetItem(plain, 2)};
    Py_INCREF(plain);
    PyObject *old = waiter->answer, *answer = paths_answer(paths, asked, 3);
    waiter->answer = answer;
    waiter->version = paths->version;
    if (answer == NULL) {
        /* Out of memory: then it asks itself. */
        PyErr_Clear();
    }
    Py_XDECREF(old);
    Py_DECREF(plain);
}

/* Wake the lookups that a sample at a stamp has unblocked, each with its answer if that is plain. After an error of
 * one, the others are woken too. */
static void
feed_wake(const Feed *self, PyObject *child, int64_t stamp, Trouble *trouble)
{
    PyObject *lines = self->parts[LINES];
    for (;;) {
        /* Looked up each time, because to wake is to run the code of an event loop. */
        PyObject *known = PyDict_GetItemWithError(lines, child);
        if (known == NULL || !PyObject_TypeCheck(known, LineType)) {
            break;
        }
        Line *line = (Line *)known;
        const Py_ssize_t last = line->places == NULL ? -1 : PyList_Size(line->places) - 1;
        if (last < 0 || is_reached(PyList_GetItem(line->places, last), stamp) <= 0) {
            break;
        }
        PyObject *item = feed_pop(lines, child, line, last);
        if (item == NULL) {
            break;
        }
        Parked *waiter = (Parked *)item;
        if (waiter->elsewhere) {
            PyObject *done = PyObject_CallFunctionObjArgs(self->parts[FORGET], item, NULL);
            if (done == NULL) {
                set_aside(trouble);
            }
            Py_XDECREF(done);
        } else if (PyDict_DelItem(self->parts[PARKED], item) < 0) {
            if (PyErr_ExceptionMatches(PyExc_KeyError)) {
                /* It could not be removed whole, for want of memory. */
                PyErr_Clear();
            } else {
                set_aside(trouble);
            }
        }
        feed_answer(self, waiter);
        if (waiter->wake != NULL) {
            PyObject *wake = waiter->wake;
            Py_INCREF(wake);
            PyObject *woken = PyObject_CallNoArgs(wake);
            Py_DECREF(wake);
            if (woken == NULL) {
                if (PyErr_ExceptionMatches(PyExc_Exception)) {
                    /* Its wait was cancelled, or its event loop is gone. */
                    PyErr_Clear();
                } else {
                    set_aside(trouble);
                }
            }
            Py_XDECREF(woken);
        }
        Py_DECREF(item);
    }
    if (PyErr_Occurred()) {
        set_aside(trouble);
    }
}

/* insert(batch): store a batch and wake the lookups that it has unblocked, if all of this is plain; else do nothing. */
static PyObject *
feed_insert(Feed *self, PyObject *batch)
{
    if (!PyTuple_CheckExact(batch)) {
        PyErr_SetString(PyExc_TypeError, "a batch is a tuple of samples");
        return NULL;
    }
    if (self->parts[PATHS] == NULL) {
        Py_RETURN_FALSE;
    }
    const int waits = PyDict_Size(self->parts[LINES]) > 0 || PyDict_Size(self->parts[WATCHES]) > 0
        || PyList_Size(self->parts[LIMITS]) > 0;
    const int plain = waits ? feed_is_plain(self, batch) : 1;
    if (plain <= 0) {
        return plain < 0 ? NULL : PyBool_FromLong(0);
    }
    PyObject *args[] = {self->parts[FRAMES], self->parts[READERS], batch};
    PyObject *stored = paths_commit((Paths *)self->parts[PATHS], args, 3);
    if (stored != Py_True || !waits) {
        return stored;
    }
    Trouble trouble = {NULL};
    const Py_ssize_t size = PyTuple_Size(batch);
    for (Py_ssize_t i = 0; i < size; i++) {
        const Sample *sample = (const Sample *)PyTuple_GetItem(batch, i);
        PyObject *child = sample->child;
        Py_INCREF(child);
        feed_wake(self, child, sample->stamp, &trouble);
        Py_DECREF(child);
    }
    if (raise_trouble(&trouble)) {
        Py_CLEAR(stored);
    }
    return stored;
}

static PyMethodDef feed_methods[] = {
    {"insert", (PyCFunction)feed_insert, METH_O,
     PyDoc_STR("insert(batch): store a batch and wake the lookups that it has unblocked, if all is plain; else do "
               "nothing.")},
    {NULL}
};

static PyType_Slot feed_slots[] = {
    {Py_tp_doc, (void *)PyDoc_STR("The plain insertion of batches, with the plain wake-ups.")},
    {Py_tp_new, PyType_GenericNew},
    {Py_tp_init, feed_init},
    {Py_tp_dealloc, feed_dealloc},
    {Py_tp_traverse, feed_traverse},
    {Py_tp_clear, feed_clear},
    {Py_tp_methods, feed_methods},
    {0, NULL}
};

static PyType_Spec feed_spec = {
    "tfbus._kernel.Feed", sizeof(Feed), 0, Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC, feed_slots
};

/* Intake: the plain publishing ---------------------------------------------------------------------------------------- */

typedef struct {
    PyObject_HEAD
    /* A tuple of (Feed, callable that takes a batch which is not plain). It is cleared first: nothing is taken then. */
    PyObject *feeds;
    PyObject *judge;      /* Judge */
    PyObject *kind;       /* the class of samples */
    PyObject *listeners;  /* a tuple of containers; their elements need each batch */
    long long samples;    /* how many were taken */
    unsigned long thread; /* the only one that may publish */
    char open;
} Intake;

REFERENCES(intake, 4)

static int
intake_init(Intake *self, PyObject *args, PyObject *kwargs)
{
    PyObject *judge, *kind, *listeners;
    if (!has_no_keywords(kwargs)
        || !PyArg_ParseTuple(args, "O!O!O!:Intake", JudgeType, &judge, &PyType_Type, &kind, &PyTuple_Type,
                             &listeners)) {
        return -1;
    }
    if (self->feeds != NULL) {
        PyErr_SetString(PyExc_RuntimeError, "an Intake is initialised once, because it may be at work");
        return -1;
    }
    PyObject *feeds = PyTuple_New(0);
    if (feeds == NULL) {
        return -1;
    }
    Py_INCREF(judge);
    Py_INCREF(kind);
    Py_INCREF(listeners);
    self->judge = judge;
    self->kind = kind;
    self->listeners = listeners;
    self->feeds = feeds;
    self->open = 1;
    return 0;
}

/* A batch of samples of exactly the class; NULL without an error for anything else. */
static PyObject *
intake_batch(const Intake *self, PyObject *samples)
{
    if (OBJECT(Py_TYPE(samples)) == self->kind) {
        return PyTuple_Pack(1, samples);
    }
    PyObject *batch = NULL;
    if (PyList_CheckExact(samples)) {
        batch = PyList_AsTuple(samples);
    } else if (PyTuple_CheckExact(samples)) {
        Py_INCREF(samples);
        batch = samples;
    }
    const Py_ssize_t size = batch == NULL ? 0 : PyTuple_Size(batch);
    for (Py_ssize_t i = 0; i < size; i++) {
        if (OBJECT(Py_TYPE(PyTuple_GetItem(batch, i))) != self->kind) {
            Py_DECREF(batch);
            return NULL;
        }
    }
    if (size == 0) {
        Py_XDECREF(batch);
        return NULL;
    }
    return batch;
}

/* take(samples, invalid): judge a batch and insert it into all buffers if it is plain and nobody else listens. Returns
 * True then; None if the judge does not accept it; False if the judge was not asked. */
static PyObject *
intake_take(Intake *self, PyObject *const *args, Py_ssize_t nargs)
{
    if (nargs != 2) {
        PyErr_SetString(PyExc_TypeError, "take takes samples and what to do with invalid ones");
        return NULL;
    }
    if (!self->open || self->feeds == NULL || self->thread != PyThread_get_thread_ident()
        || (args[1] != raise_string && args[1] != drop_string)) {
        Py_RETURN_FALSE;
    }
    const Py_ssize_t containers = PyTuple_Size(self->listeners);
    for (Py_ssize_t i = 0; i < containers; i++) {
        const Py_ssize_t size = PyObject_Size(PyTuple_GetItem(self->listeners, i));
        if (size != 0) {
            return size < 0 ? NULL : PyBool_FromLong(0);
        }
    }
    PyObject *batch = intake_batch(self, args[0]);
    if (batch == NULL) {
        return PyErr_Occurred() ? NULL : PyBool_FromLong(0);
    }
    PyObject *accepted = judge_accepts((Judge *)self->judge, batch);
    if (accepted != Py_True) {
        Py_DECREF(batch);
        if (accepted == Py_False) {
            Py_DECREF(accepted);
            Py_RETURN_NONE;
        }
        return accepted;
    }
    self->samples += PyTuple_Size(batch);
    PyObject *feeds = self->feeds;
    Py_INCREF(feeds);
    const Py_ssize_t count = PyTuple_Size(feeds);
    Trouble trouble = {NULL};
    /* After an error of one buffer, the others get the batch too, because the bus has judged it. */
    for (Py_ssize_t i = 0; i < count; i++) {
        PyObject *pair = PyTuple_GetItem(feeds, i), *done = feed_insert((Feed *)PyTuple_GetItem(pair, 0), batch);
        if (done == Py_False) {
            Py_DECREF(done);
            done = PyObject_CallFunctionObjArgs(PyTuple_GetItem(pair, 1), batch, NULL);
        }
        if (done == NULL) {
            set_aside(&trouble);
        }
        Py_XDECREF(done);
    }
    Py_DECREF(feeds);
    Py_DECREF(batch);
    if (raise_trouble(&trouble)) {
        Py_CLEAR(accepted);
    }
    return accepted;
}

static PyObject *
intake_feeds(Intake *self, void *Py_UNUSED(closure))
{
    PyObject *feeds = self->feeds == NULL ? Py_None : self->feeds;
    Py_INCREF(feeds);
    return feeds;
}

static int
intake_set_feeds(Intake *self, PyObject *value, void *Py_UNUSED(closure))
{
    Py_ssize_t pairs = 0;
    const Py_ssize_t size = value != NULL && PyTuple_CheckExact(value) ? PyTuple_Size(value) : -1;
    for (; pairs < size; pairs++) {
        PyObject *pair = PyTuple_GetItem(value, pairs);
        if (!PyTuple_CheckExact(pair) || PyTuple_Size(pair) != 2
            || !PyObject_TypeCheck(PyTuple_GetItem(pair, 0), FeedType)) {
            break;
        }
    }
    if (pairs != size) {
        PyErr_SetString(PyExc_TypeError, "feeds must be a tuple of pairs of a Feed and a callable");
        return -1;
    }
    PyObject *old = self->feeds;
    Py_INCREF(value);
    self->feeds = value;
    Py_XDECREF(old);
    return 0;
}

static PyMethodDef intake_methods[] = {
    {"take", FAST(intake_take), METH_FASTCALL,
     PyDoc_STR("take(samples, invalid): judge a batch and insert it into all buffers if it is plain and nobody else "
               "listens: True; None if the judge does not accept it, False if it was not asked.")},
    {NULL}
};

static PyGetSetDef intake_getset[] = {
    {"feeds", (getter)intake_feeds, (setter)intake_set_feeds,
     PyDoc_STR("A tuple of (Feed, callable that takes a batch which is not plain)."), NULL},
    {NULL}
};

static PyMemberDef intake_members[] = {
    {"samples", T_LONGLONG, offsetof(Intake, samples), 0, PyDoc_STR("The number of samples that were taken.")},
    {"thread", T_ULONG, offsetof(Intake, thread), 0, PyDoc_STR("The only thread that may publish.")},
    {"open", T_BOOL, offsetof(Intake, open), 0, PyDoc_STR("Whether it takes batches.")},
    {NULL}
};

static PyType_Slot intake_slots[] = {
    {Py_tp_doc, (void *)PyDoc_STR("The fast path of published samples into the buffers of a bus.")},
    {Py_tp_new, PyType_GenericNew},
    {Py_tp_init, intake_init},
    {Py_tp_dealloc, intake_dealloc},
    {Py_tp_traverse, intake_traverse},
    {Py_tp_clear, intake_clear},
    {Py_tp_methods, intake_methods},
    {Py_tp_members, intake_members},
    {Py_tp_getset, intake_getset},
    {0, NULL}
};

static PyType_Spec intake_spec = {
    "tfbus._kernel.Intake", sizeof(Intake), 0, Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC, intake_slots
};

/* Messages ---------------------------------------------------------------------------------------------------------- */

/* A sample of a message whose names and tag are known; NULL with or without an error if it is not plain. */
static PyObject *
decoded_sample(PyTypeObject *kind, PyObject *names, PyObject *tag, int64_t stamp, const char *row)
{
    static PyObject *nothing;
    if (nothing == NULL && (nothing = PyTuple_New(0)) == NULL) {
        return NULL;
    }
    if (!PyTuple_Check(names) || PyTuple_Size(names) != 2 || !PyTuple_Check(tag) || PyTuple_Size(tag) != 2) {
        return NULL;
    }
    PyObject *parent = PyTuple_GetItem(names, 0), *child = PyTuple_GetItem(names, 1);
    PyObject *authority = PyTuple_GetItem(tag, 0);
    if (!PyUnicode_CheckExact(parent) || !PyUnicode_CheckExact(child) || !PyUnicode_CheckExact(authority)) {
        return NULL;
    }
    Sample *sample = (Sample *)((newfunc)PyType_GetSlot(kind, Py_tp_new))(kind, nothing, NULL);
    if (sample == NULL) {
        return NULL;
    }
    sample->parent = Py_NewRef(parent);
    sample->child = Py_NewRef(child);
    sample->authority = Py_NewRef(authority);
    sample->stamp = stamp;
    memcpy(sample->row, row, ROW_SIZE);
    sample->is_static = PyTuple_GetItem(tag, 1) == Py_True;
    return OBJECT(sample);
}

/* Decode the plain samples at the beginning of a message: little endian, with names that were decoded before. */
static PyObject *
decode(PyObject *Py_UNUSED(module), PyObject *const *args, Py_ssize_t nargs)
{
    if (nargs != 5 || !PyBytes_Check(args[0]) || !PyTuple_Check(args[2]) || !PyDict_Check(args[3])
        || !PyType_Check(args[4]) || !PyType_IsSubtype((PyTypeObject *)args[4], SampleType)) {
        PyErr_SetString(PyExc_TypeError, "decode takes bytes, an offset, tags, known names and a type of samples");
        return NULL;
    }
    const char *body = PyBytes_AsString(args[0]);
    const int64_t size = PyBytes_Size(args[0]);
    int64_t at = PyLong_AsLongLong(args[1]);
    const Py_ssize_t count = PyTuple_Size(args[2]);
    PyObject *samples = at == -1 && PyErr_Occurred() ? NULL : PyList_New(0);
    for (Py_ssize_t i = 0; samples != NULL && i < count; i++) {
        int32_t seconds;
        uint32_t nanoseconds, length;
        double row[WIDTH];
        if (at < 0 || at > size - 12) {
            break;
        }
        memcpy(&seconds, body + at, 4);
        memcpy(&nanoseconds, body + at + 4, 4);
        memcpy(&length, body + at + 8, 4);
        const int64_t middle = (at + 12 + length + 3) & -4;
        if (middle > size - 4) {
            break;
        }
        memcpy(&length, body + middle, 4);
        const int64_t end = (middle + 4 + length + 7) & -8;
        if (end > size - (int64_t)ROW_SIZE) {
            break;
        }
        memcpy(row, body + end, ROW_SIZE);
        const double off = row[3] * row[3] + row[4] * row[4] + row[5] * row[5] + row[6] * row[6] - 1.0;
        /* Zero times a number that is not finite is NaN. */
        if (!(off >= -ROUNDING && off <= ROUNDING) || !((row[0] + row[1] + row[2]) * 0.0 == 0.0)
            || nanoseconds >= 1000000000) {
            break;
        }
        PyObject *piece = PyBytes_FromStringAndSize(body + at + 8, (Py_ssize_t)(end - at - 8));
        PyObject *names = piece == NULL ? NULL : PyDict_GetItemWithError(args[3], piece);
        Py_XDECREF(piece);
        PyObject *sample = names == NULL ? NULL
                                         : decoded_sample((PyTypeObject *)args[4], names, PyTuple_GetItem(args[2], i),
                                                          (int64_t)seconds * 1000000000 + nanoseconds, body + end);
        if (sample == NULL || PyList_Append(samples, sample) < 0) {
            Py_XDECREF(sample);
            if (PyErr_Occurred()) {
                Py_CLEAR(samples);
            }
            break;
        }
        Py_DECREF(sample);
        at = end + (int64_t)ROW_SIZE;
    }
    return samples == NULL ? NULL : Py_BuildValue("(NL)", samples, (long long)at);
}

/* The module -------------------------------------------------------------------------------------------------------- */

static PyObject *
compose_paths(PyObject *Py_UNUSED(module), PyObject *const *args, Py_ssize_t nargs)
{
    Py_buffer buffers[2], *const rows = &buffers[0], *const origins = &buffers[1];
    if (!open_buffers(args, nargs, buffers, PyBUF_WRITABLE, PyBUF_SIMPLE)) {
        return NULL;
    }
    const Py_ssize_t size = (Py_ssize_t)sizeof(int64_t), count = origins->len / size;
    const int fits = origins->len % size == 0 && rows->len % (Py_ssize_t)ROW_SIZE == 0
                     && rows->len / (Py_ssize_t)ROW_SIZE == count;
    Py_ssize_t i = 0;
    for (; fits && i < count; i++) {
        const int64_t origin = ((const int64_t *)origins->buf)[i];
        if (origin < 0 || (origin > 0 && origin >= i)) {
            break;
        }
        if (origin > 0) {
            double *row = (double *)rows->buf + WIDTH * i;
            compose((const double *)rows->buf + WIDTH * origin, row, row);
        }
    }
    close_buffers(buffers);
    if (!fits || i < count) {
        PyErr_SetString(PyExc_ValueError, "each row of seven floats needs an origin before it");
        return NULL;
    }
    Py_RETURN_NONE;
}

static PyMethodDef module_methods[] = {
    {"compose_paths", FAST(compose_paths), METH_FASTCALL,
     PyDoc_STR("compose_paths(rows, origins): make every pose relative to the first one.")},
    {"decode", FAST(decode), METH_FASTCALL,
     PyDoc_STR("decode(body, at, tags, names, kind): the samples of a message up to the first that is not plain, and "
               "its offset.")},
    {"commit", FAST(commit), METH_FASTCALL,
     PyDoc_STR("commit(frames, batch, first): store the samples from `first` to the first that is not plain; its "
               "index.")},
    {NULL}
};

static int
add_type(PyObject *module, const char *name, PyType_Spec *spec, PyTypeObject **type)
{
    if (*type == NULL && (*type = (PyTypeObject *)PyType_FromSpec(spec)) == NULL) {
        return -1;
    }
    return PyModule_AddObjectRef(module, name, (PyObject *)*type);
}

static PyObject *
imported(const char *module, const char *name)
{
    PyObject *found = PyImport_ImportModule(module);
    PyObject *value = found == NULL ? NULL : PyObject_GetAttrString(found, name);
    Py_XDECREF(found);
    return value;
}

static int
module_exec(PyObject *module)
{
    /* The types are shared by the whole process, as are those of numpy. */
    if (PyInterpreterState_GetID(PyInterpreterState_Get()) != 0) {
        PyErr_SetString(PyExc_ImportError, "the compiled kernel of tfbus runs in the main interpreter only");
        return -1;
    }
    const struct {
        const char *text;
        PyObject **place;
    } strings[] = {{"", &empty_string}, {"raise", &raise_string}, {"drop", &drop_string},
                   {"at", &at_string}, {"_paths", &paths_string}, {"_memory", &memory_string}};
    for (size_t i = 0; i < sizeof strings / sizeof *strings; i++) {
        if (*strings[i].place == NULL && (*strings[i].place = PyUnicode_InternFromString(strings[i].text)) == NULL) {
            return -1;
        }
    }
    if ((bound_method == NULL && (bound_method = imported("types", "MethodType")) == NULL)
        || (array_type == NULL && (array_type = imported("numpy", "ndarray")) == NULL)) {
        return -1;
    }
    if (add_type(module, "Sample", &sample_spec, &SampleType) < 0
        || add_type(module, "Block", &block_spec, &BlockType) < 0
        || add_type(module, "History", &history_spec, &HistoryType) < 0
        || add_type(module, "Chain", &chain_spec, &ChainType) < 0
        || add_type(module, "Held", &held_spec, &HeldType) < 0
        || add_type(module, "Paths", &paths_spec, &PathsType) < 0
        || add_type(module, "Edge", &edge_spec, &EdgeType) < 0 || add_type(module, "Judge", &judge_spec, &JudgeType) < 0
        || add_type(module, "Parked", &parked_spec, &ParkedType) < 0
        || add_type(module, "Line", &line_spec, &LineType) < 0 || add_type(module, "Feed", &feed_spec, &FeedType) < 0
        || add_type(module, "Intake", &intake_spec, &IntakeType) < 0
        || add_type(module, "Method", &method_spec, &MethodType) < 0) {
        return -1;
    }
    return 0;
}

static PyModuleDef_Slot module_slots[] = {{Py_mod_exec, module_exec}, {0, NULL}};

static struct PyModuleDef module_definition = {
    PyModuleDef_HEAD_INIT, "tfbus._kernel", PyDoc_STR("The compiled kernel of tfbus."), 0, module_methods, module_slots,
    NULL, NULL, NULL
};

PyMODINIT_FUNC
PyInit__kernel(void)
{
    return PyModuleDef_Init(&module_definition);
}

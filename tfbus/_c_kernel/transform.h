/* Transforms: the arithmetic behind `Transform`, from one product to all points of a cloud.
 *
 * These are functions on rows and buffers, and not a type: a row is shared as it is by transforms, samples and answers,
 * and Python makes the objects. Their definitions are the functions of the same names in tfbus/_python_kernel.py. They
 * return None or False for arguments that are not plain, such as numbers of numpy, and Python then computes by its own
 * rules. Nothing here reads the settings of numpy or warns: NaN and infinity go through.
 */

static PyObject *
compose_rows(PyObject *Py_UNUSED(module), PyObject *const *args, Py_ssize_t nargs)
{
    double a[WIDTH], b[WIDTH];
    if (nargs != 2) {
        PyErr_SetString(PyExc_TypeError, "compose_rows takes two rows");
        return NULL;
    }
    if (read_row(args[0], a) < 0 || read_row(args[1], b) < 0) {
        return NULL;
    }
    compose(a, b, b);
    return boxed_row(b);
}

static PyObject *
invert_row(PyObject *Py_UNUSED(module), PyObject *boxed)
{
    double row[WIDTH], inverse[WIDTH];
    if (read_row(boxed, row) < 0) {
        return NULL;
    }
    invert(row, inverse);
    return boxed_row(inverse);
}

/* A number that is a float or an int, and no instance of a derived class; 0 for anything else. */
static int
read_plain_number(PyObject *number, double *value)
{
    if (!PyFloat_CheckExact(number) && !PyLong_CheckExact(number)) {
        return 0;
    }
    *value = PyFloat_AsDouble(number);
    if (*value == -1.0 && PyErr_Occurred()) {
        /* A huge int. */
        PyErr_Clear();
        return 0;
    }
    return 1;
}

static PyObject *
move_point(PyObject *Py_UNUSED(module), PyObject *const *args, Py_ssize_t nargs)
{
    /* A point is moved as the translation of a transform is. */
    double row[WIDTH], point[WIDTH] = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0};
    if (nargs != 2) {
        PyErr_SetString(PyExc_TypeError, "move_point takes a row and a point");
        return NULL;
    }
    if (!PyTuple_CheckExact(args[1]) || PyTuple_Size(args[1]) != 3) {
        Py_RETURN_NONE;
    }
    for (int i = 0; i < 3; i++) {
        if (!read_plain_number(PyTuple_GetItem(args[1], i), &point[i])) {
            Py_RETURN_NONE;
        }
    }
    if (read_row(args[0], row) < 0) {
        return NULL;
    }
    compose(row, point, point);
    PyObject *moved = PyTuple_New(3);
    for (int i = 0; moved != NULL && i < 3; i++) {
        PyObject *number = PyFloat_FromDouble(point[i]);
        if (number == NULL || PyTuple_SetItem(moved, i, number) < 0) {
            Py_CLEAR(moved);
        }
    }
    return moved;
}

/* The first three rows of the homogeneous matrix, by the formula of transforms3d's quat2mat. */
static void
matrix_of(const double *row, double *out)
{
    const double x = row[3], y = row[4], z = row[5], w = row[6];
    const double s = 2.0 / (w * w + x * x + y * y + z * z);
    const double sx = x * s, sy = y * s, sz = z * s;
    const double wx = w * sx, wy = w * sy, wz = w * sz, xx = x * sx, xy = x * sy, xz = x * sz;
    const double yy = y * sy, yz = y * sz, zz = z * sz;
    const double matrix[12] = {1.0 - (yy + zz), xy - wz, xz + wy, row[0],
                               xy + wz, 1.0 - (xx + zz), yz - wx, row[1],
                               xz - wy, yz + wx, 1.0 - (xx + yy), row[2]};
    memcpy(out, matrix, sizeof matrix);
}

/* Whether a buffer holds contiguous floats of a kind, 'd' or 'f', and how many. */
static int
holds_floats(const Py_buffer *view, char kind, Py_ssize_t *count)
{
    *count = view->itemsize > 0 ? view->len / view->itemsize : 0;
    return view->format != NULL && view->format[0] == kind && view->format[1] == 0;
}

static PyObject *
fill_matrix(PyObject *Py_UNUSED(module), PyObject *const *args, Py_ssize_t nargs)
{
    double row[WIDTH];
    Py_buffer out;
    Py_ssize_t count;
    if (nargs != 2) {
        PyErr_SetString(PyExc_TypeError, "fill_matrix takes a row and an array");
        return NULL;
    }
    if (read_row(args[0], row) < 0
        || PyObject_GetBuffer(args[1], &out, PyBUF_WRITABLE | PyBUF_C_CONTIGUOUS | PyBUF_FORMAT) < 0) {
        return NULL;
    }
    const int fits = holds_floats(&out, 'd', &count) && count == 16;
    if (fits) {
        const double last[4] = {0.0, 0.0, 0.0, 1.0};
        matrix_of(row, out.buf);
        memcpy((double *)out.buf + 12, last, sizeof last);
    }
    PyBuffer_Release(&out);
    if (!fits) {
        PyErr_SetString(PyExc_ValueError, "a matrix is a contiguous float64 array of shape (4, 4)");
        return NULL;
    }
    Py_INCREF(args[1]);
    return args[1];
}

#define NEARLY_RIGID 1e-14 /* the largest error of a product of two columns for which the quaternion is read directly */

/* Whether a homogeneous matrix is finite and rigid but for rounding; then `row` is its row, with w >= 0. Read by
 * Shepperd, "Quaternion from rotation matrix", 1978: the part of the quaternion with the greatest square comes first. */
static int
read_matrix(const double *m, double *row)
{
    if (m[12] != 0.0 || m[13] != 0.0 || m[14] != 0.0 || m[15] != 1.0 || !((m[3] + m[7] + m[11]) * 0.0 == 0.0)) {
        return 0;
    }
    for (int i = 0; i < 3; i++) {
        const double *a = m + 4 * i;
        for (int j = i; j < 3; j++) {
            const double *b = m + 4 * j;
            const double off = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] - (i == j ? 1.0 : 0.0);
            if (!(-NEARLY_RIGID <= off && off <= NEARLY_RIGID)) {
                return 0;
            }
        }
    }
    const double det = m[0] * (m[5] * m[10] - m[6] * m[9]) - m[1] * (m[4] * m[10] - m[6] * m[8])
                       + m[2] * (m[4] * m[9] - m[5] * m[8]);
    if (!(det > 0.0)) {
        return 0;
    }
    const double squares[4] = {1.0 + m[0] - m[5] - m[10], 1.0 - m[0] + m[5] - m[10], 1.0 - m[0] - m[5] + m[10],
                               1.0 + m[0] + m[5] + m[10]};
    int first = 3;
    for (int k = 0; k < 3; k++) {
        first = squares[k] > squares[first] ? k : first;
    }
    /* Four times the products of the first part with all four, one column a first part. */
    const double xy = m[4] + m[1], xz = m[8] + m[2], yz = m[9] + m[6];
    const double xw = m[9] - m[6], yw = m[2] - m[8], zw = m[4] - m[1];
    const double products[4][4] = {{squares[0], xy, xz, xw}, {xy, squares[1], yz, yw}, {xz, yz, squares[2], zw},
                                   {xw, yw, zw, squares[3]}};
    const double *q = products[first];
    const double length = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    const double scale = q[3] < 0.0 ? -length : length;
    for (int k = 0; k < 3; k++) {
        row[k] = m[4 * k + 3];
    }
    for (int k = 0; k < 4; k++) {
        row[3 + k] = q[k] / scale;
    }
    return 1;
}

static PyObject *
row_of_matrix(PyObject *Py_UNUSED(module), PyObject *matrix)
{
    double row[WIDTH];
    Py_buffer view;
    Py_ssize_t count;
    const int is_plain = is_array(matrix);
    if (is_plain < 0) {
        return NULL;
    }
    if (!is_plain) {
        Py_RETURN_NONE;
    }
    if (PyObject_GetBuffer(matrix, &view, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT) < 0) {
        PyErr_Clear();
        Py_RETURN_NONE;
    }
    const int plain = view.ndim == 2 && view.shape[0] == 4 && view.shape[1] == 4 && holds_floats(&view, 'd', &count)
                      && read_matrix(view.buf, row);
    PyBuffer_Release(&view);
    if (!plain) {
        Py_RETURN_NONE;
    }
    return boxed_row(row);
}

/* Points of one kind of float, moved by a matrix. */
#define MOVE(number)                                                                                    \
    static void move_##number##s(const double *matrix, const number *from, number *to, Py_ssize_t count) \
    {                                                                                                   \
        number m[12];                                                                                   \
        for (int k = 0; k < 12; k++) {                                                                  \
            m[k] = (number)matrix[k];                                                                   \
        }                                                                                               \
        for (Py_ssize_t i = 0; i < count; i++, from += 3, to += 3) {                                    \
            const number x = from[0], y = from[1], z = from[2];                                         \
            to[0] = x * m[0] + y * m[1] + z * m[2] + m[3];                                              \
            to[1] = x * m[4] + y * m[5] + z * m[6] + m[7];                                              \
            to[2] = x * m[8] + y * m[9] + z * m[10] + m[11];                                            \
        }                                                                                               \
    }
MOVE(double)
MOVE(float)

enum { MANY_POINTS = 10000 }; /* from which on other threads may run meanwhile */

static PyObject *
move_points(PyObject *Py_UNUSED(module), PyObject *const *args, Py_ssize_t nargs)
{
    double row[WIDTH], matrix[12];
    Py_buffer from, to;
    Py_ssize_t count, room;
    if (nargs != 3) {
        PyErr_SetString(PyExc_TypeError, "move_points takes a row, points and an array for the moved ones");
        return NULL;
    }
    if (read_row(args[0], row) < 0) {
        return NULL;
    }
    if (PyObject_GetBuffer(args[1], &from, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT) < 0) {
        PyErr_Clear();
        Py_RETURN_FALSE;
    }
    if (PyObject_GetBuffer(args[2], &to, PyBUF_WRITABLE | PyBUF_C_CONTIGUOUS | PyBUF_FORMAT) < 0) {
        PyBuffer_Release(&from);
        PyErr_Clear();
        Py_RETURN_FALSE;
    }
    const int doubles = holds_floats(&from, 'd', &count) && holds_floats(&to, 'd', &room);
    const int plain = (doubles || (holds_floats(&from, 'f', &count) && holds_floats(&to, 'f', &room)))
                      && count == room && count % 3 == 0;
    if (plain) {
        matrix_of(row, matrix);
        PyThreadState *state = count < 3 * MANY_POINTS ? NULL : PyEval_SaveThread();
        if (doubles) {
            move_doubles(matrix, from.buf, to.buf, count / 3);
        } else {
            move_floats(matrix, from.buf, to.buf, count / 3);
        }
        if (state != NULL) {
            PyEval_RestoreThread(state);
        }
    }
    PyBuffer_Release(&to);
    PyBuffer_Release(&from);
    return PyBool_FromLong(plain);
}

/* Samples and histories: one stamped transform, the samples of an edge, a row between two of them, and storing a batch.
 *
 * A Sample holds its fields as C has them; tuples and numbers are made when Python reads them, and stay (`fields`).
 *
 * A History is the window of one edge: a Block, and the part [start, end) of it. The block holds all stamps, then all
 * rows. Appending writes behind `end`; samples that leave the window only move `start`. When a block is full, or a
 * change would touch what a reader of it has seen, the history moves into a new block and leaves the old one to its
 * readers. So a reader needs no lock: what it saw when it began stays where it is.
 *
 * Interpolation goes in lanes: the segments of up to LANES rows are found, then all turns, then all rows are blended.
 * One row is one lane. The steps of one row wait for each other and those of several rows do not, so a chain of ten
 * edges costs little more than its acos and sin.
 *
 * `store` is the way in for batches. It stops at the first sample that does not simply continue its history, which
 * Python stores; or it takes all back, if the caller wants the whole batch or nothing. Until then no window slides, so
 * taking back is `end--`.
 */

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

/* Batches: tuples of samples, or columns ----------------------------------------------------------------------------- */

/* Rows of numbers that can be samples. The objects are made only if somebody needs them. */
typedef struct {
    PyObject_HEAD
    PyObject *parents, *children; /* a plain str for all rows, or a tuple of these */
    PyObject *authority;          /* a plain str */
    Py_buffer buffers[2];         /* the stamps, and seven floats a row; both have memory, or none */
    Py_ssize_t count;
    char is_static;
} Columns;

static int
same_string(PyObject *a, PyObject *b)
{
    return a == b || (a != NULL && b != NULL && PyUnicode_Compare(a, b) == 0);
}

static Py_ssize_t
batch_size(PyObject *batch)
{
    return PyTuple_CheckExact(batch) ? PyTuple_Size(batch) : ((Columns *)batch)->count;
}

/* The class of usual samples; NULL until the first Paths. Borrowed, and only compared. */
static PyObject *plain_kind;
/* Another class that was met last, and whether its samples know more than their fields. */
static PyObject *met_kind;
static int met_knows_more;

/* Whether Python has to store a sample, because it notes what the sample knows more, such as a covariance: then its
 * class has a false `_is_plain`. */
static int
knows_more(const Sample *sample)
{
    PyObject *kind = OBJECT(Py_TYPE(OBJECT(sample)));
    if (kind == plain_kind) {
        return 0;
    }
    if (kind != met_kind) {
        PyObject *before = met_kind, *is_plain = PyObject_GetAttrString(kind, "_is_plain");
        if (is_plain == NULL) {
            const int has_none = PyErr_ExceptionMatches(PyExc_AttributeError);
            PyErr_Clear();
            if (!has_none) {
                return 1;
            }
        }
        met_knows_more = is_plain == Py_False;
        met_kind = Py_NewRef(kind);
        Py_XDECREF(is_plain);
        Py_XDECREF(before);
    }
    return met_knows_more;
}

static int
is_batch(PyObject *value)
{
    return PyTuple_CheckExact(value) || OBJECT(Py_TYPE(value)) == OBJECT(ColumnsType);
}

static PyObject *
name_at(PyObject *names, Py_ssize_t row)
{
    return PyUnicode_CheckExact(names) ? names : PyTuple_GetItem(names, row);
}

/* A sample of a batch; one of columns is in `scratch`, and borrows its names. NULL for another object in a tuple. */
static inline const Sample *
sample_at(PyObject *batch, Py_ssize_t i, Sample *scratch)
{
    if (PyTuple_CheckExact(batch)) {
        PyObject *item = PyTuple_GetItem(batch, i);
        return PyObject_TypeCheck(item, SampleType) && ((Sample *)item)->authority != NULL ? (Sample *)item : NULL;
    }
    const Columns *columns = (const Columns *)batch;
    scratch->parent = name_at(columns->parents, i);
    scratch->child = name_at(columns->children, i);
    scratch->authority = columns->authority;
    scratch->stamp = ((const int64_t *)columns->buffers[0].buf)[i];
    memcpy(scratch->row, (const double *)columns->buffers[1].buf + WIDTH * i, ROW_SIZE);
    scratch->is_static = columns->is_static;
    return scratch;
}

/* Whether a row is finite, its quaternion within a hundredth of a unit one, and the square of its translation at most
 * `square`. Then the quaternion is normalised: tfbus.rows.as_rotation. */
static int
make_rigid(double *row, double square)
{
    const double norm_square = row[3] * row[3] + row[4] * row[4] + row[5] * row[5] + row[6] * row[6];
    /* Not `>`, which is false for NaN. */
    if (!(fabs(norm_square - 1.0) <= ROUNDING)) {
        const double norm = sqrt(norm_square);
        if (!(fabs(norm - 1.0) <= NORM_TOLERANCE)) {
            return 0;
        }
        for (int k = 3; k < WIDTH; k++) {
            row[k] /= norm;
        }
    }
    return row[0] * row[0] + row[1] * row[1] + row[2] * row[2] <= square;
}

static int
names_a_frame(PyObject *name)
{
    return PyUnicode_CheckExact(name) && PyUnicode_GetLength(name) > 0 && PyUnicode_ReadChar(name, 0) != '/';
}

/* Whether all rows are plain; -1 for an error. */
static int
columns_are_plain(Columns *self, double square)
{
    PyObject *parent = NULL, *child = NULL;
    for (Py_ssize_t i = 0; i < self->count; i++) {
        PyObject *above = name_at(self->parents, i), *below = name_at(self->children, i);
        if ((above != parent || below != child)
            && (!names_a_frame(above) || !names_a_frame(below) || same_string(above, below))) {
            return 0;
        }
        parent = above;
        child = below;
        if (!make_rigid((double *)self->buffers[1].buf + WIDTH * i, square)) {
            return 0;
        }
    }
    return 1;
}

static int
fits(PyObject *names, Py_ssize_t count)
{
    return PyUnicode_CheckExact(names) || (PyTuple_CheckExact(names) && PyTuple_Size(names) == count);
}

/* columns(parents, children, stamps, rows, authority, static, square) */
static PyObject *
columns(PyObject *Py_UNUSED(module), PyObject *const *args, Py_ssize_t nargs)
{
    if (nargs != 7 || !PyUnicode_CheckExact(args[4])) {
        PyErr_SetString(PyExc_TypeError, "columns takes parents, children, stamps, rows, an authority, whether they are "
                                         "static, and the greatest square");
        return NULL;
    }
    const int is_static = PyObject_IsTrue(args[5]);
    const double square = PyFloat_AsDouble(args[6]);
    Columns *self = PyErr_Occurred() ? NULL : (Columns *)PyType_GenericAlloc(ColumnsType, 0);
    if (self == NULL || !open_buffers(args + 2, 2, self->buffers, PyBUF_SIMPLE, PyBUF_WRITABLE)) {
        Py_XDECREF(OBJECT(self));
        return NULL;
    }
    self->count = self->buffers[0].len / (Py_ssize_t)sizeof(int64_t);
    self->parents = Py_NewRef(args[0]);
    self->children = Py_NewRef(args[1]);
    self->authority = Py_NewRef(args[4]);
    self->is_static = (char)is_static;
    if (self->buffers[1].len != self->count * (Py_ssize_t)ROW_SIZE || !fits(args[0], self->count)
        || !fits(args[1], self->count)) {
        PyErr_SetString(PyExc_ValueError, "each row needs two names, a stamp and seven floats");
        Py_DECREF(OBJECT(self));
        return NULL;
    }
    if (columns_are_plain(self, square)) {
        return OBJECT(self);
    }
    Py_DECREF(OBJECT(self));
    Py_RETURN_NONE;
}

/* The samples as a tuple of objects. */
static PyObject *
columns_samples(PyObject *self, PyObject *kind)
{
    if (!PyType_Check(kind) || !PyType_IsSubtype((PyTypeObject *)kind, SampleType)) {
        PyErr_SetString(PyExc_TypeError, "samples takes a type of samples");
        return NULL;
    }
    const Py_ssize_t count = ((Columns *)self)->count;
    PyObject *samples = PyTuple_New(count);
    for (Py_ssize_t i = 0; samples != NULL && i < count; i++) {
        Sample scratch, *sample = (Sample *)PyType_GenericAlloc((PyTypeObject *)kind, 0);
        if (sample == NULL) {
            Py_CLEAR(samples);
            break;
        }
        sample_at(self, i, &scratch);
        sample->parent = Py_NewRef(scratch.parent);
        sample->child = Py_NewRef(scratch.child);
        sample->authority = Py_NewRef(scratch.authority);
        sample->stamp = scratch.stamp;
        memcpy(sample->row, scratch.row, ROW_SIZE);
        sample->is_static = scratch.is_static;
        if (PyTuple_SetItem(samples, i, OBJECT(sample)) < 0) {
            Py_CLEAR(samples);
        }
    }
    return samples;
}

static Py_ssize_t
columns_length(PyObject *self)
{
    return ((Columns *)self)->count;
}

static void
columns_dealloc(Columns *self)
{
    close_buffers(self->buffers);
    Py_XDECREF(self->parents);
    Py_XDECREF(self->children);
    Py_XDECREF(self->authority);
    let_go_of(OBJECT(self));
}

static PyMethodDef columns_methods[] = {
    {"samples", (PyCFunction)columns_samples, METH_O, PyDoc_STR("samples(kind): the rows as a tuple of samples.")},
    {NULL}
};

static PyType_Slot columns_slots[] = {
    {Py_tp_doc, (void *)PyDoc_STR("Rows of numbers that can be samples.")},
    {Py_tp_dealloc, columns_dealloc},
    {Py_tp_methods, columns_methods},
    {Py_sq_length, columns_length},
    {0, NULL}
};

static PyType_Spec columns_spec = {
    "tfbus._kernel.Columns", sizeof(Columns), 0,
    Py_TPFLAGS_DEFAULT | Py_TPFLAGS_DISALLOW_INSTANTIATION | Py_TPFLAGS_IMMUTABLETYPE, columns_slots
};

/* Block: the memory of a history ----------------------------------------------------------------------------------- */

/* The stamps of all samples, then their rows. A reader reads the samples that the block had when the reading began.
 * While a block has readers, its history only appends samples, and takes another block for every other change. */
typedef struct {
    PyObject_HEAD
    Py_ssize_t readers; /* how many read it besides its history */
    Py_ssize_t capacity;
    void *memory;
} Block;

static int64_t *
block_stamps(const Block *block)
{
    return block->memory;
}

static double *
block_rows(const Block *block)
{
    return (double *)(block_stamps(block) + block->capacity);
}

static Block *
block_new(Py_ssize_t capacity)
{
    Block *block = (Block *)PyType_GenericAlloc(BlockType, 0);
    if (block == NULL) {
        return NULL;
    }
    /* Not zeroed: the system gives a large block page by page, when it is written to. */
    block->memory = PyMem_Malloc((size_t)capacity * SAMPLE_SIZE);
    block->capacity = capacity;
    if (block->memory == NULL) {
        Py_DECREF(OBJECT(block));
        PyErr_NoMemory();
        return NULL;
    }
    return block;
}

/* Copy some samples from one block to a place in another. */
static void
block_copy(const Block *from, Py_ssize_t first, Py_ssize_t count, Block *to, Py_ssize_t place)
{
    memcpy(block_stamps(to) + place, block_stamps(from) + first, (size_t)count * sizeof(int64_t));
    memcpy(block_rows(to) + WIDTH * place, block_rows(from) + WIDTH * first, (size_t)count * ROW_SIZE);
}

static int
block_getbuffer(Block *self, Py_buffer *view, int flags)
{
    const Py_ssize_t size = self->capacity * (Py_ssize_t)SAMPLE_SIZE;
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
    PyMem_Free(((Block *)self)->memory);
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
    "tfbus._kernel.Block", sizeof(Block), 0,
    Py_TPFLAGS_DEFAULT | Py_TPFLAGS_DISALLOW_INSTANTIATION | Py_TPFLAGS_IMMUTABLETYPE, block_slots
};

/* History ---------------------------------------------------------------------------------------------------------- */

typedef struct {
    PyObject_HEAD
    PyObject *parent, *authority; /* plain str, of the newest sample */
    PyObject *static_stamp;       /* the stamp of the sample that holds at every stamp, in ns; None or NULL for none */
    Block *block;                 /* NULL until there is a sample */
    Py_ssize_t start, end;        /* the samples in the window */
    Block *next;                  /* the block that it moves into, or NULL */
    Py_ssize_t from, moved;       /* the place of the first sample of `next` in `block`, and how many it has */
    Block *left;                  /* the block that it has moved out of, while its memory is given back, or NULL */
    int64_t keep;                 /* ns; -1 for ever */
    int64_t asked;                /* the stamp between two samples that was asked for last */
    double row[WIDTH];            /* of that stamp; it holds as long as the stamp is in the window */
    char has_row;                 /* whether there is such a row */
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

/* A history of many samples that is about to need another block moves there bit by bit, a few samples with each new
 * one, and gives the memory of the old block back bit by bit too. All at once, either would hold up the event loop. It
 * has moved long before the present block is full. A change that is not an append ends the move; it begins anew. */
enum {
    MANY = 1 << 14,   /* a history of fewer samples moves at once */
    BIT = 16,         /* samples that move with each new one */
    GIVEN = 1 << 12,  /* samples whose memory is given back at once, */
    GIVEN_EACH = 64   /* with each so many new ones */
};

/* The capacity of a block for some samples. To copy many more seldom, many get more room, which costs no memory until
 * it is used. */
static Py_ssize_t
capacity_for(Py_ssize_t count)
{
    return count + (count < MANY ? count / 8 : count / 2) + 7;
}

/* Change the block for another one or NULL, where the sample at `place` is the first. */
static void
history_change_block(History *self, Block *block, Py_ssize_t place)
{
    Block *old[] = {self->block, self->next == block ? NULL : self->next, self->left};
    self->block = block;
    self->next = self->left = NULL;
    self->start -= place;
    self->end -= place;
    for (int i = 0; i < 3; i++) {
        Py_XDECREF(OBJECT(old[i]));
    }
}

static void
history_stop_moving(History *self)
{
    Block *next = self->next;
    self->next = NULL;
    Py_XDECREF(OBJECT(next));
}

static void
history_give_back(History *self)
{
    Block *left = self->left;
    if (self->end % GIVEN_EACH != 0) {
        return;
    }
    if (left->readers == 0 && left->capacity > MANY) {
        const Py_ssize_t capacity = left->capacity - GIVEN;
        void *memory = PyMem_Realloc(left->memory, (size_t)capacity * SAMPLE_SIZE);
        if (memory != NULL) {
            left->memory = memory;
            left->capacity = capacity;
            return;
        }
    }
    self->left = NULL;
    Py_DECREF(OBJECT(left));
}

static void
history_move(History *self)
{
    const Py_ssize_t count = self->end - self->start;
    if (self->left != NULL) {
        history_give_back(self);
    }
    if (self->next == NULL) {
        if (self->block->capacity - self->end > count / 8) {
            return;
        }
        self->next = block_new(capacity_for(count));
        self->from = self->start;
        self->moved = 0;
        if (self->next == NULL) {
            PyErr_Clear();
            return;
        }
    }
    Py_ssize_t some = self->end - self->from - self->moved;
    if (some < 0) {
        /* The last samples were taken back. */
        self->moved += some;
        some = 0;
    }
    some = some < BIT ? some : BIT;
    block_copy(self->block, self->from + self->moved, some, self->next, self->moved);
    self->moved += some;
    if (self->from + self->moved == self->end) {
        Block *left = self->block;
        Py_INCREF(OBJECT(left));
        history_change_block(self, self->next, self->from);
        self->left = left;
    }
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
    Block *block = block_new(capacity_for(count + more));
    if (block == NULL) {
        return -1;
    }
    if (count > 0) {
        block_copy(self->block, self->start, count, block, 0);
    }
    history_change_block(self, block, self->start);
    return 0;
}

/* Make room for some samples behind the last. */
static int
history_reserve(History *self, Py_ssize_t more)
{
    if (self->block != NULL && more <= self->block->capacity - self->end) {
        return 0;
    }
    const Py_ssize_t count = self->end - self->start;
    /* In place, if nobody else reads the block and the move pays off. */
    if (self->block != NULL && self->block->readers == 0 && self->start > count / 8
        && more <= self->block->capacity - count && self->block->capacity <= 2 * count + 16) {
        history_stop_moving(self);
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
    if (self->end - self->start >= MANY) {
        history_move(self);
    }
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
    PyObject *old[] = {self->parent, self->authority};
    self->parent = parent;
    Py_INCREF(empty_string);
    self->authority = empty_string;
    history_change_block(self, NULL, 0);
    self->start = self->end = 0;
    self->keep = window;
    self->mixed = self->has_row = 0;
    for (int i = 0; i < 2; i++) {
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
    history_stop_moving(self);
    self->has_row = 0;
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
    history_change_block(self, NULL, 0);
    self->start = self->end = 0;
    self->has_row = 0;
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
    const Py_ssize_t count = from->end - from->start;
    Block *block = block_new(capacity_for(count + 1));
    if (block == NULL) {
        return NULL;
    }
    if (count > 0) {
        block_copy(from->block, from->start, count, block, 0);
    }
    history_change_block(self, block, 0);
    self->start = 0;
    self->end = count;
    self->has_row = 0;
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
    const Py_ssize_t rows = (Py_ssize_t)sizeof(int64_t) * block->capacity + (Py_ssize_t)ROW_SIZE * at;
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
    Py_XDECREF(self->static_stamp);
    history_change_block(self, NULL, 0);
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
    {"static_stamp", T_OBJECT, offsetof(History, static_stamp), 0,
     PyDoc_STR("The stamp of the sample that holds at every stamp, in ns; None if there is none.")},
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

static inline Py_ALWAYS_INLINE Status
find_segment(const Samples *samples, int64_t at, Segment *segment)
{
    const Py_ssize_t last = samples->count - 1;
    if (last < 0 || at < samples->stamps[0] || at > samples->stamps[last]) {
        return MISSING;
    }
    const Py_ssize_t i = at == samples->stamps[last] ? last : lower_bound(samples->stamps, samples->count, at);
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

/* How far an answer may depart from its stamp: `Policy` of tfbus/tree/lookup.py, in ns; and how far it does. */
typedef struct {
    uint64_t tolerance, max_gap, hold; /* `max_gap` is UINT64_MAX for any */
    uint64_t extrapolated_by, gap;     /* the greatest over all edges */
} Policy;

static uint64_t
greater(uint64_t a, uint64_t b)
{
    return a > b ? a : b;
}

/* As `find_segment`, as far as a policy allows: `read_stamp` of tfbus/tree/lookup.py. */
static Status
find_segment_within(const Samples *samples, int64_t at, Policy *policy, Segment *segment)
{
    const Status status = find_segment(samples, at, segment);
    const Py_ssize_t last = samples->count - 1;
    uint64_t late = UINT64_MAX, early = UINT64_MAX;
    if (status == NOT_PLAIN || last < 0 || (status == ANSWERED && segment->a == NULL)) {
        return status;
    }
    if (status == ANSWERED) {
        const uint64_t gap = (uint64_t)segment->after - (uint64_t)segment->before;
        if (gap <= policy->max_gap) {
            policy->gap = greater(policy->gap, gap);
            return ANSWERED;
        }
        late = (uint64_t)at - (uint64_t)segment->before;
        early = (uint64_t)segment->after - (uint64_t)at;
    } else if (at > samples->stamps[last]) {
        late = (uint64_t)at - (uint64_t)samples->stamps[last];
        segment->a = samples->rows + WIDTH * last;
    } else {
        early = (uint64_t)samples->stamps[0] - (uint64_t)at;
        segment->b = samples->rows;
    }
    const int by_before = late <= greater(policy->tolerance, policy->hold);
    const int by_after = early <= policy->tolerance && !(by_before && late <= early);
    segment->b = by_after ? segment->b : segment->a;
    segment->a = NULL;
    policy->extrapolated_by = greater(policy->extrapolated_by, by_after ? early : late);
    return by_before || by_after ? ANSWERED : MISSING;
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

/* The plain commit -------------------------------------------------------------------------------------------------- */

enum { FEW = 64 }; /* samples whose histories fit on the stack */

/* Store the samples of a batch from the index `first` on, up to the first that is not plain; its index, or -1 for an
 * error. If `whole` is set and not all are plain, or out of memory, all histories are as before. */
static Py_ssize_t
store(PyObject *frames, PyObject *batch, Py_ssize_t first, int whole)
{
    const Py_ssize_t size = batch_size(batch);
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
    PyObject *child = NULL;
    History *history = NULL;
    while (first + stored < size) {
        Sample scratch;
        const Sample *sample = sample_at(batch, first + stored, &scratch);
        if (sample == NULL || sample->is_static || (sample != &scratch && knows_more(sample))) {
            break;
        }
        if (sample->child != child) {
            child = sample->child;
            PyObject *known = PyDict_GetItemWithError(frames, child);
            if (known == NULL || !PyObject_TypeCheck(known, HistoryType)) {
                failed = PyErr_Occurred() != NULL;
                break;
            }
            history = (History *)known;
        }
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

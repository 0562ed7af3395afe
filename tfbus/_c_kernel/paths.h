/* Chains, paths and answers: from the histories between two frames to what a lookup returns.
 *
 * A Chain is the edges from the source up to the common ancestor and from the target up to it. Neighbouring static
 * edges are one row. `chain_at` answers at one stamp; a Held is a look at the samples of all edges at one moment, and
 * answers at many stamps, in columns of LANES rows, without the interpreter's lock.
 *
 * Each edge remembers its row at the stamp between two samples that was asked for last, until samples change around it.
 *
 * Paths is the cache {target: {source: Chain}} of a tree with its lock. It answers where a chain is known, covers the
 * stamp, and nobody holds the lock; else Python looks closer: it finds the chain, applies the policy or words the error.
 * Python clears the cache whenever a chain might not hold any more.
 *
 * A Method stands before a method in Python that has many options: a call without options is answered here, before the
 * call costs anything, and any other call is passed on.
 */

/* Chain: the edges between two frames ------------------------------------------------------------------------------ */

typedef struct {
    History *edge; /* borrowed; NULL for a run of static edges, which is one row */
    double row[WIDTH];
} Step;

typedef struct {
    PyObject_HEAD
    PyObject *sides[2];   /* the steps from the source up and from the target up, as tuples, which own the edges */
    PyObject *statics;    /* the static edges, a tuple */
    Step *steps;          /* the same in a row */
    Py_ssize_t up, down;  /* the number of each */
    Py_ssize_t moving;    /* how many are edges */
    char alone;           /* whether no other way between the two frames counts at any stamp */
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
    Py_CLEAR(self->statics);
    return 0;
}

static int
chain_init(Chain *self, PyObject *args, PyObject *kwargs)
{
    PyObject *sides[2], *statics;
    if (!has_no_keywords(kwargs)
        || !PyArg_ParseTuple(args, "O!O!O!:Chain", &PyTuple_Type, &sides[0], &PyTuple_Type, &sides[1], &PyTuple_Type,
                             &statics)) {
        return -1;
    }
    for (Py_ssize_t i = 0; i < PyTuple_Size(statics); i++) {
        if (!PyObject_TypeCheck(PyTuple_GetItem(statics, i), HistoryType)) {
            PyErr_SetString(PyExc_TypeError, "static edges are histories");
            return -1;
        }
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
    Py_INCREF(statics);
    self->sides[0] = sides[0];
    self->sides[1] = sides[1];
    self->statics = statics;
    self->steps = steps;
    self->up = up;
    self->down = down;
    self->moving = moving;
    return 0;
}

static const unsigned char each[LANES] = {0,  1,  2,  3,  4,  5,  6,  7,  8,  9,  10, 11, 12, 13, 14, 15,
                                          16, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 29, 30, 31};

/* The product of `count` rows, the last one first, times `product`; of the rows alone if `begins`. */
static inline Py_ALWAYS_INLINE void
climb(const double *const *rows, Py_ssize_t count, int begins, double *product)
{
    double row[WIDTH];
    memcpy(row, begins ? rows[0] : product, ROW_SIZE);
    for (Py_ssize_t i = begins; i < count; i++) {
        compose(rows[i], row, row);
    }
    memcpy(product, row, ROW_SIZE);
}

/* Source in target at a stamp; as far as a policy allows, if it is not NULL. Each edge remembers its row at the stamp between
 * two samples that was asked for last: all frames of a robot at one stamp, and `LATEST` until something new comes, share the
 * edges, and an interpolation takes six times as long as a product. */
static inline Py_ALWAYS_INLINE Status
chain_at_as_far(const Chain *self, int64_t at, Policy *policy, double *out)
{
    const Py_ssize_t steps = self->up + self->down;
    double below[WIDTH];
    memcpy(out, identity, ROW_SIZE);
    for (Py_ssize_t first = 0; first < steps; first += LANES) {
        const Py_ssize_t count = steps - first < LANES ? steps - first : LANES;
        const double *rows[LANES];
        Segment segments[LANES];
        unsigned char which[LANES];
        Py_ssize_t between = 0;
        for (Py_ssize_t i = 0; i < count; i++) {
            const Step *step = &self->steps[first + i];
            rows[i] = step->row;
            if (step->edge == NULL) {
                continue;
            }
            if (step->edge->mixed) {
                return NOT_PLAIN;
            }
            const Samples samples = samples_of(step->edge);
            if (step->edge->asked == at && step->edge->has_row && policy == NULL && samples.stamps[0] <= at) {
                rows[i] = step->edge->row;
                continue;
            }
            const Status status = policy == NULL ? find_segment(&samples, at, &segments[between])
                                                 : find_segment_within(&samples, at, policy, &segments[between]);
            if (status != ANSWERED) {
                return status;
            }
            rows[i] = segments[between].b;
            if (segments[between].a != NULL) {
                which[between++] = (unsigned char)i;
            }
        }
        double blended[LANES][WIDTH];
        if (between > 0) {
            Turn turns[LANES];
            int64_t stamps[LANES];
            find_turns(segments, turns, between);
            for (Py_ssize_t i = 0; i < between; i++) {
                stamps[i] = at;
                rows[which[i]] = self->steps[first + which[i]].edge->row;
            }
            blend(segments, turns, each, stamps, between, blended[0], WIDTH, 1);
            for (Py_ssize_t i = 0; i < between; i++) {
                History *edge = self->steps[first + which[i]].edge;
                memcpy(edge->row, blended[i], ROW_SIZE);
                edge->asked = at;
                edge->has_row = 1;
            }
        }
        const Py_ssize_t up = first + count <= self->up ? count : first < self->up ? self->up - first : 0;
        if (up > 0) {
            climb(rows, up, first == 0, out);
        }
        if (up < count) {
            climb(rows + up, count - up, first + up == self->up, below);
        }
    }
    if (self->down > 0) {
        double inverse[WIDTH];
        invert(below, inverse);
        compose(inverse, out, out);
    }
    return ANSWERED;
}

/* Two functions, so that the first has nothing of the policy. */
static Status
chain_at(const Chain *self, int64_t at, double *out)
{
    return chain_at_as_far(self, at, NULL, out);
}

static Status
chain_at_within(const Chain *self, int64_t at, Policy *policy, double *out)
{
    return chain_at_as_far(self, at, policy, out);
}

/* Whether there are static edges; then `stamp` is the newest of their stamps. Not inlined, because few chains need it. */
Py_NO_INLINE static int
chain_newest_static(const Chain *self, int64_t *stamp)
{
    const Py_ssize_t count = self->statics == NULL ? 0 : PyTuple_Size(self->statics);
    int64_t newest = INT64_MIN;
    for (Py_ssize_t i = 0; i < count; i++) {
        PyObject *known = ((History *)PyTuple_GetItem(self->statics, i))->static_stamp;
        int overflow = 0;
        const int64_t own = known != NULL && PyLong_Check(known) ? PyLong_AsLongLongAndOverflow(known, &overflow) : 0;
        if (overflow) {
            return 0;
        }
        newest = own > newest ? own : newest;
    }
    *stamp = newest;
    return count > 0;
}

/* Whether there is a stamp that `LATEST` means: the newest one that all moving edges have reached; if nothing moves, the
 * newest of the static samples. */
static int
chain_newest(const Chain *self, int64_t *stamp)
{
    int64_t common = INT64_MAX;
    if (self->moving == 0) {
        return chain_newest_static(self, stamp);
    }
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
    return 1;
}

/* The newest stamp of any moving edge, as far as the edge that has reached `common` may be held. */
static int64_t
chain_newest_within(const Chain *self, int64_t common, uint64_t hold)
{
    int64_t newest = common;
    for (Py_ssize_t i = 0; i < self->up + self->down; i++) {
        const History *edge = self->steps[i].edge;
        if (edge != NULL && block_stamps(edge->block)[edge->end - 1] > newest) {
            newest = block_stamps(edge->block)[edge->end - 1];
        }
    }
    return (uint64_t)newest - (uint64_t)common <= hold ? newest : common + (int64_t)hold;
}

/* Whether the samples of every moving edge cover a stamp. */
static int
chain_covers(const Chain *self, int64_t at)
{
    for (Py_ssize_t i = 0; i < self->up + self->down; i++) {
        const History *edge = self->steps[i].edge;
        if (edge == NULL) {
            continue;
        }
        const Samples samples = samples_of(edge);
        if (samples.count == 0 || at < samples.stamps[0] || at > samples.stamps[samples.count - 1]) {
            return 0;
        }
    }
    return 1;
}

static PyObject *
chain_covers_method(Chain *self, PyObject *number)
{
    int64_t at;
    return read_stamp(number, &at) < 0 ? NULL : PyBool_FromLong(chain_covers(self, at));
}

/* The edge whose error counts at a stamp that is not covered: the first that has dropped it, else the one that lags
 * most; NULL if nothing moves. */
static History *
deciding_edge(const Chain *self, int64_t at)
{
    int64_t reached = INT64_MAX;
    History *lagging = NULL;
    for (Py_ssize_t i = 0; i < self->up + self->down; i++) {
        History *edge = self->steps[i].edge;
        if (edge == NULL) {
            continue;
        }
        lagging = lagging == NULL ? edge : lagging;
        const Samples samples = samples_of(edge);
        const int64_t newest = samples.count == 0 ? INT64_MIN : samples.stamps[samples.count - 1];
        if (samples.count > 0 && newest >= at) {
            if (samples.stamps[0] > at) {
                return edge;
            }
        } else if (newest < reached) {
            lagging = edge;
            reached = newest;
        }
    }
    return lagging;
}

static PyObject *
chain_deciding(Chain *self, PyObject *number)
{
    int64_t at;
    if (read_stamp(number, &at) < 0) {
        return NULL;
    }
    PyObject *edge = OBJECT(deciding_edge(self, at));
    return Py_NewRef(edge == NULL ? Py_None : edge);
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
    Py_VISIT(self->statics);
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
     PyDoc_STR("The stamp that LATEST means: the newest that all moving edges have reached, or the newest static one.")},
    {"covers", (PyCFunction)chain_covers_method, METH_O,
     PyDoc_STR("covers(at): whether the samples of every moving edge cover a stamp.")},
    {"deciding", (PyCFunction)chain_deciding, METH_O,
     PyDoc_STR("deciding(at): the edge whose error counts at a stamp that is not covered; None if nothing moves.")},
    {"hold", (PyCFunction)chain_hold, METH_NOARGS,
     PyDoc_STR("The present samples of all edges, for many answers; None if they are not plain.")},
    {NULL}
};

static PyMemberDef chain_members[] = {
    {"up", T_OBJECT_EX, offsetof(Chain, sides[0]), READONLY, PyDoc_STR("The steps from the source up.")},
    {"down", T_OBJECT_EX, offsetof(Chain, sides[1]), READONLY, PyDoc_STR("The steps from the target up.")},
    {"alone", T_BOOL, offsetof(Chain, alone), 0,
     PyDoc_STR("Whether no other way between the two frames counts at any stamp.")},
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

/* Paths: the plain answer ------------------------------------------------------------------------------------------ */

typedef struct {
    PyObject_HEAD
    PyObject *recent;        /* {target: {source: Chain}} */
    PyObject *lock_is_held;  /* the method of the tree's lock that says so */
    PyObject *latest;        /* the sentinel */
    PyObject *kind;          /* the class of an answer, made of Sample */
    PyObject *now;           /* the clock that ages are counted from, called for a stamp; None or NULL if there is none */
    PyObject *qualified;     /* the class of an answer with a policy, derived from `kind`; None or NULL if there is none */
    PyObject *clock_namers;  /* `ExtrapolationError` names the clock of a sender by them; NULL if there are none */
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

REFERENCES(paths, 7)

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
    PyObject *is_held = PyObject_GetAttr(lock, locked_string);
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
    self->kind = plain_kind = kind;
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

/* The answer of a lookup, of a class that is made of Sample. */
static PyObject *
make_answer(PyObject *kind, PyObject *target, PyObject *source, int64_t at, const double *row, int is_static)
{
    Sample *sample = (Sample *)PyType_GenericAlloc((PyTypeObject *)kind, 0);
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
    sample->is_static = (char)is_static;
    return (PyObject *)sample;
}

/* Whether it is known which stamp is asked for, by an int or by `LATEST`. */
static int
paths_stamp(const Paths *self, const Chain *path, PyObject *at, int64_t *stamp)
{
    int overflow = 1;
    if (at == self->latest) {
        return chain_newest(path, stamp);
    }
    if (PyLong_CheckExact(at)) {
        *stamp = PyLong_AsLongLongAndOverflow(at, &overflow);
    }
    return !overflow;
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
    const Chain *path = paths_find(self, args[0], args[1]);
    if (path == NULL && PyErr_Occurred()) {
        return NULL;
    }
    if (path == NULL || path->up + path->down == 0 || !paths_stamp(self, path, args[2], &at)
        || chain_at(path, at, row) != ANSWERED) {
        Py_RETURN_NONE;
    }
    return make_answer(self->kind, args[0], args[1], at, row, path->moving == 0);
}

/* As `paths_answer`, as far as a policy allows: `Extrapolation` of tfbus/tree/lookup.py. */
static PyObject *
paths_answer_within(const Paths *self, PyObject *target, PyObject *source, PyObject *at, Policy *policy)
{
    int64_t stamp;
    double row[WIDTH];
    PyObject *kind = self->qualified;
    if (kind == NULL || !PyType_Check(kind) || !PyType_IsSubtype((PyTypeObject *)kind, SampleType)) {
        Py_RETURN_NONE;
    }
    const Chain *path = paths_find(self, target, source);
    if (path == NULL && PyErr_Occurred()) {
        return NULL;
    }
    if (path == NULL || path->up + path->down == 0 || !paths_stamp(self, path, at, &stamp)) {
        Py_RETURN_NONE;
    }
    const int is_static = path->moving == 0;
    if (at == self->latest && !is_static) {
        stamp = chain_newest_within(path, stamp, policy->hold);
    }
    if (!(path->alone || chain_covers(path, stamp)) || chain_at_within(path, stamp, policy, row) != ANSWERED) {
        Py_RETURN_NONE;
    }
    PyObject *use = Py_BuildValue("KK", policy->extrapolated_by, policy->gap);
    PyObject *answer = use == NULL ? NULL : make_answer(kind, target, source, stamp, row, is_static);
    if (answer != NULL && PyObject_SetAttr(answer, policy_use_string, use) < 0) {
        Py_CLEAR(answer);
    }
    Py_XDECREF(use);
    return answer;
}

/* The clock's now; 0 if there is no clock, or Python has to look closer, perhaps with an error. */
static int
paths_now(const Paths *self, int64_t *now)
{
    PyObject *number = self->now == NULL || self->now == Py_None ? NULL : PyObject_CallNoArgs(self->now);
    const int known = number != NULL && PyLong_CheckExact(number) && read_stamp(number, now) == 0;
    Py_XDECREF(number);
    return known;
}

/* Raise the error of a lookup at a stamp that a known path does not cover, if there is no other way, and the clock shows
 * that no sample of the deciding edge is ahead of it. Python makes the error; this saves the calls on the way there.
 * Not inlined, because few calls need it. */
Py_NO_INLINE static void
paths_refuse(const Paths *self, PyObject *target, PyObject *source, PyObject *number)
{
    int64_t at = 0, now = INT64_MAX;
    int overflow = 1;
    Chain *path = PyLong_CheckExact(number) ? paths_find(self, target, source) : NULL;
    if (path != NULL) {
        at = PyLong_AsLongLongAndOverflow(number, &overflow);
    }
    if (overflow || !path->alone || path->moving == 0 || chain_covers(path, at)) {
        return;
    }
    History *edge = deciding_edge(path, at);
    const int64_t newest = edge->end > edge->start ? block_stamps(edge->block)[edge->end - 1] : INT64_MIN;
    Py_INCREF(OBJECT(path));
    if (self->now == NULL || self->now == Py_None || paths_now(self, &now)) {
        PyObject *error = newest > now ? NULL : PyObject_CallMethodObjArgs(OBJECT(edge), error_string, number, NULL);
        /* Another thread may have inserted the missing samples meanwhile. */
        if (error != NULL && !chain_covers(path, at) && PyExceptionInstance_Check(error)
            && (self->clock_namers == NULL || PyObject_SetAttr(error, namers_string, self->clock_namers) == 0)) {
            PyErr_SetObject(OBJECT(Py_TYPE(error)), error);
        }
        Py_XDECREF(error);
    }
    Py_DECREF(OBJECT(path));
}

/* One half of a time travel: source in target at a stamp or at `LATEST`; then `*stamp` is the stamp that counts, and
 * `*is_static` says whether nothing moves. 0 where Python has to look closer, perhaps with an error. */
static int
paths_half(const Paths *self, PyObject *target, PyObject *source, PyObject *at, int64_t *stamp, double *row, int *is_static)
{
    const Chain *path = paths_find(self, target, source);
    if (path == NULL || !paths_stamp(self, path, at, stamp)) {
        return 0;
    }
    *is_static = path->moving == 0;
    return chain_at(path, *stamp, row) == ANSWERED;
}

/* As `paths_answer`, of source at its own stamp, carried through a fixed frame into target: `find_in_time_travel` of
 * tfbus/tree/lookup.py. */
static PyObject *
paths_travel(const Paths *self, PyObject *target, PyObject *source, PyObject *at, PyObject *source_at, PyObject *fixed)
{
    int64_t stamp, source_stamp;
    double first[WIDTH], second[WIDTH];
    int target_static, source_static;
    if (!paths_half(self, target, fixed, at, &stamp, first, &target_static)
        || !paths_half(self, fixed, source, source_at, &source_stamp, second, &source_static)) {
        if (PyErr_Occurred()) {
            return NULL;
        }
        Py_RETURN_NONE;
    }
    compose(first, second, second);
    if (at == self->latest && target_static && !source_static) {
        stamp = source_stamp;
    }
    return make_answer(self->kind, target, source, stamp, second, target_static && source_static);
}

/* can_answer(target, source, at): whether there is an answer; None where Python has to look closer. */
static PyObject *
paths_can_answer(Paths *self, PyObject *const *args, Py_ssize_t count)
{
    int64_t at;
    int overflow = 0;
    if (count != 3) {
        PyErr_SetString(PyExc_TypeError, "can_answer takes target, source and at");
        return NULL;
    }
    const Chain *path = paths_find(self, args[0], args[1]);
    if (path == NULL && PyErr_Occurred()) {
        return NULL;
    }
    if (path == NULL || path->up + path->down == 0) {
        Py_RETURN_NONE;
    }
    if (args[2] == self->latest) {
        if (!chain_newest(path, &at)) {
            return PyBool_FromLong(0);
        }
    } else if (PyLong_CheckExact(args[2])) {
        at = PyLong_AsLongLongAndOverflow(args[2], &overflow);
    } else {
        overflow = 1;
    }
    const int covered = !overflow && chain_covers(path, at);
    if (overflow || !(covered || path->alone)) {
        Py_RETURN_NONE;
    }
    return PyBool_FromLong(covered);
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
        const int plain = is_array(stamps);
        /* Python judges arrays with a mask. */
        if (plain < 0
            || (!plain && (!PyObject_CheckBuffer(stamps) || PyObject_HasAttr(stamps, mask_string)))) {
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
    if (nargs != 3 || !PyDict_Check(args[0]) || !PyDict_Check(args[1]) || !is_batch(args[2])) {
        PyErr_SetString(PyExc_TypeError, "commit takes a dict of histories, a dict of readers and a batch");
        return NULL;
    }
    if (self->recent == NULL || PyDict_Size(args[1]) > 0) {
        Py_RETURN_FALSE;
    }
    const int free = paths_are_free(self);
    if (free < 0) {
        return NULL;
    }
    const Py_ssize_t size = batch_size(args[2]);
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
    {"can_answer", FAST(paths_can_answer), METH_FASTCALL,
     PyDoc_STR("can_answer(target, source, at): whether there is an answer; None if Python has to look closer.")},
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
    {"now", T_OBJECT, offsetof(Paths, now), 0, PyDoc_STR("The clock that ages are counted from: it gives a stamp.")},
    {"qualified", T_OBJECT, offsetof(Paths, qualified), 0, PyDoc_STR("The class of an answer with a policy.")},
    {"clock_namers", T_OBJECT, offsetof(Paths, clock_namers), 0, PyDoc_STR("For errors: the namers of clocks.")},
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

/* The paths of the object that is asked, a new reference; NULL without an error if it has none. */
static Paths *
paths_of(PyObject *asker)
{
    PyObject *paths = PyObject_GetAttr(asker, paths_string);
    if (paths == NULL || !PyObject_TypeCheck(paths, PathsType)) {
        PyErr_Clear();
        Py_CLEAR(paths);
    }
    return (Paths *)paths;
}

/* The plain answer for source in target; None if there is none. Without stamps it is the latest. */
static PyObject *
method_answer(const Method *self, PyObject *asker, PyObject *target, PyObject *source, PyObject *at)
{
    Paths *paths = paths_of(asker);
    if (paths == NULL) {
        Py_RETURN_NONE;
    }
    PyObject *question[3] = {target, source, at == NULL ? paths->latest : at};
    PyObject *found = self->many == NULL ? paths_answer(paths, question, 3) : paths_answer_many(paths, question, 3);
    if (self->many == NULL && found == Py_None) {
        paths_refuse(paths, target, source, question[2]);
        if (PyErr_Occurred()) {
            Py_CLEAR(found);
        }
    }
    Py_DECREF(OBJECT(paths));
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

/* The oldest and the newest stamp that count as `LATEST`. */
typedef struct {
    int64_t oldest, newest;
} Bounds;

/* The ns of a duration in s, a float; 0 for any other object, and for more than thirty years. */
static int
read_duration(PyObject *duration, uint64_t *nanoseconds)
{
    const double seconds = PyFloat_CheckExact(duration) ? PyFloat_AsDouble(duration) : -1.0, whole = floor(seconds);
    if (!(0.0 <= seconds && seconds <= 1e9)) {
        return 0;
    }
    *nanoseconds = (uint64_t)whole * 1000000000 + (uint64_t)nearbyint((seconds - whole) * 1e9);
    return 1;
}

/* The ns of a `Hold` of tfbus/tree/lookup.py; 0 for any other object. */
static int
read_hold(PyObject *hold, uint64_t *nanoseconds)
{
    PyObject *number = PyObject_GetAttr(hold, nanoseconds_string);
    int64_t value = -1;
    if (number == NULL || !PyLong_CheckExact(number) || read_stamp(number, &value) < 0) {
        PyErr_Clear();
    }
    Py_XDECREF(number);
    *nanoseconds = (uint64_t)value;
    return value >= 0;
}

/* Ages of a duration in s around the clock's now, as `Lookups.bounds` in tfbus/buffer/lookups.py gives them; 0 where
 * Python has to look closer, perhaps with an error. */
static int
bounds_of_age(const Paths *paths, PyObject *max_age, Bounds *bounds)
{
    uint64_t age;
    int64_t now;
    if (!read_duration(max_age, &age) || !paths_now(paths, &now) || now < -(INT64_MAX / 2) || now > INT64_MAX / 2) {
        return 0;
    }
    bounds->oldest = now - (int64_t)age;
    bounds->newest = now + (int64_t)age;
    return 1;
}

static int
read_bound(PyObject *number, int64_t *bound)
{
    int overflow = 1;
    if (PyLong_CheckExact(number)) {
        *bound = PyLong_AsLongLongAndOverflow(number, &overflow);
    }
    return !overflow;
}

/* The answer of a call with options that the kernel knows: time travel, or the age of `LATEST` and a policy. None for
 * any other, and where there is no such answer. Not inlined, as above. */
Py_NO_INLINE static PyObject *
method_answer_with(const Method *self, PyObject *const *args, PyObject *at, PyObject *const *named, PyObject *names,
                   Py_ssize_t first)
{
    PyObject *source_at = Py_None, *fixed = Py_None;
    Bounds bounds = {INT64_MIN, INT64_MAX};
    Policy policy = {0, UINT64_MAX, 0, 0, 0};
    int plain = 1, bounded = 0, limited = 0;
    Paths *paths = paths_of(args[0]);
    if (paths == NULL) {
        Py_RETURN_NONE;
    }
    for (Py_ssize_t i = first; plain && i < PyTuple_Size(names); i++) {
        PyObject *name = PyTuple_GetItem(names, i);
        PyObject *by_default = PyDict_CheckExact(self->defaults) ? PyDict_GetItem(self->defaults, name) : NULL;
        if (by_default == NULL) {
            plain = 0;
        } else if (name == source_at_string) {
            source_at = named[i];
        } else if (name == fixed_string) {
            fixed = named[i];
        } else if (by_default == named[i]) {
            continue;
        } else if ((name == tolerance_string && read_duration(named[i], &policy.tolerance))
                   || (name == max_gap_string && read_duration(named[i], &policy.max_gap))
                   || (name == extrapolate_string && read_hold(named[i], &policy.hold))) {
            /* As in `policy_of`, a tolerance of zero is none. */
            limited |= name != tolerance_string || PyFloat_AsDouble(named[i]) != 0.0;
        } else {
            plain = (name == not_before_string && read_bound(named[i], &bounds.oldest))
                    || (name == not_after_string && read_bound(named[i], &bounds.newest))
                    || (name == max_age_string && bounds_of_age(paths, named[i], &bounds));
            bounded = 1;
        }
    }
    PyObject *answer = Py_None, *when = at == NULL ? paths->latest : at;
    PyObject *question[3] = {args[1], args[2], when};
    if (PyErr_Occurred()) {
        answer = NULL;
    } else if (!plain || (source_at == Py_None) != (fixed == Py_None)
               || (bounded && (fixed != Py_None || when != paths->latest)) || (limited && fixed != Py_None)) {
        Py_INCREF(answer);
    } else if (fixed != Py_None) {
        answer = paths_travel(paths, args[1], args[2], when, source_at, fixed);
    } else {
        answer = limited ? paths_answer_within(paths, args[1], args[2], when, &policy) : paths_answer(paths, question, 3);
        const Sample *sample = (const Sample *)answer;
        if (answer != NULL && answer != Py_None && !sample->is_static
            && !(bounds.oldest <= sample->stamp && sample->stamp <= bounds.newest)) {
            Py_DECREF(answer);
            answer = Py_None;
            Py_INCREF(answer);
        }
    }
    Py_DECREF(OBJECT(paths));
    return answer;
}

/* By PEP 590. A plain call has only the object, target, source, and the stamp or stamps; all else are defaults. */
static PyObject *
method_vectorcall(Method *self, PyObject *const *args, size_t flagged, PyObject *names)
{
    const Py_ssize_t count = (Py_ssize_t)(flagged & ~((size_t)1 << (8 * sizeof(size_t) - 1)));
    const int at_is_named = count == 3 && names != NULL && PyTuple_Size(names) > 0 && PyTuple_GetItem(names, 0) == at_string;
    if (count == 4 || (self->many == NULL && count == 3)) {
        PyObject *at = count == 4 || at_is_named ? args[3] : NULL, *found;
        if (names == NULL || method_has_defaults(self, args + count, names, at_is_named)) {
            found = method_answer(self, args[0], args[1], args[2], at);
        } else if (self->many == NULL) {
            found = method_answer_with(self, args, at, args + count, names, at_is_named);
        } else {
            return method_run(self, args, count, names);
        }
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

/* Poses relative to each other ---------------------------------------------------------------------------------------- */

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

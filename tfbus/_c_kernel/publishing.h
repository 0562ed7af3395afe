/* Publishing: judging a batch, feeding it to all buffers, and decoding plain messages.
 *
 * An Edge is what the bus knows of a frame's newest edge; the Judge accepts a batch whose samples all continue known
 * edges from their trusted authority, at plausible stamps. It changes nothing before it has accepted the whole batch.
 * An Intake is the way of plain batches from `publish` to the Feed of each tree, and then to those who listen besides.
 * A batch that the Judge does not accept is Python's, with all its reasons and events; a tree whose Feed does not take a
 * batch gets it in the ordinary way.
 *
 * `decode` reads the samples of a tf message up to the first whose names are new or whose numbers need a correction.
 */

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
    if (!is_batch(batch)) {
        PyErr_SetString(PyExc_TypeError, "a batch is a tuple of samples, or columns");
        return NULL;
    }
    if (self->until != INT64_MAX && elapsed() >= self->until) {
        Py_RETURN_FALSE;
    }
    const Py_ssize_t size = batch_size(batch);
    Sample scratch;
    Edge *few[FEW], **edges = few;
    if (size > FEW && (edges = PyMem_Malloc((size_t)size * sizeof(Edge *))) == NULL) {
        return PyErr_NoMemory();
    }
    Py_ssize_t judged = 0;
    PyObject *child = NULL;
    for (; self->edges != NULL && judged < size; judged++) {
        const Sample *sample = sample_at(batch, judged, &scratch);
        if (sample == NULL || sample->is_static || sample->stamp > self->horizon) {
            break;
        }
        const double *row = sample->row;
        /* Not `>`, which is false for NaN. */
        if (!(row[0] * row[0] + row[1] * row[1] + row[2] * row[2] <= self->square)) {
            break;
        }
        if (judged > 0 && sample->child == child) {
            edges[judged] = edges[judged - 1];
        } else {
            PyObject *known = PyDict_GetItemWithError(self->edges, sample->child);
            if (known == NULL || !PyObject_TypeCheck(known, EdgeType)) {
                break;
            }
            edges[judged] = (Edge *)known;
            child = sample->child;
        }
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
        const int64_t stamp = sample_at(batch, i, &scratch)->stamp;
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

/* Intake: the plain publishing ---------------------------------------------------------------------------------------- */

typedef struct {
    PyObject_HEAD
    /* A tuple of (Feed, callable that takes a batch which is not plain). It is cleared first: nothing is taken then. */
    PyObject *feeds;
    PyObject *judge;      /* Judge */
    PyObject *kind;       /* the class of samples */
    PyObject *listeners;  /* a tuple of containers, each followed by a callable for each batch while it has elements */
    PyObject *busy;       /* a tuple of containers; nothing is taken while one of them has elements */
    long long samples;    /* how many were taken */
    unsigned long thread; /* the only one that may publish */
    char open;
} Intake;

REFERENCES(intake, 5)

static int
intake_init(Intake *self, PyObject *args, PyObject *kwargs)
{
    PyObject *judge, *kind, *listeners, *busy;
    if (!has_no_keywords(kwargs)
        || !PyArg_ParseTuple(args, "O!O!O!O!:Intake", JudgeType, &judge, &PyType_Type, &kind, &PyTuple_Type, &listeners,
                             &PyTuple_Type, &busy)) {
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
    Py_INCREF(busy);
    self->judge = judge;
    self->kind = kind;
    self->listeners = listeners;
    self->busy = busy;
    self->feeds = feeds;
    self->open = 1;
    return 0;
}

/* Whether something is a sample that knows nothing beyond its fields, such as one that came over a link. */
static int
is_plain_sample(const Intake *self, PyObject *item)
{
    return OBJECT(Py_TYPE(item)) == self->kind
        || (PyObject_TypeCheck(item, SampleType) && ((Sample *)item)->authority != NULL && !knows_more((Sample *)item));
}

/* A batch of such samples; NULL without an error for anything else. */
static PyObject *
intake_batch(const Intake *self, PyObject *samples)
{
    if (is_plain_sample(self, samples)) {
        return PyTuple_Pack(1, samples);
    }
    PyObject *batch = NULL;
    if (OBJECT(Py_TYPE(samples)) == OBJECT(ColumnsType) && batch_size(samples) > 0) {
        return Py_NewRef(samples);
    }
    if (PyList_CheckExact(samples)) {
        batch = PyList_AsTuple(samples);
    } else if (PyTuple_CheckExact(samples)) {
        Py_INCREF(samples);
        batch = samples;
    }
    const Py_ssize_t size = batch == NULL ? 0 : PyTuple_Size(batch);
    for (Py_ssize_t i = 0; i < size; i++) {
        if (!is_plain_sample(self, PyTuple_GetItem(batch, i))) {
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

/* Whether one of some containers has elements; -1 for an error. */
static int
has_any(PyObject *containers)
{
    const Py_ssize_t count = PyTuple_Size(containers);
    Py_ssize_t size = 0;
    for (Py_ssize_t i = 0; i < count && size == 0; i++) {
        size = PyObject_Size(PyTuple_GetItem(containers, i));
    }
    return size < 0 ? -1 : size > 0;
}

/* Give a batch to those who listen. */
static int
intake_tell(const Intake *self, PyObject *batch)
{
    PyObject *listeners = self->listeners, *objects = NULL;
    const Py_ssize_t count = PyTuple_Size(listeners);
    int failed = 0;
    for (Py_ssize_t i = 0; i + 1 < count && !failed; i += 2) {
        const Py_ssize_t size = PyObject_Size(PyTuple_GetItem(listeners, i));
        if (size == 0) {
            continue;
        }
        if (size > 0 && objects == NULL) {
            objects = PyTuple_CheckExact(batch) ? Py_NewRef(batch) : columns_samples(batch, self->kind);
        }
        PyObject *tell = PyTuple_GetItem(listeners, i + 1);
        PyObject *told = size < 0 || objects == NULL ? NULL : PyObject_CallFunctionObjArgs(tell, objects, NULL);
        failed = told == NULL;
        Py_XDECREF(told);
    }
    Py_XDECREF(objects);
    return failed ? -1 : 0;
}

/* take(samples, invalid): judge a batch, insert it into all trees and tell those who listen, if it is plain. Returns
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
    const int busy = has_any(self->busy);
    if (busy != 0) {
        return busy < 0 ? NULL : PyBool_FromLong(0);
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
    self->samples += batch_size(batch);
    PyObject *feeds = self->feeds;
    Py_INCREF(feeds);
    const Py_ssize_t count = PyTuple_Size(feeds);
    Trouble trouble = {NULL};
    /* After an error of one buffer, the others get the batch too, because the bus has judged it. */
    for (Py_ssize_t i = 0; i < count; i++) {
        PyObject *pair = PyTuple_GetItem(feeds, i), *done = feed_insert((Feed *)PyTuple_GetItem(pair, 0), batch);
        if (done == Py_False) {
            Py_DECREF(done);
            PyObject *objects = PyTuple_CheckExact(batch) ? Py_NewRef(batch) : columns_samples(batch, self->kind);
            done = objects == NULL ? NULL : PyObject_CallFunctionObjArgs(PyTuple_GetItem(pair, 1), objects, NULL);
            Py_XDECREF(objects);
        }
        if (done == NULL) {
            set_aside(&trouble);
        }
        Py_XDECREF(done);
    }
    Py_DECREF(feeds);
    if (intake_tell(self, batch) < 0) {
        set_aside(&trouble);
    }
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
     PyDoc_STR("take(samples, invalid): judge a batch, insert it into all trees and tell listeners if it is plain: "
               "True; None if the judge does not accept it, False if it was not asked.")},
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

/* The plain samples of a message body from an offset on, at most `count`, as a list: little endian, with names that were
 * decoded before. A single tag is that of all. */
static PyObject *
decoded_samples(const char *body, int64_t size, int64_t *place, Py_ssize_t count, PyObject *tags, PyObject *names,
                PyTypeObject *kind)
{
    int64_t at = *place;
    const Py_ssize_t last_tag = PyTuple_Size(tags) - 1;
    PyObject *samples = PyList_New(0);
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
        PyObject *known = piece == NULL ? NULL : PyDict_GetItemWithError(names, piece);
        Py_XDECREF(piece);
        PyObject *tag = PyTuple_GetItem(tags, i < last_tag ? i : last_tag);
        PyObject *sample = known == NULL ? NULL
                                         : decoded_sample(kind, known, tag, (int64_t)seconds * 1000000000 + nanoseconds,
                                                          body + end);
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
    *place = at;
    return samples;
}

/* Decode the plain samples at the beginning of a message. */
static PyObject *
decode(PyObject *Py_UNUSED(module), PyObject *const *args, Py_ssize_t nargs)
{
    if (nargs != 5 || !PyBytes_Check(args[0]) || !PyTuple_Check(args[2]) || !PyDict_Check(args[3])
        || !PyType_Check(args[4]) || !PyType_IsSubtype((PyTypeObject *)args[4], SampleType)) {
        PyErr_SetString(PyExc_TypeError, "decode takes bytes, an offset, tags, known names and a type of samples");
        return NULL;
    }
    int64_t at = PyLong_AsLongLong(args[1]);
    if (at == -1 && PyErr_Occurred()) {
        return NULL;
    }
    PyObject *samples = decoded_samples(PyBytes_AsString(args[0]), PyBytes_Size(args[0]), &at, PyTuple_Size(args[2]),
                                        args[2], args[3], (PyTypeObject *)args[4]);
    return samples == NULL ? NULL : Py_BuildValue("(NL)", samples, (long long)at);
}

/* decode_whole(tags, names, kind, most, payload): the samples of a message with its header as a tuple, if all are plain
 * and nothing follows them; else None. */
static PyObject *
decode_whole(PyObject *Py_UNUSED(module), PyObject *const *args, Py_ssize_t nargs)
{
    if (nargs != 5 || !PyTuple_Check(args[0]) || PyTuple_Size(args[0]) != 1 || !PyDict_Check(args[1])
        || !PyType_Check(args[2]) || !PyType_IsSubtype((PyTypeObject *)args[2], SampleType)) {
        PyErr_SetString(PyExc_TypeError, "decode_whole takes a tag, known names, a type of samples, a size and bytes");
        return NULL;
    }
    const Py_ssize_t most = PyLong_AsSsize_t(args[3]);
    if (most == -1 && PyErr_Occurred()) {
        return NULL;
    }
    if (!PyBytes_Check(args[4])) {
        Py_RETURN_NONE;
    }
    const char *payload = PyBytes_AsString(args[4]);
    const Py_ssize_t size = PyBytes_Size(args[4]) - 4;
    uint32_t count = 0;
    if (size < 4 || size + 4 > most || payload[0] != 0 || payload[1] != 1) {
        Py_RETURN_NONE;
    }
    memcpy(&count, payload + 4, 4);
    int64_t at = 4;
    PyObject *samples = decoded_samples(payload + 4, size, &at, count, args[0], args[1], (PyTypeObject *)args[2]);
    if (samples == NULL) {
        return NULL;
    }
    PyObject *whole = PyList_Size(samples) == (Py_ssize_t)count && at == size ? PyList_AsTuple(samples) : Py_NewRef(Py_None);
    Py_DECREF(samples);
    return whole;
}

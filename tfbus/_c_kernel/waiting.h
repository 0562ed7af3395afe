/* Waiting: the lookups that are parked until a sample comes, and the insertion that wakes them.
 *
 * A Parked is one waiting lookup. A Line is the lookups under one frame; its `places` are sorted so that the next one due
 * is the last. A Feed is the way of plain batches into one buffer: it stores the batch, pops from the lines of its frames
 * whoever is due, and calls `wake` with the answer already found, if that is plain. It takes a batch only if the lines
 * need nothing else: nobody waits for any sample, no limit is passed, and nobody watches the frames. Else it does
 * nothing, and Python inserts and wakes.
 *
 * Calling `wake` runs Python code, which may change everything here. So a waiter leaves its line before it is called,
 * and nothing is remembered across the call but references of our own.
 */

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
    const Py_ssize_t size = batch_size(batch);
    for (Py_ssize_t i = 0; i < size; i++) {
        Sample scratch;
        const Sample *sample = sample_at(batch, i, &scratch);
        if (sample == NULL) {
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
    if (!is_batch(batch)) {
        PyErr_SetString(PyExc_TypeError, "a batch is a tuple of samples, or columns");
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
    const Py_ssize_t size = batch_size(batch);
    for (Py_ssize_t i = 0; i < size; i++) {
        Sample scratch;
        const Sample *sample = sample_at(batch, i, &scratch);
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

/* Waiting: the lookups that are parked until a sample comes, and the insertion that wakes them.
 *
 * A Parked is one waiting lookup. A Line is the lookups under one frame; its `places` are sorted so that the next one due
 * is the last. A Feed is the plain way into and out of the waiting lookups of one buffer.
 *
 * `ask` gives a Parked to be awaited. If newer samples are all that its question lacks, it is parked in the line of the
 * edge that lags most, and sleeps until an insertion brings the answer; no error says so, because Python words that when
 * somebody asks. Else it takes a turn of the loop and asks; then it has its answer, or sleeps after all. So it lets the
 * others run once in either case, and nothing happens between the insertion or the asking and the answer. At the end
 * there is no answer where the question is not plain, or the answer did not hold until the task ran; then the coroutine
 * that awaits the Parked goes on. An exception (a cancellation) is thrown into that coroutine, and it takes the Parked out
 * of the index: there is no `throw` here.
 *
 * The event loop is Python's: `begin` checks the thread, sets the alarm for all lookups that hang, and names the `loop`.
 * There, a sleep is a future of asyncio or a task of trio, and takes no more of Python than they do.
 *
 * `insert` stores a batch, pops from the lines of its frames whoever is due, and calls `wake` with the answer already
 * found, if that is plain. It takes a batch only if the lines need nothing else: nobody waits for any sample, no limit is
 * passed, and nobody watches the frames. Else it does nothing, and Python inserts and wakes.
 *
 * Calling `wake` runs Python code, which may change everything here. So a waiter leaves its line before it is called,
 * and nothing is remembered across the call but references of our own.
 */

/* Waiting: the plain insertion and its plain wake-ups ---------------------------------------------------------------- */

typedef struct {
    PyObject_HEAD
    PyObject *asked;    /* a tuple: target, source, at, and options that are all None if it is plain */
    PyObject *wake;     /* called without arguments, once; or the future or the task of trio that is woken */
    PyObject *place;    /* its place in a line, if it has one */
    PyObject *answer;   /* the answer of the insertion that woke it */
    PyObject *names;    /* the frames that block it, a tuple */
    PyObject *limit;    /* its place among the first limits, if it has one */
    PyObject *feed;     /* the Feed that it asks, while it is awaited */
    PyObject *sleeper;  /* the iterator that sleeps until `wake` is called */
    PyObject *share;    /* of the buffer that asks */
    PyObject *cancel_end; /* called without arguments, cancels the alarm of its end; NULL if there is none */
    double patience;    /* how long it waits at most, in s */
    long long since;    /* when it began to wait, in ns */
    long long version;  /* of the paths, when they had this answer */
    char elsewhere;     /* whether Python has noted it elsewhere, and has to forget it */
    char step;          /* of those below */
    char on_asyncio;    /* whether a bare yield is a turn of the loop */
    char wakes;         /* which of these */
} Parked;

enum { NOT_AWAITED, BEFORE_TURN, AT_TURN, ASLEEP };

REFERENCES(parked, 10)

enum { CALLABLE, FUTURE, TASK };

/* Of trio.lowlevel, once one is needed. */
static PyObject *trio_checkpoint, *reschedule, *wait_task_rescheduled, *current_task, *abort_succeeded;

static int
needs_trio(void)
{
    const struct {
        const char *name;
        PyObject **place;
    } wanted[] = {{"checkpoint", &trio_checkpoint}, {"reschedule", &reschedule}, {"current_task", &current_task},
                  {"wait_task_rescheduled", &wait_task_rescheduled}};
    for (size_t i = 0; i < sizeof wanted / sizeof *wanted; i++) {
        if (*wanted[i].place == NULL && (*wanted[i].place = imported("trio.lowlevel", wanted[i].name)) == NULL) {
            return 0;
        }
    }
    PyObject *abort = abort_succeeded != NULL ? NULL : imported("trio.lowlevel", "Abort");
    if (abort != NULL) {
        abort_succeeded = PyObject_GetAttrString(abort, "SUCCEEDED");
        Py_DECREF(abort);
    }
    return abort_succeeded != NULL;
}

static PySendResult parked_step(PyObject *self, PyObject *value, PyObject **result);

/* `send` of an iterator: what it yields, or StopIteration at its end. */
static PyObject *
parked_send(PyObject *self, PyObject *value)
{
    PyObject *result;
    const PySendResult sent = parked_step(self, value, &result);
    if (sent == PYGEN_RETURN) {
        Py_CLEAR(result);
        PyErr_SetNone(PyExc_StopIteration);
    }
    return result;
}

/* The same without an exception at its end. A class in Python that is derived from this one has no `am_send`. */
static PyObject *
parked_next(PyObject *self)
{
    PyObject *result;
    if (parked_step(self, Py_None, &result) == PYGEN_RETURN) {
        Py_CLEAR(result);
    }
    return result;
}

static PyObject *
parked_await(PyObject *self)
{
    Py_INCREF(self);
    return self;
}

static int
parked_init(Parked *self, PyObject *args, PyObject *kwargs)
{
    static char *names[] = {"asked", "since", "wake", NULL};
    PyObject *asked, *wake;
    long long since;
    if (!PyArg_ParseTupleAndKeywords(args, kwargs, "OLO:Parked", names, &asked, &since, &wake)) {
        return -1;
    }
    PyObject *old[] = {self->asked, self->wake};
    Py_INCREF(asked);
    Py_INCREF(wake);
    self->asked = asked;
    self->wake = wake;
    self->since = since;
    self->patience = Py_HUGE_VAL;
    self->wakes = CALLABLE;
    Py_XDECREF(old[0]);
    Py_XDECREF(old[1]);
    return 0;
}

/* Wake it, if it was not woken. */
static PyObject *
parked_end(Parked *self, PyObject *Py_UNUSED(ignored))
{
    PyObject *wake = self->wake, *done;
    if (wake == NULL) {
        Py_RETURN_NONE;
    }
    self->wake = NULL;
    if (self->wakes == FUTURE) {
        done = PyObject_CallMethodObjArgs(wake, set_result_string, Py_None, NULL);
    } else if (self->wakes == TASK) {
        done = PyObject_CallFunctionObjArgs(reschedule, wake, NULL);
    } else {
        done = PyObject_CallNoArgs(wake);
    }
    Py_DECREF(wake);
    return done;
}

/* trio has cancelled the wait of its task. */
static PyObject *
parked_abort(Parked *self, PyObject *Py_UNUSED(raise_cancel))
{
    Py_CLEAR(self->wake);
    return Py_NewRef(abort_succeeded);
}

static PyObject *
parked_wake(Parked *self, void *Py_UNUSED(closure))
{
    if (self->wakes == CALLABLE) {
        return Py_NewRef(self->wake == NULL ? Py_None : self->wake);
    }
    return PyObject_GetAttr(OBJECT(self), end_string);
}

static int
parked_set_wake(Parked *self, PyObject *value, void *Py_UNUSED(closure))
{
    PyObject *old = self->wake;
    Py_XINCREF(value);
    self->wake = value;
    self->wakes = CALLABLE;
    Py_XDECREF(old);
    return 0;
}

static PyMethodDef parked_methods[] = {
    {"abort", (PyCFunction)parked_abort, METH_O, PyDoc_STR("abort(raise_cancel): end the wait, as trio has cancelled it.")},
    {"end", (PyCFunction)parked_end, METH_NOARGS, PyDoc_STR("end(): wake it, if it was not woken.")},
    {"send", (PyCFunction)parked_send, METH_O, PyDoc_STR("send(value): go on; as that of a coroutine.")},
    {NULL}
};

static PyGetSetDef parked_getset[] = {
    {"wake", (getter)parked_wake, (setter)parked_set_wake, PyDoc_STR("Called once, after it was taken out of its line."), NULL},
    {NULL}
};

static PyMemberDef parked_members[] = {
    {"asked", T_OBJECT, offsetof(Parked, asked), 0, PyDoc_STR("Target, source, at, and the options.")},
    {"place", T_OBJECT, offsetof(Parked, place), 0, PyDoc_STR("Its place in a line, or None.")},
    {"answer", T_OBJECT, offsetof(Parked, answer), 0, PyDoc_STR("The answer of the insertion that woke it, or None.")},
    {"names", T_OBJECT, offsetof(Parked, names), 0, PyDoc_STR("The frames that block it.")},
    {"limit", T_OBJECT, offsetof(Parked, limit), 0, PyDoc_STR("Its place among the first limits, or None.")},
    {"share", T_OBJECT, offsetof(Parked, share), 0, PyDoc_STR("The share of the buffer that asks, or None.")},
    {"cancel_end", T_OBJECT, offsetof(Parked, cancel_end), 0, PyDoc_STR("Cancels the alarm of its end; None if it has none.")},
    {"patience", T_DOUBLE, offsetof(Parked, patience), 0, PyDoc_STR("How long it waits at most, in s.")},
    {"since", T_LONGLONG, offsetof(Parked, since), 0, PyDoc_STR("When it began to wait, in ns.")},
    {"version", T_LONGLONG, offsetof(Parked, version), 0, PyDoc_STR("The version of the paths that gave this answer.")},
    {"elsewhere", T_BOOL, offsetof(Parked, elsewhere), 0, PyDoc_STR("Whether Python has to forget it.")},
    {NULL}
};

static PyType_Slot parked_slots[] = {
    {Py_tp_doc, (void *)PyDoc_STR("Parked(asked, since, wake): the part of a parked lookup that a wake-up needs.")},
    {Py_tp_new, PyType_GenericNew},
    {Py_tp_init, parked_init},
    {Py_am_await, parked_await},
    {Py_am_send, parked_step},
    {Py_tp_iter, parked_await},
    {Py_tp_iternext, parked_next},
    {Py_tp_methods, parked_methods},
    {Py_tp_dealloc, parked_dealloc},
    {Py_tp_traverse, parked_traverse},
    {Py_tp_clear, parked_clear},
    {Py_tp_members, parked_members},
    {Py_tp_getset, parked_getset},
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

static Line *spare; /* an empty one; NULL if there is none */

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

/* An empty line; a new reference. */
static PyObject *
line_new(void)
{
    Line *line = spare;
    if (line == NULL) {
        return PyObject_CallNoArgs(OBJECT(LineType));
    }
    spare = NULL;
    return OBJECT(line);
}

/* The end of a reference to an empty line. A line and its containers take as long to make as the rest of the parking, so
 * one is kept. */
static void
line_end(Line *line)
{
    if (spare == NULL && Py_REFCNT(OBJECT(line)) == 1 && Py_TYPE(OBJECT(line)) == LineType) {
        spare = line;
    } else {
        Py_DECREF(OBJECT(line));
    }
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

enum { PATHS, FRAMES, READERS, LINES, PARKED, LIMITS, WATCHES, INDEX, ORDERS, FORGET, KIND, BEGIN, CALL_AFTER, SHARE, HERE, LOOP, HOOK, PARTS };

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
                             &PyList_Type, &parts[LIMITS], &PyDict_Type, &parts[WATCHES], &parts[INDEX])) {
        return -1;
    }
    if (self->parts[PATHS] != NULL) {
        PyErr_SetString(PyExc_RuntimeError, "a Feed is initialised once, because it may be at work");
        return -1;
    }
    parts[ORDERS] = PyObject_GetAttr(parts[INDEX], orders_string);
    parts[FORGET] = parts[ORDERS] == NULL ? NULL : PyObject_GetAttr(parts[INDEX], forget_string);
    if (parts[FORGET] == NULL || !PyIter_Check(parts[ORDERS])) {
        Py_XDECREF(parts[ORDERS]);
        Py_XDECREF(parts[FORGET]);
        if (!PyErr_Occurred()) {
            PyErr_SetString(PyExc_TypeError, "the orders must be an iterator");
        }
        return -1;
    }
    for (int i = 0; i <= FORGET; i++) {
        if (i != ORDERS && i != FORGET) {
            Py_INCREF(parts[i]);
        }
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

/* Target, source and at of a waiter's plain question, borrowed; 0 if it is not plain. */
static int
is_plain(const Parked *waiter, PyObject **asked)
{
    PyObject *question = waiter->asked;
    const Py_ssize_t size = question != NULL && PyTuple_Check(question) ? PyTuple_Size(question) : 0;
    for (Py_ssize_t i = 0; i < size; i++) {
        PyObject *item = PyTuple_GetItem(question, i);
        if (i < 3) {
            asked[i] = item;
        } else if (item != Py_None) {
            return 0;
        }
    }
    return size >= 3;
}

/* The index of the first place in a sorted list that is not less than `place`; -1 for an error. */
static Py_ssize_t
place_index(PyObject *places, PyObject *place)
{
    Py_ssize_t low = 0, high = PyList_Size(places);
    while (low < high) {
        const Py_ssize_t middle = (low + high) / 2;
        const int less = PyObject_RichCompareBool(PyList_GetItem(places, middle), place, Py_LT);
        if (less < 0) {
            return -1;
        }
        low = less ? middle + 1 : low;
        high = less ? high : middle;
    }
    return low;
}

/* Put (-stamp, -order, waiter) into a sorted list, and into `place`. */
static int
line_up(PyObject *places, PyObject **place, Parked *waiter, int64_t stamp, PyObject *orders)
{
    PyObject *order = PyIter_Next(orders);
    const long long number = order == NULL ? -1 : PyLong_AsLongLong(order);
    Py_XDECREF(order);
    if (number < 0) {
        if (!PyErr_Occurred()) {
            PyErr_SetString(PyExc_ValueError, "the orders end, or are negative");
        }
        return -1;
    }
    PyObject *due = PyLong_FromLongLong(-stamp), *turn = PyLong_FromLongLong(-number);
    PyObject *made = due == NULL || turn == NULL ? NULL : PyTuple_Pack(3, due, turn, OBJECT(waiter));
    Py_XDECREF(due);
    Py_XDECREF(turn);
    const Py_ssize_t index = made == NULL ? -1 : place_index(places, made);
    if (index < 0 || PyList_Insert(places, index, made) < 0) {
        Py_XDECREF(made);
        return -1;
    }
    PyObject *old = *place;
    *place = made;
    Py_XDECREF(old);
    return 0;
}

/* Forget the limit of a waiter, if it has one. */
static int
drop_limit(PyObject *limits, Parked *waiter)
{
    PyObject *limit = waiter->limit;
    if (limit == NULL || !PyTuple_CheckExact(limit)) {
        return 0;
    }
    waiter->limit = NULL;
    const Py_ssize_t index = place_index(limits, limit);
    const int failed = index < 0 || (index < PyList_Size(limits) && PyList_GetItem(limits, index) == limit
                                     && PyList_SetSlice(limits, index, index + 1, NULL) < 0);
    Py_DECREF(limit);
    return failed ? -1 : 0;
}

/* The edge of a path that lags most, if only newer samples are missing at a stamp; borrowed. `limit` becomes the newest
 * stamp that any other edge may reach before it loses this one. */
static const History *
lagging_edge(const Chain *path, int64_t at, int64_t *limit)
{
    const History *lagging = NULL;
    int64_t least = INT64_MAX;
    *limit = INT64_MAX;
    for (Py_ssize_t i = 0; i < path->up + path->down; i++) {
        const History *edge = path->steps[i].edge;
        if (edge == NULL) {
            continue;
        }
        const Samples samples = samples_of(edge);
        if (edge->mixed || samples.count == 0 || at < samples.stamps[0]) {
            return NULL;
        }
        const int64_t newest = samples.stamps[samples.count - 1];
        if (newest < at && newest < least) {
            least = newest;
            lagging = edge;
        }
    }
    for (Py_ssize_t i = 0; lagging != NULL && i < path->up + path->down; i++) {
        const History *edge = path->steps[i].edge;
        if (edge == NULL || edge == lagging || edge->keep < 0) {
            continue;
        }
        const Samples samples = samples_of(edge);
        const Py_ssize_t next = lower_bound(samples.stamps, samples.count, at);
        const int exact = next < samples.count && samples.stamps[next] == at;
        const int64_t before = samples.stamps[exact ? next : next - 1];
        int64_t lasts = before > INT64_MAX - edge->keep ? INT64_MAX : before + edge->keep;
        if (next + exact == samples.count && lasts < at) {
            lasts = at;
        }
        *limit = lasts < *limit ? lasts : *limit;
    }
    return lagging;
}

/* Put a waiter into the line of a frame, and its first limit among the limits. */
static int
feed_line_up(const Feed *self, Parked *waiter, PyObject *child, int64_t at, int64_t limit)
{
    PyObject *lines = self->parts[LINES], *orders = self->parts[ORDERS];
    PyObject *names = PyTuple_Pack(1, child), *old = waiter->names;
    if (names == NULL) {
        return -1;
    }
    waiter->names = names;
    Py_XDECREF(old);
    if (PyDict_SetItem(self->parts[PARKED], OBJECT(waiter), Py_None) < 0) {
        return -1;
    }
    PyObject *line = PyDict_GetItemWithError(lines, child);
    Py_XINCREF(line);
    if (line == NULL) {
        line = PyErr_Occurred() ? NULL : line_new();
        if (line == NULL || PyDict_SetItem(lines, child, line) < 0) {
            Py_XDECREF(line);
            return -1;
        }
    }
    int failed = 1;
    if (!PyObject_TypeCheck(line, LineType) || ((Line *)line)->places == NULL) {
        PyErr_SetString(PyExc_TypeError, "the lines must be lines");
    } else {
        failed = line_up(((Line *)line)->places, &waiter->place, waiter, at, orders) < 0
                 || (limit < INT64_MAX && line_up(self->parts[LIMITS], &waiter->limit, waiter, limit, orders) < 0);
    }
    Py_DECREF(line);
    return failed ? -1 : 0;
}

/* The edge that a lookup waits for, borrowed, if newer samples are all that it lacks. NULL where Python has to look closer,
 * perhaps with an error. */
static const History *
feed_edge(const Feed *self, const Parked *waiter, int64_t *at, int64_t *limit)
{
    PyObject *asked[3];
    int overflow;
    if (self->parts[PATHS] == NULL || !is_plain(waiter, asked) || !PyLong_CheckExact(asked[2])) {
        return NULL;
    }
    *at = PyLong_AsLongLongAndOverflow(asked[2], &overflow);
    const Chain *path = overflow || *at == INT64_MIN ? NULL : paths_find((Paths *)self->parts[PATHS], asked[0], asked[1]);
    const History *edge = path == NULL || !path->alone ? NULL : lagging_edge(path, *at, limit);
    if (edge == NULL || *limit == INT64_MAX) {
        return edge;
    }
    int64_t passed;
    PyObject *number = PyObject_GetAttr(self->parts[INDEX], passed_string);
    const int failed = number == NULL || read_stamp(number, &passed) < 0;
    Py_XDECREF(number);
    return failed || *limit < passed ? NULL : edge;
}

/* ask(target, source, at, timeout): a lookup to be awaited, once. None if the timeout is neither None nor a float in s. */
static PyObject *
feed_ask(Feed *self, PyObject *const *args, Py_ssize_t nargs)
{
    if (nargs != 4 || self->parts[KIND] == NULL || self->parts[HERE] == NULL) {
        PyErr_SetString(PyExc_TypeError, "ask takes target, source, at and a timeout, after kind and here");
        return NULL;
    }
    double patience = Py_HUGE_VAL;
    if (args[3] != Py_None) {
        patience = PyFloat_CheckExact(args[3]) ? PyFloat_AsDouble(args[3]) : -1.0;
        /* Not `<`, which is false for NaN. */
        if (!(patience >= 0.0)) {
            Py_RETURN_NONE;
        }
    }
    PyObject *name = PyObject_GetAttr(self->parts[HERE], name_string);
    if (name == NULL) {
        return NULL;
    }
    Py_DECREF(name);
    PyObject *question = PyTuple_Pack(3, args[0], args[1], args[2]);
    Parked *made = question == NULL ? NULL : (Parked *)PyType_GenericAlloc((PyTypeObject *)self->parts[KIND], 0);
    if (made == NULL) {
        Py_XDECREF(question);
        return NULL;
    }
    made->asked = question;
    Py_INCREF(OBJECT(self));
    made->feed = OBJECT(self);
    made->patience = patience;
    made->on_asyncio = name == Py_None;
    made->step = BEFORE_TURN;
    return OBJECT(made);
}

/* park(waiter): park a lookup that calls back if newer samples are all that it lacks, and say whether it is parked. */
static PyObject *
feed_park(Feed *self, PyObject *waiter)
{
    int64_t at, limit;
    if (!PyObject_TypeCheck(waiter, ParkedType)) {
        PyErr_SetString(PyExc_TypeError, "only a parked lookup has a place");
        return NULL;
    }
    const History *edge = feed_edge(self, (Parked *)waiter, &at, &limit);
    PyObject *child = edge == NULL ? NULL : PyObject_GetAttr(OBJECT(edge), child_string);
    if (child == NULL) {
        return PyErr_Occurred() ? NULL : PyBool_FromLong(0);
    }
    const int failed = feed_line_up(self, (Parked *)waiter, child, at, limit) < 0;
    Py_DECREF(child);
    return failed ? NULL : PyBool_FromLong(1);
}

/* The hook of this thread for new asynchronous generators, or NULL. Each event loop sets one of its own while it runs; to ask
 * which loop runs takes asyncio a call of the operating system. */
static PyObject *
hook_of_loop(void)
{
    static PyObject *ask;
    if (ask == NULL && (ask = imported("sys", "get_asyncgen_hooks")) == NULL) {
        return NULL;
    }
    PyObject *hooks = PyObject_CallNoArgs(ask);
    PyObject *hook = hooks == NULL ? NULL : PySequence_GetItem(hooks, 0);
    Py_XDECREF(hooks);
    return hook;
}

/* The bare sleep of a waiter on asyncio or trio, and what wakes it; NULL for an error. */
static PyObject *
bare_sleep(Parked *waiter, PyObject *loop)
{
    PyObject *wakes, *sleep = NULL, *old = waiter->wake;
    if (waiter->on_asyncio) {
        wakes = PyObject_CallMethodObjArgs(loop, create_future_string, NULL);
        sleep = wakes == NULL ? NULL : PyObject_GetIter(wakes);
    } else {
        wakes = needs_trio() ? PyObject_CallNoArgs(current_task) : NULL;
        PyObject *abort = wakes == NULL ? NULL : PyObject_GetAttr(OBJECT(waiter), abort_string);
        sleep = abort == NULL ? NULL : PyObject_CallFunctionObjArgs(wait_task_rescheduled, abort, NULL);
        Py_XDECREF(abort);
    }
    if (sleep == NULL) {
        Py_XDECREF(wakes);
        return NULL;
    }
    waiter->wake = wakes;
    waiter->wakes = waiter->on_asyncio ? FUTURE : TASK;
    Py_XDECREF(old);
    return sleep;
}

/* Whether lookups may sleep on the event loop that runs now; -1 for an error. */
static int
feed_may_sleep(const Feed *self, Parked *waiter)
{
    if (self->parts[LOOP] != NULL && waiter->patience > 0.0) {
        PyObject *hook = hook_of_loop();
        const int known = hook != NULL && hook == self->parts[HOOK];
        Py_XDECREF(hook);
        if (known || hook == NULL) {
            return known ? 1 : -1;
        }
    }
    PyObject *begun = PyObject_CallFunctionObjArgs(self->parts[BEGIN], OBJECT(waiter), NULL);
    const int may = begun == NULL ? -1 : begun == Py_True && self->parts[LOOP] != NULL;
    Py_XDECREF(begun);
    return may;
}

/* The iterator that sleeps until a waiter is woken; None to let Python go on. */
static PyObject *
feed_sleeper(const Feed *self, Parked *waiter)
{
    int64_t now;
    const int may = feed_may_sleep(self, waiter);
    if (may <= 0 || !paths_now((const Paths *)self->parts[PATHS], &now)) {
        return may < 0 || PyErr_Occurred() ? NULL : Py_NewRef(Py_None);
    }
    PyObject *loop = Py_NewRef(self->parts[LOOP]), *sleeper = bare_sleep(waiter, loop), *old = waiter->share;
    Py_DECREF(loop);
    if (sleeper == NULL) {
        return NULL;
    }
    waiter->share = Py_XNewRef(self->parts[SHARE]);
    waiter->since = now;
    Py_XDECREF(old);
    if (waiter->patience < Py_HUGE_VAL && waiter->cancel_end == NULL) {
        PyObject *seconds = PyFloat_FromDouble(waiter->patience), *expire = PyObject_GetAttr(OBJECT(waiter), expire_string);
        if (seconds != NULL && expire != NULL && self->parts[CALL_AFTER] != NULL) {
            waiter->cancel_end = PyObject_CallFunctionObjArgs(self->parts[CALL_AFTER], seconds, expire, NULL);
        }
        Py_XDECREF(seconds);
        Py_XDECREF(expire);
        if (waiter->cancel_end == NULL) {
            Py_CLEAR(sleeper);
        }
    }
    return sleeper;
}

/* If newer samples are all that is missing, begin to sleep: 1. 0 if not, or Python has to go on; -1 for an error, and
 * then Python removes what is in the index. */
static int
parked_sleep(Parked *self, const Feed *feed)
{
    int64_t at, limit;
    const Paths *paths = (const Paths *)feed->parts[PATHS];
    const History *edge = feed->parts[BEGIN] == NULL ? NULL : feed_edge(feed, self, &at, &limit);
    PyObject *child = edge == NULL ? NULL : PyObject_GetAttr(OBJECT(edge), child_string);
    if (child == NULL) {
        return PyErr_Occurred() ? -1 : 0;
    }
    const long long version = paths->version;
    PyObject *sleeper = feed_sleeper(feed, self);
    int parked = sleeper == NULL ? -1 : 0;
    /* Python code has run: the collector may call anything. */
    if (parked == 0 && sleeper != Py_None && feed->parts[PATHS] == OBJECT(paths) && paths->version == version) {
        parked = feed_line_up(feed, self, child, at, limit) < 0 ? -1 : 1;
    }
    Py_DECREF(child);
    if (parked > 0) {
        PyObject *old = self->sleeper;
        self->sleeper = sleeper;
        sleeper = old;
    }
    Py_XDECREF(sleeper);
    return parked;
}

/* Ask; without an answer, as `parked_sleep`. */
static int
parked_ask(Parked *self, const Feed *feed)
{
    PyObject *asked[3];
    if (feed->parts[PATHS] == NULL || !is_plain(self, asked)) {
        return 0;
    }
    PyObject *old = self->answer;
    self->answer = paths_answer((Paths *)feed->parts[PATHS], asked, 3);
    Py_XDECREF(old);
    return self->answer == Py_None ? parked_sleep(self, feed) : self->answer == NULL ? -1 : 0;
}

/* One step of the wait. At its end, the answer is there if it holds. */
static PySendResult
parked_step(PyObject *itself, PyObject *value, PyObject **result)
{
    Parked *self = (Parked *)itself;
    const Feed *feed = (const Feed *)self->feed;
    char step = self->step;
    int sleeps;
    *result = NULL;
    if (step == NOT_AWAITED || feed == NULL) {
        PyErr_SetString(PyExc_RuntimeError, "a lookup is awaited once");
        return PYGEN_ERROR;
    }
    self->step = NOT_AWAITED;
    if (step == BEFORE_TURN) {
        if ((sleeps = parked_sleep(self, feed)) < 0) {
            return PYGEN_ERROR;
        }
        step = sleeps ? ASLEEP : AT_TURN;
        if (!sleeps && self->on_asyncio) {
            self->step = AT_TURN;
            *result = Py_NewRef(Py_None);
            return PYGEN_NEXT;
        }
        if (!sleeps && (!needs_trio() || (self->sleeper = PyObject_CallNoArgs(trio_checkpoint)) == NULL)) {
            return PYGEN_ERROR;
        }
    }
    for (;;) {
        PyObject *sleeper = self->sleeper;
        if (sleeper != NULL) {
            self->sleeper = NULL;
            const PySendResult sent = PyIter_Send(sleeper, value, result);
            if (sent == PYGEN_NEXT) {
                self->sleeper = sleeper;
                self->step = step;
                return sent;
            }
            Py_DECREF(sleeper);
            const Paths *paths = (const Paths *)feed->parts[PATHS];
            if (step == ASLEEP && (paths == NULL || self->version != paths->version)) {
                Py_CLEAR(self->answer);
            }
            if (step == ASLEEP || sent == PYGEN_ERROR) {
                return sent;
            }
            Py_CLEAR(*result);
        }
        if ((sleeps = parked_ask(self, feed)) <= 0) {
            *result = sleeps < 0 ? NULL : Py_NewRef(Py_None);
            return sleeps < 0 ? PYGEN_ERROR : PYGEN_RETURN;
        }
        step = ASLEEP;
        value = Py_None;
    }
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
    if (last == 0 && line_has_places_only(line)) {
        Py_INCREF(OBJECT(line));
        if (PyDict_DelItem(lines, child) < 0) {
            PyErr_Clear();
        }
        line_end(line);
    }
    return item;
}

/* Give a waiter its answer, if that is plain. */
static void
feed_answer(const Feed *self, Parked *waiter)
{
    PyObject *asked[3], *question = waiter->asked;
    if (!is_plain(waiter, asked)) {
        return;
    }
    Paths *paths = (Paths *)self->parts[PATHS];
    Py_INCREF(question);
    PyObject *old = waiter->answer, *answer = paths_answer(paths, asked, 3);
    waiter->answer = answer;
    waiter->version = paths->version;
    if (answer == NULL) {
        /* Out of memory: then it asks itself. */
        PyErr_Clear();
    }
    Py_XDECREF(old);
    Py_DECREF(question);
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
        if (drop_limit(self->parts[LIMITS], waiter) < 0) {
            set_aside(trouble);
        }
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
            PyObject *woken = parked_end(waiter, NULL);
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
    {"ask", FAST(feed_ask), METH_FASTCALL,
     PyDoc_STR("ask(target, source, at, timeout): a lookup to be awaited, once; then it has its answer, or Python has to "
               "go on. None if the timeout is neither None nor a float that is a duration.")},
    {"park", (PyCFunction)feed_park, METH_O,
     PyDoc_STR("park(waiter): park a lookup that calls back if newer samples are all that it lacks; whether it is parked.")},
    {"insert", (PyCFunction)feed_insert, METH_O,
     PyDoc_STR("insert(batch): store a batch and wake the lookups that it has unblocked, if all is plain; else do "
               "nothing.")},
    {NULL}
};

static int
feed_set_kind(Feed *self, PyObject *kind, void *Py_UNUSED(closure))
{
    if (kind == NULL || !PyType_Check(kind) || !PyType_IsSubtype((PyTypeObject *)kind, ParkedType)) {
        PyErr_SetString(PyExc_TypeError, "kind must be a class of parked lookups");
        return -1;
    }
    /* A class that was made in Python has no `am_send`, and each step of a task of trio would cost an exception. */
    static PyObject *base, *made;
    if (base != kind) {
        PyType_Slot slots[] = {{Py_am_await, parked_await}, {Py_am_send, parked_step}, {0, NULL}};
        PyType_Spec spec = {"tfbus._kernel.Awaited", 0, 0, Py_TPFLAGS_DEFAULT, slots};
        PyObject *derived = PyType_FromSpecWithBases(&spec, kind), *old[] = {base, made};
        if (derived == NULL) {
            return -1;
        }
        Py_INCREF(kind);
        base = kind;
        made = derived;
        Py_XDECREF(old[0]);
        Py_XDECREF(old[1]);
    }
    PyObject *old = self->parts[KIND];
    self->parts[KIND] = Py_NewRef(made);
    Py_XDECREF(old);
    return 0;
}

static PyObject *
feed_loop(Feed *self, void *Py_UNUSED(closure))
{
    return Py_NewRef(self->parts[LOOP] == NULL ? Py_None : self->parts[LOOP]);
}

static int
feed_set_loop(Feed *self, PyObject *loop, void *Py_UNUSED(closure))
{
    PyObject *hook = NULL, *old[] = {self->parts[LOOP], self->parts[HOOK]};
    loop = loop == Py_None ? NULL : loop;
    if (loop != NULL && (hook = hook_of_loop()) == NULL) {
        return -1;
    }
    if (hook == Py_None) {
        Py_CLEAR(hook);
    }
    Py_XINCREF(loop);
    self->parts[LOOP] = loop;
    self->parts[HOOK] = hook;
    Py_XDECREF(old[0]);
    Py_XDECREF(old[1]);
    return 0;
}

static PyGetSetDef feed_getset[] = {
    {"loop", (getter)feed_loop, (setter)feed_set_loop,
     PyDoc_STR("The event loop that runs while this is set, and on which lookups then sleep without `begin`; or None."), NULL},
    {"kind", NULL, (setter)feed_set_kind, PyDoc_STR("The class of what `ask` gives."), NULL},
    {NULL}
};

static PyMemberDef feed_members[] = {
    {"begin", T_OBJECT, offsetof(Feed, parts[BEGIN]), 0,
     PyDoc_STR("begin(waiter): set `loop` to the event loop that runs; whether a lookup may sleep on it.")},
    {"call_after", T_OBJECT, offsetof(Feed, parts[CALL_AFTER]), 0,
     PyDoc_STR("call_after(seconds, callback): set an alarm on that loop, and return what cancels it.")},
    {"here", T_OBJECT, offsetof(Feed, parts[HERE]), 0,
     PyDoc_STR("Its `name` is None in a task of asyncio, and the name of another library in a task of that.")},
    {"share", T_OBJECT, offsetof(Feed, parts[SHARE]), 0, PyDoc_STR("The share of the buffer that asks.")},
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
    {Py_tp_members, feed_members},
    {Py_tp_getset, feed_getset},
    {0, NULL}
};

static PyType_Spec feed_spec = {
    "tfbus._kernel.Feed", sizeof(Feed), 0, Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC, feed_slots
};

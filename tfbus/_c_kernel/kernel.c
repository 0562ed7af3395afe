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
 *
 * This is the one file that is compiled. It includes a file for each story, in the order in which one needs the other,
 * so everything is static and the compiler sees all of it at once.
 */
#include "base.h"
#include "transform.h"
#include "samples.h"
#include "paths.h"
#include "waiting.h"
#include "publishing.h"

/* The module -------------------------------------------------------------------------------------------------------- */

static PyMethodDef module_methods[] = {
    {"compose_rows", FAST(compose_rows), METH_FASTCALL, PyDoc_STR("compose_rows(a, b): the row of a @ b.")},
    {"invert_row", (PyCFunction)invert_row, METH_O, PyDoc_STR("invert_row(row): the row of the inverse.")},
    {"move_point", FAST(move_point), METH_FASTCALL,
     PyDoc_STR("move_point(row, point): the moved point; None if it is not a tuple of three floats or int.")},
    {"move_points", FAST(move_points), METH_FASTCALL,
     PyDoc_STR("move_points(row, points, out): move contiguous points of float64 or float32; else False.")},
    {"fill_matrix", FAST(fill_matrix), METH_FASTCALL,
     PyDoc_STR("fill_matrix(row, out): write the homogeneous matrix of a row into an array, and return the array.")},
    {"row_of_matrix", (PyCFunction)row_of_matrix, METH_O,
     PyDoc_STR("row_of_matrix(matrix): the row of a homogeneous matrix; None if it is not rigid but for rounding.")},
    {"compose_paths", FAST(compose_paths), METH_FASTCALL,
     PyDoc_STR("compose_paths(rows, origins): make every pose relative to the first one.")},
    {"decode", FAST(decode), METH_FASTCALL,
     PyDoc_STR("decode(body, at, tags, names, kind): the samples of a message up to the first that is not plain, and "
               "its offset.")},
    {"decode_whole", FAST(decode_whole), METH_FASTCALL,
     PyDoc_STR("decode_whole(tags, names, kind, most, payload): the samples of a message with its header, if all are "
               "plain; else None.")},
    {"columns", FAST(columns), METH_FASTCALL,
     PyDoc_STR("columns(parents, children, stamps, rows, authority, static, square): the rows as a batch, or None if one "
               "is not plain. They are normalised in place.")},
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
                   {"at", &at_string}, {"_paths", &paths_string}, {"_memory", &memory_string},
                   {"child", &child_string}, {"passed", &passed_string},
                   {"source_at", &source_at_string}, {"fixed", &fixed_string}, {"max_age", &max_age_string},
                   {"not_before", &not_before_string}, {"not_after", &not_after_string}, {"tolerance", &tolerance_string}, {"max_gap", &max_gap_string},
                   {"extrapolate", &extrapolate_string}, {"_nanoseconds", &nanoseconds_string},
                   {"_policy_use", &policy_use_string}, {"extrapolation_error", &error_string}, {"_clock_namers", &namers_string},
                   {"create_future", &create_future_string}, {"set_result", &set_result_string}, {"end", &end_string}, {"name", &name_string}, {"expire", &expire_string}, {"abort", &abort_string}, {"orders", &orders_string},
                   {"forget", &forget_string}, {"locked", &locked_string}, {"mask", &mask_string}};
    for (size_t i = 0; i < sizeof strings / sizeof *strings; i++) {
        if (*strings[i].place == NULL && (*strings[i].place = PyUnicode_InternFromString(strings[i].text)) == NULL) {
            return -1;
        }
    }
    if (bound_method == NULL && (bound_method = imported("types", "MethodType")) == NULL) {
        return -1;
    }
    if (add_type(module, "Sample", &sample_spec, &SampleType) < 0
        || add_type(module, "Columns", &columns_spec, &ColumnsType) < 0
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
#ifdef KERNEL_SOURCES
    /* In a checkout, tfbus/running_kernel.py compares it with the checksum of these files. */
    if (PyModule_AddIntConstant(module, "sources", KERNEL_SOURCES) < 0) {
        return -1;
    }
#endif
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

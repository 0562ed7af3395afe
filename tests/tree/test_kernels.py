"""Both kernels do the same; the compiled one has to do it with the same bits."""

import copy
import gc
import math
import os
import pickle
import random
import shutil
import struct
import subprocess
import sys
import threading
import weakref
from contextlib import suppress
from importlib.machinery import EXTENSION_SUFFIXES
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.both_kernels import COMPILED, KERNELS, bits, needs_both, sample_class, tfbus_on
from support.samples import row_of
from support.strategies import TODAY, transforms
from transforms3d.quaternions import quat2mat

import tfbus
from tfbus import LATEST, SECOND, Hold, Transform, TransformStamped, TransformTree, _python_kernel
from tfbus.rows import IDENTITY, Row, compose, interpolate, invert
from tfbus.stamps import STAMP_MAX, STAMP_MIN

on_both = pytest.mark.parametrize("kernel", KERNELS)

Poses = list[tuple[int, Row]]


def history(kernel: Any, samples: Any = (), keep: int | None = None) -> Any:
    """An edge with (stamp, row) samples in any order."""
    edge = kernel.History("parent", keep)
    for stamp, row in samples:
        if edge.newest is None or stamp > edge.newest:
            edge.push(stamp, row)
        elif stamp >= edge.horizon:
            edge.put(edge.find(stamp), stamp, row)
    return edge


def contents(edge: Any) -> Poses:
    return [edge.sample(i) for i in range(edge.count)]


def x(metres: float) -> Row:
    return metres, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0


def between(poses: Poses, at: int) -> Row | None:
    """The row at a stamp by the readable arithmetic; None outside the samples."""
    for (before, first), (after, second) in pairwise(poses):
        if before < at < after:
            return interpolate(first, second, (at - before) / (after - before))
    return dict(poses).get(at)


def read(columns: Any) -> list[tuple[int, float]]:
    """The stamps and the x of the columns of a history."""
    stamps_in, begin, rows_in, rows_begin, width, count = columns
    stamps = np.frombuffer(stamps_in, np.int64, count, begin)
    rows = np.frombuffer(rows_in, np.float64, count * width, rows_begin).reshape(count, width)
    return list(zip(stamps.tolist(), rows[:, -7].tolist(), strict=True))


# A history


@on_both
@given(
    st.lists(st.tuples(st.integers(-60, 60), transforms(10.0).map(row_of)), max_size=30),
    st.sampled_from([0, 1, 16, 50, None]),
)
def test_a_history_holds_what_was_inserted_last_at_each_stamp_of_its_window(
    kernel: ModuleType, samples: Poses, keep: int | None
) -> None:
    edge = history(kernel, samples, keep)
    expected: dict[int, Row] = {}
    for stamp, row in samples:
        newest = max(expected, default=stamp)
        if keep is None or stamp >= newest - keep:
            expected[stamp] = row
    newest = max(expected, default=0)
    kept = sorted((stamp, row) for stamp, row in expected.items() if keep is None or stamp >= newest - keep)
    assert contents(edge) == kept
    stamps = [stamp for stamp, _ in kept]
    assert (edge.count, edge.oldest, edge.newest) == (len(kept), *((stamps[0], stamps[-1]) if kept else (None, None)))
    for at in range(-62, 63, 3):
        assert edge.find(at) == sum(stamp < at for stamp in stamps)
        last, beyond = max(sum(stamp <= at for stamp in stamps) - 1, 0), sum(stamp < at for stamp in stamps)
        assert edge.between(at, at + 5) == (last, min(sum(stamp < at + 5 for stamp in stamps) + 1, len(stamps)))
        assert edge.between(-99, at) == (0, min(beyond + 1, len(stamps)))
    assert edge.newest_record == b"".join(struct.pack("q7d", stamp, *row) for stamp, row in kept[-1:])


@needs_both
@pytest.mark.skipif(sys.gettrace() is not None, reason="a tracer makes objects that begin a collection")
def test_a_sample_is_whole_though_the_garbage_collector_clears_the_history_meanwhile() -> None:
    assert COMPILED is not None
    edge = history(COMPILED, [(0, x(1.0)), (10, x(2.0))])

    def clear(_phase: str, _info: dict[str, int]) -> None:
        edge.clear()

    threshold = gc.get_threshold()
    gc.set_threshold(1_000_000)
    # Until they are used up, tuples come from a store of old ones, and begin no collection.
    tuples = [(number,) * 7 for number in range(3_000)]
    gc.callbacks.append(clear)
    try:
        # These were so many that the next one begins a collection.
        gc.set_threshold(1)
        found = edge.sample(1)
    finally:
        gc.set_threshold(*threshold)
        gc.callbacks.remove(clear)
    assert found == (10, x(2.0))
    assert (edge.count, len(tuples)) == (0, 3_000)


@on_both
def test_no_change_of_a_history_changes_its_columns_that_somebody_holds(kernel: ModuleType) -> None:
    edge = history(kernel, [(stamp, x(stamp)) for stamp in range(100)], keep=99)
    held = edge.columns(10, 13)
    changes = [
        lambda: edge.put(11, 11, x(-1.0)),
        lambda: edge.append("parent", 150, x(-2.0), ""),
        lambda: edge.put(0, 60, x(-3.0)),
        lambda: [edge.append("parent", stamp, x(-4.0), "") for stamp in range(151, 400)],
        edge.clear,
        lambda: edge.push(1, x(-5.0)),
    ]
    for change in changes:
        change()
        assert read(held) == [(10, 10.0), (11, 11.0), (12, 12.0)]
    changes.clear()
    edge = None
    gc.collect()
    assert read(held) == [(10, 10.0), (11, 11.0), (12, 12.0)]


@on_both
@pytest.mark.parametrize(
    ("keep", "disturbed"), [pytest.param(19_999, False, marks=pytest.mark.thorough), (19_999, True), (None, True)]
)
def test_a_long_history_has_all_samples_of_its_window_at_all_times(
    kernel: ModuleType, keep: int | None, disturbed: bool
) -> None:
    """A history of so many samples moves into another memory bit by bit, and may be disturbed meanwhile."""
    edge = history(kernel, [(0, x(0.0))], keep)
    last = 60_000
    views: list[Any] = []
    for stamp in range(1, last):
        assert edge.append("parent", stamp, x(stamp), "")
        if stamp % 4_001 == 0:
            first = 0 if keep is None else max(stamp - keep, 0)
            found = read(edge.columns(0, edge.count))
            assert found == [(at, float(at)) for at in range(first, stamp + 1)]
            if disturbed:
                # A late sample takes the place of another, twice, and somebody holds what there was.
                views.append((edge.columns(edge.count - 3, edge.count), found[-3:]))
                edge.put(edge.count // 2, found[len(found) // 2][0], x(-1.0))
                edge.put(edge.count // 2, found[len(found) // 2][0], x(found[len(found) // 2][1]))
    for view, expected in views:
        assert read(view) == expected
    twin = kernel.History("parent", keep)
    twin.take(edge)
    edge.clear()
    assert (twin.count, twin.newest, edge.count) == (last if keep is None else keep + 1, last - 1, 0)


@on_both
def test_stamps_at_the_ends_of_64_bits_leave_no_window_early(kernel: ModuleType) -> None:
    edge = history(kernel, [(STAMP_MIN, x(1.0)), (STAMP_MIN + 5, x(2.0))], keep=10)
    assert edge.count == 2
    edge.push(STAMP_MAX, x(3.0))
    assert contents(edge) == [(STAMP_MAX, x(3.0))]


# A path


@st.composite
def drawn_edges(draw: st.DrawFn, at: int) -> Poses:
    """Samples round a stamp, with the neighbours that have broken slerps: equal, opposite, near, half a turn away."""
    first = draw(transforms(10.0))
    turn = draw(transforms(10.0) | st.sampled_from([first, Transform()]))
    second = draw(st.sampled_from([turn, first @ turn]))
    if draw(st.booleans()):
        second = Transform(second.translation, [-part for part in second.rotation])
    step = draw(st.sampled_from([1, 3, 1_000, 2**53 - 1, 2**53, 2**53 + 1, 2**62]))
    early, late = draw(st.integers(0, step)), draw(st.integers(1, step))
    poses = [(at - early, row_of(first)), (at + late, row_of(second))]
    return [(stamp, row) for stamp, row in poses if STAMP_MIN <= stamp <= STAMP_MAX]


Drawn = tuple[int, list[Poses | Row], list[Poses | Row]]


@st.composite
def drawn_chains(draw: st.DrawFn) -> Drawn:
    at = draw(st.sampled_from([0, 1, TODAY, STAMP_MIN, STAMP_MIN + 1, STAMP_MAX - 1, STAMP_MAX]))
    steps = st.lists(drawn_edges(at) | transforms(10.0).map(row_of), max_size=4)
    return at, draw(steps), draw(steps)


def chain(kernel: Any, up: list[Poses | Row], down: list[Poses | Row]) -> Any:
    sides = [tuple(history(kernel, step) if isinstance(step, list) else step for step in side) for side in (up, down)]
    return kernel.Chain(*sides, ())


def expected_row(up: list[Poses | Row], down: list[Poses | Row], at: int) -> Row | None:
    """The product of what each edge interpolates, by the readable arithmetic."""
    sides: list[Row] = []
    for side in (up, down):
        product: Row | None = None
        for step in side:
            here = between(step, at) if isinstance(step, list) else step
            if here is None:
                return None
            product = here if product is None else compose(here, product)
        sides.append(IDENTITY if product is None else product)
    return compose(invert(sides[1]), sides[0]) if down else sides[0]


def widest_gap(steps: list[Poses | Row]) -> int:
    return max((step[-1][0] - step[0][0] for step in steps if isinstance(step, list) and step), default=0)


@on_both
@given(drawn_chains())
def test_the_row_of_a_chain_is_bit_for_bit_the_product_of_its_interpolated_edges(
    kernel: ModuleType, drawn: Drawn
) -> None:
    at, up, down = drawn
    row = chain(kernel, up, down).row(at)
    if row is None and kernel is COMPILED and widest_gap(up + down) > 2**53:
        return
    assert bits(row) == bits(expected_row(up, down, at))


@on_both
@given(drawn_chains(), st.booleans())
def test_a_chain_says_which_stamps_it_covers_and_which_edge_decides(kernel: Any, drawn: Drawn, alone: bool) -> None:
    at, up, down = drawn
    asked = chain(kernel, up, down)
    asked.alone = alone
    edges = [step for step in (*asked.up, *asked.down) if isinstance(step, kernel.History)]
    covered = [bool(edge.count) and edge.oldest <= at <= edge.newest for edge in edges]
    assert asked.covers(at) == all(covered)
    known = paths(kernel, cart=asked)
    if up or down:
        assert known.can_answer("map", "cart", at) is (True if all(covered) else False if alone else None)
    assert known.can_answer("map", "cart", 2**70) is known.can_answer("map", "chair", at) is None
    assert known.can_answer("map", "cart", 0.5) is None
    if not all(covered):
        dropped = [edge for edge in edges if edge.count and edge.oldest > at]
        lagging = sorted(edges, key=lambda edge: STAMP_MIN if edge.newest is None else edge.newest)
        assert asked.deciding(at) is (dropped or lagging)[0]


@on_both
def test_the_latest_of_static_edges_is_their_newest_stamp(kernel: Any) -> None:
    edges = [history(kernel), history(kernel)]
    static = kernel.Chain((x(1.0),), (x(3.0),), tuple(edges))
    known = paths(kernel, cart=static)
    for stamps, newest in (((-5, None), 0), ((-5, -7), -5), ((TODAY, 7), TODAY)):
        for edge, stamp in zip(edges, stamps, strict=True):
            edge.static_stamp = stamp
        assert static.latest() == newest
        found = known.answer("map", "cart", LATEST)
        assert (found.stamp, found.static, found._row[0]) == (newest, True, -2.0)
    assert known.answer("map", "cart", STAMP_MAX).static
    assert known.answer("map", "cart", STAMP_MAX + 1) is None
    assert paths(kernel, cart=kernel.Chain((), (), ())).answer("map", "cart", LATEST) is None


OPTIONS = st.fixed_dictionaries(
    {},
    optional={
        "source_at": st.sampled_from([None, LATEST, -5, 5, 15, 25, 2**70]),
        "fixed": st.sampled_from([None, "map", "arm", "rack", "nobody"]),
        "not_before": st.sampled_from([None, 0, 20, 21, -(2**63), 2**63]),
        "not_after": st.sampled_from([None, 19, 20, 2**63]),
    },
)
ROBOT = (
    *((0, "base", stamp, stamp / 7.0, False) for stamp in (-10, 0, 10, 20, 30)),
    *((1, "arm", stamp, stamp / 3.0, False) for stamp in (0, 8, 16, 20)),
    (0, "rack", 3, 5.0, True),
    (2, "shelf", 4, 0.5, True),
)


def robot(package: Any) -> Any:
    tree = package.TransformTree()
    turn = package.Transform.from_axis_angle
    for parent, child, stamp, metres, static in ROBOT:
        pose = turn((1.0, 2.0, 3.0), 0.1 + metres, (metres, 0.0, 1.0))
        tree.insert(package.TransformStamped(("map", "base", "rack")[parent], child, stamp, pose, static=static))
    return tree


def said(package: Any, tree: Any, target: str, source: str, at: Any, options: dict[str, Any]) -> object:
    """The answer of a lookup, or its error."""
    latest = {LATEST: package.LATEST}
    options = {name: latest.get(value, value) for name, value in options.items()}
    try:
        found = tree.lookup(target, source, latest.get(at, at), **options)
    except (package.TransformError, TypeError, ValueError) as error:
        return type(error).__name__, str(error)
    return found.stamp, found.static, bits((*found.transform.translation, *found.transform.rotation))


@needs_both
@given(st.data())
def test_every_option_has_the_answer_or_the_error_that_the_twin_gives(data: st.DataObject) -> None:
    trees = {kernel: robot(tfbus_on(kernel)) for kernel in ("python", "compiled")}
    frames = st.sampled_from(["map", "base", "arm", "rack", "shelf", "nobody"])
    for _ in range(8):
        target, source, options = data.draw(frames), data.draw(frames), data.draw(OPTIONS)
        at = data.draw(st.sampled_from([LATEST, LATEST, -3, 5, 19, 25, 2**63]))
        # The second time the path is known, and no Python need run.
        for _ in range(2):
            ours, theirs = (said(tfbus_on(k), tree, target, source, at, options) for k, tree in trees.items())
            assert ours == theirs, (target, source, at, options)


@needs_both
@given(drawn_chains(), st.data())
def test_many_rows_are_bit_for_bit_the_single_ones(drawn: Drawn, data: st.DataObject) -> None:
    at, up, down = drawn
    compiled = chain(COMPILED, up, down)
    near = st.integers(max(at - 4, STAMP_MIN), min(at + 4, STAMP_MAX))
    known = [stamp for step in up + down if isinstance(step, list) for stamp, _ in step]
    stamps = data.draw(st.lists(near | st.sampled_from([at, *known]), max_size=8))
    columns = np.zeros((7, len(stamps)))
    first_missing = compiled.hold().rows(np.array(stamps, np.int64), columns)
    if first_missing is None:
        assert widest_gap(up + down) > 2**53
        return
    rows = [compiled.row(stamp) for stamp in stamps]
    nan = (math.nan,) * 7
    assert columns.T.tobytes() == np.array([nan if row is None else row for row in rows]).reshape(-1, 7).tobytes()
    assert first_missing == (rows.index(None) if None in rows else -1)


@on_both
def test_a_chain_of_any_length_has_a_row(kernel: ModuleType) -> None:
    edges: list[Poses | Row] = [[(0, x(0.0)), (2, x(2.0))]] * 300
    assert chain(kernel, edges, edges[:100]).row(1)[0] == 200.0
    assert chain(kernel, [], []).row(5) == IDENTITY


# Plain answers


def paths(kernel: Any, **chains: Any) -> Any:
    """Paths to 'map' from each source."""
    made = kernel.Paths(threading.Lock(), LATEST, sample_class(kernel))
    made.recent["map"] = chains
    return made


class Name(str):
    """A string that is not a plain one."""

    __slots__ = ()


@needs_both
@pytest.mark.parametrize(
    "stamps",
    [
        [5, True],
        [5, 5.0],
        [2**63],
        [5, None],
        5,
        "5",
        b"12345678",
        np.array(5),
        np.array([[5]]),
        np.array([5], np.int32),
        np.array([5], np.uint64),
        np.array([5.0]),
        np.array([5], ">i8"),
        np.array([5], "M8[ns]"),
        np.broadcast_to(np.int64(5), 2**58),
        [],
    ],
)
def test_the_compiled_kernel_hands_back_what_are_no_plain_stamps(stamps: Any) -> None:
    asked = paths(COMPILED, cart=chain(COMPILED, [[(0, x(0.0)), (10, x(10.0))]], []))
    assert asked.answer_many("map", "cart", stamps) is None


@needs_both
def test_the_compiled_kernel_answers_nothing_while_somebody_holds_the_lock() -> None:
    lock = threading.Lock()
    assert COMPILED is not None
    asked = COMPILED.Paths(lock, LATEST, COMPILED.Sample)
    asked.recent["map"] = {"cart": chain(COMPILED, [[(0, x(0.0)), (10, x(10.0))]], [])}
    with lock:
        assert asked.answer("map", "cart", 5) is None
        assert asked.answer_many("map", "cart", [5]) is None
    assert asked.answer("map", "cart", 5) is not None
    assert asked.answer_many("map", "cart", [5]) is not None
    assert asked.answer_many(Name("map"), "cart", [5]) is None
    assert asked.answer(Name("map"), "cart", 5) is None


# Plain commits


def sample(kernel: Any, child: str, stamp: int, metres: float = 0.0, **other: Any) -> Any:
    made = sample_class(kernel)()
    fields = {"parent": "parent", "row": x(metres), "authority": "", "static": False, **other}
    made._fields = fields["parent"], child, stamp, fields["row"], fields["authority"], fields["static"]
    return made


@needs_both
@pytest.mark.parametrize("without_lock", [False, True])
def test_out_of_memory_in_a_commit_leaves_every_history_as_it_was(without_lock: bool) -> None:
    nomemory = pytest.importorskip("_testcapi")
    assert COMPILED is not None
    whole = answers_of(COMPILED, threading.Lock()) if without_lock else None
    failures = 0
    for allowed in range(100):
        frames = {name: history(COMPILED, [(stamp, x(stamp)) for stamp in range(8)], keep=9) for name in "ab"}
        before = [contents(edge) for edge in frames.values()]
        # The fourth sample of an edge finds its memory full, whatever its size was.
        batch = tuple(sample(COMPILED, "ab"[i % 2], 100 + i, i) for i in range(200))
        nomemory.set_nomemory(allowed, 0)
        try:
            stored = COMPILED.commit(frames, batch, 0) if whole is None else whole.commit(frames, {}, batch)
        except MemoryError:
            stored = None
        finally:
            nomemory.remove_mem_hooks()
        if stored is None:
            failures += 1
            assert [contents(edge) for edge in frames.values()] == before
            assert COMPILED.commit(frames, batch, 0) == 200
    assert 0 < failures < 100


def answers_of(kernel: Any, lock: Any) -> Any:
    return kernel.Paths(lock, LATEST, sample_class(kernel))


@needs_both
def test_the_compiled_kernel_commits_nothing_while_somebody_holds_the_lock() -> None:
    lock = threading.Lock()
    paths, edge = answers_of(COMPILED, lock), history(COMPILED, [(0, x(0.0))])
    with lock:
        assert not paths.commit({"a": edge}, {}, (sample(COMPILED, "a", 1),))
    assert edge.count == 1
    batch = tuple(sample(COMPILED, "a", 1 + i) for i in range(100))
    assert paths.commit({"a": edge}, {}, batch)
    assert (edge.count, paths.inserted, paths.version) == (101, 100, 1)


# Memory


@on_both
def test_the_garbage_collector_finds_a_cycle_through_paths_and_chains(kernel: ModuleType) -> None:
    class Edge(kernel.History):  # type: ignore[name-defined, misc]
        pass

    edge = Edge("parent", None)
    edge.paths = paths(kernel, cart=kernel.Chain((edge,), (), ()))
    gone = weakref.ref(edge)
    del edge
    gc.collect()
    assert gone() is None


ODD: list[Any] = [None, 5, -1, 2**70, 0.5, "map", (), (5,), [], {}, b"12345678", bytearray(56), LATEST, IDENTITY, int]
ODD += [np.zeros((2, 7)), np.zeros(2, np.int64), threading.Lock()]
REFUSALS = TypeError, ValueError, LookupError, AttributeError, BufferError, RuntimeError, OverflowError, RuntimeWarning


@needs_both
def test_no_call_with_any_arguments_crashes_the_compiled_kernel() -> None:
    kernel: Any = COMPILED
    kinds: list[Any] = [kind for kind in vars(kernel).values() if isinstance(kind, type)]
    for seed in range(40):
        rng = random.Random(seed)
        path = chain(kernel, [[(0, x(0.0))]], [])
        owners = [kernel, *path.up, path, path.hold(), paths(kernel, cart=path), known_edges(kernel)["a"]]
        for kind in kinds:
            with suppress(TypeError):
                # An object that nobody has initialised.
                owners.append(kind.__new__(kind))
        for _ in range(300):
            owner = rng.choice(owners)
            first = [] if owner is kernel else ["__init__"]
            name = rng.choice([*first, *(name for name in dir(owner) if not name.startswith("__"))])
            arguments = rng.choices([*ODD, *owners], k=rng.randrange(7))
            # No `SystemError`: that is an error which C has not told, or a result beside an error.
            with suppress(*REFUSALS):
                if len(arguments) == 1 and owner is not kernel:
                    setattr(owner, name, arguments[0])
                else:
                    getattr(owner, name)(*arguments)


@on_both
@given(st.lists(st.tuples(transforms(10.0).map(row_of), st.integers(0, 100)), min_size=1, max_size=12))
def test_composed_paths_are_bit_for_bit_the_products_of_their_rows(kernel: Any, drawn: list[tuple[Row, int]]) -> None:
    origins = [number % max(place, 1) for place, (_, number) in enumerate(drawn)]
    expected: list[Row] = []
    for (row, _), origin in zip(drawn, origins, strict=True):
        expected.append(compose(expected[origin], row) if origin else row)
    rows = np.array([row for row, _ in drawn]).reshape(-1, 7)
    kernel.compose_paths(rows, np.array(origins, np.int64))
    assert rows.tobytes() == np.array(expected).tobytes()


@on_both
@pytest.mark.parametrize("origins", [[0, 0, 0], [0, 1], [1, 0], [0, -1]], ids=str)
def test_an_origin_comes_before_its_row(kernel: Any, origins: list[int]) -> None:
    with pytest.raises(ValueError, match="needs an origin before it"):
        kernel.compose_paths(np.zeros((2, 7)), np.array(origins))


@on_both
@given(transforms(), transforms(), st.booleans())
def test_the_arithmetic_of_transforms_has_the_bits_of_its_readable_definition(
    kernel: Any, a: Transform, b: Transform, single: bool
) -> None:
    first, second = row_of(a), row_of(b)
    assert bits(kernel.compose_rows(first, second)) == bits(compose(first, second))
    assert bits(kernel.invert_row(first)) == bits(invert(first))
    assert kernel.move_point(first, b.translation) == compose(first, second)[:3]
    matrix = kernel.fill_matrix(first, np.empty((4, 4)))
    assert np.array_equal(matrix[:3, :3], quat2mat(a.as_wxyz()))
    assert np.array_equal(matrix[:, 3], (*a.translation, 1.0))
    points = np.array([b.translation, (math.inf, 0.0, 1.0), (1, 2, math.nan)], np.float32 if single else np.float64)
    moved = np.empty_like(points)
    assert kernel.move_points(first, points, moved)
    x, y, z = points.T
    with np.errstate(invalid="ignore"):
        columns = [x * row[0] + y * row[1] + z * row[2] + row[3] for row in matrix[:3].astype(points.dtype)]
    assert np.array_equal(moved, np.stack(columns, 1), equal_nan=True)


@on_both
@given(transforms())
def test_a_rigid_matrix_is_read_as_its_quaternion(kernel: Any, transform: Transform) -> None:
    matrix = transform.matrix()
    row = kernel.row_of_matrix(matrix)
    assert row is not None
    assert row[:3] == transform.translation
    assert row[6] >= 0.0
    assert bits(row) == bits(_python_kernel.row_of_matrix(matrix))
    assert abs(row[3:] @ np.array(transform.rotation)) == pytest.approx(1.0, abs=1e-15)
    for place, value in (((0, 0), 2.0), ((1, 2), math.nan), ((0, 3), math.inf), ((3, 3), 1.1)):
        wrong = matrix.copy()
        wrong[place] = value
        assert kernel.row_of_matrix(wrong) is None
    assert kernel.row_of_matrix(matrix * (1.0, 1.0, -1.0, 1.0)) is None


@on_both
@pytest.mark.parametrize(
    "point", [(1.0, 2.0), (1.0, 2.0, np.float64(3.0)), (1, 2, 10**400), (1, 2, True), None], ids=str
)
def test_what_is_no_plain_point_is_handed_back(kernel: Any, point: Any) -> None:
    assert kernel.move_point(IDENTITY, point) is None


def known_edges(kernel: Any) -> dict[str, Any]:
    """Frames a and b on 'map', from 'me', at 10."""
    made = {}
    for child in "ab":
        made[child] = kernel.Edge()
        made[child].parent, made[child].trusted, made[child].newest = "map", "me", 10
    return made


def judged_sample(kernel: ModuleType, *, child: str = "a", stamp: int = 20, x: float = 1.0, **other: Any) -> Any:
    """A sample 9 m away if x is 1 m."""
    row = (x, 4.0, 8.0, 0.0, 0.0, 0.0, 1.0)
    return sample(kernel, child, stamp, row=row, **{"parent": "map", "authority": "me", **other})


@on_both
def test_no_batch_is_plain_once_the_bounds_are_out_of_date(kernel: Any) -> None:
    judge = kernel.Judge(known_edges(kernel), 81.0)
    judge.allow(STAMP_MIN, STAMP_MAX, 0)
    assert not judge.accepts((judged_sample(kernel),))
    judge.allow(STAMP_MIN, STAMP_MAX, STAMP_MAX)
    assert judge.accepts((judged_sample(kernel),))


class Marked(TransformStamped):
    """A subclass with something of its own."""


@pytest.mark.parametrize("again", [copy.copy, copy.deepcopy, lambda sample: pickle.loads(pickle.dumps(sample))])
def test_samples_are_copied_and_pickled_with_all_that_they_hold(again: type) -> None:
    sample = Marked("a", "b", 5, Transform((1.0, 2.0, 3.0)), "me", static=True)
    sample.mark = 7  # type: ignore[attr-defined]
    twin = again(sample)
    assert (type(twin), twin, twin.mark) == (Marked, sample, 7)
    tree = TransformTree()
    tree.insert(TransformStamped("a", "b", 0, Transform()))
    held = tree.lookup("a", "b", SECOND, extrapolate=Hold(2.0))
    assert (again(held), again(held).extrapolated_by, again(held).gap) == (held, SECOND, 0)
    assert type(again(tree.lookup("a", "b", LATEST))) is TransformStamped


SHOW = """
from tfbus import TransformStamped
from tfbus.which_kernel import kernel
print(kernel, TransformStamped.__mro__[1].__module__)
"""


def run(wanted: str | None, script: str = SHOW) -> subprocess.CompletedProcess[str]:
    """A Python with `TFBUS_KERNEL` as wanted, which does not look into the working directory for the package."""
    environment = {name: value for name, value in os.environ.items() if name != "TFBUS_KERNEL"}
    if wanted is not None:
        environment["TFBUS_KERNEL"] = wanted
    return subprocess.run(
        [sys.executable, "-P", "-c", script], env=environment, capture_output=True, text=True, check=False, timeout=60
    )


def test_python_is_the_twin() -> None:
    assert run("python").stdout.split() == ["python", "tfbus._python_kernel"]


@pytest.mark.thorough
@needs_both
def test_trees_and_buses_are_as_their_models_say_on_the_python_kernel_too() -> None:
    tests = Path(__file__).parents[1]
    models = ("tree/test_tree_model.py", "stress/test_bus_oracle.py", "bus/test_columns.py", "bus/test_topology.py")
    command = [sys.executable, "-P", "-m", "pytest", "-q", "-x", "-n0", *(str(tests / model) for model in models)]
    environment = {**os.environ, "TFBUS_KERNEL": "python"}
    done = subprocess.run(command, env=environment, cwd=tests.parent, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


CHOOSE = "from tfbus import kernel"
WITHOUT = "import sys; sys.modules['tfbus._kernel'] = None\n"


@needs_both
def test_the_compiled_kernel_runs_where_it_was_built() -> None:
    assert run("").stdout.split() == ["compiled", "tfbus._kernel"]


def test_the_twin_runs_where_the_compiled_kernel_is_missing() -> None:
    assert run(None, WITHOUT + SHOW).stdout.split() == ["python", "tfbus._python_kernel"]


@pytest.mark.parametrize("wanted", [None, "python"])
def test_a_checkout_that_hides_an_installed_compiled_kernel_warns_once_unless_it_is_asked_for(
    wanted: str | None, tmp_path: Path
) -> None:
    package, installed = Path(tfbus.__file__).parent, tmp_path / "site-packages" / "tfbus"
    shutil.copytree(package, tmp_path / "tfbus", ignore=shutil.ignore_patterns("_kernel.*", "__pycache__"))
    installed.mkdir(parents=True)
    (installed / f"_kernel{EXTENSION_SUFFIXES[-1]}").touch()
    folders = f"import sys; sys.path[:0] = {[str(tmp_path), str(installed.parent)]}\n"
    done = run(wanted, folders + SHOW + "from tfbus import Transform, kernel\nprint(Transform.__module__)")
    assert done.stdout.split() == ["python", "tfbus._python_kernel", "tfbus.geometry.transform"]
    told = f"RuntimeWarning: tfbus is loaded from {tmp_path / 'tfbus'}, which has no compiled kernel, and not from "
    assert done.stderr.count(f"{told}{installed}, which has one") == (wanted is None)
    assert bool(done.stderr) == (wanted is None)


@needs_both
def test_a_compiled_kernel_of_other_sources_does_not_run_and_the_warning_says_what_to_do(tmp_path: Path) -> None:
    copied = Path(shutil.copytree(Path(tfbus.__file__).parent, tmp_path / "tfbus"))
    # The other one is in a wheel, which has no sources.
    sources = copied / "_c_kernel"
    sources.mkdir(exist_ok=True)
    (sources / "newer.h").write_text("int newer;")
    script = f"""
import sys, os
sys.path.insert(0, {str(tmp_path)!r})
try:
    import tfbus.running_kernel
except ImportError as error:
    print(error)
os.environ["TFBUS_KERNEL"] = ""
"""
    done = run("compiled", script + SHOW)
    told = f"was compiled from other sources than those in {sources}: compile it again with pip install -e . in the "
    refused, shown = done.stdout.splitlines()
    assert told in refused
    assert shown == "python tfbus._python_kernel"
    assert done.stderr.count(told) == 1


@pytest.mark.parametrize(
    ("wanted", "script", "error"),
    [
        ("rust", CHOOSE, "ValueError: TFBUS_KERNEL must be 'python' or 'compiled', not 'rust'"),
        ("compiled", WITHOUT + CHOOSE, "tfbus._kernel halted"),
    ],
)
def test_a_kernel_that_is_not_there_is_an_error_that_names_it(wanted: str, script: str, error: str) -> None:
    assert error in run(wanted, script).stderr

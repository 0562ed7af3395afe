"""Both kernels do the same; the compiled one has to do it with the same bits."""

import copy
import gc
import math
import struct
import sys
import threading
import weakref
from array import array
from itertools import pairwise
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.both_kernels import COMPILED, KERNELS, bits, needs_both, sample_class
from support.histories import row_of
from support.strategies import TODAY, angles, transforms, unit_vectors

from tfbus import LATEST, Transform, _python_kernel
from tfbus.geometry.transform import from_row
from tfbus.rows import IDENTITY, Row, Vector, compose, interpolate, invert
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


# A history


@on_both
def test_an_empty_history_has_no_stamps(kernel: ModuleType) -> None:
    edge = history(kernel, keep=7)
    assert (edge.count, edge.oldest, edge.newest, edge.find(0), edge.keep) == (0, None, None, 0, 7)
    assert edge.newest_record == b""
    assert (edge.parent, edge.authority, edge.mixed) == ("parent", "", False)
    for read in (edge.sample, edge.stamp):
        with pytest.raises(IndexError):
            read(0)


@on_both
def test_there_are_samples_from_the_oldest_in_the_window_to_the_newest(kernel: ModuleType) -> None:
    # What has left the window is still in memory here.
    edge = history(kernel, [(stamp, x(stamp)) for stamp in range(166)], keep=160)
    assert [edge.stamp(index) for index in (0, 1, 160)] == [5, 6, 165]
    assert [edge.sample(index) for index in (0, 160)] == [(5, x(5.0)), (165, x(165.0))]
    assert [edge.between(*span) for span in ((0, 200), (5, 5), (7, 164), (165, 165))] == [
        (0, 161),
        (0, 1),
        (2, 160),
        (160, 161),
    ]
    for read in (edge.sample, edge.stamp):
        for index in (-1, -5, 161):
            with pytest.raises(IndexError, match="no sample has this index"):
                read(index)


@on_both
@pytest.mark.parametrize(
    ("parent", "stamp", "authority", "appended"),
    [
        ("parent", 11, "me", True),
        ("parent", 10, "me", False),
        ("parent", 9, "me", False),
        ("other", 11, "me", False),
        ("parent", 11, "you", False),
    ],
)
def test_append_stores_what_continues_the_history_and_nothing_else(
    kernel: ModuleType, parent: str, stamp: int, authority: str, appended: bool
) -> None:
    edge = history(kernel, [(10, x(1.0))])
    edge.authority = "me"
    assert edge.append(parent, stamp, x(2.0), authority) is appended
    assert contents(edge) == [(10, x(1.0)), (11, x(2.0))][: 1 + appended]


@on_both
def test_append_stores_nothing_in_an_empty_or_a_mixed_history(kernel: ModuleType) -> None:
    edge = history(kernel)
    assert not edge.append("parent", 1, x(1.0), "")
    edge.push(1, x(1.0))
    edge.mixed = True
    assert not edge.append("parent", 2, x(1.0), "")
    assert edge.count == 1


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


@on_both
def test_a_long_history_slides_its_window_and_takes_another_one(kernel: ModuleType) -> None:
    edge = history(kernel, [(0, x(0.0))], keep=160)
    for stamp in range(1, 2_000):
        assert edge.append("parent", stamp, x(stamp), "")
        assert (edge.oldest, edge.newest, edge.count) == (max(0, stamp - 160), stamp, min(stamp, 160) + 1)
    edge.keep = None
    assert (edge.oldest, edge.count, edge.keep) == (1_839, 161, None)
    assert edge.append("parent", 5_000, x(1.0), "")
    assert edge.oldest == 1_839
    edge.keep = 3_100
    assert contents(edge)[:1] == [(1_900, x(1_900.0))]


@pytest.mark.parametrize(
    "store",
    [
        lambda edge, stamp: edge.append("parent", stamp, x(stamp), ""),
        lambda edge, stamp: edge.push(stamp, x(stamp)),
        lambda edge, stamp: edge.push_many(np.array([stamp]), np.array([x(stamp)])),
    ],
    ids=["append", "push", "push many"],
)
def test_the_twin_has_no_more_samples_in_memory_than_the_window_and_a_sixteenth(store: Any) -> None:
    edge = history(_python_kernel, [(0, x(0.0))], keep=160)
    for stamps in (range(1, 1_000), range(-499, 0)):
        for stamp in stamps:
            store(edge, stamp)
            assert len(edge.stamps) == len(edge.records) // 64 <= 161 + 10
        edge.clear()
        edge.push(-500, x(0.0))


@on_both
@pytest.mark.parametrize(("count", "keep"), [(0, 5), (1, 5), (3, None), (40, 5), (200, None)])
def test_many_samples_are_stored_as_one_after_the_other(kernel: ModuleType, count: int, keep: int | None) -> None:
    for before in (0, 1, 9):
        poses = [(10 * k, x(float(k))) for k in range(before + count)]
        edge, expected = history(kernel, poses[:before], keep), history(kernel, poses, keep)
        held = edge.columns(0, before)
        edge.push_many(np.arange(10 * before, 10 * (before + count), 10), np.full((count, 7), IDENTITY))
        zeros = history(kernel, [(at, row if at < 10 * before else x(0.0)) for at, row in poses], keep)
        assert contents(edge) == contents(zeros)
        assert (edge.newest, edge.horizon) == (expected.newest, expected.horizon)
        assert held[5] == len(poses[:before]) if keep is None else held[5] <= before


@on_both
@pytest.mark.parametrize(
    ("stamps", "rows"),
    [
        ([5], 1),
        ([4], 1),
        ([6, 6], 2),
        ([7, 6], 2),
        ([6, 2**62, 8], 3),
        ([STAMP_MAX, STAMP_MIN], 2),
        ([6, 7], 1),
        ([6], 2),
        ([], 1),
    ],
)
def test_many_samples_that_do_not_follow_are_refused_whole(kernel: ModuleType, stamps: list[int], rows: int) -> None:
    edge = history(kernel, [(4, x(1.0)), (5, x(2.0))])
    with pytest.raises(ValueError, match=r"newer than all others|row of seven"):
        edge.push_many(np.array(stamps, np.int64), np.zeros((rows, 7)))
    assert contents(edge) == [(4, x(1.0)), (5, x(2.0))]


@on_both
def test_the_row_of_a_history_is_that_of_a_chain_of_it_alone(kernel: ModuleType) -> None:
    edge = history(kernel, [(0, x(1.0)), (10, x(2.0))], keep=10)
    chain = kernel.Chain((edge,), ())
    assert [edge.row(at) for at in (-1, 0, 4, 10, 11, 2**70)] == [None, x(1.0), x(1.4), x(2.0), None, None]
    assert bits(edge.row(3)) == bits(chain.row(3))
    edge.mixed = True
    assert edge.row(0) is None


@on_both
def test_the_copy_of_a_history_is_independent(kernel: ModuleType) -> None:
    edge, twin = history(kernel, [(10, x(1.0)), (20, x(2.0)), (90, x(9.0))], keep=75), history(kernel, keep=75)
    twin.take(edge)
    edge.put(0, 20, x(-1.0))
    edge.push(100, x(10.0))
    assert contents(twin) == [(20, x(2.0)), (90, x(9.0))]
    longer = history(kernel, keep=1_000)
    longer.take(edge)
    assert [longer.append("parent", stamp, x(1.0), "") for stamp in (100, 101)] == [False, True]
    twin.take(twin)
    twin.clear()
    assert (twin.count, contents(edge)) == (0, [(90, x(9.0)), (100, x(10.0))])


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

    def read(columns: Any) -> list[tuple[int, float]]:
        stamps_in, begin, rows_in, rows_begin, width, count = columns
        stamps = np.frombuffer(stamps_in, np.int64, count, begin)
        rows = np.frombuffer(rows_in, np.float64, count * width, rows_begin).reshape(count, width)
        return list(zip(stamps.tolist(), rows[:, -7].tolist(), strict=True))

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
@pytest.mark.parametrize(("first", "end"), [(0, 0), (2, 1), (3, 5)])
def test_columns_of_nothing_are_empty(kernel: ModuleType, first: int, end: int) -> None:
    assert history(kernel, [(1, x(1.0)), (2, x(2.0))]).columns(first, end)[-1] == 0


@on_both
def test_stamps_at_the_ends_of_64_bits_leave_no_window_early(kernel: ModuleType) -> None:
    edge = history(kernel, [(STAMP_MIN, x(1.0)), (STAMP_MIN + 5, x(2.0))], keep=10)
    assert edge.count == 2
    edge.push(STAMP_MAX, x(3.0))
    assert contents(edge) == [(STAMP_MAX, x(3.0))]


@pytest.mark.parametrize(
    ("asked", "copied"),
    [((100,), [100, 101]), ((0, 99), [100]), ((999, 500), [500, 501, 899]), ((899,), [899]), ((150,), [150, 151])],
)
def test_the_twin_copies_the_neighbours_in_the_window_where_samples_outnumber_stamps(
    asked: tuple[int, ...], copied: list[int]
) -> None:
    # The window's slack, a sixteenth, is fifty here: what has left the window is still in memory.
    edge = history(_python_kernel, keep=799)
    edge.push(60, x(60.0))
    for stamp in range(61, 900):
        edge.append("parent", stamp, x(stamp), "")
    assert (edge.oldest, edge.stamps[0]) == (100, 60)
    stamps, _, records, _, width, count = edge.columns(0, edge.count, np.array(asked))
    assert stamps.tolist() == copied
    rows = np.frombuffer(records, np.float64, width * count).reshape(count, width)[:, -7:]
    assert rows[:, 0].tolist() == copied
    edge.push(1_000, x(0.0))
    edge.clear()
    assert stamps.tolist() == copied


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
    return kernel.Chain(*sides)


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
@given(unit_vectors(), angles(), st.integers(0, 1_000), st.sampled_from([1.0, -1.0]), st.sampled_from([1.0, -1.0]))
def test_the_angle_of_an_interpolated_turn_is_linear_in_time_for_any_axis_angle_and_quaternion_signs(
    kernel: ModuleType, axis: Vector, angle: float, thousandths: int, first_sign: float, second_sign: float
) -> None:
    turned = Transform.from_axis_angle(axis, angle)
    first = Transform(rotation=(0.0, 0.0, 0.0, first_sign))
    second = Transform(rotation=[second_sign * part for part in turned.rotation])
    found = chain(kernel, [[(0, row_of(first)), (1_000, row_of(second))]], []).row(thousandths)
    expected = Transform.from_axis_angle(axis, angle * thousandths / 1_000)
    assert from_row(found).is_close(expected, rotation_tolerance=1e-9)


@on_both
@pytest.mark.parametrize("angle", [1e-7, 1e-4, 0.01, 0.02, 0.05, 0.1, 3.1, math.pi - 1e-7])
def test_the_angle_stays_linear_where_other_slerps_switch_to_linear_interpolation(
    kernel: ModuleType, angle: float
) -> None:
    turned = Transform.from_axis_angle((1.0, 2.0, 3.0), angle)
    path = chain(kernel, [[(0, IDENTITY), (100, row_of(turned))]], [])
    for percent in range(101):
        expected = Transform.from_axis_angle((1.0, 2.0, 3.0), angle * percent / 100)
        assert from_row(path.row(percent)).is_close(expected, rotation_tolerance=1e-9)


@on_both
def test_half_of_a_turn_whose_cosine_rounds_to_one_is_half_the_angle(kernel: ModuleType) -> None:
    turned = row_of(Transform.from_axis_angle((0.0, 0.0, 1.0), 2e-8))
    assert chain(kernel, [[(0, IDENTITY), (2, turned)]], []).row(1)[5] == pytest.approx(5e-9, rel=1e-9)


@on_both
def test_neighbouring_nanoseconds_of_today_have_different_rows(kernel: ModuleType) -> None:
    path = chain(kernel, [[(TODAY, x(0.0)), (TODAY + 3, x(3.0)), (TODAY + 4, x(10.0))]], [])
    assert [path.row(TODAY + late)[0] for late in range(5)] == [0.0, 1.0, 2.0, 3.0, 10.0]


@on_both
@pytest.mark.parametrize("at", [9, 21, 2**70, -(2**70)])
def test_there_is_no_row_one_nanosecond_outside_the_samples(kernel: ModuleType, at: int) -> None:
    path = chain(kernel, [[(10, x(1.0)), (20, x(2.0))], IDENTITY], [[(0, x(1.0)), (30, x(2.0))]])
    assert path.row(at) is None
    assert path.row(10) is not None
    assert path.row(20) is not None


@on_both
def test_there_is_no_row_outside_the_window_nor_in_a_mixed_or_empty_history(kernel: ModuleType) -> None:
    edge = history(kernel, [(stamp, x(stamp)) for stamp in range(166)], keep=160)
    path = kernel.Chain((edge,), ())
    assert (path.row(4), path.row(5)) == (None, x(5.0))
    # The samples that have left the window are still in memory here.
    slack = kernel.Chain((history(kernel, [(at, x(at)) for at in (0, 4, 10, 164)], keep=160),), ())
    assert [slack.row(at) for at in (0, 2, 3, 4, 7, 10)] == [None, None, None, x(4.0), x(7.0), x(10.0)]
    late = history(kernel, [(0, x(0.0)), (10, x(1.0))], keep=5)
    assert (kernel.Chain((late,), ()).row(9), kernel.Chain((late,), ()).row(10)) == (None, x(1.0))
    edge.mixed = True
    assert path.row(5) is None
    assert kernel.Chain((history(kernel),), ()).row(0) is None


@on_both
def test_a_chain_of_any_length_has_a_row(kernel: ModuleType) -> None:
    edges: list[Poses | Row] = [[(0, x(0.0)), (2, x(2.0))]] * 300
    assert chain(kernel, edges, edges[:100]).row(1)[0] == 200.0
    assert chain(kernel, [], []).row(5) == IDENTITY


@on_both
def test_the_latest_stamp_is_the_one_that_all_edges_have_reached(kernel: ModuleType) -> None:
    ahead, behind = [(0, x(0.0)), (9, x(0.0))], [(0, x(0.0)), (5, x(0.0))]
    assert chain(kernel, [ahead, IDENTITY], [behind]).latest() == 5
    assert chain(kernel, [ahead, []], [behind]).latest() is None
    assert chain(kernel, [IDENTITY], []).latest() is None


# Plain answers


def paths(kernel: Any, **chains: Any) -> Any:
    """Paths to 'map' from each source."""
    made = kernel.Paths(threading.Lock(), LATEST, sample_class(kernel))
    made.recent["map"] = chains
    return made


@on_both
def test_an_answer_has_target_source_stamp_and_the_row_of_the_chain(kernel: ModuleType) -> None:
    path = chain(kernel, [[(0, x(0.0)), (10, x(10.0))]], [])
    asked = paths(kernel, cart=path)
    for at, stamp in ((4, 4), (LATEST, 10)):
        found = asked.answer("map", "cart", at)
        assert type(found) is sample_class(kernel)
        assert found._fields == ("map", "cart", stamp, path.row(stamp), "", False)
        assert (found.parent, found.child, found.stamp, found.authority, found.static) == (
            "map",
            "cart",
            stamp,
            "",
            False,
        )
        assert found._row == path.row(stamp)


class Name(str):
    """A string that is not a plain one."""

    __slots__ = ()


@on_both
@pytest.mark.parametrize(
    ("target", "source", "at"),
    [
        ("map", "nobody", 5),
        ("nobody", "cart", 5),
        ("map", "cart", 11),
        ("map", "cart", 2**70),
        ("map", "cart", 5.0),
        ("map", "cart", True),
        ("map", "cart", None),
        ("map", "cart", np.int64(5)),
        ("map", "fixed", 5),
        ("map", "fixed", LATEST),
        ("map", "empty", LATEST),
        (7, "cart", 5),
    ],
)
def test_what_is_not_plain_is_handed_back(kernel: ModuleType, target: Any, source: Any, at: Any) -> None:
    cart = chain(kernel, [[(0, x(0.0)), (10, x(10.0))]], [])
    asked = paths(kernel, cart=cart, fixed=chain(kernel, [IDENTITY], []), empty=chain(kernel, [[]], []))
    assert asked.answer("map", "cart", 5) is not None
    assert asked.answer(target, source, at) is None


def unpacked(memory: bytes) -> tuple[list[bytes], list[int]]:
    """The bits of each row of an answer at many stamps, and the stamps."""
    count = len(memory) // 64
    columns = np.frombuffer(memory, np.float64, 7 * count).reshape(7, count)
    return [column.tobytes() for column in columns.T], np.frombuffer(memory, np.int64, count, 56 * count).tolist()


@needs_both
@pytest.mark.parametrize(
    "form", [list, tuple, np.array, lambda stamps: np.array(stamps * 2)[::2], lambda stamps: array("q", stamps)]
)
@pytest.mark.parametrize("stamps", [[4], [4, 4, 5, 0, 10, 7], [*range(11), *range(3)] * 2 + [9, 1]])
def test_answers_at_many_stamps_are_the_rows_of_the_chain(form: Any, stamps: list[int]) -> None:
    kernel = COMPILED
    turned = Transform.from_axis_angle((1.0, 2.0, 3.0), 0.3, (1.0, 2.0, 3.0))
    poses = [(0, x(0.0)), (3, row_of(turned)), (4, x(2.0)), (10, row_of(turned.inverse()))]
    for edges in ([[poses], []], [[poses, row_of(turned)], [poses[::3]]], [[], [poses]], [[row_of(turned)], []]):
        path = chain(kernel, *edges)
        rows, kept = unpacked(paths(kernel, cart=path).answer_many("map", "cart", form(stamps)))
        asked = form(stamps).tolist() if hasattr(form(stamps), "tolist") else stamps
        assert kept == asked
        assert rows == [bits(path.row(at)) for at in asked]


@needs_both
@pytest.mark.parametrize("count", [1, 20])
@pytest.mark.parametrize(
    ("target", "source", "stamp"),
    [("map", "nobody", 5), ("nobody", "cart", 5), ("map", "cart", 11), ("map", "cart", -1), ("map", "empty", 5)],
)
def test_many_stamps_of_which_one_is_not_plain_are_handed_back(
    target: str, source: str, stamp: int, count: int
) -> None:
    kernel = COMPILED
    asked = paths(kernel, cart=chain(kernel, [[(0, x(0.0)), (10, x(10.0))]], []), empty=chain(kernel, [[]], []))
    for stamps in ([*[5] * count, stamp], [stamp, *[5] * count]):
        assert asked.answer_many(target, source, stamps) is None
        assert asked.answer_many(target, source, np.array(stamps)) is None
    assert asked.answer_many("map", "cart", []) is None
    far = paths(kernel, cart=chain(kernel, [[(0, x(0.0)), (2**60, x(1.0))]], []))
    assert far.answer_many("map", "cart", [2**59]) is None
    assert far.answer_many("map", "cart", [0, 2**60]) is not None


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
    fields = {"parent": "parent", "authority": "", "static": False, **other}
    made._fields = fields["parent"], child, stamp, x(metres), fields["authority"], fields["static"]
    return made


@on_both
def test_a_commit_stores_samples_up_to_the_first_that_is_not_plain(kernel: ModuleType) -> None:
    frames = {name: history(kernel, [(0, x(0.0))], keep=50) for name in "abc"}
    batch = (
        sample(kernel, "a", 10, 1.0),
        sample(kernel, "b", 10, 2.0),
        sample(kernel, "a", 60, 3.0),
        sample(kernel, "c", 10, 4.0, parent="other"),
        sample(kernel, "b", 20, 5.0),
        sample(kernel, "new", 20),
        sample(kernel, "b", 30, static=True),
    )
    assert kernel.commit(frames, batch, 0) == 3
    assert [contents(edge) for edge in frames.values()] == [
        [(10, x(1.0)), (60, x(3.0))],
        [(0, x(0.0)), (10, x(2.0))],
        [(0, x(0.0))],
    ]
    assert kernel.commit(frames, batch, 4) == 5
    assert kernel.commit(frames, batch, 6) == 6
    assert kernel.commit(frames, batch, 7) == 7
    assert kernel.commit(frames, (), 0) == 0
    assert contents(frames["b"])[-1] == (20, x(5.0))


@on_both
def test_a_commit_takes_a_batch_of_any_size(kernel: ModuleType) -> None:
    frames = {f"f{i}": history(kernel, [(0, x(0.0))]) for i in range(20)}
    batch = tuple(sample(kernel, f"f{i % 20}", 1 + i, i) for i in range(1_000))
    assert kernel.commit(frames, batch, 0) == 1_000
    assert [edge.count for edge in frames.values()] == [51] * 20


@needs_both
@pytest.mark.parametrize("without_lock", [False, True])
def test_out_of_memory_in_a_commit_leaves_every_history_as_it_was(without_lock: bool) -> None:
    nomemory = pytest.importorskip("_testcapi")
    assert COMPILED is not None
    whole = answers_of(COMPILED, threading.Lock()) if without_lock else None
    failures = 0
    for allowed in range(40):
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
    assert 0 < failures < 40


def answers_of(kernel: Any, lock: Any) -> Any:
    return kernel.Paths(lock, LATEST, sample_class(kernel))


@on_both
@pytest.mark.parametrize(
    ("frames", "batch", "readers", "stored"),
    [
        ("a", [("a", 1)], {}, True),
        ("a", [("a", 0)], {}, False),
        ("a", [("b", 1)], {}, False),
        ("a", [("a", 1)], {1: set()}, False),
        ("ab", [("a", 1), ("b", 1), ("a", 1)], {}, False),
        ("ab", [("a", 1), ("c", 1)], {}, False),
    ],
)
def test_a_batch_is_committed_without_the_lock_if_it_is_plain_as_a_whole(
    kernel: ModuleType, frames: str, batch: list[tuple[str, int]], readers: dict[int, Any], stored: bool
) -> None:
    paths = answers_of(kernel, threading.Lock())
    histories = {name: history(kernel, [(0, x(0.0))]) for name in frames}
    samples = tuple(sample(kernel, child, stamp) for child, stamp in batch)
    assert paths.commit(histories, readers, samples) is stored
    assert [edge.count for edge in histories.values()] == [1 + stored] * len(frames)
    assert (paths.inserted, paths.version) == (stored, stored)


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


# Samples


@on_both
def test_a_sample_without_fields_has_none(kernel: ModuleType) -> None:
    empty = sample_class(kernel)()
    for name in ("_fields", "_row", "_square", "parent", "child", "stamp", "authority", "static"):
        with pytest.raises(AttributeError):
            getattr(empty, name)


@on_both
def test_the_fields_of_a_sample_can_be_set_again_and_read_twice(kernel: ModuleType) -> None:
    made = sample(kernel, "a", STAMP_MIN, -0.0, static=True)
    assert made._fields == made._fields == ("parent", "a", STAMP_MIN, x(-0.0), "", True)
    assert bits(made._row) == bits(x(-0.0))
    made._fields = "q", "b", STAMP_MAX, x(2.0), "me", False
    assert (made.parent, made.child, made.stamp, made.authority, made.static) == ("q", "b", STAMP_MAX, "me", False)
    assert (made._row, made._square) == (x(2.0), 4.0)
    for name in ("parent", "child", "stamp", "authority", "static"):
        with pytest.raises(AttributeError):
            setattr(made, name, None)


@needs_both
@pytest.mark.parametrize(
    ("fields", "error"),
    [
        (None, TypeError),
        ((1, 2), TypeError),
        ((1, "b", 0, x(0.0), "", False), TypeError),
        (("a", "b", 0.5, x(0.0), "", False), TypeError),
        (("a", "b", 2**63, x(0.0), "", False), OverflowError),
        (("a", "b", 0, x(0.0)[:6], "", False), TypeError),
        (("a", "b", 0, ("x",) * 7, "", False), TypeError),
        (("a", "b", 0, x(0.0), None, False), TypeError),
    ],
)
def test_a_compiled_sample_refuses_other_fields_and_keeps_its_own(fields: Any, error: type[Exception]) -> None:
    made = sample(COMPILED, "a", 1, 2.0)
    with pytest.raises(error):
        made._fields = fields
    assert made._fields == ("parent", "a", 1, x(2.0), "", False)


# Memory


@on_both
def test_the_garbage_collector_finds_a_cycle_through_paths_and_chains(kernel: ModuleType) -> None:
    class Edge(kernel.History):  # type: ignore[name-defined, misc]
        pass

    edge = Edge("parent", None)
    edge.paths = paths(kernel, cart=kernel.Chain((edge,), ()))
    gone = weakref.ref(edge)
    del edge
    gc.collect()
    assert gone() is None


@needs_both
def test_wrong_arguments_raise_and_never_crash() -> None:
    kernel: Any = COMPILED
    edge = history(kernel, [(0, x(0.0))])
    path = kernel.Chain((edge,), ())
    for call in (
        lambda: kernel.History(),
        lambda: kernel.History(5, None),
        lambda: kernel.History("a", 0.5),
        lambda: kernel.History("a", keep=None),
        lambda: edge.append("parent", 1),
        lambda: edge.append("parent", "1", x(0.0), ""),
        lambda: edge.append("parent", 1, [0.0] * 7, ""),
        lambda: edge.push(0, x(0.0)),
        lambda: edge.push(1),
        lambda: edge.put(5, 1, x(0.0)),
        lambda: edge.put(-1, 1, x(0.0)),
        lambda: edge.find(0.5),
        lambda: edge.between(0),
        lambda: edge.between(0, 0.5),
        lambda: edge.sample(1),
        lambda: edge.take(5),
        lambda: edge.columns(0),
        lambda: setattr(edge, "parent", 5),
        lambda: delattr(edge, "authority"),
        lambda: kernel.Chain((), 5),
        lambda: kernel.Chain((5,), ()),
        lambda: path.row("x"),
        lambda: path.hold().rows(np.zeros(2, np.int64), np.zeros(13)),
        lambda: path.hold().rows(np.zeros(2, np.int64), bytes(112)),
        lambda: path.hold().rows(5, 6),
        lambda: path.hold().rows(np.zeros(2, np.int64)),
        lambda: kernel.Held(),
        lambda: kernel.compose_paths(np.zeros((2, 7)), np.zeros(3, np.int64)),
        lambda: kernel.compose_paths(np.zeros((2, 7)), np.array([0, 1])),
        lambda: kernel.compose_paths(np.zeros((2, 7)), np.array([1, 0])),
        lambda: kernel.compose_paths(np.zeros((2, 7)), np.array([0, -1])),
        lambda: kernel.Paths(5, LATEST, kernel.Sample),
        lambda: kernel.Paths(threading.Lock(), LATEST, int),
        lambda: path.__init__((), ()),
        lambda: paths(kernel).answer("map"),
        lambda: paths(kernel).answer_many("map", "cart"),
        lambda: setattr(paths(kernel), "recent", []),
        lambda: kernel.commit({}, [], 0),
        lambda: kernel.commit({}, (), "0"),
        lambda: kernel.Block(),
    ):
        with pytest.raises((TypeError, ValueError, IndexError, AttributeError, BufferError, RuntimeError)):
            call()
    assert contents(edge) == [(0, x(0.0))]
    for kind in (kernel.History, kernel.Chain, kernel.Paths):
        with pytest.raises(TypeError):
            copy.copy(kind.__new__(kind))
    assert kernel.commit({"a": 5}, (sample(kernel, "a", 1),), 0) == 0
    assert kernel.commit({}, (5,), 0) == 0
    assert kernel.Paths.__new__(kernel.Paths).answer("map", "cart", 0) is None
    assert kernel.Paths.__new__(kernel.Paths).answer_many("map", "cart", [0]) is None
    assert kernel.Chain.__new__(kernel.Chain).row(0) == IDENTITY

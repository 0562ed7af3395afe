"""Samples from arrays: `publish_columns`, `insert_columns` and `send_columns` do what samples one by one would do."""

import logging
from typing import Any

import anyio
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from tfbus import (
    Buffer,
    Bus,
    BusClosedError,
    InvalidTransformError,
    Outcome,
    SimulatedClock,
    Transform,
    TransformBroadcaster,
    TransformStamped,
    TransformTree,
)

Rows = list[tuple[str, str, int, Transform]]
STILL = (0.0, 0.0, 0.0, 1.0)

POSES = [Transform.from_axis_angle((1.0, 2.0, 3.0), angle, (angle, -1.0, 0.0)) for angle in (0.0, 1e-9, 0.5, 3.0, -2.0)]
poses = st.sampled_from(POSES)
stamps = st.integers(0, 40)
one_frame = st.lists(st.tuples(st.just("map"), st.just("a"), stamps, poses), min_size=1, max_size=6)
many_frames = st.lists(st.tuples(st.sampled_from("xyz"), st.sampled_from("abc"), stamps, poses), max_size=6)
batches = st.lists(st.tuples(one_frame | many_frames, st.booleans(), st.sampled_from(["", "driver"])), max_size=5)


def columns_of(rows: Rows) -> dict[str, Any]:
    """The columns by their names; a name or a stamp that all rows share stands once."""
    parents, children, stamps, moves = ([*column] for column in zip(*rows, strict=True)) if rows else ([], [], [], [])
    shared = [column[0] if len(set(column)) == 1 else column for column in (parents, children, stamps)]
    return {
        **dict(zip(("parents", "children", "stamps"), shared, strict=True)),
        "translations": np.array([move.translation for move in moves]).reshape(-1, 3),
        "rotations": np.array([move.rotation for move in moves]).reshape(-1, 4),
    }


def objects_of(rows: Rows, authority: str, static: bool) -> list[TransformStamped]:
    return [TransformStamped(*row, authority, static) for row in rows]


def assert_same(*trees: TransformTree) -> None:
    """The same samples to the last bit."""
    one, other = (
        [[part.tobytes() if isinstance(part, np.ndarray) else part for part in frame] for frame in state["frames"]]
        for state in (tree.__getstate__() for tree in trees)
    )
    assert one == other


@given(batches, st.sampled_from([None, 20e-9]))
def test_columns_in_a_tree_are_the_samples_in_a_batch(drawn: Any, keep: float | None) -> None:
    by_columns, by_objects = TransformTree(keep), TransformTree(keep)
    for rows, static, authority in drawn:
        outcomes = by_columns.insert_columns(**columns_of(rows), authority=authority, static=static)
        assert outcomes == by_objects.insert_many(objects_of(rows, authority, static))
    assert_same(by_columns, by_objects)


@pytest.mark.parametrize("listener", ["nobody", "subscriber", "events", "watch"])
@given(drawn=batches)
@example(drawn=[([("map", "a", stamp, Transform()) for stamp in (1, 2)], False, "")] * 2)
def test_columns_on_a_bus_are_the_samples_in_a_batch(listener: str, drawn: Any) -> None:
    got: list[list[Any]] = []
    trees, counters = [], []
    for publish_columns in (False, True):
        with Bus(SimulatedClock(), max_ahead=None) as bus, Buffer(bus, keep=20e-9) as buffer:
            batches: list[Any] = []
            got.append(batches)
            if listener == "subscriber":
                bus.subscribe(batches.append)
            elif listener == "events":
                events = bus.events()
            elif listener == "watch":
                buffer.watch("map", "a")
            for rows, static, authority in drawn:
                if publish_columns:
                    bus.publish_columns(**columns_of(rows), authority=authority, static=static)
                else:
                    bus.publish(objects_of(rows, authority, static))
            if listener == "events":
                batches += iter(events.queue.get, None)
            trees.append(buffer.tree)
            statistics = bus.statistics()
            counters.append((statistics.samples, statistics.reparented, statistics.kind_changes, statistics.buffers))
    assert_same(*trees)
    assert got[0] == got[1]
    assert counters[0] == counters[1]


FAULTS = [
    ("row 2: translation", "not finite", {"translations": (2, [0.0, np.nan, 0.0])}),
    (
        "row 2: the translation of 'a' in 'map' is 2e\\+12 m long",
        "not physical",
        {"translations": (2, [2e12, 0.0, 0.0])},
    ),
    ("row 1: rotation is the zero quaternion", "zero quaternion", {"rotations": (1, [0.0] * 4)}),
    ("row 1: rotation .* not a unit quaternion", "not a unit quaternion", {"rotations": (1, [0.0, 0.0, 0.0, 1.02])}),
    ("row 0: rotation", "not finite", {"rotations": (0, [np.inf, 0.0, 0.0, 1.0])}),
    ("row 1: a frame name must not be empty", "frame name", {"children": ["a", "", "a"]}),
    ("row 1: a frame name must not start", "frame name", {"parents": ["map", "/map", "map"]}),
    ("row 2: frame 'a' cannot be its own parent", "self transform", {"parents": ["map", "map", "a"]}),
]


def three_rows(changes: dict[str, Any]) -> dict[str, Any]:
    """The columns of three rows, each 1 m further; `changes` replace a column, or one row of it."""
    columns: dict[str, Any] = {
        "parents": "map",
        "children": "a",
        "stamps": [1, 2, 3],
        "translations": np.array([[float(i), 0.0, 0.0] for i in range(3)]),
        "rotations": np.array([STILL] * 3),
    }
    for name, change in changes.items():
        if isinstance(change, tuple):
            columns[name][change[0]] = change[1]
        else:
            columns[name] = change
    return columns


@pytest.mark.parametrize(("message", "reason", "fault"), FAULTS, ids=[reason for _, reason, _ in FAULTS])
@pytest.mark.parametrize("known", [False, True])
def test_a_bad_row_is_named_and_nothing_is_stored_or_only_it_is_dropped(
    message: str, reason: str, fault: dict[str, Any], known: bool, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    columns = three_rows(fault)
    tree = TransformTree(keep=None)
    with Bus(SimulatedClock(), max_ahead=None) as bus, Buffer(bus, keep=None) as buffer:
        if known:
            bus.publish(TransformStamped("map", "a", 0, Transform()))
            tree.insert(TransformStamped("map", "a", 0, Transform()))
        for store in (bus.publish_columns, tree.insert_columns):
            with pytest.raises(InvalidTransformError, match=message) as caught:
                store(**columns)
            assert caught.value.reason == reason
        assert buffer.tree.inserted == tree.inserted == known
        bus.publish_columns(**columns, invalid="drop")
        assert buffer.tree.inserted == 2 + known
        assert bus.statistics().rejected == {reason: 1}
    assert len(caplog.records) == 1


def test_a_refusal_of_the_bus_stores_nothing_of_the_columns(bus: Bus, buffer: Buffer) -> None:
    with pytest.raises(InvalidTransformError, match="loop"):
        bus.publish_columns(["a", "b"], ["b", "a"], 0, np.zeros((2, 3)), [STILL] * 2)
    assert buffer.tree.frames() == []
    with pytest.raises(ValueError, match="invalid must be"):
        bus.publish_columns("map", "a", 0, np.zeros((1, 3)), [STILL], invalid="ignore")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("change", "kind", "message"),
    [
        ({"translations": np.zeros((3, 2))}, InvalidTransformError, "shapes"),
        ({"rotations": np.zeros((2, 4))}, InvalidTransformError, "shapes"),
        ({"stamps": [1, 2]}, ValueError, "stamps must be one stamp, or one for each of 3 rows, got 2"),
        ({"stamps": [1.0, 2.0, 3.0]}, TypeError, "from_seconds"),
        ({"children": ["a"]}, ValueError, "children must be one name, or one for each of 3 rows, got 1"),
        ({"parents": ["map", 5, "map"]}, TypeError, "must be a str"),
        ({"authority": None}, TypeError, "authority"),
        ({"translations": np.ma.masked_less(np.zeros((3, 3)), 1.0)}, ValueError, "masked"),
    ],
)
def test_columns_that_do_not_fit_together_are_refused(change: Any, kind: type[Exception], message: str) -> None:
    tree = TransformTree()
    with pytest.raises(kind, match=message):
        tree.insert_columns(**three_rows(change))
    assert tree.frames() == []


@pytest.mark.parametrize("dtype", [np.float32, np.int64, list])
def test_columns_may_have_any_numbers_names_and_dates(dtype: Any) -> None:
    still: Any = [[0, 0, 0, 1]] * 2
    moves: Any = [[1, 2, 3], [4, 5, 6]]
    if dtype is not list:
        still, moves = np.array(still, dtype), np.asfortranarray(np.array(moves, dtype))
    stamps = np.array([1, 2], "datetime64[ns]")
    tree = TransformTree()
    assert tree.insert_columns("map", np.array(["a", "b"]), stamps, moves, still) == [Outcome.INSERTED] * 2
    assert tree.lookup("map", "b", 2).transform == Transform((4.0, 5.0, 6.0))


def test_rotations_are_normalised_as_those_of_a_transform() -> None:
    rotation = (0.1, 0.2, 0.3, 0.93)
    tree = TransformTree()
    tree.insert_columns("map", "a", 0, [[0.0, 0.0, 0.0]], [rotation])
    assert tree.lookup("map", "a").transform == Transform(rotation=rotation)


def test_later_changes_of_the_arrays_change_no_sample() -> None:
    columns = three_rows({"stamps": np.array([1, 2, 3])})
    tree = TransformTree(keep=None)
    tree.insert_columns(**columns)
    columns["stamps"][:] = 0
    columns["translations"][:] = 7.0
    assert tree.lookup("map", "a", 2).transform.translation == (1.0, 0.0, 0.0)


def test_a_broadcaster_sends_columns_under_its_names(bus: Bus, buffer: Buffer) -> None:
    robot = TransformBroadcaster(bus, "driver", prefix="r/", shared={"map"}, invalid="drop")
    robot.send_columns("map", ["a", "b"], [[1.0, 0.0, 0.0], [np.nan, 0.0, 0.0]], [STILL] * 2)
    robot.send_columns("map", "a", [[2.0, 0.0, 0.0]], [STILL], at=[5])
    assert buffer.tree.frames() == ["map", "r/a"]
    assert [edge.authority for edge in buffer.tree.edges()] == ["driver"]
    assert buffer.lookup_nowait("map", "r/a", 5).transform.translation == (2.0, 0.0, 0.0)


@pytest.mark.anyio
async def test_columns_wake_the_lookups_that_waited_for_a_row(bus: Bus, buffer: Buffer) -> None:
    found: list[TransformStamped] = []
    bus.publish_columns("map", ["a", "b"], 0, np.zeros((2, 3)), [STILL] * 2)

    async def wait_for(frame: str, stamp: int) -> None:
        found.append(await buffer.lookup("map", frame, stamp))

    async with anyio.create_task_group() as tasks:
        for frame, stamp in (("a", 2), ("a", 3), ("b", 2), ("c", 1)):
            tasks.start_soon(wait_for, frame, stamp)
        await anyio.wait_all_tasks_blocked()
        bus.publish_columns(**three_rows({}))
        await anyio.wait_all_tasks_blocked()
        assert sorted((answer.stamp, answer.transform.translation[0]) for answer in found) == [(2, 1.0), (3, 2.0)]
        bus.publish_columns("map", ["b", "c"], [2, 1], np.ones((2, 3)), [STILL] * 2)
    assert {(answer.child, answer.stamp) for answer in found[2:]} == {("b", 2), ("c", 1)}


def test_a_closed_bus_and_a_tree_of_a_bus_take_no_columns() -> None:
    with Bus() as bus, Buffer(bus) as buffer, pytest.raises(RuntimeError, match="publish_columns"):
        buffer.tree.insert_columns(**three_rows({}))
    with pytest.raises(BusClosedError):
        bus.publish_columns(**three_rows({}))

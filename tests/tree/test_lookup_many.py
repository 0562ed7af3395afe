"""Many lookups in one call, compared with single lookups."""

import math
import struct
import sys
from array import array
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import count, cycle, islice
from types import FrameType
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.asking import threads_that
from support.samples import moving, over, static, tree_of
from support.strategies import TODAY, transforms

import tfbus
from tfbus import (
    LATEST,
    SECOND,
    DisconnectedError,
    FutureExtrapolationError,
    Latest,
    PointCloud,
    Transform,
    TransformArray,
    TransformLookupError,
    TransformStamped,
    TransformTree,
    UnknownFrameError,
)
from tfbus.stamps import STAMP_MAX, STAMP_MIN
from tfbus.tree.lookup_many import OutOfRange

FRAMES = "rsabcdef"
ROOTS = 2
METRES = 10.0


def repeated(stamps: Sequence[int]) -> list[int]:
    """The stamps, repeated until there are too many for single lookups."""
    return list(islice(cycle(stamps), max(41, len(stamps))))


def facts(error: TransformLookupError) -> dict[str, object]:
    """The class, the message without the index, and all attributes."""
    attributes = {name: value for name, value in vars(error).items() if name != "index" and not name.startswith("_")}
    index = "" if error.index is None else f"stamps[{error.index}]: "
    return {**attributes, "class": type(error), "message": str(error).removeprefix(index)}


Expected = Sequence[Transform | TransformLookupError]


def answers(tree: TransformTree, target: str, source: str, stamps: Iterable[int], **question: Any) -> Expected:
    """The result of a single lookup for each stamp; `source_at` has one stamp for each."""
    found: list[Transform | TransformLookupError] = []
    for number, at in enumerate(stamps):
        arguments = {name: value[number] if name == "source_at" else value for name, value in question.items()}
        try:
            found.append(tree.lookup(target, source, at, **arguments).transform)
        except TransformLookupError as error:
            found.append(error)
    return found


def is_disconnected(expected: Expected) -> bool:
    return all(isinstance(one, DisconnectedError) for one in expected)


def assert_same(found: TransformArray, expected: Expected) -> None:
    """Assert NaN for each expected error, and otherwise equality to 1e-12 of the size of the numbers."""
    assert found.valid.tolist() == [isinstance(one, Transform) for one in expected]
    assert np.isnan(found.translations).all(axis=1).tolist() == (~found.valid).tolist()
    assert np.isnan(found.rotations).all(axis=1).tolist() == (~found.valid).tolist()
    rows = [(*one.translation, *one.rotation) for one in expected if isinstance(one, Transform)]
    columns = np.hstack((found.translations, found.rotations))[found.valid]
    np.testing.assert_allclose(columns, np.reshape(rows, (-1, 7)), rtol=0, atol=1e-12 * METRES)


def compare(lookup_many: Callable[..., TransformArray], expected: Expected, disconnected: bool) -> None:
    """Assert the expected answers, or the first error, and the answers in NaN mode unless there is no path at all."""
    errors = [(index, one) for index, one in enumerate(expected) if isinstance(one, TransformLookupError)]
    if errors:
        with pytest.raises(TransformLookupError) as caught:
            lookup_many()
        assert (caught.value.index, facts(caught.value)) == (errors[0][0], facts(errors[0][1]))
    else:
        assert_same(lookup_many(), expected)
    if disconnected:
        with pytest.raises(DisconnectedError) as caught:
            lookup_many(out_of_range="nan")
        assert caught.value.index == 0
    else:
        assert_same(lookup_many(out_of_range="nan"), expected)


# Random trees


@st.composite
def scenes(draw: st.DrawFn) -> tuple[TransformTree, st.SearchStrategy[int]]:
    """A tree with one root or two, and a strategy for the stamps to look up.

    A frame is static, or moves on one parent, or on several in turn, with its samples in any order. All its parents
    come before it in the alphabet of `FRAMES`, so that there are no loops.
    """
    first, step = draw(
        st.sampled_from([(0, 1), (-20, 10), (TODAY, SECOND // 10), (STAMP_MIN, 2**59), (STAMP_MAX, -(2**58) + 1)])
    )
    roots = draw(st.integers(1, ROOTS))
    tree = TransformTree(draw(st.sampled_from([None, None, min(abs(step) * 6e-9, 1e8)])))
    pose = transforms(METRES / len(FRAMES))
    for number in range(ROOTS, ROOTS + draw(st.integers(1, len(FRAMES) - ROOTS))):
        child, above = FRAMES[number], st.sampled_from(FRAMES[:roots] + FRAMES[ROOTS:number])
        parents = draw(st.lists(above, min_size=1, max_size=draw(st.sampled_from([1, 1, 1, 2]))))
        if draw(st.integers(0, 3)) == 0:
            tree.insert(TransformStamped(parents[0], child, 0, draw(pose), static=True))
            continue
        begin, end = draw(st.sampled_from([(0, 10), (0, 10), (0, 0), (2, 10), (0, 8)]))
        ticks = draw(st.lists(st.integers(begin, end), min_size=1, max_size=8, unique=True))
        for tick in {begin: None, end: None, **dict.fromkeys(ticks)}:
            parent = parents[tick * len(parents) // 11]
            tree.insert(TransformStamped(parent, child, first + step * tick, draw(pose)))
    ends = [stamp for edge in tree.edges() for stamp in (edge.oldest, edge.newest) if stamp is not None]
    near = sorted(ends) or [first]
    low, high = max(near[0] - 1, STAMP_MIN), min(near[-1] + 1, STAMP_MAX)
    interesting = st.sampled_from(near) | st.integers(0, 10).map(lambda tick: first + step * tick)
    beside = st.tuples(interesting, st.sampled_from([-1, 1])).map(
        lambda pair: min(max(sum(pair), STAMP_MIN), STAMP_MAX)
    )
    return tree, st.integers(low, high) | interesting | beside


@given(scenes(), st.data())
def test_many_lookups_equal_single_lookups(
    scene: tuple[TransformTree, st.SearchStrategy[int]], data: st.DataObject
) -> None:
    tree, interesting = scene
    stamps = data.draw(st.lists(interesting, min_size=1, max_size=12))
    names = st.sampled_from(tree.frames())
    for ends in data.draw(st.lists(st.tuples(names, names), min_size=1, max_size=3)):
        for asked in (stamps, repeated(stamps)):
            expected = answers(tree, *ends, asked)
            compare(partial(tree.lookup_many, *ends, asked), expected, is_disconnected(expected))


@given(scenes(), st.data())
def test_many_time_travels_equal_single_time_travels(
    scene: tuple[TransformTree, st.SearchStrategy[int]], data: st.DataObject
) -> None:
    tree, interesting = scene
    names = st.sampled_from(tree.frames())
    target, source, fixed = data.draw(st.tuples(names, names, names))
    pairs = data.draw(st.lists(st.tuples(interesting, interesting), min_size=1, max_size=12))
    stamps, then = (list(one) for one in zip(*pairs, strict=True))
    for asked, source_at in ((stamps, then), (repeated(stamps), repeated(then))):
        travel: dict[str, Any] = {"source_at": source_at, "fixed": fixed}
        legs = answers(tree, target, fixed, asked), answers(tree, fixed, source, source_at)
        expected = answers(tree, target, source, asked, **travel)
        compare(partial(tree.lookup_many, target, source, asked, **travel), expected, any(map(is_disconnected, legs)))


@pytest.mark.parametrize("asked", [40, 41, 200, 5_000])
def test_fewer_stamps_than_samples_and_more_than_one_block_of_stamps_equal_single_lookups(asked: int) -> None:
    rng = np.random.default_rng(asked)

    def pose() -> Transform:
        rotation = rng.normal(size=4)
        return Transform(rng.normal(size=3), rotation / np.linalg.norm(rotation))

    tree = tree_of(*(TransformStamped("root", child, 0, pose(), static=True) for child in "pq"))
    for parent, child in ("pa", "ab", "qc"):
        for stamp in rng.choice(SECOND, 300, replace=False).tolist():
            current = "q" if child == "a" and stamp > SECOND // 2 else parent
            tree.insert(TransformStamped(current, child, stamp, pose()))
    stamps = rng.integers(SECOND // 10, SECOND - SECOND // 10, asked)
    for target, source in (("root", "b"), ("c", "b"), ("b", "c")):
        expected = [tree.lookup(target, source, at).transform for at in stamps.tolist()]
        assert_same(tree.lookup_many(target, source, stamps), expected)


# Chosen cases, each with few stamps and with many

few_and_many = pytest.mark.parametrize("asked", [list, repeated], ids=["few", "many"])
Asked = Callable[[Sequence[int]], list[int]]


def xs(found: TransformArray) -> list[float]:
    return [float(x) for x in found.translations[:, 0]]


# Time travel


@few_and_many
def test_source_at_is_one_stamp_for_each_answer_or_one_for_all(asked: Asked) -> None:
    tree = tree_of(*over("map", "cart", [0, 10]))
    stamps, then = asked([8, 2, 10]), asked([3, 9, 0])
    found = tree.lookup_many("cart", "cart", stamps, source_at=then, fixed="map")
    assert xs(found)[:3] == pytest.approx([-5.0, 7.0, -10.0])
    found = tree.lookup_many("cart", "cart", stamps, source_at=4, fixed="map")
    assert xs(found)[:3] == pytest.approx([-4.0, 2.0, -6.0])


# Arguments


@pytest.mark.parametrize("times", [1, 40])
@pytest.mark.parametrize(
    "made",
    [
        list,
        tuple,
        np.array,
        lambda stamps: np.array(stamps, np.uint8),
        lambda stamps: np.array(stamps, np.uint64),
        lambda stamps: np.array(stamps, ">i8"),
        lambda stamps: np.array(stamps, object),
        lambda stamps: np.repeat(stamps, 2)[::2],
        lambda stamps: array("q", stamps),
        lambda stamps: [np.int32(stamp) for stamp in stamps],
    ],
)
def test_integers_of_any_type_are_stamps_and_are_not_modified(made: Callable[[list[int]], Any], times: int) -> None:
    tree = tree_of(*over("a", "b", [0, 10]))
    stamps = made([7, 3, 10] * times)
    if isinstance(stamps, np.ndarray):
        stamps.flags.writeable = False
    expected = [7.0, 3.0, 10.0] * times
    assert tree.lookup_many("a", "b", stamps).translations[:, 0].tolist() == pytest.approx(expected)
    found = tree.lookup_many("a", "b", [99] * len(expected), source_at=stamps, fixed="a")
    assert found.translations[:, 0].tolist() == pytest.approx(expected)
    assert list(stamps) == [7, 3, 10] * times


@pytest.mark.parametrize("stamps", [[], (), np.array([], np.int64), np.array([])])
def test_an_empty_list_of_stamps_gives_no_transforms(stamps: Any) -> None:
    tree = tree_of(*over("a", "b", [0, 10]))
    for source in "ab":
        assert len(tree.lookup_many("a", source, stamps)) == 0
        assert len(tree.lookup_many("a", source, stamps, source_at=stamps, fixed="a")) == 0
        assert len(tree.lookup_many("a", source, stamps, source_at=5, fixed="a", out_of_range="nan")) == 0


@pytest.mark.parametrize("stamps", [[], [5], [5] * 100])
@pytest.mark.parametrize("names", [("nobody", "b", "a"), ("a", "nobody", "b"), ("a", "b", "nobody")])
@pytest.mark.parametrize("out_of_range", ["raise", "nan"])
def test_an_unknown_frame_is_an_error_even_without_stamps(
    stamps: list[int], names: tuple[str, str, str], out_of_range: OutOfRange
) -> None:
    tree = tree_of(*over("a", "b", [0, 10]))
    target, source, fixed = names
    with pytest.raises(UnknownFrameError) as caught:
        tree.lookup_many(target, source, stamps, source_at=stamps, fixed=fixed, out_of_range=out_of_range)
    assert (caught.value.frame, caught.value.index) == ("nobody", None)
    if "nobody" in (target, source):
        with pytest.raises(UnknownFrameError):
            tree.lookup_many(target, source, stamps, out_of_range=out_of_range)


@pytest.mark.parametrize("bad", [1.5, True, None, LATEST, "5", np.float64(5.0), np.True_])
@pytest.mark.parametrize("others", [[], [5], [5] * 100])
def test_a_stamp_that_is_no_integer_is_a_type_error_at_any_index(bad: Any, others: list[int]) -> None:
    tree = tree_of(*over("a", "b", [0, 10]), static("a", "c"))
    for stamps in ([bad, *others], [*others, bad], np.array([bad, bad])):
        for source in "bc":
            with pytest.raises(TypeError, match="a stamp is an int"):
                tree.lookup_many("a", source, stamps)
            with pytest.raises(TypeError, match="a stamp is an int"):
                tree.lookup_many("a", source, [5] * len(stamps), source_at=stamps, fixed="a")
    if bad is not None:
        with pytest.raises(TypeError, match="a stamp is an int"):
            tree.lookup_many("a", "b", [5], source_at=bad, fixed="a")


@pytest.mark.parametrize(
    ("stamps", "question", "error", "text"),
    [
        *((stamps, {}, ValueError, "shape") for stamps in (5, [[5]], np.zeros((2, 2), int), np.zeros((0, 3), int))),
        *(
            ([5, 5], {"source_at": source_at, "fixed": "a"}, ValueError, "shape")
            for source_at in ([], [5], [5] * 3, [[5, 5]])
        ),
        *(
            (stamps, {}, ValueError, "64-bit")
            for stamps in ([2**63], [-1, 2**63], [-(2**63) - 1], np.array([2**63], np.uint64))
        ),
        *((stamps, {"out_of_range": "drop"}, ValueError, "'drop'") for stamps in ([], [5], [5] * 100)),
        *(
            ([5], question, TypeError, "source_at and fixed go together")
            for question in ({"source_at": [5]}, {"source_at": 5}, {"fixed": "a"})
        ),
    ],
)
@pytest.mark.parametrize("source", ["b", "c"])
def test_a_wrong_argument_is_an_error_that_says_what_is_right(
    source: str, stamps: Any, question: dict[str, Any], error: type[Exception], text: str
) -> None:
    tree = tree_of(moving("a", "b", 5), static("a", "c"))
    # The second time the path is known, and a question with right arguments has a plain answer.
    for _ in range(2):
        with pytest.raises(error, match=text):
            tree.lookup_many("a", source, stamps, **question)
        assert len(tree.lookup_many("a", source, [5])) == 1


def test_many_lookups_never_see_half_a_batch_of_another_thread() -> None:
    # With so short a window, nearly every insertion moves the samples down.
    tree = tree_of(moving("body", "left", 0), moving("body", "right", 0), static("left", "tip", 1.0), keep=60e-9)

    def read() -> None:
        newest = tree.lookup("body", "left").stamp
        stamps = np.arange(max(0, newest - 50), newest + 1)
        for few_or_many in (stamps[-20:], stamps):
            seen = tree.lookup_many("body", "tip", few_or_many, out_of_range="nan")
            assert (seen.translations[:, 0] == few_or_many + 1)[seen.valid].all()
            between = tree.lookup_many("left", "right", few_or_many, out_of_range="nan")
            assert not between.translations[between.valid].any()

    with threads_that(read):
        for stamp in range(1, 3_000):
            tree.insert_many(moving("body", side, stamp, float(stamp)) for side in ("left", "right"))


def test_a_policy_is_checked_although_no_stamp_needs_it() -> None:
    tree = tree_of(*over("map", "cart", range(0, 101, 10)))
    assert len(tree.lookup_many("map", "cart", [10, 25], tolerance=0.0)) == 2
    wrong: list[dict[str, Any]] = [{"tolerance": -1.0}, {"tolerance": math.nan}, {"max_gap": -1.0}]
    for options in wrong:
        with pytest.raises(ValueError, match=next(iter(options))):
            tree.lookup_many("map", "cart", [10, 25], **options)


# Clouds from a moving sensor


def scan(points: Any, stamps: Any, stamp: int | Latest = LATEST, **fields: Any) -> PointCloud:
    return PointCloud("lidar", stamp, np.asarray(points), stamps, fields)


def straight(time: float) -> Transform:
    return Transform((time, 0.0, 0.0))


def along(path: Callable[[float], Transform]) -> TransformTree:
    """A cart that goes on a path for 1 s, with a lidar on it, 1 m ahead and turned by a right angle."""
    tree = TransformTree()
    for percent in range(0, 101, 5):
        tree.insert(TransformStamped("odom", "cart", percent * SECOND // 100, path(percent / 100)))
    mount = Transform.from_axis_angle((0, 0, 1), math.pi / 2, (1.0, 0.0, 0.0))
    tree.insert(TransformStamped("cart", "lidar", 0, mount, static=True))
    return tree


def wall() -> tuple[Any, Any]:
    """300 points of a wall 9 m ahead of the start, and when each is seen."""
    y = np.linspace(-4.0, 4.0, 300)
    return np.column_stack((np.full(300, 9.0), y, y / 8.0)), np.linspace(0, SECOND, 300).astype(np.int64)


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(lambda time: Transform((3.0 * time, 0.0, 0.0)), id="straight on"),
        pytest.param(lambda time: Transform.from_axis_angle((0, 0, 1), 2.5 * time), id="on the spot"),
        pytest.param(lambda time: Transform.from_axis_angle((1, 2, 3), 2.5 * time, (time, -2 * time, 0)), id="both"),
    ],
)
@pytest.mark.parametrize("at", [LATEST, 0, SECOND // 2, SECOND])
def test_deskewing_straightens_a_wall_that_a_moving_sensor_saw(
    path: Callable[[float], Transform], at: int | Latest
) -> None:
    tree = along(path)
    expected, stamps = wall()
    cart_from_lidar = Transform.from_axis_angle((0, 0, 1), math.pi / 2, (1.0, 0.0, 0.0))
    odom_from_lidar = [path(stamp / SECOND) @ cart_from_lidar for stamp in stamps.tolist()]
    seen = [pose.inverse().apply(tuple(point)) for pose, point in zip(odom_from_lidar, expected.tolist(), strict=True)]
    cloud = scan(seen, stamps, at)
    np.testing.assert_allclose(tree.deskew(cloud, "odom", "odom").points, expected, rtol=0, atol=1e-12)
    found = tree.deskew(cloud, "cart", "odom")
    now = SECOND if isinstance(at, Latest) else at
    assert (found.frame, found.stamp, found.stamps) == ("cart", now, None)
    np.testing.assert_allclose(found.points, path(now / SECOND).inverse().apply(expected), rtol=0, atol=1e-12)


def shaken(seed: int) -> TransformTree:
    """Two moving edges above the lidar and one beside it, each with poses of its own."""
    rng = np.random.default_rng(seed)
    tree = TransformTree()
    for parent, child in (("map", "odom"), ("odom", "cart"), ("map", "beacon")):
        for stamp in range(0, 1_001, 50):
            rotation = rng.normal(size=4)
            pose = Transform(rng.normal(size=3), rotation / np.linalg.norm(rotation))
            tree.insert(TransformStamped(parent, child, stamp, pose))
    tree.insert(TransformStamped("cart", "lidar", 0, Transform.from_xyz_rpy((1, 2, 3), (0.1, 0.2, 0.3)), static=True))
    return tree


CLOUD_FRAMES = ("lidar", "cart", "odom", "map", "beacon")


@pytest.mark.parametrize("target", CLOUD_FRAMES)
@pytest.mark.parametrize("fixed", CLOUD_FRAMES)
def test_a_deskewed_cloud_equals_its_points_deskewed_one_by_one(target: str, fixed: str) -> None:
    tree, rng = shaken(1), np.random.default_rng(2)
    points, stamps = rng.normal(size=(60, 3)), rng.integers(0, 1_001, 60)
    found = tree.deskew(scan(points, stamps, 333), target, fixed)
    one_by_one = [
        tree.lookup(target, "lidar", 333, source_at=stamp, fixed=fixed).transform.apply(tuple(point))
        for point, stamp in zip(points.tolist(), stamps.tolist(), strict=True)
    ]
    np.testing.assert_allclose(found.points, one_by_one, rtol=0, atol=1e-12 * 10)
    assert (found.frame, found.stamp) == (target, 333)


def test_a_cloud_of_many_blocks_equals_its_parts() -> None:
    tree, rng = shaken(1), np.random.default_rng(2)
    points, stamps = rng.normal(size=(5_000, 3)), rng.integers(0, 1_001, 5_000)
    whole = tree.deskew(scan(points, stamps, 500), "map", "odom").points
    for first in range(0, 5_000, 700):
        part = slice(first, first + 700)
        again = tree.deskew(scan(points[part], stamps[part], 500), "map", "odom").points
        np.testing.assert_allclose(whole[part], again, rtol=0, atol=1e-12)


def test_float32_points_stay_float32_and_are_computed_in_double_precision() -> None:
    tree, rng = shaken(1), np.random.default_rng(2)
    points, stamps = rng.normal(size=(500, 3)).astype(np.float32), rng.integers(0, 1_001, 500)
    single = tree.deskew(scan(points, stamps, 500), "map", "odom").points
    double = tree.deskew(scan(points.astype(np.float64), stamps, 500), "map", "odom").points
    assert (single.dtype, double.dtype) == (np.dtype(np.float32), np.dtype(np.float64))
    np.testing.assert_array_equal(single, double.astype(np.float32))


def test_deskewing_keeps_the_other_fields_and_does_not_modify_the_cloud() -> None:
    points, stamps = np.zeros((2, 3)), np.array([0, SECOND])
    cloud = scan(points, stamps, SECOND, intensity=[0.5, 0.7], ring=[[1, 2], [3, 4]])
    found = along(straight).deskew(cloud, "cart", "odom")
    assert {name: column.tolist() for name, column in found.fields.items()} == {
        "intensity": [0.5, 0.7],
        "ring": [[1, 2], [3, 4]],
    }
    assert found.points.tolist() == [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    assert (cloud.frame, cloud.stamp, cloud.stamps is None) == ("lidar", SECOND, False)
    assert (points.tolist(), stamps.tolist()) == ([[0.0] * 3] * 2, [0, SECOND])


def test_a_nan_point_stays_nan_and_the_others_are_moved() -> None:
    tree = along(straight)
    nowhere = (math.nan, 0.0, 0.0)
    found = tree.deskew(scan([(0, 0, 0), nowhere, (0, 0, 0)], [0, 5, SECOND]), "odom", "odom")
    assert found.points[[0, 2]].tolist() == pytest.approx(np.array([[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]))
    assert np.isnan(found.points[1]).any()


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_an_infinite_point_stays_not_finite_without_a_warning(dtype: Any) -> None:
    tree = along(lambda time: Transform.from_axis_angle((1, 2, 3), time, (time, 0.0, 0.0)))
    points = np.array([(np.inf, 0, 0), (0, -np.inf, 0), (np.inf, -np.inf, np.nan), (1, 2, 3)], dtype)
    for target in ("odom", "cart"):
        found = tree.deskew(scan(points, [0, 5, SECOND, SECOND // 2]), target, "odom")
        assert np.isfinite(found.points).all(axis=1).tolist() == [False, False, False, True]


def test_points_without_an_answer_are_an_error_with_the_first_index_or_nan() -> None:
    tree = along(straight)
    cloud = scan(np.zeros((4, 3), np.float32), [5, SECOND + 1, -1, 5], 0, ring=[1, 2, 3, 4])
    with pytest.raises(FutureExtrapolationError) as caught:
        tree.deskew(cloud, "cart", "odom")
    assert (caught.value.index, caught.value.child, caught.value.stamp) == (1, "cart", SECOND + 1)
    found = tree.deskew(cloud, "cart", "odom", out_of_range="nan")
    assert np.isnan(found.points).all(axis=1).tolist() == [False, True, True, False]
    assert (found.points.dtype, found.fields["ring"].tolist()) == (np.dtype(np.float32), [1, 2, 3, 4])
    with pytest.raises(ValueError, match="'drop'"):
        tree.deskew(cloud, "cart", "odom", out_of_range="drop")  # type: ignore[arg-type]


@pytest.mark.parametrize("out_of_range", ["raise", "nan"])
def test_a_cloud_without_a_path_over_the_fixed_frame_to_the_target_is_disconnected(
    out_of_range: OutOfRange,
) -> None:
    tree = along(straight)
    tree.insert_many([static("world", "tower")])
    for target, fixed in (("tower", "odom"), ("tower", "world")):
        with pytest.raises(DisconnectedError):
            tree.deskew(scan(np.zeros((2, 3)), [0, 5]), target, fixed, out_of_range=out_of_range)


def test_the_stamp_of_the_cloud_must_be_covered_like_those_of_its_points() -> None:
    tree = along(straight)
    with pytest.raises(FutureExtrapolationError) as caught:
        tree.deskew(scan(np.zeros((2, 3)), [0, 5], 2 * SECOND), "cart", "odom")
    assert (caught.value.index, caught.value.stamp) == (None, 2 * SECOND)


@pytest.mark.parametrize("at", [LATEST, SECOND // 2])
def test_an_empty_cloud_stays_empty(at: int | Latest) -> None:
    tree = along(straight)
    found = tree.deskew(scan(np.zeros((0, 3), np.float32), [], at, ring=[]), "cart", "odom")
    assert (found.points.shape, found.points.dtype, found.frame) == ((0, 3), np.dtype(np.float32), "cart")
    assert found.stamp == (SECOND if at is LATEST else at)


def test_points_without_stamps_cannot_be_deskewed() -> None:
    with pytest.raises(ValueError, match="no stamps"):
        along(straight).deskew(scan(np.zeros((2, 3)), None), "cart", "odom")


def test_the_answers_have_the_stamps_that_were_asked_and_slices_and_masks_keep_them() -> None:
    tree = tree_of(*over("map", "base", range(101)), keep=None)
    for stamps in (np.array([30, 10, 20]), np.arange(100, dtype=np.int64)):
        found = tree.lookup_many("map", "base", stamps)
        assert found.stamps is not None
        assert found.stamps.tolist() == stamps.tolist()
        for chosen in (slice(1, 3), stamps > 15, [2, 0]):
            part = found[chosen]
            assert part.stamps is not None
            assert part.stamps.tolist() == stamps[chosen].tolist()
        # The caller may change what it gave.
        before = stamps.tolist()
        stamps[:] = 7
        assert found.stamps.tolist() == before
    dates = np.array([5, 6], "M8[ns]")
    found = tree.lookup_many("map", "base", dates, out_of_range="nan", tolerance=1e-9)
    assert (found.stamps is not None, found.gap is not None) == (True, True)
    travelled = tree.lookup_many("map", "base", [3, 4], source_at=np.datetime64(5, "ns"), fixed="map")
    assert travelled.stamps is not None
    assert travelled.stamps.tolist() == [3, 4]


@pytest.mark.skipif(tfbus.kernel != "compiled", reason="numpy's sine may differ from that of the kernel in Python")
@pytest.mark.parametrize("count", [1, 10, 1_000])
@pytest.mark.parametrize(("target", "source"), [("map", "cart"), ("dog", "lidar"), ("cart", "lidar"), ("map", "map")])
def test_many_answers_have_the_bits_of_single_lookups(target: str, source: str, count: int) -> None:
    tree = tree_of(*over("map", "cart", range(0, 1_001, 10)), static("cart", "lidar"), *over("map", "dog", [0, 500]))
    stamps = np.arange(count)[::-1] * 499 // max(count - 1, 1)
    found = tree.lookup_many(target, source, stamps)
    single = [tree.lookup(target, source, stamp).transform for stamp in stamps.tolist()]
    expected = b"".join(struct.pack("7d", *one.translation, *one.rotation) for one in single)
    assert np.hstack((found.translations, found.rotations)).tobytes() == expected


@pytest.mark.parametrize(
    "ask",
    [
        lambda tree, stamps: tree.lookup_many("map", "lidar", stamps),
        lambda tree, stamps: tree.lookup_many("map", "lidar", stamps, tolerance=1.0),
        lambda tree, stamps: tree.lookup_many("map", "guest", stamps),
        lambda tree, stamps: tree.deskew(scan(np.zeros((len(stamps), 3)), stamps, 500), "map", "map"),
    ],
    ids=["plain", "policy", "two parents", "cloud"],
)
def test_another_thread_can_insert_before_each_call_of_numpy(ask: Callable[[TransformTree, Any], object]) -> None:
    tree = tree_of(*over("map", "cart", range(0, 1_001, 10)), static("cart", "lidar"), keep=None)
    tree.insert_many([*over("cart", "guest", range(0, 500, 10)), *over("map", "guest", range(500, 1_001, 10))])
    stamps, inserted = np.arange(1_000), count()

    def insert(_frame: FrameType, event: str, function: Any) -> None:
        owner = getattr(function, "__self__", None)
        if event == "c_call" and (isinstance(owner, np.ndarray) or "numpy" in str(function.__module__)):
            other.submit(tree.insert, moving("elsewhere", "other", next(inserted))).result(10.0)

    with ThreadPoolExecutor(1) as other:
        sys.setprofile(insert)
        try:
            ask(tree, stamps)
        finally:
            sys.setprofile(None)
    assert next(inserted) > 3

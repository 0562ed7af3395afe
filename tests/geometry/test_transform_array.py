import copy
import math
import operator
import pickle
import sys
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from support.samples import over, tree_of
from support.strategies import rotations, transforms, vectors

from tfbus import SECOND, InvalidTransformError, Transform, TransformArray
from tfbus.rows import ROUNDING, Quaternion, Vector

ONE = (0.0, 0.0, 0.0, 1.0)
HALF_TURN_ABOUT_Z = (0.0, 0.0, 1.0, 0.0)


def array_of(poses: Sequence[Transform]) -> TransformArray:
    translations = np.array([pose.translation for pose in poses]).reshape(-1, 3)
    return TransformArray(translations, np.array([pose.rotation for pose in poses]).reshape(-1, 4))


def ahead(*xs: float) -> TransformArray:
    """Transforms that shift along the first axis; NaN for none."""
    missing = np.isnan(xs)
    translations, rotations = np.zeros((len(xs), 3)), np.tile(ONE, (len(xs), 1))
    translations[:, 0] = xs
    translations[missing] = rotations[missing] = math.nan
    return TransformArray(translations, rotations)


def assert_close(found: TransformArray, expected: Sequence[Transform]) -> None:
    assert len(found) == len(expected)
    rows = [(*pose.translation, *pose.rotation) for pose in expected]
    columns = np.hstack((found.translations, found.rotations))
    np.testing.assert_allclose(columns, np.reshape(rows, (-1, 7)), rtol=0, atol=1e-12)


# Making


def test_the_parts_are_those_that_were_given() -> None:
    steps = TransformArray([[1, 2, 3], [4, 5, 6]], [ONE, HALF_TURN_ABOUT_Z])
    assert steps.translations.tolist() == [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
    assert steps.rotations.tolist() == [[*ONE], [*HALF_TURN_ABOUT_Z]]
    assert steps.translations.dtype == steps.rotations.dtype == np.float64
    assert (len(steps), repr(steps)) == (2, "<TransformArray of 2>")


# By their squares, the first two are units but for rounding; the third is not, though its norm would be.
@example([((0.0, 0.0, 0.0), (-0.49, -0.01, -0.1, 0.8659099260315708))], 1.0)
@example([((0.0, 0.0, 0.0), (0.9474015346938999, 0.006046331364519918, 0.29874456871007093, -0.114653637547647))], 1.0)
@example([((0.0, 0.0, 0.0), (0.08, 0.88, -0.24, 0.401995024844837))], 1.0)
@given(st.lists(st.tuples(vectors(), rotations()), min_size=1, max_size=5), st.just(1.0) | st.floats(0.991, 1.009))
def test_rotations_are_kept_or_normalised_to_the_last_digit_as_in_a_transform(
    parts: list[tuple[Vector, Quaternion]], norm: float
) -> None:
    scaled = [(move, tuple(norm * part for part in turn)) for move, turn in parts]
    found = TransformArray([move for move, _ in scaled], [turn for _, turn in scaled])
    assert list(found) == [Transform(*each) for each in scaled]


@pytest.mark.parametrize(
    ("translation", "rotation"),
    [
        ((0, 0, 0), (0, 0, 0, 1.02)),
        ((0, 0, 0), (0, 0, 0, 0)),
        ((0, 0, 0), (0, 0, math.inf, 1)),
        ((0, math.inf, 0), ONE),
        ((0, -math.inf, 0), ONE),
        ((0, math.nan, 0), ONE),
        ((math.nan,) * 3, ONE),
        ((0, 0, 0), (math.nan,) * 4),
        ((math.nan,) * 3, (math.nan, 0, 0, 1)),
        ((math.nan, 0, 0), (math.nan,) * 4),
    ],
)
def test_a_row_that_is_neither_rigid_nor_nan_throughout_is_refused_and_named(
    translation: Sequence[float], rotation: Sequence[float]
) -> None:
    with pytest.raises(InvalidTransformError, match="transform 2 "):
        TransformArray([(0, 0, 0), (math.nan,) * 3, translation], [ONE, (math.nan,) * 4, rotation])


@pytest.mark.parametrize(
    ("translations", "rotations"), [((3,), (4,)), ((2, 3), (3, 4)), ((2, 4), (2, 3)), ((2, 2, 3), (2, 2, 4)), ((), ())]
)
def test_wrong_shapes_are_refused_with_both(translations: tuple[int, ...], rotations: tuple[int, ...]) -> None:
    with pytest.raises(InvalidTransformError) as caught:
        TransformArray(np.ones(translations), np.ones(rotations))
    assert f"got {translations} and {rotations}" in str(caught.value)


DUPLICATES = [
    *(
        pytest.param(lambda steps, by=protocol: pickle.loads(pickle.dumps(steps, by)), id=f"pickle {protocol}")
        for protocol in range(pickle.HIGHEST_PROTOCOL + 1)
    ),
    pytest.param(copy.copy, id="copy"),
    pytest.param(copy.deepcopy, id="deep copy"),
]
OTHERS = [
    pytest.param(lambda steps: steps, id="as made"),
    pytest.param(lambda steps: steps[::2], id="slice"),
    pytest.param(lambda steps: steps[np.array([0, 2])], id="indices"),
    pytest.param(lambda steps: steps[[0, 2]], id="list"),
    pytest.param(lambda steps: steps[steps.valid], id="mask"),
    pytest.param(lambda steps: copy.deepcopy(steps[[0, 2]]), id="copy of some"),
    pytest.param(lambda steps: steps.inverse(), id="inverse"),
    pytest.param(lambda steps: steps @ steps, id="product"),
]


@pytest.mark.parametrize("made", DUPLICATES + OTHERS)
def test_transforms_cannot_be_changed_however_they_were_made(made: Callable[[TransformArray], TransformArray]) -> None:
    tree = tree_of(*over("a", "b", [0, 10, 20]))
    few, many = (tree.lookup_many("a", "b", [0, 5, 20] * count) for count in (1, 40))
    lenient = tree.lookup_many("a", "b", [0, 5, 30], tolerance=1.0)
    for steps in map(made, (ahead(0.0, 1.0, 2.0), few, many, lenient)):
        for array in (steps.translations, steps.rotations, steps.extrapolated_by, steps.gap):
            if array is not None:
                with pytest.raises(ValueError, match="read-only"):
                    array[...] = 5
                with pytest.raises(ValueError, match="WRITEABLE"):
                    array.flags.writeable = True
    for name in ("translations", "rotations", "valid", "something"):
        with pytest.raises(AttributeError):
            setattr(steps, name, None)


@pytest.mark.parametrize("made", DUPLICATES)
def test_transforms_pickle_and_copy(made: Callable[[TransformArray], TransformArray]) -> None:
    steps = array_of([Transform((1.0, 2.0, 3.0), (0.1, -0.7, 0.1, -0.7)), Transform()])
    twin = made(steps)
    assert twin is not steps
    assert list(twin) == list(steps)
    assert len(made(steps[:0])) == 0
    assert made(ahead(math.nan, 1.0)).valid.tolist() == [False, True]


# Elements


def test_elements_are_transforms_of_plain_floats_by_index_from_either_end_and_in_turn() -> None:
    poses = [Transform((1.0, 2.0, 3.0), (0.1, -0.7, 0.1, -0.7)), Transform(), Transform((4.0, 5.0, 6.0))]
    steps = array_of(poses)
    assert list(steps) == [steps[0], steps[1], steps[2]] == [steps[-3], steps[-2], steps[-1]] == poses
    for pose in steps:
        assert type(pose) is Transform
        assert {type(part) for part in (*pose.translation, *pose.rotation)} == {float}


@pytest.mark.parametrize(
    "index",
    [
        slice(None),
        slice(1, 3),
        slice(None, None, -1),
        slice(5, 9),
        np.array([True, False, False, True, False]),
        np.array([4, 0, 0, -1]),
        np.array([], np.intp),
    ],
)
def test_a_slice_a_mask_or_indices_take_some_as_in_numpy(index: slice | npt.NDArray[Any]) -> None:
    xs = np.arange(5.0)
    taken = ahead(*xs)[index]
    assert isinstance(taken, TransformArray)
    assert taken.translations[:, 0].tolist() == xs[index].tolist()
    assert taken.rotations.shape == (len(taken), 4)


@pytest.mark.parametrize(
    "index", [(), (0,), (0, 1), (slice(2),), np.array([[0, 1]]), [0, 2], np.array([True]), None, True, 0.0, "0"]
)
def test_other_indices_are_refused_with_the_valid_kinds(index: Any) -> None:
    with pytest.raises(IndexError) as caught:
        ahead(1.0, 2.0)[index]
    assert str(caught.value) == (
        f"index {index!r} does not fit 2 transforms: give an int, a slice, or a mask or indices in a list or an array"
    )


@pytest.mark.parametrize("count", [0, 2])
@pytest.mark.parametrize("beyond", [2, -3])
def test_there_is_nothing_beyond_either_end(count: int, beyond: int) -> None:
    with pytest.raises(IndexError, match=f"index {beyond} does not fit {count} transforms"):
        ahead(*range(count))[beyond]


def test_a_missing_transform_is_not_valid_and_cannot_be_taken() -> None:
    steps = ahead(1.0, math.nan, 3.0)
    assert steps.valid.tolist() == [True, False, True]
    assert steps[0] == Transform((1.0, 0.0, 0.0))
    for index in (1, -2):
        with pytest.raises(InvalidTransformError, match="NaN"):
            steps[index]
    assert [*steps[steps.valid]] == [Transform((1.0, 0.0, 0.0)), Transform((3.0, 0.0, 0.0))]


def test_missing_transforms_stay_missing_and_do_not_spread() -> None:
    steps = ahead(1.0, math.nan, 3.0)
    assert (steps @ steps).valid.tolist() == [True, False, True]
    assert (ahead(1.0, 2.0, 3.0) @ steps).valid.tolist() == [True, False, True]
    assert steps.inverse().valid.tolist() == [True, False, True]
    assert np.isnan(steps.matrices()[:, :3]).all(axis=(1, 2)).tolist() == [False, True, False]
    assert np.isnan(steps.apply(np.zeros((3, 3)))).tolist() == [[False] * 3, [True] * 3, [False] * 3]


# Arithmetic


@given(st.lists(st.tuples(transforms(10.0), transforms(10.0), vectors(10.0)), max_size=5))
def test_the_methods_give_for_each_element_what_those_of_a_transform_give(
    each: list[tuple[Transform, Transform, Vector]],
) -> None:
    poses, others = [a for a, _, _ in each], [b for _, b, _ in each]
    steps = array_of(poses)
    assert_close(steps, poses)
    assert_close(steps.inverse(), [a.inverse() for a in poses])
    assert_close(steps @ array_of(others), [a @ b for a, b, _ in each])
    for one in others[:1]:
        assert_close(one @ steps, [one @ a for a in poses])
        assert_close(steps @ one, [a @ one for a in poses])
    moved = steps.apply(np.reshape([point for _, _, point in each], (-1, 3)))
    expected = np.reshape([a.apply(point) for a, _, point in each], (-1, 3))
    np.testing.assert_allclose(moved, expected, rtol=0, atol=1e-12)
    matrices = np.reshape([a.matrix() for a in poses], (-1, 4, 4))
    np.testing.assert_allclose(steps.matrices(), matrices, rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("given_type", "returned"),
    [(np.float32, np.float32), (np.float16, np.float16), (np.float64, np.float64), (np.int32, np.float64)],
)
def test_float32_stays_and_integers_become_float64(given_type: type[Any], returned: type[Any]) -> None:
    points = np.array([[1, 2, 3], [4, 5, 6]], given_type)
    found = ahead(0.5, 1.5).apply(points)
    assert found.dtype == returned
    assert found.tolist() == [[1.5, 2.0, 3.0], [5.5, 5.0, 6.0]]
    assert points.tolist() == [[1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_an_infinite_point_stays_not_finite_without_a_warning(dtype: Any) -> None:
    points = np.array([(np.inf, 0, 0), (0, -np.inf, 0), (np.inf, -np.inf, np.nan), (1, 2, 3)], dtype)
    for rotation in (ONE, HALF_TURN_ABOUT_Z, (0.1, -0.7, 0.1, -0.7)):
        moved = TransformArray([(1.0, 2.0, 3.0)] * 4, [rotation] * 4).apply(points)
        assert np.isfinite(moved).all(axis=1).tolist() == [False, False, False, True]


@pytest.mark.parametrize("shape", [(3,), (3, 3), (2, 2), (1, 3), (2, 3, 1), (0, 3)])
def test_points_must_be_as_many_as_transforms(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"shape \(2, 3\)") as caught:
        ahead(0.0, 1.0).apply(np.zeros(shape))
    assert f"got {shape}" in str(caught.value)


def test_only_as_many_transforms_can_be_combined_one_by_one() -> None:
    with pytest.raises(ValueError, match="3 and 2"):
        ahead(1.0, 2.0, 3.0) @ ahead(1.0, 2.0)


@pytest.mark.parametrize("other", [np.eye(4), np.zeros((2, 3)), np.float64(2.0), [Transform()] * 2, None, 2.0])
def test_transforms_compose_with_transforms_only(other: Any) -> None:
    for a, b in ((ahead(1.0, 2.0), other), (other, ahead(1.0, 2.0))):
        with pytest.raises(TypeError):
            operator.matmul(a, b)


# Stamps


def test_stamps_are_kept_with_their_transforms() -> None:
    days = np.array(["1970-01-01", "1970-01-02", "1970-01-03"], "M8[D]")
    steps = TransformArray(np.eye(3), [ONE] * 3, days)
    day = 86_400 * SECOND
    assert steps.stamps is not None
    assert steps.stamps.tolist() == [0, day, 2 * day]
    kept = {
        "slice": (steps[::2], [0, 2 * day]),
        "mask": (steps[[False, True, True]], [day, 2 * day]),
        "indices": (steps[[2, 0]], [2 * day, 0]),
        "inverse": (steps.inverse(), [0, day, 2 * day]),
        "with one": (steps @ Transform(), [0, day, 2 * day]),
        "one with": (Transform() @ steps, [0, day, 2 * day]),
        "with itself": (steps @ steps, [0, day, 2 * day]),
        "with none": (steps @ ahead(0.0, 1.0, 2.0), [0, day, 2 * day]),
        "none with": (ahead(0.0, 1.0, 2.0) @ steps, [0, day, 2 * day]),
        "pickle": (pickle.loads(pickle.dumps(steps)), [0, day, 2 * day]),
    }
    for name, (some, expected) in kept.items():
        assert some.stamps is not None, name
        assert some.stamps.tolist() == expected, name


def test_a_product_of_different_stamps_has_none() -> None:
    one, other = (TransformArray([[0, 0, 0]], [ONE], [stamp]) for stamp in (1, 2))
    assert (one @ other).stamps is None
    assert ahead(1.0).stamps is None
    assert (ahead(1.0) @ ahead(1.0)).stamps is None


@pytest.mark.parametrize("stamps", [[], [1], [1, 2, 3]])
def test_there_is_one_stamp_for_each_transform(stamps: list[int]) -> None:
    with pytest.raises(ValueError, match=rf"{len(stamps)} stamps for 2 transforms"):
        TransformArray(np.zeros((2, 3)), [ONE] * 2, stamps)


def test_the_repr_has_the_span_and_the_number_of_missing_transforms() -> None:
    steps = TransformArray(np.zeros((2, 3)), [ONE] * 2, [2 * SECOND, SECOND])
    assert repr(steps) == "<TransformArray of 2 from 1.000 s to 2.000 s>"
    assert repr(steps[:0]) == "<TransformArray of 0>"
    assert repr(ahead(math.nan, 0.0, math.nan)) == "<TransformArray of 3, 2 are NaN>"


# Conversions


@given(
    st.lists(
        st.one_of(
            transforms(),
            st.builds(
                lambda roll, pitch, yaw: Transform.from_xyz_rpy((0, 0, 0), (roll, pitch, yaw)),
                st.floats(-4.0, 4.0),
                st.sampled_from((math.pi / 2, -math.pi / 2)),
                st.floats(-4.0, 4.0),
            ),
        ),
        max_size=5,
    )
)
@example(
    [
        Transform(rotation=(off, sign * math.sqrt(0.5), 0.0, math.sqrt(0.5)))
        for sign in (1.0, -1.0)
        for off in (ROUNDING, math.nextafter(ROUNDING, 1.0))
    ]
)
def test_wxyz_and_rpy_are_those_of_each_transform(poses: list[Transform]) -> None:
    steps = array_of(poses)
    assert steps.as_wxyz().tolist() == [list(pose.as_wxyz()) for pose in poses]
    expected = np.reshape([pose.as_rpy() for pose in poses], (-1, 3))
    np.testing.assert_allclose(steps.as_rpy(), expected, rtol=0, atol=4e-15)


def test_rotations_go_to_scipy_and_back() -> None:
    pytest.importorskip("scipy")
    turn = Transform((1.0, 2.0, 3.0), (0.1, -0.7, 0.1, -0.7))
    steps = TransformArray([turn.translation] * 2, [turn.rotation] * 2, [1, 2])
    back = TransformArray.from_scipy(steps.translations, steps.as_scipy(), steps.stamps)
    assert_close(back, [turn, turn])
    assert back.stamps is not None
    assert back.stamps.tolist() == [1, 2]
    np.testing.assert_allclose(steps.as_scipy().apply([1, 2, 3])[1], steps[1].apply(np.array([1, 2, 3])) - [1, 2, 3])
    assert Transform.from_scipy(turn.translation, turn.as_scipy()).is_close(turn)
    np.testing.assert_allclose(turn.as_scipy().as_matrix(), turn.matrix()[:3, :3], rtol=0, atol=1e-15)
    with pytest.raises(ValueError, match="transform 1 is NaN"):
        ahead(0.0, math.nan).as_scipy()


@pytest.mark.parametrize("library", ["pandas", "polars"])
def test_a_data_frame_has_a_row_for_each_transform(library: str) -> None:
    pytest.importorskip(library)
    frame = TransformArray([[1, 2, 3], [4, 5, 6]], [ONE, HALF_TURN_ABOUT_Z], [10, 20]).to_dataframe(library)
    assert type(frame).__module__.startswith(library)
    assert list(frame.columns) == ["stamp_ns", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"]
    assert frame.to_numpy().tolist() == [[10, 1, 2, 3, 0, 0, 0, 1], [20, 4, 5, 6, 0, 0, 1, 0]]
    assert list(ahead(0.0).to_dataframe(library).columns) == ["x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"]


@pytest.mark.parametrize("library", ["pandas", "polars"])
def test_a_data_frame_has_dates_in_utc_to_the_nanosecond_and_angles(library: str) -> None:
    pytest.importorskip(library)
    stamps = [1_396_293_888_053_123_456, 1_396_293_888_053_123_457]
    turn = Transform.from_xyz_rpy((1, 2, 3), (0.1, -0.2, 3.0))
    path = TransformArray([turn.translation] * 2, [turn.rotation] * 2, stamps)
    frame = path.to_dataframe(library, index="datetime", angles=True)
    dates = frame.index if library == "pandas" else frame["stamp"]
    assert list(frame.columns)[-10:] == [
        "x_m",
        "y_m",
        "z_m",
        "qx",
        "qy",
        "qz",
        "qw",
        "roll_rad",
        "pitch_rad",
        "yaw_rad",
    ]
    assert [float(frame[name].to_numpy()[0]) for name in ("roll_rad", "pitch_rad", "yaw_rad")] == pytest.approx(
        [0.1, -0.2, 3.0]
    )
    assert "UTC" in str(dates.dtype)
    # From any zone back to stamps.
    away = dates.tz_convert("Asia/Tokyo") if library == "pandas" else dates.dt.convert_time_zone("Asia/Tokyo")
    again = TransformArray(frame[["x_m", "y_m", "z_m"]], frame[["qx", "qy", "qz", "qw"]], away)
    assert again.stamps is not None
    assert again.stamps.tolist() == stamps
    with pytest.raises(ValueError, match="no stamps"):
        ahead(0.0).to_dataframe(library, index="datetime")
    with pytest.raises(ValueError, match="None or 'datetime'"):
        path.to_dataframe(library, index="date")
    if library == "pandas":
        frame.iloc[0, 0] = 5.0
        assert path[0] == turn


def test_a_data_frame_is_of_pandas_or_polars() -> None:
    with pytest.raises(ValueError, match="'pandas' or 'polars', not 'os'"):
        ahead(0.0).to_dataframe("os")


def test_a_missing_library_of_data_frames_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match=r'pip install "tfbus\[pandas\]"'):
        ahead(0.0).to_dataframe()

""""""

import copy
import json
import math
import pickle
from collections.abc import Sequence
from decimal import Decimal, localcontext
from itertools import permutations
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from support.strategies import angles, rotations, small_angles, transforms, unit_vectors, vectors
from transforms3d import affines, axangles, euler, quaternions

from tfbus import InvalidTransformError, Transform
from tfbus.rows import Columns, Quaternion, Row, Vector, as_rotation, as_vector, compose, interpolate, invert

HALF = math.sqrt(0.5)
QUARTER_TURN_ABOUT_Z: Quaternion = (0.0, 0.0, HALF, HALF)


def angle_between(a: Sequence[float], b: Sequence[float]) -> float:
    """The angle in rad between two rotations, from the chord of their quaternions: good to the last digit."""
    chord = min(math.dist(a, b), math.dist(a, [-part for part in b]))
    return 4.0 * math.asin(min(1.0, chord / 2.0))


def assert_same(actual: Transform, expected: Transform, metres: float = 1e-9, rad: float = 1e-12) -> None:
    assert math.dist(actual.translation, expected.translation) <= metres
    assert angle_between(actual.rotation, expected.rotation) <= rad


def rotation(angle: float, axis: Vector = (0.0, 0.0, 1.0)) -> Quaternion:
    x, y, z = (math.sin(angle / 2.0) * part for part in axis)
    return x, y, z, math.cos(angle / 2.0)


# Group laws


@given(transforms(), transforms(), transforms(), vectors())
def test_transforms_are_a_group_that_acts_on_points(a: Transform, b: Transform, c: Transform, point: Vector) -> None:
    identity = Transform.identity()
    assert_same((a @ b) @ c, a @ (b @ c))
    assert_same(a @ identity, a)
    assert_same(identity @ a, a)
    assert_same(a @ a.inverse(), identity)
    assert_same(a.inverse() @ a, identity)
    assert math.dist((a @ b).apply(point), a.apply(b.apply(point))) <= 1e-9
    assert math.dist(a.inverse().apply(a.apply(point)), point) <= 1e-9


@given(rotations())
def test_the_inverse_keeps_the_sign_of_w(q: Quaternion) -> None:
    x, y, z, w = Transform(rotation=q).rotation
    assert Transform(rotation=q).inverse().rotation == (-x, -y, -z, w)


# transforms3d as the oracle


def matrix_of(t: Transform) -> Any:
    x, y, z, w = t.rotation
    return affines.compose(t.translation, quaternions.quat2mat((w, x, y, z)), np.ones(3))


@given(transforms(), transforms())
def test_matrices_are_those_of_transforms3d_and_come_back(a: Transform, b: Transform) -> None:
    np.testing.assert_allclose(a.matrix(), matrix_of(a), rtol=0, atol=1e-15)
    np.testing.assert_allclose((a @ b).matrix(), matrix_of(a) @ matrix_of(b), rtol=0, atol=1e-9)
    np.testing.assert_allclose(a.inverse().matrix(), np.linalg.inv(matrix_of(a)), rtol=0, atol=1e-9)
    assert_same(Transform.from_matrix(a.matrix()), a)
    expected = quaternions.mat2quat(matrix_of(a)[:3, :3])
    assert angle_between(Transform.from_matrix(matrix_of(a)).as_wxyz(), expected) <= 1e-14


@given(unit_vectors(), angles(), vectors())
def test_an_axis_and_an_angle_are_those_of_transforms3d(axis: Vector, angle: float, translation: Vector) -> None:
    t = Transform.from_axis_angle(axis, angle, translation)
    np.testing.assert_allclose(t.matrix()[:3, :3], axangles.axangle2mat(axis, angle), rtol=0, atol=1e-15)
    assert t.translation == translation


@given(vectors(), vectors(4.0))
def test_roll_pitch_and_yaw_are_the_fixed_axes_of_transforms3d(xyz: Vector, rpy: Vector) -> None:
    t = Transform.from_xyz_rpy(xyz, rpy)
    np.testing.assert_allclose(t.matrix()[:3, :3], euler.euler2mat(*rpy, "sxyz"), rtol=0, atol=1e-14)
    assert t.translation == xyz
    degrees = [math.degrees(angle) for angle in rpy]
    assert Transform.from_xyz_rpy(xyz, degrees, degrees=True).is_close(t)


SEQUENCES = [
    first + second + third for first in "xyz" for second in "xyz" for third in "xyz" if first != second != third
]


@given(st.sampled_from([*SEQUENCES, *map(str.upper, SEQUENCES)]), vectors(4.0), vectors())
def test_euler_angles_are_rotations_about_axes_one_after_another(sequence: str, angles: Vector, xyz: Vector) -> None:
    axes = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
    steps = [Transform.from_axis_angle(axes[a.lower()], angle) for a, angle in zip(sequence, angles, strict=True)]
    # About the axes of the turning body each step is on the right; about fixed axes it is on the left.
    first, second, third = steps if sequence.isupper() else steps[::-1]
    found = Transform.from_euler(sequence, angles, xyz)
    np.testing.assert_allclose(found.matrix()[:3, :3], (first @ second @ third).matrix()[:3, :3], rtol=0, atol=1e-14)
    assert found.translation == xyz
    assert Transform.from_euler(sequence, [math.degrees(angle) for angle in angles], xyz, degrees=True).is_close(found)


@pytest.mark.parametrize("sequence", ["xxy", "XYz", "", "rpy", "zyxz"])
def test_axes_that_are_no_sequence_are_refused(sequence: str) -> None:
    with pytest.raises(ValueError, match="three axes, such as 'ZYX' or 'xyz'"):
        Transform.from_euler(sequence, (0.0, 0.0, 0.0))


# Conversions both ways


def test_wxyz_has_w_first_and_comes_back_exactly() -> None:
    a = Transform((1.0, 2.0, 3.0), (0.1, -0.7, 0.1, -0.7))
    assert a.as_wxyz() == (-0.7, 0.1, -0.7, 0.1)
    assert Transform.from_wxyz(a.translation, a.as_wxyz()) == a


@given(transforms())
def test_roll_pitch_and_yaw_come_back(a: Transform) -> None:
    roll, pitch, yaw = a.as_rpy()
    assert_same(Transform.from_xyz_rpy(a.translation, (roll, pitch, yaw)), a)
    assert -math.pi <= roll <= math.pi
    assert -math.pi / 2 <= pitch <= math.pi / 2
    assert -math.pi <= yaw <= math.pi


@given(
    st.floats(-math.pi, math.pi),
    st.sampled_from((1.0, -1.0)),
    st.just(0.0) | st.floats(-17.0, -3.0).map(lambda exponent: 10.0**exponent),
    st.floats(-math.pi, math.pi),
)
def test_roll_pitch_and_yaw_come_back_at_and_near_the_gimbal_lock(
    roll: float, sign: float, off: float, yaw: float
) -> None:
    t = Transform.from_xyz_rpy((0, 0, 0), (roll, sign * (math.pi / 2 - off), yaw))
    assert_same(Transform.from_xyz_rpy((0, 0, 0), t.as_rpy()), t)


@given(unit_vectors(), st.one_of(small_angles(), st.floats(0.0, math.pi)))
def test_axis_and_angle_come_back(axis: Vector, angle: float) -> None:
    found_axis, found_angle = Transform.from_axis_angle(axis, angle).as_axis_angle()
    assert found_angle == pytest.approx(angle, rel=1e-14, abs=1e-300)
    if 1e-12 <= angle <= math.pi - 1e-9:
        assert math.dist(found_axis, axis) <= 1e-12


@given(rotations())
def test_the_angle_is_the_shorter_way_round_and_the_axis_is_a_unit_vector(q: Quaternion) -> None:
    assume(not 0.0 < math.hypot(*q[:3]) < 1e-300)  # denormal numbers have no digits left for a direction
    axis, angle = Transform(rotation=q).as_axis_angle()
    assert 0.0 <= angle <= math.pi
    assert math.hypot(*axis) == pytest.approx(1.0, abs=1e-15)
    assert angle_between(Transform.from_axis_angle(axis, angle).rotation, q) <= 1e-14


@pytest.mark.parametrize("tiny", [5e-324, 1e-310])
def test_the_smallest_rotation_there_is_has_a_unit_axis(tiny: float) -> None:
    axis, angle = Transform(rotation=(0.0, tiny, 0.0, 1.0)).as_axis_angle()
    assert axis == (0.0, 1.0, 0.0)
    assert angle == 2.0 * tiny


@pytest.mark.parametrize("length", [1e-300, 1e-200, 1e-9, 7.0, 1e200, 1e300])
def test_an_axis_may_have_any_length(length: float) -> None:
    t = Transform.from_axis_angle((0.0, 0.6 * length, -0.8 * length), 1.0)
    assert angle_between(t.rotation, rotation(1.0, (0.0, 0.6, -0.8))) <= 1e-15


@given(transforms(), st.floats(0.9901, 1.0099))
def test_a_matrix_within_one_percent_is_projected_on_a_rotation(a: Transform, scale: float) -> None:
    matrix = a.matrix()
    matrix[:3, :3] *= scale
    t = Transform.from_matrix(matrix.tolist())
    assert_same(t, a)
    assert math.hypot(*t.rotation) == pytest.approx(1.0, abs=1e-15)


# Wrong numbers


BAD_NUMBERS = [math.nan, math.inf, -math.inf]


@pytest.mark.parametrize(
    ("arguments", "reason", "text"),
    [
        (((0, math.nan, 0),), "not finite", "translation"),
        (((0, 10**400, 0),), "not finite", "translation"),
        (((1, 2),), "wrong length", "translation"),
        (((0.0, 0.0),), "wrong length", "translation"),
        (((0.0, 0.0, 0.0, 0.0),), "wrong length", "translation"),
        (((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)), "wrong length", "rotation"),
        (((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0, 1.0)), "wrong length", "rotation"),
        (((0, 0, 0), (0, 0, 0, math.inf)), "not finite", "rotation"),
        (((0, 0, 0), (0, 0, 0, 0)), "zero quaternion", "rotation"),
        (((0, 0, 0), (0, 0, 0, 2)), "not a unit quaternion", "rotation"),
    ],
)
def test_both_parts_are_checked_and_the_error_names_the_part(
    arguments: tuple[Any, ...], reason: str, text: str
) -> None:
    with pytest.raises(InvalidTransformError, match=text) as caught:
        Transform(*arguments)
    assert caught.value.reason == reason


@pytest.mark.parametrize("kind", [tuple, list])
def test_every_part_of_a_quaternion_counts_in_its_norm(kind: type) -> None:
    def turned(one: float, other: float) -> Transform:
        rotation = [0.0, 0.0, 0.0, 0.0]
        rotation[first], rotation[second] = one, other
        return Transform((0.0, 0.0, 0.0), kind(rotation))

    for first, second in permutations(range(4), 2):
        found = turned(0.6, -0.8).rotation
        assert (found[first], found[second]) == (0.6, -0.8)
        # One is the difference of the first two squares, and twice a half, but the square of none of the norms.
        for one, other in ((1.25, 0.75), (0.5, 0.0), (-0.5, 0.0)):
            with pytest.raises(InvalidTransformError, match="not a unit quaternion"):
                turned(one, other)


SHEARED = np.eye(4)
SHEARED[0, 1] = 0.1
MIRRORED = np.diag([1.0, 1.0, -1.0, 1.0])
PROJECTIVE = np.eye(4)
PROJECTIVE[3, 0] = 0.1


@pytest.mark.parametrize(
    ("matrix", "reason", "text"),
    [
        (np.eye(3), "wrong length", r"\(3, 3\)"),
        (np.zeros((2, 4, 4)), "wrong length", r"\(2, 4, 4\)"),
        (np.full((4, 4), math.nan), "not finite", "not finite"),
        (np.diag([1.0, 1.0, math.inf, 1.0]), "not finite", "not finite"),
        (SHEARED, "not a rotation", "rigid"),
        (MIRRORED, "not a rotation", "rigid"),
        (np.diag([1.05, 1.05, 1.05, 1.0]), "not a rotation", "rigid"),
        (np.diag([1.011, 1.011, 1.011, 1.0]), "not a rotation", "rigid"),
        (np.diag([0.989, 0.989, 0.989, 1.0]), "not a rotation", "rigid"),
        (np.diag([1.0, 1.0, 1.0, 2.0]), "not a rotation", "last row"),
        (PROJECTIVE, "not a rotation", "last row"),
        (np.zeros((4, 4)), "not a rotation", "rigid"),
    ],
)
def test_a_matrix_that_is_not_rigid_is_refused(matrix: npt.NDArray[np.float64], reason: str, text: str) -> None:
    with pytest.raises(InvalidTransformError, match=text) as caught:
        Transform.from_matrix(matrix)
    assert caught.value.reason == reason
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("bad", BAD_NUMBERS)
def test_the_other_constructors_refuse_what_is_not_finite(bad: float) -> None:
    with pytest.raises(InvalidTransformError, match="finite"):
        Transform.from_xyz_rpy((0, 0, 0), (0, bad, 0))
    with pytest.raises(InvalidTransformError, match="finite"):
        Transform.from_axis_angle((0, 0, 1), bad)
    with pytest.raises(InvalidTransformError, match="finite"):
        Transform.from_axis_angle((0, bad, 1), 1.0)
    with pytest.raises(InvalidTransformError, match="finite"):
        Transform.from_wxyz((0, 0, 0), (bad, 0, 0, 1))


def test_an_axis_without_a_direction_is_refused() -> None:
    with pytest.raises(InvalidTransformError) as caught:
        Transform.from_axis_angle((0, 0, 0), 1.0)
    assert caught.value.reason == "zero axis"


# Interpolation


@given(transforms(), transforms(), st.floats(0.0, 1.0))
def test_interpolation_moves_on_the_chord_and_turns_about_one_axis(a: Transform, b: Transform, fraction: float) -> None:
    assert_same(a.interpolate(b, 0.0), a)
    assert_same(a.interpolate(b, 1.0), b)
    t = a.interpolate(b, fraction)
    on_the_chord = [p + fraction * (q - p) for p, q in zip(a.translation, b.translation, strict=True)]
    assert math.dist(t.translation, on_the_chord) <= 1e-9
    turn = angle_between(a.rotation, b.rotation)
    assert angle_between(a.rotation, t.rotation) == pytest.approx(fraction * turn, abs=1e-7)
    assert angle_between(t.rotation, b.rotation) == pytest.approx((1.0 - fraction) * turn, abs=1e-7)
    assert math.hypot(*t.rotation) == pytest.approx(1.0, abs=1e-14)


@given(transforms(), transforms(), st.floats(0.0, 1.0))
def test_interpolation_is_the_same_whichever_sign_the_quaternions_have(
    a: Transform, b: Transform, fraction: float
) -> None:
    flipped = Transform(b.translation, [-part for part in b.rotation])
    assert_same(b.interpolate(flipped, fraction), b)
    # Half a turn has two shorter arcs.
    assume(abs(sum(p * q for p, q in zip(a.rotation, b.rotation, strict=True))) > 1e-15)
    assert_same(a.interpolate(flipped, fraction), a.interpolate(b, fraction))


@pytest.mark.parametrize("fraction", [-1e-12, 1.0 + 1e-12, math.nan, math.inf, -math.inf])
def test_a_fraction_outside_zero_to_one_is_refused(fraction: float) -> None:
    with pytest.raises(ValueError, match="from 0 to 1"):
        Transform.identity().interpolate(Transform((1, 0, 0)), fraction)


# Points


def test_one_point_comes_back_as_plain_floats() -> None:
    moved = Transform((1, 0, 0)).apply((np.float64(0.5), 2, 3))
    assert moved == (1.5, 2.0, 3.0)
    assert [type(part) for part in moved] == [float, float, float]


@given(transforms(), st.sampled_from(((3,), (0, 3), (1, 3), (5, 3), (2, 4, 3), (2, 0, 3))))
def test_an_array_of_points_is_moved_point_by_point(t: Transform, shape: tuple[int, ...]) -> None:
    points = np.linspace(-100.0, 100.0, math.prod(shape)).reshape(shape)
    moved = t.apply(points)
    assert moved.shape == shape
    expected = [t.apply((float(x), float(y), float(z))) for x, y, z in points.reshape(-1, 3)]
    np.testing.assert_allclose(moved.reshape(-1, 3), np.reshape(expected, (-1, 3)), rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("given_type", "returned"),
    [
        (np.float64, np.float64),
        (np.float32, np.float32),
        (np.int64, np.float64),
        (np.int32, np.float64),
        (np.uint8, np.float64),
    ],
)
def test_float32_stays_and_integers_become_float64(given_type: type[Any], returned: type[Any]) -> None:
    points = np.array([[1, 2, 3], [4, 5, 6]], dtype=given_type)
    moved = Transform((0.5, 0.0, 0.0), QUARTER_TURN_ABOUT_Z).apply(points)
    assert moved.dtype == returned
    np.testing.assert_allclose(moved, [[-1.5, 1.0, 3.0], [-4.5, 4.0, 6.0]], rtol=0, atol=1e-6)


def test_a_missing_point_stays_missing_and_spoils_no_other() -> None:
    moved = Transform((1, 0, 0)).apply(np.array([[math.nan] * 3, [1.0, 2.0, 3.0]]))
    assert np.isnan(moved[0]).all()
    np.testing.assert_array_equal(moved[1], (2.0, 2.0, 3.0))


@pytest.mark.parametrize("shape", [(), (0,), (2,), (4,), (3, 1), (3, 4), (2, 3, 2)])
def test_an_array_that_does_not_end_in_3_is_refused_with_its_shape(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"\(\.\.\., 3\), got " + str(shape).replace("(", r"\(").replace(")", r"\)")):
        Transform.identity().apply(np.zeros(shape))


@pytest.mark.parametrize("point", [(), (1.0, 2.0), (1.0, 2.0, 3.0, 1.0), [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]])
def test_a_sequence_that_is_not_a_point_is_refused_with_its_shape(point: Any) -> None:
    with pytest.raises(ValueError, match=rf"\({len(point)},\)"):
        Transform.identity().apply(point)
    with pytest.raises(ValueError, match=r"a point is three numbers, not .*; points go in an array"):
        Transform.identity().apply([[1.0, 2.0, 3.0]] * 3)  # type: ignore[list-item]


# Closeness


@given(tolerance=st.sampled_from((1e-12, 1e-9, 1e-3, 0.5)), a=transforms(10.0), axis=unit_vectors())
def test_close_means_within_the_tolerances_and_no_further(tolerance: float, a: Transform, axis: Vector) -> None:
    def close(b: Transform) -> bool:
        return a.is_close(b, translation_tolerance=tolerance, rotation_tolerance=tolerance)

    # Some room for rounding: the question is about the tolerance.
    inside, outside = 0.99 * tolerance - 1e-14, 1.01 * tolerance + 1e-14
    assert close(a @ Transform.from_axis_angle(axis, inside))
    assert not close(a @ Transform.from_axis_angle(axis, outside))
    assert close(shifted(a, axis, inside))
    assert not close(shifted(a, axis, outside))


def test_what_is_just_at_a_tolerance_is_close() -> None:
    shift, half_turn = Transform((3.0, 4.0, 12.0)), Transform(rotation=(0.0, 0.0, 1.0, 0.0))
    here = Transform()
    assert here.is_close(shift, translation_tolerance=13.0)
    assert not here.is_close(shift, translation_tolerance=math.nextafter(13.0, 0.0))
    assert here.is_close(half_turn, rotation_tolerance=math.pi)
    assert not here.is_close(half_turn, rotation_tolerance=math.nextafter(math.pi, 0.0))


def shifted(a: Transform, axis: Vector, distance: float) -> Transform:
    return Transform([p + distance * q for p, q in zip(a.translation, axis, strict=True)], a.rotation)


# Values


@given(transforms())
def test_a_transform_equals_its_twin_but_is_only_close_to_the_one_with_the_other_sign(a: Transform) -> None:
    twin = Transform(a.translation, a.rotation)
    assert twin == a
    assert hash(twin) == hash(a)
    assert eval(repr(a), {"Transform": Transform}) == a
    flipped = Transform(a.translation, [-part for part in a.rotation])
    assert a.is_close(flipped)
    assert flipped.is_close(a)
    assert a != flipped


def test_equality_is_exact() -> None:
    assert Transform((1, 2, 3)) == Transform(np.array([1, 2, 3]), [0, 0, 0, 1])
    assert Transform((0.0, 0.0, 0.0)) == Transform((-0.0, 0.0, 0.0))
    assert hash(Transform((0.0, 0.0, 0.0))) == hash(Transform((-0.0, 0.0, 0.0)))
    assert Transform((1, 2, 3)) != Transform((1, 2, math.nextafter(3, 4)))
    assert Transform() == Transform.identity()


@pytest.mark.parametrize("other", [2.0, None, (1.0, 2.0, 3.0), "map"])
def test_a_transform_composes_with_transforms_only(other: Any) -> None:
    with pytest.raises(TypeError):
        Transform() @ other
    with pytest.raises(TypeError):
        other @ Transform()


@pytest.mark.parametrize("name", ["translation", "rotation", "stamp"])
def test_a_transform_cannot_be_changed(name: str) -> None:
    t = Transform((1, 2, 3))
    with pytest.raises(AttributeError):
        setattr(t, name, (0.0, 0.0, 0.0))
    assert t == Transform((1, 2, 3))


def test_the_parts_are_tuples_of_plain_floats() -> None:
    t = Transform(np.array([1, 2, 3], np.float32), np.array([0, 0, 0, 1], np.int8))
    assert t.translation == (1.0, 2.0, 3.0)
    assert {type(part) for part in (*t.translation, *t.rotation, *t.as_wxyz(), *t.as_rpy())} == {float}
    for place in range(7):
        numbers = [float(number) for number in (1, 2, 3, 0, 0, 0, 1)]
        numbers[place] = int(numbers[place])
        mixed = Transform(tuple(numbers[:3]), tuple(numbers[3:]))
        assert mixed == t
        assert {type(part) for part in (*mixed.translation, *mixed.rotation)} == {float}


def test_a_transform_pickles_and_copies() -> None:
    t = Transform((1, 2, 3), QUARTER_TURN_ABOUT_Z)
    for protocol in range(2, pickle.HIGHEST_PROTOCOL + 1):
        assert pickle.loads(pickle.dumps(t, protocol)) == t
    assert copy.copy(t) == copy.deepcopy(t) == t


@given(transforms())
def test_a_transform_comes_back_from_json_to_the_last_bit(a: Transform) -> None:
    assert Transform.from_dict(json.loads(json.dumps(a.to_dict()))) == a


def test_the_plain_data_of_a_transform_are_two_lists() -> None:
    data = {"translation": [1.0, 2.0, 3.0], "rotation": [0.0, 0.0, 0.0, 1.0]}
    assert Transform((1, 2, 3)).to_dict() == data
    for wrong in ({"rotation": [0.0, 0.0, 1.0]}, {"rotation": [0.0] * 4}, {"translation": "123"}, {"stamp": 1}):
        with pytest.raises(ValueError, match=r"rotation|translation|stamp"):
            Transform.from_dict({**data, **wrong})


def row_of(transform: Transform) -> Row:
    return (*transform.translation, *transform.rotation)


def columns_of(rows: Sequence[Row]) -> Columns:
    x, y, z, qx, qy, qz, qw = np.array(rows).T
    return x, y, z, qx, qy, qz, qw


def rows_of(columns: Columns) -> list[Row]:
    return [(x, y, z, i, j, k, w) for x, y, z, i, j, k, w in np.array(columns).T.tolist()]


# Rows and columns


@given(st.lists(st.tuples(transforms(), transforms()), min_size=1, max_size=4))
def test_columns_compose_and_invert_to_the_bit_as_rows_do(both: list[tuple[Transform, Transform]]) -> None:
    left, right = [row_of(a) for a, _ in both], [row_of(b) for _, b in both]
    products = [compose(a, b) for a, b in zip(left, right, strict=True)]
    assert rows_of(compose(columns_of(left), columns_of(right))) == products
    assert rows_of(invert(columns_of(left))) == [invert(a) for a in left]


# Interpolation


def exact_slerp(a: Quaternion, b: Quaternion, bits: Sequence[bool]) -> list[Decimal]:
    """Slerp at a binary fraction in 50 digits: the middle of an arc is the normalised sum of its ends."""

    def unit(q: Sequence[Decimal]) -> list[Decimal]:
        norm = sum(part * part for part in q).sqrt()  # type: ignore[union-attr]
        return [part / norm for part in q]

    low, high = unit([Decimal(part) for part in a]), unit([Decimal(part) for part in b])
    if sum(p * q for p, q in zip(low, high, strict=True)) < 0:
        high = [-part for part in high]
    for bit in bits:
        middle = unit([p + q for p, q in zip(low, high, strict=True)])
        low, high = (middle, high) if bit else (low, middle)
    return low


@given(
    rotations(),
    unit_vectors(),
    st.one_of(
        st.floats(-9.0, math.log10(3.0)).map(lambda exponent: 10.0**exponent),
        st.floats(0.0, 3.0),
        st.floats(-9.0, -1.0).map(lambda exponent: math.pi - 10.0**exponent),
    ),
    st.booleans(),
    st.lists(st.booleans(), min_size=1, max_size=20),
)
def test_slerp_is_right_to_a_billionth_of_a_rad_at_every_angle(
    start: Quaternion, axis: Vector, angle: float, flipped: bool, bits: list[bool]
) -> None:
    a = Transform(rotation=start)
    b = a @ Transform.from_axis_angle(axis, angle)
    if flipped:
        b = Transform(rotation=[-part for part in b.rotation])
    fraction = sum(bit / 2.0**place for place, bit in enumerate(bits, 1))
    found = interpolate(row_of(a), row_of(b), fraction)[3:]
    with localcontext(prec=50):
        expected = exact_slerp(a.rotation, b.rotation, bits)
        chord = sum((Decimal(p) - q) ** 2 for p, q in zip(found, expected, strict=True)).sqrt()  # type: ignore[union-attr]
    assert 2.0 * float(chord) <= 1e-12


# Numbers that are checked


@pytest.mark.parametrize("norm", [0.9899, 1.0101, 1e-100, 0.5, 2.0, 1e200])
def test_a_norm_that_is_off_by_more_than_one_percent_is_refused(norm: float) -> None:
    with pytest.raises(InvalidTransformError, match=r"^turn .* is not a unit quaternion") as caught:
        as_rotation([part * norm for part in (0.5, -0.5, 0.5, 0.5)], "turn")
    assert caught.value.reason == "not a unit quaternion"


@given(rotations(), st.floats(0.9901, 1.0099))
def test_a_norm_within_one_percent_is_normalised_once_and_the_sign_stays(q: Quaternion, norm: float) -> None:
    unit = as_rotation([part * norm for part in q], "turn")
    assert unit == pytest.approx(q, rel=1e-15, abs=1e-15)
    assert as_rotation(unit, "turn") == unit


@pytest.mark.parametrize("bad", [None, 1.0, "123", b"123", {1, 2, 3}, ("1", "2", "3"), (None, 0, 0), (1j, 0, 0)])
def test_other_types_than_numbers_are_a_type_error(bad: Any) -> None:
    with pytest.raises(TypeError, match=r"^shift must be 3 numbers, not "):
        as_vector(bad, "shift")

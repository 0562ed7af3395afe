"""Each kind of joint against its closed form, in homogeneous matrices and Rodrigues' formula."""

import copy
import math
import pickle
from decimal import Decimal
from fractions import Fraction
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.strategies import angles, transforms, unit_vectors, vectors

from tfbus import InvalidRobotError, InvalidTransformError, Joint, Mimic, Transform
from tfbus.robot.model import KINDS
from tfbus.rows import Vector

Matrix = npt.NDArray[np.float64]

ORIGIN = Transform((1.0, 2.0, 3.0), (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)))
"""A quarter turn to the left, about z."""


def joint(kind: Any, axis: Any = (0.0, 0.0, 1.0), origin: Transform = ORIGIN, **more: Any) -> Joint:
    return Joint("elbow", kind, "upper_arm", "forearm", origin, axis, **more)


def turn(axis: Vector, angle: float) -> Matrix:
    """Rodrigues' formula, as a homogeneous matrix."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    matrix = np.eye(4)
    matrix[:3, :3] += math.sin(angle) * cross + (1.0 - math.cos(angle)) * (cross @ cross)
    return matrix


def shift(x: float, y: float, z: float) -> Matrix:
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def assert_close(actual: Transform, expected: Matrix) -> None:
    np.testing.assert_allclose(actual.matrix(), expected, rtol=0.0, atol=1e-11)
    assert math.fsum(part * part for part in actual.rotation) == pytest.approx(1.0, abs=2e-15)


@given(transforms(10.0), unit_vectors(), angles(), st.sampled_from(("revolute", "continuous")))
def test_a_revolute_joint_rotates_about_its_axis_in_the_childs_frame(
    origin: Transform, axis: Vector, angle: float, kind: str
) -> None:
    assert_close(joint(kind, axis, origin).transform(angle), origin.matrix() @ turn(axis, angle))


@given(transforms(10.0), unit_vectors(), st.floats(-10.0, 10.0))
def test_a_prismatic_joint_slides_along_its_axis_and_does_not_rotate(
    origin: Transform, axis: Vector, length: float
) -> None:
    x, y, z = axis
    moved = joint("prismatic", axis, origin).transform(length)
    assert_close(moved, origin.matrix() @ shift(length * x, length * y, length * z))
    assert moved.rotation == origin.rotation


@given(transforms(10.0), unit_vectors(), st.floats(-10.0, 10.0), st.floats(-10.0, 10.0), angles())
def test_a_planar_joint_stays_in_its_plane_and_rotates_about_the_normal(
    origin: Transform, axis: Vector, x: float, y: float, angle: float
) -> None:
    there = np.linalg.inv(origin.matrix()) @ joint("planar", axis, origin).transform((x, y, angle)).matrix()
    place = there[:3, 3]
    assert abs(place @ np.array(axis)) <= 1e-10
    assert np.linalg.norm(place) == pytest.approx(math.hypot(x, y), abs=1e-10)
    np.testing.assert_allclose(there[:3, :3], turn(axis, angle)[:3, :3], atol=1e-11)


@pytest.mark.parametrize(
    ("axis", "along_x", "along_y"),
    [
        ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
        ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)),
        ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)),
        ((0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (0.0, -1.0, 0.0)),
        # Just beside -z, to the side of x: about an axis along y, so half a turn takes x to -x.
        ((1e-9, 0.0, -1.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    ],
)
def test_the_x_and_y_of_a_plane_are_rotated_the_shortest_way_from_z_to_the_axis(
    axis: Vector, along_x: Vector, along_y: Vector
) -> None:
    flat = joint("planar", axis, Transform())
    assert flat.transform((2.0, 0.0, 0.0)).translation == pytest.approx([2.0 * part for part in along_x], abs=1e-8)
    assert flat.transform((0.0, 2.0, 0.0)).translation == pytest.approx([2.0 * part for part in along_y], abs=1e-8)


@pytest.mark.parametrize("tilt", [1e-12, 1e-9, 1e-8, 1e-6, 1e-3])
def test_a_plane_that_faces_almost_down_is_exact_too(tilt: float) -> None:
    axis = (math.sin(tilt), 0.0, -math.cos(tilt))
    x, y, z = joint("planar", axis, Transform()).transform((1.0, 0.0, 0.0)).translation
    assert (x, y, z) == pytest.approx((-math.cos(tilt), 0.0, -math.sin(tilt)), abs=1e-15)


@given(transforms(10.0), transforms(10.0))
def test_a_floating_joint_takes_seven_numbers_or_a_transform(origin: Transform, position: Transform) -> None:
    floating = joint("floating", origin=origin)
    assert_close(floating.transform(position), origin.matrix() @ position.matrix())
    assert floating.transform((*position.translation, *position.rotation)) == floating.transform(position)


@given(transforms())
def test_a_fixed_joint_ignores_its_position(origin: Transform) -> None:
    assert joint("fixed", origin=origin).transform() == origin
    assert joint("fixed", origin=origin).transform(math.nan) == origin


@given(vectors(1.0).filter(lambda axis: math.hypot(*axis) > 0.1), st.sampled_from((1e-200, 1e-9, 3.0, 1e100)))
def test_an_axis_of_any_length_is_normalised(axis: Vector, length: float) -> None:
    made = joint("prismatic", [length * part for part in axis], Transform())
    assert math.hypot(*made.axis) == pytest.approx(1.0, abs=1e-15)
    assert made.transform(2.0).translation == pytest.approx([2.0 * part / math.hypot(*axis) for part in axis])


@pytest.mark.parametrize("one", [1, np.float64(1.0), np.float32(1.0), np.int64(1), Fraction(2, 2)])
def test_a_position_may_be_any_real_number(one: Any) -> None:
    found = joint("revolute").row(one)
    assert found == joint("revolute").row(1.0)
    assert {type(part) for part in found} == {float}


@pytest.mark.parametrize(
    ("kind", "position", "reason"),
    [
        ("revolute", math.nan, "not finite"),
        ("prismatic", -math.inf, "not finite"),
        ("prismatic", 10**400, "not finite"),
        ("planar", (0.0, math.nan, 0.0), "not finite"),
        ("planar", (0.0, 0.0), "wrong length"),
        ("floating", (0.0,) * 6, "wrong length"),
        ("floating", (0.0,) * 7, "zero quaternion"),
        ("floating", (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2.0), "not a unit quaternion"),
        ("floating", (math.nan, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), "not finite"),
        ("floating", Transform((1.7e308, 1.7e308, 0.0)), "not finite"),
        ("planar", (1.7e308, 1.7e308, 0.0), "not finite"),
    ],
)
def test_an_invalid_position_is_refused_with_the_name_of_the_joint(kind: Any, position: Any, reason: str) -> None:
    with pytest.raises(InvalidTransformError, match=r"^joint 'elbow': ") as caught:
        joint(kind).transform(position)
    assert (caught.value.reason, caught.value.parent, caught.value.child) == (reason, "upper_arm", "forearm")


WRONG = [(kind, each) for kind in KINDS[1:] for each in ("1.0", None, Decimal(1), [object()] * 3, ["a"] * 7, object())]


@pytest.mark.parametrize(("kind", "position"), [*WRONG, ("planar", 1.0), ("floating", 1), ("revolute", (1,))])
def test_a_position_of_a_wrong_type_is_refused_with_the_name_of_the_joint(kind: Any, position: Any) -> None:
    with pytest.raises((TypeError, InvalidTransformError), match=r"^joint 'elbow': position must be "):
        joint(kind).transform(position)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"kind": "ball"}, "type 'ball' is none of fixed, revolute, continuous, prismatic, planar, floating"),
        ({"axis": (0.0, 0.0, 0.0)}, "axis (0.0, 0.0, 0.0) has no direction"),
        ({"axis": (0.0, math.nan, 1.0)}, "axis (0.0, nan, 1.0) is not finite"),
        ({"axis": (0.0, 1.0)}, "axis must be 3 numbers, got shape (2,)"),
        ({"lower": math.nan}, "a limit or the mimic is NaN"),
        ({"mimic": Mimic("other", math.nan)}, "a limit or the mimic is NaN"),
        ({"mimic": Mimic("other", 1.0, math.nan)}, "a limit or the mimic is NaN"),
    ],
)
def test_an_invalid_joint_is_refused_with_its_name(change: dict[str, Any], problem: str) -> None:
    with pytest.raises(InvalidRobotError) as caught:
        joint(**{"kind": "revolute", **change})
    assert str(caught.value) == f'in <joint name="elbow">: {problem}'
    assert caught.value.element == '<joint name="elbow">'


@pytest.mark.parametrize("kind", ["fixed", "floating"])
def test_a_fixed_or_floating_joint_ignores_its_axis(kind: Any) -> None:
    assert joint(kind, (0.0, 0.0, 0.0)) == joint(kind, (0.0, 0.0, 1.0))


def test_the_element_of_a_joint_is_one_line_whatever_its_name() -> None:
    assert Joint("küche\x9b", "fixed", "a", "b").element == '<joint name="küche\\x9b">'
    assert Joint('a "b"\nc', "fixed", "a", "b").element == '<joint name="a \\"b\\"\\nc">'


def test_a_joint_is_a_value() -> None:
    made = joint("revolute", lower=-1.0, upper=1.0, mimic=Mimic("shoulder", 2.0))
    for twin in (copy.deepcopy(made), pickle.loads(pickle.dumps(made))):
        assert (twin, hash(twin)) == (made, hash(made))
        assert twin.transform(0.3) == made.transform(0.3)
    assert joint("revolute") != made
    assert eval(repr(made)) == made
    assert repr(made).endswith("lower=-1.0, upper=1.0, mimic=Mimic(joint='shoulder', multiplier=2.0, offset=0.0))")

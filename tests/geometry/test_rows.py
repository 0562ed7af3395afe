import math
from collections.abc import Sequence
from decimal import Decimal, localcontext
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.strategies import rotations, transforms, unit_vectors, vectors
from transforms3d import quaternions

from tfbus import InvalidTransformError, Transform
from tfbus.rows import (
    Columns,
    Quaternion,
    Row,
    Vector,
    as_floats,
    as_rotation,
    as_vector,
    compose,
    interpolate,
    invert,
    rotate,
)

HALF = math.sqrt(0.5)
NOT_FINITE = (math.nan, math.inf, -math.inf)


def row_of(transform: Transform) -> Row:
    return (*transform.translation, *transform.rotation)


def columns_of(rows: Sequence[Row]) -> Columns:
    x, y, z, qx, qy, qz, qw = np.array(rows).T
    return x, y, z, qx, qy, qz, qw


def rows_of(columns: Columns) -> list[Row]:
    return [(x, y, z, i, j, k, w) for x, y, z, i, j, k, w in np.array(columns).T.tolist()]


# Composition and inversion: tests/geometry/test_transform.py has the laws, in transforms


@given(rotations(), vectors())
def test_a_vector_is_rotated_by_the_matrix_of_its_quaternion(turn: Quaternion, vector: Vector) -> None:
    x, y, z, w = turn
    expected = quaternions.quat2mat((w, x, y, z)) @ vector
    np.testing.assert_allclose(rotate(turn, *vector), expected, rtol=0, atol=1e-9)


@given(st.lists(st.tuples(transforms(), transforms()), min_size=1, max_size=4))
def test_columns_compose_and_invert_to_the_bit_as_rows_do(both: list[tuple[Transform, Transform]]) -> None:
    left, right = [row_of(a) for a, _ in both], [row_of(b) for _, b in both]
    products = [compose(a, b) for a, b in zip(left, right, strict=True)]
    assert rows_of(compose(columns_of(left), columns_of(right))) == products
    assert rows_of(invert(columns_of(left))) == [invert(a) for a in left]


@given(transforms(), st.lists(transforms(), min_size=1, max_size=4))
def test_a_row_composes_with_columns_from_either_side(one: Transform, many: list[Transform]) -> None:
    row, rows = row_of(one), [row_of(other) for other in many]
    assert rows_of(compose(row, columns_of(rows))) == [compose(row, other) for other in rows]
    assert rows_of(compose(columns_of(rows), row)) == [compose(other, row) for other in rows]


@given(st.lists(st.tuples(rotations(), vectors()), min_size=1, max_size=4))
def test_columns_of_vectors_are_rotated_to_the_bit_as_each(both: list[tuple[Quaternion, Vector]]) -> None:
    turns, points = np.array([turn for turn, _ in both]).T, np.array([point for _, point in both]).T
    found = np.array(rotate((*turns,), *points)).T.tolist()
    assert found == [list(rotate(turn, *point)) for turn, point in both]


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


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_for_half_a_turn_the_sign_of_the_second_quaternion_decides_the_direction(sign: float) -> None:
    origin: Vector = (0.0, 0.0, 0.0)
    middle = interpolate((*origin, 0.0, 0.0, 0.0, 1.0), (*origin, sign, 0.0, 0.0, 0.0), 0.5)
    assert middle[3:] == pytest.approx((sign * HALF, 0.0, 0.0, HALF), abs=1e-15)


def test_translations_are_interpolated_along_the_chord() -> None:
    start: Row = (1.0, -2.0, 4.0, 0.0, 0.0, 0.0, 1.0)
    end: Row = (5.0, 2.0, -4.0, 0.0, 0.0, 0.0, 1.0)
    assert interpolate(start, end, 0.25) == (2.0, -1.0, 2.0, 0.0, 0.0, 0.0, 1.0)


# Numbers that are checked


@pytest.mark.parametrize("bad", [*NOT_FINITE, 10**400])
@pytest.mark.parametrize("at", range(3))
def test_a_number_that_is_not_finite_is_refused_wherever_it_stands(at: int, bad: float) -> None:
    numbers = [0.0, 0.0, 0.0]
    numbers[at] = bad
    with pytest.raises(InvalidTransformError, match=r"^shift .* is not finite$") as caught:
        as_vector(numbers, "shift")
    assert caught.value.reason == "not finite"


@pytest.mark.parametrize("tiny", [0, 0.0, -0.0, 5e-324, 1e-200])
def test_the_zero_quaternion_is_refused(tiny: float) -> None:
    with pytest.raises(InvalidTransformError, match=r"^turn is the zero quaternion$") as caught:
        as_rotation((0, 0, tiny, 0), "turn")
    assert caught.value.reason == "zero quaternion"


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


@pytest.mark.parametrize(
    ("numbers", "length", "shape"),
    [
        ((1, 2), 3, r"\(2,\)"),
        ((1, 2, 3, 4), 3, r"\(4,\)"),
        ((), 3, r"\(0,\)"),
        ((0, 0, 1), 4, r"\(3,\)"),
        (np.zeros((3, 1)), 3, r"\(3, 1\)"),
        (np.eye(4), 4, r"\(4, 4\)"),
        (np.zeros((2, 3)), 3, r"\(2, 3\)"),
    ],
)
def test_another_number_of_numbers_is_refused_with_the_shape(numbers: Any, length: int, shape: str) -> None:
    with pytest.raises(InvalidTransformError, match=rf"^shift must be {length} numbers, got shape {shape}$") as caught:
        as_floats(numbers, length, "shift")
    assert caught.value.reason == "wrong length"


@pytest.mark.parametrize("bad", [None, 1.0, "123", b"123", {1, 2, 3}, ("1", "2", "3"), (None, 0, 0), (1j, 0, 0)])
def test_other_types_than_numbers_are_a_type_error(bad: Any) -> None:
    with pytest.raises(TypeError, match=r"^shift must be 3 numbers, not "):
        as_vector(bad, "shift")


def test_numbers_become_plain_floats() -> None:
    for numbers in ([1, 2, 3], np.array([1, 2, 3], np.int8), (np.float32(1), 2, 3.0)):
        vector = as_vector(numbers, "shift")
        assert vector == (1.0, 2.0, 3.0)
        assert {type(part) for part in vector} == {float}

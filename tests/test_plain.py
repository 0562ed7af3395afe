"""Plain data of dataclasses, numbers and arrays, and printable text."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tfbus import LATEST, Latest
from tfbus.plain import PlainData, from_plain, printable, to_plain


@dataclass(frozen=True, slots=True)
class Inner(PlainData):
    count: int


@dataclass(frozen=True, slots=True)
class Outer(PlainData):
    name: str
    at: int | Latest
    share: float
    maybe: str | None
    flag: bool
    parts: tuple[Inner, ...]
    pair: tuple[str, int]
    counts: Mapping[str, int]
    error: Exception = field(compare=False)


WHOLE = Outer("a", LATEST, 0.5, None, True, (Inner(1), Inner(2)), ("x", 3), {"b": 4}, KeyError("k"))
PLAIN = {
    "type": "Outer",
    "name": "a",
    "at": "LATEST",
    "share": 0.5,
    "maybe": None,
    "flag": True,
    "parts": [{"type": "Inner", "count": 1}, {"type": "Inner", "count": 2}],
    "pair": ["x", 3],
    "counts": {"b": 4},
    "error": {"type": "KeyError", "message": "'k'"},
}


def test_a_dataclass_becomes_its_fields_and_comes_back() -> None:
    assert WHOLE.to_dict() == PLAIN
    back = Outer.from_dict(json.loads(json.dumps(PLAIN)))
    assert back == WHOLE
    assert repr(back.error) == """Exception("KeyError: 'k'")"""


@dataclass(frozen=True, slots=True)
class Mixed(PlainData):
    number: float | int
    word: float | str | None
    at: str | Latest
    vector: tuple[float, float]


def test_the_first_alternative_that_can_be_read_holds() -> None:
    read = Mixed.from_dict({"number": 1, "word": "NaN", "at": "LATEST", "vector": [1, 2.5]})
    assert [type(part) for part in (read.number, *read.vector)] == [float] * 3
    assert isinstance(read.word, float)
    assert math.isnan(read.word)
    assert read.at == "LATEST"
    assert Mixed.from_dict({"number": 1.5, "word": "far", "at": "x", "vector": [1.5, 2.5]}).word == "far"
    with pytest.raises(ValueError, match=r"Mixed.vector\[1\]"):
        Mixed.from_dict({"number": 1, "word": None, "at": "x", "vector": [1.0, True]})


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"type": "Inner"}, "a Outer cannot be made of the data of a 'Inner'"),
        ({"name": 5}, "Outer.name cannot be 5"),
        ({"at": "latest"}, "Outer.at cannot be 'latest'"),
        ({"at": True}, "Outer.at cannot be True"),
        ({"share": "0.5"}, "Outer.share cannot be '0.5'"),
        ({"share": 10**400}, "an integer of 1329 bits is too large for a float"),
        ({"flag": 1}, "Outer.flag cannot be 1"),
        ({"parts": {}}, "Outer.parts cannot be {}"),
        ({"parts": [5]}, r"Outer.parts\[0\] cannot be 5"),
        ({"parts": [{"count": 1}, {"count": "1"}]}, r"Outer.parts\[1\] .*Inner.count cannot be '1'"),
        ({"pair": ["x", 1, 2]}, "Outer.pair cannot be"),
        ({"counts": {1: 1}}, "Outer.counts cannot be"),
        ({"counts": {"b": "c"}}, r"Outer.counts\['b'\] cannot be 'c'"),
        ({"error": "KeyError"}, "Outer.error cannot be"),
        ({"more": 1}, "Outer has no field 'more'"),
    ],
)
def test_wrong_fields_are_refused_by_name(changes: dict[str, Any], problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        Outer.from_dict({**PLAIN, **changes})


def test_a_missing_field_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match="Inner needs the field 'count'"):
        Inner.from_dict({})


@pytest.mark.parametrize("data", [None, 5, "Inner", [1]])
def test_a_dataclass_is_made_of_a_mapping_only(data: Any) -> None:
    with pytest.raises(ValueError, match="a Inner is a dict of its fields, not"):
        Inner.from_dict(data)


@given(st.floats())
def test_a_float_comes_back_to_the_last_bit_and_is_json(value: float) -> None:
    text = json.dumps(to_plain(value), allow_nan=False)
    back = from_plain(float, json.loads(text), "value")
    assert math.isnan(back) if math.isnan(value) else (back, math.copysign(1, back)) == (value, math.copysign(1, value))


@pytest.mark.parametrize("value", [np.int64(5), np.float32(0.5)])
def test_numbers_of_numpy_become_plain_numbers(value: Any) -> None:
    assert type(to_plain(value)) in (int, float)
    assert to_plain(value) == value


@pytest.mark.parametrize(
    "array",
    [
        np.array([[1.5, math.nan, math.inf], [-math.inf, -0.0, 1e-300]]),
        np.array([[0.1, 0.2, 0.3]], np.float32),
        np.zeros((0, 3), np.float32),
        np.array([2**63 - 1, -(2**63)]),
        np.array([255, 0], np.uint8),
        np.array([True, False]),
    ],
)
def test_an_array_comes_back_with_its_dtype_and_shape(array: npt.NDArray[Any]) -> None:
    data = json.loads(json.dumps(to_plain(array), allow_nan=False))
    back = from_plain(npt.NDArray[Any], data, "array")
    assert (back.dtype, back.shape) == (array.dtype, array.shape)
    np.testing.assert_array_equal(back, array)


@pytest.mark.parametrize(
    "data",
    [
        [1, 2],
        {"dtype": "float64", "shape": [2]},
        {"dtype": "float64", "shape": [2], "values": [1.0, 2.0], "more": 1},
        {"dtype": "object", "shape": [1], "values": [1]},
        {"dtype": "no such", "shape": [1], "values": [1]},
        {"dtype": "float64", "shape": [3], "values": [1.0, 2.0]},
        {"dtype": "float64", "shape": "x", "values": [1.0]},
        {"dtype": "float64", "shape": [1], "values": 5},
        {"dtype": "float64", "shape": [1], "values": ["1.0"]},
        {"dtype": "int64", "shape": [1], "values": [1.5]},
        {"dtype": "uint8", "shape": [1], "values": [256]},
        {"dtype": "bool", "shape": [1], "values": [1]},
    ],
)
def test_wrong_data_of_an_array_are_refused(data: Any) -> None:
    with pytest.raises(ValueError, match=r"^array "):
        from_plain(npt.NDArray[Any], data, "array")


def test_a_value_without_plain_data_is_a_type_error() -> None:
    with pytest.raises(TypeError, match="no plain data for <object"):
        to_plain(object())


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("base_link", "base_link"),
        ("雷达 é", "雷达 é"),
        ("\x1b[2J", "\\x1b[2J"),
        ("a\nb\r\x07", "a\\nb\\r\\x07"),
        # This character would reverse the direction of the text.
        ("\u202egpj", "\\u202egpj"),
    ],
)
def test_letters_of_any_alphabet_stay_and_control_characters_are_escaped(text: str, shown: str) -> None:
    assert printable(text) == shown


@given(st.text())
def test_a_printable_text_is_one_line_stays_as_it_is_and_has_the_escapes_of_repr(text: str) -> None:
    shown = printable(text)
    assert shown.isprintable()
    assert printable(shown) == shown
    assert shown.replace("\\", "").replace("'", "") == repr(text)[1:-1].replace("\\", "").replace("'", "")

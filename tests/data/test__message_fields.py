from array import array
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tfbus.data.messages import filled, get, has, numbers


@pytest.mark.parametrize("message", [{"a": {"b": 5}}, SimpleNamespace(a=SimpleNamespace(b=5))])
def test_fields_are_keys_or_attributes(message: Any) -> None:
    assert (has(message, "a"), has(message, "b"), get(message, "a", "b")) == (True, False, 5)
    assert numbers(get(message, "a"), ("b",)) == (5.0,)
    with pytest.raises(TypeError, match=r"no field 'a\.c'"):
        get(message, "a", "c")


def test_a_copy_has_new_values_in_the_kinds_of_the_old_ones() -> None:
    values = np.array([[1.0, 2.0]])
    like = {"a": array("f"), "n": np.zeros(1, np.float32), "l": [], "b": b"", "c": array("B"), "u": np.zeros(1, "u1")}
    made = filled(like, {"a": values, "n": values, "l": values, "b": b"xy", "c": b"xy", "u": b"xy"})
    assert (made["a"], made["l"], made["b"], made["c"]) == (array("f", [1, 2]), [1.0, 2.0], b"xy", array("B", b"xy"))
    assert (made["n"].tolist(), made["n"].dtype, made["u"].tolist()) == ([1.0, 2.0], np.float32, [120, 121])
    assert like["l"] == []
    with pytest.raises(TypeError, match="'z'"):
        filled(like, {"z": 1})

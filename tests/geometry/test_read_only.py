from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from tfbus.geometry.transform_array import locked, read_only

Array = npt.NDArray[Any]
LAYOUTS: list[Any] = [
    pytest.param(lambda array: array, id="rows"),
    pytest.param(np.asfortranarray, id="columns"),
    pytest.param(lambda array: array[::2, ::-1], id="strided"),
    pytest.param(lambda array: array[:, [2, 0]], id="taken"),
    pytest.param(lambda array: array[:0], id="empty"),
]


def test_a_view_is_read_only_and_its_owner_may_still_write() -> None:
    mine = np.zeros(3)
    held = read_only(mine)
    with pytest.raises(ValueError, match="read-only"):
        held[0] = 1.0
    mine[0] = 1.0
    assert held.tolist() == [1.0, 0.0, 0.0]
    assert read_only(held) is held


@pytest.mark.parametrize("laid_out", LAYOUTS)
@pytest.mark.parametrize("dtype", ["f2", "f4", "f8", ">f4", "g", "i8"])
def test_a_locked_array_has_the_same_numbers_and_no_view_of_it_becomes_writable(
    laid_out: Callable[[Array], Array], dtype: str
) -> None:
    array = laid_out(np.arange(12).reshape(4, 3).astype(dtype))
    held = locked(array)
    assert held.dtype == array.dtype
    np.testing.assert_array_equal(held, array, strict=True)
    for part in (held, held.T, held[:1], held[:, 0]):
        with pytest.raises(ValueError, match="WRITEABLE"):
            part.flags.writeable = True
        with pytest.raises(ValueError, match="read-only"):
            part[...] = 0

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.both_kernels import COMPILED, needs_both
from support.histories import row_of
from support.strategies import transforms

from tfbus import _python_kernel
from tfbus.rows import Row, compose

COMPOSERS = [
    pytest.param(_python_kernel.compose_paths, id="python"),
    pytest.param(getattr(COMPILED, "compose_paths", None), id="compiled", marks=needs_both),
]


@pytest.mark.parametrize("compose_paths", COMPOSERS)
@given(st.lists(st.tuples(transforms(10.0).map(row_of), st.integers(0, 100)), min_size=1, max_size=12))
def test_composed_paths_are_bit_for_bit_the_products_of_their_rows(
    compose_paths: Any, drawn: list[tuple[Row, int]]
) -> None:
    origins = [number % max(place, 1) for place, (_, number) in enumerate(drawn)]
    expected: list[Row] = []
    for (row, _), origin in zip(drawn, origins, strict=True):
        expected.append(compose(expected[origin], row) if origin else row)
    rows = np.array([row for row, _ in drawn]).reshape(-1, 7)
    compose_paths(rows, np.array(origins, np.int64))
    assert rows.tobytes() == np.array(expected).tobytes()


@pytest.mark.parametrize("compose_paths", COMPOSERS)
@pytest.mark.parametrize("origins", [[0, 0, 0], [0, 1], [1, 0], [0, -1]], ids=str)
def test_an_origin_comes_before_its_row(compose_paths: Any, origins: list[int]) -> None:
    with pytest.raises(ValueError, match="needs an origin before it"):
        compose_paths(np.zeros((2, 7)), np.array(origins))

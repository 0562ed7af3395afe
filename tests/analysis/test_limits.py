from dataclasses import fields
from typing import Any

import pytest

from tfbus.analysis import Limits


@pytest.mark.parametrize("name", [field.name for field in fields(Limits)])
@pytest.mark.parametrize(
    ("value", "error"), [(0.0, ValueError), (-1.0, ValueError), ("1", TypeError), (True, TypeError)]
)
def test_a_limit_is_a_number_greater_than_zero(name: str, value: Any, error: type[Exception]) -> None:
    with pytest.raises(error, match=name):
        Limits(**{name: value})

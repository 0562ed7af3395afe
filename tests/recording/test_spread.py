import pytest

from tfbus.recording import Spread


def test_a_spread_is_plain_data() -> None:
    spread = Spread(1.0, 2.0, 3.0)
    assert spread == Spread(1.0, 2.0, 3.0)
    with pytest.raises(AttributeError):
        spread.mean = 2.0  # type: ignore[misc]

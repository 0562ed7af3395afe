import pytest
from support.samples import moving, static

from tfbus import SECOND
from tfbus.analysis.arrivals import Delays


def test_the_delay_is_the_time_from_the_stamp_to_the_arrival() -> None:
    delays = Delays()
    delays.note((moving("map", "base", 4 * SECOND), moving("map", "arm", 6 * SECOND)), 5 * SECOND)
    assert delays.by_frame == {"base": 1.0, "arm": -1.0}


def test_the_mean_follows_the_newest_samples() -> None:
    delays = Delays()
    delays.note((moving("map", "base", 0),), 0)
    for number in range(1, 101):
        delays.note((moving("map", "base", number * SECOND),), number * SECOND + SECOND // 2)
        # An exponential mean: what is left of the first value shrinks by a tenth with each sample.
        assert delays.by_frame["base"] == pytest.approx(0.5 * (1.0 - 0.9**number))


def test_a_static_frame_has_no_delay_and_a_removed_one_none_any_more() -> None:
    delays = Delays()
    delays.note((moving("map", "base", 0), moving("map", "arm", 0), static("map", "lidar")), SECOND)
    delays.note((static("map", "base"),), SECOND)
    assert delays.by_frame == {"arm": 1.0}
    delays.forget("arm")
    delays.forget("nobody")
    assert delays.by_frame == {}

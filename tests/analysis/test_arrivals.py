import pytest
from support.samples import moving, static

from tfbus import SECOND
from tfbus.analysis.arrivals import MAX_SAMPLES, Arrivals

MS = SECOND // 1_000


def test_each_frame_and_sender_is_measured_over_the_window() -> None:
    arrivals = Arrivals(1.0)
    # 100 Hz for 2 s, 5 ms late; every tenth one of the second 20 ms more.
    for tick in range(200):
        delay = 25 if tick > 100 and tick % 10 == 0 else 5
        stamp = tick * 10 * MS
        arrivals.note((moving("map", "base", stamp, authority="odometry"),), stamp + delay * MS)
    arrivals.note((moving("map", "base", 0, authority="other"), static("base", "lidar")), 1_995 * MS)
    base, other, lidar = arrivals.measure(1_995 * MS)
    assert (base.frame, base.parent, base.authority, base.static) == ("base", "map", "odometry", False)
    # The arrivals of 995 ms to 1,995 ms: ticks 99 to 199, of which the one of 100 was not delayed.
    assert base.samples == 101
    assert base.rate == pytest.approx(100.0)
    assert base.delay_mean == pytest.approx((101 * 5 + 9 * 20) / 101e3)
    assert (base.delay_p99, base.delay_max, base.delay_min) == (0.025, 0.025, 0.005)
    assert base.longest_gap == pytest.approx(0.03)
    # 82 periods of 10 ms, and 9 each of 30 ms and of -10 ms.
    assert base.jitter == pytest.approx(0.02 * 0.18**0.5, rel=1e-9)
    assert (base.late, base.lost) == (0, 0)
    assert (other.authority, other.samples, other.rate, other.jitter) == ("other", 1, None, None)
    assert (lidar.static, lidar.samples, lidar.delay_mean, lidar.longest_gap) == (True, 0, None, None)


def test_late_and_missing_samples_are_counted() -> None:
    arrivals = Arrivals(10.0)
    for arrival, tick in enumerate((0, 1, 2, 4, 3, 5, 9, 10)):
        arrivals.note((moving("map", "base", tick * 10 * MS),), arrival * 10 * MS)
    (base,) = arrivals.measure(SECOND)
    # 3 came after 4; 6, 7 and 8 did not come.
    assert (base.late, base.lost) == (1, 3)
    assert base.longest_gap == pytest.approx(0.93)


def test_of_three_samples_one_may_be_missing() -> None:
    arrivals = Arrivals(10.0)
    for stamp in (0, 10, 40):
        arrivals.note((moving("map", "base", stamp * MS),), stamp * MS)
    # The usual period is that in the middle of the two, 25 ms.
    assert [base.lost for base in arrivals.measure(SECOND)] == [1]


def test_the_time_from_a_stamp_that_is_ahead_is_negative_and_a_single_arrival_has_no_rate() -> None:
    arrivals = Arrivals(10.0)
    arrivals.note((moving("map", "base", 2 * SECOND), moving("map", "base", 3 * SECOND)), SECOND)
    (base,) = arrivals.measure(SECOND)
    assert (base.delay_mean, base.delay_max, base.rate, base.lost) == (-1.5, -1.0, None, 0)


def test_a_silent_frame_stays_without_a_rate_and_a_removed_one_goes() -> None:
    arrivals = Arrivals(1.0)
    arrivals.note((moving("map", "base", 0), moving("map", "arm", 0)), 0)
    arrivals.forget("arm")
    (base,) = arrivals.measure(SECOND)
    assert base.samples == 1
    (base,) = arrivals.measure(SECOND + 1)
    assert (base.frame, base.samples, base.rate, base.longest_gap) == ("base", 0, None, None)


def test_the_memory_of_a_frame_is_bounded() -> None:
    arrivals = Arrivals(1e9)
    arrivals.note((moving("map", "base", 0),) * (MAX_SAMPLES + 10), 0)
    assert arrivals.measure(0)[0].samples == MAX_SAMPLES

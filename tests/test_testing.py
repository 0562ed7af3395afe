"""Simulated time for tests, transforms that are nearly equal, and registrations."""

import anyio
import pytest

from tfbus import ClockResetError, Registration, SimulatedClock, Transform, TransformStamped, from_seconds
from tfbus.testing import assert_close, simulate

pytestmark = pytest.mark.anyio


@pytest.mark.every_loop
async def test_simulate_lets_time_pass_until_the_function_has_ended(clock: SimulatedClock) -> None:
    async def nap() -> str:
        await clock.sleep(12.5)
        return "rested"

    assert await simulate(clock, nap) == "rested"
    assert clock.now() == from_seconds(12.5)


async def test_simulate_raises_what_the_function_raises_without_a_group() -> None:
    clock = SimulatedClock(start=10)

    async def fail() -> None:
        await clock.sleep(1.0)
        clock.set(0)
        raise ClockResetError(before=10, after=0)

    with pytest.raises(ClockResetError):
        await simulate(clock, fail)


async def test_simulate_raises_timeout_error_at_the_limit() -> None:
    with pytest.raises(TimeoutError, match="not finished after 60 simulated s"):
        await simulate(SimulatedClock(), lambda: anyio.Event().wait(), limit=60.0)


async def test_simulate_can_be_cancelled_from_outside(clock: SimulatedClock) -> None:
    async def cancel_from_inside() -> None:
        scope.cancel()
        await anyio.sleep_forever()

    with anyio.CancelScope() as scope:
        await simulate(clock, cancel_from_inside)
    assert scope.cancelled_caught


async def test_assert_close_takes_transforms_and_samples_up_to_the_sign_of_the_rotation() -> None:
    turned = Transform((1.0, 0.0, 0.0), (0.6, 0.0, 0.0, 0.8))
    assert_close(turned, Transform((1.0, 0.0, 0.0), (-0.6, 0.0, 0.0, -0.8)))
    assert_close(TransformStamped("a", "b", 0, turned), TransformStamped("c", "d", 5, turned))


async def test_assert_close_says_how_far_apart_they_are() -> None:
    with pytest.raises(AssertionError, match=r"is 3 m and 0\.5 rad from .*allowed: 0\.1 m, 1e-09 rad"):
        assert_close(Transform(), Transform.from_axis_angle((0, 0, 1), 0.5, (0.0, 3.0, 0.0)), translation_tolerance=0.1)


def test_a_registration_is_undone_once_also_after_an_error_and_if_it_is_closed_again() -> None:
    undone: list[str] = []

    def undo() -> None:
        undone.append("undone")
        registration.close()

    registration = Registration(undo)
    with pytest.raises(KeyError), registration:
        assert undone == []
        raise KeyError
    registration.close()
    assert undone == ["undone"]


def test_a_failed_undo_is_not_repeated() -> None:
    registration = Registration([].pop)
    with pytest.raises(IndexError):
        registration.close()
    registration.close()

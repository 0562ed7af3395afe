"""Helpers for the tests of programs that use tfbus: simulated time, and the comparison of transforms."""

from collections.abc import Awaitable, Callable
from typing import TypeVar

import anyio

from tfbus.clock import SimulatedClock
from tfbus.geometry.stamped import TransformStamped
from tfbus.geometry.transform import Transform

T = TypeVar("T")


async def simulate(clock: SimulatedClock, function: Callable[[], Awaitable[T]], *, limit: float = 3600.0) -> T:
    """Run an async function while simulated time passes as fast as possible.

    Parameters
    ----------
    clock : SimulatedClock
        Advanced until the function has ended; nothing else may advance it meanwhile.
    function : async callable
        Without arguments; use `functools.partial` to pass some.
    limit : float
        The greatest duration in simulated s.

    Returns
    -------
    The result of the function. An exception of the function is raised unchanged, without an `ExceptionGroup`.

    Raises
    ------
    TimeoutError
        If the function has not ended after `limit`, usually because it waits for data that are never sent.

    Examples
    --------
    >>> from tfbus.testing import simulate
    >>> clock = SimulatedClock()
    >>> async def hour() -> int:
    ...     await clock.sleep(3600.0)
    ...     return clock.now()
    >>> await simulate(clock, hour, limit=7200.0)
    3600000000000
    """
    result: list[T] = []
    error: list[Exception] = []
    async with anyio.create_task_group() as tasks:

        async def call() -> None:
            try:
                result.append(await function())
            except Exception as raised:  # noqa: BLE001 - it is raised again outside the task group
                error.append(raised)
            tasks.cancel_scope.cancel()

        tasks.start_soon(call)
        await clock.advance(limit)
        tasks.cancel_scope.cancel()
    if error:
        raise error[0]
    if not result:
        raise TimeoutError(f"not finished after {limit:g} simulated s")
    return result[0]


def assert_close(
    actual: Transform | TransformStamped,
    expected: Transform | TransformStamped,
    *,
    translation_tolerance: float = 1e-9,
    rotation_tolerance: float = 1e-9,
) -> None:
    """Assert that two transforms are close; the `AssertionError` has their distance and angle.

    Parameters
    ----------
    actual, expected : Transform or TransformStamped
        For samples, only the transforms are compared.
    translation_tolerance : float
        Greatest distance in m.
    rotation_tolerance : float
        Greatest angle in rad.

    Examples
    --------
    >>> from tfbus.testing import assert_close
    >>> assert_close(Transform((1.0, 0.0, 0.0)), Transform((1.0 + 1e-12, 0.0, 0.0)))
    """
    left = actual.transform if isinstance(actual, TransformStamped) else actual
    right = expected.transform if isinstance(expected, TransformStamped) else expected
    if left.is_close(right, translation_tolerance=translation_tolerance, rotation_tolerance=rotation_tolerance):
        return
    apart = left.inverse() @ right
    distance = sum(part * part for part in apart.translation) ** 0.5
    raise AssertionError(
        f"{left} is {distance:.3g} m and {apart.as_axis_angle()[1]:.3g} rad from {right} "
        f"(allowed: {translation_tolerance:g} m, {rotation_tolerance:g} rad)"
    )

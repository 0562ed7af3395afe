"""Publishing static frames until Ctrl-C, whatever edges other programs publish."""

from collections.abc import Sequence

import anyio
from anyio.abc import TaskStatus

from tfbus.bus.bus import Bus
from tfbus.cli.output import warn
from tfbus.errors import InvalidTransformError
from tfbus.geometry.stamped import TransformStamped

RETRY = 1.0
"""The time between two attempts, in s."""


async def publish_static(
    bus: Bus, samples: Sequence[TransformStamped], *, task_status: TaskStatus[None] = anyio.TASK_STATUS_IGNORED
) -> None:
    """Publish static samples; one that the bus refuses is shown once, and tried again until it is accepted.

    A refused sample may close a loop with an edge of another program, which may end. As a task it has started once
    each sample has been tried.
    """
    warned: set[str] = set()
    pending = _publish_each(bus, samples, warned)
    task_status.started()
    while pending:
        await bus.clock.sleep(RETRY)
        pending = _publish_each(bus, pending, warned)


def _publish_each(bus: Bus, samples: Sequence[TransformStamped], warned: set[str]) -> list[TransformStamped]:
    """Publish samples one by one, and return those that the bus refused."""
    refused = []
    for sample in samples:
        try:
            bus.publish(sample)
        except InvalidTransformError as error:
            refused.append(sample)
            if sample.child not in warned:
                warned.add(sample.child)
                warn(f"refused, and tried again once a second: {error}")
    return refused

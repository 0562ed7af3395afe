"""Publishing static frames until Ctrl-C, whatever edges other programs publish."""

from collections.abc import Sequence

from tfbus.bus.bus import Bus
from tfbus.cli.output import warn
from tfbus.errors import InvalidTransformError
from tfbus.geometry.stamped import TransformStamped

RETRY = 1.0
"""The time between two attempts, in s."""


async def publish_static(bus: Bus, samples: Sequence[TransformStamped]) -> None:
    """Publish static samples; one that the bus refuses is shown once, and tried again until it is accepted.

    A refused sample may close a loop with an edge of another program, which may end.
    """
    pending = list(samples)
    warned: set[str] = set()
    while pending:
        refused = []
        for sample in pending:
            try:
                bus.publish(sample)
            except InvalidTransformError as error:
                refused.append(sample)
                if sample.child not in warned:
                    warned.add(sample.child)
                    warn(f"refused, and tried again once a second: {error}")
        pending = refused
        if pending:
            await bus.clock.sleep(RETRY)

"""``tfbus listen``."""

from tfbus.buffer.buffer import Buffer
from tfbus.bus.bus import Bus
from tfbus.cli import tutorial
from tfbus.cli._replay_clock import ReplayClock
from tfbus.cli.arguments import Rate
from tfbus.cli.domain import DEFAULT_LINK, LinkOptions
from tfbus.cli.output import fitted, print_now


def listen(*, rate: Rate = 1.0, link: LinkOptions = DEFAULT_LINK) -> None:
    """Print a point of the tutorial's laser in the frame of the base, again and again, until Ctrl-C.

    Start `tfbus broadcast` in another terminal, before or after. Without it, the lines say what is missing.

    Example: tfbus listen

    Parameters
    ----------
    rate
        Lines per second.
    """

    async def print_points(bus: Bus) -> None:
        with Buffer(bus) as buffer:
            await link.first_transform(bus)
            await tutorial.listen(buffer, rate, output=lambda line: print_now(fitted(line)))

    link.run(print_points, clock=ReplayClock())

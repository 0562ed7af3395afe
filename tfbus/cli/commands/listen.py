"""``tfbus listen``."""

from functools import partial

from tfbus.buffer.buffer import Buffer
from tfbus.bus.bus import Bus
from tfbus.cli import tutorial
from tfbus.cli.domain import LOCAL, LinkOptions
from tfbus.cli.options import Rate


def listen(*, rate: Rate = 1.0, link: LinkOptions = LOCAL) -> None:
    """Print where a point of the tutorial's laser is, seen from the base, until Ctrl-C.

    Start `tfbus broadcast` in another terminal, before or after. While it is missing, lines say what is missing.

    Example: tfbus listen

    Parameters
    ----------
    rate
        Lines per second.
    """

    async def print_points(bus: Bus) -> None:
        with Buffer(bus) as buffer:
            await link.first_transform(bus)
            # Piped output would else arrive in blocks of many lines.
            await tutorial.listen(buffer, rate, output=partial(print, flush=True))

    link.run(print_points)

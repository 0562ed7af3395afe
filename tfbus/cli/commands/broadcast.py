"""``tfbus broadcast``."""

from tfbus.bus.bus import Bus
from tfbus.cli import tutorial
from tfbus.cli.arguments import Rate
from tfbus.cli.domain import DEFAULT_LINK, LinkOptions
from tfbus.cli.output import say


def broadcast(*, rate: Rate = 100.0, link: LinkOptions = DEFAULT_LINK) -> None:
    """Broadcast the transform of the tutorial's laser, until Ctrl-C; `tfbus listen` in another terminal receives it.

    Example: tfbus broadcast --rate 50

    Parameters
    ----------
    rate
        Broadcasts per second.
    """

    async def broadcast_laser(bus: Bus) -> None:
        laser = f"{tutorial.LASER!r} in {tutorial.BASE!r}"
        say(f"broadcasting {laser} at {rate:g} Hz on {link.place}, until Ctrl-C")
        await tutorial.broadcast(bus, rate)

    link.run(broadcast_laser)

"""``tfbus broadcast``."""

from tfbus.bus.bus import Bus
from tfbus.cli import tutorial
from tfbus.cli.domain import LOCAL, LinkOptions, say
from tfbus.cli.options import Rate


def broadcast(*, rate: Rate = 100.0, link: LinkOptions = LOCAL) -> None:
    """Send where the tutorial's laser is, until Ctrl-C; `tfbus listen` in another terminal hears it.

    Example: tfbus broadcast --rate 50

    Parameters
    ----------
    rate
        How often, in Hz.
    """

    async def send(bus: Bus) -> None:
        what = f"{tutorial.LASER!r} in {tutorial.BASE!r} at {rate:g} Hz"
        say(f"broadcasting {what} on domain {link.domain!r}, until Ctrl-C")
        await tutorial.broadcast(bus, rate)

    link.run(send)

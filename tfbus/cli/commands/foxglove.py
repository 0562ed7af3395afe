"""``tfbus foxglove``."""

import anyio

from tfbus.bus.bus import Bus
from tfbus.cli.arguments import Port, UsageError
from tfbus.cli.domain import DEFAULT_LINK, LinkOptions
from tfbus.cli.output import print_now, say


def foxglove(*, port: Port = 8765, link: LinkOptions = DEFAULT_LINK) -> None:
    """Show the frames of a domain to the Foxglove application, until Ctrl-C.

    The address to open in Foxglove is printed; only programs on this machine can connect.

    Example: tfbus foxglove --port 8765

    Parameters
    ----------
    port
        Serve at this port; 0 for any that is free.
    """
    try:
        from tfbus.links.foxglove import FoxgloveServer
    except ImportError as error:
        raise UsageError(str(error)) from None

    async def serve(bus: Bus) -> None:
        server = FoxgloveServer(bus, port)
        try:
            await server.__aenter__()
        except OSError as error:
            raise UsageError(str(error)) from None
        try:
            print_now(server.address)
            say("open this address in Foxglove (Open connection, Foxglove WebSocket); Ctrl-C ends it")
            await anyio.sleep_forever()
        finally:
            await server.__aexit__(None, None, None)

    link.run(serve)

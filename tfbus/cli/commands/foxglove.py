"""``tfbus foxglove``."""

from tfbus.cli.arguments import Port, UsageError, usage_errors
from tfbus.cli.domain import DEFAULT_LINK, LinkOptions
from tfbus.cli.lazy_imports import lazy_imports
from tfbus.cli.output import print_now, say

with lazy_imports():
    import anyio

    from tfbus._aio.web_door import WebDoor
    from tfbus.bus.bus import Bus


def foxglove(
    *,
    port: Port = 8765,
    host: str = "127.0.0.1",
    origin: tuple[str, ...] = (),
    link: LinkOptions = DEFAULT_LINK,
) -> None:
    """Show the frames of a domain to the Foxglove application, until Ctrl-C.

    The address to open in Foxglove is printed; only programs on this machine can connect, and of web pages only the
    Foxglove application.

    Example: tfbus foxglove --port 8765

    Parameters
    ----------
    port
        Serve at this port; 0 for any that is free.
    host
        Listen at this address; 0.0.0.0 lets all other machines connect.
    origin
        Let pages of this other site connect too, such as https://robot.example; may be given several times.
    """
    with usage_errors():
        from tfbus.links.foxglove import APPLICATION, FoxgloveServer

        WebDoor(host, origin)

    async def serve(bus: Bus) -> None:
        server = FoxgloveServer(bus, port, host=host, origins=(*APPLICATION, *origin))
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

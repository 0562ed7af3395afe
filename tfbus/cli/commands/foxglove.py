"""``tfbus foxglove``."""

from tfbus.cli.arguments import Port, usage_errors
from tfbus.cli.domain import DEFAULT_HEARING, HearingOptions


def foxglove(
    *,
    port: Port = 8765,
    host: str = "127.0.0.1",
    origin: tuple[str, ...] = (),
    link: HearingOptions = DEFAULT_HEARING,
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

    link.serve(
        lambda bus: FoxgloveServer(bus, port, host=host, origins=(*APPLICATION, *origin)),
        "open this address in Foxglove (Open connection, Foxglove WebSocket); Ctrl-C ends it",
    )

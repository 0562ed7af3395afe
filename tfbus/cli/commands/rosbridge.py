"""``tfbus rosbridge``."""

from pathlib import Path

from tfbus.cli.arguments import Flag, Port, UsageError, usage_errors
from tfbus.cli.domain import DEFAULT_HEARING, HearingOptions


def rosbridge(
    *,
    port: Port = 9090,
    host: str = "127.0.0.1",
    origin: tuple[str, ...] = (),
    page: Path | None = None,
    publish: Flag = False,
    link: HearingOptions = DEFAULT_HEARING,
) -> None:
    """Serve the frames of a domain to web pages with roslib, as a rosbridge server of ROS does, until Ctrl-C.

    The address for roslib is printed; /tf, /tf_static and a tf2_web_republisher are there. Only programs on this
    machine can connect, and of web pages only the one of --page.

    Example: tfbus rosbridge --page robot.html

    Example: tfbus rosbridge --origin http://localhost:8000

    Parameters
    ----------
    port
        Serve at this port; 0 for any that is free.
    host
        Listen at this address; 0.0.0.0 lets all other machines connect.
    origin
        Let pages of this other server connect too, such as http://localhost:8000; may be given several times.
    page
        A web page, a file of HTML, to serve at the same port.
    publish
        Let pages publish transforms on the domain.
    """
    with usage_errors():
        from tfbus.links.rosbridge import RosbridgeServer

    try:
        html = None if page is None else page.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise UsageError(f"cannot read the page {page}: {error}") from None
    link.serve(
        lambda bus: RosbridgeServer(bus, port, host=host, origins=origin, page=html, publish=publish),
        "Ctrl-C ends it; " + ("give this address to roslib" if page is None else "the page is at http://{place}"),
    )

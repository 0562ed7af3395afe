"""The web server of the page: viser's, for this machine only and without a word on standard output."""

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import rich
import viser

_PORTS_TRIED = 100
_console_lock = threading.Lock()


class Server(viser.ViserServer):
    """viser's server, which no browser can make share the page with the world."""

    def request_share_url(self, verbose: bool = True) -> str | None:  # noqa: ARG002 - viser's signature
        """Refuse: viser would pass the page on through a server on the internet."""
        return None


def start_server(host: str, port: int) -> Server:
    """Start serving an empty page. It takes some tenths of a second, so call it in a worker thread.

    Parameters
    ----------
    host : str
        The address to listen at.
    port : int
        The first port to try; 0 for any that is free.

    Raises
    ------
    OSError
        If the address cannot be listened at, or the port and the hundred after it are taken.
    """
    free = _free_port(host, port)
    with _silent():
        server = Server(host, free, verbose=False)
    try:
        _furnish(server)
    except BaseException:
        stop_server(server)
        raise
    return server


def stop_server(server: viser.ViserServer) -> None:
    """Stop serving; in a worker thread, because it waits for viser's thread."""
    with _silent():
        server.stop()


def _furnish(server: viser.ViserServer) -> None:
    """Set up the empty page."""
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
    server.gui.main_panel.dock_right()
    server.gui.set_panel_label("tfbus")
    scene = server.scene
    # viser's picture of a sky takes long to load, and to light a scene with where there is no graphics card.
    scene.configure_environment_map(None)
    scene.configure_default_lights(cast_shadow=False)
    scene.add_light_ambient("/light", intensity=1.5)
    scene.add_grid("/grid", infinite_grid=True, fade_distance=60.0, cell_size=1.0, section_size=5.0)


def _free_port(host: str, port: int) -> int:
    """The first port that can be listened at. viser would try for ever at an address that is not of this machine."""
    last = port if port == 0 else min(port + _PORTS_TRIED, 65_535)
    for candidate in range(port, last + 1):
        try:
            with socket.create_server((host, candidate), family=_family(host)) as free:
                found: int = free.getsockname()[1]
                return found
        except OSError:
            if candidate == last:
                raise
    raise AssertionError("unreachable")


def _family(host: str) -> socket.AddressFamily:
    return socket.AF_INET6 if ":" in host else socket.AF_INET


@contextmanager
def _silent() -> Iterator[None]:
    """Keep viser from printing through rich's common console."""
    with _console_lock:
        console = rich.get_console()
        before, console.quiet = console.quiet, True
        try:
            yield
        finally:
            console.quiet = before

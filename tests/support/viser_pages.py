"""A page of viser that no browser shows."""

from collections.abc import Iterator
from contextlib import contextmanager

from tfbus.view._server import Server, start_server, stop_server


@contextmanager
def viser_page() -> Iterator[Server]:
    """A server on a free port of the loopback."""
    server = start_server("127.0.0.1", 0)
    try:
        yield server
    finally:
        stop_server(server)

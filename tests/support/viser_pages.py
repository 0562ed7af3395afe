"""A page of viser that no browser shows."""

from collections.abc import Iterator
from contextlib import contextmanager

from tfbus.view.server import Server, start_server, stop_server

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1, 0, 0, 0),
    "position": (1.0, 2, 3),
    "fov": 1.0,
    "near": 0.1,
    "far": 10,
    "image_height": 100,
    "image_width": 100,
    "look_at": (0, 0, 0),
    "up_direction": (0, 0, 1),
}
"""The first message of a browser."""


@contextmanager
def viser_page() -> Iterator[Server]:
    """A server on a free port of the loopback."""
    server = start_server("127.0.0.1", 0)
    try:
        yield server
    finally:
        stop_server(server)

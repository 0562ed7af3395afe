"""`View`, the live 3D page of a bus.

The program's event loop decides when to draw, and waits. viser's thread applies the choices of people, reads the tree
and draws. All messages of browsers together cost the loop one wake-up a picture, and pictures take at most half of the
time.
"""

import logging
import os
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import anyio
import anyio.abc
import anyio.lowlevel
import anyio.to_thread
import numpy as np

from tfbus._aio.loops import LoopWaker
from tfbus._aio.task_groups import close_task_group
from tfbus._aio.web_door import WebDoor
from tfbus.analysis.arrivals import Delays
from tfbus.buffer.buffer import Buffer
from tfbus.bus.bus import Bus
from tfbus.bus.subscribers import OnceLogger
from tfbus.data import PointCloud
from tfbus.errors import BusClosedError
from tfbus.events import FrameAdded
from tfbus.frames import check_frame
from tfbus.geometry.stamped import Batch
from tfbus.registration import AsyncOnly
from tfbus.robot.model import read_visuals
from tfbus.stamps import as_duration, is_real
from tfbus.statistics import QueueStatistics
from tfbus.tree.history import STALE_AFTER
from tfbus.view.meshes import MeshFiles, Solid, solids_of
from tfbus.view.page import Page
from tfbus.view.screen import Points, Screen
from tfbus.view.server import Controls, Server, start_server, stop_server

_FEW = 100
_DELAYS_EVERY = 500_000_000
"""ns."""
_AT_LEAST_EVERY = 0.5
"""In s: the longest time between two pictures, because ages and stale frames change without any sample."""


class View(AsyncOnly):
    """A page in the browser that shows the frames of a buffer: ``async with View(bus, buffer) as view``.

    It shows the axes of every frame that is connected with the fixed frame, and a line to its parent in the colour of
    its state. A panel shows the facts about the selected frame, the tree, and events. Time can be stopped, moved and
    played. All browsers show the same page. While no browser shows it, it neither draws nor listens.

    Parameters
    ----------
    bus : Bus
    buffer : Buffer
        The page can go back in its history. The frames have the names of the bus.
    port : int
        The port of the page; if it is taken, the next free one; 0 for any.
    host : str
        The address to listen at. By default, only programs on this machine can connect; each program that can connect
        sees and controls the page.
    origins : iterable of str
        Other web pages that may use this one, such as ``https://robot.example:8443``; the page also answers to the
        names of their hosts. By default there are none, and it answers to addresses, to ``localhost``, to ``host`` and
        to the name of this machine. ``*`` stands for all.
    fixed : str, optional
        The frame that stands still; by default the root of the largest tree. It can be changed on the page.
    trails : iterable of str
        Frames that draw where they were in the last ten seconds.
    urdf : str or path, optional
        A robot whose visible shapes are drawn at the frames of its links, as `tfbus.robot.read_visuals` takes it.
    package_paths : iterable of path
        Folders in which the ``package://`` of its meshes are looked for.
    rate : float
        The page is drawn at most this many times per s.
    live : bool
        Whether the page starts with the newest samples. Otherwise it is for a recording: it starts at the oldest.
    stale_after : float
        A moving frame is shown as stale when its newest stamp is more than this many s behind the clock.

    Attributes
    ----------
    address : str
        The address of the page, ``http://127.0.0.1:8080``; empty outside of the ``async with``.

    Raises
    ------
    ValueError
        If the port, the rate or `stale_after` is out of range, or an origin is malformed.
    InvalidTransformError
        If a name cannot be the name of a frame.
    OSError, InvalidRobotError, ImportError
        On entering, if the address cannot be listened at, or the URDF cannot be read.
    BusClosedError, RuntimeError
        On entering, if the bus is closed; if it belongs to another thread, or the view was entered before.
    """

    def __init__(
        self,
        bus: Bus,
        buffer: Buffer,
        port: int = 8080,
        *,
        host: str = "127.0.0.1",
        origins: Iterable[str] = (),
        fixed: str | None = None,
        trails: Iterable[str] = (),
        urdf: str | os.PathLike[str] | None = None,
        package_paths: Iterable[str | os.PathLike[str]] = (),
        rate: float = 30.0,
        live: bool = True,
        stale_after: float = STALE_AFTER,
    ) -> None:
        if isinstance(trails, str):
            raise TypeError(f"trails must be several names, not {trails!r}")
        if isinstance(port, bool) or not isinstance(port, int):
            raise TypeError(f"a port must be an int, not {port!r}")
        if not 0 <= port <= 65_535:
            raise ValueError(f"a port must be from 0 to 65535, got {port}")
        if not is_real(rate):
            raise TypeError(f"a rate must be a number in Hz, not {rate!r}")
        if not 0.0 < rate < float("inf"):
            raise ValueError(f"a rate must be greater than zero and finite, got {rate!r} Hz")
        trails = tuple(trails)
        for frame in trails if fixed is None else (*trails, fixed):
            check_frame(frame)
        self.bus = bus
        self.address: str = ""
        self._buffer = buffer
        self._host, self._port = host, port
        self._door = WebDoor(host, origins)
        self._urdf = urdf
        self._package_paths = tuple(Path(path) for path in package_paths)
        self._period = 1.0 / rate
        self._page_options = (fixed, trails, live, as_duration(stale_after, "stale_after"))
        self._stale_after = self._page_options[3]
        self._points: dict[str, Points] = {}
        self._log = OnceLogger(logging.getLogger("tfbus"))
        self._controls = Controls(lambda: self._changed.set())
        self._changed = anyio.Event()
        self._drawn = anyio.Event()
        self._drawn_waker = LoopWaker(lambda: self._drawn.set())
        self._drawn_at = time.monotonic_ns()
        self._texts_wanted = True
        self._entered = False
        self._page: Page
        self._screen: Screen
        self._server: Server | None = None
        self._tasks: anyio.abc.TaskGroup

    def add_points(
        self,
        cloud: PointCloud,
        name: str = "points",
        *,
        size: float = 0.02,
        colour: Any = (86, 180, 233),
    ) -> None:
        """Show points in their frame, instead of earlier points of the same name.

        Points with a stamp are shown at the pose that their frame had then in the fixed frame; points with the stamp
        `LATEST` move with their frame. Points are hidden until there is a transform.

        Parameters
        ----------
        cloud : PointCloud
        name : str
        size : float
            The size of each point, in m.
        colour : (int, int, int) or integer array of shape (n, 3)
            Red, green and blue from 0 to 255, for all points or for each.

        Raises
        ------
        TypeError, ValueError
            If `cloud` is not a cloud, the size is not greater than zero, or the colour has another shape.
        """
        if not isinstance(cloud, PointCloud):
            raise TypeError(f"expected a PointCloud, not {cloud!r}")
        if not is_real(size):
            raise TypeError(f"a size must be a number of m, not {size!r}")
        if not 0.0 < size < float("inf"):
            raise ValueError(f"a size must be greater than zero and finite, got {size!r}")
        # A new dict, because viser's thread may be reading the old one.
        self._points = {**self._points, name: Points(cloud, float(size), _as_colours(colour, len(cloud)))}
        self._changed.set()

    def remove_points(self, name: str = "points") -> None:
        """Remove points.

        Raises
        ------
        KeyError
            If there are none of this name.
        """
        points = dict(self._points)
        del points[name]
        self._points = points
        self._changed.set()

    @property
    def viewers(self) -> int:
        """The number of browsers that show the page."""
        return 0 if self._server is None else len(self._server.get_clients())

    @property
    def refused(self) -> int:
        """Refused: requests of other pages, messages that this page does not send, connections beyond 100 at once."""
        server = self._server
        return self._door.refused + (server.refused + server.refused_connections if server is not None else 0)

    def statistics(self) -> QueueStatistics:
        """The counters of people's changes on the page; of each control, a picture shows the newest value."""
        return self._controls.statistics()

    async def __aenter__(self) -> Self:
        if self._entered:
            raise RuntimeError("a view is entered once: make another one")
        self.bus._check_thread()
        if self.bus.closed:
            raise BusClosedError
        self._entered = True
        self.bus._entered.add(self)
        self._controls.bind()
        self._drawn_waker.bind()
        fixed, trails, live, stale_after = self._page_options
        self._page = Page(self._buffer.tree, fixed, trails, live, stale_after)
        # A cancellation must not lose the server that a thread has started.
        with anyio.CancelScope(shield=True):
            solids = await anyio.to_thread.run_sync(self._read_solids)
            server = self._server = await anyio.to_thread.run_sync(start_server, self._host, self._port, self._door)
        try:
            self._screen = Screen(server, self._page, solids, self._controls)
            server.on_client_connect(self._client_changed)
            server.on_client_disconnect(self._client_changed)
            self.address = f"http://{f'[{self._host}]' if ':' in self._host else self._host}:{server.get_port()}"
            self._tasks = await anyio.create_task_group().__aenter__()
            self._tasks.start_soon(self._run)
        except BaseException:
            await self._stop()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._tasks.cancel_scope.cancel()
        try:
            await close_task_group(self._tasks)
        finally:
            await self._stop()

    async def _stop(self) -> None:
        self.address = ""
        self.bus._entered.discard(self)
        server, self._server = self._server, None
        if server is not None:
            with anyio.CancelScope(shield=True):
                await anyio.to_thread.run_sync(stop_server, server)

    def _read_solids(self) -> list[Solid]:
        if self._urdf is None:
            return []
        text = isinstance(self._urdf, str) and "<" in self._urdf
        files = MeshFiles(self._package_paths, Path() if text else Path(self._urdf).parent)
        return solids_of(read_visuals(self._urdf), files)

    async def _run(self) -> None:
        while True:
            self._changed = anyio.Event()
            if self.viewers:
                await self._show()
            else:
                await self._changed.wait()

    async def _show(self) -> None:
        """Draw until no browser shows the page."""
        async with anyio.create_task_group() as tasks:
            with self._listening():
                tasks.start_soon(self._note_events)
                self._drawn_at = time.monotonic_ns()
                while self.viewers:
                    self._changed = anyio.Event()
                    before = time.monotonic()
                    await self._draw()
                    # The program has work of its own.
                    await anyio.sleep(max(self._period, time.monotonic() - before))
                    if not self._page.timeline.playing:
                        with anyio.move_on_after(_AT_LEAST_EVERY):
                            await self._changed.wait()
            tasks.cancel_scope.cancel()

    async def _draw(self) -> None:
        """Have viser's thread draw the page, and wait until it has."""
        assert self._server is not None
        drawn = self._drawn = anyio.Event()
        texts, self._texts_wanted = self._texts_wanted, False
        now, points = self.bus.clock.now(), self._points
        try:
            self._server.get_event_loop().call_soon_threadsafe(self._draw_now, now, points, texts)
        except RuntimeError as error:
            self._warn(error)
        else:
            await drawn.wait()

    def _draw_now(self, now: int, points: Mapping[str, Points], texts: bool) -> None:
        """Draw the page; called in viser's thread."""
        try:
            elapsed = time.monotonic_ns()
            self._page.timeline.advance((elapsed - self._drawn_at) / 1e9)
            self._drawn_at = elapsed
            self._screen.draw(now, elapsed, points, texts)
        except Exception as error:  # noqa: BLE001 - a picture that fails must not end the program that it is of
            self._warn(error)
        # The event loop may have ended before the server.
        with suppress(RuntimeError):
            self._drawn_waker.wake()

    def _warn(self, error: Exception) -> None:
        self._log.warning((type(error), str(error)), "the page could not be drawn: %r", error)

    @contextmanager
    def _listening(self) -> Iterator[None]:
        """Redraw when samples arrive or frames are removed, for the body of a ``with``; not on a closed bus."""
        delays = Delays()
        due = 0
        self._page.delays = delays.by_frame

        def arrived(batch: Batch) -> None:
            nonlocal due
            now = time.monotonic_ns()
            # With many frames, the delays of some batches are enough.
            if len(batch) <= _FEW:
                delays.note(batch, self.bus.clock.now())
            elif now >= due:
                due = now + _DELAYS_EVERY
                delays.note(batch, self.bus.clock.now())
            self._changed.set()

        def removed(frame: str) -> None:
            delays.forget(frame)
            self._changed.set()

        with ExitStack() as stack:
            if not self.bus.closed:
                stack.enter_context(self.bus.subscribe(arrived, removed))
                # Latched samples arrived at another time.
                delays.by_frame.clear()
            yield

    async def _note_events(self) -> None:
        if self.bus.closed:
            return
        known = self.bus.statistics().frames
        with self.bus.events(stale_after=self._stale_after) as events:
            async for event in events:
                if known and isinstance(event, FrameAdded):
                    # The events begin with the frames that exist already.
                    known -= 1
                    continue
                self._page.note_event(event)
                self._texts_wanted = True
                self._changed.set()

    def _client_changed(self, _: object) -> None:
        self._texts_wanted = True
        self._controls.wake()


def _as_colours(colour: Any, count: int) -> Any:
    colours = np.asarray(colour)
    if colours.shape not in ((3,), (count, 3)):
        raise ValueError(f"a colour must have shape (3,) or ({count}, 3), got {colours.shape}")
    if colours.dtype.kind not in "iu":
        raise TypeError(f"a colour must be integers from 0 to 255, not {colours.dtype}")
    return np.clip(colours, 0, 255).astype(np.uint8)

"""`View`, the live 3D page of a bus.

Each browser has a websocket with a task of its own: it carries out the orders of a person, sends a picture, and rests
at least as long as pictures take, so all browsers together use at most half of the program's time. While a browser is
slow to read, no picture is made for it; the next one is of that moment. Threads read meshes and copy large trees.
"""

import json
import logging
import os
import shlex
import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import anyio
import anyio.abc
import anyio.to_thread
import numpy as np

from tfbus._aio.task_groups import close_task_group
from tfbus._aio.web_site import WebFile, WebSite
from tfbus._aio.websocket import WebSocket
from tfbus.analysis.arrivals import Delays
from tfbus.buffer.buffer import Buffer
from tfbus.bus.bus import Bus
from tfbus.bus.subscribers import OnceLogger
from tfbus.data import PointCloud
from tfbus.errors import TransformError
from tfbus.events import FrameAdded
from tfbus.frames import check_frame
from tfbus.geometry.stamped import Batch
from tfbus.links.bus_server import BusServer
from tfbus.recording.static_frames import save_static
from tfbus.robot.model import read_visuals
from tfbus.stamps import Latest, as_duration, is_real
from tfbus.statistics import QueueStatistics
from tfbus.tree.history import STALE_AFTER
from tfbus.tree.rendering import counted
from tfbus.view.meshes import MeshFiles, robot_message, solids_of
from tfbus.view.session import MAX_MESSAGE, Edit, Film, Message, Page, Points, Save, Session

_FILES = Path(__file__).parent / "page"
_MEDIA_TYPES = {
    ".css": "text/css; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}
_FEW = 100
_DELAYS_EVERY = 500_000_000
"""ns."""
_AT_LEAST_EVERY = 0.5
"""In s: the longest time between two pictures, because ages and stale frames change without any sample."""
_ORDERS = 64
"""The greatest number of orders of a browser that wait; beyond it, no more are read from its connection."""
_AUTHORITY = "view"


@runtime_checkable
class _HasPeers(Protocol):
    """A link."""

    @property
    def peers(self) -> tuple[str, ...]: ...

    @property
    def domain(self) -> object: ...


class _Viewer:
    """A browser that shows the page."""

    def __init__(self, page: Page, socket: WebSocket) -> None:
        self.session = Session(page)
        self.socket = socket
        self.orders: deque[Message] = deque()
        self.stirred = anyio.Event()
        self.has_room = anyio.Event()

    async def read(self) -> None:
        """Keep the orders of the browser until it is gone."""
        with suppress(OSError):
            while True:
                self.orders.append(await self.socket.receive())
                self.stirred.set()
                while len(self.orders) >= _ORDERS:
                    self.has_room = anyio.Event()
                    await self.has_room.wait()


class View(BusServer):
    """A page in the browser that shows the frames of a buffer: ``async with View(bus, buffer) as view``.

    It shows the axes of every frame that is connected with the fixed frame, and a line to its parent in the colour of
    its state. A panel shows the facts about the selected frame, the tree, and events. Time can be stopped, moved and
    played. Each browser has a selection, a time and a fixed frame of its own. While no browser shows it, it neither
    draws nor listens.

    Parameters
    ----------
    bus : Bus
    buffer : Buffer
        The page can go back in its history. The frames have the names of the bus.
    port : int
        The port of the page; if it is taken, the next free one; 0 for any.
    host : str
        The address to listen at. By default, only programs on this machine can connect; each program that can connect
        sees the page, and can move the frames that ``edit`` names.
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
    edit : iterable of str
        Static frames that can be moved on the page. Each change is published on the bus, by the authority ``"view"``.
    save : path, optional
        The file to which the page can save these frames, as `tfbus.recording.save_static` does.
    title : str
        The title of the page.

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

    _scheme = "http"

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
        edit: Iterable[str] = (),
        save: str | os.PathLike[str] | None = None,
        title: str = "tfbus",
    ) -> None:
        for name, frames in (("trails", trails), ("edit", edit)):
            if isinstance(frames, str):
                raise TypeError(f"{name} must be several names, not {frames!r}")
        if not is_real(rate):
            raise TypeError(f"a rate must be a number in Hz, not {rate!r}")
        if not 0.0 < rate < float("inf"):
            raise ValueError(f"a rate must be greater than zero and finite, got {rate!r} Hz")
        trails, edit = tuple(trails), tuple(edit)
        for frame in (*trails, *edit, *(() if fixed is None else (fixed,))):
            check_frame(frame)
        self._buffer = buffer
        self._urdf = urdf
        self._package_paths = tuple(Path(path) for path in package_paths)
        self._period = 1.0 / rate
        self._stale_after = as_duration(stale_after, "stale_after")
        self._save = None if save is None else Path(save).absolute()
        hello = {"title": title, "save": save and str(self._save)}
        self._page = Page(buffer.tree, fixed, trails, live, self._stale_after, edit, hello)
        self._log = OnceLogger(logging.getLogger("tfbus"))
        self._viewers: set[_Viewer] = set()
        self._viewers_changed = anyio.Event()
        self._refused = 0
        self._files: dict[str, WebFile] = {}
        self._tasks: anyio.abc.TaskGroup | None = None
        super().__init__(bus, host, port, origins, WebSite(self._files, self._serve, MAX_MESSAGE).answer, search=True)

    def add_points(
        self,
        cloud: PointCloud | Sequence[PointCloud],
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
        cloud : PointCloud, or sequence of PointCloud
            Of several clouds, all with a stamp, the newest up to the moment shown; none that is older than
            `stale_after`.
        name : str
        size : float
            The size of each point, in m.
        colour : (int, int, int) or integer array of shape (n, 3)
            Red, green and blue from 0 to 255, for all points or for each.

        Raises
        ------
        TypeError, ValueError
            If `cloud` is not a cloud, the size is not greater than zero, the colour has another shape, or one of
            several clouds has no stamp.
        """
        several = isinstance(cloud, Sequence)
        clouds = tuple(cloud) if isinstance(cloud, Sequence) else (cloud,)
        for each in clouds:
            if not isinstance(each, PointCloud):
                raise TypeError(f"expected a PointCloud, not {each!r}")
            if several and isinstance(each.stamp, Latest):
                raise ValueError("each of several clouds needs a stamp, not LATEST")
        if not is_real(size):
            raise TypeError(f"a size must be a number of m, not {size!r}")
        if not 0.0 < size < float("inf"):
            raise ValueError(f"a size must be greater than zero and finite, got {size!r}")
        points = [Points(each, float(size), _as_colours(colour, len(each))) for each in clouds]
        self._page.clouds[name] = Film(points, self._stale_after) if several else points[0]
        self._change()

    def remove_points(self, name: str = "points") -> None:
        """Remove points.

        Raises
        ------
        KeyError
            If there are none of this name.
        """
        del self._page.clouds[name]
        self._change()

    @property
    def viewers(self) -> int:
        """The number of browsers that show the page."""
        return len(self._viewers)

    @property
    def refused(self) -> int:
        """Refused: requests of other pages, orders that cannot be carried out, connections beyond 100 at once."""
        return super().refused + self._refused

    def statistics(self) -> QueueStatistics:
        """The counters of people's orders; a browser with too many has to wait, so none is dropped."""
        pending = sum(len(viewer.orders) for viewer in self._viewers)
        return QueueStatistics("orders", "wait", _ORDERS * max(1, self.viewers), pending, 0)

    async def _open(self) -> None:
        await anyio.to_thread.run_sync(self._read_files)
        self._tasks = await anyio.create_task_group().__aenter__()
        self._tasks.start_soon(self._listen)

    async def _close(self) -> None:
        if self._tasks is not None:
            self._tasks.cancel_scope.cancel()
            await close_task_group(self._tasks)

    def _read_files(self) -> None:
        for path in sorted(_FILES.rglob("*")):
            if path.is_file():
                media_type = _MEDIA_TYPES.get(path.suffix, "text/plain; charset=utf-8")
                self._files[f"/{path.relative_to(_FILES).as_posix()}"] = WebFile(media_type, path.read_bytes())
        if "/index.html" in self._files:
            self._files["/"] = self._files["/index.html"]
        if self._urdf is not None:
            text = isinstance(self._urdf, str) and "<" in self._urdf
            files = MeshFiles(self._package_paths, Path() if text else Path(self._urdf).parent)
            self._page.robot = robot_message(solids_of(read_visuals(self._urdf), files))
            self._page.hello["missing"] = len(files.missing)

    async def _serve(self, socket: WebSocket) -> None:
        """Show the page in one browser, until it is gone."""
        viewer = _Viewer(self._page, socket)
        self._viewers.add(viewer)
        self._viewers_changed.set()
        try:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(self._show, viewer)
                await viewer.read()
                tasks.cancel_scope.cancel()
        finally:
            self._viewers.discard(viewer)
            self._viewers_changed.set()

    async def _show(self, viewer: _Viewer) -> None:
        with suppress(OSError):
            while True:
                viewer.stirred = anyio.Event()
                begin = time.monotonic()
                messages = await self._messages(viewer)
                spent = time.monotonic() - begin
                for message in messages:
                    await viewer.socket.send(message)
                # Leave the program time for its own work.
                await anyio.sleep(max(self._period, (2 * len(self._viewers) - 1) * spent))
                if not viewer.session.timeline.playing:
                    with anyio.move_on_after(_AT_LEAST_EVERY):
                        await viewer.stirred.wait()

    async def _messages(self, viewer: _Viewer) -> list[Message]:
        """Carry out the orders that wait now; the answers to them, and the picture after them."""
        messages: list[Message] = []
        for _ in range(len(viewer.orders)):
            answer = await self._obey(viewer.session, viewer.orders.popleft())
            if answer is not None:
                messages.append(answer)
        viewer.has_room.set()
        self._greet()
        try:
            messages += viewer.session.picture(self.bus.clock.now(), time.monotonic_ns())
        except Exception as error:  # noqa: BLE001 - a picture that fails must not end the program
            self._log.warning((type(error), str(error)), "the page could not be drawn: %r", error)
        return messages

    async def _obey(self, session: Session, text: Message) -> str | None:
        """Carry out an order; the answer to the browser, if there is one."""
        try:
            order = session.read(text)
            if session.needs_history(order):
                session.hold(await anyio.to_thread.run_sync(self._page.tree.copy))
            wish = session.do(order)
            if isinstance(wish, Edit):
                self.bus.publish(wish.sample(self.bus.clock.now(), _AUTHORITY))
            elif isinstance(wish, Save):
                return json.dumps({"type": "saved", **await self._save_edited()})
        except Exception as error:  # noqa: BLE001 - an order of a stranger must not end the program
            self._refused += 1
            if not isinstance(error, ValueError | TypeError | ArithmeticError | TransformError | OSError):
                self._log.warning((type(error), str(error)), "an order of a browser failed: %r", error)
            return json.dumps({"type": "error", "text": str(error)})
        return None

    async def _save_edited(self) -> dict[str, object]:
        if self._save is None:
            raise ValueError("the program names no file to save to: give the view save=, or tfbus view --save")
        samples = [edit.sample(0, _AUTHORITY) for edit in self._page.edited()]
        if not samples:
            raise ValueError(f"none of the frames that can be moved is there: {', '.join(self._page.edit) or 'none'}")
        await anyio.to_thread.run_sync(save_static, self._save, samples)
        return {"path": str(self._save), "frames": [sample.child for sample in samples]}

    def _greet(self) -> None:
        """Tell the browsers which domain is shown, who is heard there, and how a frame is sent to it."""
        links = [each for each in self.bus._entered if isinstance(each, _HasPeers)]
        named = [link.domain for link in links if isinstance(link.domain, str)]
        option = f" --domain {shlex.quote(named[0])}" if named and named[0] != "tf" else ""
        self._page.hello |= {
            "where": " and ".join(f"domain {link.domain!r}" for link in links),
            "hears": counted(sum(len(link.peers) for link in links), "peer") if links else "",
            "send": f"tfbus static map base --xyz 1 0 0{option}" if named and self._page.live else "",
        }

    def _change(self) -> None:
        """Have every browser get another picture."""
        for viewer in self._viewers:
            viewer.stirred.set()

    async def _listen(self) -> None:
        """Listen to the bus while somebody looks."""
        while True:
            await self._until_looked_at(True)
            async with anyio.create_task_group() as tasks:
                with self._listening():
                    tasks.start_soon(self._note_events)
                    await self._until_looked_at(False)
                tasks.cancel_scope.cancel()

    async def _until_looked_at(self, wanted: bool) -> None:
        while bool(self._viewers) is not wanted:
            self._viewers_changed = anyio.Event()
            await self._viewers_changed.wait()

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
            self._change()

        def removed(frame: str) -> None:
            delays.forget(frame)
            self._change()

        with ExitStack() as stack:
            if not self.bus.closed:
                stack.enter_context(self.bus.subscribe(arrived, removed))
                # Latched samples arrived at another time.
                delays.by_frame.clear()
            yield

    async def _note_events(self) -> None:
        # The events of a recording would be those of moved frames, at the time of now.
        if self.bus.closed or not self._page.live:
            return
        known = self.bus.statistics().frames
        with self.bus.events(stale_after=self._stale_after) as events:
            async for event in events:
                if known and isinstance(event, FrameAdded):
                    # The events begin with the frames that exist already.
                    known -= 1
                    continue
                self._page.note_event(event)
                self._change()


def _as_colours(colour: Any, count: int) -> Any:
    colours = np.asarray(colour)
    if colours.shape not in ((3,), (count, 3)):
        raise ValueError(f"a colour must have shape (3,) or ({count}, 3), got {colours.shape}")
    if colours.dtype.kind not in "iu":
        raise TypeError(f"a colour must be integers from 0 to 255, not {colours.dtype}")
    return np.clip(colours, 0, 255).astype(np.uint8)

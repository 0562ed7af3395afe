"""The model of the page: the part that all browsers share, and the part of each browser.

A `Session` belongs to one browser. It takes the orders of a person (`read`, `do`), and `picture` gives the messages
that bring the browser up to date. It knows no socket and no event loop, and repeats no message unless its content has
changed. The `Page` has what all sessions share: the tree, points, events.

An order is an object of JSON with the name of the order as ``do``; `_ACTIONS` lists them, and the arguments of their
functions are the other keys. A browser receives texts of JSON with a ``type``. Stamps are texts of ns, because numbers
of JavaScript have 53 bits.

============= ======================================================================================================
type          content
============= ======================================================================================================
``hello``     facts about the page, which come first
``frames``    the ``names`` of all frames, first those that are connected with the fixed one; the places of ``parents``
``states``    a word of `_STATES` for each of these names
``clouds``    the names of the points
``time``      the mode, the stamp that is shown, the span; at least twice a second, as a sign of life
``selection`` the facts about the selected frame, its chain, its pose in its parent, and the semi-axes and the
              quaternion of the ellipsoid of two sigma in the fixed frame, if the error of its position is known
``edited``    the pose in its parent of a frame that can be moved; when it has changed
``events``    new events
``error``     the reason why an order was refused
``saved``     the path and the frames of a file that was written
============= ======================================================================================================

A message of bytes begins with its kind and three zeros. `POSES` has seven numbers of 32 bits for each name of
``frames``, and then for each of ``clouds``: the position in m and the quaternion (x, y, z, w) in the fixed frame, NaN
where there is no pose. `POINTS`, `TRAILS` and `ROBOT` have a header in JSON and arrays, as `framed` writes them.
"""

import json
import math
import re
import reprlib
import struct
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from inspect import signature
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from tfbus.data import PointCloud
from tfbus.errors import TransformLookupError, UnknownFrameError
from tfbus.events import Event
from tfbus.geometry.stamped import TransformStamped
from tfbus.geometry.transform import Transform, from_row
from tfbus.plain import printable
from tfbus.rows import Quaternion, Row, Vector
from tfbus.stamps import (
    LATEST,
    SECOND,
    STAMP_MIN,
    Latest,
    format_age,
    format_duration,
    format_stamp,
    from_seconds,
    is_real,
)
from tfbus.tree.forest import Forest
from tfbus.tree.history import STALE_AFTER, Edge, FrameHistory
from tfbus.tree.poses import PoseReader, Poses
from tfbus.tree.rendering import format_rate
from tfbus.tree.tree import TransformTree, forest_of

Floats = npt.NDArray[np.float32]
Message = str | bytes
"""A message for a browser."""

POSES, POINTS, TRAILS, ROBOT = 1, 2, 3, 4
"""The first byte of a message of bytes."""
MAX_MESSAGE = 65_536
"""The greatest length of a message of a browser."""
MAX_TRAILS = 20
SAMPLES = 300
"""The greatest number of points of a trail."""
EVENTS_KEPT = 100
TRAIL_SECONDS = 10.0
_LONGEST_TRAIL = 3_600.0
_FASTEST = 100.0
_TEXTS_EVERY = SECOND // 4
_STATES = ("static", "moving", "stale", "silent", "lost")
_STATIC, _MOVING, _STALE, _SILENT, _LOST = range(5)


def framed(kind: int, header: object, *arrays: npt.NDArray[Any]) -> bytes:
    """A message of bytes: the kind, the length of a header, the header in JSON, and arrays of 4 bytes a number."""
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    return b"".join((struct.pack("<B3xI", kind, len(text)), text, *(array.tobytes() for array in arrays)))


class Timeline:
    """A stamp that follows the newest data, stands still, or runs through a span at some speed.

    Attributes
    ----------
    stamp : int or None
        The chosen stamp, in ns; None while the page is live.
    start, end : int
        The span in which a stamp can be chosen, in ns.
    last : int
        The newest stamp of it at which frames have poses, in ns.
    playing : bool
        Whether the chosen stamp runs.
    speed : float
        Relative to real time.
    """

    def __init__(self) -> None:
        self.stamp: int | None = None
        self.start: int = 0
        self.end: int = 0
        self.last: int = 0
        self.playing: bool = False
        self.speed: float = 1.0

    def choose(self, stamp: int, span: tuple[int, int], last: int) -> None:
        """Stand still at a stamp of a span, all in ns."""
        self.start, self.end = span
        self.last = last
        self.stamp = min(max(stamp, self.start), self.end)
        self.playing = False

    def seek(self, stamp: int) -> None:
        """Stand still at another stamp of the span; while live, nothing happens."""
        self.playing = False
        if self.stamp is not None:
            self.stamp = min(max(stamp, self.start), self.end)

    def play(self) -> None:
        """Run from the chosen stamp, or from the start if that is the last one; while live, nothing happens."""
        if self.stamp is not None:
            self.playing = True
            if self.stamp >= self.last:
                self.stamp = self.start

    def advance(self, elapsed: float) -> None:
        """Run for `elapsed` s of real time, and stop at the end of the span."""
        if self.stamp is not None and self.playing:
            self.stamp = min(self.stamp + round(elapsed * self.speed * SECOND), self.end)
            self.playing = self.stamp < self.end

    def step(self, forest: Forest, forward: bool, frame: str | None = None) -> None:
        """Stand still at the next, or the previous, sample of a frame; of any frame, unless that one moves."""
        if self.stamp is None:
            return
        with forest.lock:
            own = forest.frames.get(frame or "")
            histories = forest.frames.values() if own is None or own.newest is None else (own,)
            if forward:
                found = (history.neighbours(self.stamp + 1)[1] for history in histories)
                self.seek(min((stamp for stamp in found if stamp is not None), default=self.stamp))
            else:
                found = (history.neighbours(self.stamp - 1)[0] for history in histories)
                self.seek(max((stamp for stamp in found if stamp is not None), default=self.stamp))


def span_of(forest: Forest) -> tuple[int, int] | None:
    """The oldest and the newest stamp of any moving sample, in ns; None if there is none."""
    with forest.lock:
        oldest = [history.oldest for history in forest.frames.values()]
        newest = [history.newest for history in forest.frames.values()]
    stamps = [stamp for stamp in (*oldest, *newest) if stamp is not None]
    return (min(stamps), max(stamps)) if stamps else None


def largest_root(forest: Forest) -> str | None:
    """The root of the tree with the most frames, by the newest parents; None if there are no frames."""
    with forest.lock:
        above = {child: history.parent for child, history in forest.frames.items()}
    if not above:
        return None
    roots: dict[str, str] = {}
    sizes: dict[str, int] = {}
    for frame in above:
        climbed: dict[str, None] = {}
        while frame in above and frame not in roots and frame not in climbed:
            climbed[frame] = None
            frame = above[frame]
        root = roots.get(frame, frame)
        roots.update(dict.fromkeys(climbed, root))
        sizes[root] = sizes.get(root, 0) + len(climbed)
    return max(sorted(sizes), key=sizes.__getitem__)


def selection_facts(
    tree: TransformTree, fixed: str | None, frame: str, at: int | Latest, now: int, delay: float | None = None
) -> dict[str, str]:
    """The pose of a frame in the fixed frame, and the facts about the edge above it.

    Parameters
    ----------
    tree : TransformTree
    fixed : str or None
        The fixed frame, if there is one.
    frame : str
        The selected frame.
    at : int or LATEST
        The stamp of the pose, in ns.
    now : int
        The stamp (ns) that the age is counted from.
    delay : float, optional
        The mean time from the stamp of a sample to its arrival, in s.

    Returns
    -------
    dict of str to str
        By label, in the order of display.
    """
    forest = forest_of(tree)
    with forest.lock:
        history = forest.frames.get(frame)
        edge = None if history is None else history.edge()
    return {"frame": frame, **_pose_facts(tree, fixed, frame, at), **_edge_facts(edge, now, delay)}


def _pose_facts(tree: TransformTree, fixed: str | None, frame: str, at: int | Latest) -> dict[str, str]:
    if fixed is None:
        return {"pose": "there is no fixed frame"}
    try:
        found = tree.lookup(fixed, frame, at)
    except TransformLookupError as error:
        return {"pose": f"none: {error}"}
    transform = found.transform
    return {
        "in": fixed,
        "xyz": f"{_join(transform.translation)} m",
        "rpy": f"{_join(map(math.degrees, transform.as_rpy()))} deg",
        "quaternion": f"{_join(transform.rotation)} (x y z w)",
        "at": "any time" if found.static else format_stamp(found.stamp),
    }


def _ellipsoid(tree: TransformTree, fixed: str, frame: str, at: int | Latest) -> tuple[Vector, Quaternion] | None:
    """The ellipsoid of two sigma around a frame; None if no edge has told its error."""
    found = tree.lookup(fixed, frame, at, covariance=True).ellipsoid()
    return found if any(found[0]) else None


def _edge_facts(edge: Edge | None, now: int, delay: float | None) -> dict[str, str]:
    if edge is None:
        return {"parent": "none, it is a root"}
    known = {"parent": edge.parent, "rate": format_rate(edge.static, edge.newest, edge.rate)}
    if edge.newest is not None:
        known["age"] = format_age(edge.newest, now).removeprefix("age ")
    if delay is not None:
        known["delay"] = format_duration(round(delay * SECOND))
    return {**known, "authority": edge.authority or "not known"}


def _join(numbers: Iterable[float]) -> str:
    return " ".join(f"{number:z.6f}" for number in numbers)


def trail(tree: TransformTree, fixed: str, frame: str, at: int | None, duration: float) -> Floats:
    """The path of a frame in the fixed frame, over some time before a stamp.

    Parameters
    ----------
    tree : TransformTree
    fixed, frame : str
    at : int or None
        The end, in ns; None for the newest stamp with an answer.
    duration : float
        In s.

    Returns
    -------
    array of shape (n, 3)
        In m, NaN where there is no answer; none if the frame has no pose, or a static one.
    """
    nothing = np.empty((0, 3), np.float32)
    try:
        newest = tree.lookup(fixed, frame, LATEST)
        if newest.static:
            return nothing
        at = newest.stamp if at is None else at
        stamps = np.linspace(at - from_seconds(duration), at, SAMPLES).astype(np.int64)
        stamps[-1] = at
        found = tree.lookup_many(fixed, frame, stamps, out_of_range="nan")
    except TransformLookupError:
        return nothing
    return found.translations.astype(np.float32)


class Points(NamedTuple):
    """Points of one moment."""

    cloud: PointCloud
    size: float
    """m."""
    colour: npt.NDArray[np.uint8]
    """Shape (3,), or (n, 3)."""

    @property
    def stamps(self) -> tuple[int, ...]:
        """None: they are no part of a recording."""
        return ()

    def at(self, _: int | None) -> "Points":
        """These points, at any stamp."""
        return self

    def message(self, name: str) -> bytes:
        """The points for a browser, without those that are not finite."""
        finite = np.isfinite(self.cloud.points).all(axis=1)
        points = self.cloud.points[finite].astype(np.float32)
        each = self.colour.ndim == 2
        header = {"name": name, "size": self.size, "count": len(points), "colours": each}
        if each:
            return framed(POINTS, header, points, self.colour[finite])
        return framed(POINTS, header | {"colour": self.colour.tolist()}, points)


class Film:
    """Points of many moments, sorted by stamp.

    Parameters
    ----------
    frames : sequence of Points
        None of them at `LATEST`.
    longest : float
        In s: points that are older than this at the moment shown are not drawn.
    """

    def __init__(self, frames: Iterable[Points], longest: float) -> None:
        self._frames = sorted(frames, key=lambda each: each.cloud.stamp)  # type: ignore[arg-type, return-value]
        self._stamps = np.array([each.cloud.stamp for each in self._frames], np.int64)
        self._longest = from_seconds(longest)

    @property
    def stamps(self) -> tuple[int, ...]:
        """The oldest and the newest stamp in ns, if there are points."""
        return tuple(self._stamps[[0, -1]].tolist()) if self._frames else ()

    def at(self, stamp: int | None) -> Points | None:
        """The newest points up to a stamp in ns; None for the newest of all."""
        place = len(self._frames) if stamp is None else int(self._stamps.searchsorted(stamp, "right"))
        if not place or (stamp is not None and stamp - int(self._stamps[place - 1]) > self._longest):
            return None
        return self._frames[place - 1]


class CloudSource(Protocol):
    """Points that change with time."""

    @property
    def stamps(self) -> tuple[int, ...]: ...

    def at(self, stamp: int | None, /) -> Points | None:
        """The points at a stamp in ns, or, for None, the newest ones; None if there are none."""


class Edit(NamedTuple):
    """A new pose of a static frame in its parent."""

    parent: str
    frame: str
    transform: Transform

    def sample(self, stamp: int, authority: str) -> TransformStamped:
        """The static sample for a bus; raises `InvalidTransformError`."""
        return TransformStamped(self.parent, self.frame, stamp, self.transform, authority, static=True)


class Save(NamedTuple):
    """The wish to write the edited frames to a file."""


class Order(NamedTuple):
    """An action of a person on the page: its name, and its values, which are not checked yet."""

    name: str
    values: dict[str, Any]


_PEER = re.compile("[0-9a-f]{32}")


class Page:
    """The part of the page that all browsers share.

    Parameters
    ----------
    tree : TransformTree
        The tree to show; a bus may feed it.
    fixed : str, optional
        The fixed frame of a new session; by default the root of the largest tree.
    trails : iterable of str
        Frames that have a trail in a new session.
    live : bool
        Whether sessions start with the newest data and may return to them. Otherwise they start at the oldest stamp,
        as for a recording.
    stale_after : float
        The age, in s, from which a moving frame is stale.
    edit : iterable of str
        Static frames that can be moved.
    hello : mapping
        More facts about the page for the browsers, by name.

    Attributes
    ----------
    tree, fixed, trails, live, edit
    stale_after : int
        ns.
    hello : dict
    robot : bytes
        The message with the shapes of a robot; empty if there is none.
    delays : mapping of str to float
        The delay of each frame, in s.
    lost : set of str
        Frames whose peer is gone.
    clouds : dict of str to CloudSource
    """

    def __init__(
        self,
        tree: TransformTree,
        fixed: str | None = None,
        trails: Iterable[str] = (),
        live: bool = True,
        stale_after: float = STALE_AFTER,
        edit: Iterable[str] = (),
        hello: Mapping[str, object] | None = None,
    ) -> None:
        self.tree, self.fixed, self.trails, self.live = tree, fixed, tuple(trails), live
        self.stale_after = from_seconds(stale_after)
        self.edit = tuple(edit)
        self.hello: dict[str, object] = {"live": live, "edit": self.edit, **(hello or {})}
        self.robot = b""
        self.delays: Mapping[str, float] = {}
        self.lost: set[str] = set()
        self.clouds: dict[str, CloudSource] = {}
        self._events: deque[dict[str, object]] = deque(maxlen=EVENTS_KEPT)
        self._events_seen = 0

    def note_event(self, event: Event) -> None:
        """Keep an event to show; the oldest are forgotten."""
        kind, frame, peer = type(event).__name__, getattr(event, "frame", None), getattr(event, "peer", None)
        text = str(event).partition(": ")[2]
        if peer is not None and _PEER.fullmatch(peer):
            text = text.replace(peer, peer[:8])
            peer = peer[:8]
        if kind == "PeerLost":
            self.lost.update(getattr(event, "frames", ()))
        elif kind in ("FrameLive", "FrameAdded", "FrameRemoved"):
            self.lost.discard(frame)
        self._events_seen += 1
        self._events.append({"at": str(event.stamp), "kind": kind, "frame": frame, "text": text, "peer": peer})

    def events_since(self, number: int) -> tuple[int, list[dict[str, object]]]:
        """The number of events so far, and those after the first `number`, as far as they are kept."""
        fresh = min(self._events_seen - number, len(self._events))
        return self._events_seen, list(self._events)[len(self._events) - fresh :]

    def edited(self) -> list[Edit]:
        """The frames of `edit` that are static now, as they are."""
        return [placed for placed in (_placed(self.tree, frame) for frame in self.edit) if placed is not None]


def _placed(tree: TransformTree, frame: str) -> Edit | None:
    """A static frame as it is; None if it is not static."""
    forest = forest_of(tree)
    with forest.lock:
        history = forest.frames.get(frame)
        found = (history.parent, history.static_row) if history is not None and history.static else None
    return None if found is None else Edit(found[0], frame, from_row(found[1]))


class Session:
    """The part of the page that belongs to one browser: its selection, its time, its fixed frame, its trails.

    Parameters
    ----------
    page : Page

    Attributes
    ----------
    timeline : Timeline
    """

    def __init__(self, page: Page) -> None:
        self.timeline: Timeline = Timeline()
        self._page = page
        self._chosen = page.fixed
        self._selected: str | None = None
        self._trails = dict.fromkeys(page.trails, TRAIL_SECONDS)
        self._sent: dict[str, Message] = {}
        self._sent_points: dict[str, Points] = {}
        self._events = 0
        self._poses_of_points: dict[str, tuple[Points, str, Row]] = {}
        self._drawn_at: int | None = None
        self._texts_due: int | None = None
        self._fixed: str | None = None
        self._structure: object = None
        self._named: object = None
        self._asked: object = None
        self._poses: Poses | None = None
        self._others: list[str] = []
        self._other_codes: list[int] = []
        self._show(page.tree)
        if not page.live:
            # Where all frames are static, only the points have a time.
            stamps = [
                *(span_of(forest_of(page.tree)) or ()),
                *(each for film in page.clouds.values() for each in film.stamps),
            ]
            start, end = min(stamps, default=0), max(stamps, default=0)
            self.timeline.choose(start, (start, end), end)

    def _show(self, tree: TransformTree) -> None:
        self._tree = tree
        self._reader = PoseReader(forest_of(tree))
        self._structure = self._named = self._asked = None

    # The orders of a person

    def read(self, text: Message) -> Order:
        """The order in a message of a browser.

        Raises
        ------
        ValueError
            If it is none.
        """
        if not isinstance(text, str) or len(text) > MAX_MESSAGE:
            raise ValueError(f"an order is a text of at most {MAX_MESSAGE:,} letters")
        try:
            values = json.loads(text, parse_constant=_no_number)
        except RecursionError:
            raise ValueError("the order is nested too deeply") from None
        name = values.pop("do", None) if isinstance(values, dict) else None
        if not isinstance(name, str) or name not in _ACTIONS:
            raise ValueError(f"an order is an object with 'do', one of {', '.join(_ACTIONS)}; got {reprlib.repr(text)}")
        return Order(name, values)

    def needs_history(self, order: Order) -> bool:
        """Whether `do` will copy the live tree, which takes long with many frames: `hold` a copy before."""
        return self.timeline.stamp is None and order.name in _STOPPING

    def hold(self, history: TransformTree) -> None:
        """Stand still on a copy of the tree, because the live tree forgets old samples.

        The stamp is the newest one that all frames cover, except stale frames.
        """
        span = span_of(forest_of(history))
        if span is not None:
            newest = [frame.newest for frame in forest_of(history).frames.values() if frame.newest is not None]
            last = min(each for each in newest if span[1] - each <= self._page.stale_after)
            self._show(history)
            self.timeline.choose(last, span, last)

    def do(self, order: Order) -> Edit | Save | None:
        """Carry out an order; an `Edit` or a `Save` is for the program.

        Raises
        ------
        ValueError, TypeError
            If its values cannot be used; then nothing has changed.
        """
        action = _ACTIONS[order.name]
        try:
            bound = signature(action).bind(self, **order.values)
        except TypeError as error:
            raise ValueError(f"{order.name!r} has {error}") from None
        self._texts_due = None
        wish: Edit | Save | None = action(*bound.args, **bound.kwargs)
        return wish

    def _choose_fixed(self, frame: Any) -> None:
        self._chosen = self._known(frame)
        self._structure = None

    def _select(self, frame: Any) -> None:
        self._selected = self._known(frame)

    def _trail(self, frame: Any, on: Any, seconds: Any = TRAIL_SECONDS) -> None:
        if self._known(frame) is None:
            raise ValueError("a trail needs a frame")
        if not isinstance(on, bool):
            raise TypeError(f"a trail is on or off, got {reprlib.repr(on)}")
        length = _within(seconds, 0.0, _LONGEST_TRAIL, "a trail of seconds")
        if not on:
            self._trails.pop(frame, None)
        elif frame in self._trails or len(self._trails) < MAX_TRAILS:
            self._trails[frame] = length
        else:
            raise ValueError(f"{MAX_TRAILS} trails are drawn already: remove one")

    def _go_live(self) -> None:
        if not self._page.live:
            raise ValueError("a recording has no live data")
        self.timeline = Timeline()
        self._show(self._page.tree)

    def _pause(self) -> None:
        if self.timeline.stamp is None:
            self.hold(self._page.tree.copy())
        self.timeline.playing = False

    def _play(self, speed: Any = 1.0) -> None:
        speed = _within(speed, 0.0, _FASTEST, "a speed")
        self._pause()
        self.timeline.speed = speed
        self.timeline.play()

    def _seek(self, ns: Any) -> None:
        if not isinstance(ns, str) or not re.fullmatch(r"-?[0-9]{1,19}", ns):
            raise ValueError(f"a stamp is a text of digits, got {reprlib.repr(ns)}")
        self._pause()
        self.timeline.seek(int(ns))

    def _step(self, forward: Any, frame: Any = None) -> None:
        if not isinstance(forward, bool):
            raise TypeError(f"a step is forward or not, got {reprlib.repr(forward)}")
        frame = self._known(frame)
        self._pause()
        self.timeline.step(forest_of(self._tree), forward, frame)

    def _home(self) -> None:
        self._pause()
        self.timeline.seek(self.timeline.start)

    def _end(self) -> None:
        self._pause()
        self.timeline.seek(self.timeline.last)

    def _edit(self, frame: Any, xyz: Any, xyzw: Any) -> Edit:
        if frame not in self._page.edit:
            named = ", ".join(self._page.edit) or "none"
            raise ValueError(f"frame {reprlib.repr(frame)} cannot be moved here; those that can: {named}")
        placed = _placed(self._page.tree, frame)
        if placed is None:
            raise ValueError(f"frame {frame!r} is not static, and only static frames can be moved")
        for numbers, count in ((xyz, 3), (xyzw, 4)):
            if not isinstance(numbers, list) or len(numbers) != count or not all(map(is_real, numbers)):
                raise ValueError(f"a pose has 3 numbers of m and 4 of a quaternion, got {reprlib.repr(numbers)}")
        return Edit(placed.parent, frame, Transform(xyz, xyzw))

    def _save(self) -> Save:
        return Save()

    def _known(self, frame: Any) -> str | None:
        """A frame of the tree, or none."""
        if frame is not None and (not isinstance(frame, str) or frame not in self._tree):
            raise ValueError(f"no frame is called {reprlib.repr(frame)}")
        return frame

    # The messages for the browser

    def picture(self, now: int, elapsed: int) -> list[Message]:
        """The messages that bring the browser up to date.

        Parameters
        ----------
        now : int
            The stamp (ns) that ages are counted from.
        elapsed : int
            A monotonic time, in ns, by which the timeline runs. Texts are made four times a second, and after an order.
        """
        self.timeline.advance(0.0 if self._drawn_at is None else (elapsed - self._drawn_at) / SECOND)
        self._drawn_at = elapsed
        stamp = self.timeline.stamp
        with_texts = self._texts_due is None or elapsed >= self._texts_due
        if with_texts:
            self._texts_due = elapsed + _TEXTS_EVERY
        self._follow_edits()
        self._find_fixed()
        then = now if stamp is None else stamp
        return [
            *self._greeting(),
            *self._frames(LATEST if stamp is None else stamp, then, with_texts),
            *self._trail_lines(stamp),
            # It goes out unchanged too, as the sign of life that the browser waits for.
            *([self._time(now)] if with_texts or self.timeline.playing else ()),
            *(self._selection(stamp, then) if with_texts else ()),
        ]

    def _find_fixed(self) -> None:
        forest = forest_of(self._tree)
        with forest.lock:
            structure = forest.structure, len(forest.frames)
        if self._chosen is not None:
            self._fixed = self._chosen
        elif structure != self._structure or self._fixed is None:
            # Only a new structure may have a larger tree, and finding it takes a look at all frames.
            self._fixed = largest_root(forest)
        self._structure = structure

    def _if_new(self, kind: str, message: Message) -> Iterator[Message]:
        if self._sent.get(kind) != message:
            self._sent[kind] = message
            yield message

    def _text(self, kind: str, /, **content: object) -> Iterator[Message]:
        return self._if_new(kind, json.dumps({"type": kind, **content}))

    def _greeting(self) -> Iterator[Message]:
        yield from self._text("hello", **self._page.hello, robot=bool(self._page.robot))
        if self._page.robot and "robot" not in self._sent:
            self._sent["robot"] = ""
            yield self._page.robot
        self._events, events = self._page.events_since(self._events)
        if events:
            yield json.dumps({"type": "events", "events": events})

    def _frames(self, at: int | Latest, then: int, with_texts: bool) -> Iterator[Message]:
        """The frames if they are others, their states if those have changed, and the poses."""
        fixed = self._fixed
        asked = forest_of(self._tree).paths.version, fixed, at
        if asked != self._asked:
            self._asked, self._poses = asked, None
            if fixed is not None:
                with suppress(UnknownFrameError):
                    self._poses = self._reader.read(fixed, at)
        poses = self._poses
        named = self._reader.topology, self._structure, fixed, self._chosen
        if named != self._named:
            self._named = named
            yield from self._name_frames(poses, at)
            with_texts = True
        if with_texts:
            self._other_codes = [self._code_of(frame, at, then) for frame in self._others]
        codes = [] if poses is None else self._codes(poses, then).tolist()
        yield from self._text("states", states=[_STATES[code] for code in (*codes, *self._other_codes)])
        clouds = self._page.clouds
        yield from self._text("clouds", names=list(clouds))
        rows = np.full((len(codes) + len(self._others) + len(clouds), 7), np.nan, np.float32)
        if poses is not None:
            rows[: len(codes)] = poses.columns.T
        for place, (name, source) in enumerate(clouds.items(), len(rows) - len(clouds)):
            points = source.at(None if isinstance(at, Latest) else at)
            if points is not None:
                if self._sent_points.get(name) is not points:
                    self._sent_points[name] = points
                    yield points.message(name)
                row = None if poses is None or fixed is None else self._pose_of_points(name, points, fixed)
                if row is not None:
                    rows[place] = row
        for name in self._sent_points.keys() - clouds.keys():
            del self._sent_points[name]
            self._poses_of_points.pop(name, None)
        yield from self._if_new("poses", struct.pack("<B3x", POSES) + rows.tobytes())

    def _name_frames(self, poses: Poses | None, at: int | Latest) -> Iterator[Message]:
        connected = () if poses is None else poses.frames
        names = self._tree.frames()
        self._others = sorted(set(names).difference(connected))
        places = {frame: place for place, frame in enumerate((*connected, *self._others))}
        parents = [] if poses is None else poses.parents.tolist()
        forest = forest_of(self._tree)
        with forest.lock:
            for frame in self._others:
                history = forest.frames.get(frame)
                parents.append(-1 if history is None else places.get(_parent(history, at), -1))
        yield from self._text(
            "frames",
            names=list(places),
            parents=parents,
            fixed=self._fixed,
            chosen_fixed=self._chosen,
            waiting=not places,
        )

    def _codes(self, poses: Poses, then: int) -> npt.NDArray[np.intp]:
        """The states of the frames with poses, by their numbers."""
        silent = poses.newest == STAMP_MIN
        # The age of a frame without samples would overflow.
        stale = then - np.where(silent, then, poses.newest) > self._page.stale_after
        codes = np.where(silent, _SILENT, np.where(stale, _STALE, _MOVING))
        codes = np.where(poses.static | (poses.parents < 0), _STATIC, codes)
        if self._page.lost and self.timeline.stamp is None:
            lost = np.array([frame in self._page.lost for frame in poses.frames])
            codes[lost & (codes == _STALE)] = _LOST
        return codes

    def _code_of(self, frame: str, at: int | Latest, then: int) -> int:
        """The state of a frame that is not connected with the fixed one."""
        forest = forest_of(self._tree)
        with forest.lock:
            history = forest.frames.get(frame)
            if history is None or history.static:
                return _STATIC
            newest = history.newest if isinstance(at, Latest) else history.around(at)[0]
        if newest is None:
            return _SILENT
        if then - newest <= self._page.stale_after:
            return _MOVING
        return _LOST if isinstance(at, Latest) and frame in self._page.lost else _STALE

    def _pose_of_points(self, name: str, points: Points, fixed: str) -> Row | None:
        """The pose of points at their own stamp; once the history has dropped that stamp, the last pose stays."""
        cloud = points.cloud
        try:
            row = self._tree.lookup(fixed, cloud.frame, cloud.stamp).transform._row
        except TransformLookupError:
            known = self._poses_of_points.get(name)
            return known[2] if known is not None and known[0] is points and known[1] == fixed else None
        self._poses_of_points[name] = points, fixed, row
        return row

    def _trail_lines(self, stamp: int | None) -> Iterator[Message]:
        if not self._trails and "trails" not in self._sent:
            return
        fixed = self._fixed
        found = [
            (frame, seconds, trail(self._tree, fixed, frame, stamp, seconds))
            for frame, seconds in self._trails.items()
            if fixed is not None
        ]
        header = [{"frame": frame, "count": len(points), "seconds": seconds} for frame, seconds, points in found]
        yield from self._if_new("trails", framed(TRAILS, {"trails": header}, *(points for _, _, points in found)))

    def _time(self, now: int) -> Message:
        line = self.timeline
        if line.stamp is None:
            mode, at, span = "live", now, span_of(forest_of(self._tree))
        else:
            mode, at, span = "playing" if line.playing else "paused", line.stamp, (line.start, line.end)
        start, end = (None, None) if span is None else map(str, span)
        return json.dumps(
            {"type": "time", "mode": mode, "at": str(at), "start": start, "end": end, "speed": line.speed}
        )

    def _selection(self, stamp: int | None, then: int) -> Iterator[Message]:
        frame, fixed, at = self._selected, self._fixed, LATEST if stamp is None else stamp
        facts: dict[str, str] = {}
        chain: list[str] = []
        parent = own = ellipsoid = None
        if frame is not None:
            facts = selection_facts(self._tree, fixed, frame, at, then, self._page.delays.get(frame))
            forest = forest_of(self._tree)
            with forest.lock:
                history = forest.frames.get(frame)
                parent = None if history is None else _parent(history, at)
            with suppress(TransformLookupError):
                own = None if parent is None else self._tree.lookup(parent, frame, at).transform
            if fixed is not None:
                with suppress(TransformLookupError):
                    chain = list(reversed(self._tree.chain(fixed, frame, at)))
                    ellipsoid = _ellipsoid(self._tree, fixed, frame, at)
        yield from self._text(
            "selection",
            frame=frame,
            facts={name: printable(text) for name, text in facts.items()},
            chain=chain,
            parent=parent,
            xyz=None if own is None else own.translation,
            xyzw=None if own is None else own.rotation,
            ellipsoid=ellipsoid,
        )
        for edit in self._page.edited():
            xyz, xyzw = edit.transform.translation, edit.transform.rotation
            message = json.dumps({"type": "edited", "frame": edit.frame, "xyz": xyz, "xyzw": xyzw})
            yield from self._if_new(f"edited {edit.frame}", message)

    def _follow_edits(self) -> None:
        """Bring frames that were moved into a history that is held."""
        if self._tree is not self._page.tree:
            for edit in self._page.edited():
                if edit != _placed(self._tree, edit.frame):
                    with suppress(ValueError):
                        self._tree.insert(edit.sample(0, "view"))


def _no_number(text: str) -> None:
    raise ValueError(f"{text} is not a number")


def _within(value: object, above: float, most: float, what: str) -> float:
    if not is_real(value) or not above < value <= most:  # type: ignore[operator]
        raise ValueError(f"{what} is above {above:g} and at most {most:g}, got {reprlib.repr(value)}")
    return float(value)  # type: ignore[arg-type]


def _parent(history: FrameHistory, at: int | Latest) -> str:
    return history.parent if isinstance(at, Latest) else history.parent_at(at)


_ACTIONS: dict[str, Callable[..., Any]] = {
    "fixed": Session._choose_fixed,
    "select": Session._select,
    "trail": Session._trail,
    "live": Session._go_live,
    "pause": Session._pause,
    "play": Session._play,
    "seek": Session._seek,
    "step": Session._step,
    "home": Session._home,
    "end": Session._end,
    "edit": Session._edit,
    "save": Session._save,
}
_STOPPING = ("pause", "play", "seek", "step", "home", "end")

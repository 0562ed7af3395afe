"""The model of the page: the choices that people make in the browser, and the picture that follows from them.

It knows no browser and no event loop. `Page.picture` reads a `Scene` and the trails from the tree, at the stamp of the
`Timeline`. `Page.texts` gives the texts of the side panel. Another thread may feed the tree meanwhile.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from tfbus.errors import TransformLookupError, UnknownFrameError
from tfbus.events import Event
from tfbus.plain import printable
from tfbus.stamps import LATEST, SECOND, STAMP_MIN, Latest, format_age, format_duration, format_stamp, from_seconds
from tfbus.tree.forest import Forest
from tfbus.tree.history import STALE_AFTER, Edge, EdgeState
from tfbus.tree.poses import PoseReader, Poses
from tfbus.tree.rendering import format_rate, legend, to_html
from tfbus.tree.tree import TransformTree, forest_of

SPEEDS = (0.1, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0)
"""The speeds that the page offers, as multiples of real time."""


class Timeline:
    """A stamp that follows the newest data, stands still, or runs through a span at some speed.

    Attributes
    ----------
    stamp : int or None
        The chosen stamp, in ns; None while the page is live.
    start, end : int
        The span in which a stamp can be chosen, in ns.
    playing : bool
        Whether the chosen stamp runs.
    speed : float
        Relative to real time.
    """

    def __init__(self) -> None:
        self.stamp: int | None = None
        self.start: int = 0
        self.end: int = 0
        self.playing: bool = False
        self.speed: float = 1.0

    def choose(self, stamp: int, span: tuple[int, int]) -> None:
        """Stand still at a stamp of a span, both in ns."""
        self.start, self.end = span
        self.stamp = min(max(stamp, self.start), self.end)
        self.playing = False

    def go_live(self) -> None:
        """Follow the newest data."""
        self.stamp = None
        self.playing = False

    def seek(self, stamp: int) -> None:
        """Go to another stamp of the span; while live, nothing happens."""
        if self.stamp is not None:
            self.stamp = min(max(stamp, self.start), self.end)

    def play(self) -> None:
        """Run from the chosen stamp, or from the start if the chosen stamp is the end; while live, nothing happens."""
        if self.stamp is not None:
            self.playing = True
            if self.stamp >= self.end:
                self.stamp = self.start

    def pause(self) -> None:
        """Stand still where the timeline is."""
        self.playing = False

    def advance(self, elapsed: float) -> None:
        """Run for `elapsed` s of real time, and stop at the end of the span."""
        if self.stamp is not None and self.playing:
            self.stamp = min(self.stamp + round(elapsed * self.speed * SECOND), self.end)
            self.playing = self.stamp < self.end

    def step(self, forest: Forest, forward: bool) -> None:
        """Go to the next, or the previous, stamp at which some frame has a sample."""
        if self.stamp is None:
            return
        self.playing = False
        with forest.lock:
            if forward:
                later = [history.neighbours(self.stamp + 1)[1] for history in forest.frames.values()]
                self.seek(min((stamp for stamp in later if stamp is not None), default=self.stamp))
            else:
                earlier = [history.neighbours(self.stamp - 1)[0] for history in forest.frames.values()]
                self.seek(max((stamp for stamp in earlier if stamp is not None), default=self.stamp))


def span_of(forest: Forest) -> tuple[int, int] | None:
    """The oldest and the newest stamp of any moving sample, in ns; None if there is none."""
    with forest.lock:
        oldest = [history.oldest for history in forest.frames.values()]
        newest = [history.newest for history in forest.frames.values()]
    stamps = [stamp for stamp in (*oldest, *newest) if stamp is not None]
    return (min(stamps), max(stamps)) if stamps else None


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
        "chain": " → ".join(reversed(tree.chain(fixed, frame, at))),
    }


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


Floats = npt.NDArray[np.float32]
Colours = npt.NDArray[np.uint8]

_STATES = tuple(EdgeState)
_PALETTE = np.array([[int(state.value[i : i + 2], 16) for i in (1, 3, 5)] for state in _STATES], np.uint8)
_STATIC, _MOVING, _STALE, _SILENT = range(4)
_NO_POSE = -1


class Scene(NamedTuple):
    """The n frames that have a pose in the fixed frame, which comes first, and the m edges between them."""

    frames: tuple[str, ...]
    positions: Floats
    """In m, shape (n, 3)."""
    wxyzs: Floats
    """Quaternions (w, x, y, z), shape (n, 4)."""
    colours: Colours
    """The colour of each frame's state, shape (n, 3)."""
    states: tuple[EdgeState, ...]
    """The state of the edge above each frame; a root is static."""
    parents: npt.NDArray[np.intp]
    """The place of each frame's parent, shape (n,); -1 for a root."""
    lines: Floats
    """From each frame to its parent, shape (m, 2, 3)."""
    line_colours: Colours
    """Shape (m, 2, 3)."""
    chain: tuple[str, ...]
    """The frames from the selected one to the fixed one; empty if none is selected."""
    chain_lines: Floats
    """The edges of the chain, shape (k, 2, 3)."""

    def place(self, frame: str) -> int | None:
        """The place of a frame; None if it has no pose."""
        try:
            return self.frames.index(frame)
        except ValueError:
            return None


NO_SCENE = Scene(
    (),
    np.empty((0, 3), np.float32),
    np.empty((0, 4), np.float32),
    np.empty((0, 3), np.uint8),
    (),
    np.empty(0, np.intp),
    np.empty((0, 2, 3), np.float32),
    np.empty((0, 2, 3), np.uint8),
    (),
    np.empty((0, 2, 3), np.float32),
)


class SceneReader:
    """Reads the scenes of a forest.

    Parameters
    ----------
    forest : Forest
    stale_after : float
        The age, in s, from which a moving frame is stale.
    """

    def __init__(self, forest: Forest, stale_after: float = STALE_AFTER) -> None:
        self._poses = PoseReader(forest)
        self._stale_after = round(stale_after * SECOND)
        self._kept: _Kept | None = None

    @property
    def topology(self) -> object:
        """Another object whenever the frames and their parents may have changed between two scenes."""
        return self._poses.topology

    def read(self, fixed: str, at: int | Latest, now: int, selected: str | None = None) -> Scene:
        """The scene in a fixed frame.

        Parameters
        ----------
        fixed : str
        at : int or LATEST
            ns.
        now : int
            The stamp (ns) that ages are counted from; at a chosen stamp, they are counted from the chosen one.
        selected : str, optional
            The frame whose chain is highlighted.

        Raises
        ------
        UnknownFrameError
            If no sample names the fixed frame.
        """
        poses = self._poses.read(fixed, at)
        codes = self._codes(poses, now if isinstance(at, Latest) else at)
        kept = self._kept
        if kept is None or not kept.holds(poses, codes):
            kept = self._kept = _Kept(poses, codes)
        rows = poses.columns.T if kept.all_drawn else poses.columns.T[codes != _NO_POSE]
        positions = rows[:, :3].astype(np.float32)
        chain = _chain(kept.frames, kept.parents, selected)
        chain_edges = np.array([chain[:-1], chain[1:]], np.intp).T
        return Scene(
            kept.frames,
            positions,
            rows[:, [6, 3, 4, 5]].astype(np.float32),
            kept.colours,
            kept.states,
            kept.parents,
            positions[kept.edges],
            kept.line_colours,
            tuple(kept.frames[place] for place in chain),
            positions[chain_edges] if chain else NO_SCENE.lines,
        )

    def _codes(self, poses: Poses, now: int) -> npt.NDArray[np.intp]:
        silent = poses.newest == STAMP_MIN
        # The age of a frame without samples would overflow.
        stale = now - np.where(silent, now, poses.newest) > self._stale_after
        codes = np.where(silent, _SILENT, np.where(stale, _STALE, _MOVING))
        codes = np.where(poses.static | (poses.parents < 0), _STATIC, codes)
        has_pose = np.isfinite(poses.columns)
        # The usual case: all have one. Asking for each frame takes longer.
        if not has_pose.all():
            codes[~has_pose.all(axis=0)] = _NO_POSE
        return codes


class _Kept:
    """The parts of a scene that stay while the frames only move. Their arrays are kept, so they are not sent again."""

    def __init__(self, poses: Poses, codes: npt.NDArray[np.intp]) -> None:
        self._poses, self._codes = poses, codes
        places = np.flatnonzero(codes != _NO_POSE)
        self.all_drawn = len(places) == len(codes)
        rank = np.full(len(codes) + 1, -1)
        rank[places] = np.arange(len(places))
        self.frames = poses.frames if self.all_drawn else tuple(poses.frames[place] for place in places)
        self.parents: npt.NDArray[np.intp] = rank[poses.parents[places]]
        children = np.flatnonzero(self.parents >= 0)
        self.edges = np.stack((children, self.parents[children]), axis=1)
        self.states = tuple(_STATES[code] for code in codes[places])
        self.colours = _PALETTE[codes[places]]
        self.line_colours = np.repeat(self.colours[children][:, None], 2, axis=1)

    def holds(self, poses: Poses, codes: npt.NDArray[np.intp]) -> bool:
        """Whether these poses differ from the first ones only in the places of the frames."""
        return (
            poses.frames == self._poses.frames
            and np.array_equal(poses.parents, self._poses.parents)
            and np.array_equal(codes, self._codes)
        )


def _chain(frames: Sequence[str], parents: npt.NDArray[np.intp], selected: str | None) -> list[int]:
    """The places on the path from the selected frame to the fixed one, the first; empty if it has no pose."""
    if selected is None or selected not in frames:
        return []
    chains: list[list[int]] = []
    for frame in (selected, frames[0]):
        climbed = [frames.index(frame)]
        while (above := int(parents[climbed[-1]])) >= 0 and above not in climbed:
            climbed.append(above)
        chains.append(climbed)
    up, down = chains
    if up[-1] != down[-1]:
        return []
    while len(up) > 1 and len(down) > 1 and up[-2] == down[-2]:
        up.pop()
        down.pop()
    return up + down[-2::-1]


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


SAMPLES = 300
"""The greatest number of points of a trail."""


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
    array of shape (n, 2, 3)
        Line segments in m, with a break where there is no answer; none if the frame has no pose, or a static one.
    """
    nothing = np.empty((0, 2, 3), np.float32)
    try:
        if at is None:
            newest = tree.lookup(fixed, frame, LATEST)
            if newest.static:
                return nothing
            at = newest.stamp
        stamps = np.linspace(at - from_seconds(duration), at, SAMPLES).astype(np.int64)
        stamps[-1] = at
        found = tree.lookup_many(fixed, frame, stamps, out_of_range="nan")
    except TransformLookupError:
        return nothing
    points = found.translations.astype(np.float32)
    lines = np.stack((points[:-1], points[1:]), axis=1)
    return lines[np.isfinite(lines).all(axis=(1, 2))]


Labels = Literal["selection", "all", "none"]

EVENTS_KEPT = 100
_TRAIL_DURATION = 10.0
"""s."""
_MATCHES = 200


class Picture(NamedTuple):
    """The content of the 3D part of the page."""

    scene: Scene
    labels: tuple[str, ...]
    """The frames that have a label."""
    trails: Floats
    """Line segments in m, shape (n, 2, 3)."""


class Texts(NamedTuple):
    """The content of the side panel, as HTML; frames as plain names."""

    status: str
    selection: str
    tree: str
    events: str
    frames: tuple[str, ...]
    """All frames, sorted."""
    matches: tuple[str, ...]
    """The frames that match the search, sorted."""
    fixed: str | None
    """The fixed frame that was chosen; None for the root of the largest tree."""
    selected: str | None


class Page:
    """The state of the page.

    Parameters
    ----------
    tree : TransformTree
        The tree to show; a bus may feed it.
    fixed : str, optional
        The fixed frame; by default the root of the largest tree.
    trails : iterable of str
        Frames with a trail.
    live : bool
        Whether the page starts with the newest data and may return to them. Otherwise it starts at the oldest stamp,
        as for a recording.
    stale_after : float
        The age, in s, from which a moving frame is stale.

    Attributes
    ----------
    live : bool
    timeline : Timeline
    selected : str or None
    chosen_fixed : str or None
        The fixed frame that was chosen; None for the root of the largest tree.
    labels : {"selection", "all", "none"}
    trails : dict with the frames that have a trail as keys
    search : str
    delays : mapping of str to float
        The delay of each frame, in s.
    """

    def __init__(
        self,
        tree: TransformTree,
        fixed: str | None = None,
        trails: Iterable[str] = (),
        live: bool = True,
        stale_after: float = STALE_AFTER,
    ) -> None:
        self.live = live
        self.timeline: Timeline = Timeline()
        self.selected: str | None = None
        self.chosen_fixed = fixed
        self.labels: Labels = "selection"
        self.trails: dict[str, str | None] = dict.fromkeys(trails)
        self.search = ""
        self.delays: Mapping[str, float] = {}
        self._events: tuple[Event, ...] = ()
        self._live_tree = tree
        self._root: str | None = None
        self._counted: object = None
        self._stale_after = stale_after
        self._tree_key: object = None
        self._tree_html = ""
        self._show(tree)
        if not live:
            start, end = span_of(forest_of(tree)) or (0, 0)
            self.timeline.choose(start, (start, end))

    @property
    def tree(self) -> TransformTree:
        """The tree that is shown: the live tree, or, while a stamp is chosen, a copy from the moment of the choice."""
        return self._tree

    @property
    def fixed(self) -> str | None:
        """The fixed frame; None while there are no frames."""
        if self.chosen_fixed is not None:
            return self.chosen_fixed
        if self._root is None or self._root not in self._tree or self._tree.parent(self._root) is not None:
            self._root = largest_root(forest_of(self._tree))
        return self._root

    def freeze(self) -> None:
        """Stand still at the newest stamp, on a copy of the history, because the live tree forgets old samples."""
        if self.timeline.stamp is not None:
            self.timeline.pause()
            return
        tree = self._live_tree.copy()
        span = span_of(forest_of(tree))
        if span is not None:
            self._show(tree)
            self.timeline.choose(span[1], span)

    def go_live(self) -> None:
        """Show the newest data again; a recording has none, and stays where it is."""
        if self.live:
            self.timeline.go_live()
            self._show(self._live_tree)

    def play(self) -> None:
        """Play from the chosen stamp; while live, play the present history."""
        self.freeze()
        self.timeline.play()

    def step(self, forward: bool) -> None:
        """Stand still at the next, or the previous, sample of any frame."""
        self.freeze()
        self.timeline.step(forest_of(self._tree), forward)

    def choose_fixed(self, frame: str | None) -> None:
        """Choose the fixed frame; None for the root of the largest tree."""
        self.chosen_fixed = frame

    def select(self, frame: str | None) -> None:
        """Select a frame, or none."""
        self.selected = frame

    def toggle_trail(self) -> None:
        """Show or hide the trail of the selected frame."""
        if self.selected is None:
            return
        if self.selected in self.trails:
            del self.trails[self.selected]
        else:
            self.trails[self.selected] = None

    def note_event(self, event: Event) -> None:
        """Keep an event to show, from one thread; the oldest are forgotten."""
        # A new tuple, because another thread may be reading the old one.
        self._events = (event, *self._events[: EVENTS_KEPT - 1])

    def picture(self, now: int) -> Picture:
        """The picture at the chosen stamp, or of the newest data; ages are counted from the stamp `now`, in ns."""
        fixed, at = self.fixed, self.timeline.stamp
        if fixed is None:
            return Picture(NO_SCENE, (), NO_SCENE.lines)
        try:
            scene = self._scenes.read(fixed, LATEST if at is None else at, now, self.selected)
        except UnknownFrameError:
            return Picture(NO_SCENE, (), NO_SCENE.lines)
        trails = [trail(self._tree, fixed, frame, at, _TRAIL_DURATION) for frame in self.trails]
        labels: tuple[str, ...] = ()
        if self.labels == "all":
            labels = scene.frames
        elif self.labels == "selection":
            labels = scene.chain
        return Picture(scene, labels, np.concatenate(trails) if trails else NO_SCENE.lines)

    def texts(self, now: int, scene: Scene) -> Texts:
        """The texts of the side panel beside a scene, with ages from the stamp `now`, in ns."""
        at = self.timeline.stamp
        # Not for each picture, because all frames are counted.
        if self._scenes.topology is not self._counted:
            self._counted = self._scenes.topology
            self._root = None
        frames = tuple(self._tree.frames())
        then = now if at is None else at
        facts: dict[str, str] = {}
        if self.selected is not None:
            delay = self.delays.get(self.selected)
            asked = LATEST if at is None else at
            facts = selection_facts(self._tree, self.fixed, self.selected, asked, then, delay)
        wanted = self.search.casefold()
        matches = tuple(frame for frame in frames if wanted in frame.casefold()) if wanted else frames
        return Texts(
            self._status(frames, len(scene.frames)),
            _block(_table(facts) if facts else "Click on a frame, or search for one."),
            self._tree_text(frames, scene, then),
            _block("<br>".join(escape(str(event)) for event in self._events) or "none so far"),
            frames,
            matches[:_MATCHES],
            self.chosen_fixed,
            self.selected,
        )

    def _tree_text(self, frames: tuple[str, ...], scene: Scene, then: int) -> str:
        """The tree as HTML. It is long, so it is made anew only after a change."""
        key = (frames, scene.frames, scene.states, scene.parents.tobytes(), self.selected)
        if key != self._tree_key:
            self._tree_key = key
            marked = () if self.selected is None else (self.selected,)
            html = to_html(self._tree.edges(), then, self._stale_after, marked=marked, with_facts=False)
            self._tree_html = _block(html + legend())
        return self._tree_html

    def _status(self, frames: tuple[str, ...], drawn: int) -> str:
        line, fixed = self.timeline, self.fixed
        if not frames:
            return _block("waiting for transforms …")
        when = "live"
        if line.stamp is not None:
            offset = (line.stamp - line.start) / SECOND
            kind = f"playing × {line.speed:g}" if line.playing else "paused"
            when = f"{kind} at {format_stamp(line.stamp)}, {offset:.3f} s from the start"
        status = f"{when} · {drawn} of {len(frames)} frames are connected with {fixed!r}"
        if fixed not in frames:
            status = f"{when} · the fixed frame {fixed!r} is not known: choose another one"
        return _block(escape(status))

    def _show(self, tree: TransformTree) -> None:
        self._tree = tree
        self._root = None
        self._counted = None
        self._scenes = SceneReader(forest_of(tree), self._stale_after)


def _block(content: str) -> str:
    """HTML with the margins and the size of viser's own texts."""
    return f'<div style="padding: 0.3em 0.8em; font-size: 13px; line-height: 1.4">{content}</div>'


def _table(facts: Mapping[str, str]) -> str:
    label = "vertical-align: top; padding-right: 0.8em; opacity: 0.7"
    rows = (
        f'<tr><td style="{label}">{escape(name)}</td><td style="word-break: break-word">{escape(text)}</td></tr>'
        for name, text in zip(facts, map(printable, facts.values()), strict=True)
    )
    return f'<table style="font-size: 13px; line-height: 1.4">{"".join(rows)}</table>'

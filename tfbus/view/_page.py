"""The model of the page: the choices that people make in the browser, and the picture that follows from them.

It knows no browser and no event loop. `Page.picture` reads the tree at one instant; `Page.texts` gives what the side
panel says.
"""

from collections import deque
from collections.abc import Iterable, Mapping
from html import escape
from typing import Literal, NamedTuple

import numpy as np

from tfbus.errors import UnknownFrameError
from tfbus.events import Event
from tfbus.plain import printable
from tfbus.stamps import LATEST, SECOND, format_stamp
from tfbus.tree.edge_state import STALE_AFTER
from tfbus.tree.html import legend, to_html
from tfbus.tree.tree import TransformTree, forest_of
from tfbus.view._scene import NO_SCENE, Floats, Scene, SceneReader, largest_root
from tfbus.view._selection import selection_facts
from tfbus.view._timeline import Timeline, span_of
from tfbus.view._trails import trail

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
        self.timeline = Timeline()
        self.selected: str | None = None
        self.chosen_fixed = fixed
        self.labels: Labels = "selection"
        self.trails = dict.fromkeys(trails)
        self.search = ""
        self.delays: Mapping[str, float] = {}
        self._events: deque[Event] = deque(maxlen=EVENTS_KEPT)
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
        """The tree that is shown: the live one, or while a stamp is chosen the copy that was made then."""
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
        """Stand still at the newest stamp, on a copy of the history: the live one would forget it after a while."""
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
        """Play from the chosen stamp; while live, play the history that there is by now."""
        self.freeze()
        self.timeline.play()

    def step(self, forward: bool) -> None:
        """Stand still at the next sample of any frame, or the one before."""
        self.freeze()
        self.timeline.step(forest_of(self._tree), forward)

    def choose_fixed(self, frame: str | None) -> None:
        """Choose the fixed frame; None for the root of the largest tree."""
        self.chosen_fixed = frame

    def select(self, frame: str | None) -> None:
        """Select a frame, or none."""
        self.selected = frame

    def toggle_trail(self) -> None:
        """Draw the trail of the selected frame, or no longer."""
        if self.selected is None:
            return
        if self.selected in self.trails:
            del self.trails[self.selected]
        else:
            self.trails[self.selected] = None

    def note_event(self, event: Event) -> None:
        """Keep an event to show; the oldest are forgotten."""
        self._events.append(event)

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
            _block("<br>".join(escape(str(event)) for event in reversed(self._events)) or "none so far"),
            frames,
            matches[:_MATCHES],
            self.chosen_fixed,
            self.selected,
        )

    def _tree_text(self, frames: tuple[str, ...], scene: Scene, then: int) -> str:
        """The tree as HTML, which is long: made anew only if something in it has changed."""
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

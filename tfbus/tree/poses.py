"""The poses of all frames in a fixed frame, for pictures of the tree; faster than a lookup for each frame.

The tree is walked from the fixed frame outwards, and the edges above that frame are inverted. Each edge is read once
for each stamp at which it is needed: usually once. The samples are read under the lock and composed after that. While
the structure of the tree stays, a picture of the newest samples reads nothing but these samples.
"""

from collections.abc import Sequence
from struct import Struct
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tfbus.errors import TransformLookupError
from tfbus.rows import IDENTITY, Row, invert
from tfbus.stamps import LATEST, STAMP_MIN, Latest
from tfbus.tree.forest import Forest
from tfbus.tree.history import FrameHistory
from tfbus.tree.lookup import find
from tfbus.which_kernel import compose_paths

_WIDTH = 7
_pack = Struct(f"{_WIDTH}d").pack
_IDENTITY = _pack(*IDENTITY)
_NO_ROW = _pack(*(np.nan,) * _WIDTH)


class Poses(NamedTuple):
    """The poses of the frames that are connected with a fixed frame, which comes first."""

    frames: tuple[str, ...]
    columns: npt.NDArray[np.float64]
    """Translation (m) and quaternion (x, y, z, w) of each frame in the fixed frame, shape (7, n)."""
    parents: npt.NDArray[np.intp]
    """The place of each frame's parent in `frames`, shape (n,); -1 for a root."""
    answered: npt.NDArray[np.bool_]
    """Whether a lookup gives this pose, shape (n,). If not, an edge that does not cover the stamp is read at its
    nearest sample; the columns are NaN where an edge has no sample at all."""
    static: npt.NDArray[np.bool_]
    """Whether the edge between each frame and its parent is static, shape (n,); False for a root."""
    newest: npt.NDArray[np.int64]
    """The stamp (ns) of the newest sample of each frame, not after the stamp asked for, shape (n,); `STAMP_MIN` for a
    static frame, a root, and where there is none."""


class _Plan(NamedTuple):
    """The order in which the frames are reached from the fixed frame."""

    topology: tuple[list[str], list[str]]
    """All children, and their parents."""
    frames: list[str]
    origins: list[int]
    """For each frame, the place of the frame from which the walk reaches it; for the first frame, its own."""
    edges: list[str]
    """For each frame, the child of the edge by which the walk reaches it."""
    inverted: list[bool]
    parents: npt.NDArray[np.intp]


class PoseReader:
    """Reads the poses of all frames of a forest again and again; it keeps the order of the frames while that holds.

    Parameters
    ----------
    forest : Forest

    Attributes
    ----------
    topology : object
        Another object whenever the frames and their parents may have changed between two readings.
    """

    def __init__(self, forest: Forest) -> None:
        self._forest = forest
        self._plans: dict[str, _Plan] = {}
        self._newest: _Newest | None = None
        self.topology: object = None

    def read(self, fixed: str, at: int | Latest = LATEST) -> Poses:
        """The poses in the frame `fixed` at a stamp; with `LATEST`, each frame at its own newest stamp.

        Raises
        ------
        UnknownFrameError
            If no sample names `fixed`.
        """
        if isinstance(at, Latest):
            newest, records = self._read_newest(fixed)
            poses = newest.poses(records)
            if poses is not None:
                return poses
        return self._read_any(fixed, at)

    def _read_newest(self, fixed: str) -> tuple["_Newest", list[bytes]]:
        forest = self._forest
        with forest.lock:
            forest.check_known(fixed)
            state = fixed, forest.structure, len(forest.frames)
            newest = self._newest
            if newest is None or newest.state != state:
                plan = self._plan(fixed, LATEST)
                newest = self._newest = _Newest(state, plan, [forest.frames.get(child) for child in plan.edges])
            return newest, [history.newest_record for history in newest.moving]

    def _read_any(self, fixed: str, at: int | Latest) -> Poses:
        """The poses by samples of any stamps and parents."""
        forest = self._forest
        with forest.lock:
            forest.check_known(fixed)
            plan = self._plan(fixed, at)
            histories = [forest.frames.get(child) for child in plan.edges]
            gathered = _gather(plan, histories, at)
            # At the stamp, a frame may have had another parent, or two in a loop.
            reparented = any(history.mixed for history in forest.frames.values())
            corrections = [_find(forest, fixed, frame, at) for frame in plan.frames] if reparented else []
            static, newest = self._own_edges(plan, at)
        columns, answered = gathered.compose()
        for place, row in enumerate(corrections):
            answered[place] = row is not None
            if row is not None:
                columns[:, place] = row
        return Poses(tuple(plan.frames), columns, plan.parents, answered, static, newest)

    def _own_edges(self, plan: _Plan, at: int | Latest) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.int64]]:
        """Whether the edge above each frame is static, and its newest stamp."""
        own = [self._forest.frames.get(frame) for frame in plan.frames]
        static = np.array([history is not None and history.static for history in own])
        if isinstance(at, Latest):
            newest = [STAMP_MIN if history is None else _stamp_or_least(history.newest) for history in own]
        else:
            newest = [STAMP_MIN if history is None else _stamp_or_least(history.around(at)[0]) for history in own]
        return static, np.array(newest, np.int64)

    def _plan(self, fixed: str, at: int | Latest) -> _Plan:
        frames = self._forest.frames
        if isinstance(at, Latest):
            parents = [history.parent for history in frames.values()]
        else:
            parents = [history.parent_at(at) for history in frames.values()]
        # Not pairs: a thousand new tuples for each picture keep the garbage collector busy.
        topology = list(frames), parents
        plan = self._plans.get(fixed)
        if plan is None or plan.topology != topology:
            # Only one: a picture seldom changes its fixed frame.
            self._plans = {fixed: (plan := _make_plan(fixed, topology))}
            self.topology = topology
        return plan


def _make_plan(fixed: str, topology: tuple[list[str], list[str]]) -> _Plan:
    above = dict(zip(*topology, strict=True))
    below: dict[str, list[str]] = {}
    for child, parent in above.items():
        below.setdefault(parent, []).append(child)
    places = {fixed: 0}
    frames, origins, edges, inverted = [fixed], [0], [""], [False]
    for place, frame in enumerate(frames):
        reached = [(child, child, False) for child in below.get(frame, ())]
        if frame in above:
            reached.append((above[frame], frame, True))
        for other, child, upwards in reached:
            if other not in places:
                places[other] = len(frames)
                frames.append(other)
                origins.append(place)
                edges.append(child)
                inverted.append(upwards)
    parents = [places.get(above.get(frame, ""), -1) for frame in frames]
    return _Plan(topology, frames, origins, edges, inverted, np.array(parents, np.intp))


class _Gathered(NamedTuple):
    """The edges of a plan, each read at the stamps that the frames behind it need."""

    plan: _Plan
    rows: bytearray
    """The row of each edge, seven floats."""
    places: list[int]
    """The place of the frame behind each edge."""
    origins: list[int]
    """For each edge, the index of the edge before it on the way from the fixed frame."""
    answered: list[bool]
    own: list[int]
    """For each frame, the index of its edge at its own stamp."""

    def compose(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
        """The poses of the frames as columns of shape (7, n), and whether each is answered."""
        rows = np.frombuffer(self.rows, np.float64).reshape(-1, _WIDTH)
        inverted = np.array(self.plan.inverted, np.bool_)
        _turn_round(rows, np.flatnonzero(inverted[self.places]))
        compose_paths(rows, np.array(self.origins, np.int64))
        return rows.T[:, self.own], np.array(self.answered, np.bool_)[self.own]


def _turn_round(rows: npt.NDArray[np.float64], places: npt.NDArray[np.intp]) -> None:
    """Invert the rows at these places."""
    if len(places):
        rows[places] = np.stack(invert((*rows[places].T,)), axis=1)


class _Newest:
    """The poses by the newest samples, as long as the structure of the forest stays.

    Parameters
    ----------
    state : object
        Another value whenever the structure of the forest may have changed.
    plan : _Plan
    histories : sequence of FrameHistory
        Of each edge of the plan; None for the first.

    Attributes
    ----------
    state : object
    moving : list of FrameHistory
        The moving edges; `poses` takes the newest record of each.
    """

    def __init__(self, state: object, plan: _Plan, histories: Sequence[FrameHistory | None]) -> None:
        self.state = state
        self._plan = plan
        self._frames = tuple(plan.frames)
        moving = {place: each for place, each in enumerate(histories) if each is not None and not each.static}
        self.moving = list(moving.values())
        self._places = np.array(list(moving), np.intp)
        rows = [history.static_row if history is not None and history.static else IDENTITY for history in histories]
        self._rows = np.array(rows)
        self._upside_down = np.flatnonzero(plan.inverted)
        self._origins = np.array(plan.origins, np.int64)
        is_moving = {child: place in moving for place, child in enumerate(plan.edges) if place}
        self._static = np.array([not is_moving.get(frame, True) for frame in plan.frames])
        self._is_moving = np.array([is_moving.get(frame, False) for frame in plan.frames])

    def poses(self, records: Sequence[bytes]) -> Poses | None:
        """The poses; None if the records have several stamps, or an edge has none.

        At the newest stamp of all edges, the parents are the newest ones.
        """
        block = np.frombuffer(b"".join(records)).reshape(-1, 1 + _WIDTH)
        stamps = block[:, 0].copy().view(np.int64)
        if len(block) != len(records) or (stamps != stamps[:1]).any():
            return None
        rows = self._rows.copy()
        rows[self._places] = block[:, 1:]
        _turn_round(rows, self._upside_down)
        compose_paths(rows, self._origins)
        newest = np.full(len(self._frames), STAMP_MIN)
        if len(stamps):
            newest[self._is_moving] = stamps[0]
        answered = np.ones(len(self._frames), np.bool_)
        return Poses(self._frames, rows.T, self._plan.parents, answered, self._static, newest)


def _gather(plan: _Plan, histories: Sequence[FrameHistory | None], at: int | Latest) -> _Gathered:
    """Read every edge; the caller holds the lock of the forest.

    The inner functions share local lists, because attributes would cost half as much again.
    """
    gathered = _Gathered(plan, bytearray(), [], [], [], [])
    _, rows, places, origins, answered, own = gathered
    before_each = plan.origins
    # The stamp of each frame; None while no edge from the fixed frame to it has samples: static ones hold at any stamp.
    stamps: list[int | None] = []
    others: dict[tuple[int, int], int] = {}

    def add(place: int, stamp: int | None, above: int) -> int:
        """Read one edge at one stamp; where it has no sample, its nearest stands in."""
        nonlocal rows
        history = histories[place]
        is_answered = True
        if history is None:
            row = _IDENTITY
        elif history.static:
            row = _pack(*history.static_row)
        elif (newest := history.newest) is None or stamp is None:
            row, is_answered = _NO_ROW, False
        elif stamp >= newest:
            row, is_answered = _pack(*history.sample(history.count - 1)[1]), stamp == newest
        else:
            oldest = history.stamp(0)
            row, is_answered = _pack(*history.row_at(max(stamp, oldest))), stamp >= oldest
        index = len(places)
        rows += row
        places.append(place)
        origins.append(above)
        answered.append(is_answered and (index == 0 or answered[above]))
        return index

    def add_at_another_stamp(place: int, stamp: int) -> int:
        """The index of a frame at a stamp that is not its own, with all before it on the path."""
        ahead = []
        while stamps[place] is not None and stamps[place] != stamp and (place, stamp) not in others:
            ahead.append(place)
            place = before_each[place]
        index = others.get((place, stamp), own[place])
        for here in reversed(ahead):
            index = others[here, stamp] = add(here, stamp, index)
        return index

    for place, history in enumerate(histories):
        origin = before_each[place]
        before = stamp = stamps[origin] if place else None
        if history is not None and not history.static:
            if isinstance(at, int):
                stamp = at
            elif (newest := history.newest) is not None and (before is None or newest < before):
                stamp = newest
        stamps.append(stamp)
        if before is None or before == stamp:
            above = own[origin] if place else 0
        else:
            assert stamp is not None
            above = add_at_another_stamp(origin, stamp)
        own.append(add(place, stamp, above))
    return gathered


def _stamp_or_least(stamp: int | None) -> int:
    return STAMP_MIN if stamp is None else stamp


def _find(forest: Forest, fixed: str, frame: str, at: int | Latest) -> Row | None:
    try:
        return find(forest, fixed, frame, at, None)[1]
    except TransformLookupError:
        return None

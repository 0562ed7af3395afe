"""The geometry of the page at one instant: where each frame is, in which state, and what is highlighted."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tfbus.stamps import SECOND, STAMP_MIN, Latest
from tfbus.tree.forest import Forest
from tfbus.tree.history import STALE_AFTER, EdgeState
from tfbus.tree.poses import PoseReader, Poses

Floats = npt.NDArray[np.float32]
Colours = npt.NDArray[np.uint8]

_STATES = tuple(EdgeState)
_PALETTE = np.array([[int(state.value[i : i + 2], 16) for i in (1, 3, 5)] for state in _STATES], np.uint8)
_STATIC, _MOVING, _STALE, _SILENT = range(4)
_NO_POSE = -1


class Scene(NamedTuple):
    """The frames that have a pose in the fixed frame, which comes first; n of them, with m edges between them."""

    frames: tuple[str, ...]
    positions: Floats
    """In m, shape (n, 3)."""
    wxyzs: Floats
    """Quaternions (w, x, y, z), shape (n, 4)."""
    colours: Colours
    """Of each frame's state, shape (n, 3)."""
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
            The stamp (ns) that ages are counted from; at a chosen stamp, ages are counted from that.
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
        silent = poses.heard == STAMP_MIN
        # The age of a silent frame would overflow.
        stale = now - np.where(silent, now, poses.heard) > self._stale_after
        codes = np.where(silent, _SILENT, np.where(stale, _STALE, _MOVING))
        codes = np.where(poses.static | (poses.parents < 0), _STATIC, codes)
        has_pose = np.isfinite(poses.columns)
        # Nearly always all have one; to ask for each frame takes longer.
        if not has_pose.all():
            codes[~has_pose.all(axis=0)] = _NO_POSE
        return codes


class _Kept:
    """The parts of a scene that stay while the frames only move: the same arrays, so that they are not sent again."""

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
        """Whether these poses differ from the first ones in nothing but where the frames are."""
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

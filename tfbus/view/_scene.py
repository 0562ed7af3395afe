"""The geometry of the page at one instant: where each frame is, in which state, and what is highlighted."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tfbus.stamps import SECOND, STAMP_MIN, Latest
from tfbus.tree.edge_state import STALE_AFTER, EdgeState
from tfbus.tree.forest import Forest
from tfbus.tree.poses import PoseReader, Poses

Floats = npt.NDArray[np.float32]
Colours = npt.NDArray[np.uint8]

_STATES = tuple(EdgeState)
_PALETTE = np.array([[int(state.value[i : i + 2], 16) for i in (1, 3, 5)] for state in _STATES], np.uint8)
_STATIC, _MOVING, _STALE, _SILENT = range(4)


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
        drawn = np.flatnonzero(np.isfinite(poses.columns).all(axis=0))
        rank = np.full(len(poses.frames) + 1, -1)
        rank[drawn] = np.arange(len(drawn))
        parents = rank[poses.parents[drawn]]
        positions = poses.columns[:3, drawn].T.astype(np.float32)
        wxyzs = poses.columns[[6, 3, 4, 5]][:, drawn].T.astype(np.float32)
        colours = _PALETTE[codes[drawn]]
        children = np.flatnonzero(parents >= 0)
        frames = poses.frames if len(drawn) == len(poses.frames) else tuple(poses.frames[place] for place in drawn)
        chain = _chain(frames, parents, selected)
        return Scene(
            frames,
            positions,
            wxyzs,
            colours,
            tuple(map(_STATES.__getitem__, codes[drawn].tolist())),
            parents,
            _lines(positions, children, parents[children]),
            np.repeat(colours[children][:, None], 2, axis=1),
            tuple(frames[place] for place in chain),
            _lines(positions, np.array(chain[:-1], np.intp), np.array(chain[1:], np.intp)),
        )

    def _codes(self, poses: Poses, now: int) -> npt.NDArray[np.intp]:
        silent = poses.heard == STAMP_MIN
        # The age of a silent frame would overflow.
        stale = now - np.where(silent, now, poses.heard) > self._stale_after
        codes = np.where(silent, _SILENT, np.where(stale, _STALE, _MOVING))
        return np.where(poses.static | (poses.parents < 0), _STATIC, codes)


def _lines(positions: Floats, begins: npt.NDArray[np.intp], ends: npt.NDArray[np.intp]) -> Floats:
    return np.stack((positions[begins], positions[ends]), axis=1)


def _chain(frames: Sequence[str], parents: npt.NDArray[np.intp], selected: str | None) -> list[int]:
    """The places on the path from the selected frame to the fixed one, the first; empty if it has no pose."""
    if selected not in frames:
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

"""The samples of a frame as plain columns: to write a tree to a pickle, and to read single samples."""

from collections.abc import Iterator
from itertools import groupby
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tfbus.geometry.rows import Row
from tfbus.geometry.stamped import TransformStamped
from tfbus.geometry.transform import from_row
from tfbus.stamps import STAMP_MAX, STAMP_MIN, Stamps
from tfbus.tree.history import FrameHistory


class SavedFrame(NamedTuple):
    """All samples of one frame, in types of Python and numpy."""

    child: str
    parent: str
    """Of the newest sample; it stays when a frame has none."""
    authority: str
    static: tuple[int, Row] | None
    """The stamp and the transform of a frame that is static."""
    stamps: Stamps
    """ns, ascending."""
    rows: npt.NDArray[np.float64]
    """Translation (m) and quaternion (x, y, z, w) of each sample; shape (n, 7)."""
    runs: list[tuple[str, str, int]]
    """Parent and authority, and how many samples have them one after the other."""


def save_frame(history: FrameHistory, oldest: int = STAMP_MIN) -> SavedFrame:
    """The samples of a frame from the stamp `oldest` on, in ns; a static sample has no age."""
    stamps, rows, origins = _columns(history, oldest, STAMP_MAX)
    first = int(np.searchsorted(stamps, oldest))
    runs = [(parent, authority, len(list(run))) for (parent, authority), run in groupby(origins[first:])]
    static = None
    if history.static and history.static_stamp is not None:
        static = history.static_stamp, history.static_row
    return SavedFrame(history.child, history.parent, history.authority, static, stamps[first:], rows[first:], runs)


def load_frame(saved: SavedFrame, window: int | None) -> FrameHistory:
    """A history with the samples that were saved, and a window in ns before the newest."""
    history = FrameHistory(saved.child, saved.parent, saved.static is not None, window)
    history.authority = saved.authority
    if saved.static is not None:
        stamp, row = saved.static
        history.insert_static(saved.parent, stamp, row, saved.authority)
    first = 0
    for parent, authority, count in saved.runs:
        end = first + count
        history.insert(parent, int(saved.stamps[first]), _row(saved.rows[first]), authority)
        if history.can_append(parent, authority, STAMP_MAX):
            if count > 1:
                history.append_many(saved.stamps[first + 1 : end], saved.rows[first + 1 : end])
        else:
            for at in range(first + 1, end):
                history.insert(parent, int(saved.stamps[at]), _row(saved.rows[at]), authority)
        first = end
    history.changed = False
    return history


def samples_of(history: FrameHistory, low: int, high: int) -> Iterator[TransformStamped]:
    """The moving samples from stamp `low` to `high`, and the next one on either side; or the static one."""
    if history.static:
        stamp = history.static_stamp or 0
        yield TransformStamped(
            history.parent, history.child, stamp, from_row(history.static_row), history.authority, static=True
        )
        return
    stamps, rows, origins = _columns(history, low, high)
    for stamp, row, (parent, authority) in zip(stamps.tolist(), rows, origins, strict=True):
        yield TransformStamped(parent, history.child, stamp, from_row(_row(row)), authority)


def _columns(
    history: FrameHistory, low: int, high: int
) -> tuple[Stamps, npt.NDArray[np.float64], list[tuple[str, str]]]:
    """Stamps, rows, parents and authorities of the samples from `low` to `high`, and of the next one on either side."""
    samples = history.samples_between(low, high)
    count = len(samples)
    parents = samples.parents or [history.parent] * count
    authorities = samples.authorities or [history.authority] * count
    return samples.stamps, np.ascontiguousarray(samples.rows), list(zip(parents, authorities, strict=True))


def _row(row: npt.NDArray[np.float64]) -> Row:
    x, y, z, qx, qy, qz, qw = row.tolist()
    return x, y, z, qx, qy, qz, qw

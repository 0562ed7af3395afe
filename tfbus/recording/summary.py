"""`summarise`, which lists the parents, rates, gaps and authorities of all frames in a recording, and its problems.

The recording is read once and not kept: only one stamp, 8 bytes, of each moving transform stays in memory.
"""

from array import array
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tfbus.geometry.stamped import TransformStamped
from tfbus.recording.load import sound_samples
from tfbus.recording.recording import RecordedMessage, Recording
from tfbus.stamps import SECOND


@dataclass(frozen=True, slots=True)
class FrameSummary:
    """The summary of one frame of a recording; values that need more moving samples than there are, are None.

    Parameters
    ----------
    frame : str
    parents : tuple of str
        All parents of the frame, in the order of their first samples.
    static, moving : int
        The number of samples of each kind.
    oldest, newest : int or None
        The stamps of the moving samples, in ns.
    rate : float or None
        The number of different stamps per second, over the span.
    longest_gap : float or None
        The longest time between two successive stamps, in s.
    authorities : tuple of str
        The authorities that sent samples of the frame, in the order of their first samples; without the empty one.
    """

    frame: str
    parents: tuple[str, ...]
    static: int
    moving: int
    oldest: int | None
    newest: int | None
    rate: float | None
    longest_gap: float | None
    authorities: tuple[str, ...]

    @property
    def kind(self) -> str:
        """``"static"``, ``"moving"`` or ``"both"``."""
        return "both" if self.static and self.moving else "static" if self.static else "moving"

    @property
    def span(self) -> float | None:
        """The time from the oldest to the newest stamp, in s."""
        return None if self.oldest is None or self.newest is None else (self.newest - self.oldest) / SECOND


@dataclass(frozen=True, slots=True)
class RecordingSummary:
    """The summary of a recording.

    Parameters
    ----------
    path : Path
    finished : bool
        As `Recording.finished`.
    start, end : int or None
        The log times of the first and the last message on any topic, in ns; None if there is none.
    messages, transforms : int
        The number of messages on ``/tf`` and ``/tf_static``, and of the valid transforms in them.
    frames : tuple of FrameSummary
        Every frame that has a parent, sorted by name.
    roots : tuple of str
        The frames that have no parent, sorted.
    problems : mapping of str to int
        The number of transforms and messages that were left out, by reason.
    """

    path: Path
    finished: bool
    start: int | None
    end: int | None
    messages: int
    transforms: int
    frames: tuple[FrameSummary, ...]
    roots: tuple[str, ...]
    problems: Mapping[str, int]

    @property
    def duration(self) -> float | None:
        """The time from the first to the last log time, in s."""
        return None if self.start is None or self.end is None else (self.end - self.start) / SECOND


def summarise(recording: Recording, messages: Iterable[RecordedMessage] | None = None) -> RecordingSummary:
    """Read a recording and summarise it.

    Parameters
    ----------
    recording : Recording
    messages : iterable of RecordedMessage, optional
        The messages to read, such as an iterator that shows the progress; by default, all messages of the recording.
    """
    frames: dict[str, _Frame] = {}
    named: set[str] = set()
    problems: Counter[str] = Counter()
    count = 0
    for _, batch, errors in recording.messages() if messages is None else messages:
        count += 1
        if errors:
            problems.update(error.reason for error in errors)
        for sample in sound_samples(frames, batch, named, problems):
            child = sample.child
            named.add(sample.parent)
            frame = frames.get(child)
            if frame is None:
                frame = frames[child] = _Frame(child)
            frame.count(sample)
    parents = {parent for frame in frames.values() for parent in frame.parents}
    return RecordingSummary(
        recording.path,
        recording.finished,
        recording.start,
        recording.end,
        count,
        sum(frame.static_count + len(frame.stamps) for frame in frames.values()),
        tuple(frames[child].summary() for child in sorted(frames)),
        tuple(sorted(parents - frames.keys())),
        dict(problems.most_common()),
    )


class _Frame:
    """The counts of one frame, and its newest edge, as `tfbus.tree.cycles.NewestEdge` describes it."""

    def __init__(self, frame: str) -> None:
        self.frame = frame
        self.parent = ""
        self.static = False
        self.newest: int | None = None
        self.authority = ""
        self.parents: dict[str, None] = {}
        self.authorities: dict[str, None] = {}
        self.static_count = 0
        self.stamps = array("q")

    def count(self, sample: TransformStamped) -> None:
        """Count a sample."""
        parent, _, stamp, _, authority, static = sample._fields
        if static:
            self.static_count += 1
            self.newest = None
        else:
            self.stamps.append(stamp)
        if static or self.newest is None or stamp >= self.newest:
            self.parent, self.authority, self.static = parent, authority, static
            self.newest = None if static else stamp
        if parent not in self.parents:
            self.parents[parent] = None
        if authority and authority not in self.authorities:
            self.authorities[authority] = None

    def summary(self) -> FrameSummary:
        """The summary of all samples so far."""
        stamps = np.unique(np.array(self.stamps, np.int64))
        several = len(stamps) > 1
        oldest, newest = (int(stamps[0]), int(stamps[-1])) if len(stamps) else (None, None)
        span = newest - oldest if several and newest is not None and oldest is not None else 0
        return FrameSummary(
            self.frame,
            tuple(self.parents),
            self.static_count,
            len(self.stamps),
            oldest,
            newest,
            (len(stamps) - 1) * SECOND / span if several else None,
            int(np.diff(stamps).max()) / SECOND if several else None,
            tuple(self.authorities),
        )

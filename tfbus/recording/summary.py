"""What there is in a recording: each frame's parents, rate, gaps and senders, and what is wrong with the file.

The recording is read once and not kept: what stays in memory is one stamp, 8 bytes, for each moving transform.
"""

from array import array
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tfbus.geometry.stamped import TransformStamped
from tfbus.recording.load import sift
from tfbus.recording.recording import RecordedMessage, Recording
from tfbus.stamps import SECOND


@dataclass(frozen=True, slots=True)
class FrameSummary:
    """What a recording tells of one frame; None where there are too few moving samples to tell.

    Parameters
    ----------
    frame : str
    parents : tuple of str
        Every parent that it had, in the order in which they first came.
    static, moving : int
        How many samples of each kind there are.
    oldest, newest : int or None
        The stamps of the moving samples, in ns.
    rate : float or None
        Different stamps per second, over the span.
    longest_gap : float or None
        The longest time between two stamps that follow each other, in s.
    authorities : tuple of str
        Everybody who sent samples of it, in the order in which they first came; without those that give no name.
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
        """From the oldest to the newest stamp, in s."""
        return None if self.oldest is None or self.newest is None else (self.newest - self.oldest) / SECOND


@dataclass(frozen=True, slots=True)
class RecordingSummary:
    """What there is in a recording.

    Parameters
    ----------
    path : Path
    finished : bool
        As `Recording.finished`.
    start, end : int or None
        The log times of the first and the last message on any topic, in ns; None if there is none.
    messages, transforms : int
        How many messages on ``/tf`` and ``/tf_static`` there are, and how many good transforms in them.
    frames : tuple of FrameSummary
        Every frame that has a parent, sorted by name.
    roots : tuple of str
        The frames that have none, sorted.
    problems : mapping of str to int
        How many transforms or messages were left out, by reason.
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
        """From the first to the last log time, in s."""
        return None if self.start is None or self.end is None else (self.end - self.start) / SECOND


def summarise(recording: Recording, messages: Iterable[RecordedMessage] | None = None) -> RecordingSummary:
    """What there is in a recording.

    Parameters
    ----------
    recording : Recording
    messages : iterable of RecordedMessage, optional
        Its messages, if somebody wants to see them go by; by default all of them.
    """
    frames: dict[str, _Frame] = {}
    problems: Counter[str] = Counter()
    count = 0
    for _, batch, errors in recording.messages() if messages is None else messages:
        count += 1
        if errors:
            problems.update(error.reason for error in errors)
        for sample in sift(frames, batch, problems):
            child = sample.child
            frame = frames.get(child)
            if frame is None:
                frame = frames[child] = _Frame(child)
            frame.add(sample)
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
    """What is gathered of one frame; its newest edge, as `tfbus.bus._topology` wants to know it."""

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

    def add(self, sample: TransformStamped) -> None:
        """Take note of a sample."""
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
        """What was gathered."""
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

"""`summarise`, which lists topics, frames and senders of a recording, with rates, gaps and delays, and its problems.

The recording is read once and not kept: only one stamp, 8 bytes, of each moving transform stays in memory.
"""

import math
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from tfbus.geometry.stamped import Batch
from tfbus.recording.formats.transforms import Columns
from tfbus.recording.recording import (
    Block,
    DecodedBlock,
    Problems,
    RecordedMessage,
    RecordedTopic,
    Recording,
    without_loops,
)
from tfbus.stamps import SECOND, STAMP_MAX, time_between, to_seconds


@dataclass(frozen=True, slots=True)
class Spread:
    """The mean, the 99th percentile and the maximum of some durations, in s. The percentile is exact to 1 %.

    Examples
    --------
    >>> from tfbus.recording import Spread
    >>> Spread(mean=0.02, p99=0.03, max=0.5).max
    0.5
    """

    mean: float
    p99: float
    max: float


_GROWTH: Final = math.log(1.01)
_SINGLE: Final = 1_000
"""Single durations are collected, and counted together once there are this many."""


class Durations:
    """Counts durations by their size; mean and maximum are exact."""

    def __init__(self) -> None:
        self._single = array("q")
        self._count = 0
        self._total = 0.0
        self._max = -math.inf
        self._buckets: Counter[int] = Counter()

    @classmethod
    def joined(cls, parts: Iterable["Durations"]) -> "Durations":
        """The durations of all parts."""
        whole = cls()
        for part in parts:
            part._count_single()
            whole._count += part._count
            whole._total += part._total
            whole._max = max(whole._max, part._max)
            whole._buckets.update(part._buckets)
        return whole

    def add_one(self, duration: int) -> None:
        """Count a duration in ns; if it exceeds 64 bits, count the longest duration that does not."""
        self._single.append(max(-STAMP_MAX, min(duration, STAMP_MAX)))
        if len(self._single) >= _SINGLE:
            self._count_single()

    def add(self, durations: npt.NDArray[np.int64]) -> None:
        """Count durations in ns; there is at least one."""
        if len(durations) < _SINGLE:
            self._single.frombytes(durations.astype(np.int64, copy=False).tobytes())
            if len(self._single) >= _SINGLE:
                self._count_single()
        else:
            self._count_all(durations)

    def _count_single(self) -> None:
        if self._single:
            single, self._single = self._single, array("q")
            self._count_all(np.array(single, np.int64))

    def _count_all(self, durations: npt.NDArray[np.int64]) -> None:
        self._count += len(durations)
        self._total += float(durations.sum(dtype=np.float64)) / SECOND
        self._max = max(self._max, to_seconds(int(durations.max())))
        # The number of a bucket is the logarithm of its upper end, with the sign of the durations; 0 ns has its own.
        sizes = np.ceil(np.log(np.maximum(np.abs(durations.astype(np.float64)), 1.0)) / _GROWTH).astype(np.int64) + 1
        buckets, counts = np.unique(np.sign(durations) * sizes, return_counts=True)
        for bucket, count in zip(buckets.tolist(), counts.tolist(), strict=True):
            self._buckets[bucket] += count

    def spread(self) -> Spread | None:
        """Their spread; None if there are none."""
        self._count_single()
        if not self._count:
            return None
        rank = math.ceil(0.99 * self._count)
        for bucket in sorted(self._buckets):
            rank -= self._buckets[bucket]
            if rank <= 0:
                break
        size = math.exp((abs(bucket) - 1) * _GROWTH) / SECOND if bucket else 0.0
        return Spread(self._total / self._count, min(math.copysign(size, bucket), self._max), self._max)


_AT_ONCE: Final = 50_000
"""The number of stamps that are merged at once, roughly."""


class Periods:
    """The periods of all stamps together.

    Parameters
    ----------
    arrays : sequence of array of int
        Stamps in ns, in any order; they are sorted in place.

    Attributes
    ----------
    oldest, newest : int or None
        ns; None without any stamp.
    longest : float or None
        The longest period, in s; None for fewer than two different stamps.
    """

    def __init__(self, arrays: Sequence["array[int]"]) -> None:
        columns = [np.frombuffer(stamps, np.int64) for stamps in arrays if stamps]
        for column in columns:
            if (column[1:] < column[:-1]).any():
                column.sort()
        self.oldest: int | None = min((int(column[0]) for column in columns), default=None)
        self.newest: int | None = max((int(column[-1]) for column in columns), default=None)
        self._durations = Durations()
        self._different = 0
        total = sum(map(len, columns))
        longest = max(columns, key=len, default=np.empty(0, np.int64))
        # Windows that end at stamps of the longest array hold about as many stamps of every other array.
        step = max(1, _AT_ONCE * len(longest) // max(total, 1))
        ends = [*longest[step::step].tolist(), None] if columns else []
        firsts = [0] * len(columns)
        before: int | None = None
        for end in ends:
            parts = []
            for at, column in enumerate(columns):
                first = firsts[at]
                firsts[at] = len(column) if end is None else int(np.searchsorted(column, end))
                parts.append(column[first : firsts[at]])
            merged = np.sort(np.concatenate(parts))
            before = self._add(merged[np.append(True, merged[1:] != merged[:-1])] if len(merged) else merged, before)
        maximum = None if self._different < 2 else self._durations.spread()
        self.longest: float | None = None if maximum is None else maximum.max

    def _add(self, stamps: npt.NDArray[np.int64], before: int | None) -> int | None:
        """Count the periods of different stamps that ascend; returns the last stamp."""
        if not len(stamps):
            return before
        self._different += len(stamps)
        ends = stamps if before is None else np.concatenate(([np.int64(before)], stamps))
        periods = time_between(ends[:-1], ends[1:])
        if len(periods):
            self._durations.add(periods)
        return int(stamps[-1])

    @property
    def rate(self) -> float | None:
        """Different stamps per second; None for fewer than two."""
        if self._different < 2 or self.oldest is None or self.newest is None:
            return None
        return (self._different - 1) * SECOND / (self.newest - self.oldest)

    def spread(self) -> Spread | None:
        """Their spread; None for fewer than two different stamps."""
        spread = self._durations.spread()
        if spread is None or self.oldest is None or self.newest is None:
            return None
        # The mean of the histogram has rounding errors.
        return replace(spread, mean=to_seconds(self.newest - self.oldest) / (self._different - 1))


@dataclass(frozen=True, slots=True)
class FrameSummary:
    """The summary of one frame of a recording. A value is None if there are too few moving samples for it.

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
    period : Spread or None
        The times between successive stamps.
    delay : Spread or None
        The times from the stamp of a moving sample to its log time; negative where stamps lie ahead.

    Examples
    --------
    >>> from tfbus.recording import open_recording, summarise
    >>> with open_recording("small.bag") as recording:
    ...     frames = summarise(recording).frames
    >>> frames[0].frame, frames[0].parents
    ('arm', ('base_link',))
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
    period: Spread | None = None
    delay: Spread | None = None

    @property
    def kind(self) -> str:
        """``"static"``, ``"moving"`` or ``"both"``."""
        return "both" if self.static and self.moving else "static" if self.static else "moving"

    @property
    def span(self) -> float | None:
        """The time from the oldest to the newest stamp, in s."""
        return None if self.oldest is None or self.newest is None else (self.newest - self.oldest) / SECOND


@dataclass(frozen=True, slots=True)
class SenderSummary:
    """The summary of one authority.

    Parameters
    ----------
    authority : str
    frames : tuple of str
        The frames that it sent, sorted.
    static, moving : int
        The number of samples of each kind.
    period : Spread or None
        The times between successive stamps of any of its moving samples; None for fewer than two stamps.
    delay : Spread or None
        As `FrameSummary.delay`.

    Examples
    --------
    >>> from tfbus.recording import open_recording, summarise
    >>> with open_recording("small.bag") as recording:
    ...     print([sender.authority for sender in summarise(recording).senders])
    ['arm', 'calibration', 'confused', 'description', 'odometry', 'perception', 'slam']
    """

    authority: str
    frames: tuple[str, ...]
    static: int
    moving: int
    period: Spread | None
    delay: Spread | None


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
        The number of messages on the topics that were read, and of the valid transforms in them.
    frames : tuple of FrameSummary
        Every frame that has a parent, sorted by name.
    roots : tuple of str
        The frames that have no parent, sorted.
    problems : mapping of str to int
        The number of transforms and messages that were left out, by reason.
    senders : tuple of SenderSummary
        Every authority, sorted by name; the empty one for samples without any.
    topics : tuple of RecordedTopic
        All topics, with transforms or not, sorted by name.
    remarks : tuple of str
        As `Recording.remarks`.
    details : tuple of str
        The losses at the first damaged places, in words.

    Examples
    --------
    >>> from tfbus.recording import open_recording, summarise
    >>> with open_recording("small.bag") as recording:
    ...     print(summarise(recording).problems["not finite"])
    3
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
    senders: tuple[SenderSummary, ...] = ()
    topics: tuple[RecordedTopic, ...] = ()
    remarks: tuple[str, ...] = ()
    details: tuple[str, ...] = ()

    @property
    def duration(self) -> float | None:
        """The time from the first to the last log time, in s."""
        return None if self.start is None or self.end is None else (self.end - self.start) / SECOND


def summarise(
    recording: Recording,
    messages: Iterable[RecordedMessage] | None = None,
    *,
    progress: Callable[[int], object] | None = None,
) -> RecordingSummary:
    """Read a recording and summarise it.

    Parameters
    ----------
    recording : Recording
    messages : iterable of RecordedMessage, optional
        The messages to read; by default, all messages of the recording, which is faster.
    progress : callable, optional
        Called with the number of messages in each block that has been read.

    Examples
    --------
    >>> from tfbus.recording import open_recording, summarise
    >>> with open_recording("small.bag") as recording:
    ...     summary = summarise(recording)
    >>> summary.transforms, summary.roots
    (992, ('hen', 'island', 'map'))
    """
    counts = _Counts()
    blocks: Iterator[Block | DecodedBlock] = recording.blocks() if messages is None else iter([DecodedBlock(messages)])
    for block in blocks:
        columns = block.columns()
        if columns is None or not counts.add_columns(columns):
            counts.add_messages(block.messages())
        else:
            counts.messages += len(block)
        if progress is not None:
            progress(len(block))
    frames = counts.frames
    parents = {parent for frame in frames.values() for parent in frame.parents}
    summaries = tuple(frames[child].summary() for child in sorted(frames))
    return RecordingSummary(
        recording.path,
        recording.finished,
        recording.start,
        recording.end,
        counts.messages,
        sum(frame.static + frame.moving for frame in summaries),
        summaries,
        tuple(sorted(parents - frames.keys())),
        dict(counts.problems.most_common()),
        tuple(_sender(frames, authority) for authority in sorted(counts.authorities)),
        recording.topics,
        recording.remarks,
        tuple(counts.problems.details),
    )


class _Counts:
    """The counts of one reading."""

    def __init__(self) -> None:
        self.frames: dict[str, _Frame] = {}
        self.named: set[str] = set()
        self.problems = Problems()
        self.messages = 0

    @property
    def authorities(self) -> set[str]:
        """The authorities that sent anything."""
        return {authority for frame in self.frames.values() for authority in frame.sent}

    def add_columns(self, columns: list[Columns]) -> bool:
        """Count the samples of a block unless an edge has to be judged; returns whether they were counted."""
        for each in columns:
            frame = self.frames.get(each.child)
            if frame is None or frame.static or each.static or frame.parent != each.parent:
                return False
        for each in columns:
            self.frames[each.child].count_columns(each)
        return True

    def add_messages(self, messages: Iterable[RecordedMessage]) -> None:
        """Count messages one by one."""
        for message in messages:
            received, batch, errors = message
            self.messages += not message.is_report
            if errors:
                self.problems.note(errors)
            self._add_batch(received, without_loops(self.frames, batch, self.named, self.problems))

    def _add_batch(self, received: int, batch: Batch) -> None:
        for sample in batch:
            parent, child, stamp, _, authority, static = sample._fields
            self.named.add(parent)
            frame = self.frames.get(child)
            if frame is None:
                frame = self.frames[child] = _Frame(child)
            frame.count(parent, stamp, received, authority, static)


class _Sent:
    """The samples of one frame that one authority sent."""

    def __init__(self) -> None:
        self.static = 0
        self.moving = 0
        self.stamps = array("q")
        self.delays = Durations()


class _Frame:
    """The counts of one frame, and its newest edge, as `tfbus.tree.cycles.NewestEdge` describes it."""

    def __init__(self, frame: str) -> None:
        self.frame = frame
        self.parent = ""
        self.static = False
        self.newest: int | None = None
        self.authority = ""
        self.parents: dict[str, None] = {}
        self.sent: dict[str, _Sent] = {}

    def count(self, parent: str, stamp: int, received: int, authority: str, static: bool) -> None:
        """Count a sample."""
        sent = self._sent_by(authority)
        if static:
            sent.static += 1
            self.newest = None
        else:
            sent.moving += 1
            sent.stamps.append(stamp)
            sent.delays.add_one(received - stamp)
        if static or self.newest is None or stamp >= self.newest:
            self.parent, self.authority, self.static = parent, authority, static
            self.newest = None if static else stamp
        if parent not in self.parents:
            self.parents[parent] = None

    def count_columns(self, columns: Columns) -> None:
        """Count moving samples with the parent of the newest edge."""
        sent = self._sent_by(columns.authority)
        stamps = columns.stamps
        sent.moving += len(stamps)
        sent.stamps.frombytes(stamps.tobytes())
        sent.delays.add(time_between(stamps, columns.received))
        newest = int(stamps.max())
        if self.newest is None or newest >= self.newest:
            self.newest, self.authority = newest, columns.authority

    def summary(self) -> FrameSummary:
        """The summary of all samples so far."""
        periods = Periods([sent.stamps for sent in self.sent.values()])
        return FrameSummary(
            self.frame,
            tuple(self.parents),
            sum(sent.static for sent in self.sent.values()),
            sum(sent.moving for sent in self.sent.values()),
            periods.oldest,
            periods.newest,
            periods.rate,
            periods.longest,
            tuple(authority for authority in self.sent if authority),
            periods.spread(),
            Durations.joined(sent.delays for sent in self.sent.values()).spread(),
        )

    def _sent_by(self, authority: str) -> _Sent:
        sent = self.sent.get(authority)
        if sent is None:
            sent = self.sent[authority] = _Sent()
        return sent


def _sender(frames: Mapping[str, _Frame], authority: str) -> SenderSummary:
    """The summary of an authority."""
    own = {child: frame.sent[authority] for child, frame in frames.items() if authority in frame.sent}
    return SenderSummary(
        authority,
        tuple(sorted(own)),
        sum(sent.static for sent in own.values()),
        sum(sent.moving for sent in own.values()),
        Periods([sent.stamps for sent in own.values()]).spread(),
        Durations.joined(sent.delays for sent in own.values()).spread(),
    )

"""`summarise`, which lists topics, frames and senders of a recording, with rates, gaps and delays, and its problems.

The recording is read once and not kept: only one stamp, 8 bytes, of each moving transform stays in memory.
"""

from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from tfbus.geometry.stamped import Batch
from tfbus.recording._blocks import Block, DecodedBlock
from tfbus.recording._durations import Durations
from tfbus.recording._periods import Periods
from tfbus.recording.formats._columns import Columns
from tfbus.recording.load import Problems, sound_samples
from tfbus.recording.message import RecordedMessage
from tfbus.recording.recording import RecordedTopic, Recording
from tfbus.recording.spread import Spread
from tfbus.stamps import SECOND, time_between


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
    period : Spread or None
        The times between successive stamps.
    delay : Spread or None
        The times from the stamp of a moving sample to its log time; negative where stamps lie ahead.
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
        What was lost at the first damaged places.
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
    """All that is counted while a recording is read."""

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
        """Count the samples of a block, if no edge has to be judged; returns whether that was so."""
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
            self._add_batch(received, sound_samples(self.frames, batch, self.named, self.problems))

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

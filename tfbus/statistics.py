"""Statistics as frozen dataclasses; ``dataclasses.asdict`` gives data for JSON."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from tfbus.plain import PlainData, printable
from tfbus.stamps import format_duration, from_seconds

_SHOWN = 3


class Counts(PlainData):
    """A base of statistics, which print only the fields that are not zero or empty."""

    __slots__ = ()

    def _counted(self) -> dict[str, Any]:
        values = {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]
        return {name: value for name, value in values.items() if value}

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(f'{name}={value!r}' for name, value in self._counted().items())})"

    def _repr_html_(self) -> str:
        # Few processes show a page, and the names of all entities take memory.
        from html import escape

        cells = (f"<tr><th>{name}</th><td>{escape(str(value))}</td></tr>" for name, value in self._counted().items())
        return f"<table><caption>{type(self).__name__}</caption>{''.join(cells)}</table>"


@dataclass(frozen=True, slots=True, repr=False)
class BufferStatistics(Counts):
    """The samples of one buffer since it was attached, and its waiting lookups.

    ``offered == inserted + replaced + expired``

    Attributes
    ----------
    offered : int
        Samples that the bus gave to the buffer.
    inserted, replaced, expired : int
        Samples by their `Outcome`.
    waiting : int
        Lookups that wait now.
    expired_ahead : int
        The expired samples of frames whose newest stamp was ahead of the clock: see `StampAhead`.
    superseded : int
        The expired samples that were left out because a newer sample of their frame, published before the buffer
        joined, names another parent.
    looped : int
        Samples that formed a loop of parents at a past stamp, as late data can; they are counted above as well.

    Examples
    --------
    >>> bus = Bus(SimulatedClock())
    >>> with Buffer(bus):
    ...     bus.publish(TransformStamped("map", "cart", 0, Transform()))
    ...     print(bus.statistics().buffers)
    (BufferStatistics(offered=1, inserted=1),)
    """

    offered: int
    inserted: int
    replaced: int
    expired: int
    waiting: int
    expired_ahead: int = 0
    superseded: int = 0
    looped: int = 0


@dataclass(frozen=True, slots=True, repr=False)
class QueueStatistics(Counts):
    """One bounded queue: of a stream, of events, or of samples from other threads.

    Every moving sample that was put into the queue was read, or is counted as pending, dropped or conflated.

    Attributes
    ----------
    kind : str
        The purpose of the queue, such as ``"stream"`` or ``"events"``.
    overflow : str
        Its rule for a full queue.
    capacity : int
        The bound on pending items; pending static samples are kept beyond it.
    pending : int
        Items that were not read yet.
    dropped : int
        Items that were discarded unread: the queue was full, the frame was removed, or the clock jumped back.
    conflated : int
        Samples that another sample of the same child replaced: moving ones in a queue with the overflow
        ``"conflate"``, static ones in a full recorder.

    Examples
    --------
    >>> bus = Bus(SimulatedClock())
    >>> with bus.stream(capacity=100):
    ...     bus.publish(TransformStamped("map", "cart", 0, Transform()))
    ...     print(bus.statistics().queues)
    (QueueStatistics(kind='stream', overflow='conflate', capacity=100, pending=1),)
    """

    kind: str
    overflow: str
    capacity: int
    pending: int
    dropped: int
    conflated: int = 0


@dataclass(frozen=True, slots=True, repr=False)
class BusStatistics(Counts):
    """One bus since it was made.

    Attributes
    ----------
    samples : int
        Accepted samples.
    rejected : mapping of str to int
        Rejected samples, by reason. ``"displaced"`` counts edges that were accepted first, and removed later in favour
        of a frame that its sender has reserved.
    reparented : int
        Samples that changed the newest parent of a child.
    kind_changes : int
        Samples that made a static child moving, or a moving child static.
    authority_conflicts : int
        Samples whose authority differs from the authority of the previous sample of the same child.
    clock_resets : int
        Jumps back of the clock.
    callbacks_failed : int
        Exceptions that subscribers raised.
    frames : int
        Child frames that the bus knows now.
    buffers : tuple of BufferStatistics
    queues : tuple of QueueStatistics
    ahead : int
        Accepted samples whose stamps were more than `max_ahead` ahead of the clock.
    behind : int
        Accepted samples whose stamps were more than `max_behind` behind the clock: see `StampBehind`.

    Examples
    --------
    >>> bus = Bus(SimulatedClock())
    >>> bus.publish(TransformStamped("map", "cart", 0, Transform()))
    >>> bus.statistics()
    BusStatistics(samples=1, frames=1)
    """

    samples: int
    rejected: Mapping[str, int]
    reparented: int
    kind_changes: int
    authority_conflicts: int
    clock_resets: int
    callbacks_failed: int
    frames: int
    buffers: tuple[BufferStatistics, ...]
    queues: tuple[QueueStatistics, ...]
    ahead: int = 0
    behind: int = 0


@dataclass(frozen=True, slots=True)
class PeerClock(PlainData):
    """The clock of a peer's bus, beside the clock of this bus.

    Attributes
    ----------
    peer : str
        The id of the peer.
    authorities : tuple of str
        The authorities whose samples the peer has sent, sorted.
    offset : float or None
        How far the peer's clock is ahead of this one, in s; negative if it is behind, None if it is not known.
    bound : float or None
        The greatest error of the offset, in s: half the round trip, and the possible drift since it was measured.
    drift : float or None
        The change of the offset, in s per s; None for fewer than some seconds of measurements.
    delay : float or None
        The round trip of the believed exchange, in s.
    runs : bool
        Whether the peer's bus has a clock that runs by itself, rather than a simulated one.

    Examples
    --------
    >>> from tfbus.statistics import PeerClock
    >>> print(PeerClock("7d4f", ("odometry",), 0.31, 0.0002, 1.5e-6, 0.0003))
    'odometry' runs 310 ms ahead of this clock, within 200 us
    """

    peer: str
    authorities: tuple[str, ...] = ()
    offset: float | None = None
    bound: float | None = None
    drift: float | None = None
    delay: float | None = None
    runs: bool = True

    def __str__(self) -> str:
        names = ", ".join(map(repr, self.authorities[:_SHOWN])) + (", ..." if len(self.authorities) > _SHOWN else "")
        who = names or f"peer {self.peer[:8]}"
        if not self.runs:
            return printable(f"{who} has a simulated clock")
        if self.offset is None or self.bound is None:
            return printable(f"the clock of {who} is not measured")
        distance, bound = (format_duration(from_seconds(abs(seconds))) for seconds in (self.offset, self.bound))
        side = "behind" if self.offset < 0 else "ahead of"
        return printable(f"{who} runs {distance} {side} this clock, within {bound}")


@dataclass(frozen=True, slots=True, repr=False)
class LinkStatistics(Counts):
    """One link since it was entered.

    Attributes
    ----------
    peers : int
        Connected peers now.
    sent_messages, sent_samples : int
        Messages and samples that were sent when they were published. Samples that are sent again to peers that missed
        them are not counted again. Links of tfbus send nothing while no peer listens. Samples for peers that hear only
        some frames are counted once for each set of frames.
    received_messages, received_samples : int
        Messages and samples that were received and published on the bus.
    lost : int
        Messages of peers that did not arrive, found by gaps in their sequence numbers.
    duplicates : int
        Samples that had arrived before, or that arrived after a newer one by another route.
    not_sent : mapping of str to int
        Samples and removals of this bus that a message cannot hold, by reason.
    rejected : mapping of str to int
        Rejected messages and samples of peers, by reason.
    queue : QueueStatistics
        The received messages that wait for the event loop.
    clocks : tuple of PeerClock
        The clock of each peer, in the order of the ids; empty for links to other worlds, whose programs tell no times.

    Examples
    --------
    >>> async with LocalLink(Bus(), "example") as link:
    ...     print(link.statistics().lost)
    0
    """

    peers: int
    sent_messages: int
    sent_samples: int
    received_messages: int
    received_samples: int
    lost: int
    duplicates: int
    not_sent: Mapping[str, int]
    rejected: Mapping[str, int]
    queue: QueueStatistics
    clocks: tuple[PeerClock, ...] = ()


@dataclass(frozen=True, slots=True, repr=False)
class BufferServerStatistics(Counts):
    """One buffer server since it was entered.

    Attributes
    ----------
    waiting : int
        Lookups of other processes that wait now.
    answered, failed : int
        Lookups that ended with a transform, and lookups that ended with an error.
    cancelled : int
        Lookups whose asker was cancelled, or has gone.
    refused : mapping of str to int
        Questions that were refused, by reason: ``"busy"``, because too many wait or arrive; ``"malformed"``;
        ``"internal"``, because of an error that lookups do not raise, which is logged.

    Examples
    --------
    >>> import tempfile
    >>> from tfbus.links import BufferServer
    >>> robot, folder = Bus(), tempfile.mkdtemp()
    >>> async with LocalLink(robot, directory=folder) as link, BufferServer(Buffer(robot), link) as server:
    ...     robot.publish(TransformStamped("map", "cart", 0, Transform((2.0, 0.0, 0.0)), static=True))
    ...     async with LocalLink(Bus(), directory=folder) as asker:
    ...         _ = await asker.lookup("map", "cart", timeout=5.0)
    ...     print(server.statistics().answered)
    1
    """

    waiting: int
    answered: int
    failed: int
    cancelled: int
    refused: Mapping[str, int]


@dataclass(frozen=True, slots=True, repr=False)
class RecorderStatistics(Counts):
    """One recorder since it was entered.

    The number of samples that the bus gave to it is
    ``samples + sum(refused.values()) + queue.pending + queue.dropped + queue.conflated``.

    Attributes
    ----------
    samples, messages : int
        Samples and messages that are in the file, and remain there if the process is killed.
    unattributed : int
        Samples in the file without their authority, because there were too many authorities.
    refused : mapping of str to int
        Samples that a ROS message cannot hold, by reason.
    queue : QueueStatistics
        The samples that wait for the disk. Dropped samples were lost because the disk was too slow or failed; a
        conflated sample is a static one that a newer sample of the same child replaced in a full queue.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> from tfbus.recording import Recorder
    >>> folder = tempfile.TemporaryDirectory()
    >>> async with Recorder(bus := Bus(SimulatedClock()), pathlib.Path(folder.name) / "run.mcap") as recorder:
    ...     bus.publish(TransformStamped("map", "cart", 0, Transform(), "wheels"))
    >>> recorder.statistics().samples
    1
    >>> folder.cleanup()
    """

    samples: int
    messages: int
    unattributed: int
    refused: Mapping[str, int]
    queue: QueueStatistics


@dataclass(frozen=True, slots=True, repr=False)
class RobotStatistics(Counts):
    """One robot state publisher since it was made.

    Attributes
    ----------
    messages : int
        Sets of joint positions that were published.
    unknown_joints : int
        Positions in them for joints that the robot does not have.
    violations : mapping of str to int
        Positions in them beyond the limits of the joint, by joint name.

    Examples
    --------
    >>> model = RobotModel("rig", ["rail", "cart"], [Joint("slide", "prismatic", "rail", "cart")])
    >>> publisher = RobotStatePublisher(Bus(SimulatedClock()), model)
    >>> publisher.publish({"slide": 0.5, "tail": 1.0}, 0)
    >>> publisher.statistics().unknown_joints
    1
    """

    messages: int
    unknown_joints: int
    violations: Mapping[str, int]

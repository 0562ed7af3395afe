"""The events of a bus, as frozen dataclasses; ``str(event)`` is one line for people.

``stamp`` is the time of the event on the bus's clock, in ns. `FrameAdded` and `FrameRemoved` of one frame alternate,
and so do `FrameStale` and `FrameLive`. After a `ClockReset` the first sample of each moving frame is announced by a new
`FrameAdded`.
"""

from dataclasses import dataclass, field

from tfbus.errors import TransformError, loop_text
from tfbus.plain import PlainData, printable
from tfbus.stamps import format_duration, format_stamp, from_seconds, likely_cause
from tfbus.statistics import PeerClock


@dataclass(frozen=True, slots=True)
class FrameAdded(PlainData):
    """A frame has a parent, because its first sample arrived or because it had one when the event stream was opened.

    Examples
    --------
    >>> bus = Bus(SimulatedClock())
    >>> with bus.events() as events:
    ...     bus.publish(TransformStamped("map", "cart", 0, Transform()))
    ...     print(await anext(aiter(events)))
    0.000 s: moving frame 'cart' is new under 'map', from ''
    """

    stamp: int
    frame: str
    parent: str
    authority: str
    static: bool

    def __str__(self) -> str:
        kind = "static" if self.static else "moving"
        return _line(self.stamp, f"{kind} frame {self.frame!r} is new under {self.parent!r}, from {self.authority!r}")


@dataclass(frozen=True, slots=True)
class FrameRemoved(PlainData):
    """A frame was removed: the bus and its buffers have forgotten its parent and its samples.

    Examples
    --------
    >>> bus = Bus(SimulatedClock())
    >>> bus.publish(TransformStamped("map", "cart", 0, Transform()))
    >>> with bus.events() as events:
    ...     bus.remove_frame("cart")
    ...     arrived = aiter(events)
    ...     _ = await anext(arrived)
    ...     print(await anext(arrived))
    0.000 s: frame 'cart' was removed
    """

    stamp: int
    frame: str

    def __str__(self) -> str:
        return _line(self.stamp, f"frame {self.frame!r} was removed")


@dataclass(frozen=True, slots=True)
class Reparented(PlainData):
    """The newest sample of a frame names another parent than the newest sample before it.

    Examples
    --------
    >>> bus = Bus(SimulatedClock())
    >>> with bus.events() as events:
    ...     for stamp, parent in ((0, "table"), (1, "gripper")):
    ...         bus.publish(TransformStamped(parent, "box", stamp, Transform(), "hand"))
    ...     bus.close()
    ...     print([event async for event in events][-1])
    0.000 s: frame 'box' moves from 'table' to 'gripper', says 'hand'
    """

    stamp: int
    frame: str
    parent: str
    old_parent: str
    authority: str

    def __str__(self) -> str:
        moves = f"moves from {self.old_parent!r} to {self.parent!r}"
        return _line(self.stamp, f"frame {self.frame!r} {moves}, says {self.authority!r}")


@dataclass(frozen=True, slots=True)
class KindChanged(PlainData):
    """A moving frame became static, or a static frame moving; `static` is the new kind.

    Examples
    --------
    >>> bus = Bus(SimulatedClock())
    >>> with bus.events() as events:
    ...     for static in (True, False):
    ...         bus.publish(TransformStamped("base", "lid", 1, Transform(), "robot", static))
    ...     bus.close()
    ...     print([event async for event in events][-1])
    0.000 s: frame 'lid' is now moving, says 'robot'
    """

    stamp: int
    frame: str
    static: bool
    authority: str

    def __str__(self) -> str:
        kind = "static" if self.static else "moving"
        return _line(self.stamp, f"frame {self.frame!r} is now {kind}, says {self.authority!r}")


@dataclass(frozen=True, slots=True)
class AuthorityConflict(PlainData):
    """A sample of a frame came from `authority`, the sample before it from `other`.

    Examples
    --------
    >>> bus = Bus(SimulatedClock())
    >>> with bus.events() as events:
    ...     for authority in ("wheels", "camera"):
    ...         bus.publish(TransformStamped("odom", "base", 1, Transform(), authority))
    ...     bus.close()
    ...     print([event async for event in events][-1])
    0.000 s: frame 'base' comes from two authorities, 'camera' and 'wheels'
    """

    stamp: int
    frame: str
    authority: str
    other: str

    def __str__(self) -> str:
        both = f"{self.authority!r} and {self.other!r}"
        return _line(self.stamp, f"frame {self.frame!r} comes from two authorities, {both}")


@dataclass(frozen=True, slots=True)
class SampleRejected(PlainData):
    """The bus rejected a sample, by raising an error or by dropping the sample.

    An event stream gives it once for each frame, authority and reason, until the frame is removed or added or the clock
    jumps back; ``statistics().rejected`` counts every sample.

    Attributes
    ----------
    stamp : int
        Time of the event, in ns.
    reason : str
        The key in ``statistics().rejected``: `InvalidTransformError.reason`, or ``"not a sample"``.
    frame, parent, authority : str or None
        The child, the parent and the authority of the sample; None if the object was not a sample.
    error : Exception
        The error that was raised, or that the dropped sample would have raised.

    Examples
    --------
    >>> bus = Bus(SimulatedClock())
    >>> with bus.events() as events:
    ...     too_far = TransformStamped("map", "base", 0, Transform((1e20, 0.0, 0.0)), "gps")
    ...     bus.publish(too_far, invalid="drop")
    ...     bus.close()
    ...     print([(event.reason, event.frame) async for event in events])
    [('not physical', 'base')]
    """

    stamp: int
    reason: str
    frame: str | None
    parent: str | None
    authority: str | None
    error: TransformError | Exception = field(compare=False)

    def __str__(self) -> str:
        sender = "" if self.authority is None else f" from {self.authority!r}"
        return _line(self.stamp, f"a sample{sender} was rejected: {self.error}")


@dataclass(frozen=True, slots=True)
class PastLoop(PlainData):
    """Late samples form a loop of parents at a past stamp; the newest parents form none.

    An event stream gives it once for each frame, parent and authority, until the frame is removed or added or the clock
    jumps back; the ``looped`` of each buffer in ``statistics().buffers`` counts every sample.

    Attributes
    ----------
    stamp : int
        Time of the event, in ns.
    frame, parent, authority : str
        Of the sample that closes the loop. It is stored.
    at : int
        The first stamp at which the loop holds, not before the stamp of the sample, in ns.
    loop : tuple of str
        The frames of the loop from child to parent, the first one repeated at the end.

    Examples
    --------
    >>> with Bus(SimulatedClock()) as bus, Buffer(bus) as buffer, bus.events() as events:
    ...     for parent, child, stamp in (("a", "b", 100), ("map", "a", 200), ("b", "a", 50)):
    ...         bus.publish(TransformStamped(parent, child, stamp, Transform(), "late"))
    ...     bus.close()
    ...     print([event async for event in events if type(event).__name__ == "PastLoop"])
    [PastLoop(stamp=0, frame='a', parent='b', authority='late', at=100, loop=('a', 'b', 'a'))]
    """

    stamp: int
    frame: str
    parent: str
    authority: str
    at: int
    loop: tuple[str, ...]

    def __str__(self) -> str:
        frames = loop_text(self.loop)
        return _line(
            self.stamp,
            f"the frames {frames} form a loop at {format_stamp(self.at)}, with late data of {self.authority!r}",
        )


@dataclass(frozen=True, slots=True)
class FrameStale(PlainData):
    """The newest sample of a moving frame is older than the event stream's `stale_after`.

    Attributes
    ----------
    stamp : int
        Time of the event, in ns.
    frame, authority : str
        The frame, and the sender of its newest sample.
    newest : int
        The stamp of its newest sample, in ns.

    Examples
    --------
    >>> bus = Bus(clock := SimulatedClock())
    >>> with bus.events(stale_after=0.5) as events:
    ...     bus.publish(TransformStamped("odom", "base", 0, Transform(), "wheels"))
    ...     await clock.advance(1.0)
    ...     arrived = aiter(events)
    ...     _ = await anext(arrived)
    ...     print(await anext(arrived))
    1.000 s: frame 'base' is stale, its newest sample from 'wheels' is 1 s old
    """

    stamp: int
    frame: str
    newest: int
    authority: str

    def __str__(self) -> str:
        age = format_duration(self.stamp - self.newest)
        return _line(
            self.stamp, f"frame {self.frame!r} is stale, its newest sample from {self.authority!r} is {age} old"
        )


@dataclass(frozen=True, slots=True)
class FrameLive(PlainData):
    """A stale frame has a newer sample.

    Attributes
    ----------
    stamp : int
        Time of the event, in ns.
    frame, authority : str
        The frame, and the sender of its newest sample.
    newest : int or None
        The stamp of its newest sample, in ns; None if it became static.

    Examples
    --------
    >>> bus = Bus(clock := SimulatedClock())
    >>> with bus.events(stale_after=0.5) as events:
    ...     bus.publish(TransformStamped("odom", "base", 0, Transform(), "wheels"))
    ...     await clock.advance(1.0)
    ...     arrived = aiter(events)
    ...     _ = [await anext(arrived), await anext(arrived)]
    ...     bus.publish(TransformStamped("odom", "base", clock.now(), Transform(), "wheels"))
    ...     print(await anext(arrived))
    1.000 s: frame 'base' is live again, from 'wheels'
    """

    stamp: int
    frame: str
    newest: int | None
    authority: str

    def __str__(self) -> str:
        return _line(self.stamp, f"frame {self.frame!r} is live again, from {self.authority!r}")


@dataclass(frozen=True, slots=True)
class StampAhead(PlainData):
    """The newest sample of a frame is ahead of the clock by more than the `max_ahead` of the bus.

    Until the clock has reached its stamp, correct samples are older than this one, and they expire if they are older
    than the window. An event stream gives the event once for each frame and authority, until the frame is removed or
    added or the clock jumps back. With ``reject_ahead=True`` the sample was refused, and nothing expires.

    Attributes
    ----------
    stamp : int
        Time of the event, in ns.
    frame, authority : str
        The frame, and the sender of the sample.
    newest : int
        The stamp of the sample, in ns.

    Examples
    --------
    >>> bus = Bus(SimulatedClock(start=from_seconds(1.0)))
    >>> with bus.events() as events:
    ...     bus.publish(TransformStamped("odom", "base", from_seconds(3.0), Transform(), "laptop"))
    ...     bus.close()
    ...     print([event async for event in events][-1])
    1.000 s: frame 'base' has a sample 2 s ahead of the clock, from 'laptop'
    """

    stamp: int
    frame: str
    newest: int
    authority: str

    def __str__(self) -> str:
        ahead, cause = format_duration(self.newest - self.stamp), likely_cause(self.newest, self.stamp)
        return _line(
            self.stamp,
            f"frame {self.frame!r} has a sample {ahead} ahead of the clock, from {self.authority!r}"
            f"{cause and f': {cause}'}",
        )


@dataclass(frozen=True, slots=True)
class StampBehind(PlainData):
    """A sample of a frame is behind the clock by more than the `max_behind` of the bus, or has expired in a buffer.

    An event stream gives it once for each frame and authority, until the frame is removed or added or the clock jumps
    back. There is no such event for static samples, for recorded samples, and for the older samples that a link brings
    when it joins. No sample is behind a `SimulatedClock` that nobody has set.

    Attributes
    ----------
    stamp : int
        Time of the event, in ns.
    frame, authority : str
        The frame, and the sender of the sample.
    at : int
        The stamp of the sample, in ns.
    newest : int or None
        If the sample has expired: the newest stamp of the frame, in ns, whose window does not reach back to the sample.
        None if the sample is behind the clock.

    Examples
    --------
    >>> bus = Bus(SimulatedClock(start=from_seconds(100.0)), max_behind=10.0)
    >>> with bus.events() as events:
    ...     bus.publish(TransformStamped("odom", "base", 0, Transform(), "laptop"))
    ...     bus.close()
    ...     print([event async for event in events][-1])
    100.000 s: frame 'base' has a sample 100 s behind the clock, from 'laptop'
    """

    stamp: int
    frame: str
    at: int
    newest: int | None
    authority: str

    def __str__(self) -> str:
        cause = likely_cause(self.at, self.stamp)
        return _line(
            self.stamp,
            f"frame {self.frame!r} has a sample {how_far_behind(self.at, self.stamp, self.newest)}, "
            f"from {self.authority!r}{cause and f': {cause}'}",
        )


def how_far_behind(at: int, now: int, newest: int | None) -> str:
    """The distance of a stamp from the clock, or, if it has expired, from the newest stamp, as text; all in ns."""
    if newest is None:
        return f"{format_duration(now - at)} behind the clock"
    return f"{format_duration(newest - at)} older than the newest, and has expired"


@dataclass(frozen=True, slots=True)
class ClockReset(PlainData):
    """The clock jumped back from `before` to `stamp` (ns), and the bus forgot every moving frame.

    With ``on_conflict="reject"`` each of these frames stays with its first authority until it is removed.

    Examples
    --------
    >>> bus = Bus(clock := SimulatedClock(start=from_seconds(5.0)))
    >>> with bus.events() as events:
    ...     clock.set(0)
    ...     print(await anext(aiter(events)))
    0.000 s: the clock jumped back from 5.000 s
    """

    stamp: int
    before: int

    def __str__(self) -> str:
        return _line(self.stamp, f"the clock jumped back from {format_stamp(self.before)}")


@dataclass(frozen=True, slots=True)
class SubscriberFailed(PlainData):
    """A subscriber's callback raised an `Exception`; `subscriber` is the callback's name.

    Examples
    --------
    >>> bus = Bus(SimulatedClock())
    >>> with bus.events() as events:
    ...     _ = bus.subscribe(lambda batch: 1 / 0)
    ...     bus.publish(TransformStamped("odom", "base", 0, Transform()))
    ...     bus.close()
    ...     print([event async for event in events][-1])
    0.000 s: the subscriber <lambda> raised ZeroDivisionError('division by zero')
    """

    stamp: int
    subscriber: str
    error: TransformError | Exception

    def __str__(self) -> str:
        return _line(self.stamp, f"the subscriber {self.subscriber} raised {self.error!r}")


@dataclass(frozen=True, slots=True)
class PeerJoined(PlainData):
    """A link found another bus.

    Attributes
    ----------
    stamp : int
        Time of the event, in ns.
    link : str
        The domain of the link.
    peer : str
        The identifier of the other bus, a new one each time it starts.

    Examples
    --------
    >>> here = Bus()
    >>> with here.events() as events:
    ...     async with LocalLink(here, "cell7"), LocalLink(Bus(), "cell7"):
    ...         joined = await anext(aiter(events))
    >>> type(joined).__name__, joined.link
    ('PeerJoined', 'cell7')
    """

    stamp: int
    link: str
    peer: str

    def __str__(self) -> str:
        return _line(self.stamp, f"peer {self.peer} has joined {self.link}")


@dataclass(frozen=True, slots=True)
class PeerLost(PlainData):
    """A link lost another bus: its process or its link ended, or it no longer responds.

    Attributes
    ----------
    stamp : int
        Time of the event, in ns.
    link, peer : str
        As in `PeerJoined`.
    authorities : tuple of str
        The authorities of the buses that were reached by the peer, sorted.
    frames : tuple of str
        The frames whose newest sample came from the peer, sorted; a link that drops lost frames removes them.

    Examples
    --------
    >>> here = Bus()
    >>> with here.events() as events:
    ...     async with LocalLink(here, "cell8"):
    ...         async with LocalLink(Bus(), "cell8"):
    ...             _ = await anext(aiter(events))
    ...         lost = await anext(aiter(events))
    >>> type(lost).__name__, lost.frames
    ('PeerLost', ())
    """

    stamp: int
    link: str
    peer: str
    authorities: tuple[str, ...]
    frames: tuple[str, ...]

    def __str__(self) -> str:
        spoke = f", who spoke for {', '.join(map(repr, self.authorities))}" if self.authorities else ""
        return _line(self.stamp, f"peer {self.peer} is lost on {self.link}{spoke}: {len(self.frames)} frames")


@dataclass(frozen=True, slots=True)
class PeerRejected(PlainData):
    """A link rejected a message or a sample of another bus; announced once for each peer and reason.

    Attributes
    ----------
    stamp : int
        Time of the event, in ns.
    link, peer : str
        As in `PeerJoined`.
    reason : str
        The key in the `rejected` of the link's statistics.
    error : Exception
        The reason for the rejection.

    Examples
    --------
    >>> rejected = PeerRejected(0, "zenoh", "2f6b", "oversized", ValueError("5 MiB, more than 4 MiB"))
    >>> print(rejected)
    0.000 s: peer 2f6b on zenoh sent data that were refused: 5 MiB, more than 4 MiB
    """

    stamp: int
    link: str
    peer: str
    reason: str
    error: TransformError | Exception = field(compare=False)

    def __str__(self) -> str:
        return _line(self.stamp, f"peer {self.peer} on {self.link} sent data that were refused: {self.error}")


@dataclass(frozen=True, slots=True)
class ClockOffset(PlainData):
    """The clock of a peer differs from the clock of this bus.

    It is told when the offset exceeds both its bound and the `max_offset` of the link, again when it has changed by as
    much, and when it is over.

    Attributes
    ----------
    stamp : int
        Time of the event, in ns.
    link, peer : str
        As in `PeerJoined`.
    authorities : tuple of str
        The authorities whose samples the peer has sent, sorted.
    offset : float
        How far the peer's clock is ahead of this one, in s; negative if it is behind.
    bound : float
        The greatest error of the offset, in s.
    over : bool
        Whether the offset is no longer above `max_offset`.

    Examples
    --------
    >>> print(ClockOffset(0, "tf", "7d4f", ("odometry",), 0.31, 0.0002))
    0.000 s: 'odometry' runs 310 ms ahead of this clock, within 200 us: peer 7d4f on tf
    """

    stamp: int
    link: str
    peer: str
    authorities: tuple[str, ...]
    offset: float
    bound: float
    over: bool = False

    def __str__(self) -> str:
        clock = PeerClock(self.peer, self.authorities, self.offset, self.bound)
        # Without authorities, the clock is named by its peer.
        where = f"peer {self.peer} on {self.link}" if self.authorities else f"on {self.link}"
        return _line(self.stamp, f"{clock}: {where}{', which is near enough' if self.over else ''}")


@dataclass(frozen=True, slots=True)
class PeerClockStepped(PlainData):
    """The clock of another bus was set, and its moving frames begin anew: their older samples are forgotten.

    Otherwise lookups would interpolate between samples before and behind the step.

    Attributes
    ----------
    stamp : int
        Time of the event on this bus's clock, in ns.
    link, peer : str
        As in `PeerJoined`: the peer that has brought the samples.
    step : float
        How far the clock has moved, in s; negative if it was set back.
    frames : tuple of str
        The frames that begin anew, sorted.

    Examples
    --------
    >>> print(PeerClockStepped(0, "tf", "7d4f", -1.0, ("base_link",)))
    0.000 s: a clock behind peer 7d4f on tf was set back by 1 s: its frames begin anew, 'base_link'
    """

    stamp: int
    link: str
    peer: str
    step: float
    frames: tuple[str, ...]

    def __str__(self) -> str:
        way, distance = "back" if self.step < 0 else "forward", format_duration(from_seconds(abs(self.step)))
        names = ", ".join(map(repr, self.frames))
        step = f"was set {way} by {distance}: its frames begin anew, {names}"
        return _line(self.stamp, f"a clock behind peer {self.peer} on {self.link} {step}")


@dataclass(frozen=True, slots=True)
class RecordingDropped(PlainData):
    """A recorder begins to lose samples because the disk is too slow.

    It is announced again if the recorder catches up and then falls behind once more.

    Attributes
    ----------
    stamp : int
        Time of the event, in ns.
    path : str
        The recording.
    dropped : int
        Number of samples that were lost so far.

    Examples
    --------
    >>> print(RecordingDropped(0, "run.mcap", 12))
    0.000 s: the recording run.mcap is behind and loses samples, 12 so far
    """

    stamp: int
    path: str
    dropped: int

    def __str__(self) -> str:
        return _line(self.stamp, f"the recording {self.path} is behind and loses samples, {self.dropped} so far")


@dataclass(frozen=True, slots=True)
class RecordingFailed(PlainData):
    """A recording ended early because of a write error; the file can be read up to there, and the program goes on.

    Attributes
    ----------
    stamp : int
        Time of the event, in ns.
    path : str
        The recording.
    error : Exception
        The write error.

    Examples
    --------
    >>> print(RecordingFailed(0, "run.mcap", OSError("no space left on device")))
    0.000 s: the recording run.mcap has ended early: no space left on device
    """

    stamp: int
    path: str
    error: TransformError | Exception = field(compare=False)

    def __str__(self) -> str:
        return _line(self.stamp, f"the recording {self.path} has ended early: {self.error}")


Event = (
    FrameAdded
    | FrameRemoved
    | Reparented
    | KindChanged
    | AuthorityConflict
    | SampleRejected
    | PastLoop
    | FrameStale
    | FrameLive
    | StampAhead
    | StampBehind
    | ClockReset
    | SubscriberFailed
    | PeerJoined
    | PeerLost
    | PeerRejected
    | ClockOffset
    | PeerClockStepped
    | RecordingDropped
    | RecordingFailed
)
"""Any event of `Bus.events`."""


def _line(stamp: int, text: str) -> str:
    return f"{format_stamp(stamp)}: {printable(text)}"

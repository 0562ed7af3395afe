"""What happens on a bus besides samples, as frozen data; ``str`` gives one line for people.

``stamp`` is always the bus's clock when it happened, in ns. What the events say adds up: a frame is added and removed
in turns, and stale and live in turns. `ClockReset` forgets every moving frame, so those are added anew afterwards.
"""

from dataclasses import dataclass, field

from tfbus.stamps import format_duration, format_stamp


@dataclass(frozen=True, slots=True)
class FrameAdded:
    """A frame got its first sample, so it has a parent now; a stream begins with those that have one already."""

    stamp: int
    frame: str
    parent: str
    authority: str
    static: bool

    def __str__(self) -> str:
        kind = "static" if self.static else "moving"
        return _line(self.stamp, f"{kind} frame {self.frame!r} is new under {self.parent!r}, from {self.authority!r}")


@dataclass(frozen=True, slots=True)
class FrameRemoved:
    """A frame was taken off its parent, and its samples are forgotten everywhere."""

    stamp: int
    frame: str

    def __str__(self) -> str:
        return _line(self.stamp, f"frame {self.frame!r} was removed")


@dataclass(frozen=True, slots=True)
class Reparented:
    """A frame's newest sample has another parent than the one before."""

    stamp: int
    frame: str
    parent: str
    old_parent: str
    authority: str

    def __str__(self) -> str:
        moves = f"moves from {self.old_parent!r} to {self.parent!r}"
        return _line(self.stamp, f"frame {self.frame!r} {moves}, says {self.authority!r}")


@dataclass(frozen=True, slots=True)
class KindChanged:
    """A moving frame has become static, or the other way round; `static` is what it is now."""

    stamp: int
    frame: str
    static: bool
    authority: str

    def __str__(self) -> str:
        kind = "static" if self.static else "moving"
        return _line(self.stamp, f"frame {self.frame!r} is now {kind}, says {self.authority!r}")


@dataclass(frozen=True, slots=True)
class AuthorityConflict:
    """A sample of a frame came from `authority`, the one before it from `other`."""

    stamp: int
    frame: str
    authority: str
    other: str

    def __str__(self) -> str:
        both = f"{self.authority!r} and {self.other!r}"
        return _line(self.stamp, f"frame {self.frame!r} comes from two authorities, {both}")


@dataclass(frozen=True, slots=True)
class SampleRejected:
    """The bus refused a sample, whether its sender was told or not.

    A stream tells it once for each frame, authority and reason, until the frame is removed or added or the clock jumps
    back; ``statistics().rejected`` counts every sample.

    Attributes
    ----------
    stamp : int
    reason : str
        As that of `InvalidTransformError`, or ``"not a sample"``: what ``statistics().rejected`` counts it by.
    frame, parent, authority : str or None
        The sample: its child, its parent and who sent it. None if it was not a sample.
    error : Exception
        What the sender was told, or would have been.
    """

    stamp: int
    reason: str
    frame: str | None
    parent: str | None
    authority: str | None
    error: Exception = field(compare=False)

    def __str__(self) -> str:
        sender = "" if self.authority is None else f" from {self.authority!r}"
        return _line(self.stamp, f"a sample{sender} was rejected: {self.error}")


@dataclass(frozen=True, slots=True)
class FrameStale:
    """A moving frame has had nothing new for longer than the stream's `stale_after`.

    Attributes
    ----------
    stamp : int
    frame, authority : str
    newest : int
        The stamp of its newest sample, in ns.
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
class FrameLive:
    """A frame that was stale has new data.

    Attributes
    ----------
    stamp : int
    frame, authority : str
    newest : int or None
        The stamp of its newest sample, in ns; None if it has become static.
    """

    stamp: int
    frame: str
    newest: int | None
    authority: str

    def __str__(self) -> str:
        return _line(self.stamp, f"frame {self.frame!r} is live again, from {self.authority!r}")


@dataclass(frozen=True, slots=True)
class ClockReset:
    """The clock jumped back, from `before` to `stamp` (ns); every moving frame is forgotten.

    With ``on_conflict="reject"`` its first authority keeps it all the same, until it is removed.
    """

    stamp: int
    before: int

    def __str__(self) -> str:
        return _line(self.stamp, f"the clock jumped back from {format_stamp(self.before)}")


@dataclass(frozen=True, slots=True)
class SubscriberFailed:
    """A callback raised an `Exception`; `subscriber` is its name."""

    stamp: int
    subscriber: str
    error: Exception

    def __str__(self) -> str:
        return _line(self.stamp, f"the subscriber {self.subscriber} raised {self.error!r}")


@dataclass(frozen=True, slots=True)
class PeerJoined:
    """Another bus was found over a link.

    Attributes
    ----------
    stamp : int
    link : str
        The domain of the link.
    peer : str
        The other end's own name for itself, made anew whenever it starts.
    """

    stamp: int
    link: str
    peer: str

    def __str__(self) -> str:
        return _line(self.stamp, f"peer {self.peer} has joined {self.link}")


@dataclass(frozen=True, slots=True)
class PeerLost:
    """Another bus has gone with its process or its link, is frozen, or cannot be reached any more.

    Attributes
    ----------
    stamp : int
    link, peer : str
        As in `PeerJoined`.
    authorities : tuple of str
        Whom it spoke for, sorted.
    frames : tuple of str
        What it was the last to publish, sorted; they leave the bus if the link drops what is lost.
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
class PeerRejected:
    """Something that another bus sent was refused; told once for each peer and reason.

    Attributes
    ----------
    stamp : int
    link, peer : str
        As in `PeerJoined`.
    reason : str
        What the link's statistics count it by.
    error : Exception
    """

    stamp: int
    link: str
    peer: str
    reason: str
    error: Exception = field(compare=False)

    def __str__(self) -> str:
        return _line(self.stamp, f"peer {self.peer} on {self.link} sent what was refused: {self.error}")


@dataclass(frozen=True, slots=True)
class RecordingDropped:
    """The disk is too slow for a recorder, which begins to lose samples; told again once it has caught up meanwhile.

    Attributes
    ----------
    stamp : int
    path : str
        The recording.
    dropped : int
        How many samples it has lost so far.
    """

    stamp: int
    path: str
    dropped: int

    def __str__(self) -> str:
        return _line(self.stamp, f"the recording {self.path} is behind and loses samples, {self.dropped} so far")


@dataclass(frozen=True, slots=True)
class RecordingFailed:
    """A recording could not be written any further; what is in the file can be read, and the program goes on.

    Attributes
    ----------
    stamp : int
    path : str
        The recording.
    error : Exception
        What the disk said.
    """

    stamp: int
    path: str
    error: Exception = field(compare=False)

    def __str__(self) -> str:
        return _line(self.stamp, f"the recording {self.path} has ended early: {self.error}")


Event = (
    FrameAdded
    | FrameRemoved
    | Reparented
    | KindChanged
    | AuthorityConflict
    | SampleRejected
    | FrameStale
    | FrameLive
    | ClockReset
    | SubscriberFailed
    | PeerJoined
    | PeerLost
    | PeerRejected
    | RecordingDropped
    | RecordingFailed
)
"""What `Bus.events` gives."""


def _line(stamp: int, text: str) -> str:
    return f"{format_stamp(stamp)}: {' '.join(text.splitlines())}"

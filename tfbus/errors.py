"""The error classes of tfbus.

::

    TransformError
        TransformLookupError (LookupError)
            UnknownFrameError                  .frame .close_matches .missed  waiting may help
            DisconnectedError                  .target .source .roots         waiting may help
            ExtrapolationError                 .child .stamp .oldest .newest .authority
                FutureExtrapolationError                                      waiting may help
                PastExtrapolationError                                        waiting cannot help: raised at once
                GapError                   .before .after .max_gap            waiting cannot help: raised at once
                AheadError                                                    waiting cannot help: raised at once
            LookupTimeoutError (TimeoutError)  __cause__ is the last lookup error
            RemoteLookupError                  .domain .robot .reason .detail
        InvalidTransformError (ValueError)     .reason .parent .child .authority .loop .owner
            TooManyFramesError                 .frames .max_frames
        InvalidRobotError (ValueError)         .element
        RecordingError (ValueError)            .path .reason
            MissingRecordingError (FileNotFoundError)
        ClockResetError                        .before .after
        BusClosedError

Each error keeps its facts as attributes and builds its message from them, so programs need not parse messages. Errors
can be pickled and copied, with their cause. Arguments of the wrong type raise `TypeError`, as everywhere in Python.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property, lru_cache
from heapq import nlargest
from itertools import islice
from typing import Any, Self, TypeVar, get_type_hints

from tfbus.plain import from_fields, from_plain, printable, to_plain
from tfbus.stamps import SECOND, Latest, format_duration, format_stamp, likely_cause

MOST_NAMES = 2_000
"""The number of known names that an error about an unknown name keeps."""

LONGEST_NAME = 64
"""Longer names, in letters, are never taken for similar, because the time of a comparison is quadratic."""

LOOKED_AT = 10
"""The number of known names that are compared in full with an unknown name; each comparison takes tens of us."""

SHOWN_FRAMES = 10
"""The number of frames of a loop that a text names."""


AnyError = TypeVar("AnyError", bound="TransformError")


def loop_text(frames: Sequence[str]) -> str:
    """The frames of a loop of parents in words, the first one repeated at the end; a long loop is shortened."""
    shown = frames
    if len(frames) > SHOWN_FRAMES:
        shown = (*frames[: SHOWN_FRAMES - 2], f"({len(frames) - SHOWN_FRAMES + 1} more)", frames[-1])
    return " -> ".join(shown)


def pip_install(extras: str) -> str:
    """The command that installs extras, such as ``"cli,zenoh"``: from an index, and in a checkout."""
    return f'pip install "tfbus[{extras}]", or ".[{extras}]" in a checkout'


def _restore(
    cls: type[AnyError], args: tuple[Any, ...], facts: dict[str, Any], cause: BaseException | None
) -> AnyError:
    # LookupTimeoutError inherits `__new__` from LookupError, which refuses subclasses of OSError.
    make: Any = OSError.__new__ if issubclass(cls, OSError) else cls.__new__
    error: AnyError = make(cls, *args)
    error.args = args
    error.__dict__.update(facts)
    if cause is not None:
        error.__cause__ = cause
    return error


def error_of(kind: type[AnyError], facts: dict[str, Any]) -> AnyError:
    """An error that consists of its facts, such as ``kind(**facts)`` gives it, in half the time; nothing is checked."""
    error = kind.__new__(kind)
    error.__dict__ = facts
    return error


class TransformError(Exception):
    """Base class of all tfbus errors. The text is one line: control characters in names are escaped in it."""

    def __str__(self) -> str:
        return printable(self._why())

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self)!r})"

    def __reduce__(self) -> tuple[Any, ...]:
        return _restore, (type(self), self.args, self.__dict__, self.__cause__)

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON: the class as ``"type"``, the ``"message"``, the facts, and the cause or None."""
        facts = {name: to_plain(getattr(self, name)) for name in self._facts()}
        return {"type": type(self).__name__, "message": str(self), **facts, "cause": to_plain(self.__cause__)}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """The error from which `to_dict` made `data`, of this class or a subclass.

        A cause that is not an error of tfbus comes back as an `Exception` with its type and message.

        Raises
        ------
        ValueError
            If the data do not describe such an error. The message names the fact.
        """
        given = dict(data)
        name, message, cause = (given.pop(key, None) for key in ("type", "message", "cause"))
        kind: type[Self] | None = next((kind for kind in _with_subclasses(cls) if kind.__name__ == name), None)
        if kind is None or not isinstance(message, str):
            raise ValueError(f"these are not the data of a {cls.__name__}: type {name!r}, message {message!r}")
        hints = kind._facts()
        facts = from_fields(kind, given, hints)
        index = "" if facts.get("index") is None else f"stamps[{facts['index']}]: "
        args = () if kind._why is not TransformError._why else (message.removeprefix(index),)
        reason = from_plain(TransformError | Exception | None, cause, f"{name}.cause")
        return _restore(kind, args, facts, reason)

    @classmethod
    def _facts(cls) -> dict[str, Any]:
        """The names and types of the facts: the public annotations of the class."""
        return {name: hint for name, hint in get_type_hints(cls).items() if not name.startswith("_")}

    def _why(self) -> str:
        """The message; a class that builds it from its facts overrides this."""
        # Not `super().__str__()`, because `OSError` would make a message of its own.
        return Exception.__str__(self)


def _with_subclasses(cls: type[AnyError]) -> Iterable[type[AnyError]]:
    yield cls
    for below in cls.__subclasses__():
        yield from _with_subclasses(below)


class TransformLookupError(TransformError, LookupError):
    """A lookup has no answer, at least not now.

    Attributes
    ----------
    index : int or None
        The index of the stamp without an answer in a lookup of many stamps; None for a lookup of one stamp.
    """

    index: int | None = None

    def __str__(self) -> str:
        text = super().__str__()
        return text if self.index is None else f"stamps[{self.index}]: {text}"


class UnknownFrameError(TransformLookupError):
    """No sample in the tree names this frame. Waiting may help.

    Attributes
    ----------
    frame : str
        The unknown frame.
    close_matches : tuple of str
        Frames with a similar name, the most similar first, among the frames that were known when the error was raised;
        if these were many, only some of them are searched. Computed when first read.
    missed : bool
        Whether the bus of the buffer has the frame, but no sample of it came since the buffer was made: a buffer begins
        with what is latched, or with its `prefill`.
    """

    frame: str
    missed: bool = False
    _known: tuple[str, ...] = ()

    def __init__(self, *, frame: str, known: Iterable[str] = ()) -> None:
        super().__init__()
        self.frame = frame
        # The same tuple for all errors of a tree, until its frames change.
        self._known = tuple(islice(known, MOST_NAMES)) if type(known) is not tuple else known[:MOST_NAMES]

    @cached_property
    def close_matches(self) -> tuple[str, ...]:
        """Known frames with a similar name, the most similar first."""
        return _close_matches(self.frame.lstrip("/"), self._known)

    def _why(self) -> str:
        if self.missed:
            return f"frame {self.frame!r} is not known: its samples came before this buffer was made, see prefill"
        hint = " or ".join(repr(name) for name in self.close_matches)
        slash = ", a frame name has no leading slash" if self.frame.startswith("/") else ""
        return f"frame {self.frame!r} is not known{slash}" + (f", did you mean {hint}?" if hint else "")

    @classmethod
    def _facts(cls) -> dict[str, Any]:
        return {**super()._facts(), "close_matches": tuple[str, ...]}

    def __reduce__(self) -> tuple[Any, ...]:
        facts = {**self.__dict__, "_known": (), "close_matches": self.close_matches}
        return _restore, (type(self), self.args, facts, self.__cause__)


# Many lookups may wait for one frame, and each has its own error.
@lru_cache(maxsize=128)
def _close_matches(frame: str, known: tuple[str, ...]) -> tuple[str, ...]:
    # Few processes show such an error.
    from difflib import get_close_matches

    length = len(frame)
    if length > LONGEST_NAME:
        return ()
    size = 1 + length // 8
    parts = [frame[i : i + size] for i in range(0, length, size)]

    def likeness(name: str) -> int:
        return 2 * sum(map(name.__contains__, parts)) - abs(len(name) - length)

    short = [name for name in known if len(name) <= LONGEST_NAME]
    # A comparison of long names takes up to 2 ms.
    most = max(3, min(LOOKED_AT, 10_000 // max(length, 1) ** 2))
    candidates = short if len(short) <= most else nlargest(most, short, likeness)
    return tuple(get_close_matches(frame, candidates))


class DisconnectedError(TransformLookupError):
    """Both frames are known, but no path of samples connects them. Waiting may help.

    Attributes
    ----------
    target, source : str
        The two frames of the lookup.
    roots : tuple of str
        The root of target's tree and the root of source's.
    stamp : int or None
        The stamp at which they are not connected, in ns; None for a lookup of the newest samples.
    loop : tuple of str
        Frames that form a loop of parents at that stamp, the first one repeated at the end; empty if there is none.
        Only samples that came late or out of order can form one.
    """

    target: str
    source: str
    roots: tuple[str, str]
    stamp: int | None
    loop: tuple[str, ...]

    def __init__(
        self,
        *,
        target: str,
        source: str,
        roots: tuple[str, str],
        stamp: int | None = None,
        loop: tuple[str, ...] = (),
    ) -> None:
        super().__init__()
        self.target = target
        self.source = source
        self.roots = roots
        self.stamp = stamp
        self.loop = loop

    def _why(self) -> str:
        when = "" if self.stamp is None else f" at {format_stamp(self.stamp)}"
        if self.loop:
            why = f"the frames {loop_text(self.loop)} form a loop{when}"
        else:
            why = f"they are in different trees{when}, with roots {self.roots[0]!r} and {self.roots[1]!r}"
        return f"no path from {self.source!r} to {self.target!r}: {why}"


def clock_named(namers: Iterable[Callable[[str], str]], frame: str) -> str:
    """The clock that stamps a frame, in the words of the links of a bus; empty if it is the clock of the bus."""
    return "".join(name(frame) for name in namers)


class ExtrapolationError(TransformLookupError):
    """The samples of an edge on the path do not cover the stamp.

    Attributes
    ----------
    child : str
        The child frame of the edge.
    stamp : int or Latest
        The stamp that the edge does not cover, in ns.
    oldest, newest : int or None
        The stamps of the edge's oldest and newest sample, in ns; None if it has no samples.
    authority : str
        The sender of the edge's newest sample; may be empty.
    slack : int
        The greatest distance between the stamp and a sample that the policy allowed, in ns.
    ahead : int
        The time from the clock's now to the edge's newest stamp, in ns, if it exceeds the `max_ahead` of the bus: then
        correct samples are older, and may have expired. Otherwise 0, as in all errors of a tree without a bus.
    max_age : int or None
        The `max_age` that the newest answer of a buffer exceeds, in ns; None if another reason decides.
    clock : str
        The clock of the sender beside the clock of the bus, in words, if a link knows that they differ; else empty.
        Computed when first read.
    """

    child: str
    stamp: int | Latest
    oldest: int | None
    newest: int | None
    authority: str
    slack: int
    ahead: int = 0
    max_age: int | None = None
    _clock_namers: Sequence[Callable[[str], str]] = ()

    def __init__(
        self,
        *,
        child: str,
        stamp: int | Latest,
        oldest: int | None,
        newest: int | None,
        authority: str = "",
        slack: int = 0,
    ) -> None:
        super().__init__()
        self.child = child
        self.stamp = stamp
        self.oldest = oldest
        self.newest = newest
        self.authority = authority
        self.slack = slack

    @cached_property
    def clock(self) -> str:
        """The clock of the sender, in words; empty if it is that of the bus."""
        return clock_named(self._clock_namers, self.child)

    @classmethod
    def _facts(cls) -> dict[str, Any]:
        return {**super()._facts(), "clock": str}

    def __reduce__(self) -> tuple[Any, ...]:
        facts = {**self.__dict__, "_clock_namers": (), "clock": self.clock}
        return _restore, (type(self), self.args, facts, self.__cause__)

    def _asked(self) -> str:
        asked = "the latest" if isinstance(self.stamp, Latest) else format_stamp(self.stamp)
        return f"{asked} within {format_duration(self.slack)}" if self.slack else asked

    def _gap(self) -> str:
        return "there is no sample in its window"

    def _why(self) -> str:
        sender = f", from {self.authority!r}" if self.authority else ""
        if self.ahead:
            ahead = format_duration(self.ahead)
            sender += f"; its newest stamp is {ahead} ahead of the clock, and right samples expire"
        if self.clock:
            sender += f"; {self.clock}"
        if self.max_age is not None and self.newest is not None and not isinstance(self.stamp, Latest):
            return f"frame {self.child!r}: {self._age(self.newest, self.stamp, self.max_age)}{sender}"
        cause = self._cause()
        sender += f": {cause}" if cause else ""
        return f"frame {self.child!r}: asked for {self._asked()}, {self._gap()}{sender}"

    def _age(self, newest: int, stamp: int, max_age: int) -> str:
        """The age of the newest sample, and the greatest that the lookup allows."""
        age, most = format_duration(stamp + max_age - newest), format_duration(max_age + self.slack)
        return f"newest sample is {age} old, and may be {most} old (max_age)"

    def _cause(self) -> str:
        """The likely cause, in words, if the stamp that was asked is far from all samples; else empty."""
        if self.newest is None or isinstance(self.stamp, Latest):
            return ""
        if self.stamp == 0 and self.oldest is not None and self.oldest > 0:
            return "was this stamp never set? For the newest, ask at LATEST, not at 0"
        cause = likely_cause(self.stamp, self.newest)
        if not cause or not 0 < self.stamp < self.newest:
            return cause
        if cause.startswith("seconds"):
            return f"{cause} from_seconds({self.stamp}) is that stamp"
        # No robot asks for its first millisecond, and a program that begins often asks for a round number of seconds.
        return f"for seconds write from_seconds({self.stamp})" if self.stamp < SECOND // 1_000 else cause


class FutureExtrapolationError(ExtrapolationError):
    """The stamp is newer than the edge's newest sample, or the edge has no samples. Waiting may help.

    Attributes
    ----------
    others : tuple of str
        Other child frames whose next sample may also give an answer; empty unless a policy is used with `LATEST`, or
        two ways lead round a loop of parents at the stamp.
    """

    others: tuple[str, ...] = ()

    def _gap(self) -> str:
        if self.newest is None or isinstance(self.stamp, Latest):
            return "it has no samples"
        short = format_duration(self.stamp - self.newest)
        return f"newest sample is {format_stamp(self.newest)} ({short} short)"


class PastExtrapolationError(ExtrapolationError):
    """The stamp is older than the edge's oldest sample. Waiting cannot help, so it is raised at once."""

    def _gap(self) -> str:
        if self.oldest is None or isinstance(self.stamp, Latest):
            return "it has no samples"
        early = format_duration(self.oldest - self.stamp)
        return f"oldest sample is {format_stamp(self.oldest)} ({early} too early)"


class GapError(ExtrapolationError):
    """The stamp is between two samples that are further apart than `max_gap`. Waiting cannot help.

    Attributes
    ----------
    before, after : int
        The stamps of the two samples, in ns.
    max_gap : int
        The greatest gap that the lookup allowed, in ns.
    """

    before: int
    after: int
    max_gap: int

    def __init__(self, *, before: int, after: int, max_gap: int, **facts: Any) -> None:
        super().__init__(**facts)
        self.before = before
        self.after = after
        self.max_gap = max_gap

    def _gap(self) -> str:
        return (
            f"between samples at {format_stamp(self.before)} and {format_stamp(self.after)}, which are "
            f"{format_duration(self.after - self.before)} apart (at most {format_duration(self.max_gap)})"
        )


class AheadError(ExtrapolationError):
    """The newest answer is further ahead of the clock than `max_age` allows. Waiting for samples cannot help.

    `stamp` is the newest stamp that was allowed, in ns; `child` is the edge that determines the stamp of the answer.
    """

    def _asked(self) -> str:
        return f"the latest up to {super()._asked()}"

    def _age(self, newest: int, stamp: int, max_age: int) -> str:
        ahead, most = format_duration(newest - stamp + max_age), format_duration(max_age)
        return f"newest sample is {ahead} ahead of the clock, and may be {most} ahead (max_age)"

    def _gap(self) -> str:
        if self.newest is None or isinstance(self.stamp, Latest):
            return "it has no samples"
        late = format_duration(self.newest - self.stamp)
        return f"newest sample is {format_stamp(self.newest)} ({late} too new)"


class LookupTimeoutError(TransformLookupError, TimeoutError):
    """The timeout of an awaited lookup expired; ``__cause__`` is the lookup error at that moment.

    `TimeoutError` is an `OSError`, so an ``except OSError`` around a socket loop catches this error too. Put
    ``except TransformLookupError`` before it.

    Attributes
    ----------
    target, source : str
        The two frames of the lookup.
    timeout : float
        The timeout, in s on the bus's clock.
    """

    target: str
    source: str
    timeout: float
    _missing: BaseException | None = None

    def __init__(self, *, target: str, source: str, timeout: float, missing: TransformLookupError) -> None:
        super().__init__()
        self.target = target
        self.source = source
        self.timeout = timeout
        self._missing = missing

    def _why(self) -> str:
        # Not earlier, because a thousand timeouts at once would search similar names for a thousand frames.
        # An error that comes back from JSON has only its cause.
        missing = self.__cause__ if self._missing is None else self._missing
        return f"no transform from {self.source!r} to {self.target!r} within {self.timeout:g} s: {missing}"


class RemoteLookupError(TransformLookupError):
    """The server of another process's buffer has given neither a transform nor the error of a failed lookup.

    Attributes
    ----------
    domain : str
        The domain that was asked.
    robot : str or None
        The robot that was asked.
    reason : str
        ``"absent"``: there is no such server; ``"lost"``: it has gone, or cannot be reached any more; ``"busy"``: too
        many lookups wait there, or arrive per second; ``"silent"``: it is there, but does not answer; ``"malformed"``:
        its answer, or the question, could not be read, or the answer belongs to another question; ``"internal"``: the
        lookup failed there with an error that lookups do not raise.
    detail : str
        The same in words.
    """

    domain: str
    robot: str | None
    reason: str
    detail: str

    def __init__(self, *, domain: str, robot: str | None, reason: str, detail: str) -> None:
        super().__init__()
        self.domain = domain
        self.robot = robot
        self.reason = reason
        self.detail = detail

    def _why(self) -> str:
        whose = "a buffer without a robot" if self.robot is None else f"the buffer of robot {self.robot!r}"
        return f"no answer from {whose} in domain {self.domain!r}: {self.detail}"


class InvalidTransformError(TransformError, ValueError):
    """A sample is invalid, or its authority may not publish the child; nothing was stored.

    Attributes
    ----------
    reason : str
        The broken rule as a fixed text (``"cycle"``, ``"not finite"``, ``"frame name"``); statistics count rejected
        samples by it.
    parent, child, authority : str or None
        Of the sample; None if the code that raises the error does not know it.
    loop : tuple of str
        For ``"cycle"``, the whole loop from child to parent, with its first frame repeated at the end.
    owner : str or None
        For ``"authority"`` and ``"reserved"``, the only authority that may publish the child.
    """

    reason: str
    parent: str | None
    child: str | None
    authority: str | None
    loop: tuple[str, ...]
    owner: str | None

    def __init__(
        self,
        message: str,
        *,
        reason: str,
        parent: str | None = None,
        child: str | None = None,
        authority: str | None = None,
        loop: tuple[str, ...] = (),
        owner: str | None = None,
    ) -> None:
        super().__init__(message)
        self.reason = reason
        self.parent = parent
        self.child = child
        self.authority = authority
        self.loop = loop
        self.owner = owner


class TooManyFramesError(InvalidTransformError):
    """A sample names new frames for which the bus has no place; nothing was stored.

    Attributes
    ----------
    frames : int
        The number of frames on the bus.
    max_frames : int
        The greatest number of frames that it takes.
    """

    frames: int
    max_frames: int

    def __init__(self, *, frames: int, max_frames: int, parent: str, child: str, authority: str) -> None:
        super().__init__(
            f"the edge {parent!r} -> {child!r} from {authority!r} names a new frame, but the bus has {frames:,} frames "
            f"and takes {max_frames:,}: remove frames that are gone, or make the bus with a greater max_frames",
            reason="too many frames",
            parent=parent,
            child=child,
            authority=authority,
        )
        self.frames = frames
        self.max_frames = max_frames


class InvalidRobotError(TransformError, ValueError):
    """A robot description cannot be used.

    Attributes
    ----------
    element : str
        The invalid element, such as ``<joint name="elbow">``; empty if the error is about the whole description.
    """

    element: str

    def __init__(self, problem: str, *, element: str = "") -> None:
        super().__init__(f"in {element}: {problem}" if element else problem)
        self.element = element


class RecordingError(TransformError, ValueError):
    """A file cannot be read as a recording.

    Attributes
    ----------
    path : str
        The file.
    reason : str
        ``"missing"``, ``"empty"``, ``"truncated"`` (before its first message), ``"foreign"`` (no recording),
        ``"damaged"``, ``"unreadable"`` or ``"missing extra"``.
    """

    path: str
    reason: str

    def __init__(self, problem: str, *, path: str, reason: str, kind: str = "recording") -> None:
        # Messages of other packages may have several lines.
        super().__init__(f"{kind} {path!r}: {' '.join(problem.split()).rstrip('.')}")
        self.path = path
        self.reason = reason


class MissingRecordingError(RecordingError, FileNotFoundError):
    """There is no file of this name; as with other files, ``except FileNotFoundError`` catches it."""

    def __init__(self, *, path: str, kind: str = "recording") -> None:
        super().__init__("there is no such file", path=path, reason="missing", kind=kind)


class ClockResetError(TransformError):
    """The clock jumped back during a wait for a stamp.

    Attributes
    ----------
    before, after : int
        The clock's stamps just before and just after the jump, in ns.
    """

    before: int
    after: int

    def __init__(self, *, before: int, after: int) -> None:
        super().__init__(f"the clock jumped back from {format_stamp(before)} to {format_stamp(after)}")
        self.before = before
        self.after = after


class BusClosedError(TransformError):
    """The bus or the buffer is closed, so no more samples will arrive."""

    def __init__(self, message: str = "the bus is closed") -> None:
        super().__init__(message)


MAY_COME = (UnknownFrameError, DisconnectedError, FutureExtrapolationError)
"""The lookup errors that a later sample may resolve."""

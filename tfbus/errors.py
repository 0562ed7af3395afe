"""Every error that tfbus raises of its own.

::

    TransformError
        TransformLookupError (LookupError)
            UnknownFrameError                  .frame .close_matches          waiting may help
            DisconnectedError                  .target .source .roots         waiting may help
            ExtrapolationError                 .child .stamp .oldest .newest .authority
                FutureExtrapolationError                                      waiting may help
                PastExtrapolationError                                        waiting cannot help: raised at once
                GapError                   .before .after .max_gap            waiting cannot help: raised at once
            LookupTimeoutError (TimeoutError)  __cause__ says what was still missing
        InvalidTransformError (ValueError)     .reason .parent .child .authority .loop .owner
        InvalidRobotError (ValueError)         .element
        RecordingError (ValueError)            .path .reason
        ClockResetError                        .before .after
        BusClosedError

Each error is built from facts and keeps them as attributes; the message is made from them, so nobody has to parse one.
They pickle and copy, cause included. Arguments of the wrong type raise `TypeError`, as everywhere in Python.
"""

import difflib
from collections.abc import Iterable
from functools import cached_property, lru_cache
from heapq import nlargest
from typing import Any

from tfbus.stamps import Latest, format_duration, format_stamp

LOOKED_AT = 30
"""How many names are compared in full with one that is not known: each takes tens of microseconds."""


def _restore(
    cls: type["TransformError"], args: tuple[Any, ...], facts: dict[str, Any], cause: BaseException | None
) -> "TransformError":
    # `cls.__new__` of a timeout is that of LookupError, which refuses to make what is an OSError too.
    make = OSError.__new__ if issubclass(cls, OSError) else cls.__new__
    error: TransformError = make(cls, *args)
    error.args = args
    error.__dict__.update(facts)
    if cause is not None:
        error.__cause__ = cause
    return error


class TransformError(Exception):
    """Base of every error of tfbus."""

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self)!r})"

    def __reduce__(self) -> tuple[Any, ...]:
        return _restore, (type(self), self.args, self.__dict__, self.__cause__)


class TransformLookupError(TransformError, LookupError):
    """A transform was asked for that cannot be given, at least not now.

    Attributes
    ----------
    index : int or None
        Which of the stamps it was, where many were asked for at once.
    """

    index: int | None = None

    def _why(self) -> str:
        return super().__str__()

    def __str__(self) -> str:
        return self._why() if self.index is None else f"stamps[{self.index}]: {self._why()}"


class UnknownFrameError(TransformLookupError):
    """No sample in the tree names this frame. Waiting may help.

    Attributes
    ----------
    frame : str
        The frame that was asked for.
    close_matches : tuple of str
        Known frames with a similar name, the most similar first; worked out when it is first read.
    """

    def __init__(self, *, frame: str, known: Iterable[str] = ()) -> None:
        super().__init__()
        self.frame = frame
        self._known = known

    @cached_property
    def close_matches(self) -> tuple[str, ...]:
        """Known frames with a similar name, the most similar first."""
        return _close_matches(self.frame.lstrip("/"), tuple(self._known))

    def _why(self) -> str:
        hint = " or ".join(repr(name) for name in self.close_matches)
        slash = ", a frame name has no leading slash" if self.frame.startswith("/") else ""
        return f"frame {self.frame!r} is not known{slash}" + (f", did you mean {hint}?" if hint else "")

    def __reduce__(self) -> tuple[Any, ...]:
        facts = {**self.__dict__, "_known": (), "close_matches": self.close_matches}
        return _restore, (type(self), self.args, facts, self.__cause__)


# Many lookups may wait for one frame, each with an error of its own.
@lru_cache(maxsize=128)
def _close_matches(frame: str, known: tuple[str, ...]) -> tuple[str, ...]:
    length = len(frame)
    size = 1 + length // 8
    parts = [frame[i : i + size] for i in range(0, length, size)]

    def likeness(name: str) -> int:
        return 2 * sum(map(name.__contains__, parts)) - abs(len(name) - length)

    candidates = known if len(known) <= LOOKED_AT else nlargest(LOOKED_AT, known, likeness)
    return tuple(difflib.get_close_matches(frame, candidates))


class DisconnectedError(TransformLookupError):
    """Both frames are known, but no chain of samples joins them. Waiting may help.

    Attributes
    ----------
    target, source : str
        The question.
    roots : tuple of str
        The root of target's tree and the root of source's.
    stamp : int or None
        The instant at which they are apart, in ns; None where the newest samples were asked.
    loop : tuple of str
        Frames that hang on each other in a circle, where out-of-order samples formed one; else empty.
    """

    def __init__(
        self,
        *,
        target: str,
        source: str,
        roots: tuple[str, str],
        stamp: int | None = None,
        loop: tuple[str, ...] = (),
    ) -> None:
        when = "" if stamp is None else f" at {format_stamp(stamp)}"
        if loop:
            why = f"the frames {' -> '.join(loop)} form a loop{when}"
        else:
            why = f"they are in different trees{when}, with roots {roots[0]!r} and {roots[1]!r}"
        super().__init__(f"no path from {source!r} to {target!r}: {why}")
        self.target = target
        self.source = source
        self.roots = roots
        self.stamp = stamp
        self.loop = loop


class ExtrapolationError(TransformLookupError):
    """A frame on the path has samples, but none that cover the stamp.

    Attributes
    ----------
    child : str
        The frame whose edge to its parent does not cover the stamp.
    stamp : int or Latest
        What was asked of that edge, in ns.
    oldest, newest : int or None
        The edge's window in ns; None when it is empty.
    authority : str
        Who sent its newest sample; may be empty.
    slack : int
        How far from a sample the answer was allowed to be, in ns.
    """

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

    def _gap(self) -> str:
        return "there is no sample in its window"

    def _why(self) -> str:
        asked = "the latest" if isinstance(self.stamp, Latest) else format_stamp(self.stamp)
        if self.slack:
            asked += f" within {format_duration(self.slack)}"
        sender = f", from {self.authority!r}" if self.authority else ""
        return f"frame {self.child!r}: asked for {asked}, {self._gap()}{sender}"


class FutureExtrapolationError(ExtrapolationError):
    """The stamp is newer than the edge's newest sample, or the edge has none. Waiting may help.

    Attributes
    ----------
    others : tuple of str
        Other frames of which a sample may help as well; only for `LATEST` under a policy.
    """

    others: tuple[str, ...] = ()

    def _gap(self) -> str:
        if self.newest is None or isinstance(self.stamp, Latest):
            return "it has no samples"
        short = format_duration(self.stamp - self.newest)
        return f"newest sample is {format_stamp(self.newest)} ({short} short)"


class PastExtrapolationError(ExtrapolationError):
    """The stamp is older than the edge's oldest sample. Waiting cannot help, so nothing waits on it."""

    def _gap(self) -> str:
        if self.oldest is None or isinstance(self.stamp, Latest):
            return "it has no samples"
        early = format_duration(self.oldest - self.stamp)
        return f"oldest sample is {format_stamp(self.oldest)} ({early} too early)"


class GapError(ExtrapolationError):
    """The stamp lies between two samples that are further apart than `max_gap`. Waiting cannot help.

    Attributes
    ----------
    before, after : int
        The stamps of the two samples, in ns.
    max_gap : int
        In ns.
    """

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


class LookupTimeoutError(TransformLookupError, TimeoutError):
    """An awaited lookup ran out of time; ``__cause__`` is the error that it still had.

    The mistake to avoid: `TimeoutError` is an `OSError`, so an ``except OSError`` around a socket loop swallows this.
    Put ``except TransformLookupError`` before it.

    Attributes
    ----------
    target, source : str
        The question.
    timeout : float
        How long was waited, in s on the bus's clock.
    """

    def __init__(self, *, target: str, source: str, timeout: float, missing: TransformLookupError) -> None:
        super().__init__(f"no transform from {source!r} to {target!r} within {timeout:g} s: {missing}")
        self.target = target
        self.source = source
        self.timeout = timeout


class InvalidTransformError(TransformError, ValueError):
    """A sample that is wrong, or that its sender has no right to; nothing of it was stored.

    Attributes
    ----------
    reason : str
        The rule that it broke, in a few fixed words (``"cycle"``, ``"not finite"``, ``"frame name"``): rejections are
        counted by it.
    parent, child, authority : str or None
        The sample, as far as it is known where the error is raised.
    loop : tuple of str
        For ``"cycle"``, the whole loop from child to parent, its first frame repeated at the end.
    owner : str or None
        For ``"authority"`` and ``"reserved"``, the authority that has the right to the child.
    """

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


class InvalidRobotError(TransformError, ValueError):
    """A robot's description cannot be used.

    Attributes
    ----------
    element : str
        The part of it that is wrong, such as ``<joint name="elbow">``; empty where it is the whole.
    """

    def __init__(self, problem: str, *, element: str = "") -> None:
        super().__init__(f"in {element}: {problem}" if element else problem)
        self.element = element


class RecordingError(TransformError, ValueError):
    """A file cannot be read as a recording.

    Attributes
    ----------
    path : str
    reason : str
        ``"missing"``, ``"empty"``, ``"truncated"`` (before its first message), ``"foreign"``, ``"damaged"``,
        ``"unreadable"`` or ``"missing extra"``.
    """

    def __init__(self, problem: str, *, path: str, reason: str) -> None:
        # What other packages say of a file may have several lines.
        super().__init__(f"recording {path!r}: {' '.join(problem.split()).rstrip('.')}")
        self.path = path
        self.reason = reason


class ClockResetError(TransformError):
    """The clock jumped back while something waited for a stamp of the old time.

    Attributes
    ----------
    before, after : int
        The clock just before and just after the jump, in ns.
    """

    def __init__(self, *, before: int, after: int) -> None:
        super().__init__(f"the clock jumped back from {format_stamp(before)} to {format_stamp(after)}")
        self.before = before
        self.after = after


class BusClosedError(TransformError):
    """The bus, or this buffer, was closed: nothing more will arrive."""

    def __init__(self, message: str = "the bus is closed") -> None:
        super().__init__(message)


MAY_COME = (UnknownFrameError, DisconnectedError, FutureExtrapolationError)
"""The errors that waiting may help against."""

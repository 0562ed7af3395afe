"""The lookups that a message needs: into one target or several, at its stamp and perhaps some time later."""

from collections.abc import Iterator, Sequence
from typing import Generic, TypeVar, cast

from tfbus.buffer.buffer import Buffer
from tfbus.errors import MAY_COME, LookupTimeoutError, TransformLookupError, UnknownFrameError
from tfbus.frames import is_frame
from tfbus.geometry.rows import IDENTITY
from tfbus.geometry.stamped import answer_of
from tfbus.stamps import STAMP_MAX, Latest, as_duration, from_seconds
from tfbus.tree.question import Question
from tfbus.tree.tree import forest_of

AnswerT = TypeVar("AnswerT")


class Targets(Generic[AnswerT]):
    """The target frames of a message filter.

    Parameters
    ----------
    buffer : Buffer
    target : str or sequence of str
        With one, an answer is a transform; with a sequence, a tuple of transforms in that order.
    tolerance : float
        In s. The transform at this much later has to be known too.

    Raises
    ------
    UnknownFrameError
        If a target cannot be the name of a frame.
    TypeError, ValueError
        If there is no target, or `tolerance` is not a duration.
    """

    def __init__(self, buffer: Buffer, target: str | Sequence[str], tolerance: float) -> None:
        self._buffer = buffer
        self._one = isinstance(target, str)
        self._names = self._names_of(target)
        self._tolerance = from_seconds(as_duration(tolerance, "tolerance"))

    def replace(self, target: str | Sequence[str]) -> None:
        """Change the targets; `TypeError` unless both are one frame, or both a sequence."""
        if isinstance(target, str) is not self._one:
            wanted = "one target" if self._one else "a sequence of targets"
            raise TypeError(f"the filter was made for {wanted}, and its pairs keep their shape: not {target!r}")
        self._names = self._names_of(target)

    def questions(self, frame: str, stamp: int | Latest) -> Iterator[tuple[str, int | Latest]]:
        """The targets and stamps (ns) to look up; the last one of each target gives its transform."""
        for target in self._names:
            if target == frame:
                continue
            if self._tolerance and not isinstance(stamp, Latest):
                yield target, min(stamp + self._tolerance, STAMP_MAX)
            yield target, stamp

    def lookup_nowait(self, frame: str, stamp: int | Latest) -> AnswerT:
        """The answer, or an error at once.

        Raises
        ------
        TransformLookupError
            If there is none. An error that waiting cannot help is raised before one that it may help.
        """
        now = self._buffer.bus.clock.now() if isinstance(stamp, Latest) else stamp
        found = {frame: answer_of(frame, frame, now, IDENTITY, static=True)}
        blocker: TransformLookupError | None = None
        for target, at in self.questions(frame, stamp):
            try:
                found[target] = self._buffer.lookup_nowait(target, frame, at)
            except MAY_COME as error:
                blocker = blocker or error
        if blocker is not None:
            raise blocker
        answers = tuple(found[target] for target in self._names)
        return cast(AnswerT, answers[0] if self._one else answers)

    async def wait(self, frame: str, stamp: int | Latest) -> None:
        """Wait until each question has had an answer; the errors are those of `Buffer.lookup`."""
        await self._buffer._lookup_among([Question(target, frame, at) for target, at in self.questions(frame, stamp)])

    def blocker(self, frame: str, stamp: int | Latest) -> TransformLookupError | None:
        """The error that an answer has now; None if there is an answer."""
        try:
            self.lookup_nowait(frame, stamp)
        except TransformLookupError as error:
            return error
        return None

    def lookup_at_timeout(self, frame: str, stamp: int | Latest, timeout: float) -> AnswerT:
        """The answer for a message that has waited `timeout` s; `LookupTimeoutError` where waiting might still help."""
        try:
            return self.lookup_nowait(frame, stamp)
        except MAY_COME:
            for target, at in self.questions(frame, stamp):
                try:
                    self._buffer.lookup_nowait(target, frame, at)
                except MAY_COME as blocker:
                    raise LookupTimeoutError(target=target, source=frame, timeout=timeout, missing=blocker) from blocker
            raise

    def _names_of(self, target: str | Sequence[str]) -> tuple[str, ...]:
        names = (target,) if isinstance(target, str) else tuple(target)
        if not names:
            raise ValueError("there must be at least one target")
        for name in names:
            if not is_frame(name):
                raise UnknownFrameError(frame=name, known=forest_of(self._buffer.tree).some_frames())
        return names

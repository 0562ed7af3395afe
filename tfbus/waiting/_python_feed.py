"""The plain insertion of a batch with its plain wake-ups, in Python: the definition of what ``tfbus/_kernel.c`` does.

What is not plain is left to `tfbus.waiting.live_tree`: a sample of a frame that is watched, one for which a lookup
waits whatever its stamp, and one that has passed a limit.
"""

from collections.abc import Callable, Mapping
from typing import Any, Protocol

from tfbus.geometry.stamped import Batch, TransformStamped
from tfbus.stamps import Latest

Place = tuple[int, int, Any]


class Paths(Protocol):
    """The plain answers and the plain commit of a forest; see `tfbus.tree.forest`."""

    version: int

    def answer(self, target: str, source: str, at: object, /) -> TransformStamped | None:
        """The plain answer, if there is one."""

    def commit(self, frames: Any, readers: Any, batch: Batch, /) -> bool:
        """Store a batch if it is plain; return whether it was."""


class Parked:
    """The part of a parked lookup by which it is woken.

    Attributes
    ----------
    plain : tuple or None
        Target, source and stamp of its question, if the kernel may answer it.
    wake : callable
        Called once, without arguments, after it was taken out of its line.
    place : tuple or None
        Its place in a line, if it has one.
    answer : TransformStamped or None
        The answer that whoever woke it has found, if there was one then.
    version : int
        That of the paths which had this answer.
    elsewhere : bool
        Whether more than its line, and the dict of all that are parked, has to forget it.
    """

    __slots__ = ("answer", "elsewhere", "place", "plain", "version", "wake")
    answer: TransformStamped | None
    elsewhere: bool
    place: Place | None
    plain: tuple[str, str, int | Latest | None] | None
    version: int
    wake: Callable[[], object]


class Line:
    """The parked lookups under one frame.

    Attributes
    ----------
    places : list of (-stamp, -order, Parked)
        Those that wait until the edge of the frame reaches a stamp (ns), sorted, so that the next due is the last.
    for_any : dict of Parked to None
        Those that any sample wakes.
    limits : list of (-stamp, -order, Parked)
        Those that a sample beyond a stamp wakes, sorted.
    """

    __slots__ = ("for_any", "limits", "places")

    def __init__(self) -> None:
        self.places: list[Place] = []
        self.for_any: dict[Any, None] = {}
        self.limits: list[Place] = []


class Feed:
    """The plain insertion of batches into a forest, with the plain wake-ups.

    Parameters
    ----------
    paths : Paths
    frames, readers : dict
        As `Paths.commit`.
    lines : dict of str to Line
        The parked lookups by the frame that blocks them.
    parked : dict of Parked to None
        All of them.
    limits : list of (-stamp, -order, Parked)
        The first limit of each that has one, sorted: a sample beyond the last one's stamp may have made that hopeless.
    watches : dict
        Has a key for each frame that is watched.
    forget : callable
        Called with one that is known elsewhere, instead of removing it from `parked`.
    """

    __slots__ = ("_forget", "_frames", "_limits", "_lines", "_parked", "_paths", "_readers", "_watches")

    def __init__(
        self,
        paths: Paths,
        frames: Mapping[str, Any],
        readers: Mapping[int, Any],
        lines: dict[str, Any],
        parked: dict[Any, None],
        limits: list[Any],
        watches: Mapping[str, Any],
        forget: Callable[[Any], object],
    ) -> None:
        self._paths = paths
        self._frames = frames
        self._readers = readers
        self._lines = lines
        self._parked = parked
        self._limits = limits
        self._watches = watches
        self._forget = forget

    def insert(self, batch: Batch) -> bool:
        """Store a batch and wake those that it has unblocked, each with its answer, if all of it is plain.

        Returns
        -------
        bool
            Whether it was; else nothing was done.

        Raises
        ------
        BaseException
            The first that `forget` raises, or a waiter if it is no `Exception`, after all have been woken.
        """
        lines = self._lines
        if (lines or self._watches or self._limits) and not self._is_plain(batch):
            return False
        if not self._paths.commit(self._frames, self._readers, batch):
            return False
        if lines:
            errors: list[BaseException] = []
            for sample in batch:
                self._wake(sample.child, sample.stamp, errors)
            if errors:
                raise errors[0]
        return True

    def _is_plain(self, batch: Batch) -> bool:
        """Whether only lookups that need a stamp wait for the samples, and none of these has passed the first limit."""
        for sample in batch:
            child = sample.child
            line = self._lines.get(child)
            if child in self._watches or (line is not None and (line.for_any or line.limits)):
                return False
            if self._limits and sample.stamp > -self._limits[-1][0]:
                return False
        return True

    def _wake(self, child: str, stamp: int, errors: list[BaseException]) -> None:
        """Wake those that a sample at a stamp has unblocked."""
        # Looked up each time, because to wake is to run the code of an event loop.
        while (line := self._lines.get(child)) is not None and line.places and -line.places[-1][0] <= stamp:
            waiter: Parked = line.places.pop()[2]
            # The place refers to the waiter.
            waiter.place = None
            if not (line.places or line.for_any or line.limits):
                del self._lines[child]
            try:
                if waiter.elsewhere:
                    self._forget(waiter)
                else:
                    # Not there if it could not be removed whole, for want of memory.
                    self._parked.pop(waiter, None)
            except BaseException as error:  # noqa: BLE001 - the first one is raised after all have been woken
                # It must be woken all the same.
                errors.append(error)
            if waiter.plain is not None:
                waiter.answer = self._paths.answer(*waiter.plain)
                waiter.version = self._paths.version
            try:
                waiter.wake()
            except BaseException as error:  # noqa: BLE001 - the first one is raised after all have been woken
                # Else its wait was cancelled, or its event loop is gone.
                if not isinstance(error, Exception):
                    errors.append(error)

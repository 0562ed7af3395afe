"""Counters, as plain frozen data: ``dataclasses.asdict`` makes them JSON."""

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class BufferStatistics:
    """One buffer since it was attached: ``offered == inserted + replaced + expired``."""

    offered: int
    inserted: int
    replaced: int
    expired: int
    waiting: int


@dataclass(frozen=True, slots=True)
class QueueStatistics:
    """One bounded queue: a stream, the samples of other threads, or events.

    Of moving samples, what was offered is what was read, is pending, was dropped, or gave way to another sample of the
    same child (`conflated`, with that overflow only).
    """

    kind: str
    overflow: str
    capacity: int
    pending: int
    dropped: int
    conflated: int = 0


@dataclass(frozen=True, slots=True)
class BusStatistics:
    """A bus since it was made.

    Attributes
    ----------
    samples : int
        Published and accepted.
    rejected : mapping of str to int
        Samples that were refused, by reason.
    reparented : int
        Samples that gave a child another newest parent.
    kind_changes : int
        Samples that turned a static child into a moving one, or back.
    authority_conflicts : int
        Samples of a child that followed one from another authority.
    clock_resets : int
        Jumps back of the clock.
    callbacks_failed : int
        Exceptions that subscribers raised.
    frames : int
        Children that the bus knows now.
    buffers : tuple of BufferStatistics
    queues : tuple of QueueStatistics
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

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


@dataclass(frozen=True, slots=True)
class LinkStatistics:
    """One link since it was entered.

    Attributes
    ----------
    peers : int
        Other ends that are there now.
    sent_messages, sent_samples : int
        What was handed to the network live. Static frames go out once more by themselves, for those who join late.
    received_messages, received_samples : int
        What was taken from it and published on the bus.
    lost : int
        Messages of peers that never came, by their numbers.
    duplicates : int
        Samples that had come before, or were overtaken by newer ones on another way.
    not_sent : mapping of str to int
        Samples and removals of this bus that cannot be put into a message, by reason.
    rejected : mapping of str to int
        Messages and samples of peers that were refused, by reason.
    queue : QueueStatistics
        The messages that wait for the event loop.
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


@dataclass(frozen=True, slots=True)
class RecorderStatistics:
    """One recorder since it was entered.

    What it was offered is ``samples + sum(refused.values()) + queue.pending + queue.dropped + queue.conflated``.

    Attributes
    ----------
    samples, messages : int
        What is in the file by now, and survives if the process is killed.
    unattributed : int
        Of the samples, those whose authority is not in the file, because there were too many.
    refused : mapping of str to int
        Samples that a message of ROS cannot hold, by reason.
    queue : QueueStatistics
        What waits for the disk. Dropped is what it was too slow for, or failed to take; conflated are static samples
        that gave way to a newer one of the same child when there was too much.
    """

    samples: int
    messages: int
    unattributed: int
    refused: Mapping[str, int]
    queue: QueueStatistics


@dataclass(frozen=True, slots=True)
class RobotStatistics:
    """One publisher of a robot since it was made.

    Attributes
    ----------
    messages : int
        Sets of positions that were published.
    unknown_joints : int
        Positions in them for joints that the robot does not have.
    violations : mapping of str to int
        Positions in them beyond the limits of a joint, by its name.
    """

    messages: int
    unknown_joints: int
    violations: Mapping[str, int]

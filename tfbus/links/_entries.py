"""The contents of a link's messages, on the way out and on the way in: batches of samples, and removals of frames."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

from tfbus.errors import InvalidTransformError
from tfbus.geometry.stamped import TransformStamped
from tfbus.links._provenance import ReceivedTransform


class OutgoingBatch:
    """Samples of one batch and one origin, as they go out.

    Attributes
    ----------
    origin : bytes
        The bus on which the batch was published first, 16 bytes.
    sequence : int
        The batch's number on that bus.
    samples : sequence of TransformStamped
    """

    __slots__ = ("origin", "samples", "sequence")

    def __init__(self, origin: bytes, sequence: int, samples: Sequence[TransformStamped]) -> None:
        self.origin = origin
        self.sequence = sequence
        self.samples = samples


class ReceivedBatch:
    """Samples of one batch, as they came in.

    Attributes
    ----------
    samples : list of ReceivedTransform
        Their provenance is not set yet.
    authorities : collection of str
        The authorities that the batch names; a peer may name only so many.
    origin : bytes or None
        The bus on which the batch was published first, 16 bytes; None if the sender knows no buses, as ROS.
    sequence : int
        The batch's number on that bus; without an origin it is not used.
    """

    __slots__ = ("authorities", "origin", "samples", "sequence")

    def __init__(
        self,
        samples: list[ReceivedTransform],
        authorities: Collection[str],
        origin: bytes | None = None,
        sequence: int = 0,
    ) -> None:
        self.samples = samples
        self.authorities = authorities
        self.origin = origin
        self.sequence = sequence


@dataclass(frozen=True, slots=True)
class RemovedFrame:
    """A tombstone: a frame was removed, by the batch number `sequence` of the bus `origin`.

    With `lost`, the sender has lost the peer that brought the frame, so only what the sender itself brought is removed.
    """

    origin: bytes
    sequence: int
    frame: str
    lost: bool = False


@dataclass(slots=True)
class Turn:
    """All that one turn of the event loop has published and removed.

    Attributes
    ----------
    entries : list of OutgoingBatch or RemovedFrame
        In the order in which it happened.
    statics : dict of str to OutgoingBatch, RemovedFrame or None
        The static frames whose state for late joiners has changed: the newest sample of each as a batch of its own, its
        tombstone, or None if the frame is not to be kept any more.
    """

    entries: list[OutgoingBatch | RemovedFrame]
    statics: dict[str, OutgoingBatch | RemovedFrame | None]


@dataclass(slots=True)
class ReceivedMessage:
    """One message of a peer, decoded.

    Attributes
    ----------
    entries : list of ReceivedBatch or RemovedFrame
        In the order in which it happened.
    number : int
        The sender numbers its live messages 1, 2, 3, so that gaps are noticed; 0 for a message without a number: one
        that was kept for late joiners, or one of a sender that does not number.
    errors : list of InvalidTransformError
        One for each sample that was refused; `entries` has the others.
    """

    entries: list[ReceivedBatch | RemovedFrame]
    number: int = 0
    errors: list[InvalidTransformError] = field(default_factory=list)

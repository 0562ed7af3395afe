"""The entries of the messages between links: batches, and what is said of frames without a sample."""

from collections.abc import Sequence
from dataclasses import dataclass

from tfbus.geometry.stamped import TransformStamped


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


@dataclass(frozen=True, slots=True)
class RemovedFrame:
    """A tombstone: a frame was removed, by the batch number `sequence` of the bus `origin`.

    With `lost`, the frame was not removed, but the sender does not bring it any more: it has lost the peer that brought
    the frame, or another link has taken the frame over. So only what the sender itself brought is removed.
    """

    origin: bytes
    sequence: int
    frame: str
    lost: bool = False


@dataclass(frozen=True, slots=True)
class MovingFrame:
    """A link brings a moving frame, whose samples come by themselves."""

    frame: str

"""The bounds of every size that a file claims or unfolds to.

A few bytes can claim, or unfold to, more than any machine holds. What exceeds a bound is not read, and its place is
reported. `tfbus.recording.open_recording` tells these numbers to users.
"""

from typing import Final

MIB: Final = 2**20

MAX_CHUNK: Final = 256 * MIB
"""The size in bytes of a chunk of an MCAP file or a bag, compressed or not."""
MAX_CHUNK_MESSAGES: Final = 1_000_000
"""The number of messages in a chunk that are read at once."""
MESSAGE_SIZE: Final = 256
"""The size in bytes of a message in memory, beside its payload, roughly."""
MAX_MESSAGE: Final = 8 * MIB
"""The size in bytes of a message with transforms; about 80,000 transforms."""
MAX_OTHER_MESSAGE: Final = 256 * MIB
"""The size in bytes of any other message."""
MAX_INDEX: Final = 64 * MIB
"""The size in bytes of the index of a file; a file with a larger one is read from its beginning."""
MAX_DESCRIBED: Final = 64 * MIB
"""The size in bytes of all descriptions of channels and types of a file, each with `DESCRIPTION` bytes more."""
DESCRIPTION: Final = 1_024
MAX_PACKED: Final = 64 * MIB
"""The size in bytes of chunks that overlap and are decoded at once; others are decoded message by message."""
MAX_OVERLAPPING: Final = 512 * MIB
"""The size in bytes of the messages of chunks that overlap in time, which are sorted in memory."""
MAX_METADATA: Final = 4 * MIB
"""The size in bytes of ``metadata.yaml``."""
MAX_FACTOR: Final = 100
MIN_UNPACKED: Final = 64 * MIB


class DescriptionBudget:
    """Counts what a file describes and a reader keeps; chunks unfold, so a small file could describe any number."""

    def __init__(self) -> None:
        self._left = MAX_DESCRIBED

    def take(self, *texts: bytes | str) -> None:
        """Count a description; raises `ValueError` if all together exceed `MAX_DESCRIBED`."""
        self._left -= DESCRIPTION + sum(map(len, texts))
        if self._left < 0:
            raise ValueError(f"the descriptions of channels take more than {MAX_DESCRIBED:,} bytes, which is the bound")


def max_unpacked(packed: int) -> int:
    """The size in bytes that a compressed file of a folder may unfold to: 100 times its own, or 64 MiB if more."""
    return max(MIN_UNPACKED, MAX_FACTOR * packed)

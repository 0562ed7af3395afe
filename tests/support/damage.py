"""Messages with damage that decoders do not like."""

from collections.abc import Sequence
from random import Random


def damaged(random: Random, message: bytes, pieces: Sequence[bytes]) -> bytes:
    """A message with some bytes changed, cut, doubled, or replaced by some pieces."""
    for _ in range(random.randint(1, 4)):
        at, end = sorted(random.choices(range(len(message) + 1), k=2))
        message = random.choice(
            [
                message[:at] + random.choice(pieces) + message[at:],
                message[:at] + random.choice(pieces) * random.randint(1, 300) + message[end:],
                message[:at] + random.randbytes(random.randint(1, 8)) + message[at + 1 :],
                message[:at],
                message[:at] + message[at:end] * 2 + message[end:],
            ]
        )
    return message

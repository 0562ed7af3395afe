"""`record_places`, which finds the records in the chunks of an MCAP file.

Only the length of a record tells where the next one begins. But most recordings repeat the same few lengths, so many
places are guessed at once: if the first guess is right, and each record there is as long as guessed, all are right.
"""

import struct
from itertools import pairwise
from typing import Final

import numpy as np
import numpy.typing as npt

_HEAD: Final = 9
"""Bytes: the opcode and the length of what follows."""
_LENGTH: Final = struct.Struct("<Q")
_FIRST_STEPS: Final = 16
"""So many records are read one by one, to find what repeats; more, if a guess was of little use."""
_GUESSED: Final = 2**16
"""So many places are guessed at once, roughly."""


def record_places(data: bytes) -> npt.NDArray[np.int64]:
    """The beginnings of all records of whole chunks, and the end of the last one.

    Raises
    ------
    struct.error, ValueError
        If the last record is cut off.
    """
    length = len(data)
    found: list[npt.NDArray[np.int64]] = []
    at, steps = 0, _FIRST_STEPS
    while at < length:
        places: list[int] = []
        while at < length and len(places) < steps:
            places.append(at)
            at += _HEAD + _LENGTH.unpack_from(data, at + 1)[0]
        found.append(np.array(places, np.int64))
        if at < length and (cycle := _cycle([after - before for before, after in pairwise([*places, at])])):
            guessed = _follow(data, at, cycle)
            if len(guessed) > 1:
                found.append(guessed[:-1])
                at = int(guessed[-1])
            steps = steps * 2 if len(guessed) <= steps else _FIRST_STEPS
        else:
            steps *= 2
    if at != length:
        raise ValueError("a record goes on behind the end of the chunks")
    return np.concatenate([*found, np.array([at], np.int64)])


def _cycle(lengths: list[int]) -> list[int] | None:
    """The shortest cycle that the lengths have gone through at least twice."""
    for period in range(1, len(lengths) // 2 + 1):
        if lengths[period:] == lengths[:-period]:
            # In phase: what comes next is what came one period before.
            return lengths[-period:]
    return None


def _follow(data: bytes, at: int, cycle: list[int]) -> npt.NDArray[np.int64]:
    """The places of successive records from `at` on, as long as their lengths go through a cycle, and the end."""
    last = len(data) - _HEAD
    count = min((last - at) // sum(cycle) + 1, _GUESSED // len(cycle) + 1)
    lengths = np.tile(np.array(cycle, np.int64), max(count, 0))
    places = at + np.cumsum(lengths) - lengths
    places = places[: np.searchsorted(places, last, side="right")]
    lengths = lengths[: len(places)]
    announced = np.ndarray((max(last, 0) + 1,), "<u8", data, offset=1, strides=(1,))[places]
    wrong = np.flatnonzero(announced != (lengths - _HEAD).astype(np.uint64))
    right = int(wrong[0]) if len(wrong) else len(places)
    return np.append(places[:right], at if not right else places[right - 1] + lengths[right - 1])

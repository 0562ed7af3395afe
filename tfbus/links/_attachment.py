"""The attachment of a message between links: the origin, number and authority of its samples, removals, and a claim.

ROS's TFMessage has no fields for these. A message holds the samples of several batches one after the other; its
attachment says how many samples belong to which batch, in the order in which batches and removals happened. Little
endian::

    version u8, claim u8, origins u8, times u8, authorities u16, entries u32, number u64
    since u64, state u64, digest u64, message u64: a `StateStep`; claim is 0 without one, 1, or 2 for the final step
    times        0 or 1: i64, the time of the sender's clock in ns
    origins      16 bytes each
    authorities  length u16, UTF-8
    entries      kind u8, origin u8, runs u16, sequence u64, and then
        batch    runs times: authority u16, static u16, samples u32
        removal  the length of the name in place of runs, UTF-8
        loss     as a removal
        moving   as a removal, of an origin that does not matter: the name of a moving frame

Reading one costs time in proportion to its bytes; handling an entry may cost more, so both have a limit.
"""

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, repeat

from tfbus.links._entries import MovingFrame, RemovedFrame
from tfbus.links._state import StateStep
from tfbus.tf_message import MAX_NAME, MalformedMessageError

VERSION = 2
ORIGIN_BYTES = 16
MAX_BYTES = 2**20
MAX_ENTRIES = 10_000

_HEADER = struct.Struct("<BBBBHIQQQQQ")
_ENTRY = struct.Struct("<BBHQ")
_RUN = struct.Struct("<HHI")
_LENGTH = struct.Struct("<H")
_TIME = struct.Struct("<q")
_BATCH, _REMOVAL, _LOSS, _MOVING = 0, 1, 2, 3
_NO_STEP, _STEP, _FINAL_STEP = 0, 1, 2
_NO_ORIGIN = bytes(ORIGIN_BYTES)


@dataclass(frozen=True, slots=True)
class PublishedBatch:
    """The attachment's entry for a batch.

    Attributes
    ----------
    origin : bytes
        The bus on which the batch was published first, 16 bytes.
    sequence : int
        The batch's number on that bus.
    runs : tuple of (str, bool, int)
        Authority, static flag and number of consecutive samples that share both, in the order of the message.
    """

    origin: bytes
    sequence: int
    runs: tuple[tuple[str, bool, int], ...]

    @property
    def count(self) -> int:
        """The number of its samples."""
        return sum(count for _, _, count in self.runs)


Entry = PublishedBatch | RemovedFrame | MovingFrame


@dataclass(frozen=True, slots=True)
class Attachment:
    """An attachment, unpacked; the sender numbers its live messages 1, 2, 3, and all others 0."""

    number: int
    entries: tuple[Entry, ...]
    step: StateStep | None = None
    time: int | None = None

    def tags(self) -> Iterator[tuple[str, bool]]:
        """Authority and static flag of each sample of the message."""
        batches = (entry for entry in self.entries if isinstance(entry, PublishedBatch))
        runs = chain.from_iterable(batch.runs for batch in batches)
        return chain.from_iterable(repeat((authority, static), count) for authority, static, count in runs)


def pack(number: int, entries: Sequence[Entry], step: StateStep | None = None, time: int | None = None) -> bytes:
    """The bytes of an attachment.

    Raises
    ------
    ValueError
        If there are more than 255 origins, `MAX_ENTRIES` entries, 65,535 authorities or runs of one batch; if an
        authority has more than 65,535 bytes, a removed frame's name more than `MAX_NAME`, or all together more than
        `MAX_BYTES`; or if a name cannot be written in UTF-8.
    """
    if len(entries) > MAX_ENTRIES:
        raise ValueError(f"too much for one attachment: {len(entries)} entries, more than {MAX_ENTRIES}")
    origins: dict[bytes, int] = {}
    authorities: dict[str, int] = {}
    body = bytearray()
    for entry in entries:
        if isinstance(entry, MovingFrame):
            origin = origins.setdefault(_NO_ORIGIN, len(origins))
            name = _name(entry.frame)
            body += _pack(_ENTRY, _MOVING, origin, len(name), 0) + name
            continue
        origin = origins.setdefault(entry.origin, len(origins))
        if isinstance(entry, RemovedFrame):
            name = _name(entry.frame)
            kind = _LOSS if entry.lost else _REMOVAL
            body += _pack(_ENTRY, kind, origin, len(name), entry.sequence) + name
        else:
            body += _pack(_ENTRY, _BATCH, origin, len(entry.runs), entry.sequence)
            for authority, static, count in entry.runs:
                body += _pack(_RUN, authorities.setdefault(authority, len(authorities)), static, count)
    claim, claimed = _NO_STEP, (0, 0, 0, 0)
    if step is not None:
        claim = _FINAL_STEP if step.final else _STEP
        claimed = step.since, step.number, step.digest, step.message
    counts = len(origins), time is not None, len(authorities), len(entries)
    head = bytearray(_pack(_HEADER, VERSION, claim, *counts, number, *claimed))
    if time is not None:
        head += _pack(_TIME, time)
    for origin_bytes in origins:
        head += origin_bytes
    for authority in authorities:
        text = authority.encode()
        head += _pack(_LENGTH, len(text)) + text
    if len(head) + len(body) > MAX_BYTES:
        raise ValueError(f"too much for one attachment: {len(head) + len(body)} bytes, more than {MAX_BYTES}")
    return bytes(head + body)


def unpack(data: bytes) -> Attachment:
    """The attachment in some bytes.

    Raises
    ------
    MalformedMessageError
        If the bytes are not an attachment of this version.
    """
    if not data or data[0] != VERSION:
        found = f"version {data[0]}" if data else "nothing"
        raise MalformedMessageError("version", f"the attachment has {found}, expected version {VERSION}")
    if len(data) > MAX_BYTES:
        raise MalformedMessageError("oversized", f"the attachment has {len(data)} bytes, more than {MAX_BYTES}")
    try:
        return _unpack(data)
    except (struct.error, IndexError):
        detail = f"the attachment of {len(data)} bytes is cut off or inconsistent"
        raise MalformedMessageError("attachment", detail) from None
    except UnicodeDecodeError:
        raise MalformedMessageError("attachment", "a name in the attachment is no UTF-8") from None


def _unpack(data: bytes) -> Attachment:
    _, claim, origin_count, time_count, authority_count, entry_count, number, *claimed = _HEADER.unpack_from(data)
    if entry_count > MAX_ENTRIES:
        raise MalformedMessageError("oversized", f"the attachment has {entry_count} entries, more than {MAX_ENTRIES}")
    at = _HEADER.size
    time = None
    if time_count:
        if time_count > 1:
            raise IndexError
        (time,) = _TIME.unpack_from(data, at)
        at += _TIME.size
    at += ORIGIN_BYTES * origin_count
    origins = [data[at - ORIGIN_BYTES * (k + 1) : at - ORIGIN_BYTES * k] for k in reversed(range(origin_count))]
    authorities = []
    for _ in range(authority_count):
        (length,) = _LENGTH.unpack_from(data, at)
        at += _LENGTH.size
        authorities.append(data[at : at + length].decode())
        at += length
    entries: list[Entry] = []
    # Each entry takes some bytes, so a false count ends the loop with an error before the list grows long.
    for _ in range(entry_count):
        kind, origin, size, sequence = _ENTRY.unpack_from(data, at)
        at += _ENTRY.size
        if kind in (_REMOVAL, _LOSS, _MOVING) and size <= MAX_NAME:
            frame = data[at : at + size].decode()
            if kind == _MOVING:
                entries.append(MovingFrame(frame))
            else:
                entries.append(RemovedFrame(origins[origin], sequence, frame, kind == _LOSS))
            at += size
        elif kind == _BATCH:
            runs = _RUN.iter_unpack(data[at : at + _RUN.size * size])
            at += _RUN.size * size
            named = tuple((authorities[authority], bool(static), count) for authority, static, count in runs)
            entries.append(PublishedBatch(origins[origin], sequence, named))
        else:
            raise IndexError
    # Slicing past the end raises nothing, so the end is checked.
    if at != len(data):
        raise IndexError
    return Attachment(number, tuple(entries), _step(claim, *claimed), time)


def _step(claim: int, since: int, state: int, digest: int, message: int) -> StateStep | None:
    if claim > _FINAL_STEP or since > state:
        raise IndexError
    return None if claim == _NO_STEP else StateStep(since, state, digest, claim == _FINAL_STEP, message)


def _name(frame: str) -> bytes:
    name = frame.encode()
    if len(name) > MAX_NAME:
        raise ValueError(f"too much for one attachment: a frame name of {len(name)} bytes")
    return name


def _pack(layout: struct.Struct, *values: object) -> bytes:
    try:
        return layout.pack(*values)
    except struct.error as error:
        raise ValueError(f"too much for one attachment: {error}") from None

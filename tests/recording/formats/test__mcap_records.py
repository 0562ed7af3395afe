import struct
from io import BytesIO

import pytest
from mcap.records import McapRecord

from tfbus.recording.formats import _mcap_records
from tfbus.recording.formats._mcap_records import Chunk, read_records, split_chunk, split_message
from tfbus.recording.formats._storage import Channel
from tfbus.recording.formats._unfold import UnfoldError

TF = Channel("/tf", "", "cdr")


def message(number: int, received: int, payload: bytes) -> bytes:
    content = struct.pack("<HIQQ", number, 0, received, 0) + payload
    return struct.pack("<BQ", 5, len(content)) + content


def split(data: bytes, torn: bool = False) -> tuple[list[tuple[int, object, bytes]], dict[int, int]]:
    registered: list[McapRecord] = []
    found, counts = split_chunk(data, {3: TF}.get, registered.append, torn)
    assert registered == []
    return list(found), counts


def test_messages_of_wanted_channels_are_found_and_all_are_counted() -> None:
    data = message(3, 10, b"x") + message(4, 11, b"y") + message(3, 12, b"")
    assert split(data) == ([(10, TF, b"x"), (12, TF, b"")], {3: 2, 4: 1})


def test_a_record_that_goes_on_behind_the_end_is_damage_unless_the_chunk_is_torn() -> None:
    data = message(3, 10, b"x") + message(3, 11, b"y")
    for size in range(len(data) // 2 + 1, len(data)):
        with pytest.raises((ValueError, struct.error)):
            split(data[:size])
        assert split(data[:size], torn=True) == ([(10, TF, b"x")], {3: 1})


def test_a_message_without_its_header_is_damage() -> None:
    with pytest.raises(ValueError, match="too short"):
        split(struct.pack("<BQ", 5, 3) + b"abc" + bytes(30))
    assert split_message(message(3, 10, b"x")[9:]) == (10, 3, b"x")


def test_kinds_of_records_from_128_on_are_private_and_others_that_are_unknown_are_told() -> None:
    kinds = (127, 128, 255)
    data = b"".join(struct.pack("<BQ", kind, 1) + b"x" for kind in kinds) + struct.pack("<BQ", 2, 0)
    assert list(read_records(BytesIO(data), len(data))) == [(0, 127, None)]


def chunk(data: bytes, size: int, crc: int = 0, compression: bytes = b"") -> bytes:
    head = struct.pack("<QQQII", 1, 2, size, crc, len(compression)) + compression
    return head + struct.pack("<Q", len(data)) + data


def test_a_chunk_has_the_size_and_the_checksum_that_it_claims() -> None:
    assert Chunk.parse(chunk(b"abc", 3)).unfold() == b"abc"
    for wrong, why in (
        (chunk(b"abc", 4), "claims 4 bytes, and holds 3"),
        (chunk(b"abc", 2), "more than 2 bytes"),
        (chunk(b"abc", 3, crc=1), "checksum"),
        (chunk(b"abc", 2**40), "is the bound"),
        (chunk(b"abc", 3, compression=b"rar"), "'rar' is unknown"),
    ):
        with pytest.raises(UnfoldError, match=why):
            Chunk.parse(wrong).unfold()
    with pytest.raises(ValueError, match="3 bytes are announced, and there are 2"):
        Chunk.parse(chunk(b"abc", 3)[:-1])
    assert Chunk.parse(chunk(b"abc", 3)[:-1], torn=True).unfold(torn=True) == b"ab"
    with pytest.raises(ValueError, match="name of the compression"):
        Chunk.parse(chunk(b"", 0, compression=b"x" * 33))


def test_a_chunk_of_the_largest_size_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_mcap_records, "MAX_CHUNK", 3)
    assert Chunk.parse(chunk(b"abc", 3)).unfold() == b"abc"
    with pytest.raises(UnfoldError, match="it claims 4 bytes, and 3 is the bound"):
        Chunk.parse(chunk(b"abcd", 4)).unfold()

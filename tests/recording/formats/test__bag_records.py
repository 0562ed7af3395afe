import io
import struct

import pytest

from tfbus.recording.formats._bag_records import (
    CHUNK,
    DAMAGE,
    CutOffError,
    counts_in,
    find_chunk,
    index_entries,
    kind_of,
    number_in,
    parse_fields,
    read_record,
    split_chunk,
    time_in,
)


def field(name: bytes, value: bytes) -> bytes:
    return struct.pack("<I", len(name) + 1 + len(value)) + name + b"=" + value


def record(header: bytes, data: bytes = b"") -> bytes:
    return struct.pack("<I", len(header)) + header + struct.pack("<I", len(data)) + data


def message(connection: int, seconds: int, data: bytes, order: str = "cot") -> bytes:
    fields = {
        "c": field(b"conn", struct.pack("<I", connection)),
        "o": field(b"op", b"\2"),
        "t": field(b"time", struct.pack("<II", seconds, 5)),
    }
    return record(b"".join(fields[letter] for letter in order), data)


CHUNK_RECORD = record(
    field(b"compression", b"none") + field(b"op", b"\5") + field(b"size", struct.pack("<I", 3)), b"abc"
)


def test_messages_are_split_whatever_the_order_of_the_fields() -> None:
    data = message(1, 2, b"x") + message(7, 3, b"yy", "toc") + message(1, 4, b"", "toc") + message(1, 5, b"z")
    content = split_chunk(data)
    assert content.messages == [
        (2_000_000_005, 1, b"x"),
        (3_000_000_005, 7, b"yy"),
        (4_000_000_005, 1, b""),
        (5_000_000_005, 1, b"z"),
    ]
    assert content.damage == ""


def test_what_comes_before_damage_is_kept() -> None:
    data = message(1, 2, b"x") + message(1, 3, b"yy")
    assert split_chunk(data[:-1])[2] == "it ends inside of a record"
    assert len(split_chunk(data[:-1]).messages) == 1
    unknown = message(1, 2, b"x") + record(field(b"op", b"\x63"))
    assert split_chunk(unknown).damage == "a record of kind 99 is unknown"


def test_a_chunk_is_found_by_its_bytes() -> None:
    noise = b"\x04\0\0\0op=\x05" + bytes(range(256)) * 10
    file = io.BytesIO(noise + CHUNK_RECORD + b"more")
    assert find_chunk(file, 0) == len(noise)
    found = read_record(file, len(noise))
    assert (found.kind, found.read(file), found.end) == (CHUNK, b"abc", len(noise) + len(CHUNK_RECORD))
    assert find_chunk(file, len(noise) + 1) is None
    # Also across the blocks that are read at once.
    for size in (2**20 - 30, 2**20 - 5, 2**20 + 3):
        assert find_chunk(io.BytesIO(bytes(size) + CHUNK_RECORD), 0) == size
    # Its mark begins in one block and ends in the next, and its header began 89 bytes before them.
    fields = field(b"compression", b"none") + field(b"size", bytes(4)) + field(b"note", bytes(38)) + field(b"op", b"\5")
    assert find_chunk(io.BytesIO(bytes(2**20 - 89) + record(fields)), 0) == 2**20 - 89


def test_a_record_of_another_kind_with_the_mark_of_a_chunk_in_a_field_is_no_chunk() -> None:
    mark = b"\x04\0\0\0op=\x05"
    other = record(field(b"op", b"\2") + field(b"size", bytes(4)) + field(b"note", mark))
    assert read_record(io.BytesIO(other), 0).kind == 2
    assert find_chunk(io.BytesIO(other), 0) is None
    # The mark is in the data of the chunk behind it, or before it begins.
    chunk = record(field(b"size", bytes(4)) + field(b"op", b"\5"), mark)
    assert find_chunk(io.BytesIO(mark + chunk), 0) == len(mark)
    assert find_chunk(io.BytesIO(chunk), 1) is None


def test_a_record_that_claims_more_than_its_bound_is_not_read() -> None:
    file = io.BytesIO(CHUNK_RECORD)
    found = read_record(file, 0)
    assert found.read(file, 3) == b"abc"
    with pytest.raises(ValueError, match="claims 3 bytes, and 2 is the bound"):
        found.read(file, 2)


def test_damage_is_an_error() -> None:
    with pytest.raises(CutOffError):
        read_record(io.BytesIO(CHUNK_RECORD[:10]), 0)
    with pytest.raises(ValueError, match="claims 4,294,967,295 bytes"):
        read_record(io.BytesIO(b"\xff" * 20), 0)
    for call in (
        lambda: parse_fields(b"\5\0\0\0abcde"),
        lambda: parse_fields(b"\xff\0\0\0a=b"),
        lambda: kind_of({b"op": b"\x09"}),
        lambda: kind_of({}),
        lambda: number_in({b"conn": b"\1"}, b"conn"),
        lambda: time_in(b"1234567"),
    ):
        with pytest.raises(DAMAGE):
            call()


def test_the_counts_of_an_index_are_read_as_far_as_they_go() -> None:
    assert counts_in(struct.pack("<IIII", 3, 10, 4, 20) + b"rest") == {3: 10, 4: 20}
    assert list(index_entries(struct.pack("<IIIIII", 1, 2, 0, 3, 4, 0) + b"rest")) == [1_000_000_002, 3_000_000_004]

import io
import struct
from itertools import permutations

import pytest
from support.bag_bytes import chunk, field, message, record

from tfbus.recording.formats import ros1
from tfbus.recording.formats.ros1 import (
    CHUNK,
    DAMAGE,
    CutOffError,
    counts_in,
    find_chunk,
    index_span,
    kind_of,
    number_in,
    parse_fields,
    read_chunk,
    read_record,
    split_chunk,
    time_in,
)

CHUNK_RECORD = chunk(b"abc")


def test_messages_are_split_whatever_the_order_of_the_fields() -> None:
    data = message(1, 2, b"x") + message(7, 3, b"yy", "toc") + message(1, 4, b"", "toc") + message(1, 5, b"z")
    content = split_chunk(data)
    assert content.messages == [
        (2_000_000_005, 1, b"x"),
        (3_000_000_005, 7, b"yy"),
        (4_000_000_005, 1, b""),
        (5_000_000_005, 1, b"z"),
    ]
    assert (content.connections, content.damage) == ([], "")


def test_connections_are_split_from_the_messages_and_other_records_are_passed_over() -> None:
    described = field(b"conn", bytes(4)) + field(b"op", b"\7")
    content = split_chunk(record(described, b"type=a") + record(field(b"op", b"\4"), b"index") + message(0, 2, b"x"))
    assert content == ([(2_000_000_005, 0, b"x")], [({b"conn": bytes(4), b"op": b"\7"}, b"type=a")], "")


@pytest.mark.parametrize("order", ["".join(order) for order in permutations("cot")])
def test_a_damaged_header_is_read_behind_a_good_one_of_its_length_as_it_is_alone(order: str) -> None:
    first, second = message(1, 2, b"x", order), message(7, 3, b"y", order)
    (before,) = split_chunk(first).messages
    (header,) = struct.unpack_from("<I", second)
    for place in range(4, 4 + header):
        for bit in range(8):
            damaged = bytearray(second)
            damaged[place] ^= 1 << bit
            alone, behind = split_chunk(bytes(damaged)), split_chunk(first + damaged)
            assert (behind.messages, behind.damage) == ([before, *alone.messages], alone.damage)


def test_a_chunk_holds_messages_up_to_a_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ros1, "MAX_CHUNK_MESSAGES", 2)
    data = message(1, 2, b"x") + message(1, 3, b"y")
    assert (len(split_chunk(data).messages), split_chunk(data).damage) == (2, "")
    for order in ("cot", "toc"):
        damage = "it has more than 2 messages, which is the bound"
        assert split_chunk(data + message(1, 4, b"z", order)).damage == damage


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
    # What looks like one in the block before, and where the file stands, do not matter.
    file = io.BytesIO(noise + bytes(2**20) + CHUNK_RECORD)
    file.seek(2**20)
    assert find_chunk(file, 0) == len(noise) + 2**20
    # Its mark begins in one block and ends in the next, and its header began 89 bytes before them.
    fields = field(b"compression", b"none") + field(b"size", bytes(4)) + field(b"note", bytes(38)) + field(b"op", b"\5")
    assert find_chunk(io.BytesIO(bytes(2**20 - 89) + record(fields)), 0) == 2**20 - 89


def test_a_record_of_another_kind_with_the_mark_of_a_chunk_in_a_field_is_no_chunk() -> None:
    mark = b"\x04\0\0\0op=\x05"
    other = record(field(b"op", b"\2") + field(b"size", bytes(4)) + field(b"note", mark))
    assert read_record(io.BytesIO(other), 0).kind == 2
    assert find_chunk(io.BytesIO(other), 0) is None
    # A chunk has the field "size".
    assert find_chunk(io.BytesIO(record(field(b"op", b"\5"), b"abc")), 0) is None
    # The mark is in the data of the chunk behind it, or before it begins.
    real = record(field(b"size", bytes(4)) + field(b"op", b"\5"), mark)
    assert find_chunk(io.BytesIO(mark + real), 0) == len(mark)
    assert find_chunk(io.BytesIO(real), 1) is None
    # It is at the very begin of the data of one that has none itself.
    assert find_chunk(io.BytesIO(record(field(b"size", bytes(4)) + field(b"op", b"\5\0"), mark)), 0) is None


def test_a_record_that_claims_more_than_its_bound_is_not_read() -> None:
    file = io.BytesIO(CHUNK_RECORD)
    found = read_record(file, 0)
    assert found.read(file, 3) == b"abc"
    with pytest.raises(ValueError, match="claims 3 bytes, and 2 is the bound"):
        found.read(file, 2)
    file = io.BytesIO(CHUNK_RECORD + bytes(4))
    # Where the file stands does not matter.
    file.seek(5)
    assert found.read(file) == b"abc"


@pytest.mark.parametrize(("bound", "fits"), [(0, True), (-1, False)])
def test_a_header_is_read_up_to_its_bound(monkeypatch: pytest.MonkeyPatch, bound: int, fits: bool) -> None:
    (length,) = struct.unpack_from("<I", CHUNK_RECORD)
    monkeypatch.setattr(ros1, "_MAX_HEADER", length + bound)
    if fits:
        assert read_record(io.BytesIO(CHUNK_RECORD), 0).kind == CHUNK
    else:
        with pytest.raises(ValueError, match=f"a header claims {length} bytes"):
            read_record(io.BytesIO(CHUNK_RECORD), 0)


def test_a_chunk_is_unfolded_up_to_its_bound_and_has_the_size_that_it_claims(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ros1, "MAX_CHUNK", 3)

    def content(size: int, data: bytes, torn: bool = False) -> bytes:
        file = io.BytesIO(chunk(data, size))
        return read_chunk(file, read_record(file, 0), torn)

    assert content(3, b"abc") == b"abc"
    assert content(3, b"ab", torn=True) == content(0, b"ab", torn=True) == b"ab"
    for size, data, torn, why in (
        (4, b"abc", False, "it claims 4 bytes, and 3 is the bound"),
        (3, b"abcd", False, "a record claims 4 bytes, and 3 is the bound"),
        (2, b"abc", False, "more than 2 bytes"),
        (2, b"abc", True, "more than 2 bytes"),
        (3, b"ab", False, "it claims 3 bytes, and holds 2"),
    ):
        with pytest.raises(ValueError, match=why):
            content(size, data, torn)


def test_damage_is_an_error() -> None:
    with pytest.raises(CutOffError):
        read_record(io.BytesIO(CHUNK_RECORD[:10]), 0)
    with pytest.raises(ValueError, match="claims 4,294,967,295 bytes"):
        read_record(io.BytesIO(b"\xff" * 20), 0)
    for call in (
        lambda: parse_fields(b"\5\0\0\0abcde"),
        lambda: parse_fields(b"\xff\0\0\0a=b"),
        lambda: kind_of({b"op": b"\1"}),
        lambda: kind_of({b"op": b"\x08"}),
        lambda: kind_of({b"op": b""}),
        lambda: kind_of({}),
        lambda: number_in({b"conn": bytes(3)}, b"conn"),
        lambda: number_in({b"conn": bytes(5)}, b"conn"),
        lambda: time_in(b"1234567"),
    ):
        with pytest.raises(DAMAGE):
            call()


def test_the_counts_of_an_index_are_read_as_far_as_they_go() -> None:
    for rest in range(8):
        assert counts_in(struct.pack("<6I", 3, 10, 4, 20, 5, 30) + bytes(rest)) == {3: 10, 4: 20, 5: 30}
    for rest in range(12):
        entries = struct.pack("<6I", 1, 2, 0, 3, 4, 0) + bytes(rest)
        assert index_span(entries) == (1_000_000_002, 3_000_000_004, 2)

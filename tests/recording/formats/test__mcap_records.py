import struct
import zlib
from io import BytesIO

import numpy as np
import pytest
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import ChunkIndex, McapRecord

from tfbus.recording.formats import mcap_records
from tfbus.recording.formats.mcap_records import (
    DAMAGE,
    Chunk,
    parse_record,
    read_records,
    scan_chunks,
    split_chunk,
    split_message,
)
from tfbus.recording.formats.storage import Channel, UnfoldError

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


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def test_records_are_read_up_to_their_bounds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mcap_records, "_BOUND", {Opcode.CHUNK: 5, Opcode.MESSAGE: 4})
    monkeypatch.setattr(mcap_records, "MAX_INDEX", 3)
    for opcode, bound in ((Opcode.CHUNK, 5), (Opcode.MESSAGE, 4), (Opcode.SCHEMA, 3), (Opcode.STATISTICS, 3)):
        within, beyond = bytes(bound), bytes(bound + 1)
        data = record(opcode, within) + record(opcode, beyond) + record(opcode, b"") + record(Opcode.FOOTER, b"")
        second = 9 + bound
        assert list(read_records(BytesIO(data), len(data))) == [
            (0, opcode, within),
            (second, opcode, None),
            (second + 10 + bound, opcode, b""),
        ]


def test_the_part_of_a_record_that_there_is_comes_with_the_end_of_the_file(monkeypatch: pytest.MonkeyPatch) -> None:
    data = record(Opcode.MESSAGE, b"abc")
    for size, torn in ((12, None), (11, (Opcode.MESSAGE, b"ab")), (9, (Opcode.MESSAGE, b"")), (8, None), (0, None)):
        found = read_records(BytesIO(data[:size]), size)
        if size == 12:
            assert next(found) == (0, Opcode.MESSAGE, b"abc")
        with pytest.raises(EndOfFile) as raised:
            next(found)
        end = () if torn is None else (torn,)
        assert raised.value.args == end
        # What a writer has put behind it meanwhile is not read.
        if size < 12:
            found = read_records(BytesIO(data + data + bytes(5)), 12 + size)
            assert next(found) == (0, Opcode.MESSAGE, b"abc")
            with pytest.raises(EndOfFile) as raised:
                next(found)
            assert raised.value.args == end
    # Of a huge one, no more than of a chunk.
    monkeypatch.setattr(mcap_records, "MAX_CHUNK", 2)
    with pytest.raises(EndOfFile) as raised:
        next(read_records(BytesIO(record(Opcode.MESSAGE, bytes(9))[:-1]), 17))
    assert raised.value.args == ((Opcode.MESSAGE, bytes(2)),)


def test_an_entry_of_the_index_is_parsed_as_by_the_official_reader() -> None:
    offsets = struct.pack("<HQHQ", 3, 100, 7, 200)
    content = struct.pack("<QQQQI", 1, 2, 3, 4, len(offsets)) + offsets
    content += struct.pack("<QI", 5, 4) + b"zstd" + struct.pack("<QQ", 6, 7)
    found = parse_record(Opcode.CHUNK_INDEX, content)
    assert found == ChunkIndex.read(ReadDataStream(BytesIO(content)))
    assert found == ChunkIndex(
        message_start_time=1,
        message_end_time=2,
        chunk_start_offset=3,
        chunk_length=4,
        message_index_offsets={3: 100, 7: 200},
        message_index_length=5,
        compression="zstd",
        compressed_size=6,
        uncompressed_size=7,
    )
    for size in range(len(content)):
        with pytest.raises(DAMAGE):
            parse_record(Opcode.CHUNK_INDEX, content[:size])
    assert parse_record(Opcode.METADATA, b"") is None


def test_a_channel_is_asked_for_again_behind_a_record_that_may_describe_it() -> None:
    described = struct.pack("<HHI", 3, 0, 3) + b"/tf" + struct.pack("<II", 0, 0)
    channels: dict[int, Channel] = {}

    def register(found: McapRecord) -> None:
        assert (getattr(found, "id", None), getattr(found, "topic", None)) == (3, "/tf")
        channels[3] = TF

    data = message(3, 10, b"x") + record(Opcode.CHANNEL, described) + message(3, 11, b"y")
    assert split_chunk(data, channels.get, register) == ([(11, TF, b"y")], {3: 2})


def test_a_chunk_holds_wanted_messages_up_to_a_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mcap_records, "MAX_CHUNK_MESSAGES", 2)
    data = message(3, 10, b"x") + message(4, 11, b"y") + message(3, 12, b"z")
    assert split(data) == ([(10, TF, b"x"), (12, TF, b"z")], {3: 2, 4: 1})
    with pytest.raises(ValueError, match="it has more than 2 messages, which is the bound"):
        split(data + message(3, 13, b""))


def test_chunks_are_scanned_as_they_are_split() -> None:
    described = struct.pack("<HHI", 3, 0, 3) + b"/tf" + struct.pack("<II", 0, 0)
    parts = [
        message(3, 10, b"x"),
        record(Opcode.CHANNEL, described),
        message(2**16 - 1, 2**64 - 1, b""),
        message(4, 0, b"yy"),
    ]
    data = b"".join(parts)
    bounds = np.cumsum([0, *map(len, parts)])
    registered: list[McapRecord] = []
    numbers, received, starts, ends = scan_chunks(data, bounds[:-1], bounds[1:], registered.append)
    assert (numbers.tolist(), received.tolist()) == ([3, 2**16 - 1, 4], [10, 2**64 - 1, 0])
    assert [data[start:end] for start, end in zip(starts.tolist(), ends.tolist(), strict=True)] == [b"x", b"", b"yy"]
    assert [getattr(each, "topic", None) for each in registered] == ["/tf"]
    nothing = np.empty(0, np.int64)
    assert scan_chunks(b"", nothing, nothing, registered.append).numbers.tolist() == []
    # One byte shorter than its header, and as long.
    for size, is_whole in ((21, False), (22, True)):
        one = record(Opcode.MESSAGE, bytes(size))
        for order in ((one, parts[0]), (parts[0], one)):
            begins, ends = np.array([0, len(order[0])]), np.cumsum([*map(len, order)])
            if is_whole:
                found = scan_chunks(b"".join(order), begins, ends, registered.append)
                assert found.numbers.tolist() == [0 if each is one else 3 for each in order]
            else:
                with pytest.raises(ValueError, match="a message is too short"):
                    scan_chunks(b"".join(order), begins, ends, registered.append)


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
    with pytest.raises(ValueError, match="name of the compression has 33 bytes"):
        Chunk.parse(chunk(b"", 0, compression=b"x" * 33))
    assert Chunk.parse(chunk(b"", 0, compression=b"x" * 32)).compression == "x" * 32
    assert Chunk.parse(chunk(b"abc", 3, 4, b"lz4")) == (1, 2, 3, 4, "lz4", b"abc")
    # The checksum is that of the whole content.
    assert Chunk.parse(chunk(b"abc", 3, crc=zlib.crc32(b"abc"))).unfold() == b"abc"
    assert Chunk.parse(chunk(b"abc", 3, crc=1)[:-1], torn=True).unfold(torn=True) == b"ab"


def test_a_chunk_of_the_largest_size_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mcap_records, "MAX_CHUNK", 3)
    assert Chunk.parse(chunk(b"abc", 3)).unfold() == b"abc"
    with pytest.raises(UnfoldError, match="it claims 4 bytes, and 3 is the bound"):
        Chunk.parse(chunk(b"abcd", 4)).unfold()

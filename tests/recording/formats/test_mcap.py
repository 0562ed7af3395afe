"""MCAP files of every layout, whole and harmed, and their records byte by byte."""

import os
import random
import struct
import tracemalloc
import zlib
from collections.abc import Callable, Iterator
from functools import partial
from io import BytesIO
from itertools import accumulate, cycle, islice
from pathlib import Path
from typing import Any

import pytest
import zstandard
from hypothesis import example, given
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.writer import CompressionType, IndexType, Writer
from support.recorded import (
    Line,
    batches_in,
    facts,
    in_blocks,
    messages_in,
    without_unfinished,
    write_blocks,
    write_mcap,
)
from support.samples import moving, static

from tfbus import RecordingError
from tfbus.recording import RecordedMessage, open_recording
from tfbus.recording.formats import mcap_records
from tfbus.recording.formats.mcap_records import Chunk, read_records, record_places
from tfbus.recording.formats.storage import UnfoldError
from tfbus.stamps import STAMP_MAX
from tfbus.tf_message import encode

COUNT = 40
LINES = [
    (10, "/tf_static", [static("base", "laser", 1.0)]),
    *((100 + k, "/tf", [moving("odom", "base", k, float(k)), moving("base", "wheel", k)]) for k in range(COUNT)),
]
EXPECTED = [(received, tuple(samples)) for received, _, samples in LINES]

Write = Callable[..., Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    return partial(write_mcap, tmp_path / "run.mcap")


def damage(path: Path, part: bytes) -> None:
    """Turn over a bit where some bytes first are."""
    data = bytearray(path.read_bytes())
    data[data.index(part)] ^= 1
    path.write_bytes(data)


def errors_in(messages: list[RecordedMessage]) -> list[str]:
    return [str(error) for message in messages for error in message.errors]


def records_in(data: bytes | bytearray) -> Iterator[tuple[int, int]]:
    """The begin of each record, and its opcode."""
    at = 8
    while at + 8 < len(data):
        yield at, data[at]
        at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")


@pytest.mark.parametrize("finish", [True, False])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"chunk_size": 1},
        {"chunk_size": 1_000_000},
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.ZSTD},
        {"use_chunking": False},
        {"index_types": IndexType.NONE},
        {"index_types": IndexType.CHUNK},
        {"use_statistics": False},
        {"repeat_channels": False},
        {"repeat_schemas": False},
        {"repeat_schemas": False, "repeat_channels": False, "use_statistics": False, "index_types": IndexType.NONE},
        {"enable_crcs": False},
        {"enable_data_crcs": True},
    ],
    ids=str,
)
def test_all_messages_are_read_in_every_layout_of_a_file(write: Write, options: dict[str, Any], finish: bool) -> None:
    path = write(LINES, finish=finish, **options)
    assert batches_in(path) == EXPECTED
    with open_recording(path) as recording:
        assert (recording.start, recording.end, recording.finished) == (10, 99 + COUNT, finish)


def test_a_file_with_an_index_knows_the_count_of_its_messages(write: Write) -> None:
    path = write(LINES)
    with open_recording(path) as recording:
        assert facts(recording) == (10, 99 + COUNT, COUNT + 1, True)
    # A part is not held to it.
    for part in ((None, 110), (110, None)):
        messages = in_blocks(path, *part)
        assert messages == messages_in(path, *part)
        assert errors_in(messages) == []


def test_the_shortest_finished_file_is_an_empty_recording_and_with_a_byte_less_it_is_cut_off(path: Path) -> None:
    magic = b"\x89MCAP0\r\n"
    footer = b"\x02" + (20).to_bytes(8, "little") + bytes(20)
    path.write_bytes(magic + footer + magic)
    with open_recording(path) as recording:
        assert (recording.start, recording.end, recording.finished) == (None, None, True)
        assert list(recording.messages()) == []
    path.write_bytes((magic + footer + magic)[:-1])
    with pytest.raises(RecordingError, match="ends before its first message"):
        open_recording(path)


@pytest.mark.parametrize("finish", [True, False])
def test_a_message_whose_log_time_is_no_stamp_is_reported_and_the_others_are_read(write: Write, finish: bool) -> None:
    late = [(2**63 + 5, "/tf", [moving("a", "b", 6)]), (2**64 - 1, "/tf", [moving("a", "b", 7)])]
    path = write([(5, "/tf", [moving("a", "b", 5)]), *late], finish=finish)
    reasons = [f"no message of transforms (damaged): a message has the log time {time} ns" for time, _, _ in late]
    for messages in (messages_in(path), in_blocks(path)):
        found = [(message.received, len(message.batch), list(map(str, message.errors))) for message in messages]
        assert found[:3] == [(5, 1, []), *((5, 0, [reason]) for reason in reasons)]
        # A finished file also promises three.
        assert len(found) == 3 + finish


def test_only_the_chunks_of_the_range_are_read(write: Write) -> None:
    path = write(LINES)
    # A chunk has ten messages or less: these are far from the first and the last one.
    for stamp in (0, COUNT - 1):
        damage(path, encode([moving("odom", "base", stamp, float(stamp)), moving("base", "wheel", stamp)]))
    middle = messages_in(path, 115, 120)
    # One for the static transform, which is in the first chunk.
    assert [message.received for message in middle if message.batch] == [115, 116, 117, 118, 119, 120]
    assert not any(message.errors for message in middle)
    assert in_blocks(path, 115, 120) == middle


@pytest.mark.parametrize("finish", [True, False])
def test_a_damaged_chunk_is_reported_and_the_others_are_read(write: Write, finish: bool) -> None:
    path = write(LINES, finish=finish)
    damage(path, encode(EXPECTED[15][1]))
    messages = messages_in(path)
    lost, *promised = [message for message in messages if message.errors]
    assert [error.reason for error in lost.errors] == ["damaged"]
    assert "its checksum does not match" in str(lost.errors[0])
    assert lost.batch == ()
    read = [(message.received, message.batch) for message in messages if message.batch]
    missing = [place for place, line in enumerate(EXPECTED) if line not in read]
    assert 15 in missing
    assert missing == list(range(missing[0], missing[-1] + 1))
    assert len(missing) < 12
    # A finished file promises how many messages there are.
    expected = f"the file promises {COUNT} messages on '/tf', and {COUNT - len(missing)} were found"
    assert [error.detail for message in promised for error in message.errors] == [expected] * finish  # type: ignore[union-attr]
    # It comes in the place of what is lost.
    assert messages.index(lost) == missing[0]
    # Several chunks at once give the same.
    assert list(map(str, in_blocks(path))) == list(map(str, messages))


def test_damage_before_a_range_is_reported_at_the_start_of_the_range(write: Write) -> None:
    path = write(LINES)
    damage(path, encode(EXPECTED[15][1]))
    lost = {
        since: message.received
        for since in range(100, 100 + COUNT)
        for message in messages_in(path, since)
        if message.errors
    }
    # The chunk has several messages, and it is told from whichever the range begins with.
    assert sum(since == received for since, received in lost.items()) > 1
    assert all(since <= received <= 114 for since, received in lost.items() if since <= 114)


@pytest.mark.parametrize(("write_in", "count"), [(write_blocks, 5), (write_mcap, 1)])
def test_each_message_of_a_part_comes_once_in_blocks_of_any_size(
    tmp_path: Path, write_in: Callable[[Path, list[Line]], Path], count: int
) -> None:
    times = (0, 1, 2, 3, STAMP_MAX)
    path = write_in(tmp_path / "run.mcap", [(time, "/tf", [moving("a", "b", k)]) for k, time in enumerate(times)])
    for since in (None, *times):
        for until in (None, *times):
            first, last = 0 if since is None else since, STAMP_MAX if until is None else until
            expected = [(time, (moving("a", "b", k),), ()) for k, time in enumerate(times) if first <= time <= last]
            assert messages_in(path, since, until) == in_blocks(path, since, until) == expected
    with open_recording(path) as recording:
        assert len(list(recording.blocks())) == count


def test_a_chunk_without_transforms_is_not_read(write: Write) -> None:
    first, second = [moving("a", "b", 1)], [moving("a", "b", 3)]
    path = write([(1, "/tf", first), (2, "/camera", b"picture" * 1_000), (3, "/tf", second)], chunk_size=1)
    damage(path, b"picturepicture")
    assert [received for received, _ in batches_in(path)] == [1, 3]
    assert [(message.received, message.errors) for message in in_blocks(path)] == [(1, ()), (3, ())]


def test_a_record_beyond_the_end_of_a_finished_file_is_reported(write: Write) -> None:
    path = write(LINES, use_statistics=False)
    data = bytearray(path.read_bytes())
    second = [place for place, opcode in records_in(data) if opcode == Opcode.CHUNK][1]
    data[second + 1 : second + 9] = len(data).to_bytes(8, "little")
    path.write_bytes(data)
    *read, lost = messages_in(path)
    assert [(message.received, message.batch) for message in read] == EXPECTED[: len(read)]
    assert 0 < len(read) < len(EXPECTED)
    assert [error.reason for error in lost.errors] == ["damaged"]


def test_damage_in_the_index_loses_no_messages(write: Write) -> None:
    path = write(LINES)
    data = path.read_bytes()
    index = data.rindex(b"/tf_static")
    for place in (index, len(data) - 30, len(data) - 20):
        torn = bytearray(data)
        torn[place] ^= 1
        path.write_bytes(torn)
        assert batches_in(path) == EXPECTED
        with open_recording(path) as recording:
            assert recording.count is None


def test_an_index_is_used_up_to_its_bound(write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(LINES)
    data = path.read_bytes()
    begin, _, _ = struct.unpack("<QQI", data[-28:-8])
    size = len(data) - begin
    for bound, count in ((size, COUNT + 1), (size - 1, None)):
        monkeypatch.setattr("tfbus.recording.formats.mcap.MAX_INDEX", bound)
        with open_recording(path) as recording:
            assert recording.count == count
        assert batches_in(path) == EXPECTED


def test_an_index_entry_that_leads_to_another_record_loses_only_its_chunk(write: Write) -> None:
    path = write(LINES, enable_crcs=False)
    data = bytearray(path.read_bytes())
    entry = next(place for place, opcode in records_in(data) if opcode == Opcode.CHUNK_INDEX)
    schema = next(place for place, opcode in records_in(data) if opcode == Opcode.SCHEMA)
    # Where the chunk begins, and its length.
    data[entry + 25 : entry + 41] = schema.to_bytes(8, "little") + bytes(8)
    path.write_bytes(data)
    for messages in (messages_in(path), in_blocks(path)):
        told = errors_in(messages)
        assert told[0].endswith(f"the chunk at byte {schema}: there is no chunk, or it is too large")
        assert ["promises" in each for each in told[1:]] == [True, True]
        read = [(message.received, message.batch) for message in messages if message.batch]
        assert 0 < len(read) < len(EXPECTED)
        assert read == EXPECTED[-len(read) :]


def test_an_unreadable_record_is_reported_and_the_next_ones_are_read(write: Write) -> None:
    path = write(LINES, finish=False)
    data = path.read_bytes()
    nonsense = b"\x04" + (100).to_bytes(8, "little") + b"\xff" * 100
    path.write_bytes(data + nonsense + data[8:])
    messages = messages_in(path)
    lost = messages.pop(len(EXPECTED))
    assert [(message.received, message.batch) for message in messages] == EXPECTED * 2
    assert [error.reason for error in lost.errors] == ["damaged"]
    assert f"the channel at byte {len(data)}" in str(lost.errors[0])
    # At the last log time before it.
    assert lost.received == EXPECTED[-1][0]


def test_a_record_of_an_unknown_kind_is_told_with_its_place_and_a_private_one_is_not(write: Write) -> None:
    path = write(LINES, finish=False)
    data = path.read_bytes()
    private, unknown = (kind + (3).to_bytes(8, "little") + b"abc" for kind in (b"\x80", b"\x7f"))
    path.write_bytes(data + private + unknown + data[8:])
    (lost,) = errors_in(messages_in(path))
    assert lost.endswith(f"the record at byte {len(data) + len(private)}: its kind, 127, is unknown")


AUTHORITIES = "tfbus.authorities"
THREE = [moving("a", name, 1) for name in "bcd"]


@pytest.mark.parametrize(
    ("metadata", "authorities"),
    [
        ('[["odometry", 1]]', ["odometry"] * 3),
        ('[["odometry", 3]]', ["odometry"] * 3),
        ('[["odometry", 2], ["slam", 1]]', ["odometry", "odometry", "slam"]),
        ('[["odometry", 1], ["", 1], ["slam", 1]]', ["odometry", "", "slam"]),
        # Not of ours, or not for these: then nobody is said to have sent them.
        ('[["odometry", 1], ["slam", 1]]', [""] * 3),
        ("[]", [""] * 3),
        ("nonsense", [""] * 3),
        ("[" * 100_000, [""] * 3),
        ("3", [""] * 3),
        ('[["odometry", "x"]]', [""] * 3),
        ('[["odometry", 3], ["slam", -1]]', [""] * 3),
        ('[["odometry", 3], ["slam", 0]]', [""] * 3),
        ('[["odometry", 1000000000000]]', ["odometry"] * 3),
        ('[["odometry", 1000000000000], ["slam", 1]]', [""] * 3),
    ],
)
def test_authorities_are_in_the_metadata_of_the_channel(write: Write, metadata: str, authorities: list[str]) -> None:
    path = write([(1, "/tf", THREE), (2, "/tf_static", [static("x", "y")] * 3)], metadata={AUTHORITIES: metadata})
    (_, moving_ones), (_, static_ones) = batches_in(path)
    assert [sample.authority for sample in moving_ones] == authorities
    assert [sample.authority for sample in static_ones] == authorities
    assert all(sample.static for sample in static_ones)


def test_a_description_that_contradicts_that_of_the_index_is_told_and_that_of_the_index_holds(write: Write) -> None:
    path = write(LINES, enable_crcs=False)
    # The first one is in the first chunk.
    damage(path, b"/tf_static")
    for found in (errors_in(messages_in(path)), errors_in(in_blocks(path))):
        assert found == ["no message of transforms (damaged): the descriptions of channel 1 contradict each other"]
    assert [(message.received, message.batch) for message in messages_in(path) if message.batch] == EXPECTED


@pytest.mark.parametrize("use_chunking", [True, False])
def test_messages_on_channels_that_are_not_described_are_counted(write: Write, use_chunking: bool) -> None:
    path = write(LINES, finish=False, enable_crcs=False, use_chunking=use_chunking)
    data = bytearray(path.read_bytes())
    for place in (3, 4, 30):
        # The number of the channel is the first of the message, 22 bytes before the payload.
        at = data.index(encode(EXPECTED[place][1])) - 22
        assert int.from_bytes(data[at : at + 2], "little") == 2
        data[at] = 9
    path.write_bytes(data)
    reason = "no message of transforms (damaged): 3 messages are on channels that the file does not describe"
    assert errors_in(messages_in(path)) == errors_in(in_blocks(path)) == [reason]
    assert [message.received for message in messages_in(path) if message.batch] == [
        received for place, (received, _) in enumerate(EXPECTED) if place not in (3, 4, 30)
    ]
    with open_recording(path) as recording:
        assert recording.count is None
        for part in ((0, None), (None, 10**9)):
            assert len(list(recording.messages(*part))) > 0
        assert len(without_unfinished(recording.messages())) == len(EXPECTED) - 3 + 1
        assert recording.count == len(EXPECTED) - 3


def test_many_channels_that_claim_a_million_authorities_cost_nothing(path: Path) -> None:
    with path.open("wb") as file:
        writer: Any = Writer(file)
        writer.start("ros2", "tests")
        kind = writer.register_schema("tf2_msgs/msg/TFMessage", "ros2msg", b"")
        claim = {AUTHORITIES: '[["a", 999999], ["b", 1]]'}
        for number in range(1_000):
            channel = writer.register_channel("/tf", "cdr", kind, claim)
            writer.add_message(channel, number, encode([moving("a", "b", number)]), number)
        writer.finish()
    tracemalloc.start()
    assert len(batches_in(path)) == 1_000
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 50_000_000


def test_a_message_that_inflates_beyond_its_bound_is_refused_and_the_next_is_read(write: Write) -> None:
    bomb = zstandard.compress(bytes(9 * 2**20))
    path = write([(1, "/tf", bomb), (2, "/tf", [moving("a", "b", 2)])], chunk_size=100_000)
    refused, good = messages_in(path)
    assert [error.reason for error in refused.errors] == ["oversized"]
    assert "more than 8,388,608 bytes, which is the bound" in str(refused.errors[0])
    assert good.batch == (moving("a", "b", 2),)


@pytest.mark.parametrize("finish", [True, False])
@pytest.mark.parametrize("claim", [2**40, 200 * 2**20])
def test_a_chunk_that_claims_another_size_than_it_has_is_not_inflated(write: Write, finish: bool, claim: int) -> None:
    path = write(LINES, compression=CompressionType.ZSTD, finish=finish)
    data = bytearray(path.read_bytes())
    second = [place for place, opcode in records_in(data) if opcode == Opcode.CHUNK][1]
    # Behind the header of the record and two times.
    data[second + 25 : second + 33] = claim.to_bytes(8, "little")
    path.write_bytes(data)
    tracemalloc.start()
    lost, *_ = errors_in(messages_in(path))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert f"the chunk at byte {second}: it claims {claim:,} bytes" in lost
    assert peak < 20_000_000


def test_the_whole_part_of_a_torn_chunk_is_read(write: Write) -> None:
    # Incompressible, so that a chunk has several blocks of Zstandard.
    rng = random.Random(1)
    lines = [(k, "/tf", [moving("a", "b", k, rng.random())]) for k in range(5_000)]
    whole = [(received, tuple(samples)) for received, _, samples in lines]
    counts = []
    for part in (0.5, 0.7, 0.95):
        path = write(
            lines,
            finish=False,
            compression=CompressionType.ZSTD,
            chunk_size=10_000_000,
            index_types=IndexType.NONE,
        )
        os.truncate(path, int(part * path.stat().st_size))
        found = batches_in(path)
        assert found == whole[: len(found)]
        counts.append(len(found))
    assert 0 < counts[0] < counts[1] < counts[2] < 5_000


@pytest.mark.parametrize("use_chunking", [True, False])
def test_a_file_that_is_cut_anywhere_in_its_last_message_has_the_others(write: Write, use_chunking: bool) -> None:
    path = write(LINES[:3], finish=False, use_chunking=use_chunking, chunk_size=10_000)
    data = path.read_bytes()
    payload = encode(EXPECTED[2][1])
    begin = data.index(payload)
    for size in range(begin - 31, begin + len(payload)):
        path.write_bytes(data[:size])
        assert batches_in(path) == EXPECTED[:2]


@pytest.mark.parametrize(
    ("short", "why"), [(False, "a record goes on behind the end of the chunk"), (True, "a message is too short")]
)
def test_a_message_of_a_wrong_length_loses_its_chunk(write: Write, short: bool, why: str) -> None:
    path = write(LINES, chunk_size=1, enable_crcs=False)
    data = bytearray(path.read_bytes())
    payload = encode([moving("odom", "base", 5, 5.0), moving("base", "wheel", 5)])
    place = data.index(payload) - 30
    length = int.from_bytes(data[place : place + 8], "little")
    assert length == 22 + len(payload)
    data[place : place + 8] = (21 if short else length + 1).to_bytes(8, "little")
    path.write_bytes(data)
    for messages in (messages_in(path), in_blocks(path)):
        assert errors_in(messages)[0].endswith(why)
        read = [(message.received, message.batch) for message in messages if message.batch]
        assert read == [line for line in EXPECTED if line[0] != 105]


def test_a_file_that_grows_while_it_is_open_is_read_up_to_the_size_that_it_had(write: Write) -> None:
    path = write(LINES, finish=False)
    with open_recording(path) as recording:
        with path.open("ab") as file:
            file.write(path.read_bytes()[8:])
        assert [(message.received, message.batch) for message in recording.messages() if message.batch] == EXPECTED


def test_a_chunk_with_more_messages_than_the_bound_is_told_and_the_others_are_read(
    write: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("mcap", "mcap_records"):
        monkeypatch.setattr(f"tfbus.recording.formats.{module}.MAX_CHUNK_MESSAGES", 2)
    # A chunk ends where it is full, so the larger messages are two in a chunk.
    lines = [(k, "/tf", [moving("a", "b" * (9 if k < 3 else 190), k)]) for k in range(9)]
    path = write(lines, chunk_size=500)
    for messages in (messages_in(path), in_blocks(path)):
        told = errors_in(messages)
        assert told[0].endswith("it has more than 2 messages, which is the bound")
        assert len(told) == 2
        assert [message.received for message in messages if message.batch] == [3, 4, 5, 6, 7, 8]


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def test_records_are_read_up_to_their_bounds_and_private_ones_are_passed_over(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mcap_records, "MAX_INDEX", 3)
    for opcode in (Opcode.SCHEMA, Opcode.STATISTICS):
        kinds = ((opcode, 3), (128, 1), (opcode, 4), (255, 1), (opcode, 0), (2, 0))
        data = b"".join(record(kind, bytes(size)) for kind, size in kinds)
        found = [(0, opcode, bytes(3)), (22, opcode, None), (45, opcode, b"")]
        assert list(read_records(BytesIO(data), len(data))) == found


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
    # The checksum is that of the whole content.
    assert Chunk.parse(chunk(b"abc", 3, crc=zlib.crc32(b"abc"))).unfold() == b"abc"
    assert Chunk.parse(chunk(b"abc", 3, crc=1)[:-1], torn=True).unfold(torn=True) == b"ab"


def written(sizes: list[int]) -> bytes:
    # Contents that look like heads must not be taken for them.
    return b"".join(struct.pack("<BQ", 5, size) + bytes(size) for size in sizes)


@given(
    st.lists(st.tuples(st.lists(st.integers(0, 5), min_size=1, max_size=5), st.integers(1, 90)), min_size=1, max_size=4)
)
@example([([1, 2, 3], 90), ([4], 1), ([1, 2, 3], 90)])
@example([([3], 63), ([4, 4, 5], 6), ([3, 1], 40)])
def test_all_records_are_found_whether_their_lengths_repeat_or_not(parts: list[tuple[list[int], int]]) -> None:
    sizes = [size for lengths, count in parts for size in islice(cycle(lengths), count)]
    assert record_places(written(sizes)).tolist() == list(accumulate((9 + size for size in sizes), initial=0))


@pytest.mark.parametrize("count", [0, 1, 2, 40])
def test_a_last_record_that_is_cut_off_or_claims_more_than_there_is_is_damage(count: int) -> None:
    data = written([3] * count)
    for missing in range(1, 12 if count else 1):
        with pytest.raises((ValueError, struct.error)):
            record_places(data[:-missing])
    for size in (2**63, 2**64 - 1, 100):
        with pytest.raises(ValueError, match="behind the end"):
            record_places(data + struct.pack("<BQ", 5, size) + bytes(90))

"""Bags of ROS 1, whole and harmed, and their records byte by byte."""

import io
import re
import struct
from collections.abc import Iterable
from functools import partial
from itertools import permutations
from pathlib import Path

import pytest
from rosbags.rosbag1 import Reader, Writer
from rosbags.typesys import Stores, get_typestore
from support.recorded import SMALL, facts, messages_in, sender_of, without_unfinished
from support.samples import moving, static

from tfbus import RecordingError, TransformStamped
from tfbus.recording import open_recording
from tfbus.recording.formats import ros1
from tfbus.recording.formats.ros1 import CHUNK, Ros1Storage, find_chunk, read_chunk, read_record, split_chunk
from tfbus.recording.formats.storage import Channel
from tfbus.recording.formats.transforms import write_ros1
from tfbus.tf_message import encode

# The records of a bag byte by byte, for bags that no writer makes


def field(name: bytes, value: bytes) -> bytes:
    return struct.pack("<I", len(name) + 1 + len(value)) + name + b"=" + value


def record(header: bytes, data: bytes = b"") -> bytes:
    return struct.pack("<I", len(header)) + header + struct.pack("<I", len(data)) + data


def message(connection: int, seconds: int, data: bytes, order: str = "cot") -> bytes:
    """A message at 5 ns after a second, the fields of its header in the order of these letters."""
    fields = {
        "c": field(b"conn", struct.pack("<I", connection)),
        "o": field(b"op", b"\2"),
        "t": field(b"time", struct.pack("<II", seconds, 5)),
    }
    return record(b"".join(fields[letter] for letter in order), data)


def connection(number: int, own_topic: bytes | None, /, **described: bytes) -> bytes:
    """A connection, with a topic of its own, and with what its data say."""
    header = field(b"conn", struct.pack("<I", number)) + field(b"op", b"\7")
    if own_topic is not None:
        header += field(b"topic", own_topic)
    return record(header, b"".join(field(name.encode(), value) for name, value in described.items()))


def chunk(content: bytes, size: int | None = None) -> bytes:
    """A chunk that is not compressed; it claims the size of its content, or another."""
    claim = struct.pack("<I", len(content) if size is None else size)
    return record(field(b"compression", b"none") + field(b"op", b"\5") + field(b"size", claim), content)


def index(connection: int, *seconds: int) -> bytes:
    """The index of the messages of a connection that comes behind a chunk."""
    header = field(b"ver", struct.pack("<I", 1)) + field(b"op", b"\4")
    header += field(b"conn", struct.pack("<I", connection)) + field(b"count", struct.pack("<I", len(seconds)))
    return record(header, b"".join(struct.pack("<III", second, 5, 0) for second in seconds))


def unfinished(*records: bytes) -> bytes:
    """A bag whose writer was killed before it wrote an index."""
    header = field(b"index_pos", bytes(8)) + field(b"conn_count", bytes(4)) + field(b"chunk_count", bytes(4))
    return b"#ROSBAG V2.0\n" + record(header + field(b"op", b"\3")) + b"".join(records)


SECOND = 1_000_000_000


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run.bag"


def test_a_bag_tells_its_ends_its_count_and_who_sent_what() -> None:
    with Reader(SMALL) as reader:
        count = reader.message_count
        recorded = {sender_of(connection).removeprefix("/") for connection in reader.connections}
    # The first is a static transform a second before the start, the last the newest of the odometry, 2 ms late.
    with open_recording(SMALL) as recording:
        assert facts(recording) == (99 * SECOND, 109_982_000_000, count, True)
        messages = list(recording.messages())
    assert len(messages) == count
    senders = {sample.child: sample.authority for message in messages for sample in message.batch}
    assert (senders["odom"], senders["base_link"], senders["laser"]) == ("slam", "odometry", "calibration")
    assert set(senders.values()) == recorded


def test_a_range_includes_both_ends() -> None:
    times = [message.received for message in messages_in(SMALL)]
    low, high = times[100], times[200]
    # Four static frames come from before.
    assert [message.received for message in messages_in(SMALL, low, high)] == [low] * 4 + [
        time for time in times if low <= time <= high
    ]


Line = tuple[int, str, list[TransformStamped]]

LINES: list[Line] = [
    (10, "/tf_static", [static("base", "laser", 1.0)]),
    *((100 + k, "/tf", [moving("odom", "base", k, float(k)), moving("base", "wheel", k)]) for k in range(60)),
]
EXPECTED = [(received, tuple(samples)) for received, _, samples in LINES]


def write_bag(
    path: Path, lines: Iterable[Line] = LINES, compression: Writer.CompressionFormat | None = None, chunk: int = 2_000
) -> bytes:
    """A bag by the writer of `rosbags`; returns its bytes."""
    types = get_typestore(Stores.ROS2_HUMBLE)
    path.unlink(missing_ok=True)
    writer = Writer(path)
    if compression is not None:
        writer.set_compression(compression)
    writer.chunk_threshold = chunk
    with writer:
        topics = {}
        for received, topic, samples in lines:
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, "tf2_msgs/msg/TFMessage", typestore=types, callerid="")
            payload = types.cdr_to_ros1(encode(samples), "tf2_msgs/msg/TFMessage")
            writer.write(topics[topic], received, bytes(payload))
    return path.read_bytes()


def read(path: Path) -> tuple[list[tuple[int, tuple[TransformStamped, ...]]], list[str]]:
    """The messages that are read of a recording, and the losses that are reported."""
    messages = messages_in(path)
    batches = [(message.received, message.batch) for message in messages if message.batch]
    return batches, [str(error) for message in messages for error in message.errors]


def read_all_but_a_chunk(path: Path) -> tuple[int, list[str]]:
    """Read all messages but some of one chunk; returns the number of these, and the losses that are reported."""
    found, lost = read(path)
    missing = [line for line in EXPECTED if line not in found]
    assert 0 < len(missing) < 25
    assert found == [line for line in EXPECTED if line not in missing]
    return len(missing), lost


def chunks_in(data: bytes) -> list[int]:
    """The begins of the chunks' headers, in a bag by `rosbags`."""
    return [
        found.start()
        for found in re.finditer(rb"....\x04\0\0\0op=\x05|....\x10\0\0\0compression=none", data, re.DOTALL)
    ]


COMPRESSIONS = [None, *Writer.CompressionFormat]


def index_place(data: bytes | bytearray) -> int:
    """The place in the header of a bag at which is told where its index begins."""
    return data.index(b"index_pos=") + 10


def without_index(data: bytearray) -> bytearray:
    """The same bag, whose header tells of no index, as that of a writer that was killed."""
    place = index_place(data)
    data[place : place + 8] = bytes(8)
    return data


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_all_messages_are_read_with_an_index_and_without(
    path: Path, compression: Writer.CompressionFormat | None
) -> None:
    data = write_bag(path, compression=compression)
    (begin,) = struct.unpack_from("<Q", data, index_place(data))
    for finished in (True, False):
        path.write_bytes(data if finished else data[:begin])
        assert read(path) == (EXPECTED, [])
        with open_recording(path) as recording:
            assert facts(recording) == (10, 159, 61, finished)


def test_a_finished_bag_without_messages_is_an_empty_recording(path: Path) -> None:
    data = bytearray(unfinished())
    place = index_place(data)
    # Its index is behind the header at the earliest.
    for begin in (len(data), len(data) - 1):
        data[place : place + 8] = begin.to_bytes(8, "little")
        path.write_bytes(data)
        if begin == len(data):
            with open_recording(path) as recording:
                assert facts(recording) == (None, None, 0, True)
                assert list(recording.messages()) == []
        else:
            with pytest.raises(RecordingError, match="ends before its first message"):
                open_recording(path)


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_the_last_chunk_of_a_writer_that_was_killed_is_read(
    tmp_path: Path, compression: Writer.CompressionFormat | None
) -> None:
    path = tmp_path / "run.bag.active"
    data = bytearray(write_bag(path, compression=compression))
    # While it writes a chunk, `rosbag` has a size of zero in the header, and no index.
    with path.open("rb") as file:
        last = max(
            (record for record in map(partial(read_record, file), chunks_in(bytes(data))) if record.kind == 5),
            key=lambda record: record.offset,
        )
    data[last.data - 4 : last.data] = bytes(4)
    size = data.index(b"size=", last.offset) + 5
    data[size : size + 4] = bytes(4)
    path.write_bytes(without_index(data)[: last.end])
    assert read(path) == (EXPECTED, [])


def test_behind_a_damaged_record_reading_goes_on_with_the_next_chunk(path: Path) -> None:
    data = bytearray(write_bag(path))
    second, third = chunks_in(bytes(data))[1:3]
    # The length of the header of a message in the second chunk.
    place = data.index(b"time=", data.index(b"time=", second) + 100) - 4
    assert second < place < third
    data[place + 3] ^= 0x80
    path.write_bytes(data)
    missing, (damage, promised) = read_all_but_a_chunk(path)
    assert f"the chunk at byte {second}: " in damage
    assert f"the file promises 60 messages on '/tf', and {60 - missing} were found" in promised


@pytest.mark.parametrize("indexed", [True, False])
def test_a_damaged_chunk_header_loses_one_chunk(path: Path, indexed: bool) -> None:
    data = bytearray(write_bag(path))
    second, third = chunks_in(bytes(data))[1:3]
    data[second + 3] ^= 0x40
    path.write_bytes(data if indexed else without_index(data))
    _, lost = read_all_but_a_chunk(path)
    assert (f"the chunk at byte {second}: " if indexed else f"from byte {second} to byte {third}") in lost[0]


def test_a_chunk_that_claims_to_hold_those_behind_it_hides_none_of_them(path: Path) -> None:
    data = bytearray(write_bag(path))
    second, third = chunks_in(bytes(data))[1:3]
    with path.open("rb") as file:
        begin = read_record(file, second).data
    data[begin - 1] ^= 0x40
    path.write_bytes(without_index(data))
    _, lost = read_all_but_a_chunk(path)
    (size,) = struct.unpack_from("<I", data, begin - 4)
    assert f"nothing can be read from byte {second} to byte {third}: a chunk claims {size:,} bytes" in lost[0]


def test_an_index_is_used_up_to_its_bound(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = write_bag(path)
    size = len(data) - struct.unpack_from("<Q", data, index_place(data))[0]
    for bound, finished in ((size, True), (size - 1, False)):
        monkeypatch.setattr("tfbus.recording.formats.ros1.MAX_INDEX", bound)
        with open_recording(path) as recording:
            assert recording.finished == finished
        assert read(path) == (EXPECTED, [])


TF = {"type": b"tf2_msgs/TFMessage", "md5sum": b"94810edda583a504dfda3829e70d7eec"}


def stored_in(path: Path, *records: bytes, **limits: int) -> tuple[list[tuple[int, str, bytes]], list[str]]:
    """Log time in s, topic and payload of all messages of an unfinished bag, and the losses that are reported."""
    path.write_bytes(unfinished(*records))
    storage = Ros1Storage(path)
    try:
        found, lost = [], []
        for received, channel, payload in storage.messages(lambda _: True, **limits):
            if isinstance(channel, Channel):
                assert received % SECOND == 5
                found.append((received // SECOND, channel.topic, payload))
            elif channel.reason != "unfinished":
                lost.append(channel.detail)
        return found, lost
    finally:
        storage.close()


def test_the_topic_of_a_connection_is_that_of_its_record_or_else_that_of_its_description(path: Path) -> None:
    # The second one is that to which the recorder subscribed.
    content = connection(0, b"/tf", topic=b"/mapped", **TF) + connection(1, None, topic=b"/other", **TF)
    content += message(0, 1, b"x") + message(1, 2, b"y")
    assert stored_in(path, chunk(content)) == ([(1, "/tf", b"x"), (2, "/other", b"y")], [])


def test_messages_on_connections_that_are_not_described_are_counted(path: Path) -> None:
    content = connection(3, b"/tf", **TF) + b"".join(message(number, number, b"x") for number in (1, 2, 3, 4))
    found, lost = stored_in(path, chunk(content), chunk(message(1, 5, b"y")))
    assert found == [(3, "/tf", b"x")]
    assert lost == ["4 messages are on connections that the file does not describe"]


@pytest.mark.parametrize("other", [connection(3, b"/tf2", **TF), connection(3, b"/tf", type=b"std_msgs/String")])
def test_descriptions_that_contradict_each_other_are_told_and_the_first_one_holds(path: Path, other: bytes) -> None:
    one = connection(3, b"/tf", **TF)
    again = connection(3, b"/tf", **{**TF, "callerid": b"/other"})
    assert stored_in(path, chunk(one + again + message(3, 1, b"x"))) == ([(1, "/tf", b"x")], [])
    found, lost = stored_in(path, chunk(one + other + message(3, 1, b"x")))
    assert found == [(1, "/tf", b"x")]
    assert lost == ["the descriptions of connection 3 contradict each other"]


def test_a_range_of_a_bag_without_an_index_includes_both_ends(path: Path) -> None:
    described = chunk(connection(0, b"/tf", **TF))
    chunks = [chunk(message(0, begin, b"x") + message(0, begin + 1, b"y")) for begin in (10, 20, 30)]
    for first, last in ((11, 30), (12, 29), (20, 21), (21, 21), (22, 29)):
        found, lost = stored_in(path, described, *chunks, since=first * SECOND + 5, until=last * SECOND + 5)
        assert [second for second, _, _ in found] == [
            second for second in (10, 11, 20, 21, 30, 31) if first <= second <= last
        ]
        assert lost == []


def test_damage_between_the_chunks_is_told_at_the_start_of_the_recording_or_of_the_range(path: Path) -> None:
    one = chunk(connection(0, b"/tf", **TF) + message(0, 7, b""))
    path.write_bytes(unfinished(b"\xff" * 40, one))
    for since, told in ((None, 7 * SECOND + 5), (0, 7 * SECOND + 5), (9 * SECOND, 9 * SECOND)):
        lost = [
            message.received for message in messages_in(path, since) if "nothing can be read" in str(message.errors)
        ]
        assert lost == [told]
    # The chunk behind one byte is found.
    begin = len(unfinished())
    path.write_bytes(unfinished(b"\xff", one))
    (damage, *_) = read(path)[1]
    assert f"nothing can be read from byte {begin} to byte {begin + 1}" in damage
    # Nothing is behind the whole, and a byte more is a record that is cut.
    for rest in (b"", b"x"):
        assert stored_in(path, one, rest) == ([(7, "/tf", b"")], [])


def test_a_chunk_of_which_nothing_can_be_read_changes_neither_start_nor_end(path: Path) -> None:
    damaged = chunk(b"\xff" * 50)
    described = connection(0, b"/tf", **TF)
    first, second = (chunk(described + message(0, seconds, write_ros1([]))) for seconds in (7, 9))
    for parts in ((damaged, first, second), (first, damaged, second), (first, second, damaged)):
        path.write_bytes(unfinished(*parts))
        with open_recording(path) as recording:
            assert (recording.start, recording.end) == (7 * SECOND + 5, 9 * SECOND + 5)
            lost, *whole = without_unfinished(recording.messages())
        place = len(unfinished(*parts[: parts.index(damaged)]))
        assert (lost.received, len(lost.errors)) == (7 * SECOND + 5, 1)
        assert f"the chunk at byte {place}: " in str(lost.errors[0])
        assert [(each.received, each.errors) for each in whole] == [(7 * SECOND + 5, ()), (9 * SECOND + 5, ())]
    # With its index, its time is known.
    path.write_bytes(unfinished(first, damaged, index(0, 8), second))
    assert [(each.received // SECOND, len(each.errors)) for each in messages_in(path)] == [(7, 0), (8, 1), (9, 0)]
    path.write_bytes(unfinished(damaged))
    with pytest.raises(RecordingError, match=r"as a bag of ROS 1: the chunk at byte \d+: ") as raised:
        open_recording(path)
    assert raised.value.reason == "damaged"


def test_the_indexes_behind_the_chunks_tell_how_many_messages_there_are(path: Path) -> None:
    described = connection(0, b"/tf", **TF) + connection(1, b"/other", type=b"a/B")
    first = chunk(described + message(0, 1, b"x") + message(1, 2, b"y") + message(0, 3, b"z"))
    second = chunk(message(0, 8, b"x") + message(0, 9, b"x"))
    whole = unfinished(first, index(0, 1, 3), index(1, 2), second, index(0, 8, 9))
    path.write_bytes(whole)
    with open_recording(path) as recording:
        assert facts(recording) == (SECOND + 5, 9 * SECOND + 5, 4, False)
        assert [(topic.name, topic.count) for topic in recording.topics] == [("/other", 1), ("/tf", 4)]
    # Of a chunk whose index is cut, and of one that is cut itself, only reading them tells.
    end = len(index(0, 8, 9))
    for cut, last, count in ((1, 9, 4), (end, 9, 4), (end + 1, 8, 3)):
        path.write_bytes(whole[:-cut])
        with open_recording(path) as recording:
            assert facts(recording) == (SECOND + 5, last * SECOND + 5, None, False)
            assert [(topic.name, topic.count) for topic in recording.topics] == [("/other", None), ("/tf", None)]
            # Of a part, nothing is known of the whole.
            for part in ((0, None), (None, 99 * SECOND)):
                assert len(without_unfinished(recording.messages(*part))) == count
                assert recording.count is None
            assert len(without_unfinished(recording.messages())) == recording.count == count
            assert [(topic.name, topic.count) for topic in recording.topics] == [("/other", 1), ("/tf", count)]


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
    # A look-alike in the block before and the position of the file do not matter.
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

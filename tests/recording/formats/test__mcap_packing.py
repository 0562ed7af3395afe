import struct
from collections import Counter
from contextlib import closing
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import CompressionType, Writer
from support.samples import moving

from tfbus.recording.formats.mcap import ChunkPacker, McapReading, McapStorage, OpenChunk
from tfbus.recording.formats.mcap_records import MAGIC
from tfbus.recording.formats.storage import Channel, ChunkPlace, Packed
from tfbus.tf_message import encode


def message(number: int, received: int, payload: bytes) -> bytes:
    return struct.pack("<BQHIQQ", 5, 22 + len(payload), number, 0, received, 0) + payload


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def text(content: str) -> bytes:
    return struct.pack("<I", len(content)) + content.encode()


def described(number: int, kind: str) -> bytes:
    """The schema and the channel of a number, of a type."""
    schema = struct.pack("<H", number + 1) + text(kind) + text("") + text("")
    return record(3, schema) + record(4, struct.pack("<HH", number, number + 1) + text("/tf") + text("cdr") + text(""))


STATISTICS = record(11, struct.pack("<QHIIIIQQI", 0, 2, 2, 0, 0, 0, 0, 0, 0))
FILE = (
    MAGIC
    + described(0, "a")
    + described(3, "b")
    + STATISTICS
    + record(2, struct.pack("<QQI", len(MAGIC), 0, 0))
    + MAGIC
)
"""A finished file without messages, whose channels have the numbers 0 and 3."""


def packed(*contents: bytes, low: int = 0, high: int = 100) -> tuple[list[tuple[int, str, bytes]], Counter[int]]:
    """Log time, kind of channel or damage, and payload of the messages in some chunks; and the number of all."""
    with closing(McapStorage(Path("run.mcap"), BytesIO(FILE))) as storage:
        reading = McapReading(storage, lambda _: True)
        chunks = [OpenChunk(ChunkPlace(5, 9, at), content) for at, content in enumerate(contents)]
        found = []
        for block in ChunkPacker(reading).pack(chunks, low, high):
            damaged = not isinstance(block, Packed) and any(not isinstance(channel, Channel) for _, channel, _ in block)
            assert isinstance(block, Packed) != damaged
            for received, channel, payload in block.stored() if isinstance(block, Packed) else block:
                found.append((received, channel.type if isinstance(channel, Channel) else channel.detail, payload))
        return found, reading.counts


def test_all_messages_are_counted_and_those_of_wanted_channels_are_packed_by_time() -> None:
    first, second = message(3, 7, b"x") + message(8, 1, b""), message(0, 5, b"y") + message(3, 6, b"z")
    expected = [(5, "a", b"y"), (6, "b", b"z"), (7, "b", b"x")]
    assert packed(first, second) == (expected, {0: 1, 3: 2, 8: 1})
    # Of a part, both ends belong to it, and all are counted.
    assert packed(first, second, low=6, high=7) == (expected[1:], {0: 1, 3: 2, 8: 1})
    assert packed(first, second, low=6, high=6) == (expected[1:2], {0: 1, 3: 2, 8: 1})
    # Also if no channel is wanted, or nothing is there.
    assert packed(message(8, 1, b"")) == ([], {8: 1})
    assert packed() == packed(b"") == ([], {})


@pytest.mark.parametrize(
    ("damaged", "why"),
    [
        (message(3, 6, b"x")[:-1], "a record goes on behind the end of the chunk"),
        (struct.pack("<BQ", 5, 21) + bytes(40), "a message is too short"),
        (message(3, 6, b"x") * 3, "it has more than 2 messages, which is the bound"),
    ],
)
def test_the_messages_of_the_good_chunks_are_counted_beside_a_damaged_one(
    monkeypatch: pytest.MonkeyPatch, damaged: bytes, why: str
) -> None:
    for module in ("mcap", "mcap_records"):
        monkeypatch.setattr(f"tfbus.recording.formats.{module}.MAX_CHUNK_MESSAGES", 2)
    good = message(3, 7, b"x") + message(8, 1, b"")
    lost = f"the chunk at byte 1: {why}"
    assert packed(good, damaged, good) == ([(5, lost, b""), *[(7, "b", b"x")] * 2], {3: 2, 8: 2})
    assert packed(damaged, low=6) == ([(6, lost.replace("1", "0", 1), b"")], {})
    # Where nothing is damaged, so many are packed.
    assert packed(good, good) == ([(7, "b", b"x")] * 2, {3: 2, 8: 2})


def test_a_record_that_ends_where_another_chunk_has_begun_is_damage() -> None:
    good = message(3, 7, b"x")
    # Together, their bytes are records again.
    found, counts = packed(good[:20], good[20:])
    assert [text.partition(":")[0] for _, text, _ in found] == ["the chunk at byte 0", "the chunk at byte 1"]
    assert counts == {}


@pytest.mark.parametrize("wrong", ["schema", "short"])
def test_a_damaged_chunk_among_packed_ones_is_lost_alone(tmp_path: Path, wrong: str) -> None:
    path = tmp_path / "run.mcap"
    with path.open("wb") as file:
        writer: Any = Writer(file, 1, CompressionType.NONE, enable_crcs=False)
        writer.start("ros2", "")
        channel = writer.register_channel(
            "/tf", "cdr", writer.register_schema("tf2_msgs/msg/TFMessage", "ros2msg", b"")
        )
        for k in range(5):
            writer.add_message(channel, k, encode([moving("map", f"frame{k}", k)]), k)
        writer.finish()
    data = bytearray(path.read_bytes())
    at = data.index(b"frame2")
    head = data.rindex(b"\5", 0, at - 31 - 24)
    while data[head : head + 1] != b"\5" or int.from_bytes(data[head + 1 : head + 9], "little") > 200:
        head = data.rindex(b"\5", 0, head)
    # The record of the third message becomes one that ends too early, or a schema.
    data[head] = 3 if wrong == "schema" else data[head]
    if wrong == "short":
        data[head + 1 : head + 9] = (21).to_bytes(8, "little")
    path.write_bytes(data)
    storage = McapStorage(path)
    try:
        expected = list(storage.messages(lambda _: True))
        blocks = list(storage.packed(lambda _: True))
        found = [stored for block in blocks for stored in (block.stored() if isinstance(block, Packed) else block)]
    finally:
        storage.close()
    assert [(received, payload) for received, _, payload in found] == [
        (received, payload) for received, _, payload in expected
    ]
    assert len([1 for _, each, _ in found if isinstance(each, Channel)]) == 4

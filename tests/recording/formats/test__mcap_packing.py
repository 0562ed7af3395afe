from pathlib import Path
from typing import Any

import pytest
from mcap.writer import CompressionType, Writer
from support.samples import moving

from tfbus.recording.formats._mcap import McapStorage
from tfbus.recording.formats._packed import Packed
from tfbus.recording.formats._storage import Channel
from tfbus.tf_message import encode


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

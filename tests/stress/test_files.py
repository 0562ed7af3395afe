"""Files that are cut, damaged or hostile: nothing but the documented errors, and whatever is missing is told."""

import os
import random
import sqlite3
import struct
import tracemalloc
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import zstandard
from mcap.writer import CompressionType
from rosbags.rosbag2 import StoragePlugin
from support.recorded import SMALL, as_ros2, write_mcap
from support.samples import moving

from tfbus import RecordingError
from tfbus.recording import convert, examine, load, open_recording
from tfbus.recording.recording import Problems
from tfbus.recording.summary import summarise
from tfbus.tf_message import encode

OPTIONS: dict[str, dict[str, Any]] = {
    "mcap": {},
    "lz4.mcap": {"compression": CompressionType.LZ4},
    "zstd.mcap": {"compression": CompressionType.ZSTD},
    "plain.mcap": {"use_chunking": False},
    "bare.mcap": {"use_statistics": False, "repeat_channels": False, "enable_crcs": False},
}
"""The layouts of an MCAP file."""
STEP, DAMAGES = (int(os.environ.get(name, default)) for name, default in (("FILE_STEP", "23"), ("FILE_DAMAGES", "30")))
"""A file is cut at every so many bytes, and damaged so many times, in the thorough suite."""


def zstd(path: Path) -> Path:
    """The file compressed as ROS 2 does, in a folder of its own."""
    folder = path.with_suffix("")
    folder.mkdir()
    packed = folder / f"{path.name}.zstd"
    packed.write_bytes(zstandard.compress(path.read_bytes()))
    return packed


def finished_file(kind: str, folder: Path) -> Path:
    """A finished recording of 40 messages in one file."""
    lines = [(k + 1, "/tf", [moving("odom", "base", k, float(k)), moving("base", "arm", k)]) for k in range(40)]
    source = write_mcap(folder / "source.mcap", lines, **OPTIONS.get(kind, {}))
    if kind in OPTIONS:
        return source
    copy = folder / f"copy.{kind.removesuffix('.zstd')}"
    convert([source], copy)
    return zstd(copy) if kind.endswith("zstd") else copy


@pytest.mark.parametrize("kind", [*OPTIONS, "bag", "db3", "mcap.zstd", "db3.zstd"])
@pytest.mark.parametrize("step", [293, pytest.param(STEP, marks=pytest.mark.thorough)])
def test_a_finished_file_that_is_cut_anywhere_tells_of_it(tmp_path: Path, kind: str, step: int) -> None:
    path = finished_file(kind, tmp_path)
    data = path.read_bytes()
    # A compressed file is read as a part of its folder.
    recording = path.parent if path.suffix == ".zstd" else path
    for size in range(len(data) - 1, -1, -step):
        os.truncate(path, size)
        problems = Problems()
        try:
            load(recording, problems=problems)
        except RecordingError as error:
            assert error.reason in ("truncated", "damaged", "empty", "foreign")
            continue
        assert problems, f"cut at byte {size}"


def mutated(data: bytes, numbers: random.Random) -> bytes:
    """The data with some bits turned over, and some bytes removed, inserted, copied or replaced by a large number."""
    found = bytearray(data)
    for _ in range(numbers.choice([1, 1, 2, 8])):
        at, other = numbers.randrange(len(found)), numbers.randrange(len(found))
        size = numbers.choice([1, 4, 8, 64])
        match numbers.randrange(6):
            case 0:
                found[at] ^= 1 << numbers.randrange(8)
            case 1:
                del found[at : at + size]
            case 2:
                found[at:at] = numbers.randbytes(size)
            case 3:
                found[at : at + size] = found[other : other + size]
            case 4:
                found[at : at + size] = b"\xff" * size
            case _:
                del found[at:]
        if not found:
            break
    return bytes(found)


@pytest.mark.parametrize("kind", [*OPTIONS, "bag", "db3", "mcap.zstd", "metadata.yaml"])
@pytest.mark.parametrize("count", [3, pytest.param(DAMAGES, marks=pytest.mark.thorough)])
def test_a_damaged_file_is_read_or_refused_and_nothing_else(tmp_path: Path, kind: str, count: int) -> None:
    if kind == "metadata.yaml":
        recording = as_ros2(SMALL, tmp_path / "folder", StoragePlugin.MCAP)
        path = recording / kind
    else:
        path = finished_file(kind, tmp_path)
        recording = path.parent if path.suffix == ".zstd" else path
    data = path.read_bytes()
    numbers = random.Random(count)
    for _ in range(count):
        path.write_bytes(mutated(data, numbers))
        try:
            load(recording, problems=Problems())
            with open_recording(recording) as opened:
                examine(opened)
                summarise(opened)
                list(opened.messages(5, 20))
            convert([recording], tmp_path / "copy.mcap", overwrite=True)
        except RecordingError as error:
            # The damaged list of a folder may name a file that is not there.
            assert error.reason in ("truncated", "damaged", "empty", "foreign", "missing")


def record(opcode: int, data: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(data)) + data


def text(data: bytes) -> bytes:
    return struct.pack("<I", len(data)) + data


def chunk(content: bytes) -> bytes:
    """A chunk of an MCAP file from 1 to 9 ns, whose content Zstandard makes very small."""
    packed = zstandard.compress(content)
    head = struct.pack("<QQQI", 1, 9, len(content), 0)
    return record(6, head + text(b"zstd") + struct.pack("<Q", len(packed)) + packed)


def described(number: int, definition: bytes) -> bytes:
    """A schema and a channel of it."""
    schema = struct.pack("<H", number) + text(b"tf2_msgs/msg/TFMessage") + text(b"ros2msg") + text(definition)
    channel = struct.pack("<HH", number, number) + text(b"/tf") + text(b"cdr") + text(b"")
    return record(3, schema) + record(4, channel)


def stored(number: int, payload: bytes) -> bytes:
    return record(5, struct.pack("<HIQQ", number, 0, 5, 5) + payload)


MAGIC = b"\x89MCAP0\r\n" + record(1, text(b"") + text(b""))


def test_what_small_chunks_describe_is_kept_up_to_a_bound(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    big = bytes(30 * 2**20)
    chunks = [chunk(described(number, big) + stored(number, encode([moving("a", "b", 1)]))) for number in range(1, 4)]
    path.write_bytes(MAGIC + b"".join(chunks))
    assert path.stat().st_size < 100_000
    problems = Problems()
    tracemalloc.start()
    load(path, problems=problems)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 250 * 2**20
    # The first two are within the bound.
    assert problems == {"damaged": 1, "unfinished": 1}
    assert "the descriptions of channels take more than 67,108,864 bytes" in problems.details[0]


@pytest.mark.thorough
def test_all_chunks_of_a_small_file_together_unfold_to_a_bound(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    first = chunk(described(1, b"") + stored(1, encode([moving("a", "b", 1)])))
    big = chunk(record(0x80, bytes(250 * 2**20)))
    path.write_bytes(MAGIC + first + 7 * big + stored(1, encode([moving("b", "c", 1)])))
    assert path.stat().st_size < 100_000
    problems = Problems()
    # The fifth exceeds the bound of 1 GiB, and is the last that is unfolded.
    assert load(path, problems=problems).frames() == ["a", "b", "c"]
    assert problems == {"damaged": 2, "unfinished": 1}
    assert "the chunks before it hold more bytes than the bound for a file of its size" in problems.details[0]


def test_a_chunk_that_an_index_names_twice_is_read_once(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    one = chunk(described(1, b"") + stored(1, encode([moving("a", "b", 1)])))
    place = struct.pack("<QQQQI", 1, 9, len(MAGIC), len(one), 0) + struct.pack("<QI", 0, 4) + b"zstd"
    index = record(8, place + struct.pack("<QQ", len(one), 1_000)) * 1_000
    statistics = struct.pack("<QHIIIIQQ", 1_000, 1, 1, 0, 0, 1_000, 1, 9) + struct.pack("<IHQ", 10, 1, 1_000)
    data = MAGIC + one + record(15, bytes(4))
    start = len(data)
    data += described(1, b"") + index + record(11, statistics) + record(2, struct.pack("<QQI", start, 0, 0)) + MAGIC[:8]
    path.write_bytes(data)
    with open_recording(path) as recording:
        assert [message.received for message in recording.messages()] == [5]


def test_a_tree_of_pages_that_has_more_ways_than_a_file_has_bytes_is_refused(tmp_path: Path) -> None:
    path = finished_file("db3", tmp_path)
    with closing(sqlite3.connect(path)) as file:
        file.execute("CREATE TABLE spare(x)")
        file.executemany("INSERT INTO spare VALUES (zeroblob(3000))", [()] * 20)
        file.commit()
        ((root,),) = file.execute("SELECT rootpage FROM sqlite_master WHERE name = 'messages'")
    data = bytearray(path.read_bytes())
    size = 4_096
    last = len(data) // size
    (right,) = struct.unpack_from(">I", data, (root - 1) * size + 8)
    leaf = data[(right - 1) * size : right * size]
    # Every one of 300 ways from each of six pages leads to the next of them.
    for page, child in zip([root, *range(last, last - 5, -1)], range(last, last - 6, -1), strict=True):
        ways = b"".join(struct.pack(">IBB", child, 0x80 | way >> 7, way & 0x7F) for way in range(1, 301))
        begin = size - len(ways)
        head = struct.pack(">BHHHBI", 5, 0, 300, begin, 0, child)
        head += b"".join(struct.pack(">H", begin + 6 * way) for way in range(300))
        data[(page - 1) * size : page * size] = head + bytes(size - len(head) - len(ways)) + ways
    data[(last - 6) * size : (last - 5) * size] = leaf
    path.write_bytes(data)
    with pytest.raises(RecordingError, match="it takes more steps than a file of its size needs"):
        open_recording(path)

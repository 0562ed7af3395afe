"""Folders of ROS 2: several files, compression, and what the metadata promise."""

import shutil
from pathlib import Path
from typing import Any

import pytest
import zstandard
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode
from support.recorded import SMALL, as_ros2, batches_in, facts, in_blocks, messages_in, write_mcap
from support.samples import moving

from tfbus import RecordingError
from tfbus.recording import open_recording

ZSTD = {"fmt": CompressionFormat.ZSTD}
LINES = [(time, "/tf", [moving("odom", "base", time)]) for time in range(30)]
EXPECTED = [(time, tuple(samples)) for time, _, samples in LINES]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with one file."""
    write_mcap(tmp_path / "run_0.mcap", LINES)
    return tmp_path


@pytest.mark.parametrize("storage", StoragePlugin)
@pytest.mark.parametrize(
    "options",
    [
        pytest.param({}, marks=pytest.mark.thorough),
        {"mode": CompressionMode.FILE, **ZSTD},
        {"mode": CompressionMode.MESSAGE, **ZSTD},
    ],
    ids=str,
)
def test_what_ros_2_records_is_read_compressed_or_not(
    tmp_path: Path, storage: StoragePlugin, options: dict[str, Any]
) -> None:
    folder = as_ros2(SMALL, tmp_path / "bag", storage, **options)
    before = sorted(tmp_path.rglob("*"))
    anonymous = [
        (message.received, tuple(sample.replace(authority="") for sample in message.batch))
        for message in messages_in(SMALL)
    ]
    assert [(message.received, message.batch) for message in messages_in(folder)] == anonymous
    with open_recording(folder) as recording, open_recording(SMALL) as bag:
        assert facts(recording) == facts(bag)
    assert sorted(tmp_path.rglob("*")) == before


def test_several_files_are_one_recording_in_the_order_of_their_times(tmp_path: Path) -> None:
    # By name, 10 is before 2.
    for number, part in ((2, LINES[:10]), (10, LINES[10:25]), (11, LINES[25:])):
        write_mcap(tmp_path / f"run_{number}.mcap", part)
    (tmp_path / "metadata.yaml").write_text("not needed")
    assert batches_in(tmp_path) == EXPECTED
    with open_recording(tmp_path) as recording:
        assert facts(recording) == (0, 29, 30, True)
    assert [message.received for message in in_blocks(tmp_path)] == list(range(30))
    assert [message.received for message in messages_in(tmp_path, 9, 11)] == [9, 10, 11]


@pytest.mark.parametrize("content", [b"", b"\x89MCAP0\r\n", b"nonsense"])
def test_a_file_that_cannot_be_read_is_told_and_the_others_are_read(folder: Path, content: bytes) -> None:
    (folder / "run_1.mcap").write_bytes(content)
    lost, *rest = messages_in(folder)
    assert (lost.received, [error.reason for error in lost.errors]) == (0, ["damaged"])
    assert "run_1.mcap" in str(lost.errors[0])
    assert [(message.received, message.batch) for message in rest] == EXPECTED
    with open_recording(folder) as recording:
        assert not recording.finished
    # Told once, also where what was static before is looked for.
    assert sum(bool(message.errors) for message in messages_in(folder, since=5)) == 1


def test_what_cannot_be_read_is_told_at_the_start_of_the_recording_or_of_the_range(tmp_path: Path) -> None:
    # A file without messages has no start.
    write_mcap(tmp_path / "run_0.mcap", [])
    write_mcap(tmp_path / "run_1.mcap", LINES[10:20])
    (tmp_path / "run_2.mcap").write_bytes(b"nonsense")
    for since, told in ((None, 10), (12, 12), (40, 40)):
        lost = [message for message in messages_in(tmp_path, since) if message.errors]
        assert [message.received for message in lost] == [told]
    with open_recording(tmp_path) as recording:
        assert (recording.start, recording.end, recording.count) == (10, 19, 10)
        (block,) = (block for block in recording.blocks() if len(block))
        assert [message.received for message in block.messages()] == [10, *range(10, 20)]


def test_a_folder_of_nothing_but_bad_files_is_refused_for_what_is_wrong_with_the_first(tmp_path: Path) -> None:
    (tmp_path / "run_0.mcap").write_bytes(b"")
    (tmp_path / "run_1.db3").write_bytes(b"nonsense")
    with pytest.raises(RecordingError, match=r"run_0\.mcap': the file is empty") as raised:
        open_recording(tmp_path)
    assert raised.value.reason == "empty"


def test_a_damaged_compressed_file_is_refused(tmp_path: Path) -> None:
    folder = as_ros2(SMALL, tmp_path / "bag", StoragePlugin.MCAP, mode=CompressionMode.FILE, **ZSTD)
    (file,) = folder.glob("*.zstd")
    file.write_bytes(b"\xff" * 100)
    with pytest.raises(RecordingError, match="cannot be decompressed"):
        open_recording(folder)


def test_any_other_folder_is_no_recording(tmp_path: Path) -> None:
    shutil.copy(SMALL, tmp_path)
    with pytest.raises(RecordingError, match="a folder without files") as raised:
        open_recording(tmp_path)
    assert raised.value.reason == "foreign"


def metadata(folder: Path, *files: str, topic: str = "/tf", count: int = 0) -> None:
    (folder / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  version: 5\n  relative_file_paths:\n"
        + "".join(f"    - {file}\n" for file in files)
        + f"  topics_with_message_count:\n    - topic_metadata: {{name: {topic}}}\n      message_count: {count}\n"
    )


def test_a_folder_is_what_its_metadata_name(folder: Path) -> None:
    write_mcap(folder / "stray.mcap", LINES)
    # As old versions wrote it, with the folder before the name.
    metadata(folder, "run/run_0.mcap", count=30)
    assert batches_in(folder) == EXPECTED
    with open_recording(folder) as recording:
        assert recording.remarks == ("stray.mcap is ignored: metadata.yaml does not name it",)


def test_a_file_that_the_metadata_name_and_is_not_there_is_told(folder: Path) -> None:
    metadata(folder, "run_0.mcap", "run_1.mcap", count=30)
    lost, *rest = messages_in(folder)
    assert "run_1.mcap': there is no such file" in str(lost.errors[0])
    assert len(rest) == 30


def test_a_name_that_leads_out_of_the_folder_does_not(tmp_path: Path) -> None:
    (tmp_path / "bag").mkdir()
    write_mcap(tmp_path / "secret.mcap", LINES)
    metadata(tmp_path / "bag", "../secret.mcap")
    with pytest.raises(RecordingError, match="there is no such file"):
        open_recording(tmp_path / "bag")


def test_what_the_metadata_promise_of_topics_that_are_not_read_is_not_told(tmp_path: Path) -> None:
    write_mcap(tmp_path / "run_0.mcap", [*LINES, (40, "/camera", b"picture")])
    metadata(tmp_path, "run_0.mcap", topic="/camera", count=7)
    assert batches_in(tmp_path) == EXPECTED


@pytest.mark.parametrize(
    ("text", "why"),
    [
        pytest.param("[" * 10_000, "maximum recursion depth", marks=pytest.mark.thorough, id="deep"),
        ("a: &a [*a]", "'rosbag2_bagfile_information'"),
        ("\0", "unacceptable character"),
        ("rosbag2_bagfile_information: {}", "'relative_file_paths'"),
        ("rosbag2_bagfile_information: {relative_file_paths: []}", "it names no file"),
        ("- 1", "list indices must be integers"),
    ],
)
def test_metadata_that_cannot_be_read_are_ignored_with_a_remark(folder: Path, text: str, why: str) -> None:
    (folder / "metadata.yaml").write_text(text)
    assert batches_in(folder) == EXPECTED
    with open_recording(folder) as recording:
        assert recording.remarks[0].startswith(f"metadata.yaml is ignored, as it cannot be read: {why}")


def test_metadata_are_read_up_to_a_bound(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_mcap(folder / "stray.mcap", LINES)
    metadata(folder, "run_0.mcap", count=30)
    size = (folder / "metadata.yaml").stat().st_size
    why = f"it has more than {size - 1} bytes, which is the bound"
    for bound, remark in (
        (size, "stray.mcap is ignored: metadata.yaml does not name it"),
        (size - 1, f"metadata.yaml is ignored, as it cannot be read: {why}"),
    ):
        monkeypatch.setattr("tfbus.recording.formats.folder.MAX_METADATA", bound)
        with open_recording(folder) as recording:
            assert recording.remarks == (remark,)


def test_metadata_that_promise_nothing_on_a_topic_that_no_file_has_are_kept(folder: Path) -> None:
    metadata(folder, "run_0.mcap", topic="/gone", count=0)
    assert batches_in(folder) == EXPECTED


def test_without_metadata_an_uncompressed_file_hides_the_compressed_one(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "run_0.mcap", LINES)
    (tmp_path / "run_0.mcap.zstd").write_bytes(zstandard.compress(path.read_bytes()))
    assert batches_in(tmp_path) == EXPECTED
    with open_recording(tmp_path) as recording:
        assert recording.remarks == ("run_0.mcap.zstd is ignored: the uncompressed file of the same name is there",)


def test_a_compressed_file_unfolds_up_to_a_bound_and_nothing_of_it_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(temporary))
    folder = tmp_path / "bag"
    folder.mkdir()
    (folder / "run_0.db3.zstd").write_bytes(zstandard.compress(bytes(65 * 2**20)))
    with pytest.raises(RecordingError, match="more than 67,108,864 bytes, which is the bound"):
        open_recording(folder)
    assert list(temporary.iterdir()) == []
    whole = as_ros2(SMALL, tmp_path / "whole", StoragePlugin.SQLITE3, mode=CompressionMode.FILE, **ZSTD)
    with open_recording(whole) as recording:
        # The reader has it open, and it has no name.
        assert list(temporary.iterdir()) == []
        assert sum(bool(message.batch) for message in recording.messages()) > 700


@pytest.mark.parametrize("received", [0, 7])
def test_what_is_missing_of_a_file_of_which_nothing_is_read_is_told_at_its_start(tmp_path: Path, received: int) -> None:
    write_mcap(tmp_path / "run_0.mcap", [(received, "/camera", b"picture")])
    metadata(tmp_path, "run_0.mcap", topic="/gone", count=3)
    for messages in (messages_in(tmp_path), in_blocks(tmp_path)):
        assert [(message.received, len(message.errors)) for message in messages] == [(received, 1)]


# One that is not finished is not packed.
@pytest.mark.parametrize("finish", [True, False])
@pytest.mark.parametrize(
    ("topic", "promised", "says"),
    [
        ("/tf", 2_000, []),
        ("/tf", 2_003, ["promises 2,003 messages on '/tf', and 2,000 were found"]),
        ("/gone", 7, ["promises 7 messages on '/gone'"]),
    ],
)
def test_the_promises_of_the_metadata_are_compared_with_the_messages_that_are_read(
    tmp_path: Path, finish: bool, topic: str, promised: int, says: list[str]
) -> None:
    write_mcap(
        tmp_path / "run_0.mcap", [(5 + k, "/tf", [moving("odom", "base", k)]) for k in range(2_000)], finish=finish
    )
    metadata(tmp_path, "run_0.mcap", topic=topic, count=promised)
    for messages in (messages_in(tmp_path), in_blocks(tmp_path)):
        assert [message.received for message in messages if message.batch] == list(range(5, 2_005))
        told = [(message.received, str(message.errors[0])) for message in messages if message.errors]
        assert [received for received, _ in told] == [2_004] * len(says)
        assert all(each in text for each, (_, text) in zip(says, told, strict=True))
    # Of a range nothing can be said.
    assert [message.received for message in in_blocks(tmp_path, 100, 200)] == list(range(100, 201))

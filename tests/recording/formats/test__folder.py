import shutil
from pathlib import Path
from typing import Any

import pytest
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode
from support.recorded import SMALL, as_ros2, batches_in, facts, messages_in, write_mcap
from support.samples import moving, static

from tfbus import RecordingError
from tfbus.recording import open_recording

ZSTD = {"fmt": CompressionFormat.ZSTD}
LINES = [(time, "/tf", [moving("odom", "base", time)]) for time in range(30)]
EXPECTED = [(time, tuple(samples)) for time, _, samples in LINES]


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
    assert [message.received for message in messages_in(tmp_path, 9, 11)] == [9, 10, 11]


def test_files_that_overlap_are_merged(tmp_path: Path) -> None:
    write_mcap(tmp_path / "even.mcap", LINES[::2])
    write_mcap(tmp_path / "odd.mcap", LINES[1::2])
    assert batches_in(tmp_path) == EXPECTED


def test_what_is_static_in_an_earlier_file_comes_first(tmp_path: Path) -> None:
    write_mcap(tmp_path / "run_0.mcap", [(0, "/tf_static", [static("base", "laser")])])
    write_mcap(tmp_path / "run_1.mcap", LINES[10:])
    first = messages_in(tmp_path, since=20)[0]
    assert (first.received, first.batch) == (20, (static("base", "laser"),))


def test_an_unfinished_file_makes_an_unfinished_recording(tmp_path: Path) -> None:
    write_mcap(tmp_path / "run_0.mcap", LINES[:10])
    write_mcap(tmp_path / "run_1.mcap", LINES[10:], finish=False)
    assert batches_in(tmp_path) == EXPECTED
    with open_recording(tmp_path) as recording:
        assert facts(recording) == (0, 29, None, False)


@pytest.mark.parametrize("content", [b"", b"\x89MCAP0\r\n", b"nonsense"])
def test_a_file_that_cannot_be_read_is_told_and_the_others_are_read(tmp_path: Path, content: bytes) -> None:
    write_mcap(tmp_path / "run_0.mcap", LINES)
    (tmp_path / "run_1.mcap").write_bytes(content)
    lost, *rest = messages_in(tmp_path)
    assert [error.reason for error in lost.errors] == ["damaged"]
    assert "run_1.mcap" in str(lost.errors[0])
    assert [(message.received, message.batch) for message in rest] == EXPECTED
    with open_recording(tmp_path) as recording:
        assert not recording.finished
    # Told once, also where what was static before is looked for.
    assert sum(bool(message.errors) for message in messages_in(tmp_path, since=5)) == 1


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

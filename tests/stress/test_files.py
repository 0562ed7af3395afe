"""Files that are cut, damaged or hostile: nothing but the documented errors, and whatever is missing is told."""

import os
from pathlib import Path
from typing import Any

import pytest
import zstandard
from mcap.writer import CompressionType
from support.recorded import write_mcap
from support.samples import moving

from tfbus import RecordingError
from tfbus.recording import convert, load
from tfbus.recording.load import Problems


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
    options: dict[str, dict[str, Any]] = {
        "mcap": {},
        "lz4.mcap": {"compression": CompressionType.LZ4},
        "zstd.mcap": {"compression": CompressionType.ZSTD},
        "plain.mcap": {"use_chunking": False},
        "bare.mcap": {"use_statistics": False, "repeat_channels": False, "enable_crcs": False},
    }
    source = write_mcap(folder / "source.mcap", lines, **options.get(kind, {}))
    if kind in options:
        return source
    copy = folder / f"copy.{kind.removesuffix('.zstd')}"
    convert([source], copy)
    return zstd(copy) if kind.endswith("zstd") else copy


@pytest.mark.parametrize(
    "kind",
    ["mcap", "lz4.mcap", "zstd.mcap", "plain.mcap", "bare.mcap", "bag", "db3", "mcap.zstd", "db3.zstd"],
)
@pytest.mark.parametrize("step", [97, pytest.param(1, marks=pytest.mark.thorough)])
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

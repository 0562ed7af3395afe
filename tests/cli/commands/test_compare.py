import csv
import json
from io import StringIO
from pathlib import Path

import pytest
from support.commands import Command, check_wrong_call
from support.recorded import write_mcap
from support.samples import moving

from tfbus import Transform, TransformStamped

SECOND = 1_000_000_000


def write(path: Path, offset: float) -> Path:
    """A base on a parabola."""
    places = [(k, k * SECOND, (k + offset, 0.1 * k * k, 0.0)) for k in range(10)]
    lines = [(k, "/tf", [TransformStamped("map", "base", stamp, Transform(place))]) for k, stamp, place in places]
    return write_mcap(path, lines)


@pytest.fixture
def both(tmp_path: Path) -> tuple[Path, Path]:
    return write(tmp_path / "truth.mcap", 0.0), write(tmp_path / "slam.mcap", 2.0)


def test_errors_are_printed_with_and_without_alignment(both: tuple[Path, Path], tfbus: Command) -> None:
    done = tfbus("compare", *both, "--pair", "map:base")
    assert (done.returncode, done.stderr) == (0, "")
    lines = done.stdout.splitlines()
    assert lines[0] == "map:base, not aligned: 10 poses of 10 and 10"
    assert lines[1].split() == ["error", "unit", "rmse", "mean", "median", "std", "min", "max"]
    assert lines[2].split() == ["absolute", "translation", "m", "2", "2", "2", "0", "2", "2"]
    assert lines[7] == "map:base, aligned: 10 poses of 10 and 10"
    plain, aligned = json.loads(tfbus("compare", *both, "--pair", "map:base", "--json").stdout)
    assert (plain["absolute_translation"]["rmse"], plain["alignment"]) == (2.0, None)
    assert aligned["absolute_translation"]["max"] == pytest.approx(0.0, abs=1e-9)
    assert aligned["alignment"]["translation"] == pytest.approx([-2.0, 0.0, 0.0])


def test_without_a_pair_all_frames_that_move_in_both_are_compared(
    tmp_path: Path, both: tuple[Path, Path], tfbus: Command
) -> None:
    assert tfbus("compare", *both).stdout == tfbus("compare", *both, "--pair", "map:base").stdout
    other = write_mcap(tmp_path / "other.mcap", [(1, "/tf", [moving("map", "arm", 1)])])
    check_wrong_call(tfbus("compare", both[0], other), "no frame moves in both")


def test_errors_over_time_are_a_table(both: tuple[Path, Path], tfbus: Command) -> None:
    done = tfbus("compare", *both, "--pair", "map:base", "--delta", "3", "--csv")
    rows = list(csv.DictReader(StringIO(done.stdout)))
    assert [int(row["stamp_ns"]) for row in rows] == [k * SECOND for k in range(10)]
    assert [float(row["absolute_translation_m"]) for row in rows] == [2.0] * 10
    assert [bool(row["relative_translation_m"]) for row in rows] == [k in (3, 6, 9) for k in range(10)]


def test_a_trajectory_of_tum_is_compared_with_a_recording_of_other_names(
    both: tuple[Path, Path], tmp_path: Path, tfbus: Command
) -> None:
    tum = tmp_path / "truth.tum"
    tum.write_text("".join(f"{k}.0 {k} {0.1 * k * k} 0 0 0 0 1\n" for k in range(10)))
    wanted = tfbus("compare", *both, "--pair", "map:base", "--json")
    done = tfbus("compare", tum, both[1], "--pair", "map:base_link=map:base", "--json")
    assert json.loads(done.stdout.replace("map:base_link=", "")) == json.loads(wanted.stdout)
    check_wrong_call(tfbus("compare", tum, both[1]), "--pair TARGET:SOURCE=TARGET:SOURCE")
    for wrong in ("map", "map:base=", "map:base=map", "map=base:map", ":base", "map:base=a:b=c:d"):
        check_wrong_call(tfbus("compare", *both, "--pair", wrong), "a pair is TARGET:SOURCE")


def test_the_errors_are_drawn_with_the_names_of_the_files(
    both: tuple[Path, Path], tmp_path: Path, tfbus: Command
) -> None:
    pytest.importorskip("matplotlib")
    (tmp_path / "monday").mkdir()
    same = write(tmp_path / "monday" / "truth.mcap", 0.5)
    picture = tmp_path / "errors.svg"
    for other, name in ((both[1], "slam against truth"), (same, f"monday/truth against {tmp_path.name}/truth")):
        done = tfbus("compare", both[0], other, "--plot", picture)
        assert (done.returncode, done.stderr) == (0, f"wrote {picture}\n")
        assert f"<!-- map:base: {name}, aligned -->" in picture.read_text(encoding="utf-8")
    check_wrong_call(tfbus("compare", *both, "--plot", tmp_path / "errors.gif"), ".png, .svg or .pdf")
    two = ("--pair", "map:base", "--pair", "base:map", "--plot", picture)
    check_wrong_call(tfbus("compare", *both, *two), "--plot draws one pair")


def test_what_cannot_be_aligned_is_warned_of(tmp_path: Path, tfbus: Command) -> None:
    lines = [(k, "/tf", [moving("map", "base", k * SECOND, float(k))]) for k in range(5)]
    path = write_mcap(tmp_path / "line.mcap", lines)
    done = tfbus("compare", path, path, "--pair", "map:base")
    assert done.returncode == 0
    assert "their points lie on a line" in done.stderr


def test_a_scale_is_told_and_what_is_left_out_of_a_recording_too(tmp_path: Path, tfbus: Command) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    # One is twice as large as the other, which ends with a sample that cannot be.
    lines, doubled = (
        [
            (k, "/tf", [TransformStamped("map", "base", k * SECOND, Transform((size * k, size * k * k, 0.0)))])
            for k in range(10)
        ]
        for size in (1.0, 2.0)
    )
    write_mcap(folder / "run_0.mcap", [*lines, (10, "/tf", [moving("map", "base", 10 * SECOND, 1e13)])])
    write_mcap(folder / "stray.mcap", lines)
    (folder / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  version: 5\n  relative_file_paths:\n    - run_0.mcap\n"
        "  topics_with_message_count: []\n"
    )
    truth = write_mcap(tmp_path / "truth.mcap", doubled)
    done = tfbus("compare", truth, folder, "--pair", "map:base", "--scale")
    assert done.stderr.splitlines() == [
        f"tfbus: left out of {folder}: 1 x not physical",
        f"tfbus: {folder}: stray.mcap is ignored: metadata.yaml does not name it",
    ]
    headings = [line for line in done.stdout.splitlines() if line.startswith("map:base")]
    assert headings == [
        "map:base, not aligned: 10 poses of 10 and 10",
        "map:base, aligned and scaled by 2: 10 poses of 10 and 10",
    ]

import json
import re
from pathlib import Path

import pytest
from support.commands import Command
from support.recorded import SMALL, WRONG_IN_SMALL, Line, write_mcap
from support.samples import moving, static


def rows_of(output: str) -> dict[str, list[str]]:
    """The cells of each row of the table of frames by frame; two blanks or more separate them."""
    table = output.split("\n\n")[1]
    return {cells[0]: cells[1:] for line in table.splitlines() if (cells := re.split(r"  +", line.strip()))}


def test_the_table_shows_every_frame_and_counts_invalid_transforms(tfbus: Command) -> None:
    done = tfbus("info", SMALL, "--wide")
    assert (done.returncode, done.stderr) == (0, "")
    head, _, _ = done.stdout.partition("\n\n")
    assert head.splitlines() == [
        str(SMALL),
        "start     99.000000000 s  1970-01-01 00:01:39 UTC",
        "end       109.982000000 s  1970-01-01 00:01:49 UTC",
        "duration  10.982000000 s",
        "contents  992 transforms in 789 messages",
        "frames    12, below hen, island, map",
        "left out  3 x not finite, 2 x frame name, 1 x zero quaternion, 1 x not a unit quaternion, 1 x self transform, "
        "1 x cycle",
    ]
    rows = rows_of(done.stdout)
    assert rows["frame"] == ["parent", "kind", "samples", "rate", "span", "longest gap", "authority"]
    assert rows["odom"] == ["map", "moving", "100", "10.0 Hz", "9.9 s", "100 ms", "slam"]
    assert rows["base_link"] == ["odom", "moving", "426", "42.6 Hz", "9.98 s", "1.52 s", "odometry"]
    assert rows["box"][:2] == ["table, gripper", "moving"]
    assert rows["laser"] == ["base_link", "static", "1", "calibration"]
    assert len(rows) == 13


def test_the_senders_are_shown_with_their_frames_and_samples(tmp_path: Path, tfbus: Command) -> None:
    senders = tfbus("info", SMALL, "--wide").stdout.partition("\nsender ")[2].splitlines()
    assert [line.split()[:3] for line in senders[1:3]] == [["arm", "2", "400"], ["calibration", "3", "3"]]
    path = write_mcap(tmp_path / "run.mcap", [(1, "/tf", [moving("a", "b", 1), moving("a", "b", 2)])])
    unknown = tfbus("info", path, "--wide").stdout.partition("\nsender ")[2].splitlines()
    assert unknown[1].split()[:3] == ["(unknown)", "1", "2"]


def test_json_has_all_digits(tfbus: Command) -> None:
    done = tfbus("info", SMALL, "--json")
    assert (done.returncode, done.stderr) == (0, "")
    data = json.loads(done.stdout)
    assert data["path"] == str(SMALL)
    assert (data["start"], data["end"], data["duration"]) == ("99.000000000", "109.982000000", 10.982)
    assert (data["finished"], data["messages"], data["transforms"]) == (True, 789, 992)
    assert (data["roots"], data["problems"]) == (["hen", "island", "map"], WRONG_IN_SMALL)
    frames = {frame["frame"]: frame for frame in data["frames"]}
    assert frames["odom"] == {
        "frame": "odom",
        "parents": ["map"],
        "kind": "moving",
        "static": 0,
        "moving": 100,
        "oldest": "100.000000000",
        "newest": "109.900000000",
        "rate": 10.0,
        "span": 9.9,
        "longest_gap": 0.1,
        "authorities": ["slam"],
        "period": {"mean": 0.1, "p99": 0.1, "max": 0.1},
        "delay": {"mean": pytest.approx(0.002), "p99": 0.002, "max": 0.002},
    }
    assert frames["laser"]["oldest"] is None


def test_names_are_no_markup_and_not_cut_where_the_output_is_no_terminal(tmp_path: Path, tfbus: Command) -> None:
    long = "a_link_with_a_very_long_name_" * 10
    samples = [moving("[bold]map[/bold]", ":robot:", 1), moving(":robot:", long, 1)]
    rows = rows_of(tfbus("info", write_mcap(tmp_path / "run.mcap", [(1, "/tf", samples)]), "--wide").stdout)
    assert rows[":robot:"][0] == "[bold]map[/bold]"
    assert rows[long][0] == ":robot:"


def test_a_frame_of_both_kinds_shows_both(tmp_path: Path, tfbus: Command) -> None:
    lines = [(1, "/tf_static", [static("a", "b")]), (2, "/tf", [moving("a", "b", 1)])]
    assert rows_of(tfbus("info", write_mcap(tmp_path / "run.mcap", lines)).stdout)["b"][:3] == [
        "a",
        "static, moving",
        "2",
    ]


def test_an_unfinished_file_is_marked_and_read(tmp_path: Path, tfbus: Command) -> None:
    path = write_mcap(tmp_path / "run.mcap", [(1, "/tf", [moving("a", "b", 1)])], finish=False)
    done = tfbus("info", path)
    assert done.returncode == 0
    assert done.stdout.splitlines()[0] == f"{path}, cut or not finished by its writer"
    assert "b" in rows_of(done.stdout)


def test_a_recording_without_transforms_has_no_table(tmp_path: Path, tfbus: Command) -> None:
    done = tfbus("info", write_mcap(tmp_path / "run.mcap", [(1, "/camera", b"")]))
    assert (done.returncode, done.stderr) == (0, "")
    head, topics = done.stdout.split("\n\n")
    assert head.splitlines()[-3:-1] == ["contents  0 transforms in 0 messages", "frames    0"]
    assert topics.splitlines()[0].split() == ["topic", "type", "messages", "read"]


def test_all_lines_fit_80_columns_and_what_matters_least_is_left_out(
    tfbus: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    lines = tfbus("info", SMALL).stdout.split("\n\n", 1)[1].splitlines()
    assert max(map(len, lines)) <= 80
    assert lines[0].split() == ["frame", "parent", "kind", "samples", "rate", "longest", "gap", "authority"]
    titles = [line for line in lines if line.startswith(("frame ", "sender ", "topic "))]
    assert "delay p99" in titles[1]
    assert len(titles) == 4


def test_topics_that_are_not_read_are_listed_and_noted(
    tmp_path: Path, tfbus: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    lines: list[Line] = [
        (1, "/tf", [moving("a", "b", 1)]),
        (2, "/robot1/tf", [moving("a", "b", 1)]),
        (3, "/robot1/tf", b""),
    ]
    done = tfbus("info", write_mcap(tmp_path / "run.mcap", lines))
    assert "note      not read: 2 messages on topic /robot1/tf of type tf2_msgs/msg/TFMessage" in done.stdout
    assert re.search(r"/robot1/tf +tf2_msgs/msg/TFMessage +2  no, it may hold transforms", done.stdout)
    assert re.search(r"/tf +tf2_msgs/msg/TFMessage +1  yes", done.stdout)
    # On a narrow terminal the facts of the heading stay in their column.
    monkeypatch.setenv("COLUMNS", "50")
    narrow = tfbus("info", tmp_path / "run.mcap").stdout.splitlines()
    at = next(place for place, line in enumerate(narrow) if line.startswith("note"))
    assert narrow[at].index("not read") == 10
    assert re.match(r" {10}\S", narrow[at + 1])


def test_what_is_lost_is_told_line_by_line(tmp_path: Path, tfbus: Command) -> None:
    path = write_mcap(tmp_path / "run.mcap", [(1, "/tf", b"nonsense"), (2, "/tf", [moving("a", "b", 1)])])
    lines = tfbus("info", path).stdout.splitlines()
    at = lines.index("left out  1 x encoding")
    assert lines[at + 1].startswith("          it is not plain CDR")

"""``tfbus query``."""

import csv
import json
import re
import struct
from collections import Counter
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from support.commands import Command, check_wrong_call
from support.recorded import SMALL, Line, write_mcap
from support.samples import moving, static

from tfbus import Transform, TransformStamped
from tfbus.cli.commands.query import Row, print_rows
from tfbus.recording import load
from tfbus.tf_message import encode

SECOND = 1_000_000_000
EPOCH = 1_700_000_000_123_456_789
"""A stamp, in ns, whose neighbours are the same float."""


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """A base that moves at 1 m/s for 10 s, and an arm on it with samples from 2.5 s to 7.25 s."""
    lines = [
        (0, "/tf_static", [static("base", "laser", 100.0)]),
        *((k, "/tf", [moving("map", "base", EPOCH + k * SECOND // 10, k / 10)]) for k in range(101)),
        *((k, "/tf", [moving("base", "arm", EPOCH + k * SECOND // 100, 0.5)]) for k in range(250, 726)),
        (9, "/tf", [moving("island", "palm", EPOCH)]),
    ]
    return write_mcap(tmp_path / "run.mcap", lines)


def test_by_default_it_prints_the_newest_transform(recording: Path, tfbus: Command) -> None:
    done = tfbus("query", recording, "map", "arm", "--csv")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == "stamp_ns,x_m,y_m,z_m,qx,qy,qz,qw\n1700000007373456789,7.75,0.0,0.0,0.0,0.0,0.0,1.0\n"


def test_an_instant_is_exact_to_the_nanosecond(recording: Path, tfbus: Command) -> None:
    done = tfbus("query", recording, "map", "base", "--at", "1700000000.123456789", "--json")
    assert json.loads(done.stdout) == {
        "target": "map",
        "source": "base",
        "stamp": "1700000000.123456789",
        "translation": [0.0, 0.0, 0.0],
        "rotation": [0.0, 0.0, 0.0, 1.0],
    }
    # A nanosecond earlier there is nothing; a float of this size has steps of 238 ns.
    done = tfbus("query", recording, "map", "base", "--at", "1700000000.123456788")
    assert (done.returncode, done.stdout) == (1, "")
    assert "too early" in done.stderr


def test_intervals_span_the_time_that_all_edges_cover(recording: Path, tfbus: Command) -> None:
    done = tfbus("query", recording, "map", "arm", "--every", "0.5", "--csv")
    assert (done.returncode, done.stderr) == (0, "")
    rows = list(csv.DictReader(StringIO(done.stdout)))
    assert [int(row["stamp_ns"]) for row in rows] == [EPOCH + (5 + k) * SECOND // 2 for k in range(10)]
    assert [float(row["x_m"]) for row in rows] == pytest.approx([3.0 + k * 0.5 for k in range(10)])


def test_the_rows_are_those_of_single_lookups(tfbus: Command) -> None:
    tree = load(SMALL, problems=Counter())
    done = tfbus("query", SMALL, "laser", "box", "--every", "0.01", "--csv")
    rows = list(csv.DictReader(StringIO(done.stdout)))
    assert len(rows) > 900
    for row in rows:
        found = tree.lookup("laser", "box", int(row["stamp_ns"])).transform
        assert [float(row[name]) for name in ("x_m", "y_m", "z_m")] == pytest.approx(found.translation, abs=1e-12)
        assert [float(row[name]) for name in ("qx", "qy", "qz", "qw")] == pytest.approx(found.rotation, abs=1e-12)


def test_the_table_has_columns_with_units(recording: Path, tfbus: Command) -> None:
    done = tfbus("query", recording, "map", "base", "--every", "5")
    head, *lines = done.stdout.splitlines()
    assert re.split(r"  +", head.strip()) == ["stamp [s]", "x [m]", "y [m]", "z [m]", "qx", "qy", "qz", "qw"]
    assert [line.split()[:2] for line in lines] == [
        ["1700000000.123456789", "0.000000"],
        ["1700000005.123456789", "5.000000"],
        ["1700000010.123456789", "10.000000"],
    ]


def test_the_table_has_no_negative_zeros(tmp_path: Path, tfbus: Command) -> None:
    path = write_mcap(tmp_path / "run.mcap", [(1, "/tf", [moving("map", "base", EPOCH, -1e-9)])])
    _, line = tfbus("query", path, "map", "base").stdout.splitlines()
    assert line.split()[1:] == ["0.000000"] * 6 + ["1.000000"]


@pytest.mark.parametrize(
    ("every", "rows", "left_out"),
    # A chunk of instants covers two seconds of the second one.
    [("1", 8, "3 of 11"), ("0.0005", 14_001, "6,000 of 20,001")],
)
def test_instants_at_which_the_frames_are_not_connected_are_left_out_and_counted(
    tmp_path: Path, tfbus: Command, every: str, rows: int, left_out: str
) -> None:
    # From 4 s to 7 s the box is on an island.
    lines = [
        (k, "/tf", [moving("map", "robot", k * SECOND), moving("island" if 4 <= k < 7 else "map", "box", k * SECOND)])
        for k in range(11)
    ]
    done = tfbus("query", write_mcap(tmp_path / "run.mcap", lines), "robot", "box", "--every", every, "--csv")
    stamps = [int(line.partition(",")[0]) / SECOND for line in done.stdout.splitlines()[1:]]
    assert (done.returncode, len(stamps)) == (0, rows)
    assert not [stamp for stamp in stamps if 3.0 < stamp < 7.0 and every == "1"]
    assert done.stderr == f"tfbus: {left_out} instants are left out, the frames are not connected there\n"


@pytest.mark.parametrize(
    ("question", "why"),
    [
        (("map", "bse"), "frame 'bse' is not known, did you mean 'base'?"),
        (("/map", "base"), "frame '/map' is not known, a frame name has no leading slash, did you mean 'map'?"),
        (("map", "palm"), "no path from 'palm' to 'map'"),
        (("map", "palm", "--every", "1"), "no path from 'palm' to 'map'"),
        (("map", "base", "--at", "1.5"), "too early"),
        (("map", "base", "--at", "1700000020"), "short)"),
    ],
)
def test_a_failed_lookup_is_one_line_and_status_1(
    recording: Path, question: tuple[str, ...], why: str, tfbus: Command
) -> None:
    done = tfbus("query", recording, *question, "--csv")
    assert (done.returncode, done.stdout) == (1, "")
    assert re.fullmatch(r"tfbus: .+\n", done.stderr)
    assert why in done.stderr


def test_edges_that_never_overlap_are_a_failed_lookup(tmp_path: Path, tfbus: Command) -> None:
    lines = [
        (1, "/tf", [moving("a", "b", k) for k in range(5)]),
        (2, "/tf", [moving("b", "c", k) for k in range(7, 9)]),
    ]
    done = tfbus("query", write_mcap(tmp_path / "run.mcap", lines), "a", "c", "--every", "1")
    assert (done.returncode, done.stdout) == (1, "")
    assert "frame 'b': asked for 0.000000007 s, newest sample is 0.000000004 s" in done.stderr


def test_invalid_transforms_of_the_recording_are_counted_on_standard_error(tfbus: Command) -> None:
    done = tfbus("query", SMALL, "map", "base_link", "--csv")
    assert done.returncode == 0
    assert len(done.stdout.splitlines()) == 2
    assert re.fullmatch(r"tfbus: left out of .*small\.bag: 3 x not finite, .*, 1 x cycle\n", done.stderr)


def test_an_unfinished_recording_is_a_warning_on_standard_error(tmp_path: Path, tfbus: Command) -> None:
    path = write_mcap(tmp_path / "run.mcap", [(1, "/tf", [moving("a", "b", 1)])], finish=False)
    done = tfbus("query", path, "a", "b", "--csv")
    assert (done.returncode, len(done.stdout.splitlines())) == (0, 2)
    why = "1 messages were read of the file; it is cut, or its writer did not finish it: its index is missing"
    assert done.stderr == f"tfbus: left out of {path}: 1 x unfinished\ntfbus: {why}\n"


def test_an_offset_counts_from_the_beginning_and_a_date_is_absolute(tmp_path: Path, tfbus: Command) -> None:
    start = 1_396_293_890 * SECOND
    lines = [(start + k * SECOND, "/tf", [moving("map", "base", start + k * SECOND, float(k))]) for k in range(5)]
    path = write_mcap(tmp_path / "run.mcap", lines)
    for at in ("2.5", "1396293892.5", "2014-03-31T19:24:52.5"):
        (line,) = tfbus("query", path, "map", "base", "--at", at, "--json").stdout.splitlines()
        assert json.loads(line)["translation"] == [2.5, 0.0, 0.0]


def test_the_format_of_tum_has_eight_numbers_a_line(recording: Path, tfbus: Command) -> None:
    done = tfbus("query", recording, "map", "base", "--every", "5", "--tum")
    assert done.stdout.splitlines() == [
        f"{1_700_000_000 + 5 * k}.123456789 {5.0 * k} 0.0 0.0 0.0 0.0 0.0 1.0" for k in range(3)
    ]


def test_the_formats_of_kitti_and_euroc_have_a_matrix_or_the_stamp_in_ns_a_line(
    recording: Path, tfbus: Command
) -> None:
    question = ("query", recording, "map", "base", "--every", "5")
    kitti = tfbus(*question, "--kitti").stdout.splitlines()
    assert kitti == [f"1.0 0.0 0.0 {5.0 * k} 0.0 1.0 0.0 0.0 0.0 0.0 1.0 0.0" for k in range(3)]
    header, *euroc = tfbus(*question, "--euroc").stdout.splitlines()
    assert header.startswith("#timestamp [ns],")
    assert euroc == [f"{EPOCH + 5 * k * SECOND},{5.0 * k},0.0,0.0,1.0,0.0,0.0,0.0" for k in range(3)]


def test_several_pairs_are_told_apart(recording: Path, tfbus: Command) -> None:
    done = tfbus("query", recording, "map", "base", "base", "laser", "--csv")
    assert done.stdout.splitlines() == [
        "target,source,stamp_ns,x_m,y_m,z_m,qx,qy,qz,qw",
        "map,base,1700000010123456789,10.0,0.0,0.0,0.0,0.0,0.0,1.0",
        "base,laser,0,100.0,0.0,0.0,0.0,0.0,0.0,1.0",
    ]
    table = tfbus("query", recording, "map", "base", "base", "laser").stdout.splitlines()
    assert [table[at] for at in (0, 3, 4)] == ["base in map", "", "laser in base"]


def test_parquet_has_a_row_for_each_transform(recording: Path, tmp_path: Path, tfbus: Command) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    path = tmp_path / "rows.parquet"
    done = tfbus("query", recording, "map", "base", "base", "laser", "--every", "5", "--parquet", path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", f"4 rows in {path}\n")
    rows = parquet.read_table(path).to_pylist()
    assert [(row["target"], row["source"], row["x_m"], row["qw"]) for row in rows] == [
        ("map", "base", 0.0, 1.0),
        ("map", "base", 5.0, 1.0),
        ("map", "base", 10.0, 1.0),
        ("base", "laser", 100.0, 1.0),
    ]
    assert rows[1]["stamp_ns"] == EPOCH + 5 * SECOND
    check_wrong_call(tfbus("query", recording, "map", "base", "--parquet", tmp_path / "no" / "x"), "cannot write")
    assert not (tmp_path / "no").exists()


def test_the_stamps_of_another_topic_are_asked_for(tmp_path: Path, tfbus: Command) -> None:
    lines: list[Line] = [(k, "/tf", [moving("map", "base", k, float(k))]) for k in range(10)]
    lines += [(k, "/other", b"") for k in (3, 7, 20)]
    path = write_mcap(tmp_path / "run.mcap", sorted(lines, key=lambda line: line[0]))
    done = tfbus("query", path, "map", "base", "--stamps-of", "/other", "--csv")
    assert [line.split(",")[1] for line in done.stdout.splitlines()[1:]] == ["3.0", "7.0"]
    assert "the messages on /other have no headers: their log times are used" in done.stderr
    assert "1 of 3 instants are left out" in done.stderr


def test_messages_without_a_readable_header_are_counted(tmp_path: Path, tfbus: Command) -> None:
    write_mcap(tmp_path / "tf.mcap", [(k, "/tf", [moving("map", "base", k, float(k))]) for k in range(10)])
    # Little endian: seconds and nanoseconds; the second one is too short.
    images: list[Line] = [(20, "/image", b"\0\1\0\0" + bytes(4) + b"\5\0\0\0"), (21, "/image", b"\0\1\0\0")]
    write_mcap(tmp_path / "image.mcap", images, schema="sensor_msgs/msg/Image", definition=b"std_msgs/Header header")
    done = tfbus("query", tmp_path, "map", "base", "--stamps-of", "/image", "--csv")
    assert done.stderr.splitlines() == ["tfbus: 1 message on /image cannot be read"]
    (row,) = csv.DictReader(StringIO(done.stdout))
    assert (row["stamp_ns"], float(row["x_m"])) == ("5", 5.0)


def test_own_stamps_are_those_of_the_frame_with_the_most_samples_as_far_as_all_have_data(
    recording: Path, tfbus: Command
) -> None:
    for pair, first, count in ((("map", "base"), 0, 101), (("map", "arm"), 5 * SECOND // 2, 476)):
        rows = list(csv.DictReader(StringIO(tfbus("query", recording, *pair, "--own-stamps", "--csv").stdout)))
        assert (len(rows), int(rows[0]["stamp_ns"])) == (count, EPOCH + first)
    assert len(tfbus("query", recording, "base", "laser", "--own-stamps", "--csv").stdout.splitlines()) == 2
    check_wrong_call(tfbus("query", recording, "map", "base", "--own-stamps", "--at", "1"), "give one of them")


def test_namespaces_are_read_and_ignored_ones_are_mentioned(tmp_path: Path, tfbus: Command) -> None:
    lines = [(1, f"{space}/tf", [moving("odom", "base", 1, x)]) for space, x in (("/r1", 1.0), ("/r2", 2.0))]
    path = write_mcap(tmp_path / "run.mcap", lines)
    done = tfbus("query", path, "r2/odom", "r2/base", "--namespaces", "--json")
    assert json.loads(done.stdout)["translation"] == [2.0, 0.0, 0.0]
    done = tfbus("query", path, "x/odom", "x/base", "--topic", "/r1/tf=x/", "--json")
    assert json.loads(done.stdout)["translation"] == [1.0, 0.0, 0.0]
    assert "not read: 1 messages on topic /r2/tf of type tf2_msgs/msg/TFMessage" in done.stderr


def test_a_speed_limit_leaves_out_what_cannot_be(tmp_path: Path, tfbus: Command) -> None:
    lines = [(k, "/tf", [moving("map", "base", k * SECOND, x)]) for k, x in enumerate([0.0, 1.0, 1e9, 3.0])]
    done = tfbus(
        "query", write_mcap(tmp_path / "run.mcap", lines), "map", "base", "--at", "2", "--max-speed", "5", "--json"
    )
    assert json.loads(done.stdout)["translation"] == [2.0, 0.0, 0.0]
    assert "1 x speed" in done.stderr


def test_where_a_line_does_not_fit_the_quaternion_is_on_a_second_one(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    row = Row("map", "base", 1_396_293_888_050_000_001, (1e12, -2.0, 0.5), (0.0, 0.0, 0.0, 1.0))
    heights = {}
    for width in (60, 103, 104):
        monkeypatch.setenv("COLUMNS", str(width))
        print_rows([row], "table", several=False)
        lines = capsys.readouterr().out.splitlines()
        assert max(map(len, lines)) <= width
        heights[width] = len(lines)
        numbers = (
            "1396293888.050000001  1.0000e+12   -2.000000    0.500000    0.000000    0.000000    0.000000    1.000000"
        )
        assert " ".join(lines).split()[-8:] == numbers.split()
        # All of one width, however large.
        assert width < 104 or lines[-1].endswith(numbers)
    assert heights == {60: 4, 103: 4, 104: 2}


def test_poses_of_a_recording_are_read_as_the_transforms_of_a_frame(tmp_path: Path, tfbus: Command) -> None:
    transform = encode([TransformStamped("map", "?", 5 * SECOND, Transform((1.0, 2.0, 3.0)))])
    # A pose has no child, and no number of transforms before it: a header, "map" and its numbers.
    pose = transform[:4] + transform[8:16] + transform[16:24] + transform[-56:]
    path = write_mcap(tmp_path / "run.mcap", [(0, "/pose", pose)], schema="geometry_msgs/msg/PoseStamped")
    done = tfbus("query", path, "camera", "map", "--csv", "--odometry", "/pose=camera", "--invert")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines()[1].startswith("5000000000,-1.0,-2.0,-3.0,")
    check_wrong_call(tfbus("query", path, "camera", "map", "--invert"), "--invert is for the topics of --odometry")


def test_sigmas_are_those_of_the_odometry_and_edges_without_are_named(tmp_path: Path, tfbus: Command) -> None:
    lines: list[tuple[int, str, bytes]] = []
    for second in range(3):
        # A pose with its covariance, and a twist with another.
        head = struct.pack("<4xiII5s3xI5s3x", second, 0, 5, b"odom\0", 5, b"base\0")
        spread = np.diag([0.01, 0.04, 0.0, 0.0, 0.0, 1e-4]) * (1 + second)
        numbers = np.concatenate(((2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), spread.ravel(), np.full(42, 3.0)))
        lines.append((second, "/odom", b"\0\1" + head[2:] + numbers.astype("<f8").tobytes()))
    path = write_mcap(tmp_path / "odometry.mcap", lines, schema="nav_msgs/msg/Odometry")
    asked = ("query", path, "odom", "base", "--odometry", "/odom", "--sigmas")
    done = tfbus(*asked, "--every", "0.5", "--csv")
    assert done.stderr == ""
    rows = list(csv.DictReader(StringIO(done.stdout)))
    assert [float(row["sigma_x_m"]) for row in rows] == pytest.approx([(0.01 * k) ** 0.5 for k in (1, 1.5, 2, 2.5, 3)])
    assert [float(row["sigma_yaw"]) for row in rows][::4] == pytest.approx([0.01, 0.01 * 3**0.5])
    assert json.loads(tfbus(*asked, "--json", "--at", "0").stdout)["sigmas"] == pytest.approx([0.1, 0.2, 0, 0, 0, 0.01])
    assert "yaw ±" in tfbus(*asked).stdout
    plain = write_mcap(tmp_path / "plain.mcap", [(0, "/tf", [moving("map", "base", 0)])])
    assert "taken as exact: map -> base" in tfbus("query", plain, "map", "base", "--sigmas").stderr
    check_wrong_call(tfbus("query", plain, "map", "base", "--sigmas", "--tum"), "--sigmas is for tables")

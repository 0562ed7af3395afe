"""Trajectories of TUM, KITTI and EuRoC: read as recordings, written, and read by evo."""

import math
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.recorded import real, write_mcap
from support.samples import moving, static
from support.strategies import transforms

from tfbus import SECOND, RecordingError, Transform, TransformArray
from tfbus.analysis import compare
from tfbus.recording import Edits, convert, load, open_recording, save_trajectory
from tfbus.recording.recording import Problems

EPOCH = 1_403_636_579_763_555_527
"""A stamp, in ns, that no float has."""
ENDINGS = (".tum", ".kitti", ".euroc")
TURN = Transform.from_axis_angle((0.0, 0.0, 1.0), math.pi / 2, (1.0, 2.0, 3.0))
H = repr(math.sqrt(0.5))

# The pose of TURN as each benchmark writes it.
LINES = {
    ".tum": f"# comment\n\n1403636579.763555527 1 2 3 0 0 {H} {H}\n",
    ".kitti": "0 -1 0 1 1 0 0 2 0 0 1 3\n",
    ".euroc": f"#timestamp [ns],p_RS_R_x [m]\n1403636579763555527,1,2,3,{H},0,0,{H},0.5,0.5,0.5,0,0,0,0,0,0\r\n",
}


@pytest.mark.parametrize("ending", ENDINGS)
def test_the_content_tells_the_format_and_stamps_are_exact(tmp_path: Path, ending: str) -> None:
    path = tmp_path / "groundtruth.txt"
    path.write_text(LINES[ending], newline="")
    with open_recording(path) as recording:
        assert (recording.count, recording.finished) == (1, True)
        [message] = recording.messages()
    [sample] = message.batch
    assert (sample.parent, sample.child, sample.static) == ("map", "base_link", False)
    assert sample.transform.is_close(TURN)
    assert sample.stamp == message.received == (0 if ending == ".kitti" else EPOCH)


@pytest.mark.parametrize(
    ("text", "stamp"),
    [
        ("1.403636579763555527e+09", EPOCH),
        ("12", 12 * SECOND),
        ("0.1234567894", 123_456_789),
        ("-0.5", -SECOND // 2),
        ("1e-9", 1),
    ],
)
def test_stamps_of_tum_are_decimal_numbers_of_seconds(tmp_path: Path, text: str, stamp: int) -> None:
    (tmp_path / "a.tum").write_text(f"{text} 1 2 3 0 0 0 1")
    stamps = load(tmp_path / "a.tum").samples("base_link").stamps
    assert stamps is not None
    assert stamps.tolist() == [stamp]


def test_poses_of_kitti_take_their_stamps_from_times_txt(tmp_path: Path) -> None:
    path, times = tmp_path / "00.txt", tmp_path / "times.txt"
    path.write_text(LINES[".kitti"] * 3)
    for content, stamps, remark in (
        (None, [0, SECOND // 10, SECOND // 5], "no times.txt: they are taken 0.1 s apart"),
        ("0.0 \n1.037875e-01\n0.207557\n", [0, 103_787_500, 207_557_000], None),
        ("0.0\n0.1\n", [0, SECOND // 10, SECOND // 5], "it has 2 stamps, and there are 3 poses"),
        ("a\nb\nc\n", [0, SECOND // 10, SECOND // 5], "b'a' is no stamp"),
    ):
        if content is not None:
            times.write_text(content)
        with open_recording(path) as recording:
            assert [sample.stamp for message in recording.messages() for sample in message.batch] == stamps
            assert remark in str(recording.remarks) if remark else not recording.remarks


BAD = ("0.5 1 2 3 0 0 0", "x 1 2 3 0 0 0 1", "0.5 1 2 nan 0 0 0 1", "0.5 1 2 3 0 0 0 2", "1e300 1 2 3 0 0 0 1", "0,5")


def test_a_line_that_is_no_pose_is_left_out_and_reported_with_its_number(tmp_path: Path) -> None:
    path = tmp_path / "a.tum"
    for bad in BAD:
        path.write_text(f"# head\n0.25 1 2 3 0 0 0 1\n{bad}\n0.75 1 2 3 0 0 0 1\n")
        problems = Problems()
        assert len(load(path, problems=problems).samples("base_link")) == 2
        assert problems == {"damaged": 1}
        assert problems.details == [
            f"line 3: expected stamp x y z qx qy qz qw, a unit quaternion; got {bad!r}",
        ]
    path.write_text("1 2 3 0 0 0 1 0\n" + "x\n" * 3_000)
    load(path, problems=(problems := Problems()))
    assert problems == {"damaged": 1_001}
    path.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 2 0 0 0 0 1 0\n")
    load(path, problems=(problems := Problems()))
    assert problems.details[0].startswith(
        "line 2: expected the 12 numbers of a matrix with a rotation; got '1 0 0 0 0 2"
    )
    path.write_text("1 2 3 0 0 0 1 0\n" + "9" * 5_000 + " 1 2 3 0 0 0 1\n3 1 2 3 0 0 0 1\n")
    load(path, problems=(problems := Problems()))
    assert "line 2: it is not read from here on: a line has at most 4,096 bytes" in problems.details[-1]


def test_another_text_is_refused_with_the_line_and_what_was_expected(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    for content, says in (
        ("# only\n", "no line but comments"),
        ("#a\n1 2 3\n", "line 2 is no pose, expected a line of TUM: stamp x y z qx qy qz qw, a unit quaternion; KITTI"),
        ("1,2,3\n", "EuRoC: stamp,x,y,z,qw,qx,qy,qz, the stamp in ns, a unit quaternion; got '1,2,3'"),
        ("x,y\n", "nor a trajectory of TUM, KITTI or EuRoC"),
    ):
        path.write_text(content)
        with pytest.raises(RecordingError, match=r"recording .*a\.txt") as caught:
            load(path)
        assert says in str(caught.value)


poses = st.lists(
    st.tuples(st.integers(0, 2**31 * SECOND - 1), transforms(1e3)), min_size=1, unique_by=lambda one: one[0]
)


@given(poses=poses)
def test_what_is_written_is_read_again(
    tmp_path_factory: pytest.TempPathFactory, poses: list[tuple[int, Transform]]
) -> None:
    poses.sort(key=lambda one: one[0])
    stamps = [stamp for stamp, _ in poses]
    path = TransformArray([each.translation for _, each in poses], [each.rotation for _, each in poses], stamps)
    for ending in ENDINGS:
        file = tmp_path_factory.mktemp("written") / f"a{ending}"
        save_trajectory(file, path)
        again = load(file, problems=Counter()).samples("base_link")
        if ending == ".kitti":
            assert again.matrices() == pytest.approx(path.matrices(), abs=1e-12)
        else:
            assert again.translations.tolist() == path.translations.tolist()
            assert again.rotations == pytest.approx(path.rotations, abs=1e-15)
            assert again.stamps is not None
            assert again.stamps.tolist() == stamps


def test_what_is_no_trajectory_is_not_written(tmp_path: Path) -> None:
    path = TransformArray([[0.0, 0.0, 0.0], [math.nan] * 3], [[0.0, 0.0, 0.0, 1.0], [math.nan] * 4], [1, 2])
    with pytest.raises(ValueError, match=r"transform 1 is NaN.*\[transforms.valid\]"):
        save_trajectory(tmp_path / "a.tum", path)
    with pytest.raises(ValueError, match=r"must end in \.tum, \.kitti, \.euroc, not 'a.txt'"):
        save_trajectory(tmp_path / "a.txt", path[:1])
    with pytest.raises(ValueError, match="no stamps"):
        save_trajectory(tmp_path / "a.tum", TransformArray(path.translations[:1], path.rotations[:1]))
    assert not list(tmp_path.iterdir())
    save_trajectory(tmp_path / "a.tum", path[:1])
    with pytest.raises(FileExistsError):
        save_trajectory(tmp_path / "a.tum", path[:1])
    save_trajectory(tmp_path / "a.tum", path[:1], overwrite=True)


def test_a_trajectory_becomes_a_recording_and_the_way_back_keeps_every_bit(tmp_path: Path) -> None:
    source = tmp_path / "a.tum"
    source.write_text(f"0.1 1 2 3 0 0 {H} {H}\n0.2 1e-300 -0.0 3 0 0 0 1.001\n")
    convert([source], tmp_path / "b.mcap", edits=Edits(rename={"map": "odom"}))
    assert load(tmp_path / "b.mcap").parent("base_link") == "odom"
    done = convert([tmp_path / "b.mcap"], tmp_path / "c.tum")
    assert (done.messages, done.problems) == (2, {})
    assert (tmp_path / "c.tum").read_text().splitlines() == [
        f"0.100000000 1.0 2.0 3.0 0.0 0.0 {H} {H}",
        "0.200000000 1e-300 -0.0 3.0 0.0 0.0 0.0 1.001",
    ]


def test_a_recording_of_several_moving_frames_is_no_trajectory(tmp_path: Path) -> None:
    lines = [
        (0, "/tf_static", [static("base", "laser")]),
        *(
            (k, "/tf", [moving("map", "base", k * SECOND, float(k)), moving("base", "arm", k * SECOND)])
            for k in range(3)
        ),
    ]
    source = write_mcap(tmp_path / "run.mcap", lines)
    with pytest.raises(ValueError, match="base in map, arm in base move: choose one by the name of its child frame"):
        convert([source], tmp_path / "a.tum")
    assert not (tmp_path / "a.tum").exists()
    done = convert([source], tmp_path / "a.tum", edits=Edits(frames=["base"]))
    assert len((tmp_path / "a.tum").read_text().splitlines()) == done.transforms == 3


def evo_reading(ending: str, path: Path) -> Any:
    interface = pytest.importorskip("evo.tools.file_interface")
    readers = {
        ".tum": interface.read_tum_trajectory_file,
        ".kitti": interface.read_kitti_poses_file,
        ".euroc": interface.read_euroc_csv_trajectory,
    }
    return readers[ending](path)


@pytest.mark.thorough
def test_evo_reads_what_is_written_and_finds_the_same_errors_in_a_real_recording(tmp_path: Path) -> None:
    metrics = pytest.importorskip("evo.core.metrics")
    tree = load(real("turtlesim.bag"))
    path = tree.samples("turtle2")
    assert path.stamps is not None
    rng = np.random.default_rng(1)
    drift = np.cumsum(rng.normal(scale=0.01, size=(len(path), 3)), axis=0)
    estimate = TransformArray(path.translations + drift, path.rotations, path.stamps)
    for ending in ENDINGS:
        save_trajectory(tmp_path / f"truth{ending}", path)
        theirs = evo_reading(ending, tmp_path / f"truth{ending}")
        assert theirs.positions_xyz == pytest.approx(path.translations)
        assert np.array(theirs.poses_se3) == pytest.approx(path.matrices(), abs=1e-9)
        if ending != ".kitti":
            assert theirs.timestamps == pytest.approx(path.stamps / 1e9, abs=1e-6)
        save_trajectory(tmp_path / f"slam{ending}", estimate)
        ours = compare(
            load(tmp_path / f"truth{ending}"), load(tmp_path / f"slam{ending}"), "map", "base_link", align=True
        )
        pair = theirs, evo_reading(ending, tmp_path / f"slam{ending}")
        pair[1].align(pair[0])
        for relation, values in (
            (metrics.PoseRelation.translation_part, ours.absolute.translation),
            (metrics.PoseRelation.rotation_angle_rad, ours.absolute.rotation),
        ):
            metric = metrics.APE(relation)
            metric.process_data(pair)
            assert values == pytest.approx(metric.error, abs=1e-7)
        # The way and the speed, as evo tells them.
        assert np.linalg.norm(np.diff(path.translations, axis=0), axis=1).sum() == pytest.approx(theirs.path_length)
    speeds = np.linalg.norm(tree.twist_many("turtle2", "world", path.stamps[1:]).linear, axis=1)
    assert speeds == pytest.approx(evo_reading(".tum", tmp_path / "truth.tum").speeds, rel=1e-4)

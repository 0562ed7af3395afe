"""The values that are drawn: series, lines of text, and arrivals."""

import numpy as np
import pytest
from support.samples import moving, over, static, tree_of

from tfbus import SECOND, Transform, TransformStamped, TransformTree
from tfbus.errors import UnknownFrameError
from tfbus.plot import read_series, sparklines
from tfbus.plot.plots import read_reception
from tfbus.recording import RecordedMessage


def test_the_angles_are_roll_pitch_and_yaw_in_degrees() -> None:
    tree = tree_of(TransformStamped("map", "base", 5, Transform.from_xyz_rpy((0, 0, 0), (0.1, -0.2, 3.0))))
    assert read_series(tree, "map", "base", samples=2).angles == pytest.approx(np.degrees([[0.1, -0.2, 3.0]] * 2))


def test_a_series_covers_what_all_edges_cover_at_equal_intervals() -> None:
    tree = tree_of(
        *over("map", "odom", (0, 10 * SECOND), speed=1e-9), *over("odom", "base", (2 * SECOND, 8 * SECOND), speed=1e-9)
    )
    series = read_series(tree, "map", "base", samples=4)
    assert series.stamps.tolist() == [2 * SECOND, 4 * SECOND, 6 * SECOND, 8 * SECOND]
    assert series.seconds.tolist() == [2.0, 4.0, 6.0, 8.0]
    assert series.translations[:, 0] == pytest.approx([4.0, 8.0, 12.0, 16.0])
    assert not series.static


def test_seconds_count_from_the_oldest_sample_of_any_frame() -> None:
    start = 1_700_000_000 * SECOND
    tree = tree_of(moving("map", "other", start), *over("map", "base", (start + SECOND, start + 3 * SECOND), speed=0.0))
    assert read_series(tree, "map", "base", samples=3).seconds.tolist() == [1.0, 2.0, 3.0]


def test_a_static_pose_is_drawn_over_the_whole_recording() -> None:
    tree = tree_of(*over("map", "base", (0, 4 * SECOND)), static("base", "lidar", 2.0))
    series = read_series(tree, "base", "lidar", samples=2)
    assert series.static
    assert series.seconds.tolist() == [0.0, 4.0]
    assert series.translations[:, 0].tolist() == [2.0, 2.0]


def test_there_is_no_value_where_the_frames_are_not_connected() -> None:
    tree = tree_of(*over("map", "base", (0, 2 * SECOND)), keep=None)
    tree.insert_many(over("world", "base", (4 * SECOND, 6 * SECOND)))
    series = read_series(tree, "world", "base", samples=7)
    assert np.isnan(series.translations[:, 0]).tolist() == [True] * 4 + [False] * 3


def test_an_unknown_frame_and_too_few_samples_are_errors() -> None:
    with pytest.raises(UnknownFrameError):
        read_series(TransformTree(), "map", "base")
    with pytest.raises(ValueError, match="two samples"):
        read_series(tree_of(static("map", "base")), "map", "base", samples=1)


def test_a_single_sample_is_a_series_at_its_stamp() -> None:
    tree = tree_of(TransformStamped("map", "base", 5, Transform((1.0, 0.0, 0.0))))
    series = read_series(tree, "map", "base", samples=2)
    assert series.stamps.tolist() == [5, 5]
    assert series.translations[:, 0].tolist() == [1.0, 1.0]


def test_each_coordinate_has_a_line_from_its_least_to_its_greatest_value() -> None:
    series = read_series(tree_of(*over("map", "base", (0, 7 * SECOND), speed=1e-9)), "map", "base")
    lines = sparklines(series, width=8).split("\n")
    assert lines[0] == "base in map, 0.000 s to 7.000 s"
    assert lines[1] == "    x  ▁▂▃▄▅▆▇█  0.000 to 7.000 m"
    assert lines[2] == "    y  ▁▁▁▁▁▁▁▁  0.000 to 0.000 m"
    assert [line.split()[0] for line in lines[1:]] == ["x", "y", "z", "roll", "pitch", "yaw"]
    assert lines[6].endswith("deg")


def test_there_is_a_blank_where_there_is_no_answer() -> None:
    tree = tree_of(*over("map", "base", (0, 2 * SECOND)), static("world", "anchor"), keep=None)
    tree.insert_many([moving("world", "base", 4 * SECOND, 1.0), moving("world", "base", 6 * SECOND, 2.0)])
    assert sparklines(read_series(tree, "world", "base", samples=7), width=7).split("\n")[1] == (
        "    x      ▁▅█  1.000 to 2.000 m"
    )


def test_a_line_has_at_least_one_letter() -> None:
    series = read_series(tree_of(*over("map", "base", (0, SECOND))), "map", "base")
    with pytest.raises(ValueError, match="letter"):
        sparklines(series, width=0)
    assert "▁" in sparklines(series, width=1)


def test_each_frame_has_its_stamps_and_the_times_of_their_arrival() -> None:
    messages = [
        RecordedMessage(5 * SECOND, (moving("map", "b", 4 * SECOND), static("b", "lidar")), ()),
        RecordedMessage(7 * SECOND, (moving("map", "b", 6 * SECOND), moving("map", "a", 7 * SECOND)), ()),
        RecordedMessage(8 * SECOND, (moving("map", "b", 6 * SECOND),), ()),
    ]
    reception = read_reception(messages)
    assert list(reception) == ["a", "b", "lidar"]
    assert reception["b"].stamps.tolist() == [4 * SECOND, 6 * SECOND, 6 * SECOND]
    assert reception["b"].received.tolist() == [5 * SECOND, 7 * SECOND, 8 * SECOND]
    assert reception["b"].periods.tolist() == [2.0]
    assert reception["b"].delays.tolist() == [1.0, 1.0, 2.0]
    assert [reception[frame].static for frame in ("a", "b", "lidar")] == [False, False, True]
    assert reception["lidar"].periods.tolist() == reception["lidar"].delays.tolist() == []

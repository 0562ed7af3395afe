import pytest

from tfbus import SECOND, Edge
from tfbus.cli.tree_display import TreeDisplay, draw
from tfbus.tree.rendering import describe

MOVING = Edge("map", "base_link", False, 101, 2 * SECOND, 4 * SECOND, "odometry")
STATIC = Edge("base_link", "lidar", True, 1, None, None, "")
SINGLE = Edge("base_link", "arm", False, 1, 3 * SECOND, 3 * SECOND, "driver")
EDGES = [SINGLE, MOVING, STATIC]


def styles(edges: list[Edge], now: int) -> dict[str, str]:
    """How each piece of the picture is drawn."""
    return {line.plain[span.start : span.end]: str(span.style) for line in draw(edges, now) for span in line.spans}


def test_it_is_the_picture_that_a_buffer_gives_of_itself() -> None:
    assert [line.plain for line in draw(EDGES, 5 * SECOND)] == describe(EDGES, 5 * SECOND).split("\n")


def test_names_of_any_width_stand_in_columns() -> None:
    wide, narrow = draw(
        [Edge("map", "雷达", True, 1, None, None, ""), Edge("map", "odom", True, 1, None, None, "")], 0
    )[1:]
    assert (wide.plain, narrow.plain) == ("├── 雷达  static", "└── odom  static")


def test_nothing_is_lost_however_deep_it_hangs(capsys: pytest.CaptureFixture[str]) -> None:
    chain = [Edge(f"frame{level}", f"frame{level + 1}", True, 1, None, None, "robot") for level in range(50)]
    with TreeDisplay(live=False) as display:
        display.show(chain, 0)
    assert capsys.readouterr().out == describe(chain, 0) + "\n"


def test_a_frame_that_has_been_silent_for_more_than_a_second_stands_out() -> None:
    assert styles([MOVING], 5 * SECOND)["age 1 s"] == "green"
    assert styles([MOVING], 5 * SECOND + 1)["age 1 s"] == "red"


def test_names_cannot_control_the_terminal_or_the_style() -> None:
    evil = Edge("map", "[red]\x1b[2J\n:smile:", True, 1, None, None, "\x1b]0;title\x07")
    (_, line) = draw([evil], 0)
    assert line.plain == "└── [red]\\x1b[2J\\n:smile:  static  from '\\x1b]0;title\\x07'"


def test_without_lines_to_draw_with_there_are_letters() -> None:
    assert [line.plain for line in draw(EDGES, 5 * SECOND, ascii_only=True)][1:] == [
        "`-- base_link  50.0 Hz  age 1 s  span 2 s  from 'odometry'",
        "    |-- arm    one sample  age 2 s  span 0 ns  from 'driver'",
        "    `-- lidar  static",
    ]


def test_a_tree_without_frames_says_so() -> None:
    assert [line.plain for line in draw([], 0)] == ["(no frames)"]

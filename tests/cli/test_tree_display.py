"""The tree of frames as it is drawn."""

import sys

import pytest
from support.commands import Terminal

from tfbus import SECOND, Edge
from tfbus.cli.tree_display import TreeDisplay, tree_lines
from tfbus.tree.rendering import describe

MOVING = Edge("map", "base_link", False, 101, 2 * SECOND, 4 * SECOND, "odometry")
STATIC = Edge("base_link", "lidar", True, 1, None, None, "")
SINGLE = Edge("base_link", "arm", False, 1, 3 * SECOND, 3 * SECOND, "driver")
EDGES = [SINGLE, MOVING, STATIC]
HIDE_CURSOR, SHOW_CURSOR = "\x1b[?25l", "\x1b[?25h"


def styles(edges: list[Edge], now: int) -> dict[str, str]:
    """The style of each styled piece of the tree."""
    return {
        line.plain[span.start : span.end]: str(span.style) for line in tree_lines(edges, now) for span in line.spans
    }


def test_the_tree_is_the_one_that_a_buffer_describes() -> None:
    assert [line.plain for line in tree_lines(EDGES, 5 * SECOND)] == describe(EDGES, 5 * SECOND).split("\n")


def test_columns_are_aligned_whatever_the_width_of_the_letters() -> None:
    wide, narrow = tree_lines(
        [Edge("map", "雷达", True, 1, None, None, ""), Edge("map", "odom", True, 1, None, None, "")], 0
    )[1:]
    assert (wide.plain, narrow.plain) == ("├── 雷达  static", "└── odom  static")


@pytest.mark.parametrize("environment", [{}, {"NO_COLOR": "1"}])
def test_on_a_terminal_a_live_tree_is_redrawn_in_place_with_the_cursor_shown_and_in_colour_unless_forbidden(
    monkeypatch: pytest.MonkeyPatch, environment: dict[str, str]
) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stdout", terminal)
    for name, value in ({"TERM": "xterm-256color", "NO_COLOR": ""} | environment).items():
        monkeypatch.setenv(name, value)
    monkeypatch.delenv("FORCE_COLOR", raising=False)
    with TreeDisplay(live=True) as display:
        assert terminal.getvalue().endswith(SHOW_CURSOR)
        display.show([MOVING], 0)
        display.show([MOVING], 0)
    shown = terminal.getvalue()
    assert shown.count("base_link") >= 2
    # The second drawing begins one line up, at the first of the two lines.
    assert "\x1b[1A" in shown
    assert ("\x1b[36m" in shown) is not bool(environment)
    assert shown.rindex(SHOW_CURSOR) > shown.rindex(HIDE_CURSOR)


def test_a_frame_without_a_sample_for_more_than_a_second_is_red() -> None:
    assert styles([MOVING], 5 * SECOND)["age 1 s"] == "green"
    assert styles([MOVING], 5 * SECOND + 1)["age 1 s"] == "red"


def test_frame_names_cannot_control_the_terminal_or_the_style() -> None:
    evil = Edge("map", "[red]\x1b[2J\n:smile:", True, 1, None, None, "\x1b]0;title\x07")
    (_, line) = tree_lines([evil], 0)
    assert line.plain == "└── [red]\\x1b[2J\\n:smile:  static  from '\\x1b]0;title\\x07'"


def test_the_branches_can_be_drawn_in_ascii() -> None:
    assert [line.plain for line in tree_lines(EDGES, 5 * SECOND, ascii_only=True)][1:] == [
        "`-- base_link  50.0 Hz  age 1 s  span 2 s  from 'odometry'",
        "    |-- arm    one sample  age 2 s  span 0 ns  from 'driver'",
        "    `-- lidar  static",
    ]


ARM = [
    Edge("base", "shoulder_pan_link", False, 11, 0, SECOND, "a_very_long_sender_of_joint_states"),
    Edge("shoulder_pan_link", "elbow", False, 11, 0, SECOND, "a_very_long_sender_of_joint_states"),
]


@pytest.mark.parametrize(
    ("width", "last"),
    [
        (200, "    └── elbow          10.0 Hz  age 1 s  span 1 s  from 'a_very_long_sender_of_joint_states'"),
        (70, "    └── elbow          10.0 Hz  age 1 s  span 1 s  from 'a_v…t_states'"),
        (63, "    └── elbow          10.0 Hz  age 1 s  span 1 s  from …tates'"),
        (50, "    └── elbow          10.0 Hz  age 1 s  span 1 s"),
        (47, "  └ elbow            10.0 Hz  age 1 s  span 1 s"),
        (40, "  └ elbow            10.0 Hz  age 1 s"),
        (36, " └elbow             10.0 Hz  age 1 s"),
        (31, " └elbow        10.0 Hz  age 1 s"),
    ],
)
def test_where_it_does_not_fit_it_keeps_frame_rate_and_age(width: int, last: str) -> None:
    lines = [line.plain for line in tree_lines(ARM, 2 * SECOND, width=width)]
    assert max(map(len, lines)) <= width
    assert lines[-1] == last


def test_of_a_tree_that_is_deeper_than_the_terminal_is_wide_the_nearest_levels_are_drawn() -> None:
    chain = [Edge(f"frame{level}", f"frame{level + 1}", True, 1, None, None, "") for level in range(50)]
    lines = [line.plain for line in tree_lines(chain, 0, width=40)]
    assert max(map(len, lines)) <= 40
    assert lines[-1].split() == ["…", "└frame50", "static"]


def test_a_live_tree_that_is_higher_than_the_terminal_says_how_many_frames_do_not_fit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stdout", terminal)
    for name, value in (("TERM", "xterm"), ("COLUMNS", "80"), ("LINES", "5")):
        monkeypatch.setenv(name, value)
    wide = [Edge("map", f"f{number}", True, 1, None, None, "") for number in range(9)]
    with TreeDisplay(live=True) as display:
        display.show(wide[:3], 0)
        assert "more than fit" not in terminal.getvalue()
        display.show(wide, 0)
    shown = terminal.getvalue()
    # Ten lines, four of which fit above the cursor's; one of them says so.
    assert "… and 7 lines more than fit" in shown
    assert ("f1" in shown, "f2" in shown) == (True, True)
    assert "f3" not in shown

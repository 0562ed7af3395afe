import re
from html import unescape

from support.samples import moving, static, tree_of

from tfbus import SECOND, Buffer, Bus, Edge, SimulatedClock
from tfbus.tree.history import EdgeState
from tfbus.tree.rendering import legend, to_html

EDGES = [
    Edge("map", "base", False, 101, 2 * SECOND, 4 * SECOND, "odometry"),
    Edge("base", "lidar", True, 1, None, None, "driver"),
]


def plain(html: str) -> list[str]:
    """The lines without their elements."""
    return [unescape(re.sub("<[^>]*>", "", line)).rstrip() for line in html.split("\n")]


def test_the_tree_has_a_line_with_the_facts_of_each_frame() -> None:
    assert plain(to_html(EDGES, 5 * SECOND)) == [
        "map",
        "└── base       50.0 Hz  age 1 s  span 2 s  from 'odometry'",
        "    └── lidar  static  from 'driver'",
    ]


def test_the_facts_can_be_left_out() -> None:
    assert plain(to_html(EDGES, 0, with_facts=False)) == ["map", "└── base", "    └── lidar"]


def test_frames_have_the_colour_of_their_state() -> None:
    root, base, lidar = to_html(EDGES, 9 * SECOND).split("\n")
    assert f'color: {EdgeState.STALE.value}">base<' in base
    assert f'color: {EdgeState.STATIC.value}">lidar<' in lidar
    assert "; color" not in root


def test_the_age_from_which_frames_are_stale_can_be_chosen() -> None:
    for stale_after, state in ((1.0, EdgeState.MOVING), (0.9, EdgeState.STALE)):
        assert f'color: {state.value}">base<' in to_html(EDGES, 5 * SECOND, stale_after)


def test_marked_frames_stand_out() -> None:
    lines = to_html(EDGES, 0, marked=("lidar",)).split("\n")
    assert ["background" in line for line in lines] == [False, False, True]


def test_names_and_authorities_cannot_become_elements() -> None:
    evil = "<script>alert('&')</script>"
    html = to_html([Edge(evil, f"{evil}2", False, 1, 0, 0, evil)], 0)
    assert "<script" not in html
    assert html.count("&lt;script&gt;") == 3


def test_an_empty_tree_has_a_text() -> None:
    assert plain(to_html([], 0)) == ["(no frames)"]


def test_the_legend_names_every_state_in_its_colour() -> None:
    for state in EdgeState:
        assert f'color: {state.value}">\u25cf {state.name.lower()}<' in legend()


def test_a_tree_in_a_notebook_counts_ages_from_its_newest_stamp() -> None:
    tree = tree_of(moving("map", "base", 5 * SECOND), moving("map", "arm", 3 * SECOND))
    html = tree._repr_html_()
    assert "age 0 ns" in html
    assert "age 2 s" in html
    assert "static" in html


def test_a_buffer_in_a_notebook_has_its_own_names_and_ages_by_the_clock() -> None:
    bus = Bus(SimulatedClock(9 * SECOND))
    with Buffer(bus, prefix="robot1/") as buffer:
        bus.publish([moving("robot1/map", "robot1/base", 5 * SECOND), static("robot1/base", "lidar")])
        html = buffer._repr_html_()
    assert ">base<" in html
    assert "age 4 s" in html

""""""

import ast
import json
import re
import shutil
import subprocess
from dataclasses import replace
from html import unescape
from typing import Any
from xml.etree import ElementTree as ET

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.samples import moving, static, tree_of
from support.strategies import TODAY, frame_names

from tfbus import SECOND, Buffer, Bus, Edge, SimulatedClock, Transform, TransformStamped, TransformTree
from tfbus.tree.history import EdgeState
from tfbus.tree.rendering import describe, legend, to_dot, to_html, to_yaml

MOVING = Edge("map", "base_link", False, 101, 2 * SECOND, 4 * SECOND, "odometry")
STATIC = Edge("base_link", "lidar", True, 1, None, None, "")
SINGLE = Edge("base_link", "arm", False, 1, 3 * SECOND, 3 * SECOND, "driver")
EMPTY = Edge("base_link", "tool", False, 0, None, None, "")
EDGES = [SINGLE, MOVING, STATIC, EMPTY]


def edge(parent: str, child: str) -> Edge:
    return replace(STATIC, parent=parent, child=child)


def labels(picture: str) -> list[str]:
    """The frames of a picture without facts, in the order of their lines."""
    return [re.sub(r"^[│├└─ ]*", "", line).removesuffix("  static").rstrip() for line in picture.split("\n")]


# Text


def test_the_text_has_a_line_with_the_facts_of_each_frame() -> None:
    assert describe(EDGES).split("\n") == [
        "map",
        "└── base_link  50.0 Hz  age 0 ns  span 2 s  from 'odometry'",
        "    ├── arm    one sample  age 1 s  span 0 ns  from 'driver'",
        "    ├── lidar  static",
        "    └── tool   no samples",
    ]


def test_a_branch_that_continues_is_drawn_beside_its_descendants() -> None:
    picture = describe([edge("map", "a"), edge("a", "b"), edge("map", "c")])
    assert picture.split("\n") == ["map", "├── a      static", "│   └── b  static", "└── c      static"]


def test_an_empty_tree_has_a_text_and_an_empty_yaml() -> None:
    tree = TransformTree()
    assert tree.describe() == "(no frames)"
    assert tree.to_yaml() == "{}\n"
    assert tree.to_dot() == "digraph tf {\n}\n"


def test_several_trees_are_drawn_one_below_the_other_and_a_loop_once_with_a_mark() -> None:
    assert labels(describe([edge("odom", "base"), edge("map", "anchor")])) == ["map", "anchor", "odom", "base"]
    assert labels(describe([edge("b", "a"), edge("a", "b"), edge("map", "c")])) == ["map", "c", "a (in a loop)", "b"]


@given(st.dictionaries(st.sampled_from("abcdefgh"), st.sampled_from("abcdefgh"), max_size=8))
def test_every_frame_of_any_graph_is_drawn_once_and_only_those_in_loops_are_marked(parents: dict[str, str]) -> None:
    picture = describe([edge(parent, child) for child, parent in sorted(parents.items())])
    drawn = [label.removesuffix(" (in a loop)") for label in labels(picture)]
    assert sorted(drawn) == sorted({*parents, *parents.values()} or {"(no frames)"})
    named = {label.removesuffix(" (in a loop)") for label in labels(picture) if label.endswith(" (in a loop)")}
    for frame in named:
        above = parents[frame]
        for _ in parents:
            if above != frame:
                above = parents[above]
        assert above == frame


def test_a_chain_of_two_thousand_frames_is_drawn_without_recursion_and_with_a_bounded_indent() -> None:
    lines = describe([edge(f"{depth:05}", f"{depth + 1:05}") for depth in range(2_000)]).splitlines()
    assert len(lines) == 2_001
    assert lines[64].startswith("    " * 63 + "└── 00064")
    assert lines[70].startswith("…   " + "    " * 62 + "└── 00070")
    assert lines[2_000].startswith("…   " + "    " * 62 + "└── 02000")


# Graphviz


def test_graphviz_has_an_arrow_for_each_edge_with_rate_and_authority() -> None:
    assert to_dot(EDGES).split("\n") == [
        "digraph tf {",
        '    "base_link" -> "arm" [label="one sample\\ndriver"];',
        '    "map" -> "base_link" [label="50.0 Hz\\nodometry"];',
        '    "base_link" -> "lidar" [label="static", style=dashed];',
        '    "base_link" -> "tool" [label="no samples"];',
        "}",
        "",
    ]


@given(frame_names(), frame_names(), frame_names())
def test_graphviz_escapes_every_name(parent: str, child: str, authority: str) -> None:
    text = to_dot([replace(STATIC, parent=parent, child=child, authority=authority)])
    quoted = r'"(?:[^"\\\n]|\\.)*"'
    names = rf"(?:    {quoted} \[label={quoted}\];\n){{0,2}}"
    edge = rf"    {quoted} -> {quoted} \[label={quoted}, style=dashed\];\n"
    assert re.fullmatch(rf"digraph tf {{\n{edge}{names}}}\n", text)
    assert all(line.isprintable() for line in text.split("\n"))


def drawn_by_graphviz(*edges: Edge) -> str:
    """All texts of the picture, as SVG has them."""
    if shutil.which("dot") is None:
        pytest.skip("Graphviz is not installed")
    svg = subprocess.run(["dot", "-Tsvg"], input=to_dot(edges).encode(), capture_output=True, check=True).stdout
    return "\n".join(element.text or "" for element in ET.fromstring(svg).iter() if element.tag.endswith("}text"))


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("a\nb", r"a\nb"),
        ("\u202egpj", r"\u202egpj"),
        ("a\u200bb", r"a\u200bb"),
        ("\x1b[2J", r"\x1b[2J"),
        ("a&#8238;b", "a&#8238;b"),
        ("<b>\\N</b>", "<b>\\N</b>"),
    ],
)
def test_graphviz_shows_a_name_in_one_line_with_its_control_characters_escaped(name: str, shown: str) -> None:
    assert drawn_by_graphviz(replace(STATIC, parent="map", child=name, authority=name)) == "\n".join(
        ["map", shown, "static", shown]
    )


# YAML


def parsed(text: str) -> dict[str, dict[str, Any]]:
    """The YAML of frames: blocks of one level, whose texts are those of Python, and whose other values are JSON."""

    def read(value: str) -> Any:
        return ast.literal_eval(value) if value.startswith('"') else json.loads(value)

    frames: dict[str, dict[str, Any]] = {}
    frame = ""
    for line in text.removesuffix("\n").split("\n"):
        if line.startswith("  "):
            key, _, value = line.strip().partition(": ")
            frames[frame][key] = read(value)
        else:
            assert line.endswith(":")
            frame = read(line[:-1])
            frames[frame] = {}
    return frames


def test_yaml_has_the_keys_of_tf2_and_stamps_in_seconds() -> None:
    newest_oldest_length = "most_recent_transform", "oldest_transform", "buffer_length"
    keys = "parent", "broadcaster", "static", "rate", *newest_oldest_length
    facts = {
        "arm": ("base_link", "driver", False, None, 3.0, 3.0, 0.0),
        "base_link": ("map", "odometry", False, 50.0, 4.0, 2.0, 2.0),
        "lidar": ("base_link", "", True, None, None, None, None),
        "tool": ("base_link", "", False, None, None, None, None),
    }
    assert parsed(to_yaml(EDGES)) == {frame: dict(zip(keys, values, strict=True)) for frame, values in facts.items()}


def test_yaml_keeps_the_nanoseconds_of_stamps_of_today() -> None:
    text = to_yaml([replace(MOVING, oldest=TODAY + 1, newest=TODAY + 2 * SECOND + 4)])
    seconds = TODAY // SECOND
    assert f"  oldest_transform: {seconds}.000000001\n" in text
    assert f"  most_recent_transform: {seconds + 2}.000000004\n" in text
    assert "  buffer_length: 2.000000003\n" in text


def test_yaml_numbers_are_numbers_for_a_yaml_1_1_parser() -> None:
    text = to_yaml([replace(MOVING, samples=2, oldest=0, newest=10_000)])
    assert "  buffer_length: 0.00001\n" in text
    assert "  most_recent_transform: 0.00001\n" in text


@given(frame_names(), frame_names(), frame_names())
def test_yaml_round_trips_every_name(parent: str, child: str, authority: str) -> None:
    text = to_yaml([replace(STATIC, parent=parent, child=child, authority=authority)])
    facts = parsed(text)[child]
    assert (facts["parent"], facts["broadcaster"]) == (parent, authority)


@pytest.mark.parametrize("length", [1, 1_000, *range(1_020, 1_027), pytest.param(100_000, marks=pytest.mark.thorough)])
@pytest.mark.parametrize("letter", ["a", "é", "\u202e", "\U000e0001", "\\"])
def test_pyyaml_reads_names_of_any_length_back(letter: str, length: int) -> None:
    yaml: Any = pytest.importorskip("yaml")
    name = letter * length
    read = yaml.safe_load(to_yaml([replace(STATIC, parent=name, child=name, authority=name), edge(name, "tool")]))
    assert list(read) == [name, "tool"]
    assert (read[name]["parent"], read[name]["broadcaster"], read["tool"]["parent"]) == (name, name, name)


# The tree


def test_a_tree_draws_its_own_edges() -> None:
    tree = TransformTree()
    for tenth in range(11):
        tree.insert(TransformStamped("map", "base_link", tenth * SECOND // 10, Transform(), "odometry"))
    tree.insert(TransformStamped("base_link", "lidar", 0, Transform(), static=True))
    assert tree.describe(now=SECOND * 3 // 2).split("\n") == [
        "map",
        "└── base_link  10.0 Hz  age 500 ms  span 1 s  from 'odometry'",
        "    └── lidar  static",
    ]
    assert tree.to_dot().count("->") == 2
    assert set(parsed(tree.to_yaml())) == {"base_link", "lidar"}


@pytest.mark.parametrize(
    ("samples", "seconds", "rate"),
    [(2, 50, "0.02 Hz"), (2, 3, "0.33 Hz"), (100, 100, "0.99 Hz"), (101, 100, "1.0 Hz"), (125, 100, "1.2 Hz")],
)
def test_a_rate_has_two_digits_and_that_of_a_slow_edge_is_not_zero(samples: int, seconds: int, rate: str) -> None:
    edge = Edge("map", "dock", static=False, samples=samples, oldest=0, newest=seconds * SECOND, authority="")
    assert describe([edge]).split("  ")[1] == rate


def test_dot_with_a_stamp_shows_all_facts_in_the_colour_of_the_state() -> None:
    lines = to_dot(EDGES, 5 * SECOND, {"base_link": 0.012}).split("\n")
    assert (
        '    "map" -> "base_link" '
        r'[label="50.0 Hz\nage 1 s\nspan 2 s\nodometry\ndelay 12 ms", color="#009e73", fontcolor="#009e73"];'
    ) in lines
    assert '    "base_link" -> "lidar" [label="static", style=dashed, color="#0072b2", fontcolor="#0072b2"];' in lines
    assert any('"arm" [label="one sample' in line and "#d55e00" in line for line in lines)
    assert any('"tool" [label="no samples", color="#767676"' in line for line in lines)
    assert to_dot(EDGES, None, {"base_link": 0.012}) == to_dot(EDGES)


TWO_EDGES = [
    Edge("map", "base", False, 101, 2 * SECOND, 4 * SECOND, "odometry"),
    Edge("base", "lidar", True, 1, None, None, "driver"),
]


def plain(html: str) -> list[str]:
    """The lines without their elements."""
    return [unescape(re.sub("<[^>]*>", "", line)).rstrip() for line in html.split("\n")]


def test_the_tree_has_a_line_with_the_facts_of_each_frame() -> None:
    assert plain(to_html(TWO_EDGES, 5 * SECOND)) == [
        "map",
        "└── base       50.0 Hz  age 1 s  span 2 s  from 'odometry'",
        "    └── lidar  static  from 'driver'",
    ]
    assert plain(to_html([], 0)) == ["(no frames)"]


def test_frames_have_the_colour_of_their_state() -> None:
    root, base, lidar = to_html(TWO_EDGES, 9 * SECOND).split("\n")
    assert f'color: {EdgeState.STALE.value}">base<' in base
    assert f'color: {EdgeState.STATIC.value}">lidar<' in lidar
    assert "; color" not in root


def test_the_age_from_which_frames_are_stale_can_be_chosen_and_one_ahead_of_the_clock_is_not_stale() -> None:
    cases = ((5, 1.0, EdgeState.MOVING), (5, 0.9, EdgeState.STALE), (3, 0.1, EdgeState.MOVING))
    for now, stale_after, state in cases:
        assert f'color: {state.value}">base<' in to_html(TWO_EDGES, now * SECOND, stale_after)


def test_names_and_authorities_cannot_become_elements() -> None:
    evil = "<script>alert('&')</script>"
    html = to_html([Edge(evil, f"{evil}2", False, 1, 0, 0, evil)], 0)
    assert "<script" not in html
    assert html.count("&lt;script&gt;") == 3


def test_the_legend_names_every_state_in_its_colour() -> None:
    for state in EdgeState:
        assert f'color: {state.value}">\u25cf {state.name.lower()}<' in legend()


def in_a_notebook(value: object) -> str:
    """The page that a notebook shows for a value."""
    formatters = pytest.importorskip("IPython.core.formatters", reason="a notebook needs IPython")
    html: str = formatters.HTMLFormatter()(value)
    return html


def test_a_tree_in_a_notebook_counts_ages_from_its_newest_stamp() -> None:
    tree = tree_of(moving("map", "base", 5 * SECOND), moving("map", "arm", 3 * SECOND))
    html = in_a_notebook(tree)
    assert "age 0 ns" in html
    assert "age 2 s" in html
    assert "static" in html


def test_a_buffer_in_a_notebook_has_its_own_names_and_ages_by_the_clock() -> None:
    bus = Bus(SimulatedClock(9 * SECOND))
    with Buffer(bus, prefix="robot1/") as buffer:
        bus.publish([moving("robot1/map", "robot1/base", 5 * SECOND), static("robot1/base", "lidar")])
        html = in_a_notebook(buffer)
    assert ">base<" in html
    assert "age 4 s" in html

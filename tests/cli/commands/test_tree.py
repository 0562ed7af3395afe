"""``tfbus tree``."""

import json
import os
import shutil
from pathlib import Path

import pytest
from support.commands import START, Command, check_wrong_call
from support.recorded import write_mcap
from support.samples import moving, static

from tfbus import SECOND, Bus


async def publish(bus: Bus) -> None:
    """A camera that is static, and after 2 s a laser at 10 Hz; their parent is the base."""
    bus.publish(static("base", "camera", authority="me"))
    await bus.clock.sleep(2.0)
    async for _ in bus.clock.ticks(10.0):
        bus.publish(moving("base", "laser", bus.clock.now(), authority="driver"))


@pytest.mark.parametrize("backend", ["asyncio", "trio"])
def test_the_tree_is_shown_after_the_duration_and_written_for_graphviz(
    tfbus: Command, backend: str, tmp_path: Path
) -> None:
    dot = tmp_path / "frames.dot"
    done = tfbus.on_domain(publish, "tree", "--duration", "2.45", "--dot", dot, "--backend", backend)
    assert (done.returncode, done.stderr) == (0, "")
    # Samples of 102 s to 102.4 s, seen at 102.45 s.
    assert done.stdout.splitlines() == [
        "base",
        "├── camera  static  from 'me'",
        "└── laser   10.0 Hz  age 50 ms  span 400 ms  from 'driver'",
    ]
    first, *edges, last = dot.read_text().splitlines()
    assert (first, last) == ("digraph tf {", "}")
    assert [edge.partition(" [")[0].strip() for edge in edges] == ['"base" -> "camera"', '"base" -> "laser"']


@pytest.mark.skipif(shutil.which("dot") is None, reason="Graphviz is not installed")
def test_the_picture_has_every_fact_of_each_edge(tfbus: Command, tmp_path: Path) -> None:
    async def publish_late(bus: Bus) -> None:
        bus.publish(static("base", "bäse", authority="me"))
        async for _ in bus.clock.ticks(10.0):
            bus.publish(moving("base", "laser", bus.clock.now() - SECOND // 50, authority="driver"))

    svg, pdf, png = (tmp_path / f"frames.{kind}" for kind in ("svg", "pdf", "png"))
    done = tfbus.on_domain(publish_late, "tree", "--duration", "1.05", "--svg", svg, "--pdf", pdf, "--png", png)
    assert (done.returncode, done.stderr) == (0, "")
    drawn = svg.read_text(encoding="utf-8")
    texts = ["base", "bäse", "static", "me", "laser", "10.0 Hz", "driver", "delay 20 ms"]
    assert [text for text in texts if f">{text}<" not in drawn] == []
    assert "#009e73" in drawn
    assert (pdf.read_bytes()[:4], png.read_bytes()[:4]) == (b"%PDF", b"\x89PNG")


def test_by_default_it_listens_for_a_second_and_json_has_each_frame_with_null_for_missing_values(
    tfbus: Command,
) -> None:
    done = tfbus.on_domain(publish, "tree", "--json", "--domain", "yard")
    assert done.returncode == 0
    nothing = {"rate": None, "age": None, "span": None}
    assert json.loads(done.stdout) == {
        "domain": "yard",
        "stamp": 101 * SECOND,
        "frames": {
            "base": {"parent": None, "kind": "root", **nothing, "authority": None},
            "camera": {"parent": "base", "kind": "static", **nothing, "authority": "me"},
        },
    }
    # For people: an indented document.
    assert len(done.stdout.splitlines()) > 10
    done = tfbus.on_domain(publish, "tree", "--json", "--duration", "2.45")
    laser = {"parent": "base", "kind": "moving", "rate": 10.0, "age": 0.05, "span": 0.4, "authority": "driver"}
    assert json.loads(done.stdout)["frames"]["laser"] == laser


def test_watched_it_is_printed_again_and_again(tfbus: Command) -> None:
    async def publish_for_a_second(bus: Bus) -> None:
        bus.publish(static("map", "odom"))
        await bus.clock.sleep(0.75)
        bus.publish(static("odom", "base"))
        await bus.clock.sleep(0.5)

    def watch(*options: str) -> str:
        done = tfbus.on_domain(publish_for_a_second, "tree", "--watch", "--rate", "2", *options)
        assert (done.returncode, done.stderr) == (130, "")
        return done.stdout

    before = "map\n└── odom  static\n\n"
    after = "map\n└── odom      static\n    └── base  static\n\n"
    assert watch() == before + before + after
    documents = [json.loads(line) for line in watch("--json").splitlines()]
    assert [document["stamp"] - START for document in documents] == [0, SECOND // 2, SECOND]
    assert [len(document["frames"]) for document in documents] == [2, 2, 3]


def test_it_listens_until_each_frame_was_heard_twice_and_all_are_connected(tfbus: Command) -> None:
    async def publish_slowly(bus: Bus) -> None:
        bus.publish([static("base", "camera"), static("odom_combined", "anchor")])
        async for _ in bus.clock.ticks(0.5):
            bus.publish(moving("odom_combined", "base", bus.clock.now()))

    done = tfbus.on_domain(publish_slowly, "tree")
    assert (done.returncode, done.stderr) == (0, "")
    # The first tick is at once, the second one after 2 s.
    assert done.stdout.splitlines()[:3] == [
        "odom_combined",
        "├── anchor      static",
        "└── base        0.5 Hz  age 0 ns  span 2 s",
    ]


def test_it_says_what_it_could_not_see_within_five_seconds(tfbus: Command) -> None:
    async def publish_once(bus: Bus) -> None:
        bus.publish([static(f"root{number}", f"leaf{number}") for number in range(6)])
        await bus.clock.sleep(0.5)
        bus.publish(moving("root0", "laser", bus.clock.now()))
        await bus.clock.sleep(60.0)

    done = tfbus.on_domain(publish_once, "tree", "--json")
    assert json.loads(done.stdout)["stamp"] == START + 5 * SECOND
    assert done.stderr.splitlines() == [
        "one sample only, so the rate is not known: laser",
        "6 trees, below root0, root1, root2, root3, root4 and 1 more: no edge between them was sent meanwhile",
    ]
    # A duration that is given is kept.
    assert json.loads(tfbus.on_domain(publish_once, "tree", "--json", "--duration", "2").stdout)["stamp"] == (
        START + 2 * SECOND
    )


def test_the_tree_of_a_recording_is_shown_with_ages_before_its_newest_stamp(tfbus: Command, tmp_path: Path) -> None:
    lines = [(number * SECOND, "/tf", [moving("map", "base", number * SECOND)]) for number in range(3)]
    lines += [(SECOND, "/tf_static", [static("base", "laser")]), (SECOND, "/tf", [moving("map", "slow", SECOND)])]
    path, dot = write_mcap(tmp_path / "run.mcap", lines), tmp_path / "frames.dot"
    done = tfbus("tree", path, "--dot", dot, "--prefix", "r1/")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines() == [
        "r1/map",
        "├── r1/base       1.0 Hz  age 0 ns  span 2 s",
        "│   └── r1/laser  static",
        "└── r1/slow       one sample  age 1 s  span 0 ns",
    ]
    assert '"r1/map" -> "r1/base"' in dot.read_text()
    document = json.loads(tfbus("tree", path, "--json").stdout)
    assert (document["file"], document["stamp"], document["frames"]["slow"]["age"]) == (str(path), 2 * SECOND, 1.0)


@pytest.mark.skipif(shutil.which("dot") is None, reason="Graphviz is not installed")
def test_the_tree_of_a_recording_is_drawn(tfbus: Command, tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "run.mcap", [(SECOND, "/tf", [moving("map", "base", SECOND)])])
    assert tfbus("tree", path, "--svg", tmp_path / "frames.svg").returncode == 0
    assert ">base<" in (tmp_path / "frames.svg").read_text(encoding="utf-8")


def test_without_graphviz_the_error_says_what_to_install(
    tfbus: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    done = tfbus.on_domain(publish, "tree", "--pdf", tmp_path / "frames.pdf")
    check_wrong_call(done, "--pdf needs Graphviz: install it (apt install graphviz")


def test_a_complaint_of_graphviz_is_a_usage_error(
    tfbus: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "dot"
    program.write_text("#!/bin/sh\necho 'syntax error\nnear line 1' >&2; exit 1\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    done = tfbus.on_domain(publish, "tree", "--svg", tmp_path / "frames.svg")
    check_wrong_call(done, "Graphviz could not draw the tree: syntax error near line 1")
    assert list(tmp_path.iterdir()) == [program]

import errno
import json
import os
import pty
import re
import signal
import subprocess
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import pytest
from support.processes import new_domain
from support.programs import PATIENCE, TFBUS, Program, free_address, tfbus

from tfbus import SECOND, Edge
from tfbus.cli.commands.tree import document, write
from tfbus.cli.domain import UnusableError

TREE = r"""base_link
├── base_laser  \d+\.\d Hz  age .+  span .+  from 'robot_tf_publisher'
└── camera      static  from 'tfbus static'
"""


def test_the_document_has_each_frame_with_its_edge_and_null_for_what_it_does_not_have() -> None:
    moving = Edge("map", "base_link", False, 101, 2 * SECOND, 4 * SECOND, "odometry")
    static = Edge("base_link", "lidar", True, 1, None, None, "")
    assert document("tf", ["base_link", "lidar", "map"], [moving, static], 5 * SECOND) == {
        "domain": "tf",
        "stamp": 5 * SECOND,
        "frames": {
            "base_link": {
                "parent": "map",
                "kind": "moving",
                "rate": 50.0,
                "age": 1.0,
                "span": 2.0,
                "authority": "odometry",
            },
            "lidar": {
                "parent": "base_link",
                "kind": "static",
                "rate": None,
                "age": None,
                "span": None,
                "authority": "",
            },
            "map": {"parent": None, "kind": "root", "rate": None, "age": None, "span": None, "authority": None},
        },
    }


def test_a_file_is_replaced_as_a_whole_and_nothing_else_is_left(tmp_path: Path) -> None:
    path = tmp_path / "frames.dot"
    for text in ("first", "second"):
        write(path, text)
        assert path.read_text() == text
    assert list(tmp_path.iterdir()) == [path]


def test_a_pipe_is_written_to_and_not_replaced(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        write(pipe, "digraph")
        assert os.read(reader, 100) == b"digraph"
    finally:
        os.close(reader)
    assert pipe.is_fifo()


@pytest.mark.parametrize("name", ["nowhere/frames.dot", "."])
def test_what_cannot_be_written_is_told_by_its_name(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    with pytest.raises(UnusableError, match=re.escape(f"cannot write {path}: ")):
        write(path, "")


@pytest.mark.parametrize("backend", ["asyncio", "trio"])
def test_the_tree_is_shown_as_others_send_it_and_written_for_graphviz(backend: str, tmp_path: Path) -> None:
    domain, address = new_domain(), free_address()
    options = ("--domain", domain, "--backend", backend)
    dot = tmp_path / "frames.dot"
    with (
        tfbus("broadcast", "--listen", address, *options) as broadcaster,
        tfbus("static", "base_link", "camera", "--connect", address, *options) as static,
    ):
        broadcaster.errors.expect("broadcasting")
        static.errors.expect("publishing")
        with tfbus("tree", "--duration", "1.5", "--dot", str(dot), "--connect", address, *options) as tree:
            assert tree.wait() == 0
    assert re.fullmatch(TREE, tree.output.text)
    first, *edges, last = dot.read_text().splitlines()
    assert (first, last) == ("digraph tf {", "}")
    assert [re.split(r" \[", edge)[0].strip() for edge in edges] == [
        '"base_link" -> "base_laser"',
        '"base_link" -> "camera"',
    ]


def test_where_nothing_comes_it_waits_until_something_does() -> None:
    domain = new_domain()
    with tfbus("tree", "--duration", "0", "--domain", domain) as tree:
        tree.errors.expect("waiting")
        with tfbus("static", "map", "odom", "--domain", domain):
            assert tree.wait() == 0
    assert tree.output.text == "map\n└── odom  static  from 'tfbus static'\n"
    assert tree.errors.text == f"waiting for transforms on domain '{domain}' …\n"


def test_ctrl_c_ends_one_that_still_waits() -> None:
    with tfbus("tree", "--domain", new_domain()) as tree:
        waiting = tree.errors.expect("waiting")
        assert tree.end() == 130
    assert (tree.output.text, tree.errors.text) == ("", f"{waiting}\n")


def test_a_file_that_cannot_be_written_is_one_line_and_status_2(tmp_path: Path) -> None:
    options = ("--domain", new_domain())
    nowhere = tmp_path / "nowhere" / "frames.dot"
    with (
        tfbus("static", "base_link", "camera", *options),
        tfbus("tree", "--duration", "0", "--dot", str(nowhere), *options) as tree,
    ):
        assert tree.wait() == 2
    assert tree.errors.text == f"tfbus: cannot write {nowhere}: {os.strerror(errno.ENOENT)}\n"


def test_watched_through_a_pipe_it_is_printed_again_and_again_and_what_is_new_is_in_it() -> None:
    options = ("--domain", new_domain())
    with (
        tfbus("static", "map", "odom", *options),
        tfbus("tree", "--watch", "--rate", "20", *options) as tree,
        tfbus("tree", "--watch", "--rate", "20", "--json", *options) as lines,
    ):
        for _ in range(2):
            tree.output.expect("^map$")
            tree.output.expect("^└── odom  static  from 'tfbus static'$")
            tree.output.expect("^$")
        assert set(json.loads(lines.output.expect(""))["frames"]) == {"map", "odom"}
        with tfbus("static", "odom", "base_link", "--authority", "me", *options):
            tree.output.expect("^    └── base_link  static  from 'me'$")
            document = json.loads(lines.output.expect("base_link"))
        assert document["frames"]["base_link"]["parent"] == "odom"
        assert tree.end() == 130
    assert "\x1b" not in tree.output.text


@pytest.mark.parametrize(("environment", "coloured"), [({}, True), ({"NO_COLOR": "1"}, False)])
def test_on_a_terminal_it_is_redrawn_in_place_and_in_colour_if_that_is_wanted(
    environment: Mapping[str, str], coloured: bool
) -> None:
    options = ("--domain", new_domain())
    screen, terminal = pty.openpty()
    plain = {name: value for name, value in os.environ.items() if name not in {"NO_COLOR", "FORCE_COLOR"}}
    with tfbus("static", "map", "odom", *options):
        watch = subprocess.Popen(
            [TFBUS, "tree", "--watch", "--rate", "20", *options],
            stdin=terminal,
            stdout=terminal,
            stderr=terminal,
            env={**plain, "TERM": "xterm-256color", **environment},
            start_new_session=True,
        )
        os.close(terminal)
        with watch:
            seen = b""
            # One line up, to the first of the two.
            while seen.count(b"\x1b[1A") < 2:
                seen += os.read(screen, 4096)
            watch.send_signal(signal.SIGINT)
            # A terminal whose program has ended says so by an error.
            with suppress(OSError):
                while more := os.read(screen, 4096):
                    seen += more
            assert watch.wait(PATIENCE) == 130
        os.close(screen)
    assert (b"\x1b[36m" in seen) is coloured
    # The cursor is there.
    assert seen.rindex(b"\x1b[?25h") > seen.rindex(b"\x1b[?25l")
    assert b"Traceback" not in seen


def test_an_output_that_knows_no_such_letters_gets_others() -> None:
    domain = new_domain()
    command = (TFBUS, "tree", "--duration", "0", "--domain", domain)
    with (
        tfbus("static", "map", "Straße", "--domain", domain),
        Program(*command, environment={**os.environ, "PYTHONIOENCODING": "ascii"}) as tree,
    ):
        assert tree.wait() == 0
    assert tree.output.text == "map\n`-- Stra\\xdfe  static  from 'tfbus static'\n"

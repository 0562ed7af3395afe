import errno
import os
import re
import shutil
from pathlib import Path

import pytest

from tfbus.cli._graphviz import draw, write_file
from tfbus.cli.arguments import UsageError

needs_graphviz = pytest.mark.skipif(shutil.which("dot") is None, reason="Graphviz is not installed")


@needs_graphviz
@pytest.mark.parametrize(("kind", "begin"), [("svg", b"<?xml"), ("pdf", b"%PDF"), ("png", b"\x89PNG")])
def test_a_graph_is_drawn_in_every_kind(tmp_path: Path, kind: str, begin: bytes) -> None:
    path = tmp_path / "picture"
    draw('digraph tf { "map" -> "b\u00e4se" }', kind, path)
    assert path.read_bytes().startswith(begin)
    if kind == "svg":
        assert ">b\u00e4se<" in path.read_text(encoding="utf-8")


@needs_graphviz
def test_what_graphviz_complains_of_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="syntax error"):
        draw("digraph {", "svg", tmp_path / "picture.svg")
    assert list(tmp_path.iterdir()) == []


def test_without_graphviz_the_error_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UsageError, match=r"--pdf needs Graphviz: install it .*graphviz"):
        draw("digraph {}", "pdf", tmp_path / "picture.pdf")


def test_a_file_is_replaced_as_a_whole_without_leaving_others(tmp_path: Path) -> None:
    path = tmp_path / "frames.dot"
    for content in (b"first", b"second"):
        write_file(path, content)
        assert path.read_bytes() == content
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_that_cannot_be_replaced_leaves_nothing_unfinished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(Path, "replace", fail)
    with pytest.raises(UsageError, match="Input/output error"):
        write_file(tmp_path / "frames.dot", b"digraph")
    assert list(tmp_path.iterdir()) == []


def test_a_pipe_is_written_to_and_not_replaced(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        write_file(pipe, b"digraph")
        assert os.read(reader, 100) == b"digraph"
    finally:
        os.close(reader)
    assert pipe.is_fifo()


@pytest.mark.parametrize("name", ["nowhere/frames.dot", "."])
def test_an_error_names_the_file_that_cannot_be_written(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    with pytest.raises(UsageError, match=re.escape(f"cannot write {path}: ")):
        write_file(path, b"")

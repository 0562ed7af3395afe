import shutil
from pathlib import Path

import pytest

from tfbus.cli._graphviz import draw
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

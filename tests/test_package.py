"""The names of the package, and the package as a program."""

import ast
import copy
import pickle
import re
import runpy
import sys
from dataclasses import FrozenInstanceError, fields, is_dataclass
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
from support.commands import Command

import tfbus


def test_dir_shows_the_public_names_and_the_version() -> None:
    assert dir(tfbus) == sorted([*tfbus.__all__, "__version__"])
    assert all(hasattr(tfbus, name) for name in dir(tfbus))


def test_the_version_is_that_of_the_installed_package() -> None:
    assert tfbus.__version__ == version("tfbus")


def test_another_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="module 'tfbus' has no attribute 'Transfrom'"):
        tfbus.Transfrom  # type: ignore[attr-defined]  # noqa: B018


def test_values_that_users_get_cannot_be_changed_and_have_slots() -> None:
    found = {
        kind
        for room in ("tfbus", "tfbus.analysis", "tfbus.data", "tfbus.recording", "tfbus.robot")
        for name in import_module(room).__all__
        if isinstance(kind := getattr(import_module(room), name), type) and is_dataclass(kind)
    }
    assert len(found) > 60
    for kind in found - {tfbus.recording.Conversion}:
        value = kind.__new__(kind)
        with pytest.raises(FrozenInstanceError):
            setattr(value, fields(kind)[0].name, 0)
        assert not hasattr(value, "__dict__"), kind


def test_type_checkers_read_the_names_and_modules_that_are_loaded() -> None:
    stub = ast.parse(Path(tfbus.__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    imports = [(node.module, alias) for node in stub.body if isinstance(node, ast.ImportFrom) for alias in node.names]
    assert all(alias.name == alias.asname for _, alias in imports)
    names = {alias.name: module for module, alias in imports if module != "tfbus"}
    assert sorted(names) == tfbus.__all__
    for name, module in names.items():
        assert getattr(tfbus, name) is getattr(import_module(str(module)), name)
    for room in (alias.name for module, alias in imports if module == "tfbus"):
        assert getattr(tfbus, room) is import_module(f"tfbus.{room}")


def test_the_package_runs_as_the_command(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    command = Command(monkeypatch, capsys)("query")
    monkeypatch.setattr(sys, "argv", ["tfbus", "query"])
    monkeypatch.delitem(sys.modules, "tfbus.__main__", raising=False)
    with pytest.raises(SystemExit) as ended:
        runpy.run_module("tfbus", run_name="__main__")
    assert ended.value.code == command.returncode == 2
    assert capsys.readouterr().err == command.stderr != ""


def test_a_bus_says_why_it_cannot_be_copied_or_pickled() -> None:
    for make in (copy.copy, copy.deepcopy, pickle.dumps):
        with pytest.raises(TypeError, match=r"use Buffer\(bus\).tree.copy\(\)"):
            make(tfbus.Bus())


def test_rooms_with_extras_are_found_after_a_plain_import() -> None:
    for room, extra in (("plot", "matplotlib"), ("view", "trimesh"), ("links", "anyio")):
        pytest.importorskip(extra)
        assert getattr(tfbus, room) is import_module(f"tfbus.{room}")


def test_long_values_print_in_few_lines_and_as_html() -> None:
    trees = [tfbus.TransformTree(None), tfbus.TransformTree(None)]
    for place in range(600):
        for tree, off in zip(trees, (0.0, 0.5), strict=True):
            tree.insert(tfbus.TransformStamped("map", "<cart>", place, tfbus.Transform((place, off, 0.0))))
    comparison = tfbus.analysis.compare(trees[0], trees[1], "map", "<cart>")
    assert len(str(comparison).splitlines()) < 8
    assert re.search(r"absolute translation \[m\] +0.5 +0.5 +0.5 +0 +0.5 +0.5", str(comparison))
    stamps = tfbus.recording.HeaderStamps(np.arange(600) * tfbus.SECOND, True, 2)
    assert repr(stamps) == "<HeaderStamps of 600 messages, 0.000 s .. 599.000 s, from headers, 2 unreadable>"
    explanation = trees[0].explain("map", "<cart>")
    assert repr(explanation) == "<Explanation of '<cart>' in 'map', 1 edge: 0.000000599 s>"
    assert "&lt;cart&gt;" in explanation._repr_html_()
    bus = tfbus.Bus()
    bus.publish(tfbus.TransformStamped("map", "cart", 1, tfbus.Transform()))
    assert repr(bus.statistics()).startswith("BusStatistics(samples=1, frames=1")
    assert "<tr><th>samples</th><td>1</td></tr>" in bus.statistics()._repr_html_()
    assert "max-height" in trees[0]._repr_html_()

"""Type checkers find typos on every public class, and no fault with the demos or with calls that docstrings allow."""

import importlib
import inspect
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("pyright", reason="the extra dev is not installed")

pytestmark = pytest.mark.thorough

ROOT = Path(__file__).parents[2]
DOORS = ["tfbus", "tfbus.analysis", "tfbus.links", "tfbus.recording", "tfbus.robot"]
CHECKERS = {
    "mypy": ["-m", "mypy", "--no-error-summary", "--cache-dir", "cache", "--config-file", ""],
    "pyright": ["-m", "pyright", "--pythonpath", sys.executable],
    "ty": [
        "-m",
        "ty",
        "check",
        "--output-format",
        "concise",
        "--python",
        sys.executable,
        "--extra-search-path",
        str(ROOT),
    ],
}
CALLS = """
import numpy as np
import tfbus
from tfbus import LATEST, Transform

tfbus.PointStamped("map", 0, [1.0, 2.0, 3.0])
tfbus.PointStamped("map", LATEST, np.zeros(3))
tfbus.Vector3Stamped("map", np.int64(3), [1, 2, 3])
tfbus.QuaternionStamped("map", np.datetime64(0, "ns"), [0.0, 0.0, 0.0, 1.0])
tfbus.TwistStamped("map", 0, [0.0, 0.0, 0.0], np.zeros(3))
tfbus.WrenchStamped("map", 0, np.zeros(3), [0.0, 0.0, 0.0])
tfbus.Polygon("map", 0, [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
tfbus.PoseWithCovarianceStamped("map", 0, Transform(), [0.0] * 36)
Transform([1, 2, 3], np.array([0, 0, 0, 1])).apply([1.0, 2.0, 3.0])

tree = tfbus.TransformTree()
tree.insert(tfbus.TransformStamped("map", "laser", np.int64(0), Transform()))
tree.lookup_many("map", "laser", range(2), out_of_range="nan")
moved = tfbus.do_transform(tfbus.PointStamped("laser", 0, [1, 2, 3]), tree.lookup("map", "laser"))
x, y, z = moved.point
"""


def faults(folder: Path, mode: str) -> list[Any]:
    """The reports of pyright on the programs in a folder."""
    options = {"include": ["."], "typeCheckingMode": mode, "extraPaths": [str(ROOT)]}
    (folder / "pyrightconfig.json").write_text(json.dumps(options), encoding="utf-8")
    command = [sys.executable, "-m", "pyright", "-p", str(folder), "--pythonpath", sys.executable, "--outputjson"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if not done.stdout.startswith("{"):
        pytest.skip(f"pyright does not start: {done.stderr.strip()[-200:]}")
    report = json.loads(done.stdout)
    assert report["summary"]["filesAnalyzed"] >= len(list(folder.glob("*.py")))
    return [(Path(fault["file"]).name, fault["message"]) for fault in report["generalDiagnostics"]]


def test_pyright_finds_no_fault_with_the_demos(tmp_path: Path) -> None:
    for demo in (ROOT / "demos").glob("*.py"):
        # A demo with requirements of its own is checked where these are installed.
        if "# /// script" not in demo.read_text(encoding="utf-8"):
            shutil.copy(demo, tmp_path)
    assert faults(tmp_path, "basic") == []


def test_sequences_are_accepted_by_types_as_by_docstrings(tmp_path: Path) -> None:
    (tmp_path / "calls.py").write_text(CALLS, encoding="utf-8")
    exec(compile(CALLS, "calls.py", "exec"), {})
    assert faults(tmp_path, "basic") == []
    (tmp_path / "calls.py").write_text('import tfbus\ntfbus.PointStamped("map", 0, "123")\n', encoding="utf-8")
    assert [name for name, _ in faults(tmp_path, "basic")] == ["calls.py"]


@pytest.mark.parametrize("checker", CHECKERS)
def test_a_typo_on_any_public_class_is_caught(checker: str, tmp_path: Path) -> None:
    pytest.importorskip(checker, reason="the extra dev is not installed")
    rooms = [importlib.import_module(door) for door in DOORS]
    named = [(room.__name__, name) for room in rooms for name in room.__all__ if inspect.isclass(getattr(room, name))]
    classes = [f"{door}.{name}" for door, name in named]
    imports = [f"import {door}" for door in DOORS]
    typos = [f"def use_{line}(thing: {name}) -> None: thing.no_such_name" for line, name in enumerate(classes)]
    (tmp_path / "typos.py").write_text("\n".join([*imports, *typos]), encoding="utf-8")
    command = [sys.executable, *CHECKERS[checker], "typos.py"]
    environment = {**os.environ, "MYPYPATH": str(ROOT), "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path, env=environment)
    caught = {int(line) for line in re.findall(r"typos\.py:(\d+).*no_such_name", done.stdout)}
    missed = [name for line, name in enumerate(classes, len(imports) + 1) if line not in caught]
    assert (missed, len(classes) > 80) == ([], True), done.stderr[-500:]

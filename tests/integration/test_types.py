"""Pyright, which editors run, finds no fault with the demos, nor with sequences where docstrings allow them."""

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("pyright", reason="the extra thorough is not installed")

pytestmark = pytest.mark.thorough

ROOT = Path(__file__).parents[2]
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
        shutil.copy(demo, tmp_path)
    assert faults(tmp_path, "basic") == []


def test_sequences_are_accepted_by_types_as_by_docstrings(tmp_path: Path) -> None:
    (tmp_path / "calls.py").write_text(CALLS, encoding="utf-8")
    exec(compile(CALLS, "calls.py", "exec"), {})
    assert faults(tmp_path, "basic") == []
    (tmp_path / "calls.py").write_text('import tfbus\ntfbus.PointStamped("map", 0, "123")\n', encoding="utf-8")
    assert [name for name, _ in faults(tmp_path, "basic")] == ["calls.py"]

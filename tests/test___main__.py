import runpy
import sys

import pytest
from support.commands import Command


def test_the_package_runs_as_the_command(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    command = Command(monkeypatch, capsys)("query")
    monkeypatch.setattr(sys, "argv", ["tfbus", "query"])
    monkeypatch.delitem(sys.modules, "tfbus.__main__", raising=False)
    with pytest.raises(SystemExit) as ended:
        runpy.run_module("tfbus", run_name="__main__")
    assert ended.value.code == command.returncode == 2
    assert capsys.readouterr().err == command.stderr != ""

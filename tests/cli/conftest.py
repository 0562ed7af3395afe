"""The fixture ``tfbus``: the command, run in the process of the test."""

import pytest
from support.commands import Command


@pytest.fixture
def tfbus(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    return Command(monkeypatch, capsys)

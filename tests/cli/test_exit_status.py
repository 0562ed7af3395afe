import os
import sys

import pytest

from tfbus.cli.domain import LinkOptions
from tfbus.cli.exit_status import run


def test_what_the_caller_does_once_all_is_loaded_comes_before_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    steps: list[str] = []
    monkeypatch.setattr(LinkOptions, "run", lambda *_, **__: steps.append("run"))
    assert run(["listen"], lambda: steps.append("loaded")) == 0
    assert run(["listen", "--no-such-option"], lambda: steps.append("loaded")) == 2
    assert steps == ["loaded", "run"]


def test_a_reader_that_has_gone_is_no_error_and_not_told_again_at_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w", encoding="utf-8") as output:
        monkeypatch.setattr(sys, "stdout", output)
        monkeypatch.setattr(LinkOptions, "run", lambda *_, **__: print("something"))
        assert run(["listen"]) == 0
        # As Python does when it ends.
        print("more")
        output.flush()

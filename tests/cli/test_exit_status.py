import pytest

from tfbus.cli.domain import LinkOptions
from tfbus.cli.exit_status import run


def test_what_the_caller_does_once_all_is_loaded_comes_before_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    steps: list[str] = []
    monkeypatch.setattr(LinkOptions, "run", lambda *_, **__: steps.append("run"))
    assert run(["listen"], lambda: steps.append("loaded")) == 0
    assert run(["listen", "--no-such-option"], lambda: steps.append("loaded")) == 2
    assert steps == ["loaded", "run"]

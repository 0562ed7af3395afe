import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from tfbus.cli import _log_lines
from tfbus.cli._log_lines import log_lines

LOGGER = logging.getLogger("tfbus")


@contextmanager
def windows(monkeypatch: pytest.MonkeyPatch, first: float) -> Iterator[None]:
    """Show the lines of tfbus, with another time for which the first of a kind is held back."""
    with monkeypatch.context() as patch, log_lines("WARNING"):
        patch.setattr(_log_lines, "FIRST_WINDOW", first)
        yield


def test_lines_of_one_kind_are_one_line_with_their_number(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with windows(monkeypatch, 60.0):
        for number in range(83):
            LOGGER.warning("frame %r comes from two authorities", f"f{number}")
        LOGGER.warning("the clock jumped back")
        assert capsys.readouterr() == ("", "")
    assert capsys.readouterr().err.splitlines() == [
        "tfbus: frame 'f0' comes from two authorities (and 82 more like it)",
        "tfbus: the clock jumped back",
    ]


def test_a_line_is_printed_when_its_time_is_over_and_the_time_doubles(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with windows(monkeypatch, 0.001):
        for round_ in range(3):
            LOGGER.warning("round %d", round_)
            deadline = time.monotonic() + 60.0
            while not (printed := capsys.readouterr().err) and time.monotonic() < deadline:
                time.sleep(0.001)
            assert printed == f"tfbus: round {round_}\n"
        (handler,) = LOGGER.handlers
        assert isinstance(handler, _log_lines.FoldingHandler)
        assert handler._windows == {"round %d": 0.008}


def test_a_traceback_stays_with_its_line(capsys: pytest.CaptureFixture[str]) -> None:
    with log_lines("WARNING"):
        LOGGER.warning("the callback raised", exc_info=ValueError("no\ntfbus: all is well\x1b[2J"))
    first, *traceback = capsys.readouterr().err.split("\n")
    assert first == "tfbus: the callback raised"
    assert traceback[-3:] == ["  ValueError: no", r"  tfbus: all is well\x1b[2J", ""]
    assert all(line.startswith("  ") for line in traceback[:-1])


def test_the_level_and_the_handlers_are_as_before_at_the_end() -> None:
    before = LOGGER.level, list(LOGGER.handlers)
    with log_lines("DEBUG"):
        assert LOGGER.level == logging.DEBUG
    assert (LOGGER.level, LOGGER.handlers) == before

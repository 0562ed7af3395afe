import logging

import pytest

from tfbus.bus.once_logger import OnceLogger, SeenKeys

LOGGER = logging.getLogger("tests.once")


def test_a_key_is_logged_the_first_time_only(caplog: pytest.LogCaptureFixture) -> None:
    once = OnceLogger(LOGGER)
    once.warning(("cycle", "base"), "first %s", "base")
    once.warning(("cycle", "base"), "second %s", "base")
    assert caplog.messages == ["first base"]
    assert caplog.records[0].levelno == logging.WARNING
    assert caplog.records[0].name == "tests.once"


def test_info_is_logged_once_too(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    once = OnceLogger(LOGGER)
    once.info("key", "first %s", "base")
    once.info("key", "second")
    assert caplog.record_tuples == [("tests.once", logging.INFO, "first base")]


def test_another_key_is_logged_even_with_the_same_message(caplog: pytest.LogCaptureFixture) -> None:
    once = OnceLogger(LOGGER)
    once.warning(("cycle", "base"), "dropped")
    once.warning(("cycle", "laser"), "dropped")
    assert caplog.messages == ["dropped", "dropped"]


def test_two_loggers_do_not_share_their_keys(caplog: pytest.LogCaptureFixture) -> None:
    OnceLogger(LOGGER).warning("key", "first")
    OnceLogger(LOGGER).warning("key", "second")
    assert caplog.messages == ["first", "second"]


def test_the_error_is_logged_with_its_traceback(caplog: pytest.LogCaptureFixture) -> None:
    error = ValueError("broken")
    OnceLogger(LOGGER).warning("key", "a subscriber failed", exc_info=error)
    assert caplog.records[0].exc_info is not None
    assert caplog.records[0].exc_info[1] is error


def test_memory_is_bounded_and_the_oldest_of_a_thousand_keys_is_forgotten_first(
    caplog: pytest.LogCaptureFixture,
) -> None:
    once = OnceLogger(LOGGER)
    for key in range(1_001):
        once.warning(key, "key %d", key)
    caplog.clear()
    once.warning(1_000, "the newest")
    once.warning(1, "the oldest that is remembered")
    once.warning(0, "the forgotten one")
    assert caplog.messages == ["the forgotten one"]


def test_a_key_is_the_first_of_its_kind_until_it_is_forgotten() -> None:
    once = SeenKeys(capacity=2)
    assert [once.add(key) for key in "aabb"] == [True, False, True, False]
    assert once.add("c")
    assert not once.add("b")
    assert once.add("a")


def test_no_argument_begins_a_line_of_its_own(caplog: pytest.LogCaptureFixture) -> None:
    log = OnceLogger(logging.getLogger("tfbus"))
    name = "x\n2026 CRITICAL\x1b[2J"
    log.warning("key", "%s %r %s %d %.1f", name, name, OSError(name), 3, 0.5)
    (record,) = caplog.records
    shown = r"x\n2026 CRITICAL\x1b[2J"
    assert record.getMessage() == f"{shown} '{shown}' {shown} 3 0.5"
    assert record.msg == "%s %r %s %d %.1f"

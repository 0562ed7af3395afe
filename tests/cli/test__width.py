import sys

import pytest
from support.terminal import Terminal

from tfbus.cli._width import align, cells, shorten, shorten_widest, terminal_width, wrapped


def test_a_pipe_has_room_for_any_line_unless_the_environment_says_otherwise(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    assert terminal_width() is None
    monkeypatch.setenv("COLUMNS", "60")
    assert terminal_width() == 60
    monkeypatch.setenv("COLUMNS", "many")
    assert terminal_width() is None
    monkeypatch.setattr(sys, "stdout", Terminal())
    assert isinstance(terminal_width(), int)


@pytest.mark.parametrize(("text", "width"), [("", 0), ("map", 3), ("雷达", 4), ("e\u0301", 1), ("Straße", 6)])
def test_a_wide_letter_takes_two_columns_and_a_combining_mark_none(text: str, width: int) -> None:
    assert cells(text) == width


@pytest.mark.parametrize(
    ("text", "width", "shortened"),
    [
        ("base_link", 9, "base_link"),
        ("base_link", 8, "bas…link"),
        ("base_link", 5, "ba…nk"),
        ("base_link", 2, "…k"),
        ("base_link", 1, "…"),
        ("base_link", 0, ""),
        ("雷达雷达", 7, "雷…雷达"),
        ("雷达雷达", 5, "雷…达"),
        ("雷达雷达", 4, "…达"),
    ],
)
def test_the_middle_of_a_long_text_is_cut_out(text: str, width: int, shortened: str) -> None:
    assert shorten(text, width) == shortened


def test_a_line_is_broken_between_words_and_a_longer_word_is_shortened() -> None:
    assert wrapped("one two three", None, 2) == wrapped("one two three", 13, 2) == ["one two three"]
    assert wrapped("one two three", 8, 2) == ["one two", "  three"]
    assert wrapped("at /a/very/long/path it is", 10, 2) == ["at", "  /a/…path", "  it is"]


def test_the_widest_columns_give_way_first() -> None:
    assert shorten_widest([20, 10, 3], 40) == [20, 10, 3]
    assert shorten_widest([20, 10, 3], 28) == [15, 10, 3]
    assert shorten_widest([20, 10, 3], 21) == [9, 9, 3]
    assert shorten_widest([20, 10, 3], 5) == [8, 8, 3]
    assert shorten_widest([], 5) == []


def test_a_text_is_filled_up_to_a_width() -> None:
    assert (align("达", 4), align("达", 4, right=True)) == ("达  ", "  达")

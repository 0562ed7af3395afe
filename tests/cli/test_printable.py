import pytest

from tfbus.cli.printable import printable


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("base_link", "base_link"),
        ("雷达 é", "雷达 é"),
        ("\x1b[2J", "\\x1b[2J"),
        ("a\nb\r\x07", "a\\nb\\r\\x07"),
        # It would turn round what follows.
        ("\u202egpj", "\\u202egpj"),
    ],
)
def test_letters_of_any_alphabet_stay_and_what_controls_a_terminal_is_written_out(text: str, shown: str) -> None:
    assert printable(text) == shown

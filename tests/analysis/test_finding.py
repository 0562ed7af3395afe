import pytest

from tfbus import Finding
from tfbus.analysis.examiner import ADVICE


def test_a_finding_says_which_frame_what_how_often_the_worst_and_when() -> None:
    finding = Finding("jump", "base", 1_234, 1_500_000_000, 12.3456, "m/s", "moves faster than it can", 2_000_000_000)
    assert str(finding) == ("'base': moves faster than it can, 1,234 x, worst 12.35 m/s at 2.000 s, first at 1.500 s")
    assert finding.advice == ADVICE["jump"]


def test_what_is_not_known_is_left_out() -> None:
    assert str(Finding("disconnected", None, 2, None, None, "", "separate trees")) == "separate trees, 2 x"


@pytest.mark.parametrize("kind", ADVICE)
def test_every_kind_has_an_advice_of_one_line(kind: str) -> None:
    assert ADVICE[kind]
    assert "\n" not in ADVICE[kind]

from dataclasses import FrozenInstanceError

import pytest

from tfbus.recording import Edits
from tfbus.recording.formats.transforms import RawTransform

SLASHED = RawTransform(1, 2, b"/odom", b"/base", bytes(56))


def test_edits_are_frozen() -> None:
    with pytest.raises(FrozenInstanceError):
        Edits().prefix = "r/"  # type: ignore[misc]


def test_without_edits_nothing_changes_not_even_a_leading_slash() -> None:
    assert Edits() == Edits(frames=None, rename={}, prefix="", drop_static=False)
    assert Edits().apply(SLASHED) == SLASHED
    assert not Edits().changes_messages
    assert not Edits(drop_static=True).changes_messages
    assert Edits(frames=()).changes_messages


def test_names_are_compared_without_their_slashes() -> None:
    assert Edits(rename={"base": "body"}).apply(SLASHED)[2:4] == (b"/odom", b"body")
    assert Edits(prefix="r/").apply(SLASHED)[2:4] == (b"r/odom", b"r/base")
    assert Edits(frames=["base"]).keeps(SLASHED)
    assert not Edits(frames=["odom"]).keeps(SLASHED)


def test_a_name_that_is_no_text_keeps_its_bytes() -> None:
    broken = SLASHED._replace(child=b"\xffbase")
    assert Edits(prefix="r/").apply(broken).child == b"r/\xffbase"

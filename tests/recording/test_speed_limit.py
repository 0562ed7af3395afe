from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from support.recorded import write_mcap
from support.samples import moving, static

from tfbus import SECOND, TransformStamped
from tfbus.recording import load
from tfbus.recording.recording import _MAX_CANDIDATES, SpeedLimit


def kept(*places: float, speed: float = 2.0) -> tuple[list[float], Counter[str]]:
    """The indices of those of some places, one a second, that stay."""
    limit = SpeedLimit(speed)
    found: list[TransformStamped] = []
    for at, x in enumerate(places):
        found += limit.admit((moving("a", "b", at * SECOND, x),))
    found += limit.undecided()
    # Each of them once.
    assert limit.undecided() == ()
    return [sample.transform.translation[0] for sample in found], limit.dropped


def test_a_sample_that_is_too_far_from_the_last_one_kept_is_dropped() -> None:
    assert kept(0, 1, 100, 3, 5) == ([0, 1, 3, 5], {"speed": 1})
    assert kept(0, 2, 4) == ([0, 2, 4], {})


def test_the_first_sample_goes_if_the_next_ones_contradict_it() -> None:
    assert kept(1e9, 0, 1, 2) == ([0, 1, 2], {"speed": 1})
    assert kept(0, 1e9, 1, 2) == ([0, 1, 2], {"speed": 1})
    assert kept(7) == ([7], {})
    assert kept(0, 1e9) == ([0], {"speed": 1})
    assert kept(0, 1e9, -1e9, 5e9) == ([0], {"speed": 3})


def test_a_frame_that_really_is_elsewhere_is_reached_in_time() -> None:
    assert kept(0, 0, 5, 5, 5) == ([0, 0, 5], {"speed": 2})


def test_candidates_are_bounded() -> None:
    places = [1e3 * 4**k for k in range(40)]
    found, dropped = kept(*places)
    assert (len(found), dropped) == (1, {"speed": 39})
    # The oldest one is forgotten, so what comes back to its place confirms nothing.
    found, dropped = kept(*places, places[0])
    assert (len(found), dropped) == (1, {"speed": 40})
    # As long as it is remembered, it is confirmed, and the others go; of one more, two are forgotten in turn.
    most = places[:_MAX_CANDIDATES]
    assert kept(*most, places[0]) == ([places[0], places[0]], {"speed": _MAX_CANDIDATES - 1})
    most = places[: _MAX_CANDIDATES + 1]
    assert kept(*most, places[0]) == ([places[2]], {"speed": _MAX_CANDIDATES + 1})


def test_frames_parents_and_kinds_are_apart() -> None:
    limit = SpeedLimit(1.0)
    first = (moving("a", "b", 0), moving("a", "c", 0, 50.0), static("b", "d", 9e9))
    assert limit.admit(first) == (first[2],)
    second = (moving("a", "b", SECOND, 1.0), moving("z", "b", SECOND, 900.0), moving("a", "c", SECOND, 51.0))
    assert limit.admit(second) == (first[0], second[0], first[1], second[2])
    # Of one stamp, the last one wins: no speed is known.
    third = (moving("a", "b", SECOND, 80.0),)
    assert limit.admit(third) == third


@pytest.mark.parametrize(("speed", "error"), [(0.0, ValueError), (-1.0, ValueError), ("fast", TypeError)])
def test_a_speed_is_a_number_greater_than_zero(speed: Any, error: type[Exception]) -> None:
    with pytest.raises(error, match="max_speed"):
        SpeedLimit(speed)


def test_a_speed_limit_holds_in_a_long_recording_that_would_be_stored_at_once(tmp_path: Path) -> None:
    lines = [(k, "/tf", [moving("map", "base", k * SECOND, 1e6 if k == 1_900 else float(k))]) for k in range(2_000)]
    problems: Counter[str] = Counter()
    tree = load(write_mcap(tmp_path / "run.mcap", lines), max_speed=3.0, problems=problems)
    assert [edge.samples for edge in tree.edges()] == [1_999]
    assert problems == {"speed": 1}


def test_load_leaves_out_what_nothing_can_have_reached(tmp_path: Path) -> None:
    places = [5e9, 0, 1, 2, 77, 3]
    lines = [(at, "/tf", [moving("map", "base", at * SECOND, x)]) for at, x in enumerate(places)]
    path = write_mcap(tmp_path / "run.mcap", [*lines, (9, "/tf", [moving("map", "lone", 0, 5.0)])])
    problems: Counter[str] = Counter()
    tree = load(path, max_speed=3.0, problems=problems)
    assert {edge.child: edge.samples for edge in tree.edges()} == {"base": 4, "lone": 1}
    assert problems == {"speed": 2}

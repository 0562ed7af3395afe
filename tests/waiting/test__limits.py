import pytest
from support.histories import live_tree
from support.samples import moving, static

from tfbus import LATEST, Question, TransformStamped
from tfbus.tree.lookup import Policy
from tfbus.waiting.live_tree import limits_of


def limits(
    *samples: TransformStamped,
    keep: float | None = 100e-9,
    question: Question | None = None,
    blocking: str | None = None,
) -> list[tuple[str, int]]:
    live = live_tree(keep)
    for sample in samples:
        live.insert((sample,))
    return limits_of(live.forest, question or Question("map", "tip", 50), blocking)


TWO_EDGES = (moving("map", "mid", 30), moving("map", "mid", 60), moving("mid", "tip", 20))


def test_an_edge_may_go_on_until_the_sample_before_the_stamp_leaves_its_window() -> None:
    assert limits(*TWO_EDGES) == [("tip", 120), ("mid", 130)]


def test_an_edge_that_lags_may_go_on_at_least_to_the_stamp() -> None:
    assert limits(*TWO_EDGES, keep=20e-9) == [("tip", 50), ("mid", 50)]


def test_the_blocking_edge_and_static_ones_are_left_out() -> None:
    assert limits(*TWO_EDGES, static("tip", "end"), question=Question("map", "end", 50), blocking="tip") == [
        ("mid", 130)
    ]


@pytest.mark.parametrize(
    "question", [Question("map", "tip", LATEST), Question("map", "nobody", 50), Question("map", "other", 50)]
)
def test_without_a_stamp_or_a_path_there_are_none(question: Question) -> None:
    assert limits(*TWO_EDGES, moving("elsewhere", "other", 0), question=question) == []


def test_an_edge_that_keeps_everything_has_none() -> None:
    assert limits(*TWO_EDGES, keep=None) == []
    assert limits(moving("map", "tip", 0), moving("map", "tip", 90), keep=None) == []


def test_the_first_sample_of_an_edge_decides() -> None:
    live = live_tree(100e-9)
    live.insert(TWO_EDGES)
    live.reset(60, 0)
    live.insert((moving("map", "mid", 10),))
    assert limits_of(live.forest, Question("map", "tip", 50), "mid") == [("tip", 50)]
    # It had come too late for this stamp.
    assert limits_of(live.forest, Question("map", "mid", 5), None) == [("mid", 5)]


def test_a_tolerance_moves_the_stamp() -> None:
    question = Question("map", "tip", 50, policy=Policy(tolerance=10))
    assert limits(*TWO_EDGES, question=question) == [("tip", 120), ("mid", 160)]


def test_with_a_greatest_gap_the_sample_after_the_stamp_decides() -> None:
    assert limits(*TWO_EDGES, question=Question("map", "tip", 50, policy=Policy(max_gap=40))) == [
        ("tip", 60),
        ("mid", 130),
    ]
    assert limits(*TWO_EDGES, question=Question("map", "tip", 50, policy=Policy(max_gap=5))) == [
        ("tip", 50),
        ("mid", 50),
    ]


def test_time_travel_has_the_limits_of_both_halves() -> None:
    question = Question("map", "tip", 50, source_at=25, fixed="mid")
    assert limits(*TWO_EDGES, question=question) == [("mid", 130), ("tip", 120)]
    latest = Question("map", "tip", LATEST, source_at=25, fixed="mid")
    assert limits(*TWO_EDGES, question=latest) == [("tip", 120)]


def test_both_ways_round_a_loop_above_the_path_have_their_limits() -> None:
    # Until 10, b is above c; then the newest path from b over c to a holds as well, but has no samples before 0.
    live = live_tree(100e-9)
    live.insert((moving("b", "c", 0), moving("b", "c", 10), moving("root", "c", 20)))
    live.insert((moving("c", "a", 0), moving("c", "b", 0), moving("c", "a", 30), moving("c", "b", 30)))
    assert live.forest.find_path("a", "b", LATEST).permanent
    assert {child for child, _ in limits_of(live.forest, Question("a", "b", -1), None)} == {"a", "b", "c"}
    assert {child for child, _ in limits_of(live.forest, Question("a", "c", 50), None)} == {"a"}


def test_frames_that_form_a_loop_are_connected_once_one_of_them_loses_the_stamp() -> None:
    # At 50, a is on b and b on a; by the newest parents, both are on others.
    samples = [
        *(moving(parent, "a", at) for at, parent in ((0, "x"), (50, "b"), (55, "b"), (60, "x"))),
        *(moving(parent, "b", at) for at, parent in ((0, "y"), (40, "a"), (55, "a"), (60, "y"))),
    ]
    found = limits(*samples, question=Question("a", "b", 50))
    assert sorted(found) == [("a", 150), ("b", 140)]

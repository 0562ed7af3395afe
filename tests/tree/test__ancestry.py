import pytest
from support.samples import moving, static

from tfbus import TransformStamped
from tfbus.stamps import STAMP_MIN
from tfbus.tree.cycles import Loop, edges_above, names_below, past_loop
from tfbus.tree.forest import Forest


def forest(*batch: TransformStamped) -> Forest:
    made = Forest(None)
    for sample in batch:
        made.insert_judged(sample)
    return made


FRAMES = forest(
    static("root", "trunk"), moving("trunk", "left", 0), moving("left", "leaf", 0), moving("right", "leaf", 5)
).frames


def test_edges_above_are_found_by_every_parent_and_once() -> None:
    assert edges_above(FRAMES, ["leaf", "left"]) == {child: FRAMES[child] for child in ("leaf", "left", "trunk")}
    assert edges_above(FRAMES, ["root", "nowhere"]) == {}


@pytest.mark.parametrize(
    ("names", "above", "found"),
    [
        (["leaf", "left", "trunk"], {"left"}, {"leaf", "left"}),
        (["leaf", "left"], {"right"}, {"leaf"}),
        (["leaf"], {"root"}, {"leaf"}),
        (["trunk", "right"], {"left", "leaf"}, set()),
        (["root", "nowhere"], {"root", "nowhere", "left"}, {"root", "nowhere"}),
        ([], {"root"}, set()),
    ],
)
def test_names_below_are_those_that_are_asked_for(names: list[str], above: set[str], found: set[str]) -> None:
    assert names_below(FRAMES, names, above) == found


def test_walks_end_where_frames_have_been_each_others_parents() -> None:
    frames = forest(moving("b", "a", 0), moving("c", "a", 10), moving("a", "b", 5)).frames
    assert sorted(edges_above(frames, ["a"])) == ["a", "b"]
    assert names_below(frames, ["a", "b", "c"], {"b"}) == {"a", "b"}
    assert names_below(frames, ["a", "b", "c"], {"c"}) == {"a", "b", "c"}


@pytest.mark.parametrize(
    ("others", "sample", "loop"),
    [
        pytest.param(
            [moving("c", "a", 0), moving("b", "a", 5), moving("c", "a", 9)],
            moving("a", "b", 5),
            Loop(5, ("b", "a", "b")),
            id="both hold at the stamp",
        ),
        pytest.param(
            [moving("c", "a", 0), moving("b", "a", 5), moving("c", "a", 9)],
            moving("a", "b", 3),
            Loop(5, ("b", "a", "b")),
            id="the other one begins later",
        ),
        pytest.param(
            [moving("c", "a", 0), moving("b", "a", 5), moving("c", "a", 9)],
            moving("a", "b", 9),
            None,
            id="it has ended",
        ),
        pytest.param(
            [moving("c", "a", 0), moving("b", "a", 5), moving("c", "a", 9), moving("d", "b", 5)],
            moving("a", "b", 3),
            None,
            id="the sample has ended",
        ),
        pytest.param(
            [moving("c", "a", 0), moving("b", "a", 7), moving("c", "a", 9), moving("a", "b", 7)],
            moving("a", "b", 3),
            None,
            id="the loop is that of the next sample",
        ),
        pytest.param(
            [moving("b", "a", 5), moving("c", "a", 9)],
            moving("a", "b", 3),
            Loop(5, ("b", "a", "b")),
            id="before the oldest sample an edge does not count",
        ),
        pytest.param([moving("b", "a", 5), moving("c", "a", 9)], moving("a", "b", 20), None, id="in order"),
        pytest.param(
            [moving("b", "a", 5), moving("c", "a", 9)], static("a", "b"), Loop(5, ("b", "a", "b")), id="a static edge"
        ),
        pytest.param(
            [static("x", "a"), moving("b", "x", 5), moving("c", "x", 9)],
            moving("a", "b", 6),
            Loop(6, ("b", "a", "x", "b")),
            id="through a static edge",
        ),
        pytest.param(
            [moving("a", "x", 0), moving("x", "a", 5), moving("c", "x", 9), moving("c", "a", 9)],
            moving("a", "b", 5),
            None,
            id="above a loop of others",
        ),
    ],
)
def test_the_first_loop_in_the_time_of_a_sample_is_found(
    others: list[TransformStamped], sample: TransformStamped, loop: Loop | None
) -> None:
    frames = forest(*others, sample).frames
    assert past_loop(frames, sample.child, STAMP_MIN if sample.static else sample.stamp) == loop

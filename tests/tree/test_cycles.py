""""""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import pytest
from support.samples import moving, newest_samples, static

from tfbus import TransformStamped
from tfbus.stamps import STAMP_MIN
from tfbus.tree.cycles import Loop, admit, past_loop
from tfbus.tree.forest import Forest


@dataclass(frozen=True)
class KnownEdge:
    """The newest edge of a child, as plain data."""

    parent: str
    static: bool = False
    newest: int | None = None
    authority: str = ""


class CountedEdges(dict[str, Any]):
    """Counts how often an edge is looked up."""

    reads = 0

    def get(self, key: str, default: Any = None) -> Any:
        self.reads += 1
        return super().get(key, default)


def edges_of(*stored: TransformStamped) -> dict[str, KnownEdge]:
    """The newest edge of each child of some samples."""
    return {
        child: KnownEdge(sample.parent, sample.static, None if sample.static else sample.stamp, sample.authority)
        for child, sample in newest_samples(stored).items()
    }


def parents_of(edges: Mapping[str, KnownEdge]) -> set[str]:
    return {edge.parent for edge in edges.values()}


def samples_of(text: str) -> list[TransformStamped]:
    """Samples, each as PARENT>CHILD@STAMP, or as PARENT>CHILD if it is static."""
    edges = [(*edge.split(">"), at) for edge, _, at in (word.partition("@") for word in text.split())]
    return [moving(parent, child, int(at)) if at else static(parent, child) for parent, child, at in edges]


CHAIN = "map>base@10 base>tool@10"


@pytest.mark.parametrize(
    ("before", "batch", "refused"),
    [
        pytest.param(CHAIN, "tool>base@10", [0], id="a sample at the newest stamp"),
        pytest.param(CHAIN, "tool>base", [0], id="a static sample"),
        pytest.param(CHAIN, "tool>map@-5", [0], id="the first sample of a child"),
        pytest.param("map>base base>tool@10", "tool>base@1", [0], id="a moving sample of any stamp after a static one"),
        pytest.param("a>b b>c", "c>a", [0], id="static edges"),
        pytest.param(CHAIN, "base>map@11", [0], id="an edge turned round"),
        pytest.param("", "a>b@0 b>c@0 c>a@0", [2], id="a loop inside the batch"),
        pytest.param(CHAIN, "tool>map@11 tool>map@12 x>y@0", [1, 0], id="a loop that is closed twice"),
        pytest.param(CHAIN, "world>map@11 tool>map@12", [1], id="only the newer of two parents"),
        pytest.param(CHAIN, "world>map@0 tool>map", [1], id="a static sample after a moving one"),
        pytest.param("", "a>b@0 x>y@0 b>a@0 y>x@0", [3, 2], id="two loops"),
        pytest.param("a>b@0 b>a@0", "a>c@5", [], id="a loop that the batch does not change"),
    ],
)
def test_admit_refuses_the_last_samples_that_close_loops_of_newest_parents(
    before: str, batch: str, refused: list[int]
) -> None:
    edges, samples = edges_of(*samples_of(before)), samples_of(batch)
    accepted, errors = admit(edges, samples, parents_of(edges))
    assert accepted == tuple(sample for place, sample in enumerate(samples) if place not in refused)
    assert [(error.reason, error.parent, error.child) for error in errors] == [
        ("cycle", samples[place].parent, samples[place].child) for place in refused
    ]


@pytest.mark.parametrize("length", [2, 3, 9, 10, 1_000])
def test_the_error_names_the_whole_loop_and_its_message_at_most_ten_frames(length: int) -> None:
    names = [f"frame {number}" for number in range(length)]
    edges = edges_of(*(moving(parent, child, 0) for parent, child in pairwise(names)))
    _, (error,) = admit(edges, [moving(names[-1], names[0], 1, authority="somebody")], names)
    assert (error.reason, error.parent, error.child, error.authority) == ("cycle", names[-1], names[0], "somebody")
    assert error.loop == (names[0], *reversed(names))
    shown = error.loop if length < 10 else (*error.loop[:8], f"({length - 8} more)", names[0])
    assert str(error) == (f"the edge {names[-1]!r} -> {names[0]!r} would close a loop of parents: {' -> '.join(shown)}")


def test_the_error_names_the_authorities_of_the_other_edges_of_the_loop_sorted() -> None:
    edges = edges_of(
        moving("a", "b", 0, authority="slam"),
        moving("b", "c", 0, authority="arm"),
        moving("c", "d", 0),
        moving("x", "a", 0, authority="old"),
        moving("c", "y", 0, authority="elsewhere"),
    )
    _, (error,) = admit(edges, [moving("d", "a", 1, authority="culprit")], "abcd")
    assert str(error).endswith("a -> d -> c -> b -> a, with edges from 'arm' and 'slam'")


def test_a_batch_under_a_long_chain_is_judged_in_linear_time() -> None:
    links = 2_000
    edges = CountedEdges(edges_of(*(moving(f"f{i}", f"f{i + 1}", 0) for i in range(links))))
    leaves = [moving(f"f{links}", f"leaf {i}", 0) for i in range(links)]
    # As if a leaf might be a parent: all walks up to the root are one.
    _, refused = admit(edges, leaves, {*edges, *(sample.child for sample in leaves)})
    assert not refused
    assert edges.reads < 10 * links


def test_a_chain_that_grows_at_its_end_is_not_climbed() -> None:
    edges = CountedEdges(edges_of(*(moving(f"f{i}", f"f{i + 1}", 0) for i in range(2_000))))
    parents = parents_of(edges)
    for batch in ([moving("f2000", "a", 0)], [moving("f2000", "a", 0), moving("a", "b", 0), moving("b", "c", 0)]):
        edges.reads = 0
        assert admit(edges, batch, parents) == (tuple(batch), [])
        assert edges.reads < 10


def test_a_parent_that_is_remembered_without_a_sample_closes_no_loop() -> None:
    edges = {"a": KnownEdge("b"), **edges_of(moving("b", "c", 5))}
    assert admit(edges, [moving("a", "b", 0)], parents_of(edges))[1] == []


def test_names_that_are_no_longer_parents_do_no_harm() -> None:
    edges = edges_of(moving("a", "b", 0))
    assert admit(edges, [moving("b", "c", 0)], {"a", "c", "former"})[1] == []
    assert len(admit(edges, [moving("b", "a", 0)], {"a", "c", "former"})[1]) == 1


def forest_with(*batch: TransformStamped) -> Forest:
    made = Forest(None)
    for sample in batch:
        made.insert_judged(sample)
    return made


FROM_5_TO_9 = "b>a@5 c>a@9"
ROUND = ("b", "a", "b")


@pytest.mark.parametrize(
    ("others", "sample", "loop"),
    [
        pytest.param(f"c>a@0 {FROM_5_TO_9}", "a>b@5", Loop(5, ROUND), id="both hold at the stamp"),
        pytest.param(f"c>a@0 {FROM_5_TO_9}", "a>b@3", Loop(5, ROUND), id="the other one begins later"),
        pytest.param(f"c>a@0 {FROM_5_TO_9}", "a>b@9", None, id="it has ended"),
        pytest.param(f"c>a@0 {FROM_5_TO_9} d>b@5", "a>b@3", None, id="the sample has ended"),
        pytest.param("c>a@0 b>a@7 c>a@9 a>b@7", "a>b@3", None, id="the loop is that of the next sample"),
        pytest.param(FROM_5_TO_9, "a>b@3", Loop(5, ROUND), id="an edge begins with its oldest sample"),
        pytest.param(FROM_5_TO_9, "a>b@20", None, id="in order"),
        pytest.param(FROM_5_TO_9, "a>b", Loop(5, ROUND), id="a static edge"),
        pytest.param("x>a b>x@5 c>x@9", "a>b@6", Loop(6, ("b", "a", "x", "b")), id="through a static edge"),
        pytest.param("a>x@0 x>a@5 c>x@9 c>a@9", "a>b@5", None, id="above a loop of others"),
    ],
)
def test_the_first_loop_in_the_time_of_a_sample_is_found(others: str, sample: str, loop: Loop | None) -> None:
    (last,) = samples_of(sample)
    frames = forest_with(*samples_of(others), last).frames
    assert past_loop(frames, last.child, STAMP_MIN if last.static else last.stamp) == loop

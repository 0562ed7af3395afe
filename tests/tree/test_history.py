""""""

from collections.abc import Iterable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.samples import held

from tfbus import Outcome
from tfbus.rows import Row
from tfbus.tree.history import FrameHistory, Runs

INSERTED, REPLACED, EXPIRED = Outcome.INSERTED, Outcome.REPLACED, Outcome.EXPIRED


def row(x: float) -> Row:
    return x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0


def history(keep: int | None = None, stamps: Iterable[int] = ()) -> FrameHistory:
    """The frame 'child' on 'parent', at each stamp x equal to the stamp."""
    made = FrameHistory("child", "parent", static=False, keep=keep)
    for stamp in stamps:
        made.insert("parent", stamp, row(float(stamp)), "")
    return made


@pytest.mark.parametrize("parents", [1, 2])
@pytest.mark.parametrize("count", [pytest.param(200_000, marks=pytest.mark.thorough), 10_000], ids=["many", "some"])
def test_samples_take_no_more_memory_than_the_window_and_its_slack_also_after_a_clear(count: int, parents: int) -> None:
    samples = history(keep=1_000, stamps=[10**7])
    samples.clear()
    pose = row(1.0)
    for stamp in range(count):
        samples.insert(f"parent {stamp % parents}", stamp, pose, "")
        assert held(samples) < 1_150
    assert set(samples.named_parents) == {f"parent {number}" for number in range(parents)}


# Samples between two stamps


def test_samples_between_have_their_authorities_as_long_as_there_are_several_in_the_window() -> None:
    samples = history(keep=20)
    for stamp, authority in ((10, "first"), (20, "second"), (30, "second")):
        samples.insert("parent", stamp, row(0.0), authority)
    taken = samples.samples_between(10, 30)
    assert (taken.parents, taken.authorities) == (None, ["first", "second", "second"])
    samples.insert("parent", 40, row(0.0), "second")
    assert samples.samples_between(10, 40).authorities is None
    assert taken.authorities == ["first", "second", "second"], "the samples that were taken stay as they were"


STAMPS = st.integers(0, 20)


@given(st.lists(st.tuples(STAMPS, st.sampled_from("abc")), min_size=1), st.none() | st.integers(0, 12))
def test_each_stamp_has_the_name_that_a_plain_dict_of_all_samples_gives_it(
    samples: list[tuple[int, str]], keep: int | None
) -> None:
    runs = Runs()
    held: dict[int, str] = {}
    for stamp, name in samples:
        newest = max(held, default=None)
        if newest is None or stamp > newest:
            if newest is not None:
                runs = runs.push(stamp, name, held[newest])
        else:
            before = max((other for other in held if other < stamp), default=None)
            after = min((other for other in held if other > stamp), default=None)
            runs = runs.put(stamp, name, before, after, held[newest])
        held[stamp] = name
        if keep is not None:
            held = {other: held[other] for other in held if other >= max(held) - keep}
            names = set(runs.names())
            assert runs.forget_before(min(held)) or set(runs.names()) == names
        assert bool(runs) == (len(set(held.values())) > 1)
        if runs:
            ordered = sorted(held)
            assert {other: runs.at(other) for other in held} == held
            assert runs.at_all(np.array(ordered)) == [held[other] for other in ordered]
            # Before the first sample, and between two, the earlier name holds; before all, the oldest.
            assert runs.at(ordered[0] - 1) == held[ordered[0]]
            assert set(runs.names()) == set(held.values())
            changes = [b for a, b in pairwise(ordered) if held[a] != held[b]]
            assert runs.changes() == changes

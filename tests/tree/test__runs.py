from itertools import pairwise

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tfbus.tree.history import Runs

STAMPS = st.integers(0, 20)


@settings(max_examples=100)
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
                runs.push(stamp, name, held[newest])
        else:
            before = max((other for other in held if other < stamp), default=None)
            after = min((other for other in held if other > stamp), default=None)
            runs.put(stamp, name, before, after, held[newest])
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


def test_a_name_is_forgotten_once_the_next_one_holds_from_the_oldest_stamp_on() -> None:
    runs = Runs()
    for stamp, name, newest in ((10, "b", "a"), (20, "c", "b"), (30, "c", "c")):
        runs.push(stamp, name, newest)
    assert (runs.forget_before(9), runs.names(), runs.changes()) == (False, ("a", "b", "c"), [10, 20])
    assert (runs.forget_before(10), runs.names(), runs.changes()) == (True, ("b", "c"), [20])
    assert (runs.forget_before(19), runs.names(), [runs.at(stamp) for stamp in (5, 19, 20)]) == (
        False,
        ("b", "c"),
        ["b", "b", "c"],
    )
    assert (runs.forget_before(40), bool(runs)) == (True, False)
    assert not runs.forget_before(50)


def test_a_copy_is_independent() -> None:
    runs = Runs()
    runs.push(2, "b", "a")
    twin = runs.copy()
    runs.clear()
    assert not runs
    twin.push(3, "c", "b")
    assert (twin.at(1), twin.at(2), twin.at(3)) == ("a", "b", "c")

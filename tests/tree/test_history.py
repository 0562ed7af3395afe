import random
from collections.abc import Iterable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.histories import held

from tfbus import LATEST, SECOND, FutureExtrapolationError, Latest, Outcome, PastExtrapolationError
from tfbus.rows import Row
from tfbus.stamps import STAMP_MAX, STAMP_MIN
from tfbus.tree.history import FrameHistory

INSERTED, REPLACED, EXPIRED = Outcome.INSERTED, Outcome.REPLACED, Outcome.EXPIRED


def row(x: float) -> Row:
    return x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0


def history(keep: int | None = None, stamps: Iterable[int] = ()) -> FrameHistory:
    """The frame 'child' on 'parent', at each stamp x equal to the stamp."""
    made = FrameHistory("child", "parent", static=False, keep=keep)
    for stamp in stamps:
        made.insert("parent", stamp, row(float(stamp)), "")
    return made


def x_at(samples: FrameHistory, stamp: int) -> float:
    return samples.row_at(stamp)[0]


@pytest.mark.parametrize("order", ["ascending", "descending", "shuffled"])
def test_every_sample_is_read_back_at_its_stamp_for_any_order_of_insertion(order: str) -> None:
    stamps = list(range(1, 100))
    if order == "descending":
        stamps.reverse()
    elif order == "shuffled":
        random.Random(1).shuffle(stamps)
    samples = history()
    for stamp in stamps:
        assert samples.insert(f"parent {stamp}", stamp, row(2.0 * stamp), f"sender {stamp}") is INSERTED

    for stamp in stamps:
        assert x_at(samples, stamp) == 2.0 * stamp
        assert samples.parent_at(stamp) == f"parent {stamp}"
    assert (samples.parent, samples.authority) == ("parent 99", "sender 99")


@given(st.permutations(range(12)), st.data())
def test_out_of_order_inside_the_window_gives_the_same_as_in_order(order: list[int], data: st.DataObject) -> None:
    parents = data.draw(st.lists(st.sampled_from("pq"), min_size=12, max_size=12))
    in_order, shuffled = history(), history()
    for stamp in range(12):
        in_order.insert(parents[stamp], stamp, row(float(stamp * stamp)), parents[stamp])
    for stamp in order:
        shuffled.insert(parents[stamp], stamp, row(float(stamp * stamp)), parents[stamp])

    assert shuffled.edge() == in_order.edge()
    assert set(shuffled.named_parents) == set(in_order.named_parents)
    for stamp in range(-1, 13):
        assert shuffled.covers(stamp) == in_order.covers(stamp)
        assert shuffled.parent_at(stamp) == in_order.parent_at(stamp)
        if in_order.covers(stamp):
            assert shuffled.row_at(stamp) == in_order.row_at(stamp)


def test_a_sample_as_old_as_the_window_stays_and_one_nanosecond_older_goes() -> None:
    samples = history(keep=10, stamps=[0, 10])
    assert samples.oldest == 0
    samples.insert("parent", 11, row(11.0), "")
    assert samples.oldest == 10
    assert not samples.covers(9)


def test_late_samples_are_inserted_inside_the_window_and_expire_outside() -> None:
    samples = history(keep=10, stamps=[100])
    assert samples.insert("parent", 89, row(0.0), "") is EXPIRED
    assert samples.insert("parent", 90, row(90.0), "") is INSERTED
    assert (samples.oldest, len(samples)) == (90, 2)


def test_an_expired_sample_changes_nothing() -> None:
    samples = history(keep=10, stamps=[95, 100])
    before = samples.edge()
    assert samples.insert("other parent", 89, row(0.0), "late") is EXPIRED
    assert samples.edge() == before
    assert samples.named_parents == ("parent",)
    assert not samples.changed


def test_a_window_of_zero_keeps_only_the_newest_sample() -> None:
    samples = history(keep=0, stamps=[1, 2, 3])
    assert (samples.oldest, samples.newest, len(samples)) == (3, 3, 1)
    assert samples.insert("parent", 2, row(0.0), "") is EXPIRED


def test_without_a_window_the_whole_range_of_stamps_is_kept() -> None:
    samples = history(stamps=[STAMP_MAX, STAMP_MIN, 0])
    assert (samples.oldest, samples.newest) == (STAMP_MIN, STAMP_MAX)
    assert x_at(samples, STAMP_MIN) == float(STAMP_MIN)
    assert x_at(samples, 0) == 0.0


def test_the_window_does_not_overflow_at_either_end_of_the_range() -> None:
    samples = history(keep=100, stamps=[STAMP_MIN, STAMP_MIN + 100])
    assert samples.oldest == STAMP_MIN
    samples.insert("parent", STAMP_MAX, row(1.0), "")
    assert (samples.oldest, samples.newest) == (STAMP_MAX, STAMP_MAX)


@pytest.mark.parametrize("stamp", [1, 2, 3])
def test_of_two_samples_at_one_stamp_the_last_one_wins(stamp: int) -> None:
    samples = history(stamps=[1, 2, 3])
    assert samples.insert("parent", stamp, row(50.0), "corrected") is REPLACED
    assert x_at(samples, stamp) == 50.0
    assert len(samples) == 3
    assert samples.authority == ("corrected" if stamp == 3 else "")


def test_a_repeated_sample_is_stored_once() -> None:
    samples = history()
    outcomes = [samples.insert("parent", 5, row(1.0), "") for _ in range(100)]
    assert outcomes == [INSERTED] + [REPLACED] * 99
    assert len(samples) == samples.count == 1


def test_replacing_the_newest_sample_can_change_the_newest_parent() -> None:
    samples = history(stamps=[1, 2])
    samples.insert("other", 2, row(7.0), "sender")
    assert (samples.parent, samples.authority) == ("other", "sender")
    assert samples.changed
    assert (samples.parent_at(1), samples.parent_at(2)) == ("parent", "other")
    samples.insert("parent", 2, row(2.0), "")
    assert samples.named_parents == ("parent",)


def test_each_sample_keeps_its_own_parent() -> None:
    samples = history(stamps=[10, 20])
    samples.insert("new", 30, row(0.0), "")
    samples.insert("new", 40, row(0.0), "")
    assert [samples.parent_at(stamp) for stamp in (10, 20, 29, 30, 40)] == ["parent", "parent", "parent", "new", "new"]
    assert set(samples.named_parents) == {"parent", "new"}


def test_outside_the_window_the_parent_is_that_of_the_nearest_sample() -> None:
    samples = history(stamps=[10])
    samples.insert("new", 20, row(0.0), "")
    assert (samples.parent_at(-100), samples.parent_at(100)) == ("parent", "new")


# The window's slack, a sixteenth, is ten here: what has left the window is still in memory when the parent changes.
@pytest.mark.parametrize("switch", [200, 165, 170, 175])
def test_a_parent_is_forgotten_with_the_last_sample_in_the_window_that_names_it(switch: int) -> None:
    samples = history(keep=160, stamps=range(switch))
    for stamp in range(switch, switch + 200):
        samples.insert("new", stamp, row(0.0), "")
        oldest = max(0, stamp - 160)
        expected = {"parent", "new"} if oldest < switch else {"new"}
        assert set(samples.named_parents) == expected
        assert samples.parent_at(oldest) == ("parent" if oldest < switch else "new")


def test_a_new_parent_sets_changed_and_another_sample_of_the_same_parent_does_not() -> None:
    samples = history(keep=10, stamps=[0, 1])
    assert not samples.changed
    samples.insert("new", 2, row(0.0), "")
    assert samples.changed
    samples.changed = False
    samples.insert("new", 12, row(0.0), "")
    assert samples.changed, "the last sample on the old parent has left the window"


def test_an_older_oldest_sample_sets_changed() -> None:
    samples = history(stamps=[10, 20])
    samples.insert("parent", 15, row(0.0), "")
    assert not samples.changed
    samples.insert("parent", 5, row(0.0), "")
    assert samples.changed


def test_a_static_sample_holds_at_every_stamp() -> None:
    samples = FrameHistory("child", "parent", static=True, keep=10)
    assert samples.insert_static("parent", 3, row(1.0), "urdf") is INSERTED
    assert all(samples.covers(stamp) for stamp in (STAMP_MIN, -1, 0, 3, STAMP_MAX))
    assert (samples.oldest, samples.newest, samples.static_stamp, len(samples)) == (None, None, 3, 1)
    assert samples.authority == "urdf"


def test_a_new_static_sample_replaces_the_old_one_and_its_parent() -> None:
    samples = FrameHistory("child", "parent", static=True, keep=10)
    samples.insert_static("parent", 0, row(1.0), "")
    assert samples.insert_static("parent", 1, row(1.0), "") is REPLACED
    assert not samples.changed, "the same transform at another stamp is no news to a path"
    assert samples.insert_static("other", 2, row(2.0), "") is REPLACED
    assert samples.changed
    assert (samples.parent, samples.static_row, samples.static_stamp) == ("other", row(2.0), 2)


def test_a_static_sample_drops_the_moving_history() -> None:
    samples = history(stamps=[1, 2])
    samples.insert("other", 3, row(0.0), "")
    samples.changed = False
    assert samples.insert_static("third", 0, row(9.0), "urdf") is INSERTED
    assert samples.changed
    assert samples.static
    assert samples.named_parents == ("third",)
    assert (samples.oldest, samples.newest, len(samples)) == (None, None, 1)


def test_a_moving_sample_drops_the_static_one() -> None:
    samples = FrameHistory("child", "parent", static=True, keep=10)
    samples.insert_static("parent", 50, row(1.0), "urdf")
    samples.changed = False
    assert samples.insert("parent", 5, row(2.0), "odometry") is INSERTED
    assert samples.changed
    assert (samples.static, samples.static_stamp, samples.oldest, samples.newest) == (False, None, 5, 5)
    assert not samples.covers(50)


def test_clear_drops_the_samples_and_keeps_the_newest_parent() -> None:
    samples = history(keep=10, stamps=[100])
    samples.insert("new", 105, row(0.0), "sender")
    samples.clear()
    assert (samples.oldest, samples.newest, len(samples)) == (None, None, 0)
    assert (samples.parent, samples.authority, samples.named_parents) == ("new", "sender", ("new",))
    assert (samples.parent_changes(), samples.beginnings()) == ([], [])
    assert samples.insert("new", 3, row(1.0), "sender") is INSERTED, "the window starts anew, so time may run again"
    assert samples.beginnings() == [3]
    taken = samples.samples_between(0, 5)
    assert (taken.parents, taken.authorities) == (None, None)


def test_an_extrapolation_error_has_all_facts() -> None:
    samples = history(stamps=[10, 20])
    samples.insert("parent", 30, row(0.0), "odometry")
    future = samples.extrapolation_error(31)
    assert type(future) is FutureExtrapolationError
    assert (future.child, future.stamp, future.oldest, future.newest) == ("child", 31, 10, 30)
    assert future.authority == "odometry"
    assert (future.slack, samples.extrapolation_error(31, 5).slack) == (0, 5)
    past = samples.extrapolation_error(9)
    assert type(past) is PastExtrapolationError
    assert (past.child, past.stamp, past.oldest, past.newest) == ("child", 9, 10, 30)


def test_one_sample_answers_only_at_its_own_stamp() -> None:
    samples = history(stamps=[10])
    assert [samples.covers(stamp) for stamp in (9, 10, 11)] == [False, True, False]
    assert type(samples.extrapolation_error(9)) is PastExtrapolationError
    assert type(samples.extrapolation_error(11)) is FutureExtrapolationError


@pytest.mark.parametrize("stamp", [5, LATEST])
def test_an_empty_history_raises_a_future_extrapolation(stamp: int | Latest) -> None:
    error = history().extrapolation_error(stamp)
    assert type(error) is FutureExtrapolationError
    assert (error.oldest, error.newest) == (None, None)


def test_the_rate_is_the_mean_over_the_window() -> None:
    samples = history(keep=2 * SECOND, stamps=range(0, 10 * SECOND, SECOND // 100))
    assert samples.edge().rate == pytest.approx(100.0)
    assert history(stamps=[1]).edge().rate is None
    assert history().edge().rate is None


@given(
    st.lists(st.tuples(st.integers(0, 12), st.sampled_from("pq"), st.sampled_from(["", "sender"])), max_size=40),
    st.sampled_from([0, 5, 40, None]),
)
def test_the_fast_path_for_the_next_sample_equals_an_insertion(
    steps: list[tuple[int, str, str]], keep: int | None
) -> None:
    slow, quick = history(keep), history(keep)
    stamp = 0
    for count, (step, parent, authority) in enumerate(steps):
        stamp += step - 2
        pose = row(float(count))
        slow.insert(parent, stamp, pose, authority)
        quick.append(parent, stamp, pose, authority) or quick.insert(parent, stamp, pose, authority)
        assert quick.edge() == slow.edge()
        assert set(quick.named_parents) == set(slow.named_parents)
        for at in range(stamp - 6, stamp + 1):
            assert quick.covers(at) == slow.covers(at)
            if slow.covers(at):
                assert quick.row_at(at) == slow.row_at(at)


def test_the_fast_path_refuses_samples_that_are_not_the_next() -> None:
    samples = history(stamps=[10])
    assert not samples.append("parent", 10, row(0.0), "")
    assert not samples.append("parent", 9, row(0.0), "")
    assert not samples.append("other", 11, row(0.0), "")
    assert not samples.append("parent", 11, row(0.0), "somebody else")
    assert not history().append("parent", 11, row(0.0), "")
    assert samples.edge() == history(stamps=[10]).edge()


def test_a_copy_is_independent() -> None:
    samples = history(keep=100, stamps=[0, 10])
    samples.insert("other", 20, row(20.0), "sender")
    twin = samples.copy()
    before = twin.edge()
    samples.insert("third", 30, row(30.0), "")
    samples.insert("parent", 10, row(-1.0), "")
    assert twin.edge() == before
    assert x_at(twin, 10) == 10.0
    assert set(twin.named_parents) == {"parent", "other"}
    twin.clear()
    assert samples.newest == 30


def test_a_copy_with_another_window_has_the_valid_samples_and_expires_by_its_own_window() -> None:
    samples = history(keep=160, stamps=range(0, 170, 5))
    assert samples.oldest == 5
    long, short = samples.copy_within(None), samples.copy_within(100)
    assert (long.oldest, short.oldest) == (5, 65)
    assert long.insert("parent", 1, row(1.0), "") is INSERTED
    assert samples.insert("parent", 1, row(1.0), "") is EXPIRED
    assert short.insert("parent", 64, row(1.0), "") is EXPIRED
    short.insert("parent", 170, row(170.0), "")
    assert (short.oldest, long.oldest, samples.newest) == (70, 1, 165)


def test_a_copy_with_a_shorter_window_has_no_parent_outside_it() -> None:
    samples = history(keep=100, stamps=[0, 10])
    samples.insert("other", 20, row(20.0), "sender")
    both, one = samples.copy_within(20), samples.copy_within(5)
    assert (set(both.named_parents), set(one.named_parents)) == ({"parent", "other"}, {"other"})
    assert (one.mixed, one.changed) == (False, False)
    assert set(samples.named_parents) == {"parent", "other"}


def test_a_copy_of_a_static_or_empty_history_may_have_any_window() -> None:
    fixed = FrameHistory("child", "parent", static=True, keep=10)
    fixed.insert_static("parent", 3, row(1.0), "sender")
    assert fixed.copy_within(0).edge() == fixed.edge()
    emptied = history(stamps=[10])
    emptied.clear()
    twin = emptied.copy_within(5)
    assert (len(twin), twin.parent) == (0, "parent")
    assert twin.insert("parent", 1, row(1.0), "") is INSERTED


@pytest.mark.thorough
def test_a_million_samples_take_no_more_than_the_window_and_its_slack() -> None:
    samples = history(keep=1_000, stamps=[0])
    pose = row(1.0)
    largest = 0
    for stamp in range(1, 1_000_001):
        samples.append("parent", stamp, pose, "")
        largest = max(largest, held(samples))
    assert largest < 1_150


def test_the_window_applies_to_earlier_stamps_after_a_clear() -> None:
    samples = history(keep=1_000, stamps=[10**6])
    samples.clear()
    for stamp in range(10_000):
        samples.insert("parent", stamp, row(1.0), "")
        assert held(samples) < 1_150


def test_alternating_parents_take_no_more_memory_than_the_window() -> None:
    samples = history(keep=1_000, stamps=[0])
    for stamp in range(1, 20_000):
        samples.insert(f"parent {stamp % 2}", stamp, row(0.0), "")
        assert held(samples) < 1_150
    assert set(samples.named_parents) == {"parent 0", "parent 1"}


# What many lookups take


def test_parent_changes_are_the_stamps_of_samples_with_another_parent_than_before() -> None:
    samples = history(stamps=[10, 20])
    assert samples.parent_changes() == []
    for stamp, parent in ((30, "p"), (40, "p"), (50, "q"), (60, "p")):
        samples.insert(parent, stamp, row(0.0), "")
    assert samples.parent_changes() == [30, 50, 60]
    samples.insert("q", 25, row(0.0), "")
    assert samples.parent_changes() == [25, 30, 50, 60]


@settings(max_examples=100)
@given(
    st.lists(st.tuples(st.integers(0, 30), st.sampled_from("pq")), min_size=1, max_size=20), st.sampled_from([5, None])
)
def test_between_two_parent_changes_the_parent_is_constant(samples: list[tuple[int, str]], keep: int | None) -> None:
    made = FrameHistory("child", "p", static=False, keep=keep)
    for stamp, parent in samples:
        made.insert(parent, stamp, row(0.0), "")
    every = [made.parent_at(stamp) for stamp in range(-1, 32)]
    assert made.parent_changes() == [at for at in range(31) if every[at] != every[at + 1]]


@given(st.permutations(range(8)), st.integers(0, 70), st.integers(0, 70))
def test_samples_between_are_read_by_numpy_as_inserted(order: list[int], one: int, other: int) -> None:
    low, high = sorted((one, other))
    samples = FrameHistory("child", "parent", static=False, keep=None)
    for number in order:
        samples.insert("parent", 10 * number, (number, 0.1, -0.2, 0.5, 0.5, -0.5, 0.5), "")
    taken = samples.samples_between(low, high)
    # From the last sample not after the first stamp, to the first sample not before the last stamp.
    numbers = range(low // 10, -(-high // 10) + 1)
    assert taken.stamps.tolist() == [10 * number for number in numbers]
    assert taken.rows.tolist() == [[number, 0.1, -0.2, 0.5, 0.5, -0.5, 0.5] for number in numbers]
    assert taken.parents is None


def test_samples_between_are_copies() -> None:
    samples = history(stamps=[10, 20, 30])
    taken = samples.samples_between(10, 30)
    stamps, rows = taken.stamps, taken.rows
    samples.insert("parent", 40, row(40.0), "")
    samples.insert("parent", 20, row(-1.0), "")
    samples.clear()
    assert (stamps.tolist(), rows[:, 0].tolist()) == ([10, 20, 30], [10.0, 20.0, 30.0])


def test_samples_between_have_their_parents_if_there_are_several() -> None:
    samples = history(stamps=[10, 20])
    for stamp in (30, 40, 50):
        samples.insert("new", stamp, row(0.0), "")
    taken = samples.samples_between(15, 35)
    assert (list(taken.stamps), taken.parents) == ([10, 20, 30, 40], ["parent", "parent", "new", "new"])
    assert taken.authorities is None


def test_samples_between_have_their_authorities_as_long_as_there_are_several_in_the_window() -> None:
    samples = history(keep=20)
    for stamp, authority in ((10, "first"), (20, "second"), (30, "second")):
        samples.insert("parent", stamp, row(0.0), authority)
    taken = samples.samples_between(10, 30)
    assert (taken.parents, taken.authorities) == (None, ["first", "second", "second"])
    samples.insert("parent", 40, row(0.0), "second")
    assert samples.samples_between(10, 40).authorities is None
    assert taken.authorities == ["first", "second", "second"], "those that were taken stay"


def test_samples_between_are_inside_the_window() -> None:
    # The window's slack, a sixteenth, is ten here: what has left the window is still in memory.
    samples = history(keep=160, stamps=range(166))
    assert list(samples.samples_between(5, 6).stamps) == [5, 6]

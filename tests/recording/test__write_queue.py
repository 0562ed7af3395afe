import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.samples import any_samples, moving, static

from tfbus import TransformStamped
from tfbus.recording._write_queue import Backlog


def sizes(backlog: Backlog, size: int) -> list[int]:
    return [len(batch) for _, batch in backlog.take(size)]


def test_what_was_put_comes_out_in_order_with_its_time() -> None:
    backlog = Backlog(10)
    batches = [(moving("map", "a", 1),), (moving("map", "b", 2), static("map", "c"))]
    assert [backlog.put(7 + at, batch) for at, batch in enumerate(batches)] == [0, 0]
    assert len(backlog) == 3
    assert backlog.take(10) == [(7, batches[0]), (8, batches[1])]
    assert len(backlog) == 0
    assert backlog.take(10) == []


def test_whole_batches_are_taken_as_far_as_they_fit_and_one_at_least() -> None:
    backlog = Backlog(100)
    for size in (2, 3, 9, 1):
        backlog.put(0, tuple(moving("map", "a", stamp) for stamp in range(size)))
    assert sizes(backlog, 5) == [2, 3]
    assert sizes(backlog, 5) == [9]
    assert sizes(backlog, 5) == [1]


def test_the_oldest_batches_give_way_as_a_whole() -> None:
    backlog = Backlog(4)
    assert backlog.put(0, (moving("map", "a", 1), moving("map", "b", 1))) == 0
    assert backlog.put(1, (moving("map", "a", 2), moving("map", "b", 2))) == 0
    assert backlog.put(2, (moving("map", "a", 3),)) == 2
    assert backlog.dropped == 2
    assert [received for received, _ in backlog.take(10)] == [1, 2]


def test_a_batch_that_is_larger_than_the_capacity_stays_while_it_is_the_newest() -> None:
    backlog = Backlog(1)
    large = tuple(moving("map", "a", stamp) for stamp in range(5))
    assert backlog.put(0, large) == 0
    assert backlog.put(1, (moving("map", "a", 9),)) == 5


def test_static_samples_of_dropped_batches_come_first_with_their_own_times() -> None:
    backlog = Backlog(1)
    backlog.put(0, (static("map", "a"), moving("map", "b", 1)))
    backlog.put(1, (static("map", "c"), moving("map", "b", 2)))
    backlog.put(2, (moving("map", "b", 3),))
    assert len(backlog) == 3
    assert backlog.take(10) == [
        (0, (static("map", "a"),)),
        (1, (static("map", "c"),)),
        (2, (moving("map", "b", 3),)),
    ]


def test_batches_of_static_samples_alone_are_bounded_too() -> None:
    backlog = Backlog(3)
    for number in range(1_000):
        assert backlog.put(number, (static("map", f"s{number % 2}", x=float(number)),)) == 0
    assert len(backlog) == 5
    assert backlog.conflated == 995
    assert [sample.transform.translation[0] for _, (sample,) in backlog.take(10)] == [995, 996, 997, 998, 999]


def test_what_is_cleared_counts_as_dropped() -> None:
    backlog = Backlog(1)
    backlog.put(0, (static("map", "a"), moving("map", "b", 1)))
    backlog.put(1, (static("map", "c"), moving("map", "b", 2)))
    backlog.clear()
    assert (len(backlog), backlog.dropped) == (0, 4)
    assert backlog.put(2, (moving("map", "b", 3),)) == 0


@pytest.mark.parametrize("capacity", [0, -1])
def test_there_is_room_for_one_at_least(capacity: int) -> None:
    with pytest.raises(ValueError, match="at least 1"):
        Backlog(capacity)


steps = st.lists(st.lists(any_samples("abc", 3), min_size=1, max_size=5) | st.integers(1, 8), max_size=40)


@given(steps, st.integers(1, 6))
def test_the_books_balance_and_no_static_sample_is_lost(
    steps: list[list[TransformStamped] | int], capacity: int
) -> None:
    backlog = Backlog(capacity)
    put: list[TransformStamped] = []
    taken: list[tuple[int, TransformStamped]] = []
    for now, step in enumerate(steps):
        if isinstance(step, int):
            taken += [(received, sample) for received, batch in backlog.take(step) for sample in batch]
        else:
            backlog.put(now, tuple(step))
            put += step
    # Within the bound, but for one batch that is too large by itself.
    assert sum(not sample.static for sample in put) - backlog.dropped - sum(
        not sample.static for _, sample in taken
    ) <= max(capacity, 5)
    while entries := backlog.take(3):
        taken += [(received, sample) for received, batch in entries for sample in batch]
    assert len(put) == len(taken) + backlog.dropped + backlog.conflated
    assert backlog.dropped <= sum(not sample.static for sample in put)
    received = [received for received, _ in taken]
    assert received == sorted(received)
    newest = {sample.child: sample for sample in put if sample.static}
    assert {sample.child: sample for _, sample in taken if sample.static} == newest

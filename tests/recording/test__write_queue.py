import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.samples import any_samples, moving, static

from tfbus import QueueStatistics, TransformStamped
from tfbus.recording.recorder import WriteQueue


def slice_sizes(queue: WriteQueue, size: int) -> list[int]:
    return [len(batch) for _, batch in queue.get_slice(size)]


def test_batches_come_out_in_order_with_their_times() -> None:
    queue = WriteQueue(10)
    batches = [(moving("map", "a", 1),), (moving("map", "b", 2), static("map", "c"))]
    for published, batch in enumerate(batches, 7):
        queue.put(batch, published)
    assert len(queue) == 3
    assert queue.get_slice(10) == [(7, batches[0]), (8, batches[1])]
    assert len(queue) == 0
    assert queue.get_slice(10) == []


def test_a_slice_has_at_least_one_batch_and_otherwise_no_more_samples_than_its_size() -> None:
    queue = WriteQueue(100)
    for size in (2, 3, 9, 1):
        queue.put(tuple(moving("map", "a", stamp) for stamp in range(size)), 0)
    assert [slice_sizes(queue, 5) for _ in range(3)] == [[2, 3], [9], [1]]


def test_the_oldest_batches_are_dropped_whole() -> None:
    queue = WriteQueue(4)
    for published in range(2):
        queue.put((moving("map", "a", published), moving("map", "b", published)), published)
    assert queue.dropped == 0
    queue.put((moving("map", "a", 3),), 2)
    assert queue.dropped == 2
    assert [published for published, _ in queue.get_slice(10)] == [1, 2]


def test_static_samples_of_dropped_batches_come_first_with_their_own_times() -> None:
    queue = WriteQueue(1)
    queue.put((static("map", "a"), moving("map", "b", 1)), 0)
    queue.put((static("map", "c"), moving("map", "b", 2)), 1)
    queue.put((moving("map", "b", 3),), 2)
    assert len(queue) == 3
    assert queue.get_slice(10) == [
        (0, (static("map", "a"),)),
        (1, (static("map", "c"),)),
        (2, (moving("map", "b", 3),)),
    ]


def test_batches_of_static_samples_alone_are_bounded_and_the_replaced_ones_are_counted() -> None:
    queue = WriteQueue(3)
    for number in range(1_000):
        queue.put((static("map", f"s{number % 2}", x=float(number)),), number)
    assert queue.statistics("recording") == QueueStatistics("recording", "drop_oldest", 3, 5, 0, 995)
    assert [sample.transform.translation[0] for _, (sample,) in queue.get_slice(10)] == [995, 996, 997, 998, 999]


def test_cleared_samples_count_as_dropped() -> None:
    queue = WriteQueue(1)
    queue.put((static("map", "a"), moving("map", "b", 1)), 0)
    queue.put((static("map", "c"), moving("map", "b", 2)), 1)
    queue.clear()
    assert (len(queue), queue.dropped, queue.get_slice(10)) == (0, 4, [])
    queue.put((moving("map", "b", 3),), 2)
    assert (len(queue), queue.dropped) == (1, 4)


@pytest.mark.parametrize("capacity", [0, -1])
def test_a_capacity_below_one_is_refused(capacity: int) -> None:
    with pytest.raises(ValueError, match="at least 1"):
        WriteQueue(capacity)


steps = st.lists(st.lists(any_samples("abc", 3), min_size=1, max_size=5) | st.integers(1, 8), max_size=40)


def count_moving(samples: list[TransformStamped]) -> int:
    return sum(not sample.static for sample in samples)


@given(steps, st.integers(1, 6))
def test_every_sample_is_read_or_counted_and_the_newest_static_ones_are_read(
    steps: list[list[TransformStamped] | int], capacity: int
) -> None:
    queue = WriteQueue(capacity)
    put: list[TransformStamped] = []
    read: list[tuple[int, TransformStamped]] = []
    for now, step in enumerate(steps):
        if isinstance(step, int):
            read += [(published, sample) for published, batch in queue.get_slice(step) for sample in batch]
        else:
            queue.put(tuple(step), now)
            put += step
    # Within the capacity, except for a single batch that is larger.
    assert count_moving(put) - queue.dropped - count_moving([sample for _, sample in read]) <= max(capacity, 5)
    while batches := queue.get_slice(3):
        read += [(published, sample) for published, batch in batches for sample in batch]
    assert len(put) == len(read) + queue.dropped + queue.conflated
    assert queue.dropped <= count_moving(put)
    times = [published for published, _ in read]
    assert times == sorted(times)
    newest = {sample.child: sample for sample in put if sample.static}
    assert {sample.child: sample for _, sample in read if sample.static} == newest

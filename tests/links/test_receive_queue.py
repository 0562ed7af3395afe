import threading
from collections import Counter, deque
from functools import partial

from hypothesis import given
from hypothesis import strategies as st

from tfbus.links.receive_queue import MAX_BYTES, Arrival, Arrivals
from tfbus.statistics import QueueStatistics

MIB = 2**20


def message(content: object, size: int = 0) -> Arrival:
    return Arrival("peer", content, size, moving=True)


def kept(content: object, size: int = 0) -> Arrival:
    return Arrival("peer", content, size)


def drained(arrivals: Arrivals) -> list[object]:
    contents = []
    while (arrival := arrivals.get()) is not None:
        contents.append(arrival.content)
    return contents


def test_what_has_come_is_given_in_order_until_there_is_nothing() -> None:
    arrivals = Arrivals(10)
    assert arrivals.get() is None
    for arrival in (message(1), kept(2), message(3), kept(True)):
        arrivals.put(arrival)
    assert len(arrivals) == 4
    assert drained(arrivals) == [1, 2, 3, True]
    assert (len(arrivals), arrivals.get()) == (0, None)


def test_beyond_the_capacity_the_oldest_moving_ones_go_and_all_others_stay_in_order() -> None:
    arrivals = Arrivals(2)
    for arrival in (kept("a"), message(1), kept("b"), message(2), message(3), kept("c"), message(4)):
        arrivals.put(arrival)
    assert arrivals.statistics() == QueueStatistics("link", "drop_oldest", 2, pending=5, dropped=2)
    assert drained(arrivals) == ["a", "b", 3, "c", 4]


def test_what_does_not_move_takes_no_room_from_what_does() -> None:
    arrivals = Arrivals(1)
    for number in range(10_000):
        arrivals.put(kept(number))
    arrivals.put(message("last"))
    assert arrivals.statistics().dropped == 0
    assert drained(arrivals) == [*range(10_000), "last"]


def test_when_the_bytes_are_too_many_what_moves_goes_first_and_then_the_oldest_of_all_else() -> None:
    arrivals = Arrivals(1_000)
    for number in range(3):
        arrivals.put(kept(f"kept {number}", 15 * MIB))
        arrivals.put(message(number, 5 * MIB))
    arrivals.put(message("large", 15 * MIB))
    assert arrivals.statistics().dropped == 3
    arrivals.put(kept("kept 3", 15 * MIB))
    assert arrivals.statistics().dropped == 4
    arrivals.put(kept("kept 4", 15 * MIB))
    assert arrivals.statistics().dropped == 5
    assert drained(arrivals) == ["kept 1", "kept 2", "kept 3", "kept 4"]


def test_room_is_given_back_by_reading() -> None:
    arrivals = Arrivals(2)
    for number in range(1_000):
        arrivals.put(message(number, 16 * MIB))
        arrivals.put(kept(number, 16 * MIB))
        assert drained(arrivals) == [number, number]
    assert arrivals.statistics().dropped == 0


def test_what_is_larger_than_all_the_room_is_dropped() -> None:
    arrivals = Arrivals(2)
    arrivals.put(kept("small"))
    arrivals.put(message("huge", MAX_BYTES + 1))
    assert drained(arrivals) == ["small"]
    arrivals.put(kept("huge", MAX_BYTES + 1))
    arrivals.put(kept("small"))
    assert drained(arrivals) == ["small"]
    assert arrivals.statistics().dropped == 2


def test_things_of_no_size_are_not_without_number_either() -> None:
    arrivals = Arrivals(1)
    for number in range(400_000):
        arrivals.put(kept(number % 2 == 0))
    statistics = arrivals.statistics()
    assert statistics.pending <= 300_000
    assert statistics.pending + statistics.dropped == 400_000


def test_a_jump_back_discards_what_moves_and_counts_it() -> None:
    arrivals = Arrivals(3)
    for arrival in (kept("a", MIB), message(1, MIB), message(2), message(3), kept("b"), message(4)):
        arrivals.put(arrival)
    arrivals.discard_moving()
    assert arrivals.statistics() == QueueStatistics("link", "drop_oldest", 3, pending=2, dropped=4)
    for number in range(3):
        arrivals.put(message(number))
    assert arrivals.statistics().dropped == 4
    assert drained(arrivals) == ["a", "b", 0, 1, 2]


STEPS = st.lists(st.sampled_from(("message", "kept", "get", "get", "discard")), max_size=60)


@given(capacity=st.integers(1, 4), steps=STEPS)
def test_the_queue_does_what_a_list_would(capacity: int, steps: list[str]) -> None:
    arrivals = Arrivals(capacity)
    model: list[Arrival] = []
    dropped = 0
    for number, step in enumerate(steps):
        if step == "get":
            assert arrivals.get() == (model.pop(0) if model else None)
            continue
        if step == "discard":
            arrivals.discard_moving()
            gone = [arrival for arrival in model if arrival.moving]
        else:
            model.append(message(number) if step == "message" else kept(number))
            arrivals.put(model[-1])
            gone = [arrival for arrival in model if arrival.moving][:-capacity]
        model = [arrival for arrival in model if arrival not in gone]
        dropped += len(gone)
        assert (len(arrivals), arrivals.statistics().dropped) == (len(model), dropped)
    assert drained(arrivals) == [arrival.content for arrival in model]


def test_threads_that_put_while_others_take_lose_nothing_uncounted_and_keep_their_order() -> None:
    arrivals = Arrivals(50)
    done = threading.Event()
    taken: list[list[Arrival]] = [[], []]

    def put(name: str) -> None:
        for number in range(5_000):
            arrivals.put(Arrival(name, number, 10, moving=number % 3 > 0))

    def take(into: list[Arrival]) -> None:
        while not done.is_set() or len(arrivals):
            arrival = arrivals.get()
            if arrival is not None:
                into.append(arrival)

    takers = [threading.Thread(target=partial(take, into)) for into in taken]
    putters = [threading.Thread(target=partial(put, name)) for name in "abcd"]
    for thread in (*takers, *putters):
        thread.start()
    for thread in putters:
        thread.join(60)
    done.set()
    for thread in takers:
        thread.join(60)
        assert not thread.is_alive()
    everything = [arrival for into in taken for arrival in into]
    assert len(everything) + arrivals.statistics().dropped == 20_000
    assert Counter(arrival.sender for arrival in everything if not arrival.moving) == dict.fromkeys("abcd", 1_667)
    assert len({(arrival.sender, arrival.content) for arrival in everything}) == len(everything)
    for into in taken:
        last: dict[str, int] = {}
        queue = deque(into)
        while queue:
            arrival = queue.popleft()
            assert arrival.content > last.get(arrival.sender, -1)
            last[arrival.sender] = arrival.content

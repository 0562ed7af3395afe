import threading
from collections import Counter
from functools import partial

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tfbus.links.link import MANY, ReceiveQueue
from tfbus.links.seams import Joined, Left, Received

MIB = 2**20
ROOM = 64 * MIB
ITEM = 1_024
"""Bytes; more than an item takes besides its content."""


def moving(content: object, size: int = 0) -> Received:
    return Received("peer", content, size, moving=True)


def kept(content: object, size: int = 0) -> Received:
    return Received("peer", content, size)


def urgent(content: object, size: int = 0, *, follows: bool = False) -> Received:
    return Received("peer", content, size, urgent=True, follows=follows)


JOINED, LEFT = urgent(Joined()), urgent(Left())


def drained(queue: ReceiveQueue) -> list[object]:
    contents = []
    while (item := queue.get()) is not None:
        contents.append(item.content)
    return contents


@pytest.mark.parametrize("waiting", [0, 1, MANY - 1, MANY])
def test_urgent_items_overtake_what_waits_of_others(waiting: int) -> None:
    queue = ReceiveQueue(1_000)
    before = list(range(waiting))
    for number in before:
        queue.put(Received("other", number, moving=True))
    own, hurried = [-1, False], [Joined(), "question", "answer", Left()]
    for item in (moving(-1), kept(False), JOINED, urgent("question"), urgent("answer", follows=True), LEFT, moving(-2)):
        queue.put(item)
    assert len(queue) == waiting + 7
    # Messages that the peer sent before its answer are read before it, if they are not many.
    first = [*hurried[:2], *own, *hurried[2:]] if waiting < MANY else [*hurried[:3], *own, *hurried[3:]]
    assert drained(queue) == [*first, *before, -2]


def test_what_overtakes_has_a_bound_too() -> None:
    queue = ReceiveQueue(10)
    queue.put(urgent("large", ROOM + 1))
    assert (len(queue), queue.statistics().dropped) == (0, 1)
    for item in (urgent("small", MIB), moving(1, MIB), urgent("nearly all", ROOM - 2 * MIB)):
        queue.put(item)
    assert drained(queue) == ["small", "nearly all"], "moving items make room first"
    assert queue.statistics().dropped == 2


def test_what_is_read_before_the_end_of_a_peer_makes_room_too() -> None:
    queue = ReceiveQueue(2)
    for item in (moving(1), moving(2), LEFT, kept("a"), moving(3)):
        queue.put(item)
    assert queue.statistics().dropped == 1
    assert drained(queue) == [2, Left(), "a", 3], "the oldest moving item makes room"
    for item in (moving(1, MIB), LEFT, kept("a", ROOM - MIB)):
        queue.put(item)
    assert drained(queue) == [Left(), "a"], "moving items make room first"


def test_the_end_of_a_peer_comes_after_its_messages_and_before_it_joins_again() -> None:
    queue = ReceiveQueue(1_000)
    for item in (*map(moving, range(3)), LEFT, moving(-1), JOINED):
        queue.put(item)
    assert drained(queue) == [*range(3), Left(), Joined(), -1]
    # Waiting messages of others do not delay it.
    others = [Received("other", number, moving=True) for number in range(4)]
    for item in (*others[:2], moving("last"), *others[2:], LEFT, JOINED):
        queue.put(item)
    assert drained(queue) == ["last", Left(), Joined(), *range(4)]


@given(
    steps=st.lists(
        st.tuples(st.sampled_from("abc"), st.sampled_from(["live", "state", "answer", Joined(), Left(), "get"]))
    )
)
def test_nothing_is_lost_and_of_each_peer_only_its_coming_overtakes(steps: list[tuple[str, object]]) -> None:
    put: dict[str, list[tuple[int, object]]] = {"a": [], "b": [], "c": []}
    got: dict[str, list[tuple[int, object]]] = {"a": [], "b": [], "c": []}
    queue = ReceiveQueue(1_000)

    def get() -> bool:
        item = queue.get()
        if item is not None:
            got[item.sender].append((item.size, item.content))
        return item is not None

    for number, (sender, step) in enumerate(steps):
        if step == "get":
            get()
        else:
            put[sender].append((number, step))
            first = step == "answer" or isinstance(step, (Joined, Left))
            queue.put(Received(sender, step, number, step == "live", first, step == "answer"))
    while get():
        pass
    for sender, items in put.items():
        assert sorted(got[sender], key=lambda item: item[0]) == items
        in_order = [item for item in items if item[1] != Joined()]
        assert [item for item in got[sender] if item[1] != Joined()] == in_order


def test_beyond_the_bytes_moving_items_are_dropped_first_and_then_the_oldest_of_the_others() -> None:
    queue = ReceiveQueue(1_000)
    for number in range(3):
        queue.put(kept(f"kept {number}", 15 * MIB))
        queue.put(moving(number, 5 * MIB))
    queue.put(moving("large", 15 * MIB))
    assert queue.statistics().dropped == 3
    queue.put(kept("kept 3", 15 * MIB))
    assert queue.statistics().dropped == 4
    queue.put(kept("kept 4", 15 * MIB))
    assert queue.statistics().dropped == 5
    assert drained(queue) == ["kept 1", "kept 2", "kept 3", "kept 4"]


@pytest.mark.parametrize("end", ["read", "discarded"])
def test_an_item_may_fill_all_the_room_that_is_left(end: str) -> None:
    queue = ReceiveQueue(10)
    for item in (moving(1, MIB), kept("b", MIB)):
        queue.put(item)
    if end == "read":
        drained(queue)
    else:
        queue.discard_moving()
    dropped = queue.statistics().dropped
    queue.put(kept("all of it", ROOM - MIB * (end == "discarded") - 2 * ITEM))
    assert queue.statistics().dropped == dropped
    assert drained(queue)[-1] == "all of it"
    queue.put(kept("more", ROOM))
    assert (len(queue), queue.statistics().dropped) == (0, dropped + 1)


@pytest.mark.thorough
def test_the_number_of_items_without_content_is_bounded_too() -> None:
    queue = ReceiveQueue(1)
    for number in range(400_000):
        queue.put(kept(number % 2 == 0))
    statistics = queue.statistics()
    assert statistics.pending <= 300_000
    assert statistics.pending + statistics.dropped == 400_000


STEPS = st.lists(st.sampled_from(("moving", "kept", "get", "get", "discard")), max_size=60)


@given(capacity=st.integers(1, 4), steps=STEPS)
def test_the_queue_behaves_like_a_list(capacity: int, steps: list[str]) -> None:
    queue = ReceiveQueue(capacity)
    model: list[Received] = []
    dropped = 0
    for number, step in enumerate(steps):
        if step == "get":
            assert queue.get() == (model.pop(0) if model else None)
            continue
        if step == "discard":
            queue.discard_moving()
            gone = [item for item in model if item.moving]
        else:
            model.append(moving(number) if step == "moving" else kept(number))
            queue.put(model[-1])
            gone = [item for item in model if item.moving][:-capacity]
        model = [item for item in model if item not in gone]
        dropped += len(gone)
        assert (len(queue), queue.statistics().dropped) == (len(model), dropped)
    assert drained(queue) == [item.content for item in model]


def test_threads_that_put_and_get_at_once_lose_nothing_uncounted_and_keep_the_order() -> None:
    queue = ReceiveQueue(50)
    done = threading.Event()
    taken: list[list[Received]] = [[], []]

    def put(name: str) -> None:
        for number in range(5_000):
            queue.put(Received(name, number, 10, moving=number % 3 > 0))

    def take(into: list[Received]) -> None:
        while not done.is_set() or len(queue):
            item = queue.get()
            if item is not None:
                into.append(item)

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
    everything = [item for into in taken for item in into]
    assert len(everything) + queue.statistics().dropped == 20_000
    assert Counter(item.sender for item in everything if not item.moving) == dict.fromkeys("abcd", 1_667)
    assert len({(item.sender, item.content) for item in everything}) == len(everything)
    for into in taken:
        last: dict[str, int] = {}
        for item in into:
            assert item.content > last.get(item.sender, -1)
            last[item.sender] = item.content

import pytest

from tfbus import (
    AuthorityConflict,
    ClockReset,
    Event,
    FrameAdded,
    FrameRemoved,
    FrameStale,
    KindChanged,
    PastLoop,
    QueueStatistics,
    Reparented,
    SampleRejected,
    StampAhead,
)
from tfbus.bus.event_stream import EventQueue


def emptied(queue: EventQueue) -> list[Event]:
    events = []
    while (event := queue.get()) is not None:
        events.append(event)
    return events


def added(frame: str) -> FrameAdded:
    return FrameAdded(0, frame, "map", "", static=False)


def test_events_are_given_in_order() -> None:
    queue = EventQueue(10)
    happened: list[Event] = [added("a"), FrameRemoved(1, "a"), added("a"), ClockReset(0, 9)]
    for event in happened:
        queue.put(event)
    assert len(queue) == 4
    assert emptied(queue) == happened
    assert queue.dropped == 0


def test_a_full_queue_drops_and_counts_the_oldest_events() -> None:
    queue = EventQueue(2)
    for name in "abcde":
        queue.put(FrameRemoved(0, name))
    assert queue.statistics() == QueueStatistics("events", "drop_oldest", capacity=2, pending=2, dropped=3)
    assert emptied(queue) == [FrameRemoved(0, "d"), FrameRemoved(0, "e")]


def test_the_initial_events_come_first_and_are_never_dropped() -> None:
    known = [added(f"frame {number}") for number in range(50)]
    queue = EventQueue(1, known)
    queue.put(FrameRemoved(0, "frame 7"))
    queue.put(FrameRemoved(0, "frame 8"))
    assert (len(queue), queue.dropped) == (51, 1)
    assert emptied(queue) == [*known, FrameRemoved(0, "frame 8")]


def test_an_initial_event_of_a_frame_ahead_of_the_clock_is_given_once() -> None:
    ahead = StampAhead(1, "a", 10**9, "x")
    queue = EventQueue(10, [added("a"), ahead])
    queue.put(StampAhead(2, "a", 2 * 10**9, "x"))
    assert emptied(queue) == [added("a"), ahead]
    queue.put(StampAhead(3, "a", 10**9, "y"))
    assert emptied(queue) == [StampAhead(3, "a", 10**9, "y")]


def test_a_conflict_of_two_authorities_is_given_once_for_a_frame_until_it_is_removed() -> None:
    queue = EventQueue(100)
    one, two = AuthorityConflict(1, "a", "x", "y"), AuthorityConflict(1, "a", "y", "x")
    third, elsewhere = AuthorityConflict(2, "a", "x", "z"), AuthorityConflict(3, "b", "x", "y")
    for event in (one, two, one, third, one, third, elsewhere, elsewhere):
        queue.put(event)
    assert emptied(queue) == [one, third, elsewhere]
    queue.put(FrameRemoved(4, "a"))
    for event in (one, elsewhere):
        queue.put(event)
    assert emptied(queue) == [FrameRemoved(4, "a"), one]
    queue.put(ClockReset(0, 5))
    queue.put(elsewhere)
    assert emptied(queue) == [ClockReset(0, 5), elsewhere]


def test_in_a_conflict_each_parent_and_kind_of_an_authority_is_given_once() -> None:
    queue = EventQueue(100)
    queue.put(AuthorityConflict(0, "a", "x", "y"))
    to_p, to_q = Reparented(1, "a", "p", "q", "x"), Reparented(1, "a", "q", "p", "y")
    still, moves = KindChanged(1, "a", static=True, authority="x"), KindChanged(1, "a", static=False, authority="y")
    for _ in range(5):
        for event in (to_p, to_q, still, moves):
            queue.put(event)
    new = Reparented(2, "a", "r", "q", "x")
    queue.put(new)
    assert emptied(queue)[1:] == [to_p, to_q, still, moves, new]


def test_every_change_of_parent_by_a_single_authority_is_given() -> None:
    queue = EventQueue(100)
    queue.put(AuthorityConflict(0, "elsewhere", "x", "y"))
    taken, put_down = Reparented(1, "cup", "hand", "table", "x"), Reparented(2, "cup", "table", "hand", "x")
    froze = KindChanged(3, "cup", static=True, authority="x")
    for event in (taken, put_down, taken, put_down, froze, froze):
        queue.put(event)
    assert emptied(queue)[1:] == [taken, put_down, taken, put_down, froze, froze]


def rejected(frame: str | None, authority: str | None, reason: str = "authority") -> SampleRejected:
    return SampleRejected(1, reason, frame, "map", authority, ValueError())


def test_a_rejection_is_given_once_for_a_frame_authority_and_reason_until_the_frame_is_removed_added_or_reset() -> None:
    queue = EventQueue(100)
    different: list[Event] = [
        rejected("a", "x"),
        rejected("b", "x"),
        rejected("a", "y"),
        rejected("a", "x", "cycle"),
        rejected(None, None, "not a sample"),
    ]
    for event in different * 3:
        queue.put(event)
    assert emptied(queue) == different
    for end, again in (
        (FrameRemoved(2, "a"), [rejected("a", "x")]),
        (added("a"), [rejected("a", "x")]),
        (ClockReset(2, 3), [rejected("a", "x"), rejected("b", "x")]),
    ):
        for event in (end, *[rejected("a", "x"), rejected("b", "x")] * 2):
            queue.put(event)
        assert emptied(queue) == [end, *again]


def test_a_loop_in_the_past_is_given_once_for_a_frame_authority_and_parent() -> None:
    queue = EventQueue(100)
    loops: list[Event] = [
        PastLoop(1, frame, parent, authority, 0, (frame, parent, frame))
        for frame, parent, authority in (("a", "b", "x"), ("a", "c", "x"), ("a", "b", "y"), ("d", "b", "x"))
    ]
    for event in (*loops, *loops, rejected("a", "x", "b")):
        queue.put(event)
    assert emptied(queue) == [*loops, rejected("a", "x", "b")]


def test_a_rejection_is_no_conflict_of_authorities() -> None:
    queue = EventQueue(100)
    events: list[Event] = [rejected("cup", "x"), *[Reparented(1, "cup", "hand", "table", "y")] * 3]
    for event in events:
        queue.put(event)
    assert emptied(queue) == events


def test_memory_is_bounded_for_rejections_of_new_frames_and_authorities() -> None:
    queue = EventQueue(1)
    for number in range(3_000):
        queue.put(rejected(f"frame {number}", "x"))
        queue.put(rejected("frame 0", f"process {number}"))
    dropped = queue.dropped
    queue.put(rejected("frame 2999", "x"))
    queue.put(rejected("frame 2500", "x"))
    assert queue.dropped == dropped, "still remembered"
    queue.put(rejected("frame 1", "x"))
    assert queue.dropped == dropped + 1, "forgotten in favour of later ones"


def test_a_frame_that_changes_its_parent_all_the_time_does_not_displace_events_of_others() -> None:
    queue = EventQueue(5)
    others: list[Event] = [added("a"), Reparented(0, "b", "map", "odom", "x"), FrameRemoved(0, "a")]
    for event in others:
        queue.put(event)
    moves: list[Event] = []
    for stamp in range(100):
        moves += [Reparented(stamp, "cup", "hand", "table", ""), KindChanged(stamp, "cup", stamp % 2 == 0, "")]
    for event in moves:
        queue.put(event)
    assert queue.dropped == len(moves) - 2
    assert emptied(queue) == [*others, *moves[-2:]]


def test_staleness_events_come_next_and_are_never_dropped() -> None:
    queue = EventQueue(1)
    news = [FrameStale(5, f"frame {number}", 0, "") for number in range(10)]
    queue.put_staleness(news)
    queue.put(FrameRemoved(6, "frame 1"))
    queue.put(FrameRemoved(7, "frame 2"))
    assert queue.statistics() == QueueStatistics("events", "drop_oldest", capacity=1, pending=11, dropped=1)
    assert emptied(queue) == [*news, FrameRemoved(7, "frame 2")]


def test_memory_is_bounded_for_conflicts_of_new_authorities() -> None:
    queue = EventQueue(1)
    for number in range(1_000):
        queue.put(AuthorityConflict(0, "a", f"process {number}", f"process {number + 1}"))
    assert queue.dropped == 999
    queue.put(AuthorityConflict(0, "a", "process 998", "process 999"))
    assert queue.dropped == 999, "still remembered"
    queue.put(AuthorityConflict(0, "a", "process 0", "process 1"))
    assert queue.dropped == 1000, "forgotten in favour of the last hundred"


@pytest.mark.parametrize("capacity", [0, -1, 1.5, True])
def test_a_bad_capacity_is_an_error(capacity: int) -> None:
    with pytest.raises((TypeError, ValueError), match="capacity"):
        EventQueue(capacity)

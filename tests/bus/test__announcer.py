from collections import deque

from tfbus import ClockReset, Event, FrameRemoved
from tfbus.bus._announcer import Announcer


class Ears:
    """A listener that keeps what it is told."""

    def __init__(self) -> None:
        self.heard: list[Event] = []

    def put(self, event: Event) -> None:
        self.heard.append(event)


def test_everybody_who_is_in_the_list_at_the_moment_is_told_in_order() -> None:
    early, late = Ears(), Ears()
    listeners: deque[Ears] = deque()
    announcer = Announcer(lambda: 7, listeners)
    announcer.tell(FrameRemoved(0, "nobody hears it"))
    listeners.append(early)
    announcer.tell(FrameRemoved(1, "a"))
    listeners.append(late)
    announcer.tell(ClockReset(2, 9))
    listeners.remove(early)
    announcer.tell(FrameRemoved(3, "b"))
    assert early.heard == [FrameRemoved(1, "a"), ClockReset(2, 9)]
    assert late.heard == [ClockReset(2, 9), FrameRemoved(3, "b")]
    assert announcer.now() == 7


def test_it_is_false_while_nobody_listens() -> None:
    listeners: list[Ears] = []
    announcer = Announcer(lambda: 0, listeners)
    assert not announcer
    listeners.append(Ears())
    assert announcer

from collections import deque

from tfbus import ClockReset, Event, FrameRemoved
from tfbus.bus.subscribers import Announcer


class Recorder:
    """A listener that keeps its events."""

    def __init__(self) -> None:
        self.events: list[Event] = []

    def put(self, event: Event) -> None:
        self.events.append(event)


def test_an_event_goes_to_the_listeners_registered_when_it_is_announced() -> None:
    early, late = Recorder(), Recorder()
    listeners: deque[Recorder] = deque()
    announcer = Announcer(lambda: 7, listeners)
    announcer.announce(FrameRemoved(0, "nobody hears it"))
    listeners.append(early)
    announcer.announce(FrameRemoved(1, "a"))
    listeners.append(late)
    announcer.announce(ClockReset(2, 9))
    listeners.remove(early)
    announcer.announce(FrameRemoved(3, "b"))
    assert early.events == [FrameRemoved(1, "a"), ClockReset(2, 9)]
    assert late.events == [ClockReset(2, 9), FrameRemoved(3, "b")]
    assert announcer.now() == 7


def test_has_listeners_follows_registrations() -> None:
    listeners: list[Recorder] = []
    announcer = Announcer(lambda: 0, listeners)
    assert not announcer.has_listeners
    listeners.append(Recorder())
    assert announcer.has_listeners

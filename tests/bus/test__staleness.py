import random
from dataclasses import dataclass

from hypothesis import given
from hypothesis import strategies as st
from support.samples import moving, static
from support.wires import size_of

from tfbus import FrameLive, FrameStale
from tfbus.bus.event_stream import Staleness

LIMIT = 10


@dataclass(frozen=True)
class Known:
    newest: int | None
    authority: str = ""
    parent: str = "map"

    @property
    def static(self) -> bool:
        return self.newest is None


class World:
    """A stand-in for the frames of a bus, and for those who watch them."""

    def __init__(self) -> None:
        self.edges: dict[str, Known] = {}
        self.staleness = Staleness(LIMIT, self.edges.get)

    def send(self, frame: str, stamp: int | None) -> bool:
        known = self.edges.get(frame)
        if known is None or known.static != (stamp is None):
            # The bus announces new frames and other kinds.
            self.staleness.note(frame)
        before = None if known is None else known.newest
        newest = stamp if stamp is None or before is None else max(stamp, before)
        self.edges[frame] = Known(newest)
        sample = static("map", frame) if stamp is None else moving("map", frame, stamp)
        return self.staleness.arrived((sample,))

    def remove(self, frame: str) -> None:
        self.edges.pop(frame, None)
        self.staleness.forget(frame)


def test_a_frame_older_than_the_limit_is_announced_stale_once() -> None:
    world = World()
    world.send("a", 100)
    assert world.staleness.changes(100) == []
    assert world.staleness.due() == 111
    assert world.staleness.changes(110) == []
    assert world.staleness.changes(111) == [FrameStale(111, "a", 100, "")]
    assert world.staleness.changes(500) == []
    assert world.staleness.due() is None


def test_regular_samples_keep_a_frame_live() -> None:
    world = World()
    for stamp in range(100, 200, 9):
        world.send("a", stamp)
        assert world.staleness.changes(stamp + 9) == []
    assert world.staleness.due() == 199 + LIMIT + 1


def test_a_stale_frame_is_live_again_with_a_sample_that_is_recent_enough() -> None:
    world = World()
    world.send("a", 100)
    world.staleness.changes(200)
    assert world.send("a", 189)
    assert world.staleness.changes(200) == [], "newer, but still too old"
    assert world.send("a", 190)
    assert world.staleness.changes(200) == [FrameLive(200, "a", 190, "")]
    assert world.staleness.due() == 201
    assert not world.send("a", 195)
    assert world.staleness.changes(205) == []
    assert world.staleness.changes(206) == [FrameStale(206, "a", 195, "")]


def test_a_late_sample_of_a_stale_frame_changes_nothing() -> None:
    world = World()
    world.send("a", 100)
    world.staleness.changes(200)
    world.send("a", 50)
    assert world.staleness.changes(200) == []
    assert world.staleness.changes(111) == [], "only what arrived is looked at"


def test_static_frames_are_never_stale() -> None:
    world = World()
    world.send("a", None)
    world.send("b", 100)
    world.send("b", None)
    assert world.staleness.changes(500) == []
    assert world.staleness.due() is None


def test_a_stale_frame_that_becomes_static_is_live() -> None:
    world = World()
    world.send("a", 100)
    world.staleness.changes(200)
    assert world.send("a", None)
    assert world.staleness.changes(200) == [FrameLive(200, "a", None, "")]


def test_a_static_frame_that_becomes_moving_is_checked_from_its_newest_stamp() -> None:
    world = World()
    world.send("a", 100)
    world.send("a", None)
    assert world.send("a", 50)
    assert world.staleness.changes(60) == []
    assert world.staleness.due() == 61
    assert world.staleness.changes(61) == [FrameStale(61, "a", 50, "")]


def test_a_frame_that_was_static_for_a_while_turns_stale_once() -> None:
    world = World()
    for stamp in (100, None, 50):
        world.send("a", stamp)
        assert world.staleness.changes(60) == []
    assert world.staleness.changes(61) == [FrameStale(61, "a", 50, "")]
    assert world.staleness.changes(500) == []
    assert size_of(world.staleness) == 1, "only that it is stale"


def test_frames_turn_stale_in_the_order_of_their_newest_stamps() -> None:
    world = World()
    for name, stamp in (("a", 1), ("c", 3), ("b", 3), ("a", 5)):
        world.send(name, stamp)
    assert [event.frame for event in world.staleness.changes(100)] == ["b", "c", "a"]


def test_a_removed_frame_is_neither_stale_nor_live_and_may_return() -> None:
    world = World()
    world.send("a", 100)
    world.remove("a")
    assert world.staleness.changes(200) == []
    world.send("a", 200)
    world.staleness.changes(211)
    world.send("a", 211)
    world.remove("a")
    world.send("a", 300)
    assert world.staleness.changes(300) == []
    assert world.staleness.changes(311) == [FrameStale(311, "a", 300, "")]


def test_clear_forgets_every_frame() -> None:
    world = World()
    world.send("a", 100)
    world.send("b", 100)
    world.send("c", 150)
    world.staleness.changes(111)
    world.send("a", 111)
    world.edges.clear()
    world.staleness.clear()
    assert (size_of(world.staleness), world.staleness.due(), world.staleness.changes(500)) == (0, None, [])


def test_memory_is_bounded_for_frames_that_are_added_and_removed() -> None:
    world = World()
    world.send("base", 100)
    for number in range(10_000):
        world.send(f"object {number}", 101 + number)
        world.staleness.changes(100)
        world.remove(f"object {number}")
    assert size_of(world.staleness) < 200
    assert world.staleness.changes(111) == [FrameStale(111, "base", 100, "")]


def test_frames_turn_stale_in_order_when_most_others_were_removed() -> None:
    world = World()
    stamps = random.Random(1).sample(range(1_000), 500)
    for stamp in stamps:
        world.send(f"frame {stamp}", stamp)
    world.staleness.changes(0)
    kept = stamps[::10]
    for stamp in set(stamps) - set(kept):
        world.remove(f"frame {stamp}")
    stale = [event.frame for now in range(0, 1_100, 100) for event in world.staleness.changes(now + LIMIT)]
    assert stale == [f"frame {stamp}" for stamp in sorted(kept)]


def test_a_frame_that_is_removed_before_anybody_looks_leaves_no_entry() -> None:
    world = World()
    world.send("a", 100)
    world.remove("a")
    assert size_of(world.staleness) == 0


def test_a_sample_of_a_live_frame_adds_no_entry() -> None:
    world = World()
    world.send("a", 0)
    world.staleness.changes(0)
    before = size_of(world.staleness)
    for stamp in range(1, 1_000):
        assert not world.send("a", stamp)
    assert size_of(world.staleness) == before


STEPS = st.one_of(
    st.tuples(st.just("send"), st.sampled_from("abc"), st.integers(0, 60) | st.none()),
    st.tuples(st.just("remove"), st.sampled_from("abc"), st.none()),
    st.tuples(st.just("look"), st.just(""), st.integers(0, 8)),
)


@given(st.lists(STEPS, max_size=30))
def test_the_events_add_up_to_the_set_of_stale_frames(steps: list[tuple[str, str, int | None]]) -> None:
    world = World()
    announced: set[str] = set()
    now = 0
    for kind, frame, number in steps:
        if kind == "send":
            world.send(frame, number)
        elif kind == "remove":
            world.remove(frame)
            announced.discard(frame)
        else:
            events = world.staleness.changes(now)
            due = world.staleness.due()
            now += number or 0
            later = world.staleness.changes(now)
            assert not later or (due is not None and due <= now), "nothing changes before the announced time"
            events += later
            for event in events:
                assert (event.frame in announced) == isinstance(event, FrameLive)
                announced ^= {event.frame}
            stale = {
                name for name, known in world.edges.items() if known.newest is not None and known.newest + LIMIT < now
            }
            assert announced == stale

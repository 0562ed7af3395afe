import math
import random
import struct
import sys
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from itertools import groupby

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import strategies as some
from support.samples import moving, static
from support.wires import Domain, End, size_of
from tfbus.links._attachment import MAX_ENTRIES, Entry, PublishedBatch, pack
from tfbus.links._entries import MovingFrame, RemovedFrame
from tfbus.links._inbox import ReceivedBatch, ReceivedMessage
from tfbus.links._message import Message, read_message
from tfbus.links._mirror import Mirror
from tfbus.links._outbox import Outbox
from tfbus.links._peers import MAX_AUTHORITIES, MAX_PEERS
from tfbus.links._provenance import ReceivedTransform
from tfbus.links._receive_queue import Presence
from tfbus.links._relay import LARGEST_JUMP, Relay
from tfbus.links._state import StateStep, digest_moving

from tfbus import (
    Buffer,
    Bus,
    BusClosedError,
    FrameAdded,
    InvalidTransformError,
    PeerLost,
    PeerRejected,
    SimulatedClock,
    Transform,
    TransformStamped,
)
from tfbus.bus.ownership import OnConflict
from tfbus.tf_message import encode

ORIGIN, OTHER = b"0123456789abcdef", b"another origin !"
Batch = tuple[TransformStamped, ...]


class Wire(Domain):
    """Notes what goes out."""

    def __init__(self, receiver: "Receiver") -> None:
        super().__init__()
        self._receiver = receiver

    def put(self, sender: End, message: Message) -> None:  # noqa: ARG002 - there is only one
        self._receiver.sent.append(message)


class Receiver:
    """A bus with one link, the batches that it has heard, and peers whose messages a test writes by hand."""

    def __init__(
        self,
        frames: Collection[str] | None = None,
        max_frames: int = 10_000,
        on_conflict: OnConflict = "last",
        drop_lost: bool = False,
    ) -> None:
        self.bus = Bus(SimulatedClock(), on_conflict)
        self.bus._relay = Relay(self.bus, 0)
        self.heard: list[Batch] = []
        self.bus.subscribe(self.heard.append)
        self.end = Wire(self).join(self.bus, frames, max_frames, drop_lost)
        self.sent: list[Message] = []
        self.inbox = self.end.endpoint.inbox
        self.peers = self.end.endpoint.peers
        self._events = self.bus.events()

    @property
    def reports(self) -> list[tuple[str, str]]:
        """Peer and reason of each refusal that was announced since the last call."""
        events = iter(self._events.queue.get, None)
        return [(event.peer, event.reason) for event in events if isinstance(event, PeerRejected)]

    def receive_bytes(self, payload: bytes, attachment: bytes, sender: str = "peer") -> None:
        self.end.receive(sender, Message(payload, attachment, 0))

    def lose(self, sender: str = "peer") -> tuple[str, ...]:
        """A peer goes; returns the frames that the bus announces as lost with it."""
        with self.bus.events() as events:
            self.end.receive(sender, Presence.LEFT)
            (frames,) = (event.frames for event in iter(events.queue.get, None) if isinstance(event, PeerLost))
            return frames

    def turn(self) -> list[Message]:
        """End a turn of the event loop; returns the messages that go out."""
        self.sent.clear()
        self.end.endpoint.send()
        return self.sent

    def said(self) -> ReceivedBatch:
        """End a turn of the event loop; returns the one batch that goes out."""
        (message,) = self.turn()
        (entry,) = read_message(message.payload, message.attachment).entries
        assert isinstance(entry, ReceivedBatch)
        return entry

    def receive(
        self,
        *samples: TransformStamped,
        origin: bytes = ORIGIN,
        sequence: int = 1,
        number: int = 1,
        sender: str = "peer",
    ) -> None:
        """One batch in a message of its own."""
        self.receive_bytes(encode(samples), pack(number, [batch(samples, origin, sequence)]), sender)

    def remove(
        self, frame: str, origin: bytes = ORIGIN, sequence: int = 1, sender: str = "peer", lost: bool = False
    ) -> None:
        self.receive_bytes(encode(()), pack(1, [RemovedFrame(origin, sequence, frame, lost)]), sender)

    @property
    def frames(self) -> list[str]:
        """The children that the bus knows."""
        with self.bus.events() as events:
            return [event.frame for event in iter(events.queue.get, None) if isinstance(event, FrameAdded)]

    @property
    def counts(self) -> tuple[int, int, int, int]:
        """Messages, samples, duplicates, lost."""
        return self.inbox.messages, self.inbox.samples, self.inbox.duplicates, self.inbox.lost


@contextmanager
def receiver(
    frames: Collection[str] | None = None,
    max_frames: int = 10_000,
    on_conflict: OnConflict = "last",
    drop_lost: bool = False,
) -> Iterator[Receiver]:
    made = Receiver(frames, max_frames, on_conflict, drop_lost)
    yield made
    made.end.leave()


def batch(samples: Sequence[TransformStamped], origin: bytes = ORIGIN, sequence: int = 1) -> PublishedBatch:
    tags = groupby(samples, lambda sample: (sample.authority, sample.static))
    return PublishedBatch(origin, sequence, tuple((*tag, len(list(run))) for tag, run in tags))


def spoilt(samples: Sequence[TransformStamped], x: float = math.nan) -> bytes:
    """A message in which every x that was 7 m is something else."""
    return encode(samples).replace(struct.pack("<d", 7.0), struct.pack("<d", x))


# Good messages.


def test_a_message_is_published_batch_by_batch_with_everything_that_was_said() -> None:
    first = [moving("map", "a", 1, 1.0, "slam"), static("a", "b", 2.0, 5), moving("map", "c", 2, authority="odometry")]
    second = [moving("map", "a", 3, authority="slam")]
    entries: list[Entry] = [batch(first, ORIGIN, 8), RemovedFrame(OTHER, 9, "c"), batch(second, ORIGIN, 9)]
    with receiver() as here, Buffer(here.bus) as buffer:
        here.receive_bytes(encode([*first, *second]), pack(1, entries))
        assert here.heard == [tuple(first), tuple(second)]
        assert "c" not in buffer.tree
        assert buffer.lookup_nowait("map", "b", 1).transform.translation == (3.0, 0.0, 0.0)
        assert here.counts == (1, 4, 0, 0)
        assert here.turn() == [], "nothing goes back where it came from"


@given(samples=st.lists(some.samples(names=st.sampled_from("abc"), at=some.stamps(0, 2**60)), min_size=1, max_size=6))
def test_received_samples_are_published_to_the_bit(samples: list[TransformStamped]) -> None:
    with receiver() as here, Bus(SimulatedClock()) as there:
        heard: list[Batch] = []
        there.subscribe(heard.append)
        there.publish(samples, invalid="drop")
        here.receive(*samples)
        assert here.heard == heard
        for got in here.heard:
            assert all(type(sample) is ReceivedTransform and sample._provenance.origin == ORIGIN for sample in got)


def test_the_batches_of_a_message_that_was_kept_are_published_as_one() -> None:
    first, second = [static("map", "a"), moving("map", "b", 1)], [static("map", "c")]
    with receiver() as here:
        entries = [batch(first), batch(second, sequence=2)]
        here.receive_bytes(encode([*first, *second]), pack(0, entries))
        assert here.heard == [(*first, *second)]
        here.receive_bytes(encode([*first, *second]), pack(1, [batch(first, sequence=3), batch(second, sequence=4)]))
        assert here.heard[1:] == [tuple(first), tuple(second)], "live ones stay apart"
        # An answer is no live message either.
        here.end.receive("peer", Presence.JOINED)
        told = [ReceivedTransform("map", name, 2, Transform()) for name in "de"]
        batches: list[ReceivedBatch | RemovedFrame | MovingFrame] = [
            ReceivedBatch([sample], [], ORIGIN, 5 + number) for number, sample in enumerate(told)
        ]
        assert here.inbox.receive_answer("peer", ReceivedMessage(batches, step=StateStep(0, 2, 0, final=False)))
        assert here.heard[3:] == [tuple(told)]


def test_an_empty_message_and_an_empty_batch_call_no_subscriber() -> None:
    with receiver() as here:
        here.receive_bytes(encode(()), pack(1, []))
        here.receive_bytes(encode(()), pack(2, [PublishedBatch(ORIGIN, 1, ())]))
        assert (here.heard, here.counts) == ([], (2, 0, 0, 0))


def test_only_wanted_frames_come_in_or_go() -> None:
    with receiver(frames={"a", "s"}) as here, Buffer(here.bus) as buffer:
        here.bus.publish(moving("map", "c", 1))
        here.receive(moving("map", "a", 1), moving("map", "b", 1), static("map", "s"), sequence=1)
        here.receive(moving("a", "b", 1), sequence=2)
        here.remove("c", sequence=3)
        assert here.heard[1:] == [(moving("map", "a", 1), static("map", "s"))]
        here.remove("a", sequence=4)
        assert {frame for frame in buffer.tree.frames() if buffer.tree.parent(frame)} == {"c", "s"}
        assert here.counts == (4, 2, 0, 0)


# Numbers.


@pytest.mark.parametrize(
    ("given", "lost"),
    [
        ((1, 2, 3), 0),
        ((1, 4, 5, 8), 4),
        ((7, 8), 0),
        ((1_000_000, 1_000_003), 2),
        ((5, 1, 2, 3), 0),
        ((5, 0, 0, 6), 0),
        ((0, 0, 0), 0),
        ((0, 5, 6), 0),
        ((1, 3, 3, 3), 1),
        ((1, 3, 2, 4), 1),
        ((1, 2**32 + 2), 2**32),
        ((1, 2**32 + 3), 0),
        ((1, 2**64 - 1), 0),
        ((1, 2**63, 2**64 - 1, 1, 2), 0),
        ((2**64 - 1, 1), 0),
    ],
    ids=str,
)
def test_gaps_in_the_numbers_of_a_peer_are_messages_that_were_lost(given: tuple[int, ...], lost: int) -> None:
    with receiver() as here:
        for stamp, number in enumerate(given):
            here.receive(moving("map", "a", stamp), sequence=stamp, number=number)
        assert here.counts == (len(given), len(given), 0, lost)


@pytest.mark.parametrize(
    ("second", "told"),
    [(1, 1), (2, 1), (3, 0), (2**33, 0)],
    ids=["of the same message", "without a gap", "after one lost message", "after a number that is made up"],
)
def test_a_claim_after_a_lost_message_is_not_believed(second: int, told: int) -> None:
    with receiver() as here:
        here.receive(moving("map", "a", 1), sequence=1, number=1)
        peer = here.peers.find("peer")
        assert peer is not None
        peer.mirror = mirror = Mirror(10)
        here.receive_bytes(encode(()), pack(second, [], StateStep(0, 1, 0)))
        assert mirror.number == told


def test_a_live_message_that_an_answer_has_overtaken_does_not_change_what_is_known_of_the_peer() -> None:
    with receiver() as here:
        peer = here.peers.find("peer")
        assert peer is not None
        peer.mirror = mirror = Mirror(10)
        # The answer told that frame "a" has gone by now.
        mirror.moving("b")
        mirror.answered(StateStep(0, 3, digest_moving("b")))
        assert mirror.agrees
        late: list[ReceivedBatch | RemovedFrame | MovingFrame] = [ReceivedBatch([], [], ORIGIN, 1), MovingFrame("a")]
        late.append(RemovedFrame(ORIGIN, 1, "b", lost=True))
        here.inbox.receive("peer", ReceivedMessage(late, 1, step=StateStep(0, 2, digest_moving("a"), message=1)))
        assert (mirror.agrees, "a" in mirror, "b" in mirror) == (True, False, True)
        # What an answer has not told yet is noted.
        now = StateStep(3, 4, digest_moving("a") ^ digest_moving("b"), message=2)
        here.inbox.receive("peer", ReceivedMessage([MovingFrame("a")], 2, step=now))
        assert (mirror.agrees, mirror.number, "a" in mirror) == (True, 4, True)


def test_when_a_peer_has_told_its_whole_state_the_frames_go_that_it_brings_no_more() -> None:
    with receiver() as here:
        here.end.receive("peer", Presence.JOINED)
        for name in "abc":
            here.receive(moving("map", name, 1), sequence=1)
        here.receive(moving("map", "d", 1), sequence=1, sender="other")
        first, last = StateStep(0, 1, 0, final=False), StateStep(1, 2, digest_moving("a") ^ digest_moving("c"))
        assert here.inbox.receive_answer("peer", ReceivedMessage([MovingFrame("a")], step=first))
        assert set(here.frames) == set("abcd"), "the rest may follow"
        assert here.inbox.receive_answer("peer", ReceivedMessage([MovingFrame("c")], step=last))
        assert set(here.frames) == set("acd")
        assert not here.inbox.receive_answer("peer", ReceivedMessage([MovingFrame("c")], step=last)), "told already"
        assert here.counts == (7, 4, 0, 0)


@pytest.mark.parametrize("told", [True, False])
def test_the_frames_of_a_peer_go_that_tells_of_a_state_without_any_change(told: bool) -> None:
    with receiver() as here:
        here.receive(moving("map", "b", 1), sequence=1, sender="other")
        here.receive(moving("map", "a", 1), sequence=1)
        here.lose()
        here.end.receive("peer", Presence.JOINED)
        here.receive(moving("map", "a", 2), sequence=2)
        if told:
            step = StateStep(0, 1, digest_moving("a"))
            assert here.inbox.receive_answer("peer", ReceivedMessage([MovingFrame("a")], step=step))
        assert set(here.frames) == {"a", "b"}
        peer = here.peers.find("peer")
        assert peer is not None
        assert peer.mirror is not None
        peer.mirror.asks()
        assert not here.inbox.receive_answer("peer", ReceivedMessage([], step=StateStep(0, 0, 0)))
        assert here.frames == ["b"]


def test_a_claim_that_is_near_a_large_number_is_believed() -> None:
    with receiver() as here:
        here.receive(moving("map", "a", 1), sequence=1, number=1)
        peer = here.peers.find("peer")
        assert peer is not None
        peer.mirror = mirror = Mirror(10)
        mirror.answered(StateStep(0, 2**40, 0))
        here.receive_bytes(encode(()), pack(2, [], StateStep(2**40, 2**40 + 1, 0)))
        assert (mirror.number, here.reports) == (2**40 + 1, [])


@pytest.mark.parametrize(("step", "refused"), [(2**32, []), (2**32 + 1, [("peer", "number")])])
def test_a_claim_of_more_changes_than_anybody_makes_is_refused(step: int, refused: list[tuple[str, str]]) -> None:
    with receiver() as here:
        here.receive(moving("map", "a", 1), sequence=1, number=1)
        peer = here.peers.find("peer")
        assert peer is not None
        peer.mirror = Mirror(10)
        here.receive_bytes(encode(()), pack(2, [], StateStep(0, step, 0)))
        assert here.reports == refused


def test_each_peer_has_numbers_of_its_own_and_begins_anew_when_it_comes_back() -> None:
    with receiver() as here:
        here.receive(moving("map", "a", 1), sequence=1, number=2)
        here.receive(moving("map", "a", 2), sequence=2, number=5)
        assert here.inbox.lost == 2
        here.receive(moving("map", "b", 1), sequence=1, number=9, sender="other")
        assert here.inbox.lost == 2
        here.lose()
        here.receive(moving("map", "b", 1), sequence=2, number=1)
        here.receive(moving("map", "b", 1), sequence=3, number=3)
        assert here.inbox.lost == 3


# What has come already.


def test_repeated_and_late_samples_are_counted_and_not_published() -> None:
    with receiver() as here:
        for sequence, stamp in ((5, 10), (5, 10), (4, 9), (6, 8), (1, 1)):
            here.receive(moving("map", "a", stamp), moving("map", f"new in {sequence}", 1), sequence=sequence)
        assert [[sample.child for sample in heard] for heard in here.heard] == [
            ["a", "new in 5"],
            ["new in 4"],
            ["a", "new in 6"],
            ["new in 1"],
        ]
        assert here.counts == (5, 6, 4, 0)


def test_other_origins_are_other_sources() -> None:
    with receiver() as here:
        here.receive(moving("map", "a", 10), origin=ORIGIN, sequence=5)
        here.receive(moving("map", "a", 9), origin=OTHER, sequence=1)
        assert here.counts == (2, 2, 0, 0)


def test_a_moving_sample_does_not_replace_a_static_one_that_was_said_later() -> None:
    with receiver() as here:
        here.receive(static("map", "a", 1.0), origin=ORIGIN, sequence=5)
        here.receive(moving("map", "a", 8), origin=OTHER, sequence=4)
        assert here.heard == [(static("map", "a", 1.0),)]
        here.receive(moving("map", "a", 9), origin=OTHER, sequence=6)
        assert here.heard[1:] == [(moving("map", "a", 9),)]


# What was removed.


def test_an_older_removal_spares_newer_samples() -> None:
    with receiver() as here:
        here.receive(moving("map", "a", 5), sequence=5)
        here.remove("a", sequence=4)
        assert here.bus.statistics().frames == 1
        here.remove("a", sequence=6)
        assert here.bus.statistics().frames == 0
        # The frame may be another's by now, whose numbers are lower.
        here.receive(moving("map", "b", 5), sequence=8)
        here.receive(moving("map", "b", 6), origin=OTHER, sequence=3)
        here.remove("b", sequence=7)
        assert here.frames == ["b"]
        here.remove("b", sequence=9)
        assert here.frames == []


def test_of_what_two_buses_say_of_a_frame_a_removal_below_the_other_word_changes_nothing() -> None:
    with receiver() as here:
        here.receive(static("map", "s"), moving("map", "a", 1), origin=OTHER, sequence=9)
        here.remove("s", sequence=5)
        here.remove("a", sequence=5)
        assert set(here.frames) == {"s", "a"}
        here.remove("s", sequence=12)
        here.remove("s", origin=OTHER, sequence=10)
        here.receive(static("map", "s"), sequence=11)
        assert here.frames == ["a"], "the removal of the higher number is the one that holds"
        here.receive(static("map", "s"), origin=OTHER, sequence=13)
        assert set(here.frames) == {"s", "a"}
        # So it is for a bus that had never said anything of the frame.
        here.remove("a", sequence=15)
        for sequence in (14, 16):
            here.receive(moving("map", "a", sequence), origin=b"a third origin !", sequence=sequence)
            assert ("a" in here.frames) is (sequence > 15)


def test_a_removed_frame_comes_back_only_with_a_higher_number() -> None:
    with receiver() as here:
        here.receive(moving("map", "a", 1), sequence=1)
        here.remove("a", sequence=3)
        here.receive(moving("map", "a", 2), sequence=2)
        here.receive(moving("map", "a", 3), sequence=3)
        assert here.bus.statistics().frames == 0
        here.receive(moving("map", "a", 4), sequence=4)
        assert here.bus.statistics().frames == 1
        assert here.counts[1:3] == (2, 2)


def test_a_removal_that_overtakes_its_samples_is_remembered() -> None:
    with receiver() as here:
        here.remove("a", sequence=2)
        here.receive(moving("map", "a", 1), moving("map", "b", 1), sequence=1)
        assert [[sample.child for sample in heard] for heard in here.heard] == [["b"]]


def test_a_repeated_removal_spares_samples_that_others_have_published_since() -> None:
    with receiver() as here:
        here.receive(moving("map", "a", 1), sequence=1)
        here.remove("a", sequence=2)
        here.receive(moving("map", "a", 1), origin=OTHER, sequence=3)
        here.remove("a", sequence=2)
        assert here.bus.statistics().frames == 1
        here.bus.remove_frame("a")
        here.bus.publish(static("map", "a"))
        here.remove("a", sequence=2)
        assert here.bus.statistics().frames == 1


def test_removing_the_frame_of_others_removes_their_samples_up_to_now() -> None:
    with receiver() as here:
        here.receive(moving("map", "a", 5), sequence=5)
        here.remove("a", origin=OTHER, sequence=6)
        here.receive(moving("map", "a", 4), sequence=4)
        here.receive(moving("map", "a", 5), sequence=5)
        assert here.bus.statistics().frames == 0
        here.receive(moving("map", "a", 6), sequence=7)
        here.bus.remove_frame("a")
        here.receive(moving("map", "a", 6), sequence=7)
        assert here.bus.statistics().frames == 0


def test_of_very_many_removals_the_highest_number_is_remembered_for_live_messages() -> None:
    with receiver() as here:
        for start in (10, 6_010):
            entries: list[Entry] = [RemovedFrame(ORIGIN, start + n, f"{start + n}") for n in range(6_000)]
            here.receive_bytes(encode(()), pack(start, entries))
        here.receive(moving("map", "10", 1), sequence=9, number=20_000)
        here.receive(moving("map", "new", 1), sequence=8, number=20_001)
        assert here.heard == []
        here.receive(moving("map", "new", 1), origin=OTHER, sequence=8, number=20_002)
        here.receive(static("map", "old"), sequence=1, number=0)
        here.receive(moving("map", "10", 1), sequence=20_000, number=20_003)
        # So does what is told of the last seconds.
        past = ReceivedTransform("map", "past", 1, Transform())
        here.inbox.receive_history("peer", ReceivedMessage([ReceivedBatch([past], [], ORIGIN, 2)]))
        assert [[sample.child for sample in heard] for heard in here.heard] == [["new"], ["old"], ["10"], ["past"]]
        assert here.counts[:3] == (8, 4, 2)


@pytest.mark.thorough
def test_removals_of_very_many_origins_are_not_remembered_without_end() -> None:
    with receiver() as here:
        for number in range(15_000):
            here.remove("a", origin=number.to_bytes(16))
        assert 10_000 <= size_of(here.end.relay) < 11_100


def test_the_loss_of_a_frame_removes_only_what_that_peer_has_brought() -> None:
    with receiver() as here:
        for name in "abcd":
            here.receive(moving("map", name, 1), sequence=1, sender="bridge")
        here.receive(moving("map", "b", 1), sequence=2, sender="other")
        here.bus.publish(static("map", "c"))
        for name in "abcde":
            here.remove(name, origin=OTHER, sequence=9, sender="bridge", lost=True)
        assert set(here.frames) == {"b", "c"}
        here.receive(moving("map", "d", 0), sequence=0, sender="bridge")
        here.receive(moving("map", "d", 1), sequence=1, sender="other")
        assert set(here.frames) == {"b", "c"}, "what is still on its way does not bring it back"
        here.receive(moving("map", "d", 1), sequence=1, sender="bridge")
        assert set(here.frames) == {"b", "c", "d"}, "but who had lost it has it again"
        here.remove("d", origin=OTHER, sequence=9, sender="bridge", lost=True)
        here.receive(moving("map", "d", 1), sequence=1, sender="new")
        assert set(here.frames) == {"b", "c", "d"}, "and so has who has come since then"


@pytest.mark.parametrize(("kind", "lost", "told"), [("static", True, 1), ("static", False, 0), ("moving", True, 0)])
def test_of_a_loss_only_those_are_told_again_who_bring_a_late_static_sample(kind: str, lost: bool, told: int) -> None:
    sample = static("map", "a") if kind == "static" else moving("map", "a", 1)
    with receiver() as here:
        here.receive(sample, sequence=1, sender="bridge")
        here.receive(moving("map", "b", 1), sequence=1)
        here.remove("a", origin=OTHER, sequence=9, sender="bridge", lost=lost)
        here.turn()
        here.receive(sample, sequence=1)
        assert here.frames == ["b"]
        entries = [entry for sent in here.turn() for entry in read_message(sent.payload, sent.attachment).entries]
        losses = [(entry.frame, entry.lost) for entry in entries if isinstance(entry, RemovedFrame)]
        assert losses == [("a", True)] * told


def test_a_loss_is_passed_on_towards_the_owner_once_though_several_peers_tell_of_it() -> None:
    with receiver() as here:
        towards = Domain().join(here.bus)
        towards.receive("owner", Message(encode([static("map", "s")]), pack(1, [batch([static("map", "s")])]), 1))
        passed_on = []
        for sequence, sender in ((1, "a"), (9, "a"), (9, "b"), (10, "b"), (9, "c")):
            here.remove("s", origin=OTHER, sequence=sequence, sender=sender, lost=True)
            passed_on.append(towards.endpoint.outbox.flush().entries)
        assert here.frames == ["s"]
        losses = {number: [RemovedFrame(OTHER, number, "s", lost=True)] for number in (9, 10)}
        assert passed_on == [[], losses[9], [], losses[10], []]
        # The owner, too, loses it and has it again.
        for number, entry in ((2, RemovedFrame(OTHER, 11, "s", lost=True)), (3, batch([static("map", "s")]))):
            samples = [static("map", "s")] if number == 3 else []
            towards.receive("owner", Message(encode(samples), pack(number, [entry]), number))
            assert here.frames == ["s"] * (number == 3)
        towards.endpoint.outbox.flush()
        here.remove("s", origin=OTHER, sequence=10, lost=True)
        assert towards.endpoint.outbox.flush().entries == losses[10], "what was passed on before counts no more"
        towards.leave()


def test_after_a_loss_a_removal_counts_as_ever() -> None:
    with receiver() as here:
        here.receive(moving("map", "a", 1), sequence=18)
        here.remove("a", origin=OTHER, sequence=19)
        here.receive(moving("map", "a", 1), sequence=20)
        here.remove("a", origin=OTHER, sequence=15, lost=True)
        assert here.frames == []
        here.receive(moving("map", "a", 1), origin=OTHER, sequence=18)
        assert here.frames == []
        here.receive(moving("map", "a", 1), sequence=20)
        assert here.frames == ["a"]
        here.remove("a", sequence=30)
        here.receive(moving("map", "a", 1), sequence=20)
        assert here.frames == []


@pytest.mark.parametrize("drop", [True, False])
def test_after_the_loss_of_a_peer_only_later_peers_may_repeat_its_last_samples(drop: bool) -> None:
    with receiver(drop_lost=drop) as here:
        here.receive(moving("map", "b", 1), sequence=1, sender="old")
        here.receive(moving("map", "a", 5), sequence=5)
        assert here.lose() == ("a",)
        assert set(here.frames) == ({"b"} if drop else {"a", "b"})
        here.receive(moving("map", "a", 5), sequence=5, sender="old")
        here.receive(moving("map", "a", 4), sequence=4, sender="new")
        assert here.counts[1:3] == (2, 2)
        here.receive(moving("map", "a", 5), sequence=5)
        assert here.counts[1:3] == (3, 2)
        here.receive(moving("map", "a", 5), sequence=5, sender="new")
        assert here.counts[1:3] == (3, 3)


def test_beside_a_world_without_origins_a_moving_sample_that_passed_is_no_news_and_a_static_one_is_ranked() -> None:
    with receiver() as here:
        world = Outbox(None, lambda: None)
        here.end.relay.attach(world, foreign=True)
        here.bus.publish([moving("map", "a", 1), static("map", "s")])
        # They have gone round through that world and another bus.
        here.receive(moving("map", "a", 1), static("map", "s"), sequence=500)
        assert here.heard[1:] == [(static("map", "s"),)]
        assert here.counts == (1, 1, 1, 0)
        here.end.relay.detach(world)


def test_a_number_that_no_bus_can_have_given_is_refused_and_later_ones_are_news() -> None:
    with receiver() as here:
        here.receive(moving("map", "a", 1), sequence=7)
        for number in (2**64 - 1, 7 + LARGEST_JUMP + 1):
            here.receive(moving("map", "a", 2), moving("map", "b", 2), sequence=number)
            here.remove("a", sequence=number)
        assert here.peers.rejected == {"number": 6}
        assert here.frames == ["a"]
        here.receive(moving("map", "a", 3), sequence=8)
        here.receive(moving("map", "a", 4), sequence=8 + LARGEST_JUMP)
        assert here.counts[1:3] == (3, 0)


def test_a_number_of_this_bus_that_somebody_has_made_up_does_not_hide_what_it_says_later() -> None:
    with receiver() as here:
        here.bus.publish([static("map", "s", 1.0), static("map", "t"), moving("map", "m", 1)])
        here.turn()
        origin = here.end.relay.origin
        here.receive(static("map", "s", 2.0), moving("map", "m", 2), origin=origin, sequence=500)
        said_again = here.said()
        assert (said_again.origin, said_again.samples) == (origin, [static("map", "s", 1.0)])
        assert said_again.sequence > 500
        here.remove("t", origin=origin, sequence=900)
        said_again = here.said()
        assert (said_again.sequence > 900, said_again.samples) == (True, [static("map", "t")])
        here.bus.publish(moving("map", "m", 3))
        assert here.said().sequence > said_again.sequence
        assert [len(heard) for heard in here.heard] == [3, 1]


def test_what_this_bus_has_said_itself_last_comes_back_without_being_said_again() -> None:
    with receiver() as here:
        here.bus.publish(static("map", "s"))
        origin, number = here.end.relay.origin, here.said().sequence
        here.receive(static("map", "s"), origin=origin, sequence=number)
        here.remove("s", origin=origin, sequence=number)
        assert here.turn() == []
        # The next number is made up.
        here.receive(static("map", "s"), origin=origin, sequence=number + 1)
        number = here.said().sequence
        here.remove("s", origin=origin, sequence=number + 1)
        assert here.said().sequence > number + 1
        assert here.frames == ["s"]


def test_samples_of_this_bus_itself_are_no_news() -> None:
    with receiver() as here:
        here.receive(moving("map", "a", 1), origin=here.end.relay.origin, sequence=100)
        here.bus.publish(static("map", "s"))
        here.remove("s", origin=here.end.relay.origin, sequence=2**64 - 1)
        assert here.heard == [(static("map", "s"),)]
        assert here.counts == (2, 0, 1, 0)


# Refusals.


def test_invalid_samples_are_counted_by_reason_and_the_rest_of_their_batch_is_published() -> None:
    samples = [moving("map", "a", 1), moving("map", "bad", 1, 7.0), moving("map", "b", 1), moving("map", "bad", 2, 7.0)]
    with receiver() as here:
        entries = [batch(samples[:3]), batch(samples[3:], sequence=2)]
        for number in (1, 2):
            here.receive_bytes(spoilt(samples), pack(number, entries))
        assert here.heard == [(samples[0], samples[2])]
        assert here.peers.rejected == {"not finite": 4}
        assert here.reports == [("peer", "not finite")]
        assert here.counts == (2, 2, 2, 0)


def test_samples_that_only_the_bus_can_judge_are_refused_and_counted_there() -> None:
    with receiver(on_conflict="reject") as here:
        here.bus.publish([moving("map", "a", 1), moving("map", "mine", 1, authority="slam")])
        with here.bus.reserve("tool", authority="arm"):
            here.receive(
                moving("a", "map", 2),
                moving("map", "mine", 2, authority="rogue"),
                moving("map", "tool", 2, authority="rogue"),
                moving("map", "b", 2),
            )
        assert here.heard[1:] == [(moving("map", "b", 2),)]
        assert here.bus.statistics().rejected == {"cycle": 1, "authority": 1, "reserved": 1}
        assert here.peers.rejected == {}


def test_samples_that_close_a_loop_one_after_the_other_are_refused_and_the_bus_goes_on() -> None:
    with receiver() as here:
        here.receive(moving("a", "b", 1), moving("b", "c", 1), sequence=1)
        here.receive(moving("c", "a", 2), moving("x", "y", 2), moving("y", "x", 2), moving("map", "x", 2), sequence=2)
        here.receive(moving("map", "a", 3), moving("a", "b", 3), sequence=3)
        assert here.heard[1:] == [
            (moving("x", "y", 2), moving("y", "x", 2), moving("map", "x", 2)),
            (moving("map", "a", 3), moving("a", "b", 3)),
        ]
        assert here.bus.statistics().rejected == {"cycle": 1}


TWO = [moving("map", "a", 1), moving("map", "b", 1)]
MALFORMED = [
    pytest.param(encode(TWO), b"", "version", id="no attachment"),
    pytest.param(encode(TWO), b"\1" + bytes(60), "version", id="another version"),
    pytest.param(encode(TWO), pack(1, [batch(TWO)])[:-1], "attachment", id="cut off"),
    pytest.param(b"", pack(1, [batch(TWO)]), "truncated", id="no message"),
    pytest.param(encode(TWO)[:-1], pack(1, [batch(TWO)]), "truncated", id="a message cut off"),
    pytest.param(encode(TWO) + bytes(4), pack(1, [batch(TWO)]), "oversized", id="a message with more behind it"),
    pytest.param(b"\0\3" + encode(TWO)[2:], pack(1, [batch(TWO)]), "encoding", id="another encoding"),
    pytest.param(encode(TWO), pack(1, [batch(TWO[:1])]), "tags", id="a batch too small"),
    pytest.param(encode(TWO), pack(1, [batch(TWO), batch(TWO[:1])]), "tags", id="a batch too many"),
    pytest.param(encode(TWO), pack(1, []), "tags", id="no batch"),
    pytest.param(
        encode(TWO), pack(1, [PublishedBatch(ORIGIN, 1, (("", False, 2**32 - 1),) * 60_000)]), "tags", id="billions"
    ),
]


@pytest.mark.parametrize(("payload", "attachment", "reason"), MALFORMED)
def test_nothing_of_a_malformed_message_is_published(payload: bytes, attachment: bytes, reason: str) -> None:
    with receiver() as here:
        for _ in range(3):
            here.receive_bytes(payload, attachment)
        assert (here.heard, here.counts) == ([], (0, 0, 0, 0))
        assert here.peers.rejected == {reason: 3}
        assert here.reports == [("peer", reason)]
        here.receive(*TWO)
        assert here.heard == [tuple(TWO)]


# Limits.


def test_too_many_frames_of_a_peer_are_refused_and_counted() -> None:
    with receiver(max_frames=3) as here:
        here.receive(*[moving("map", f"{number}", 1) for number in range(5)], sequence=1)
        here.receive(*[moving("map", f"{number}", 2) for number in range(5)], sequence=2)
        assert [[sample.child for sample in heard] for heard in here.heard] == [["0", "1", "2"]] * 2
        assert here.peers.rejected == {"too many frames": 4}
        assert here.counts == (2, 6, 0, 0)
        here.receive(moving("map", "3", 1), sender="other", sequence=3)
        assert here.inbox.samples == 7, "what one peer has is nothing to another"


def test_several_samples_of_one_frame_in_a_batch_are_one_frame() -> None:
    with receiver(max_frames=2) as here:
        samples = [moving("map", name, stamp) for stamp in range(3) for name in "abc"]
        here.receive(*samples)
        assert here.heard == [tuple(sample for sample in samples if sample.child != "c")]
        assert here.peers.rejected == {"too many frames": 3}


def test_many_origins_do_not_get_around_the_limit() -> None:
    with receiver(max_frames=10) as here:
        for number in range(1_000):
            here.receive(moving("map", "a", number), origin=number.to_bytes(16), sequence=number)
            here.receive(moving("map", f"{number}", 1), origin=number.to_bytes(16), sequence=number)
        assert here.bus.statistics().frames <= 10
        assert here.inbox.samples == 10
        assert size_of(here.end.relay) < 100
        assert here.peers.rejected == {"too many frames": 1_990}


def test_removed_frames_no_longer_count_for_their_peer() -> None:
    with receiver(max_frames=2) as here:
        for number in range(20):
            here.receive(moving("map", f"{number}", 1), moving("map", f"{number} too", 1), sequence=10 * number)
            here.remove(f"{number}", sequence=10 * number + 1)
            here.bus.remove_frame(f"{number} too")
        assert here.inbox.samples == 40
        assert here.peers.rejected == {}


def test_removed_frames_that_the_bus_had_refused_no_longer_count_either() -> None:
    with receiver(max_frames=2) as here:
        here.bus.publish(moving("map", "base", 1))
        for number in range(20):
            here.receive(moving("base", "map", 1), moving("base", f"x{number}", 1), sequence=10 * number)
            here.remove("map", sequence=10 * number + 1)
            here.remove(f"x{number}", sequence=10 * number + 2)
        assert here.bus.statistics().rejected == {"cycle": 20}
        assert here.inbox.samples == 40
        assert here.peers.rejected == {}


@pytest.mark.parametrize("drop", [True, False])
def test_the_frames_of_a_lost_peer_no_longer_count(drop: bool) -> None:
    with receiver(max_frames=2, drop_lost=drop) as here:
        for number in range(20):
            here.receive(moving("map", f"{number}", 1), moving("map", f"{number} too", 1), sequence=number)
            peer = here.peers.find("peer")
            assert peer is not None
            here.lose()
            assert peer.frames == set()
        assert here.inbox.samples == 40


def test_batches_with_too_many_authorities_of_a_peer_are_refused_and_counted() -> None:
    with receiver() as here:
        for number in range(MAX_AUTHORITIES + 3):
            sample = moving("map", "a", number, authority=f"{number}")
            here.receive(sample, moving("map", "b", number, authority="0"), sequence=number)
        assert here.inbox.samples == 2 * MAX_AUTHORITIES
        assert here.peers.rejected == {"too many authorities": 6}
        here.receive(moving("map", "a", 1, authority="7"), sequence=10**6)
        here.receive(moving("map", "a", 1, authority="new"), sequence=10**6 + 1, sender="other")
        assert here.inbox.samples == 2 * MAX_AUTHORITIES + 2
        found = here.peers.find("peer")
        assert found is not None
        assert found.authorities == {f"{number}" for number in range(MAX_AUTHORITIES)}


def test_messages_of_too_many_peers_are_refused_and_counted() -> None:
    with receiver() as here:
        for number in range(MAX_PEERS + 5):
            here.receive(moving("map", "a", number), sequence=number, sender=f"{number}")
        assert here.inbox.samples == MAX_PEERS
        assert here.peers.rejected == {"too many peers": 5}
        assert here.reports == [(f"{MAX_PEERS}", "too many peers")]


def test_an_evicted_peer_that_comes_back_has_its_frames_again() -> None:
    with receiver(drop_lost=True) as here:
        here.receive(moving("map", "a", 1), sender="evicted")
        for number in range(1, MAX_PEERS):
            here.receive(moving("map", "b", number), origin=OTHER, sequence=number, sender=f"{number}")
        here.end.receive("announced", Presence.JOINED)
        here.lose("announced")
        here.receive(moving("map", "a", 1), sender="evicted")
        assert here.peers.rejected == {}
        assert here.lose("evicted") == ("a",)


@pytest.mark.thorough
def test_removals_of_unknown_frames_do_not_reach_the_bus() -> None:
    entries: list[Entry] = [RemovedFrame(ORIGIN, number, f"no {number}") for number in range(MAX_ENTRIES)]
    calls: Counter[str] = Counter()
    with receiver() as here:
        here.bus.publish(moving("map", "a", 1))
        here.turn()
        sys.setprofile(lambda frame, event, _: calls.update([frame.f_code.co_name] if event == "call" else []))
        try:
            here.receive_bytes(encode(()), pack(1, entries))
            here.remove("a", sequence=MAX_ENTRIES)
        finally:
            sys.setprofile(None)
        assert calls["remove_frame"] == 1, "it would look at all names for each"
        assert here.bus.statistics().frames == 0
        assert len(here.turn()) == 0


# The end.


def test_a_closed_bus_takes_nothing_in() -> None:
    with receiver() as here:
        here.receive(moving("map", "a", 1))
        here.end.receive("peer", Presence.JOINED)
        here.bus.close()
        here.receive(moving("map", "a", 2), sequence=2)
        here.remove("a", sequence=3)
        told = ReceivedMessage([ReceivedBatch([], [], ORIGIN, 4)], step=StateStep(0, 1, 0))
        assert not here.inbox.receive_answer("peer", told)
        here.inbox.receive_history("peer", told)
        assert here.heard == [(moving("map", "a", 1),)]
        assert here.counts == (1, 1, 0, 0)


def test_what_a_peer_tells_that_has_gone_is_not_taken() -> None:
    with receiver() as here:
        bad = InvalidTransformError("bad", reason="bad", parent="map", child="a", authority="")
        told = ReceivedMessage([ReceivedBatch([], [], ORIGIN, 1)], errors=[bad], step=StateStep(0, 1, 0))
        assert not here.inbox.receive_answer("peer", told)
        here.inbox.receive_history("peer", told)
        assert (here.counts, here.peers.rejected) == ((0, 0, 0, 0), {})
        # While it is there, what of that is invalid is counted, and only batches of known buses are of the past.
        told.entries += [RemovedFrame(ORIGIN, 2, "a"), MovingFrame("a"), ReceivedBatch([], [], None)]
        here.peers.find("peer")
        here.inbox.receive_history("peer", told)
        assert (here.counts, here.peers.rejected) == ((1, 0, 0, 0), {"bad": 1})


def test_a_subscriber_that_closes_the_bus_in_the_middle_of_a_message_ends_it() -> None:
    with receiver() as here:
        here.bus.subscribe(lambda _: here.bus.close())
        samples = [moving("map", "a", stamp) for stamp in range(3)]
        entries: list[Entry] = [batch(samples[:1]), RemovedFrame(ORIGIN, 2, "a"), batch(samples[1:], sequence=3)]
        here.receive_bytes(encode(samples), pack(1, entries))
        assert here.heard == [tuple(samples[:1])]
        with pytest.raises(BusClosedError):
            here.bus.publish(samples)


def test_a_peer_that_is_lost_when_the_bus_is_closed_does_no_harm() -> None:
    with receiver(drop_lost=True) as here:
        here.receive(moving("map", "a", 1))
        here.bus.close()
        here.end.receive("peer", Presence.LEFT)
        assert here.peers.forget("peer") is None
        assert here.peers.rejected == {}


# Anything at all.


def test_many_damaged_messages_do_no_harm() -> None:
    chance = random.Random(2)
    samples = [moving("map", "a", 1, authority="slam"), static("a", "b"), moving("b", "c", 1), moving("map", "d", 2)]
    entries: list[Entry] = [batch(samples[:2]), RemovedFrame(OTHER, 1, "c"), batch(samples[2:], OTHER, 2)]
    payload, attachment = encode(samples), pack(1, entries)
    with receiver(max_frames=50) as here:
        here.bus.subscribe(lambda _: None, lambda _: None)
        for _ in range(2_000):
            parts = [bytearray(payload), bytearray(attachment)]
            for _ in range(chance.randrange(1, 4)):
                part = parts[chance.randrange(2)]
                part[chance.randrange(len(part))] = chance.randrange(256)
            here.receive_bytes(bytes(parts[0]), bytes(parts[1]), f"peer {chance.randrange(3)}")
        assert here.bus.statistics().callbacks_failed == 0
        assert here.inbox.messages > 400
        assert sum(here.peers.rejected.values()) > 400
        assert here.bus.statistics().frames <= 150


names = st.sampled_from(("a", "b", "c", "map", "", "/a", "\0", "x" * 2_000))
any_batch = st.builds(
    PublishedBatch,
    st.sampled_from((ORIGIN, OTHER)),
    st.integers(0, 5) | st.integers(0, 2**64 - 1),
    st.lists(st.tuples(st.sampled_from(("", "slam")), st.booleans(), st.integers(0, 2)), max_size=2).map(tuple),
)
any_removal = st.builds(RemovedFrame, st.sampled_from((ORIGIN, OTHER)), st.integers(0, 5), names, st.booleans())


@given(
    messages=st.lists(
        st.tuples(st.lists(any_batch | any_removal, max_size=4), st.integers(0, 2**64 - 1), st.sampled_from("pq")),
        max_size=5,
    ),
    data=st.data(),
)
def test_messages_of_any_content_do_no_harm(messages: list[tuple[list[Entry], int, str]], data: st.DataObject) -> None:
    with receiver(max_frames=2) as here:
        for entries, number, sender in messages:
            count = sum(entry.count for entry in entries if isinstance(entry, PublishedBatch))
            count += data.draw(st.sampled_from((0, 0, 0, 1)))
            wanted = [
                data.draw(some.samples(names=st.sampled_from("abcd"), at=st.integers(0, 9))) for _ in range(count)
            ]
            try:
                attachment = pack(number, entries)
            except ValueError:
                continue
            here.receive_bytes(encode(wanted), attachment, sender)
        assert here.inbox.samples == sum(map(len, here.heard)) + sum(here.bus.statistics().rejected.values())

"""An endpoint's own behaviour; the other tests of this room drive whole networks of endpoints."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from support import wires
from support.samples import moving, static
from support.wires import Domain, ForeignCarrier, ForeignMessage, ForeignTransform, ForeignWorld
from tfbus.links._asker import FIRST_PAUSE, PATIENCE, SETTLING
from tfbus.links._endpoint import CLAIM_PERIOD, Endpoint
from tfbus.links._entries import OutgoingBatch
from tfbus.links._message import Message, write_answer
from tfbus.links._outbox import Turn
from tfbus.links._peers import MAX_PEERS
from tfbus.links._receive_queue import Answer, HistoryAnswer, Presence, Question, Received
from tfbus.links._state import StateStep

from tfbus import Bus, Event, SimulatedClock
from tfbus.events import PeerJoined, PeerLost, PeerRejected
from tfbus.tf_message import MalformedMessageError


class NotingCarrier(ForeignCarrier):
    """Notes what its link tells it."""

    def __init__(self) -> None:
        super().__init__(ForeignWorld())
        self.turns: list[Turn] = []

    def send(self, turn: Turn) -> None:
        self.turns.append(turn)


class Scene:
    """An endpoint of a bus whose clock stands at 7 ns."""

    def __init__(self, **options: Any) -> None:
        self.bus = Bus(SimulatedClock(start=7))
        self.carrier = NotingCarrier()
        self.notified = 0
        self.endpoint = Endpoint(self.bus, "world", self.carrier, self._note, **options)
        self.endpoint.attach()
        self._events = self.bus.events(stale_after=None)

    def _note(self) -> None:
        self.notified += 1

    def handle(self, *contents: object, sender: str = "driver") -> None:
        for content in contents:
            self.endpoint.handle(Received(sender, content))

    def told(self) -> list[Event]:
        """The events of links since the last call."""
        wanted = (PeerJoined, PeerLost, PeerRejected)
        return [event for event in iter(self._events.queue.get, None) if isinstance(event, wanted)]


@contextmanager
def scene(**options: Any) -> Iterator[Scene]:
    made = Scene(**options)
    yield made
    made.endpoint.detach()


def message(*children: str) -> ForeignMessage:
    return ForeignMessage(False, [ForeignTransform("map", child, 1, 0.0) for child in children])


def test_a_turn_goes_to_the_carrier_once_and_an_empty_one_never() -> None:
    with scene() as here:
        here.endpoint.send()
        here.bus.publish(moving("map", "a", 1))
        assert (here.notified, here.carrier.turns) == (1, [])
        here.endpoint.send()
        here.endpoint.send()
        (turn,) = here.carrier.turns
        assert [tuple(entry.samples) for entry in turn.entries if hasattr(entry, "samples")] == [
            (moving("map", "a", 1),)
        ]
        assert turn.statics == {}


def test_a_peer_is_announced_when_it_joins_and_leaves_and_the_carrier_knows_who_comes_again() -> None:
    with scene() as here:
        here.handle(Presence.JOINED, Presence.JOINED, message("b", "a"), Presence.LEFT, Presence.LEFT, Presence.JOINED)
        assert here.told() == [
            PeerJoined(7, "world", "driver"),
            PeerLost(7, "world", "driver", ("foreign",), ("a", "b")),
            PeerJoined(7, "world", "driver"),
        ]
        assert here.endpoint.peers.present == ("driver",)
        assert here.bus.statistics().frames == 2


def test_the_frames_of_a_lost_peer_leave_the_bus_if_they_are_to_be_dropped() -> None:
    with scene(drop_lost=True) as here:
        here.handle(message("a"), sender="stays")
        here.handle(message("b"), Presence.LEFT)
        assert here.bus.statistics().frames == 1


def test_an_announced_peer_evicts_an_unannounced_one_whose_frames_stay() -> None:
    with scene(drop_lost=True) as here:
        for number in range(MAX_PEERS):
            here.handle(message("a"), sender=f"{number}")
        here.handle(Presence.JOINED)
        assert here.endpoint.peers.present == ("driver",)
        assert here.endpoint.peers.rejected == {}
        assert here.bus.statistics().frames == 1
        here.handle(message("b"), sender="0")
        assert here.endpoint.peers.rejected == {"too many peers": 1}


def test_a_refused_message_is_counted_each_time_and_announced_and_logged_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with scene() as here, caplog.at_level(logging.WARNING, "tfbus"):
        error = MalformedMessageError("oversized", "9 bytes")
        here.handle(error, error, ForeignMessage(False, []), object(), message("a"))
        assert here.endpoint.peers.rejected == {"oversized": 2, "empty": 1, "not published": 1}
        told = here.told()
    assert [
        (event.stamp, event.link, event.peer, event.reason) for event in told if isinstance(event, PeerRejected)
    ] == [(7, "world", "driver", reason) for reason in ("oversized", "empty", "not published")]
    assert isinstance(told[0], PeerRejected)
    assert (told[0].error.args, told[0].error is error) == (error.args, False)
    assert caplog.messages[0] == (
        "refused what peer driver sent over the link world: no message of transforms (oversized): 9 bytes"
    )
    assert len(caplog.messages) == 3


def test_a_detached_endpoint_forgets_its_peers_and_keeps_their_frames() -> None:
    made = Scene(drop_lost=True)
    made.handle(Presence.JOINED, message("a"))
    made.endpoint.detach()
    assert made.endpoint.peers.present == ()
    assert made.bus.statistics().frames == 1
    made.bus.publish(moving("map", "b", 1))
    made.endpoint.send()
    assert made.carrier.turns == []


def test_a_link_claims_its_state_ever_less_often_while_nothing_happens() -> None:
    domain = Domain()
    bus = Bus(SimulatedClock())
    end, other = domain.join(bus), domain.join(Bus(SimulatedClock()))
    wire = domain.wires[end, other]

    def claims(until: float) -> list[float]:
        """The times at which the end claims its state."""
        found = []
        while domain.time <= until:
            due = end.endpoint.reconcile()
            if any(isinstance(packet, Message) for packet in wire.packets):
                found.append(domain.time)
            wire.packets.clear()
            domain.time = due
        return found

    assert claims(until=366.0) == [0.0, 2.0, 6.0, 14.0, 30.0, 62.0, 126.0, 246.0, 366.0]
    # Peers that come back may never have lost this link, and ask for nothing.
    domain.time = 500.0
    for name in ("a", "b"):
        end.endpoint.handle(Received(name, Presence.JOINED))
    assert claims(until=506.0) == [500.0, 502.0, 506.0]
    sent = domain.time
    bus.publish(moving("map", "a", 1))
    end.endpoint.send()
    wire.packets.clear()
    assert [round(time - sent, 6) for time in claims(until=sent + 7.5)] == [CLAIM_PERIOD, 3.0, 7.0]
    # A claim goes to all peers, so many of them are told less often.
    domain.time = joined = sent + 60.0
    for number in range(38):
        end.endpoint.handle(Received(f"one of 40, {number}", Presence.JOINED))
    assert [round(time - joined, 6) for time in claims(until=joined + 48.0)] == [0.0, 16.0, 48.0]
    end.endpoint.handle(Received("one of 41", Presence.JOINED))
    assert [round(time - joined, 6) for time in claims(until=joined + 80.0)] == [56.2, 72.6]
    for made in (end, other):
        made.leave()


def test_an_answer_does_not_overtake_the_batch_that_it_tells_of() -> None:
    domain = Domain()
    bus, other = Bus(SimulatedClock()), Bus(SimulatedClock())
    heard: list[list[str]] = []
    other.subscribe(lambda batch: heard.append([sample.child for sample in batch]))
    end, asking = domain.join(bus), domain.join(other)
    bus.publish([static("map", "lidar"), moving("map", "base", 1)])
    # Before the turn in which it was published ends.
    end.receive(asking.id, Question(0, asking.id))
    domain.settle()
    assert heard == [["lidar", "base"]]
    for made in (end, asking):
        made.leave()


@pytest.mark.parametrize(
    ("answer", "rejected"), [(None, {}), (Message(b"", b"no attachment", 0), {"version": 1})], ids=["none", "malformed"]
)
def test_a_peer_without_an_answer_of_use_is_asked_again_after_a_pause(
    answer: Message | None, rejected: dict[str, int]
) -> None:
    domain = Domain()
    end, peer = domain.join(Bus(SimulatedClock())), domain.join(Bus(SimulatedClock()))
    end.receive(peer.id, Presence.JOINED)
    assert end.endpoint.next_question() == domain.time
    end.endpoint.reconcile()
    assert end.endpoint.next_question() == domain.time + PATIENCE
    end.receive(peer.id, Answer(answer))
    due = end.endpoint.next_question()
    assert due is not None
    assert 0.5 * FIRST_PAUSE <= due - domain.time <= 1.5 * FIRST_PAUSE
    assert end.endpoint.peers.rejected == rejected
    for made in (end, peer):
        made.leave()


@pytest.mark.parametrize("history", [None, 5.0])
def test_an_answer_about_the_past_that_nobody_has_asked_for_changes_nothing(history: float | None) -> None:
    domain = Domain()
    end, peer = domain.join(Bus(SimulatedClock()), history=history), domain.join(Bus(SimulatedClock()))
    said = write_answer([OutgoingBatch(bytes(16), 1, [moving("map", "a", 1)])], StateStep(0, 0, 0))
    end.receive(peer.id, HistoryAnswer(said))
    assert (end.bus.statistics().frames, end.endpoint.peers.rejected) == (0, {})
    for made in (end, peer):
        made.leave()


def test_a_message_with_a_gap_before_it_makes_a_link_ask_soon() -> None:
    domain = Domain()
    bus = Bus(SimulatedClock())
    end, asking = domain.join(bus), domain.join(Bus(SimulatedClock()))
    domain.settle()
    domain.pass_time()
    domain.settle()
    assert asking.endpoint.next_question() is None
    for name in ("lost", "heard"):
        domain.wires[end, asking].packets.clear()
        bus.publish(static("map", name))
        end.endpoint.send()
    domain.settle()
    due = asking.endpoint.next_question()
    assert due is not None
    assert due - domain.time <= 1.5 * SETTLING
    for made in (end, asking):
        made.leave()


def test_a_question_whose_answer_no_message_can_hold_has_none(monkeypatch: pytest.MonkeyPatch) -> None:
    domain = Domain()
    end, asking = domain.join(Bus(SimulatedClock())), domain.join(Bus(SimulatedClock()))

    def fail(*_: object) -> Message:
        raise ValueError("too much")

    monkeypatch.setattr(wires, "write_answer", fail)
    wire = domain.wires[end, asking]
    wire.packets.clear()
    end.receive(asking.id, Question(0, asking.id))
    assert (list(wire.packets), end.endpoint.peers.rejected) == ([], {})
    for made in (end, asking):
        made.leave()


def test_a_peer_that_has_gone_is_asked_no_more() -> None:
    domain = Domain()
    end = domain.join(Bus(SimulatedClock()))
    end.endpoint.handle(Received("a", Presence.JOINED))
    assert end.endpoint.next_question() == domain.time
    end.endpoint.handle(Received("a", Presence.LEFT))
    assert end.endpoint.next_question() is None
    end.leave()


class Heard:
    """Notes the times that an endpoint hears, among what its bus publishes and removes."""

    def __init__(self, bus: Bus) -> None:
        self.found: list[int | str] = []
        bus.subscribe(lambda batch: self.found.extend(sample.child for sample in batch))

    def hear(self, stamp: int) -> None:
        self.found.append(stamp)


def test_the_time_of_a_clock_goes_before_what_is_published_at_it_and_a_jump_behind_what_was_before() -> None:
    domain = Domain()
    bus, other = Bus(SimulatedClock()), Bus(SimulatedClock())
    heard = Heard(other)
    end = domain.join(bus)
    hearing = domain.join(other, follower=heard)
    plain = domain.join(Bus(SimulatedClock()))
    domain.settle()
    end.endpoint.tell_time(5)
    bus.publish(moving("map", "a", 1))
    end.endpoint.tell_time(6)
    end.endpoint.send()
    bus.publish(moving("map", "b", 1))
    end.endpoint.tell_time(2)
    bus.publish(moving("map", "c", 1))
    end.endpoint.send()
    domain.settle()
    assert heard.found == [6, "a", 6, "b", 2, "c"]
    assert (plain.bus.statistics().frames, plain.endpoint.peers.rejected) == (3, {}), "it follows no clock"
    heard.found.clear()
    # Nothing but a time; and whoever comes later is told.
    end.endpoint.tell_time(9)
    end.endpoint.send()
    domain.settle()
    late = Heard(Bus(SimulatedClock()))
    last = domain.join(Bus(SimulatedClock()), follower=late)
    domain.settle()
    end.endpoint.send()
    domain.settle()
    assert set(heard.found) == {9}
    assert set(late.found) == {9}
    for made in (end, hearing, plain, last):
        made.leave()


def test_one_clock_is_followed_until_its_peer_is_lost() -> None:
    domain = Domain()
    heard = Heard(Bus(SimulatedClock()))
    ends = [domain.join(Bus(SimulatedClock())) for _ in range(2)]
    hearing = domain.join(Bus(SimulatedClock()), follower=heard)
    domain.settle()
    for number, end in enumerate(ends):
        end.endpoint.tell_time(10 + number)
        end.endpoint.send()
        domain.settle()
    assert set(heard.found) == {10}
    assert hearing.endpoint.peers.rejected == {"second clock": 1}
    hearing.receive(ends[0].id, Presence.LEFT)
    ends[1].endpoint.tell_time(12)
    ends[1].endpoint.send()
    domain.settle()
    assert heard.found[-1] == 12
    for made in (*ends, hearing):
        made.leave()

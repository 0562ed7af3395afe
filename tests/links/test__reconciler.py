"""A reconciler's own decisions; the tests of the relay and of random lives drive it in whole networks."""

from random import Random

from tfbus import Bus, SimulatedClock
from tfbus.links._asker import FIRST_PAUSE, Asker
from tfbus.links._entries import MovingFrame
from tfbus.links._inbox import Inbox, ReceivedMessage
from tfbus.links._outbox import Outbox
from tfbus.links._peers import Peer, Peers
from tfbus.links._reconciler import Reconciler
from tfbus.links._relay import relay_of
from tfbus.links._state import StateStep, digest_moving


class Scene:
    """A reconciler whose questions a test answers by hand."""

    def __init__(self, max_frames: int = 10) -> None:
        self.time = 0.0
        self.woken = 0
        self.asked: list[tuple[str, int]] = []
        self.peers = Peers(print)
        bus = Bus(SimulatedClock())
        self.inbox = Inbox(bus, relay_of(bus), Outbox(None, print), None, max_frames, self.peers)
        asker = Asker(lambda: self.time, Random(1))
        self.reconciler = Reconciler(
            self.inbox, self.peers, lambda *question: self.asked.append(question), asker, self._wake, max_frames
        )

    def _wake(self) -> None:
        self.woken += 1

    def join(self, name: str = "peer") -> Peer:
        peer = self.peers.find(name)
        assert peer is not None
        self.reconciler.joined(peer)
        return peer

    def run(self) -> list[tuple[str, int]]:
        """The questions that are asked when the next is due."""
        self.asked.clear()
        due = self.reconciler.next_due()
        if due is not None:
            self.time = due
            self.reconciler.run()
        return self.asked

    def hear(self, step: StateStep, *names: str) -> None:
        self.inbox.receive("peer", ReceivedMessage([MovingFrame(name) for name in names], step=step))
        self.reconciler.heard("peer")

    def answer(self, step: StateStep, *names: str) -> None:
        self.reconciler.answered("peer", ReceivedMessage([MovingFrame(name) for name in names], step=step))


A, B, C = map(digest_moving, "abc")


def test_a_peer_that_joins_is_asked_at_once_and_not_again_when_all_was_told() -> None:
    scene = Scene()
    scene.join()
    assert scene.woken == 1
    assert (scene.run(), scene.time) == ([("peer", 0)], 0.0)
    scene.answer(StateStep(0, 1, A), "a")
    assert scene.reconciler.next_due() is None


def test_a_second_answer_to_what_all_was_told_already_changes_nothing() -> None:
    scene = Scene()
    peer = scene.join()
    scene.run()
    scene.answer(StateStep(0, 2, A ^ B), "a", "b")
    # An older one, written before "b" came, and the same once more.
    for number, digest, names in ((1, A, "a"), (2, A ^ B, "ab")):
        scene.answer(StateStep(0, number, digest), *names)
        assert peer.mirror is not None
        assert (peer.mirror.agrees, peer.mirror.number, "b" in peer.mirror) == (True, 2, True)
        assert not peer.mirror.take_whole()
        assert scene.reconciler.next_due() is None
    # One that was written since then has more.
    scene.answer(StateStep(2, 3, A ^ B ^ C), "c")
    assert peer.mirror is not None
    assert (peer.mirror.number, "c" in peer.mirror) == (3, True)


def test_what_a_peer_claims_and_has_not_told_is_asked_for_in_parts() -> None:
    scene = Scene()
    scene.join()
    scene.run()
    scene.answer(StateStep(0, 1, A), "a")
    scene.hear(StateStep(3, 3, A ^ B))
    assert scene.run() == [("peer", 1)]
    scene.answer(StateStep(1, 2, 0, final=False))
    assert scene.run() == [("peer", 2)]
    scene.answer(StateStep(2, 3, A ^ B), "b")
    assert scene.reconciler.next_due() is None


def test_a_peer_may_begin_anew_with_less_than_it_had_told() -> None:
    scene = Scene()
    scene.join()
    scene.run()
    scene.answer(StateStep(0, 2, A ^ B), "a", "b")
    scene.hear(StateStep(4, 4, C))
    assert scene.run() == [("peer", 2)]
    scene.answer(StateStep(0, 1, 0, final=False), "a")
    assert scene.run() == [("peer", 1)]


def test_a_live_message_that_tells_the_rest_makes_the_question_needless() -> None:
    scene = Scene()
    scene.join()
    scene.run()
    scene.answer(StateStep(0, 1, A), "a")
    scene.hear(StateStep(2, 2, A ^ B))
    assert scene.reconciler.next_due() is not None
    scene.hear(StateStep(0, 2, A ^ B), "b")
    assert scene.reconciler.next_due() is None


def test_without_an_answer_and_after_one_that_does_not_help_it_asks_again_after_a_pause() -> None:
    scene = Scene()
    scene.join()
    scene.run()
    scene.reconciler.unanswered("peer")
    assert scene.run() == [("peer", 0)]
    assert 0.5 * FIRST_PAUSE <= scene.time <= 1.5 * FIRST_PAUSE
    for step in (StateStep(7, 9, A), StateStep(0, 0, A)):
        scene.answer(step)
        assert scene.reconciler.next_due() != scene.time
    assert scene.run() == [("peer", 0)]


def test_a_peer_that_has_left_is_not_asked_and_its_answer_says_nothing() -> None:
    scene = Scene()
    peer = scene.join()
    scene.peers.forget("peer")
    scene.reconciler.left(peer)
    scene.answer(StateStep(0, 1, A), "a")
    scene.hear(StateStep(9, 9, A))
    assert scene.run() == []
    assert peer.mirror is None
    scene.join()
    scene.peers.forget("peer")
    assert scene.run() == [], "nor is one that was evicted"
    assert scene.reconciler.next_due() is None


def test_a_peer_with_too_many_frames_is_asked_no_more() -> None:
    scene = Scene(max_frames=1)
    scene.join()
    scene.run()
    scene.answer(StateStep(0, 2, A ^ B), "a", "b")
    scene.hear(StateStep(5, 5, 1))
    assert scene.reconciler.next_due() is None

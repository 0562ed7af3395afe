import math
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from support.samples import moving, static
from support.wires import Domain, End
from tfbus.links._history import (
    CHUNK,
    LONGEST_HISTORY,
    MOST_HELD,
    MOST_OF_FRAME,
    MOST_REMEMBERED,
    PATIENCE,
    HistoryAsker,
    HistoryTeller,
)
from tfbus.links._message import Message
from tfbus.links._receive_queue import HistoryAnswer, HistoryQuestion
from tfbus.links._state import StateStep

from tfbus import SECOND, Buffer, Bus, TransformStamped
from tfbus.links import _history
from tfbus.links.zenoh import ZenohLink


class Scene:
    """A bus with a buffer and a link, and one that joins late."""

    def __init__(self, seconds: float = 5.0, keep: float | None = None) -> None:
        self.domain = Domain()
        self.source, self.late = Bus(max_ahead=None), Bus(max_ahead=None)
        self.buffer = Buffer(self.source, keep)
        self.teller = self.domain.join(self.source)
        self.seconds = seconds
        self.heard: list[TransformStamped] = []
        self.late.subscribe(self.heard.extend)

    def publish(self, *samples: TransformStamped) -> None:
        self.source.publish(samples)
        self.teller.endpoint.send()

    def join(self) -> End:
        self.asker = self.domain.join(self.late, history=self.seconds)
        return self.asker

    def deliver(self, *, only: type | None = None) -> None:
        """Deliver all packets, or those of one kind, until there are no more."""
        while True:
            found = [
                (wire, place)
                for wire in self.domain.wires.values()
                for place, packet in enumerate(wire.packets)
                if only is None or isinstance(packet, only)
            ]
            if not found:
                if only is not None or not self.domain.pass_time():
                    return
                continue
            wire, place = found[0]
            wire.deliver(place)


@contextmanager
def scene(seconds: float = 5.0, keep: float | None = None) -> Iterator[Scene]:
    made = Scene(seconds, keep)
    with made.source, made.late, made.buffer:
        yield made


def stamps_of(heard: list[TransformStamped], child: str) -> list[float]:
    return [sample.stamp / SECOND for sample in heard if sample.child == child]


def test_who_joins_late_has_the_last_seconds_with_stamps_parents_and_authorities_before_what_is_live() -> None:
    with scene() as s:
        for second in range(10):
            parent, authority = ("map", "odometry") if second < 8 else ("odom", "slam")
            s.publish(moving(parent, "base", second * SECOND, float(second), authority))
        s.publish(static("base", "lidar"), moving("map", "old", 3 * SECOND))
        s.join()
        # Live messages overtake the answers.
        s.publish(moving("odom", "base", 10 * SECOND, 10.0, "slam"))
        s.deliver()
        s.publish(moving("odom", "base", 11 * SECOND, 11.0, "slam"))
        s.deliver()
        base = [sample for sample in s.heard if sample.child == "base"]
        assert stamps_of(s.heard, "base") == [5, 6, 7, 8, 9, 10, 11]
        assert [sample.parent for sample in base] == ["map"] * 3 + ["odom"] * 4
        assert [sample.authority for sample in base] == ["odometry"] * 3 + ["slam"] * 4
        assert [sample.transform.translation[0] for sample in base] == [5, 6, 7, 8, 9, 10, 11]
        assert stamps_of(s.heard, "old") == [3]
        assert [sample.child for sample in s.heard if sample.static] == ["lidar"]


def test_the_past_is_not_told_as_late_data_and_what_comes_live_is() -> None:
    with scene() as s:
        s.publish(*[moving("map", "base", second * SECOND) for second in range(10)])
        s.join()
        s.deliver()
        assert stamps_of(s.heard, "base") == [4, 5, 6, 7, 8, 9]
        assert s.late.statistics().behind == 0
        s.publish(moving("map", "base", 10 * SECOND))
        s.deliver()
        assert s.late.statistics().behind == 1


@pytest.mark.parametrize("keeps", [(2.0, 8.0), (8.0, 2.0)])
def test_the_past_is_that_of_the_buffer_which_holds_most_of_it(keeps: tuple[float, float]) -> None:
    with scene(60.0, keeps[0]) as s, Buffer(s.source, keeps[1]), Buffer(s.source, 4.0):
        for second in range(20):
            s.publish(moving("map", "base", second * SECOND))
        # One that has never heard of the frame.
        with Buffer(s.source):
            s.join()
            s.deliver()
        held = stamps_of(s.heard, "base")
        assert held == list(range(20))[-len(held) :]
        assert 8 <= len(held) <= 10


def test_without_a_buffer_there_is_nothing_to_tell() -> None:
    with Bus(max_ahead=None) as bus:
        end = Domain().join(bus)
        bus.publish(moving("map", "base", SECOND))
        assert end.endpoint._history_teller.chunk(5.0, "") == ([], StateStep(0, 0, 0))
        end.leave()


def test_without_it_nothing_of_the_past_comes() -> None:
    with scene() as s:
        s.publish(moving("map", "base", SECOND))
        s.domain.join(s.late)
        s.deliver()
        assert s.heard == []


@pytest.mark.parametrize(
    ("chunk", "most"), [(20, 20), (20, 30), pytest.param(CHUNK, MOST_OF_FRAME, marks=pytest.mark.thorough)]
)
def test_the_past_comes_in_chunks_of_whole_frames_and_is_bounded(
    chunk: int, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_history, "CHUNK", chunk)
    monkeypatch.setattr(_history, "MOST_OF_FRAME", most)
    with scene(LONGEST_HISTORY) as s:
        names = [f"f{number}" for number in range(5)]
        for stamp in range(chunk // 2):
            s.publish(*(moving("map", name, stamp) for name in names))
        for stamp in range(most + 10):
            s.publish(moving("map", "much", stamp))
        s.join()
        s.deliver()
        assert {name: len(stamps_of(s.heard, name)) for name in [*names, "much"]} == {
            **dict.fromkeys(names, chunk // 2),
            "much": most,
        }
        assert stamps_of(s.heard, "much")[0] == 10 / SECOND
        teller = s.teller.endpoint._history_teller
        told, step = teller.chunk(LONGEST_HISTORY, "")
        assert ([batch.samples[0].child for batch in told], step.final) == (["f0", "f1"], False)
        told, step = teller.chunk(LONGEST_HISTORY, "f4")
        assert ([batch.samples[0].child for batch in told], step.final) == (["much"], True)
        assert teller.chunk(LONGEST_HISTORY, "much")[0] == []


def test_a_peer_is_asked_once_even_if_it_comes_back() -> None:
    with scene() as s:
        s.publish(moving("map", "base", SECOND))
        s.join()
        s.deliver()
        assert stamps_of(s.heard, "base") == [1]
        s.domain.part(s.teller, s.asker)
        s.publish(moving("map", "base", 2 * SECOND))
        s.domain.meet(s.teller, s.asker)
        s.deliver()
        assert stamps_of(s.heard, "base") == [1]


def test_so_many_peers_are_remembered_as_asked() -> None:
    asked: list[str] = []
    asker = HistoryAsker(5.0, lambda peer, _seconds, _after: asked.append(peer), lambda: 0.0)
    for number in range(MOST_REMEMBERED):
        asker.joined(f"{number}")
    asker.joined("0")
    assert len(asked) == MOST_REMEMBERED
    for peer in ("one more", "1", "0"):
        asker.joined(peer)
    assert asked[MOST_REMEMBERED:] == ["one more", "0"], "the first one was forgotten"


def test_without_an_answer_what_is_live_is_late_and_not_lost() -> None:
    with scene() as s:
        s.join()
        s.publish(moving("map", "base", SECOND))
        for wire in s.domain.wires.values():
            while wire.packets:
                if isinstance(wire.packets[0], HistoryQuestion):
                    wire.packets.popleft()
                else:
                    wire.deliver()
        assert s.heard == []
        s.domain.time += PATIENCE
        s.asker.endpoint.reconcile()
        assert stamps_of(s.heard, "base") == [1]


@pytest.mark.parametrize("end", ["answer", "garbage", "loss", "many"])
def test_what_was_held_back_comes_when_the_peer_says_nothing_leaves_or_sends_too_much(end: str) -> None:
    with scene() as s:
        s.join()
        for wire in s.domain.wires.values():
            wire.deliver()
        count = MOST_HELD + 2 if end == "many" else 3
        for stamp in range(count):
            s.publish(moving("map", "base", stamp))
        wire = s.domain.wires[s.teller, s.asker]
        while wire.packets:
            wire.deliver()
        if end == "answer":
            assert s.heard == []
            s.asker.receive(s.teller.id, HistoryAnswer(None))
        elif end == "garbage":
            assert s.heard == []
            s.asker.receive(s.teller.id, HistoryAnswer(Message(b"", b"no attachment", 0)))
            assert s.asker.endpoint.peers.rejected == {"version": 1}
        elif end == "loss":
            assert s.heard == []
            s.domain.part(s.teller, s.asker)
        assert [sample.stamp for sample in s.heard] == list(range(count))


def test_a_peer_whose_answers_lead_nowhere_is_asked_no_more() -> None:
    asked: list[str] = []
    with scene() as s:
        s.publish(moving("map", "base", SECOND))
        s.join()
        s.deliver(only=HistoryQuestion)
        asker = HistoryAsker(5.0, lambda _peer, _seconds, after: asked.append(after), lambda: 0.0)
        told, step = HistoryTeller(s.source, s.teller.relay, s.teller.endpoint.outbox).chunk(5.0, "")
        written = s.teller.carrier.write_answer(told, step._replace(final=False))
        s.teller.carrier.answer(HistoryQuestion(5.0, "", s.asker.id), written)
        packet = s.domain.wires[s.teller, s.asker].packets[-1]
        assert isinstance(packet, HistoryAnswer)
        message = s.asker.carrier.read(packet.message)
        asker.joined("peer")
        assert asker.goes_on("peer", message)
        assert not asker.goes_on("peer", message), "the same once more"
        assert asked == ["", "base"]
        assert not asker.goes_on("nobody", message)
        for held, goes_on in ((MOST_HELD - 1, True), (MOST_HELD, False)):
            full = HistoryAsker(5.0, lambda *_: None, lambda: 0.0)
            full.joined("peer")
            assert all(full.holds("peer", message) for _ in range(held))
            assert full.goes_on("peer", message) is goes_on
            assert full.holds("peer", message) is goes_on


def test_it_has_to_be_a_time_that_passes() -> None:
    with Bus() as bus:
        for seconds in (0.0, -1.0, math.nextafter(LONGEST_HISTORY, math.inf), float("nan")):
            with pytest.raises(ValueError, match="history"):
                ZenohLink(bus, history=seconds)
        for seconds in (1e-3, LONGEST_HISTORY):
            ZenohLink(bus, history=seconds)

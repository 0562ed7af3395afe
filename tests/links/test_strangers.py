"""A link whose peer is a stranger: the test writes the messages that come, as any program that reaches it could."""

import math
import struct
from collections.abc import Sequence
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import strategies as some
from support.domains import Network, Stranger, World, write_text
from support.samples import moving, static

from tfbus import PeerLost, PeerRejected, TransformStamped
from tfbus.links.endpoint import MAX_AUTHORITIES
from tfbus.links.message import VERSION, Heard, Kind, Outgoing, read_message, split_clocks, write_body, write_message
from tfbus.links.relay import LARGEST_JUMP
from tfbus.links.replica import MANY_ORIGINS, Claim, OutgoingBatch, RemovedFrame

HERE, OTHER, THIRD = b"the stranger's..", b"one more origin.", b"and a third one."


class Scene:
    """A link and a stranger that it has met."""

    def __init__(self, seed: int = 0, channel: str = "all", **options: Any) -> None:
        self.world = World(seed)
        self.network = Network(self.world)
        self.process = self.world.process(self.network, **options)
        self.stranger = Stranger(self.network, channel=channel, bus=HERE)
        self.world.run(0.01)
        self.stranger.items.clear()
        # Numbers near to those that buses give.
        self.process.say(static("map", "own"))
        self.world.run(0.01)
        own = self.told()[-1]
        self.origin, self.first = own.origin, own.sequence
        self.process.seen.clear()
        self.process.batches.clear()

    def say(self, *samples: TransformStamped, number: int, origin: bytes = HERE) -> None:
        self.stranger.say(OutgoingBatch(origin, self.first + number, samples))

    def remove(self, frame: str, number: int, origin: bytes = HERE) -> None:
        self.stranger.say(RemovedFrame(origin, self.first + number, frame))

    def told(self) -> list[Any]:
        """The messages that the link has published since this was asked last."""
        found: list[Any] = []
        for message in self.stranger.heard(Kind.LIVE):
            for part in read_message(message):
                found += part.entries  # type: ignore[union-attr]
        self.stranger.items.clear()
        return found

    @property
    def frames(self) -> set[str]:
        return set(self.process.frames) - {"own"}

    @property
    def rejected(self) -> dict[str, int]:
        return dict(self.process.end.rejected)

    @property
    def counts(self) -> tuple[int, int]:
        """Samples that were published, and those that were no news."""
        return self.process.end.samples, self.process.end.duplicates


@pytest.fixture
def scene() -> Scene:
    return Scene()


# The entry of a frame that counts

SAID = {"s": static, "m": lambda parent, child, x: moving(parent, child, int(x), x)}
Step = tuple[str, int, bytes]


@pytest.mark.parametrize(
    ("steps", "stays"),
    [
        ([("m", 5, HERE), ("r", 4, HERE)], True),
        ([("m", 5, HERE), ("r", 6, HERE)], False),
        ([("m", 8, HERE), ("m", 9, OTHER), ("r", 7, HERE)], True),
        ([("m", 1, HERE), ("r", 3, HERE), ("m", 2, HERE)], False),
        ([("m", 1, HERE), ("r", 3, HERE), ("m", 3, HERE)], False),
        ([("m", 1, HERE), ("r", 3, HERE), ("m", 4, HERE)], True),
        ([("r", 2, HERE), ("m", 1, HERE)], False),
        ([("r", 2, HERE), ("s", 1, OTHER)], False),
        ([("m", 1, HERE), ("r", 2, HERE), ("m", 3, OTHER), ("r", 2, HERE)], True),
        ([("m", 5, HERE), ("r", 6, OTHER), ("m", 5, HERE)], False),
        ([("s", 9, OTHER), ("r", 5, HERE)], True),
        ([("s", 9, OTHER), ("r", 12, HERE), ("r", 10, OTHER), ("s", 11, HERE)], False),
        ([("r", 15, HERE), ("m", 14, THIRD)], False),
        ([("r", 15, HERE), ("m", 16, THIRD)], True),
    ],
)
@pytest.mark.parametrize("at_once", [False, True])
def test_the_word_of_the_highest_number_holds(scene: Scene, steps: Sequence[Step], stays: bool, at_once: bool) -> None:
    entries: list[OutgoingBatch | RemovedFrame] = []
    for what, number, origin in steps:
        if what == "r":
            entries.append(RemovedFrame(origin, scene.first + number, "a"))
        else:
            entries.append(OutgoingBatch(origin, scene.first + number, [SAID[what]("map", "a", float(number))]))
    for said in [entries] if at_once else [[entry] for entry in entries]:
        scene.stranger.say(*said)
    assert scene.frames == ({"a"} if stays else set())


def test_a_moving_sample_does_not_replace_a_static_one_that_was_said_later(scene: Scene) -> None:
    scene.say(static("map", "a", 1.0), number=5)
    scene.say(moving("map", "a", 8), number=4, origin=OTHER)
    assert scene.process.seen == [static("map", "a", 1.0)]
    scene.say(moving("map", "a", 9), number=6, origin=OTHER)
    assert scene.process.seen[1:] == [moving("map", "a", 9)]


def test_what_comes_again_or_late_is_counted_and_what_this_bus_has_said_is_no_news(scene: Scene) -> None:
    for number in (2, 2, 1, 3):
        scene.say(moving("map", "a", number), number=number)
    assert scene.counts == (2, 2)
    scene.say(moving("map", "a", 2), number=2, origin=OTHER)
    assert scene.counts == (3, 2), "another origin is another source"
    scene.say(static("map", "own"), number=0, origin=scene.origin)
    scene.remove("own", number=0, origin=scene.origin)
    assert scene.process.frames.keys() == {"own", "a"}
    assert scene.told() == [], "nothing was said again"


def test_a_message_of_nothing_calls_no_subscriber(scene: Scene) -> None:
    scene.stranger.say()
    assert scene.process.batches == []
    assert scene.process.end.messages == 1


def test_the_batches_of_a_message_are_published_one_by_one_and_those_of_an_answer_as_one() -> None:
    scene = Scene()
    batches = [OutgoingBatch(HERE, scene.first + n, [static("map", f"{n}")]) for n in range(1, 4)]
    scene.stranger.say(*batches)
    assert [len(batch) for batch in scene.process.batches] == [1, 1, 1]
    scene = Scene()
    scene.stranger.say(*batches, kind=Kind.ANSWER, claim=Claim(0, 3, 0))
    assert [len(batch) for batch in scene.process.batches] == [3]


# Numbers


def test_a_number_that_no_bus_can_have_given_is_refused_and_later_ones_are_news(scene: Scene) -> None:
    scene.say(moving("map", "a", 1), number=7)
    for number in (2**64 - 1 - scene.first, LARGEST_JUMP + 10**9):
        scene.say(moving("map", "a", 2), moving("map", "b", 2), number=number)
        scene.remove("a", number=number)
    assert scene.rejected == {"number": 6}
    assert scene.frames == {"a"}
    scene.say(moving("map", "a", 3), number=8)
    scene.say(moving("map", "a", 4), number=LARGEST_JUMP)
    assert scene.counts == (3, 0)


def test_a_number_of_this_bus_that_somebody_has_made_up_does_not_hide_what_it_says_later(scene: Scene) -> None:
    scene.process.say(static("map", "s", 1.0), static("map", "t"), moving("map", "m", 1))
    scene.world.run(0.01)
    scene.say(static("map", "s", 2.0), moving("map", "m", 2), origin=scene.origin, number=10**9)
    scene.remove("t", origin=scene.origin, number=10**12)
    # It holds here as on all other buses, until this one says something else.
    assert scene.process.frames["s"] == static("map", "s", 2.0)
    assert scene.process.removed == ["t"]
    scene.told()
    scene.process.say(static("map", "s", 1.0), static("map", "t"), moving("map", "m", 3))
    scene.world.run(0.01)
    assert min(entry.sequence for entry in scene.told()) > scene.first + 10**12
    assert scene.process.frames.keys() == {"own", "s", "t", "m"}


def test_gaps_in_the_numbers_of_a_peer_are_messages_that_were_lost() -> None:
    scene = Scene()
    lost = []
    for number in (7, 8, 11, 10, 11, 12, 2**63, 2**63 + 2):
        scene.stranger.say(number=number)
        lost.append(scene.process.end.lost)
    # Nobody has sent so many: one of the two numbers is made up.
    assert lost == [0, 0, 2, 2, 2, 2, 2, 3]
    scene = Scene()
    scene.stranger.say(number=7)
    for _ in range(2):
        # A sign tells the number of the newest live message.
        scene.stranger.say_bytes(write_message(Outgoing(Kind.SIGN, HERE, 9)))
    assert scene.process.end.lost == 2
    scene.network.remove(scene.stranger)
    scene.network.add(scene.stranger)
    scene.world.run(0.01)
    scene.stranger.say(number=3)
    scene.stranger.say(number=5)
    assert scene.process.end.lost == 3, "one that comes back begins anew"


def test_whoever_misses_a_message_asks_soon(scene: Scene) -> None:
    scene.stranger.say(kind=Kind.ANSWER)
    scene.stranger.say(number=1)
    scene.world.run(10.0)
    assert scene.stranger.heard(Kind.QUESTION) == []
    scene.stranger.say(number=3)
    scene.world.run(0.3)
    assert len(scene.stranger.heard(Kind.QUESTION)) == 1


def test_a_link_says_in_its_signs_that_it_has_not_fetched_all(scene: Scene) -> None:
    def last_sign() -> Claim:
        scene.stranger.items.clear()
        scene.world.run(2.5)
        (sign,) = read_message(split_clocks(scene.stranger.heard(Kind.SIGN)[-1])[0])
        assert isinstance(sign, Heard)
        return sign.claim

    for number in (1, 3):
        scene.stranger.say(number=number)
    scene.world.run(0.3)
    assert last_sign().final
    scene.stranger.say(kind=Kind.ANSWER, claim=Claim(0, 1, 0, final=False))
    assert not last_sign().final
    scene.stranger.say(kind=Kind.ANSWER, claim=Claim(1, 2, 0))
    assert last_sign().final


# Refused samples


def test_what_no_message_can_say_is_counted_and_told_once_for_each_peer_and_reason(
    scene: Scene, caplog: pytest.LogCaptureFixture
) -> None:
    with scene.process.bus.events(stale_after=None) as events:
        for bad in (
            b"",
            b"garbage",
            bytes((VERSION, Kind.LIVE)),
            bytes((VERSION, Kind.LIVE)),
            write_body(Kind.QUESTION, b"[]"),
            write_body(Kind.QUESTION, b""),
        ):
            scene.stranger.say_bytes(bad)
        other = Stranger(scene.network)
        other.say_bytes(b"garbage")
        told = []
        while (event := events.queue.get()) is not None:
            if isinstance(event, PeerRejected):
                told.append((event.link, event.peer, event.reason, type(event.error).__name__))
    assert scene.rejected == {"version": 3, "head": 2, "text": 2}
    expected = [(scene.stranger.id, reason) for reason in ("version", "head", "text")] + [(other.id, "version")]
    assert [(peer, reason) for _, peer, reason, _ in told] == expected
    assert {(link, error) for link, _, _, error in told} == {("tf", "MalformedMessageError")}
    assert [message for message in caplog.messages if "refused" in message] == [
        message for message in caplog.messages if f"what peer {scene.stranger.id}" in message or other.id in message
    ]
    assert sum("refused what peer" in message for message in caplog.messages) == 4
    assert scene.process.seen == []


def test_invalid_samples_are_counted_by_reason_and_the_rest_of_their_batch_is_published() -> None:
    scene = Scene()
    samples = [moving("mm", name, 1, x) for name, x in (("aa", 1.5), ("bb", 7.5), ("cc", 1.5))]
    data = write_message(Outgoing(Kind.LIVE, HERE, 1), [OutgoingBatch(HERE, scene.first + 1, samples)])
    for _ in range(2):
        scene.stranger.say_bytes(
            data.replace(struct.pack("<d", 7.5), struct.pack("<d", math.inf)).replace(b"cc\0", b"mm\0")
        )
    assert scene.process.seen == samples[:1]
    assert scene.rejected == {"not finite": 2, "self transform": 2}
    # The bus refuses samples that only it can judge.
    scene = Scene()
    scene.say(static("a", "b"), static("b", "c"), number=1)
    scene.say(static("c", "a"), static("a", "d"), number=2)
    assert scene.frames == {"b", "c", "d"}
    assert sum(scene.process.bus.statistics().rejected.values()) == 1
    assert scene.rejected == {}


def test_too_many_frames_of_a_bus_are_refused_and_counted_and_those_that_went_make_room() -> None:
    scene = Scene(max_frames=3)
    scene.say(*(moving("map", name, 1) for name in "aaabcde"), number=1)
    assert (scene.frames, scene.rejected) == ({"a", "b", "c"}, {"too many frames": 2})
    scene.say(moving("map", "a", 2), number=2)
    scene.remove("a", number=3)
    scene.say(moving("map", "d", 1), moving("map", "e", 1), number=4)
    assert (scene.frames, scene.rejected) == ({"b", "c", "d"}, {"too many frames": 3})
    for number in range(100):
        scene.say(moving("map", f"{number}", 1), number=2 * number + 5)
        scene.remove(f"{number}", number=2 * number + 6)
    scene.remove("b", number=300)
    scene.say(moving("map", "e", 1), number=301)
    assert scene.frames == {"c", "d", "e"}
    # Many origins do not get around the limit, and a lost peer's frames count no more.
    for number in range(2 * MANY_ORIGINS):
        scene.say(*(moving("map", f"{number}/{k}", 1) for k in range(3)), number=400, origin=b"%16d" % number)
    assert len(scene.frames) <= 3 * MANY_ORIGINS
    assert len(scene.frames) > 3 * (MANY_ORIGINS - 2)


def test_frames_in_the_name_of_this_bus_are_bounded_like_those_of_others_and_its_own_are_not() -> None:
    scene = Scene(max_frames=3)
    scene.say(*(moving("map", name, 1) for name in "abcde"), number=1, origin=scene.origin)
    assert (scene.frames, scene.rejected) == ({"a", "b"}, {"too many frames": 3})
    scene.process.say(*(moving("map", f"{number}", 1) for number in range(3 * MANY_ORIGINS)))
    scene.say(moving("map", "f", 1), number=2)
    assert len(scene.frames) == 3 + 3 * MANY_ORIGINS


def test_batches_with_too_many_authorities_of_a_peer_are_refused_and_counted(scene: Scene) -> None:
    for number in range(MAX_AUTHORITIES + 2):
        scene.say(static("map", "a", authority=f"node {number}"), number=number + 1)
    assert scene.rejected == {"too many authorities": 2}
    scene.say(static("map", "a", authority="node 7"), number=10_000)
    assert scene.rejected == {"too many authorities": 2}
    with scene.process.bus.events(stale_after=None) as events:
        scene.network.remove(scene.stranger)
        scene.world.run(0.01)
        told = []
        while (event := events.queue.get()) is not None:
            told.append(event)
    (lost,) = [event for event in told if isinstance(event, PeerLost)]
    assert (lost.link, lost.peer, lost.frames, len(lost.authorities)) == ("tf", scene.stranger.id, ("a",), 1_000)


def test_nothing_is_taken_of_a_link_that_was_not_announced_or_has_gone(scene: Scene) -> None:
    scene.process.wire.part(scene.stranger)
    scene.world.run(0.01)
    scene.say(static("map", "a"), number=1)
    assert (scene.frames, scene.rejected) == (set(), {})


# Subscribers


def test_a_subscriber_that_raises_hears_all_the_same_and_one_that_closes_the_bus_ends_a_message(scene: Scene) -> None:
    def fail(batch: Sequence[TransformStamped]) -> None:
        raise ValueError(batch[0].child)

    scene.process.bus.subscribe(fail)
    scene.say(static("map", "a"), number=1)
    scene.remove("a", number=2)
    scene.say(static("map", "b"), number=3)
    assert (scene.frames, scene.rejected) == ({"b"}, {})
    assert scene.process.bus.statistics().callbacks_failed == 3

    def close(batch: Sequence[TransformStamped]) -> None:
        if batch[0].child == "10":
            scene.process.bus.close()

    scene.process.bus.subscribe(close)
    batches = [OutgoingBatch(HERE, scene.first + n, [static("map", f"{n}")]) for n in range(10, 13)]
    scene.stranger.say(*batches, RemovedFrame(HERE, scene.first + 20, "b"))
    assert scene.frames == {"b", "10"}
    scene.say(static("map", "c"), number=30)
    scene.network.remove(scene.stranger)
    scene.world.run(5.0)
    assert (scene.frames, scene.rejected) == ({"b", "10"}, {})


def test_a_subscriber_may_change_the_frames_of_a_lost_peer_when_it_hears_of_it() -> None:
    scene = Scene(drop_lost=True)
    scene.say(*(static("map", name) for name in "abcd"), number=1)

    def answer(frame: str) -> None:
        if frame == "a":
            scene.process.bus.remove_frame("c")
            scene.process.bus.publish(static("map", "d", 2.0))

    scene.process.bus.subscribe(lambda _: None, answer)
    scene.network.remove(scene.stranger)
    scene.world.run(1.0)
    assert scene.frames == {"d"}
    assert scene.process.frames["d"].transform.translation[0] == 2.0


# Questions


def test_a_question_is_answered_with_what_this_link_brings_and_a_bad_one_is_refused(scene: Scene) -> None:
    scene.process.say(moving("map", "m", 1))
    for since, names in ((0, None), (0, ["m", "x"]), (10**9, [])):
        scene.stranger.say_bytes(write_text(Kind.QUESTION, {"since": since, "frames": names}))
    frames = []
    for message in scene.stranger.heard(Kind.ANSWER):
        (heard,) = read_message(message)
        frames.append({sample.child for entry in heard.entries for sample in entry.samples})  # type: ignore[union-attr]
    assert frames == [{"own", "m"}, {"m"}, set()]
    bad: list[dict[str, Any]] = [{}, {"since": 0}]
    bad += [{"since": since, "frames": None} for since in (-1, 2**64, 1.0, True)]
    bad += [{"since": 0, "frames": frames} for frames in ("m", 5, [5], {"m": 1})]
    for fields in bad:
        scene.stranger.say_bytes(write_text(Kind.QUESTION, fields))
    pasts: list[dict[str, Any]] = [{}, {"seconds": "5", "after": ""}, {"seconds": 5, "after": 5}]
    for fields in pasts:
        scene.stranger.say_bytes(write_text(Kind.PAST_QUESTION, fields))
    assert scene.rejected == {"text": len(bad) + len(pasts)}
    assert len(scene.stranger.heard(Kind.ANSWER)) == 3


def test_an_answer_about_the_past_that_nobody_has_asked_for_changes_nothing() -> None:
    scene = Scene(history=5.0)
    scene.world.run(10.0)
    past = OutgoingBatch(HERE, scene.first + 1, [moving("map", "a", 1)])
    scene.stranger.say(past, kind=Kind.PAST, claim=Claim(0, 0, 0, final=False))
    assert (scene.frames, scene.rejected) == (set(), {})


# Ways


def test_a_peer_leads_to_one_bus_and_to_those_in_its_signs_whatever_buses_it_names(scene: Scene) -> None:
    for number in range(100):
        scene.stranger.say_bytes(write_message(Outgoing(Kind.LIVE, b"%16d" % number, number + 1)))
    assert len(list(scene.process.end.ways())) == 1


def test_a_bus_that_a_peer_says_it_reaches_is_there_while_it_says_so() -> None:
    scene = Scene(drop_lost=True)
    far, own = b"a bus far away..", scene.origin
    scene.stranger.say(kind=Kind.SIGN, reach=[(far, (OTHER,)), (own, ()), (THIRD, (own,))])
    scene.say(static("map", "far"), number=1, origin=far)
    scene.say(static("map", "behind us"), number=1, origin=THIRD)
    scene.say(static("map", "unknown"), number=1, origin=OTHER)
    assert scene.frames == {"far"}, "a way that leads back through this bus is none"
    scene.stranger.say(kind=Kind.SIGN)
    assert scene.frames == set()
    scene.stranger.say(kind=Kind.SIGN, reach=[(far, ()), (OTHER, ())])
    assert scene.frames == {"far", "unknown"}
    scene.network.remove(scene.stranger)
    scene.world.run(1.0)
    assert scene.frames == set()


# Anything at all


entries_of_any_kind = st.lists(
    st.builds(
        RemovedFrame, st.sampled_from((HERE, OTHER)), st.integers(0, 5), st.sampled_from(("a", "b", "", "/a", "\0"))
    )
    | st.builds(
        OutgoingBatch,
        st.sampled_from((HERE, OTHER)),
        st.integers(0, 5) | st.integers(0, 2**64 - 1),
        st.lists(some.samples(names=st.sampled_from("abcd"), at=st.integers(0, 9)), min_size=1, max_size=3),
    ),
    max_size=4,
)


@given(
    messages=st.lists(
        st.tuples(
            st.sampled_from([Kind.LIVE, Kind.ANSWER, Kind.MEETING]), entries_of_any_kind, st.integers(0, 2**64 - 1)
        ),
        max_size=5,
    )
)
def test_messages_of_any_content_do_no_harm(messages: list[tuple[Kind, list[Any], int]]) -> None:
    scene = Scene(max_frames=2)
    for kind, entries, number in messages:
        scene.stranger.say_bytes(write_message(Outgoing(kind, HERE, number), entries))
    scene.world.run(1.0)
    refused = sum(scene.process.bus.statistics().rejected.values())
    assert scene.process.end.samples == len(scene.process.seen) + refused
    assert "not published" not in scene.rejected

"""What a program that speaks zenoh and means no good can do to a link: not much."""

import struct
from collections.abc import Iterator
from queue import Queue
from random import Random
from typing import Any
from uuid import uuid4

import pytest
import zenoh
from support.processes import PATIENCE, crowd, free_ports, new_domain
from support.processes import PeerProcess as Process
from support.samples import moving, static

from tfbus import TransformStamped
from tfbus.links._attachment import PublishedBatch, pack
from tfbus.links._message import MAX_BYTES
from tfbus.links._peers import MAX_PEERS
from tfbus.links.zenoh._settings import settings
from tfbus.tf_message import encode

pytestmark = pytest.mark.thorough

NAN = struct.pack("<d", float("nan"))
Message = tuple[bytes, bytes]


class Stranger:
    """A session without a link, which may say anything."""

    def __init__(self, address: str, domain: str) -> None:
        self.session = zenoh.open(settings([], address, None, 2.0))
        self.prefix = f"tfbus/{domain}"
        self.id = uuid4().hex
        self.origin = uuid4().bytes
        self._sequence = 0
        found: Queue[zenoh.Sample] = Queue()
        watch = self.session.liveliness().declare_subscriber(f"{self.prefix}/@alive/*", found.put, history=True)
        for _ in range(2):
            found.get(timeout=PATIENCE)
        watch.undeclare()

    def put(self, payload: bytes, attachment: bytes | None, key: str | None = None) -> None:
        block = zenoh.CongestionControl.BLOCK
        where = key or f"{self.prefix}/live/{self.id}"
        self.session.put(where, payload, attachment=attachment, congestion_control=block)

    def message(self, *samples: TransformStamped) -> Message:
        """What a link would send."""
        self._sequence += 1
        batch = PublishedBatch(self.origin, self._sequence, (("stranger", False, len(samples)),))
        return encode(samples), pack(0, [batch])

    def say(self, *samples: TransformStamped, key: str | None = None) -> None:
        self.put(*self.message(*samples), key)


class Scene:
    """A link, somebody who means well, and a stranger."""

    def __init__(self, stranger: Stranger, victim: Process, friend: Process) -> None:
        self.stranger = stranger
        self.victim = victim
        self.friend = friend

    def facts(self) -> dict[str, Any]:
        """The counters of the victim's link when it has taken in all that the stranger has said."""
        self.stranger.say(moving("map", "marker", 1))
        self.victim.ask("until", has=["marker"])
        self.victim.ask("remove", frame="marker")
        facts = self.victim.ask("facts")
        link: dict[str, Any] = facts["links"][0]
        return link | {"frames": facts["bus"]["frames"], "megabytes": facts["megabytes"]}

    def check_told(self, *reasons: str) -> None:
        """It tells of each reason, for whoever it is that has given it, once."""
        for reason in reasons:
            self.victim.wait(event="PeerRejected", reason=reason)
        assert self.victim.said(event="PeerRejected") == []

    def check_that_nothing_is_broken(self) -> None:
        for number, (one, other) in enumerate([(self.friend, self.victim), (self.victim, self.friend)]):
            one.ask("stream", authority=f"after all {number}", batches=20, rate=1_000)
            other.ask("until", last={f"after all {number}": 19})
            tally = other.ask("facts")["tallies"][f"after all {number}"]
            assert (tally["batches"], tally["missing"], tally["not_in_order"], tally["not_whole"]) == (20, 0, 0, 0)


@pytest.fixture
def scene() -> Iterator[Scene]:
    domain = new_domain()
    address = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    with crowd() as processes:
        victim = processes.add({"domain": domain, "listen": address})
        friend = processes.add({"domain": domain, "connect": address}, backend="trio")
        victim.ask("until", peers=1)
        stranger = Stranger(address, domain)
        try:
            scene = Scene(stranger, victim, friend)
            yield scene
            scene.check_that_nothing_is_broken()
        finally:
            stranger.session.close()


def test_random_bytes_are_counted_and_told_once(scene: Scene) -> None:
    rng = Random(1)
    for _ in range(2_000):
        scene.stranger.put(rng.randbytes(rng.randrange(400)), rng.randbytes(rng.randrange(200)))
    facts = scene.facts()
    # Of random attachments one in 256 begins as this version does.
    assert facts["rejected"]["version"] > 1_900
    assert sum(facts["rejected"].values()) == 2_000
    scene.check_told(*facts["rejected"])
    assert facts["frames"] == 0


def test_pieces_of_a_message_are_refused(scene: Scene) -> None:
    payload, attachment = scene.stranger.message(*[moving("map", "base", stamp) for stamp in range(3)])
    for size in range(len(payload)):
        scene.stranger.put(payload[:size], attachment)
    for size in range(len(attachment)):
        scene.stranger.put(payload, attachment[:size])
    scene.stranger.put(payload, None)
    for version in {*range(256)} - {attachment[0]}:
        scene.stranger.put(payload, bytes([version]) + attachment[1:])
    facts = scene.facts()
    assert sum(facts["rejected"].values()) == len(payload) + len(attachment) + 1 + 255
    assert facts["received_samples"] == 1
    assert facts["frames"] == 0


def test_messages_that_are_too_large_are_refused_whatever_is_in_them(scene: Scene) -> None:
    payload, attachment = scene.stranger.message(moving("map", "base", 1))
    for _ in range(3):
        scene.stranger.put(bytes(MAX_BYTES + 1), attachment)
        scene.stranger.put(payload, bytes(MAX_BYTES + 1))
        # So large that zenoh does not even put it together.
        scene.stranger.put(bytes(4 * MAX_BYTES), attachment)
    facts = scene.facts()
    assert facts["rejected"] == {"oversized": 6}
    scene.check_told("oversized")
    assert facts["megabytes"] < 200


def test_numbers_that_are_none_are_refused_and_the_loop_has_time_for_others(scene: Scene) -> None:
    payload, attachment = scene.stranger.message(*[moving("map", "base", 1, 1.0) for _ in range(5_000)])
    for _ in range(20):
        scene.stranger.put(payload.replace(struct.pack("<d", 1.0), NAN), attachment)
    scene.stranger.say(moving("map", "behind it", 1))
    began = scene.victim.start("until", has=["behind it"])
    # It answers while most of this is yet to be taken in.
    early = scene.victim.ask("facts")["links"][0]["rejected"].get("not finite", 0)
    assert early < 90_000
    scene.victim.finish(began)
    facts = scene.facts()
    assert facts["rejected"] == {"not finite": 100_000}
    scene.check_told("not finite")
    assert facts["frames"] == 1


def test_too_many_frame_names_are_refused_and_the_first_ones_go_with_their_peer(scene: Scene) -> None:
    stranger = scene.stranger
    token = stranger.session.liveliness().declare_token(f"{stranger.prefix}/@alive/{stranger.id}")
    for group in range(40):
        stranger.say(*[moving("map", f"frame {group} {i}", 1) for i in range(5_000)])
    stranger.say(moving("map", "frame 0 0", 2, 7.0))
    scene.victim.ask("until", x={"frame 0 0": 7.0})
    facts = scene.victim.ask("facts")
    (link,) = facts["links"]
    assert link["rejected"] == {"too many frames": 190_000}
    assert facts["bus"]["frames"] == 10_000
    assert facts["megabytes"] < 300
    scene.check_told("too many frames")
    token.undeclare()
    lost = scene.victim.wait(event="PeerLost")
    assert len(lost["frames"]) == 10_000


def test_forged_senders_are_as_many_as_a_link_takes_and_keep_nobody_out(scene: Scene) -> None:
    stranger = scene.stranger
    for _ in range(2 * MAX_PEERS):
        stranger.say(moving("map", "base", 1), key=f"{stranger.prefix}/live/{uuid4().hex}")
    # Nobody more comes in, not even the marker.
    payload, attachment = stranger.message(moving("map", "last", 1))
    known = scene.friend.ask("facts")["ids"][0]
    stranger.put(payload, attachment, f"{stranger.prefix}/live/{known}")
    scene.victim.ask("until", has=["last"])
    (link,) = scene.victim.ask("facts")["links"]
    assert link["rejected"]["too many peers"] >= MAX_PEERS
    scene.check_told("too many peers")
    # Whoever says that he is there gets in all the same.
    token = stranger.session.liveliness().declare_token(f"{stranger.prefix}/@alive/{stranger.id}")
    scene.victim.wait(event="PeerJoined", peer=stranger.id)
    stranger.say(moving("map", "newcomer", 1))
    scene.victim.ask("until", has=["newcomer"])
    token.undeclare()


def test_keys_that_no_link_has_are_refused(scene: Scene) -> None:
    stranger = scene.stranger
    wrong = ["**", "tfbus/**", f"{stranger.prefix}/**", f"{stranger.prefix}/live/*", f"{stranger.prefix}/static/*/*"]
    wrong += [f"{stranger.prefix}/live/{name}" for name in ("robot", "ä", "@x", "z" * 5_000)]
    elsewhere = [f"{stranger.prefix}/{name}" for name in ("live", "live/a/b", "static/a", "a", "live/@x/y")]
    for key in wrong + elsewhere:
        stranger.say(static("map", "base"), key=key)
    facts = scene.facts()
    # Those with stars are for the static and the live subscriber, as the case may be.
    assert set(facts["rejected"]) == {"key"}
    assert facts["rejected"]["key"] >= len(wrong)
    assert facts["frames"] == 0
    scene.check_told("key")


def test_a_thousand_tokens_are_a_thousand_peers_and_go_with_their_session(scene: Scene) -> None:
    stranger = scene.stranger
    names = [uuid4().hex for _ in range(2 * MAX_PEERS)] + [f"robot{i}" for i in range(100)] + ["*", "**"]
    tokens = [stranger.session.liveliness().declare_token(f"{stranger.prefix}/@alive/{name}") for name in names]
    known = scene.friend.ask("facts")["ids"][0]
    stranger.say(moving("map", "last", 1), key=f"{stranger.prefix}/live/{known}")
    scene.victim.ask("until", has=["last"], peers=MAX_PEERS)
    scene.victim.ask("until", peers=MAX_PEERS)
    scene.check_told("key", "too many peers")
    stranger.session.close()
    scene.victim.ask("until", peers=1)
    assert len(tokens) == len(names)

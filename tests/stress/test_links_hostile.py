"""Programs that speak zenoh and send anything they like cannot break a link."""

import struct
from collections.abc import Iterator
from queue import Queue
from typing import Any
from uuid import uuid4

import pytest
import zenoh
from support.processes import PATIENCE, PeerProcess, crowd, free_ports, new_domain
from support.samples import moving

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
    """A zenoh session without a link, which may send anything."""

    def __init__(self, address: str, domain: str) -> None:
        self.session = zenoh.open(settings([], address, None, 2.0))
        self.prefix = f"tfbus/{domain}"
        self.id = uuid4().hex
        self.origin = uuid4().bytes
        self._sequence = 0
        found: Queue[zenoh.Sample] = Queue()
        watch = self.session.liveliness().declare_subscriber(f"{self.prefix}/*/@alive/*/*", found.put, history=True)
        for _ in range(2):
            found.get(timeout=PATIENCE)
        watch.undeclare()

    def put(self, payload: bytes, attachment: bytes | None, key: str | None = None) -> None:
        block = zenoh.CongestionControl.BLOCK
        where = key or f"{self.prefix}/~/live/{self.id}"
        self.session.put(where, payload, attachment=attachment, congestion_control=block)

    def message(self, *samples: TransformStamped) -> Message:
        """A message as a link sends it."""
        self._sequence += 1
        batch = PublishedBatch(self.origin, self._sequence, (("stranger", False, len(samples)),))
        return encode(samples), pack(0, [batch])

    def send(self, *samples: TransformStamped, key: str | None = None) -> None:
        self.put(*self.message(*samples), key)


class Scene:
    """A link, a well-meaning peer, and a stranger."""

    def __init__(self, stranger: Stranger, victim: PeerProcess, friend: PeerProcess) -> None:
        self.stranger = stranger
        self.victim = victim
        self.friend = friend

    def facts(self) -> dict[str, Any]:
        """The counters of the victim's link once it has handled all messages of the stranger."""
        self.stranger.send(moving("map", "marker", 1))
        self.victim.ask("until", has=["marker"])
        self.victim.ask("remove", frame="marker")
        facts = self.victim.ask("facts")
        link: dict[str, Any] = facts["links"][0]
        return link | {"frames": facts["bus"]["frames"], "megabytes": facts["megabytes"]}

    def check_announced(self, *reasons: str) -> None:
        """Check that the victim has announced each reason once."""
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


def test_messages_that_are_too_large_are_refused(scene: Scene) -> None:
    payload, attachment = scene.stranger.message(moving("map", "base", 1))
    for _ in range(3):
        scene.stranger.put(bytes(MAX_BYTES + 1), attachment)
        scene.stranger.put(payload, bytes(MAX_BYTES + 1))
        # So large that zenoh does not even assemble it.
        scene.stranger.put(bytes(4 * MAX_BYTES), attachment)
    facts = scene.facts()
    assert facts["rejected"] == {"oversized": 6}
    scene.check_announced("oversized")
    assert facts["megabytes"] < 200


def test_values_that_are_not_numbers_are_refused_and_the_loop_has_time_for_others(scene: Scene) -> None:
    payload, attachment = scene.stranger.message(*[moving("map", "base", 1, 1.0) for _ in range(5_000)])
    for _ in range(20):
        scene.stranger.put(payload.replace(struct.pack("<d", 1.0), NAN), attachment)
    scene.stranger.send(moving("map", "behind it", 1))
    began = scene.victim.start("until", has=["behind it"])
    # It answers while most of this is still waiting.
    early = scene.victim.ask("facts")["links"][0]["rejected"].get("not finite", 0)
    assert early < 90_000
    scene.victim.finish(began)
    facts = scene.facts()
    assert facts["rejected"] == {"not finite": 100_000}
    scene.check_announced("not finite")
    assert facts["frames"] == 1


def test_too_many_frame_names_are_refused_and_the_first_ones_go_with_their_peer(scene: Scene) -> None:
    stranger = scene.stranger
    token = stranger.session.liveliness().declare_token(f"{stranger.prefix}/~/@alive/{stranger.id}/0")
    for group in range(40):
        stranger.send(*[moving("map", f"frame {group} {i}", 1) for i in range(5_000)])
    stranger.send(moving("map", "frame 0 0", 2, 7.0))
    scene.victim.ask("until", x={"frame 0 0": 7.0})
    facts = scene.victim.ask("facts")
    (link,) = facts["links"]
    assert link["rejected"] == {"too many frames": 190_000}
    assert facts["bus"]["frames"] == 10_000
    assert facts["megabytes"] < 300
    scene.check_announced("too many frames")
    token.undeclare()
    lost = scene.victim.wait(event="PeerLost")
    assert len(lost["frames"]) == 10_000


def test_forged_senders_are_limited_in_number_and_keep_no_announced_peer_out(scene: Scene) -> None:
    stranger = scene.stranger
    for _ in range(2 * MAX_PEERS):
        stranger.send(moving("map", "base", 1), key=f"{stranger.prefix}/~/live/{uuid4().hex}")
    # All places are taken, so not even the marker comes in.
    payload, attachment = stranger.message(moving("map", "last", 1))
    known = scene.friend.ask("facts")["ids"][0]
    stranger.put(payload, attachment, f"{stranger.prefix}/~/live/{known}")
    scene.victim.ask("until", has=["last"])
    (link,) = scene.victim.ask("facts")["links"]
    assert link["rejected"]["too many peers"] >= MAX_PEERS
    scene.check_announced("too many peers")
    # A peer that announces itself gets in all the same.
    token = stranger.session.liveliness().declare_token(f"{stranger.prefix}/~/@alive/{stranger.id}/0")
    scene.victim.wait(event="PeerJoined", peer=stranger.id)
    stranger.send(moving("map", "newcomer", 1))
    scene.victim.ask("until", has=["newcomer"])
    token.undeclare()

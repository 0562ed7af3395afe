"""A link under a flood of everything that somebody who speaks zenoh can send."""

import threading
from collections.abc import Iterator
from random import Random
from uuid import uuid4

import pytest
import zenoh
from support.processes import PATIENCE, Crowd, crowd, free_ports, new_domain
from support.samples import moving

from tfbus.links._attachment import PublishedBatch, pack
from tfbus.links._message import MAX_BYTES
from tfbus.links.zenoh._settings import settings
from tfbus.tf_message import encode

pytestmark = pytest.mark.thorough

NAMED = encode([moving("map", f"aaaaaaaa{number}", 0) for number in range(5_000)])
STATICS = [f"fixed {number}" for number in range(50)]


@pytest.fixture
def processes() -> Iterator[Crowd]:
    with crowd() as together:
        yield together


class Flood(threading.Thread):
    """Somebody who speaks zenoh, sends whatever there is to a domain, and then goes."""

    def __init__(self, domain: str, address: str, victim: str) -> None:
        super().__init__()
        self.session = zenoh.open(settings([], address, None, 2.0))
        self.prefix = f"tfbus/{domain}"
        self.victim = victim
        self.rounds = 0

    def run(self) -> None:
        try:
            for number in range(200):
                self.send(number)
                self.rounds += 1
        finally:
            self.session.close()

    def send(self, number: int) -> None:
        rng, me = Random(number), uuid4().hex
        block = zenoh.CongestionControl.BLOCK

        def put(key: str, payload: bytes, attachment: bytes) -> None:
            self.session.put(f"{self.prefix}/{key}", payload, attachment=attachment, congestion_control=block)

        put("live/nobody", b"", b"")
        for _ in range(20):
            put(f"live/{me}", rng.randbytes(rng.randrange(2_000)), rng.randbytes(rng.randrange(200)))
            put(f"live/{uuid4().hex}", b"", rng.randbytes(20))
            put(f"static/{me}/{rng.randrange(100)}", rng.randbytes(50), rng.randbytes(50))
        put(f"static/{self.victim}/lidar", b"\x01", b"\x01")
        # A million names, all from one peer.
        payload = NAMED.replace(b"a" * 8, b"%08d" % number)
        put(f"live/{'f' * 32}", payload, pack(0, [PublishedBatch(b"f" * 16, number, (("flood", False, 5_000),))]))
        if number % 50 == 0:
            put(f"live/{me}", bytes(MAX_BYTES + 1), b"")


def test_a_flood_of_everything_is_counted_and_told_and_harms_nobody(processes: Crowd) -> None:
    domain, address = new_domain(), f"tcp/127.0.0.1:{free_ports(1)[0]}"
    # Fewer frames than the victim's reader of events has room for.
    victim = processes.add({"domain": domain, "listen": address, "max_frames": 500})
    good = processes.add({"domain": domain, "connect": address})
    for process in (victim, good):
        process.ask("until", peers=1)
    good.ask("stream", authority="wheels", batches=10, rate=100.0)
    victim.ask("until", last={"wheels": 9})
    before = victim.ask("facts")
    flood = Flood(domain, address, good.ask("facts")["ids"][0])
    streaming = good.start("stream", authority="wheels", batches=200, rate=100.0, start=10)
    flood.start()
    try:
        while flood.is_alive():
            # It still answers.
            victim.ask("facts")
            flood.join(0.1)
    finally:
        flood.join(PATIENCE)
    assert flood.rounds == 200
    good.finish(streaming)
    good.ask("statics", names=STATICS, authority="urdf")
    good.ask("stream", authority="wheels", batches=10, rate=100.0, start=210)
    victim.ask("until", last={"wheels": 219}, static=STATICS)
    after = victim.ask("facts")
    tally, link = after["tallies"]["wheels"], after["links"][0]
    assert tally["batches"] + tally["missing"] == 220
    # Two that are published in one turn are one message.
    assert tally["missing"] <= 2 * link["lost"]
    assert (tally["not_in_order"], tally["not_whole"]) == (0, 0)
    assert after["tallies"]["flood"]["samples"] == 500
    told = {said["reason"] for said in victim.said(event="PeerRejected")}
    # What it has not told by now may still be on its way.
    told |= {victim.wait(event="PeerRejected", reason=reason)["reason"] for reason in link["rejected"].keys() - told}
    assert told >= {"key", "version", "attachment", "oversized", "too many frames"}
    assert link["rejected"].keys() == told
    # Each of the messages is counted somewhere.
    assert link["rejected"]["too many frames"] + link["queue"]["dropped"] * 5_000 + 500 >= 1_000_000
    assert sum(link["rejected"].values()) - link["rejected"]["too many frames"] + link["queue"]["dropped"] >= 200 * 62
    assert after["megabytes"] - before["megabytes"] < 150

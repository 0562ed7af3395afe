"""A link under a flood of everything that somebody who speaks zenoh can send."""

import threading
from collections.abc import Iterator
from random import Random
from uuid import uuid4

import pytest
import zenoh
from processes import PATIENCE, Crowd, crowd, free_ports, new_domain
from samples import moving

from tfbus.links.attachment import PublishedBatch, pack
from tfbus.links.outbox import MAX_BYTES
from tfbus.links.zenoh_settings import settings
from tfbus.tf_message import encode

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

"""A program that speaks zenoh and knows all keys sends garbage to each, and well-formed messages with a mistake."""

import json
import math
import struct
import threading
from base64 import urlsafe_b64encode
from collections.abc import Callable, Iterator
from random import Random
from typing import Any

import anyio
import anyio.to_thread
import pytest
import zenoh
from support.processes import PATIENCE, free_address, new_domain, until
from support.samples import moving, static

from tfbus import LATEST, Buffer, Bus, RemoteLookupError, SimulatedClock
from tfbus.links._remote_lookup import Cancellation, RemoteQuestion, write_answer, write_question
from tfbus.links.zenoh import BufferClient, BufferServer, ZenohLink
from tfbus.links.zenoh._settings import settings

pytestmark = [pytest.mark.anyio, pytest.mark.thorough]

STRANGER = "5" * 32
STAMP = 1_700_000_000_000_000_000
EXTREMES = [0, 1, 2**7, 2**15, 2**16 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**63, 2**64 - 1]
NUMBERS = [b"9" * 401, b"9" * 20, b"1e999", b"-1", b"NaN", b"null", b"[]", b'"x"', b"9" * 5_000]


def ignore(_: zenoh.Reply) -> None:
    """Need no answer."""


class Mutations:
    """Bytes that are nearly right, and bytes that are not."""

    def __init__(self, seed: int) -> None:
        self.random = Random(seed)

    def garbage(self) -> bytes:
        return self.random.choice([b"", b"{", b"[" * 30_000, b"\xff" * 40, self.random.randbytes(64)])

    def of(self, valid: bytes) -> bytes:
        random, data = self.random, bytearray(valid)
        if not data or random.random() < 0.1:
            return self.garbage()
        if data[0] == ord("{") and random.random() < 0.7:
            fields = json.loads(data)
            marked = fields | {random.choice(list(fields)): "the wrong one"}
            return json.dumps(marked).encode().replace(b'"the wrong one"', random.choice(NUMBERS))
        for _ in range(random.choice([1, 1, 1, 2, 5])):
            place = random.randrange(len(data) + 1)
            match random.randrange(5):
                case 0:
                    data[place : place + 1] = random.randbytes(1)
                case 1:
                    size, order = random.choice([1, 2, 4, 8]), random.choice(["little", "big"])
                    number = random.choice(EXTREMES) % 2 ** (8 * size)
                    data[place : place + size] = number.to_bytes(size, order)
                case 2:
                    del data[place : place + random.choice([1, 4, 8, 1_000])]
                case 3:
                    data[place:place] = struct.pack("<d", random.choice([math.nan, math.inf, -1e308, 1e13]))
                case _:
                    digits = [i for i, byte in enumerate(data) if byte in b"0123456789"]
                    if digits:
                        at = random.choice(digits)
                        data[at : at + 1] = random.choice(NUMBERS)
        return bytes(data)


class Stranger:
    """A session that sends what it likes, by any key of a domain, and answers as it likes."""

    def __init__(self, address: str, domain: str, seed: int) -> None:
        self.base = f"tfbus/{domain}/~"
        self.session = zenoh.open(settings([], address, {"mode": "client"}, 2.0))
        self.mutations = Mutations(seed)
        self.heard: dict[str, list[tuple[bytes, bytes]]] = {}
        self.cases = 0
        self.declared: list[Any] = [self.session.declare_subscriber(f"{self.base}/**", self._hear)]
        self._filters = [
            json.dumps([["*"], ["base"]]),
            json.dumps([["*", 10**30], [1]]),
            "[" * 5_000,
            "{}",
            '[["**a"],[]]',
        ]

    def _hear(self, sample: zenoh.Sample) -> None:
        kind = str(sample.key_expr).split("/")[3]
        attachment = b"" if sample.attachment is None else sample.attachment.to_bytes()
        self.heard.setdefault(kind, []).append((sample.payload.to_bytes(), attachment))

    def learn(self, link: str, questions: dict[str, bytes]) -> None:
        """Ask rightly, to have right answers to change; and hear no more, for it would be its own."""
        self.declared.pop().undeclare()
        for kind, payload in questions.items():
            for reply in self.session.get(f"{self.base}/{kind}/{link}", payload=payload, timeout=2.0):
                ok = reply.ok
                assert ok is not None
                attachment = b"" if ok.attachment is None else ok.attachment.to_bytes()
                self.heard.setdefault(kind, []).append((ok.payload.to_bytes(), attachment))

    def announce(self) -> None:
        """Be a peer and a server, whose answers are wrong."""

        def answer(query: zenoh.Query) -> None:
            parts = str(query.key_expr).split("/")
            # Its own questions come here, too.
            kind = parts[3] if len(parts) > 3 else "state"
            for _ in range(self.mutations.random.choice([0, 1, 1, 1, 2])):
                self._reply(query, kind)

        for key in (f"{self.base}/*/{STRANGER}", f"{self.base}/lookup"):
            self.declared.append(self.session.declare_queryable(key, zenoh.handlers.Callback(answer, indirect=False)))
        self.declared.append(self.session.liveliness().declare_token(f"{self.base}/@alive/{STRANGER}/0"))

    def _reply(self, query: zenoh.Query, kind: str) -> None:
        self.cases += 1
        payload, attachment = self.mutations.random.choice(self.heard.get(kind) or [(b"", b"")])
        of = self.mutations.of
        addresses = ["tcp/\ufffd:1", "quic/a:1#;;;", "tcp/" + "a" * 70 + ":1", "serial//dev/null", "tcp/127.0.0.1:1"]
        if kind == "hears":
            token = f"{self.base}/@alive/{'7' * 32}/0"
            attachment = f"{token} {' '.join(addresses)}".encode()
        key = f"{self.base}/{kind}" if kind == "lookup" else f"{self.base}/{kind}/{STRANGER}"
        query.reply(key, of(payload), attachment=attachment if kind == "hears" else of(attachment))

    def storm(self, link: str, questions: dict[str, bytes], rounds: int) -> None:
        of, random = self.mutations.of, self.mutations.random
        for _ in range(rounds):
            for kind in ("live", "slow", "only"):
                payload, attachment = random.choice(self.heard["live"])
                sender = random.choice([STRANGER, STRANGER, STRANGER, link, "6" * 32, "not an id"])
                key = f"{self.base}/{kind}/{sender}" + ("/" + "0" * 32 if kind == "only" else "")
                self.cases += 1
                self.session.put(key, of(payload), attachment=random.choice([of(attachment), attachment, None]))
                self.session.put(key, payload, attachment=of(attachment))
                self.session.delete(key)
            for kind, right in questions.items():
                self.cases += 1
                where = f"{self.base}/{kind}" if kind == "lookup" else f"{self.base}/{kind}/{link}"
                where = random.choice([where, where, where, f"{self.base}/**", "**", f"{where}?a=b;c"])
                self.session.get(
                    where,
                    zenoh.handlers.Callback(ignore, indirect=False),
                    payload=random.choice([of(right), None]),
                    attachment=random.choice([of(f"{self.base}/@alive/{STRANGER}/0".encode()), None]),
                    timeout=1.0,
                )
            chunk = urlsafe_b64encode(random.choice(self._filters).encode()).decode()
            for token in (
                f"@only/{STRANGER}/0/x{of(chunk.encode()).hex()}",
                f"@only/{STRANGER}/0/{chunk}",
                f"@alive/x/{chunk}",
            ):
                self.cases += 1
                self.session.liveliness().declare_token(f"{self.base}/{token}").undeclare()
            self.session.liveliness().declare_token(f"{self.base}/@lookup/{random.randrange(99)}").undeclare()
            self.session.liveliness().declare_token(f"{self.base}/@asking/{random.randrange(99)}").undeclare()

    def close(self) -> None:
        self.declared.clear()
        self.session.close()


@pytest.fixture(params=range(3))
def stranger(request: pytest.FixtureRequest) -> Iterator[Callable[[str, str], Stranger]]:
    made: list[Stranger] = []

    def make(address: str, domain: str) -> Stranger:
        made.append(Stranger(address, domain, request.param))
        return made[-1]

    yield make
    for one in made:
        one.close()


async def test_whatever_a_stranger_sends_by_any_key_all_are_served_and_the_rest_is_counted(
    stranger: Callable[[str, str], Stranger], caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    address, domain, clock = free_address(), new_domain(), SimulatedClock()
    questions = {
        "state": bytes(8),
        "history": struct.pack("<d", 5.0),
        "hears": f"tfbus/{domain}/~/@alive/{STRANGER}/0".encode(),
        "lookup": write_question(RemoteQuestion("s", 1, "map", "base", LATEST, 1.0, 2.0, 3, "map", 0.1, 0.2, 0.3)),
    }
    with Bus(max_ahead=None) as bus, Bus(clock, max_ahead=None) as other, Buffer(bus) as buffer, Buffer(other):
        async with (
            ZenohLink(bus, domain, listen=address, history=5.0) as link,
            ZenohLink(other, domain, connect=address, history=5.0, clock=clock, frames=["arm", "base", "lamp"]) as peer,
            BufferServer(buffer, link=link) as server,
            BufferClient(domain, connect=address) as client,
        ):
            bus.publish([static("map", "lamp"), moving("map", "base", STAMP, authority="odometry")])
            await until(lambda: bool(link.peers and peer.peers))
            one = await anyio.to_thread.run_sync(stranger, address, domain)
            one.heard["lookup"] = [
                (write_question(Cancellation("s", 1)), b""),
                (write_answer(RemoteLookupError(domain=domain, robot=None, reason="busy", detail="")), b""),
                (write_answer(moving("map", "base", STAMP)), b""),
            ]
            for stamp in range(20):
                bus.publish(moving("map", "base", STAMP + stamp))
                await anyio.sleep(0.01)
            await until(lambda: "live" in one.heard)
            await anyio.to_thread.run_sync(one.learn, link.id, {k: v for k, v in questions.items() if k != "lookup"})
            await anyio.to_thread.run_sync(one.announce)
            threads = [thread for thread in threading.enumerate() if "(_send_all)" in thread.name]
            assert len(threads) == 2
            for _ in range(4):
                await anyio.to_thread.run_sync(one.storm, link.id, questions, 40)
                await anyio.to_thread.run_sync(one.storm, peer.id, questions, 20)
                # Lookups of the client may come to the stranger, who says that it is a server.
                with anyio.move_on_after(2.0):
                    for _ in range(20):
                        try:
                            await client.lookup("map", "base", timeout=0.2)
                        except RemoteLookupError:
                            pass
                        except (TimeoutError, LookupError, ValueError, TypeError):
                            pass
            await anyio.to_thread.run_sync(one.close)
            # All goes on for those who mean well.
            bus.publish(static("map", "end"))
            other.publish(moving("map", "arm", STAMP))
            async with BufferClient(domain, connect=address) as last:
                with anyio.fail_after(PATIENCE):
                    assert (await last.lookup("map", "end")).static
                    assert (await last.lookup("map", "arm")).stamp == STAMP
            counts, served = link.statistics(), server.statistics()
            assert all(thread.is_alive() for thread in threads)
            for reason in ("key", "version", "attachment", "question", "token"):
                assert counts.rejected[reason], reason
            assert served.refused["malformed"]
            assert "internal" not in served.refused
            assert "callback error" not in capfd.readouterr().err
            assert [record for record in caplog.records if record.levelname in ("ERROR", "CRITICAL")] == []


async def test_a_flood_of_tokens_is_bounded_and_counted_and_a_friend_is_met_once_it_has_gone() -> None:
    address, domain = free_address(), new_domain()
    base = f"tfbus/{domain}/~"
    chunk = urlsafe_b64encode(json.dumps([["*"], ["base"]]).encode()).decode()
    with Bus() as bus, Bus() as other:
        async with ZenohLink(bus, domain, listen=address) as link:
            session = await anyio.to_thread.run_sync(zenoh.open, settings([], address, {"mode": "client"}, 2.0))

            def flood() -> list[Any]:
                declare = session.liveliness().declare_token
                ids = [f"{number:032x}" for number in range(1, 1_201)]
                tokens = [declare(f"{base}/@alive/{each}/0") for each in ids]
                tokens += [declare(f"{base}/@alive/{ids[0]}/{name:032x}") for name in range(1, 101)]
                tokens += [declare(f"{base}/@only/{ids[0]}/{name:032x}/{chunk}") for name in range(2_100)]
                return tokens

            tokens = await anyio.to_thread.run_sync(flood)
            await until(lambda: link.statistics().rejected.get("filter", 0) >= 100)
            await until(lambda: link.statistics().rejected.get("too many tokens", 0) >= 280)
            assert len(link.peers) <= 1_000
            tokens.clear()
            await anyio.to_thread.run_sync(session.close)
            await until(lambda: not link.peers)
            async with ZenohLink(other, domain, connect=address) as friend:
                await until(lambda: bool(friend.peers and link.peers))
                other.publish(static("map", "lamp"))
                await until(lambda: bus.statistics().frames > 0)

"""A program that knows the protocol and means ill, against links over both wires."""

import json
import struct
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from random import Random
from typing import Any, NamedTuple

import anyio
import anyio.lowlevel
import anyio.to_thread
import pytest
from support.damage import damaged
from support.domains import Network, World, write_text
from support.domains import Stranger as WrittenLink
from support.local_links import RawPeer, files_in, framed
from support.memory_wire import MemoryNetwork
from support.processes import free_address, new_domain, until
from support.samples import moving, static

from tfbus import LATEST, Buffer, Bus, PeerRejected, Transform, TransformStamped
from tfbus.links import BufferServer, DomainLink
from tfbus.links.channels import MOST_FILTERS
from tfbus.links.domain import SOONEST_SIGN
from tfbus.links.endpoint import MAX_PEERS, MOST_AUTHORITY_TEXT
from tfbus.links.history import MOST_HELD_SAMPLES, HistoryAsker
from tfbus.links.local import LocalLink
from tfbus.links.message import (
    VERSION,
    Heard,
    Kind,
    Outgoing,
    RemoteQuestion,
    kind_of,
    write_body,
    write_message,
    write_question,
)
from tfbus.links.replica import (
    Claim,
    Entry,
    OutgoingBatch,
    ReceivedBatch,
    RemovedFrame,
)
from tfbus.links.seams import Hearing, Joined, Left

pytestmark = pytest.mark.anyio

STRANGER = "5" * 32
BUS, OTHER, FAR = b"stranger........", b"another.........", 2**52
EXTREMES = [0, 1, 2**7, 2**15, 2**16 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**63, 2**64 - 1]
HEAD = struct.Struct("<BBBBHHIQ16sQQQ")


@pytest.fixture
def anyio_backend() -> tuple[str, dict[str, Any]]:
    """One event loop: what a stranger says is judged before it."""
    return "asyncio", {}


class Scene(NamedTuple):
    """Facts that a stranger can learn, and its dice."""

    origin: bytes
    number: int
    random: Random


Attack = Callable[[Scene], Iterator[bytes]]


def live(*entries: Entry, number: int = 0, kind: Kind = Kind.LIVE, **out: Any) -> bytes:
    return write_message(Outgoing(kind, BUS, number, **out), entries)


def lookup(number: int, body: bytes, kind: Kind = Kind.LOOKUP) -> bytes:
    return write_body(kind, (number % 2**64).to_bytes(8, "little") + body)


def valid(scene: Scene) -> list[bytes]:
    """One message of each kind."""
    number = scene.number
    entries = OutgoingBatch(BUS, number, (moving("map", "arm", 1), static("map", "leg"))), RemovedFrame(BUS, 1, "leg")
    reach = [(OTHER, (BUS, OTHER))]
    question = RemoteQuestion("map", "arm", LATEST, 1.0, 2.0, 3, "map", 0.1, 0.2, 0.3)
    return [
        *(live(*entries, kind=kind, number=1, time=5, reach=reach) for kind in Kind if kind.value in (1, 2, 3, 5, 7)),
        write_text(Kind.QUESTION, {"since": 0, "frames": ["arm"]}),
        write_text(Kind.PAST_QUESTION, {"seconds": 1.0, "after": ""}),
        lookup(1, write_question(question)),
        lookup(1, write_question(question), Kind.LOOKUP_ANSWER),
    ]


def mutated(scene: Scene) -> Iterator[bytes]:
    numbers = [number.to_bytes(8, "little")[:size] for number in EXTREMES for size in (1, 2, 4, 8)]
    numbers += [struct.pack("<d", number) for number in (float("nan"), float("inf"), 1e308)]
    for _ in range(600):
        yield damaged(scene.random, scene.random.choice(valid(scene)), numbers)


def garbage(scene: Scene) -> Iterator[bytes]:
    for kind in range(12):
        for data in (
            b"",
            b"{",
            b"[" * 30_000,
            b"9" * 5_000,
            b'{"a":' * 5_000,
            b"\xff" * 60,
            scene.random.randbytes(99),
        ):
            yield bytes((VERSION, kind)) + data
    yield b""
    yield bytes(2**22 + 1)


def false_counts(_: Scene) -> Iterator[bytes]:
    for ways, origins, authorities, entries in [
        (255, 0, 0, 0),
        (0, 65_535, 0, 1),
        (0, 0, 65_535, 1),
        (0, 0, 0, 2**32 - 1),
    ]:
        yield HEAD.pack(VERSION, 1, 0, ways, origins, authorities, entries, 1, BUS, 0, 0, 0) + bytes(2_000)
    empty = struct.pack("<BHHQ", 0, 0, 10_000, 1) + bytes(20_000)
    yield HEAD.pack(VERSION, 1, 0, 0, 1, 1, 2, 1, BUS, 0, 0, 0) + BUS + bytes(10) + empty * 2


def ill_questions(_: Scene) -> Iterator[bytes]:
    for since in (-1, 2**64, 10**400, 1.5, None, True, "0"):
        yield write_text(Kind.QUESTION, {"since": since, "frames": None})
    for frames in ("arm", [1], {"arm": 1}, ["\ud800"], [["arm"]]):
        yield write_text(Kind.QUESTION, {"since": 0, "frames": frames})
    for seconds in (float("nan"), float("inf"), -1, 10**400, True, None):
        yield write_text(Kind.PAST_QUESTION, {"seconds": seconds, "after": "\ud800"})


def question_storm(_: Scene) -> Iterator[bytes]:
    for number in range(600):
        yield write_text(Kind.QUESTION, {"since": 0, "frames": [f"filter {number}"] if number % 2 else None})
        yield write_text(Kind.PAST_QUESTION, {"seconds": 3_600, "after": ""})


def numbers_without_end(scene: Scene) -> Iterator[bytes]:
    """Each as far ahead of the last one as one may be, up to the last number that there is."""
    for jump in range(1, 4_200):
        number = min(scene.number + jump * FAR - 2**40, 2**64 - 1)
        yield live(OutgoingBatch(OTHER if jump % 2 else scene.origin, number, (static("map", "far"),)))
        yield live(RemovedFrame(BUS, number, "far"))


def own_origin(scene: Scene) -> Iterator[bytes]:
    for first in range(0, 2_000, 500):
        numbers = range(scene.number + first, scene.number + first + 500)
        yield live(*(OutgoingBatch(scene.origin, number, (static("wrong", "lamp"),)) for number in numbers))
        yield live(*(RemovedFrame(scene.origin, number, "lamp") for number in numbers))


def removals_beyond_the_bound(scene: Scene) -> Iterator[bytes]:
    """A frame moves, is removed, and its removal is pushed out by others before it has settled."""
    yield live(OutgoingBatch(BUS, scene.number, (moving("map", "gone", 1),)))
    yield write_text(Kind.QUESTION, {"since": 0, "frames": None})
    yield live(RemovedFrame(BUS, scene.number + 1, "gone"))
    for first in range(2, 12_002, 4_000):
        yield live(*(RemovedFrame(BUS, scene.number + first + k, f"r{first + k}") for k in range(4_000)))
    yield write_text(Kind.QUESTION, {"since": 0, "frames": None})


def many_origins(scene: Scene) -> Iterator[bytes]:
    for first in range(0, 12_000, 1_000):
        origins = [(first + k).to_bytes(16, "big") for k in range(1_000)]
        yield live(
            *(
                OutgoingBatch(origin, scene.number, (moving("map", f"o{k % 50}", k + 1),))
                for k, origin in enumerate(origins)
            )
        )
    yield live(*(RemovedFrame(BUS, scene.number + 1, f"o{k}") for k in range(50)))


def false_claims(scene: Scene) -> Iterator[bytes]:
    for number in range(500):
        claim = Claim(0, scene.random.choice(EXTREMES), scene.random.choice(EXTREMES))
        yield live(kind=Kind.SIGN, number=scene.random.choice(EXTREMES), claim=claim)
        yield live(kind=Kind.ANSWER, claim=Claim(number, number + 1, 7, final=False))
        yield live(kind=Kind.MEETING, claim=claim)


def false_ways(scene: Scene) -> Iterator[bytes]:
    loop = [(scene.origin, (BUS,)), (BUS, (BUS,) * 8), (OTHER, (scene.origin, OTHER)), (OTHER, (OTHER,))]
    for number in range(500):
        many = [(scene.random.randbytes(16), (OTHER,) * 8) for _ in range(255)]
        yield live(kind=Kind.SIGN, reach=many if number % 2 else loop)
    yield HEAD.pack(VERSION, 2, 0, 1, 0, 0, 0, 0, BUS, 0, 0, 0) + OTHER + b"\xff" + OTHER * 255


def false_times(_: Scene) -> Iterator[bytes]:
    for stamp in (0, 2**63 - 1, -(2**63), 10**18, 2**63 - 2, 5):
        yield live(time=stamp)


def lookups(_: Scene) -> Iterator[bytes]:
    for number in range(1_500):
        question = RemoteQuestion("map", f"unknown {number}", LATEST, 10.0)
        yield lookup(number, write_question(question))
        yield lookup(number - 3, b"")
        yield lookup(number, json.dumps({"type": "TransformStamped"}).encode(), Kind.LOOKUP_ANSWER)
    yield lookup(1, b'{"timeout": ' + b"9" * 401 + b"}")


def many_frames(scene: Scene) -> Iterator[bytes]:
    for first in range(0, 11_000, 1_000):
        samples = tuple(static("map", f"f{first + k}") for k in range(1_000))
        yield live(OutgoingBatch(BUS, scene.number + first, samples))
    for first in range(0, 1_200, 100):
        yield live(
            *(OutgoingBatch(BUS, scene.number, (static("map", "a", authority=f"{first + k}"),)) for k in range(100))
        )
    yield live(*(OutgoingBatch(BUS, scene.number, (static("map", "a", authority=f"{k}" * 60_000),)) for k in range(9)))
    yield live(*(OutgoingBatch(BUS, scene.number, (static("map", "a", authority=f"-{k}" * 30_000),)) for k in range(9)))


ATTACKS: dict[str, tuple[Attack, set[str]]] = {
    "mutated": (mutated, {"head", "version"}),
    "garbage": (garbage, {"head", "version", "text", "oversized"}),
    "false counts": (false_counts, {"head", "oversized"}),
    "ill questions": (ill_questions, {"text"}),
    "question storm": (question_storm, set()),
    "numbers without end": (numbers_without_end, {"number"}),
    "own origin": (own_origin, set()),
    "removals beyond the bound": (removals_beyond_the_bound, set()),
    "many origins": (many_origins, set()),
    "false claims": (false_claims, set()),
    "false ways": (false_ways, {"head"}),
    "false times": (false_times, set()),
    "lookups": (lookups, {"lookup"}),
    "many frames": (many_frames, {"too many frames", "too many authorities"}),
}
QUICK = {
    ("zenoh", "false counts"),
    *(("local", name) for name in ("garbage", "false counts", "numbers without end", "removals beyond the bound")),
}


class LocalStranger:
    """It speaks over a socket, and never reads."""

    def __init__(self, domain: str, directory: str) -> None:
        self._domain, self._directory = domain, directory

    def link(self, bus: Bus, **options: Any) -> DomainLink:
        return LocalLink(bus, self._domain, directory=self._directory, **options)

    async def meet(self) -> bytes:
        """Meet the attacked link; returns what that says first."""
        # The first name is that of the oldest link, which the test attacks.
        self._peer = await RawPeer.connect(files_in(self._directory)[0])
        await self._peer.meet()
        return await self._peer.hear()

    async def say(self, message: bytes) -> None:
        await self._peer.stream.send(framed(message))

    async def leave(self) -> None:
        await self._peer.stream.aclose()


class ZenohStranger:
    """It speaks over a session of the router."""

    def __init__(self, domain: str, directory: str) -> None:
        del directory
        self._domain, self._address = domain, free_address()
        self._attacked: DomainLink | None = None
        self._id = STRANGER

    def link(self, bus: Bus, **options: Any) -> DomainLink:
        from tfbus.links.zenoh import ZenohLink

        where: dict[str, Any] = {"connect" if self._attacked else "listen": self._address}
        link = ZenohLink(bus, self._domain, **where, **options)
        self._attacked = self._attacked or link
        return link

    async def meet(self) -> bytes:
        import zenoh

        attacked = self._attacked
        assert attacked is not None
        config = zenoh.Config()
        for path, value in {"mode": "client", "connect/endpoints": [self._address]}.items():
            config.insert_json5(path, json.dumps(value))
        config.insert_json5("scouting/multicast/enabled", "false")
        self._session = await anyio.to_thread.run_sync(zenoh.open, config)
        block = zenoh.CongestionControl.BLOCK
        self._publisher = self._session.declare_publisher(
            f"tfbus/{self._domain}/~/all/{self._id}", congestion_control=block
        )
        heard = self._session.declare_subscriber(f"tfbus/{self._domain}/@to/{self._id}")
        self._token = self._session.liveliness().declare_token(f"tfbus/{self._domain}/~/@alive/{self._id}/1")
        sample = await anyio.to_thread.run_sync(heard.recv)
        while str(sample.attachment and sample.attachment.to_bytes().hex()) != attacked.id:
            sample = await anyio.to_thread.run_sync(heard.recv)
        heard.undeclare()
        message: bytes = sample.payload.to_bytes()
        return message

    async def say(self, message: bytes) -> None:
        await anyio.to_thread.run_sync(self._publisher.put, message)

    async def leave(self) -> None:
        await anyio.to_thread.run_sync(self._session.close)


Stranger = LocalStranger | ZenohStranger


@pytest.fixture
def stranger(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Stranger:
    if request.param == "zenoh":
        pytest.importorskip("zenoh")
    directory = str(tmp_path_factory.mktemp("t"))
    return (LocalStranger if request.param == "local" else ZenohStranger)(new_domain(), directory)


def statics(bus: Bus) -> dict[str, str]:
    found: dict[str, str] = {}
    bus.subscribe(lambda batch: found.update({sample.child: sample.parent for sample in batch})).close()
    return found


@asynccontextmanager
async def attacked(stranger: Stranger, **options: Any) -> AsyncIterator[tuple[DomainLink, bytes, list[PeerRejected]]]:
    """A link that a stranger has met; at the end it and a friend have to agree about all that they say."""
    refused: list[PeerRejected] = []
    with (
        Bus(max_ahead=None, max_behind=None) as bus,
        Bus(max_ahead=None, max_behind=None) as other,
        Buffer(bus) as buffer,
    ):
        async with (
            stranger.link(bus, **options) as link,
            BufferServer(buffer, link) as server,
            stranger.link(other) as friend,
        ):
            bus.publish([static("map", "lamp"), moving("map", "base", time.time_ns())])
            await until(lambda: bool(link.peers and friend.peers))
            with bus.events() as events:
                meeting = await stranger.meet()
                await until(lambda: len(link.peers) == 2)
                yield link, HEAD.unpack_from(meeting)[8], refused
                await stranger.leave()
                await until(lambda: len(link.peers) == 1)
                other.publish(static("map", "chair"))
                bus.publish([static("map", "table"), static("map", "lamp")])
                await until(lambda: statics(bus).get("chair") == statics(other).get("table") == "map")
                other.publish(static("room", "chair"))
                bus.remove_frame("table")
                await until(lambda: statics(bus).get("chair") == "room" and "table" not in statics(other))
                await until(lambda: statics(bus).get("lamp") == statics(other).get("lamp") == "map")
                assert (await friend.lookup("room", "chair", timeout=20.0)).static
                assert "internal" not in server.statistics().refused
                refused += [event for event in iter(events.queue.get, None) if isinstance(event, PeerRejected)]


@pytest.mark.parametrize(
    ("stranger", "attack"),
    [
        pytest.param(carrier, name, marks=() if (carrier, name) in QUICK else pytest.mark.thorough)
        for carrier in ("local", "zenoh")
        for name in ATTACKS
    ],
    indirect=["stranger"],
)
async def test_whatever_a_stranger_says_the_others_agree_and_what_is_refused_is_counted_and_told_once(
    stranger: Stranger, attack: str, caplog: pytest.LogCaptureFixture
) -> None:
    messages, reasons = ATTACKS[attack]
    async with attacked(stranger) as (link, origin, refused):
        scene = Scene(origin, time.time_ns() // 1_000, Random(attack))
        for message in messages(scene):
            await stranger.say(message)
        await until(lambda: reasons <= link.statistics().rejected.keys())
        await until(lambda: link.statistics().queue.pending == 0)
    told = [(event.peer, event.reason) for event in refused]
    assert len(told) == len(set(told))
    assert reasons <= {reason for _, reason in told}
    # Every refusal has a reason of its own.
    assert "not published" not in {reason for _, reason in told}
    assert [record for record in caplog.records if record.levelname in ("ERROR", "CRITICAL")] == []


# Defects that were found


def test_messages_of_large_batches_do_not_wait_for_the_past_beyond_a_bound() -> None:
    asker = HistoryAsker(5.0, lambda *_: None, lambda: 0.0)
    asker.joined("one")
    asker.joined("other")
    samples = [moving("map", "arm", stamp) for stamp in range(1_000)]
    heard = Heard(Kind.LIVE, BUS, 1, entries=[ReceivedBatch(BUS, 1, samples)])
    held = sum(asker.holds("one", heard) + asker.holds("other", heard) for _ in range(500))
    assert held == MOST_HELD_SAMPLES // 1_001
    asker.end("one")
    assert asker.holds("other", heard)


def test_the_authorities_of_a_peer_have_so_many_letters_together() -> None:
    world = World()
    network = Network(world)
    process, stranger = world.process(network), WrittenLink(network)
    for number in range(200):
        sample = TransformStamped("map", "arm", number, Transform(), f"{number:x}" * 10_000)
        stranger.say(stranger.batch(sample, number=number + 1))
    taken = {sample.authority for sample in process.seen}
    assert sum(map(len, taken)) <= MOST_AUTHORITY_TEXT
    assert process.end.rejected == {"too many authorities": 200 - len(taken)}


async def test_a_link_that_found_no_place_is_not_heard_and_is_met_once_there_is_one() -> None:
    network = MemoryNetwork()
    with Bus() as bus:
        async with DomainLink(bus, "d", network.wire()) as link:
            receive = network.wires[link.id].receive
            for number in range(MAX_PEERS + 5):
                receive(f"{number:032x}", Joined(""))
            await until(lambda: len(link.peers) == MAX_PEERS and link.statistics().rejected.get("too many peers") == 5)
            assert f"{MAX_PEERS:032x}" not in link.peers
            receive(f"{MAX_PEERS:032x}", live(OutgoingBatch(BUS, 1, (static("map", "a"),))))
            await until(lambda: link.statistics().queue.pending == 0)
            assert statics(bus) == {}
            receive(f"{MAX_PEERS + 1:032x}", Left())
            receive(f"{7:032x}", Left())
            await until(lambda: f"{MAX_PEERS:032x}" in link.peers)
            receive(f"{8:032x}", Left())
            await until(lambda: f"{MAX_PEERS + 2:032x}" in link.peers)
            assert f"{MAX_PEERS + 1:032x}" not in link.peers


async def test_filters_that_nobody_hears_make_room_for_others() -> None:
    network = MemoryNetwork()
    with Bus() as bus, Bus() as other:
        async with DomainLink(bus, "d", network.wire()) as link:
            receive = network.wires[link.id].receive
            for number in range(MOST_FILTERS + 50):
                receive(f"{number:032x}", write_text(Kind.QUESTION, {"since": 0, "frames": [f"f{number}"]}))
            async with DomainLink(other, "d", network.wire(), frames=["arm"]):
                bus.publish(static("map", "arm"))
                await until(lambda: "arm" in statics(other))
                bus.publish(static("room", "arm"))
                await until(lambda: statics(other)["arm"] == "room")
                assert link.statistics().rejected == {}


async def test_however_often_ways_change_a_bridge_signs_so_often_at_most() -> None:
    first, second = MemoryNetwork(), MemoryNetwork()
    signs: list[bytes] = []
    with Bus() as bus:
        async with DomainLink(bus, "one", first.wire()) as link, DomainLink(bus, "two", second.wire()):
            listener = second.wire()
            await listener.open([Hearing("*", "all")], lambda _, item: signs.append(item), signs.append)  # type: ignore[arg-type]
            receive = first.wires[link.id].receive
            receive(STRANGER, Joined(""))
            begun = anyio.current_time()
            for number in range(2_000):
                receive(STRANGER, live(kind=Kind.SIGN, reach=[(number.to_bytes(16, "big"), (OTHER,))]))
                await anyio.lowlevel.checkpoint()
            await until(lambda: link.statistics().queue.pending == 0)
            lasted = anyio.current_time() - begun
            heard = [item for item in signs if isinstance(item, bytes) and kind_of(item) is Kind.SIGN]
            assert 1 <= len(heard) <= lasted / SOONEST_SIGN + 2


async def test_questions_are_answered_one_a_link_and_leave_half_of_the_time_to_others() -> None:
    network = MemoryNetwork()
    with Bus() as bus:
        async with DomainLink(bus, "d", network.wire()) as link:
            bus.publish([static("map", f"f{number}") for number in range(500)])
            answers: list[object] = []
            asker = network.wire()
            await asker.open([Hearing("*", "all")], lambda _, item: answers.append(item), answers.append)
            for _ in range(1_000):
                asker.send(link.id, write_text(Kind.QUESTION, {"since": 0, "frames": None}))
            await until(lambda: any(kind_of(item) is Kind.ANSWER for item in answers if isinstance(item, bytes)))
            await until(lambda: link.statistics().queue.pending == 0)
            count = sum(kind_of(item) is Kind.ANSWER for item in answers if isinstance(item, bytes))
            # How many depends on when they come, and is far from all.
            assert count < 500

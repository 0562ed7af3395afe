"""Whole domains in one process and in simulated time: links of tfbus over networks that lose, cut, stop and kill.

Everything but the event loop and the sockets is real. A run is given by its seed, and takes some milliseconds.
"""

import heapq
import json
import random
from collections.abc import Callable, Coroutine, Iterable, Sequence
from contextlib import suppress
from fnmatch import fnmatchcase
from itertools import count
from typing import Any

from support.foreign_world import ForeignCarrier, ForeignMessage, ForeignWorld

from tfbus import Bus, SimulatedClock, SystemClock, Transform, TransformStamped, UnknownFrameError
from tfbus.geometry.stamped import Batch
from tfbus.links.clocks import OwnClock
from tfbus.links.domain import DomainEnd
from tfbus.links.endpoint import Endpoint
from tfbus.links.link import ReceiveQueue
from tfbus.links.message import NOTHING, Kind, Outgoing, kind_of, write_body, write_message
from tfbus.links.relay import relay_of
from tfbus.links.replica import Claim, OutgoingBatch, RemovedFrame
from tfbus.links.ros.foreign_end import ForeignEnd
from tfbus.links.seams import Hearing, Joined, Left, Receive, Received, WireItem
from tfbus.tf_message import MalformedMessageError

SECOND = 10**9
BACKLOG = 100
"""So many messages wait for a process that is stopped; the others are lost."""


def finish(call: Coroutine[Any, Any, object]) -> None:
    """Run a coroutine that never waits."""
    with suppress(StopIteration):
        call.send(None)


def write_text(kind: Kind, fields: object) -> bytes:
    """A message of JSON, which may be of no use."""
    return write_body(kind, json.dumps(fields).encode())


class SkewedClock(SystemClock):
    """A clock of a world that is ahead by some s, and gains some s a s; it can be set."""

    def __init__(self, world: "World", ahead: float = 0.0, drift: float = 0.0) -> None:
        self._world = world
        self._began = world.now
        self.ahead = ahead
        self.drift = drift
        self.is_set = True

    def now(self) -> int:
        return round((self._world.now + self.offset) * SECOND)

    @property
    def offset(self) -> float:
        """The s by which it is ahead of the time of the world."""
        return self.ahead + self.drift * (self._world.now - self._began)


class World:
    """The time, the networks and the processes."""

    def __init__(self, seed: int = 0) -> None:
        self.seed = seed
        self.random = random.Random(seed)
        # The library draws pauses.
        random.seed(seed)
        self.now = 1_000.0
        self.processes: list[Process] = []
        self.published: set[tuple[str, int]] = set()
        self.names = count()
        self._numbers = count()
        self._events: list[tuple[float, int, Callable[[], object]]] = []
        self._arrivals: dict[tuple[object, object], float] = {}

    def process(
        self, *networks: "Network", drop_lost: bool = False, worlds: Sequence[ForeignWorld] = (), **options: Any
    ) -> "Process":
        """Start a process with a link to each of some networks and worlds."""
        process = Process(self, networks, drop_lost, worlds, options)
        self.processes.append(process)
        process.start()
        return process

    def kill(self, process: "Process") -> None:
        """End a process without a word."""
        self.processes.remove(process)
        for end in process.ends:
            finish(end.network.close())

    def end(self, process: "Process") -> None:
        """End the links of a process; its bus stays."""
        for end in process.ends:
            end.detach()
            end.send()
            finish(end.network.close())
        self.processes.remove(process)

    def arrive(self, sender: object, receiver: object, call: Callable[[], object], delay: float = 0.0) -> None:
        """Call something after a while, and behind all that came on this way before."""
        when = max(self.now + delay, self._arrivals.get((sender, receiver), 0.0))
        self._arrivals[sender, receiver] = when
        heapq.heappush(self._events, (when, next(self._numbers), call))

    def run(self, seconds: float) -> None:
        """Let time pass."""
        end = self.now + seconds
        while True:
            running = [process for process in self.processes if not process.stopped]
            due = min((process.due for process in running), default=end + 1)
            due = min(due, self._events[0][0] if self._events else end + 1)
            if due > end:
                break
            self.now = max(self.now, due)
            while self._events and self._events[0][0] <= self.now:
                heapq.heappop(self._events)[2]()
            for process in running:
                if process.due <= self.now and process in self.processes:
                    process.work()
        self.now = end


class Network:
    """Links that may hear each other."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.wires: list[Wire] = []
        self.loss = 0.0
        self.delay: Callable[[Wire, Wire], float] = lambda *_: world.random.uniform(0.0001, 0.005)
        self.cuts: set[tuple[Wire, Wire]] = set()
        self.carried: list[tuple[Kind | None, int]] = []

    def cut(self, wire: "Wire", *, inwards: bool = True, outwards: bool = True) -> None:
        """Cut a link off from all others, or one way only."""
        for other in self.wires:
            if other is not wire and inwards:
                self.cuts.add((other, wire))
                wire.part(other)
            if other is not wire and outwards:
                self.cuts.add((wire, other))
                other.part(wire)

    def silence(self, wire: "Wire", lease: float = 4.0) -> None:
        """Cut a link off from all others, which notice that after a while, unless the network has healed by then."""
        cut = {pair for other in self.wires if other is not wire for pair in ((other, wire), (wire, other))}
        self.cuts |= cut

        def notice() -> None:
            for other, one in cut & self.cuts:
                one.part(other)

        self.world.arrive(wire, self, notice, lease)

    def heal(self) -> None:
        self.cuts.clear()
        self.loss = 0.0
        for wire in self.wires:
            self.meet(wire)

    def add(self, wire: "Wire") -> None:
        self.wires.append(wire)
        self.meet(wire)

    def meet(self, wire: "Wire") -> None:
        for other in self.wires:
            if other is not wire:
                wire.meet(other)
                other.meet(wire)

    def remove(self, wire: "Wire") -> None:
        if wire in self.wires:
            self.wires.remove(wire)
            for other in self.wires:
                other.part(wire)

    def sent(self, *kinds: Kind) -> int:
        """The number of messages of some kinds sent since this was called last, each receiver's counted."""
        found = sum(kind in kinds for kind, _ in self.carried)
        self.carried.clear()
        return found


class Wire:
    """See `tfbus.links.seams.Wire`; the end of the link that uses it calls it without an event loop."""

    rest = 2.0

    def __init__(self, network: Network, robot: str = "") -> None:
        self.network = network
        self.robot = robot
        self.id = f"{network.world.random.getrandbits(128):032x}"
        self.hears: Sequence[Hearing] = ()
        self.met: set[str] = set()

    async def open(self, hears: Sequence[Hearing], receive: Receive, warn: Callable[[Exception], object]) -> None:
        del warn
        self.hears, self._receive = hears, receive

    async def run(self) -> None:
        """Nothing takes time."""

    async def close(self) -> None:
        self.network.remove(self)

    def channel_of(self, other: "Wire") -> str | None:
        return next((channel for robots, channel in self.hears if fnmatchcase(other.robot, robots)), None)

    def meet(self, other: "Wire") -> None:
        if other.id not in self.met and (other, self) not in self.network.cuts and self.channel_of(other) is not None:
            self.met.add(other.id)
            self.bring(other.id, Joined(other.robot))

    def part(self, other: "Wire") -> None:
        if other.id in self.met:
            self.met.remove(other.id)
            self.bring(other.id, Left())

    def is_heard(self, channel: str) -> bool:
        return any(other.channel_of(self) == channel for other in self.network.wires if other is not self)

    def is_behind(self) -> bool:
        return False

    def publish(self, channel: str, message: bytes) -> None:
        for other in self.network.wires:
            if other is not self and other.channel_of(self) == channel and self.id in other.met:
                self._carry(other, message)

    def send(self, link: str, message: bytes) -> bool:
        other = next((wire for wire in self.network.wires if wire.id == link), None)
        return other is not None and self._carry(other, message)

    def _carry(self, other: "Wire", message: bytes) -> bool:
        world = self.network.world
        if (self, other) in self.network.cuts:
            return False
        self.network.carried.append((kind_of(message), len(message)))
        if world.random.random() >= self.network.loss:
            other.bring(self.id, message, self.network.delay(self, other))
        return True

    def bring(self, sender: str, item: WireItem, delay: float = 0.0) -> None:
        def take() -> None:
            if self in self.network.wires:
                self._receive(sender, item)

        self.network.world.arrive(sender, self, take, delay)


class Stranger(Wire):
    """A link of which the test writes the messages itself."""

    def __init__(self, network: Network, robot: str = "", channel: str = "all", bus: bytes = b"") -> None:
        super().__init__(network, robot)
        self.hears = [Hearing("*", channel)] if channel else []
        self.bus = bus or network.world.random.randbytes(16)
        self.items: list[WireItem] = []
        self._number = 0
        network.add(self)

    def _receive(self, sender: str, item: WireItem) -> None:
        del sender
        self.items.append(item)

    def heard(self, *kinds: Kind) -> list[bytes]:
        """The messages of some kinds that have come."""
        return [item for item in self.items if isinstance(item, bytes) and kind_of(item) in kinds]

    def say(
        self,
        *entries: OutgoingBatch | RemovedFrame,
        kind: Kind = Kind.LIVE,
        number: int | None = None,
        claim: Claim = NOTHING,
        reach: Sequence[tuple[bytes, tuple[bytes, ...]]] = (),
    ) -> None:
        """Publish a message with the next number, or another one, and let it arrive."""
        if kind is Kind.LIVE:
            self._number = self._number + 1 if number is None else number
        self.say_bytes(write_message(Outgoing(kind, self.bus, self._number, claim, None, reach), entries))

    def say_bytes(self, message: bytes) -> None:
        for other in self.network.wires:
            if other is not self:
                self._carry(other, message)
        self.network.world.run(0.01)

    def batch(self, *samples: TransformStamped, number: int = 1, origin: bytes = b"") -> OutgoingBatch:
        return OutgoingBatch(origin or self.bus, number, samples)

    def removal(self, frame: str, number: int = 1, origin: bytes = b"") -> RemovedFrame:
        return RemovedFrame(origin or self.bus, number, frame)


class Host:
    """The part of a link and of an event loop that an end needs."""

    def __init__(self, process: "Process", end: Endpoint) -> None:
        self._process = process
        self._end = end
        self._queue = ReceiveQueue(10_000)
        self._handles = False
        self.received = 0
        end.host = self

    def receive(self, item: Received) -> None:
        self.received += 1
        if self._process.stopped and len(self._queue) >= BACKLOG and isinstance(item.content, bytes):
            return
        self._queue.put(item)
        self.handle()

    def handle(self) -> None:
        """Handle all that has come."""
        if self._handles or self._process.stopped:
            return
        self._handles = True
        while (received := self._queue.get()) is not None:
            try:
                for part in self._end.split(received):
                    if part is not None:
                        self._end.handle(received.sender, part)
            except MalformedMessageError as error:
                self._end.handle(received.sender, error)
        self._handles = False
        self._process.flush()

    def send_soon(self, pending: int) -> None:
        del pending
        self._process.sending = True

    def is_behind(self) -> bool:
        return len(self._queue) > 0

    def stir(self) -> None:
        self._process.due = self._process.world.now


class Process:
    """A bus with a link to each of some networks and worlds."""

    def __init__(
        self,
        world: World,
        networks: tuple[Network, ...],
        drop_lost: bool,
        worlds: Sequence[ForeignWorld],
        options: dict[str, Any],
    ) -> None:
        self.world = world
        clock: SkewedClock | None = options.pop("clock", None)
        self.bus = Bus(clock or SimulatedClock(int(world.now * SECOND)), max_ahead=None)
        if clock is not None:
            # Machines count from when they were started.
            started = world.random.randint(-(10**15), 10**15)
            relay_of(self.bus).clock = OwnClock(clock, lambda: round(world.now * SECOND) + started)
        # The relay draws it elsewhere, and a run has to be given by its seed.
        relay_of(self.bus).replica.origin = world.random.randbytes(16)
        self.networks = networks
        self.name: str = options.pop("name", f"{next(world.names)}")
        self.drop_lost = drop_lost
        self.stopped = False
        self.sending = False
        self.due = world.now
        self.wires = [Wire(network, options.get("robot", "")) for network in networks]
        make: dict[str, Any] = {"drop_lost": drop_lost, "now": lambda: world.now, **options}
        self.domain_ends = [DomainEnd(self.bus, "tf", wire, **make) for wire in self.wires]
        carriers = [ForeignCarrier(place, f"bus {len(world.processes)}.{k}") for k, place in enumerate(worlds)]
        self.foreign_ends = [ForeignEnd(self.bus, "world", carrier, drop_lost=drop_lost) for carrier in carriers]
        self.ends: list[Endpoint] = [*self.domain_ends, *self.foreign_ends]
        self.frames: dict[str, TransformStamped] = {}
        self.seen: list[TransformStamped] = []
        # The samples that were heard more than once; a frame of a lost owner may be taken off the bus and put back.
        self.again: list[TransformStamped] = []
        self._ever: dict[str, set[int]] = {}
        self.batches: list[Batch] = []
        self.removed: list[str] = []
        self._hosts = [Host(self, end) for end in self.ends]
        self.bus.subscribe(self._note, self._note_removal)

    @property
    def received(self) -> int:
        """So many items of its networks and worlds had to wait for its event loop."""
        return sum(host.received for host in self._hosts)

    @property
    def end(self) -> DomainEnd:
        """Its first link."""
        return self.domain_ends[0]

    @property
    def wire(self) -> Wire:
        return self.wires[0]

    def start(self) -> None:
        for end in self.ends:
            finish(end.open())
            end.relay.attach(end)
        for wire in self.wires:
            wire.network.add(wire)
        self.work()

    def stop(self) -> None:
        self.stopped = True

    def go_on(self) -> None:
        self.stopped = False
        for host in self._hosts:
            host.handle()
        self.work()

    def publish(self, frame: str, static: bool) -> None:
        """Publish a sample with a stamp that nobody else uses."""
        stamp = int(self.world.now * SECOND) + len(self.world.published)
        self.world.published.add((frame, stamp))
        self.say(TransformStamped("map", frame, stamp, Transform(), self.wire.id[:4], static))

    def say(self, *samples: TransformStamped) -> None:
        """Publish a batch, and end the turn."""
        self.bus.publish(samples)
        self.flush()

    def remove(self, frame: str) -> None:
        with suppress(UnknownFrameError):
            self.bus.remove_frame(frame)
        self.flush()

    def work(self) -> None:
        self.due = max(min(end.work() for end in self.ends), self.world.now + 0.0001)
        self.flush()

    def flush(self) -> None:
        """End the turn: all links send what has gathered."""
        while self.sending:
            self.sending = False
            for end in self.ends:
                end.send()

    def _note(self, batch: Batch) -> None:
        self.batches.append(batch)
        for sample in batch:
            known = self.frames.get(sample.child)
            self.seen.append(sample)
            ever = self._ever.setdefault(sample.child, set())
            if sample.stamp in ever:
                self.again.append(sample)
            ever.add(sample.stamp)
            if known is None or sample.static != known.static or sample.stamp >= known.stamp or sample.static:
                self.frames[sample.child] = sample

    def _note_removal(self, frame: str) -> None:
        self.removed.append(frame)
        self.frames.pop(frame, None)
        if self.drop_lost:
            self._ever.pop(frame, None)


class SlowWorld(ForeignWorld):
    """A foreign world whose messages take a while."""

    def __init__(self, world: World) -> None:
        super().__init__()
        self._world = world

    def deliver(self, sender: str, node: str, message: ForeignMessage) -> None:
        deliver = super().deliver
        delay = self._world.random.uniform(0.0001, 0.005)
        self._world.arrive(self, node, lambda: deliver(sender, node, message), delay)


def shown(process: Process) -> dict[str, int]:
    """The frames on a bus, with the stamps of their newest samples."""
    return {frame: sample.stamp for frame, sample in process.frames.items()}


def agree(processes: Iterable[Process]) -> bool:
    first, *others = map(shown, processes)
    return all(other == first for other in others)

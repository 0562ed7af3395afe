"""Random schedules of everything that events tell of, against a slow and obvious model that predicts each of them.

A schedule is a list of bursts. First some readers stop reading or begin again; then what is in the burst happens
without a task switch; then the readers read, and some simulated time passes while they wait.
"""

import math
from collections import Counter
from collections.abc import Awaitable, Callable
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import anyio
import pytest
from anyio.abc import TaskGroup
from hypothesis import HealthCheck, event, example, given, settings
from hypothesis import strategies as st

from tfbus import (
    SECOND,
    AuthorityConflict,
    Bus,
    ClockReset,
    Event,
    EventStream,
    FrameAdded,
    FrameLive,
    FrameRemoved,
    FrameStale,
    InvalidTransformError,
    KindChanged,
    Registration,
    Reparented,
    SampleRejected,
    SimulatedClock,
    SubscriberFailed,
    Transform,
    TransformStamped,
    UnknownFrameError,
)
from tfbus.bus.ownership import OnConflict

Run = Callable[[Callable[[], Awaitable[None]]], None]

START = 10
FRAMES = "abo"
EDGES = [("a", "b"), ("b", "a"), ("r", "a"), ("r", "b"), ("r", "o"), ("s", "o")]
OWNED = "o"
"""The one frame that is reserved: it is in no loop, so no edge has to make room."""
AUTHORITIES = ("", "odometry", "slam")
CRASHES = Transform((9.0, 0.0, 0.0))


# The happenings; ages and durations in s


class Draft(NamedTuple):
    """A sample that is stamped when it is sent."""

    ends: tuple[str, str]
    age: int
    authority: str
    static: bool
    crashes: bool

    def stamped(self, now: int) -> TransformStamped:
        parent, child = self.ends
        transform = CRASHES if self.crashes else Transform()
        return TransformStamped(parent, child, now - self.age * SECOND, transform, self.authority, self.static)


Happening = tuple[Any, ...]
"""The name of a method of `Game`, and its arguments."""


class Burst(NamedTuple):
    """`toggled` are the places of the readers that stop reading or begin again."""

    toggled: tuple[int, ...]
    happenings: list[Happening]
    then: float


# The model


@dataclass(frozen=True)
class Edge:
    """`authority` has sent the last sample, `publisher` the newest one."""

    parent: str
    static: bool
    newest: int
    authority: str
    publisher: str


@dataclass
class Reader:
    """The events that a stream holds, and the events that its reader has read."""

    capacity: int
    limit: float
    pending: list[Event]
    initial: int
    dropped: int = 0
    quarrels: dict[str, set[object]] = field(default_factory=dict)
    refused: set[tuple[str | None, str | None, str]] = field(default_factory=set)
    stale: set[str] = field(default_factory=set)
    heard: list[str] = field(default_factory=list)
    read: list[Event] = field(default_factory=list)

    def put(self, happened: Event) -> None:
        claim: object = None
        frame = getattr(happened, "frame", None)
        if isinstance(happened, AuthorityConflict):
            claim = frozenset((happened.authority, happened.other))
            self.quarrels.setdefault(happened.frame, set())
        elif isinstance(happened, Reparented):
            claim = (Reparented, happened.authority, happened.parent)
        elif isinstance(happened, KindChanged):
            claim = (KindChanged, happened.authority, happened.static)
        elif isinstance(happened, SampleRejected):
            refusal = (happened.frame, happened.authority, happened.reason)
            if refusal in self.refused:
                return
            self.refused.add(refusal)
        elif isinstance(happened, (FrameAdded, FrameRemoved)):
            self.quarrels.pop(happened.frame, None)
            self.refused = {refusal for refusal in self.refused if refusal[0] != happened.frame}
            self.stale.discard(happened.frame)
        elif isinstance(happened, ClockReset):
            self.quarrels.clear()
            self.refused.clear()
            self.stale.clear()
        if claim is not None and frame in self.quarrels:
            told = self.quarrels[frame]
            if claim in told:
                return
            told.add(claim)
        if len(self.pending) - self.initial == self.capacity:
            counting = self.pending[self.initial :]
            moves = [other for other in counting if isinstance(other, (Reparented, KindChanged))]
            own = [move for move in moves if isinstance(happened, (Reparented, KindChanged)) and move.frame == frame]
            first = next((place for place, other in enumerate(counting) if own and other is own[0]), 0)
            del self.pending[self.initial + first]
            self.dropped += 1
        self.pending.append(happened)

    def look(self, edges: dict[str, Edge], now: int) -> None:
        """Read what is pending, then all that is stale and live again, however much that is."""
        self.flush()
        heard, self.heard = list(dict.fromkeys(self.heard)), []
        for frame in heard:
            edge = edges.get(frame)
            if frame in self.stale and edge is not None and (edge.static or edge.newest + self.limit >= now):
                self.stale.remove(frame)
                self.read.append(FrameLive(now, frame, None if edge.static else edge.newest, edge.publisher))
        for frame, edge in sorted(edges.items(), key=lambda known: (known[1].newest, known[0])):
            if not edge.static and frame not in self.stale and edge.newest + self.limit < now:
                self.stale.add(frame)
                self.read.append(FrameStale(now, frame, edge.newest, edge.publisher))

    def flush(self) -> None:
        self.read += self.pending
        self.pending = []
        self.initial = 0


def after(edges: dict[str, Edge], batch: list[TransformStamped]) -> dict[str, Edge]:
    """The state that is known when a batch has been noted."""
    edges = dict(edges)
    for sample in batch:
        before = edges.get(sample.child)
        edge = Edge(sample.parent, sample.static, sample.stamp, sample.authority, sample.authority)
        if before is None or before.static or sample.static or sample.stamp >= before.newest:
            edges[sample.child] = edge
        else:
            edges[sample.child] = replace(before, authority=sample.authority)
    return edges


def loop_through(edges: dict[str, Edge], frame: str) -> frozenset[str]:
    """The frames of the loop that runs through a frame; empty if none does."""
    walk = [frame]
    while walk[-1] in edges and len(walk) <= len(FRAMES):
        walk.append(edges[walk[-1]].parent)
        if walk[-1] == frame:
            return frozenset(walk)
    return frozenset()


def loops_of(edges: dict[str, Edge], batch: list[TransformStamped]) -> set[frozenset[str]]:
    """The loops that there are when a batch has been noted."""
    new = after(edges, batch)
    return {loop for sample in batch if (loop := loop_through(new, sample.child))}


@dataclass
class Model:
    """The bus."""

    first_keeps: bool
    edges: dict[str, Edge] = field(default_factory=dict)
    kept: dict[str, str] = field(default_factory=dict)
    reserved: list[str] = field(default_factory=list)
    readers: list[Reader] = field(default_factory=list)
    counted: Counter[str] = field(default_factory=Counter)

    def tell(self, happened: Event) -> None:
        for reader in self.readers:
            reader.put(happened)

    def owner(self, frame: str) -> str | None:
        return self.reserved[0] if frame == OWNED and self.reserved else None

    def publish(self, batch: list[TransformStamped], drop: bool, now: int) -> bool:
        """Whether it is an error."""
        rejected: list[tuple[TransformStamped, str]] = []
        allowed: list[TransformStamped] = []
        first = self.kept | {child: edge.authority for child, edge in self.edges.items()}
        for sample in batch:
            owner = self.owner(sample.child)
            if owner is not None and owner != sample.authority:
                rejected.append((sample, "reserved"))
            elif owner is None and self.first_keeps and first.get(sample.child, sample.authority) != sample.authority:
                rejected.append((sample, "authority"))
            else:
                allowed.append(sample)
                if owner is None:
                    first.setdefault(sample.child, sample.authority)
        allowed, looped = self.admit(allowed)
        rejected += [(sample, "cycle") for sample in looped]
        for sample, reason in rejected:
            self.refuse(sample, reason, now)
        if rejected and not drop:
            return True
        for sample in allowed:
            self.note(sample, now)
        for reader in self.readers:
            reader.heard += [sample.child for sample in allowed if sample.child in reader.stale]
        if any(sample.transform == CRASHES for sample in allowed):
            self.counted["crashes"] += 1
            self.tell(SubscriberFailed(now, "fail", Crash()))
        return False

    def refuse(self, sample: TransformStamped, reason: str, now: int) -> None:
        self.counted[reason] += 1
        error = InvalidTransformError("", reason=reason)
        self.tell(SampleRejected(now, reason, sample.child, sample.parent, sample.authority, error))

    def admit(self, batch: list[TransformStamped]) -> tuple[list[TransformStamped], list[TransformStamped]]:
        """The samples of a batch that close no loop, and the last ones that do."""
        edges = self.edges
        allowed, looped = list(batch), []
        while loops := loops_of(edges, allowed):
            new = after(edges, allowed)
            for sample in reversed(list(allowed)):
                loop = next((loop for loop in loops if sample.child in loop), None)
                before = edges.get(sample.child)
                decides = new[sample.child].parent == sample.parent and (
                    before is None or before.parent != sample.parent
                )
                if loop is not None and decides:
                    loops.remove(loop)
                    allowed = [other for other in allowed if other is not sample]
                    looped.append(sample)
        return allowed, looped

    def remove(self, frame: str, now: int) -> None:
        self.kept.pop(frame, None)
        if self.edges.pop(frame, None):
            self.tell(FrameRemoved(now, frame))

    def note(self, sample: TransformStamped, now: int) -> None:
        child, authority = sample.child, sample.authority
        before = self.edges.get(child)
        self.edges = after(self.edges, [sample])
        new = self.edges[child]
        if before is None:
            self.tell(FrameAdded(now, child, sample.parent, authority, sample.static))
            return
        if before.authority != authority and self.owner(child) is None:
            self.counted["conflicts"] += 1
            self.tell(AuthorityConflict(now, child, authority, before.authority))
        if before.static != new.static:
            self.counted["kinds"] += 1
            self.tell(KindChanged(now, child, new.static, authority))
        if before.parent != new.parent:
            self.counted["parents"] += 1
            self.tell(Reparented(now, child, new.parent, before.parent, authority))


class Crash(Exception):
    """The error that the subscriber raises; one is like the other."""

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Crash)

    def __hash__(self) -> int:
        return 0


class Game:
    """The bus and its model, side by side."""

    def __init__(self, on_conflict: OnConflict, tasks: TaskGroup) -> None:
        self.tasks = tasks
        self.clock = SimulatedClock(START * SECOND)
        self.bus = Bus(self.clock, on_conflict)
        self.bus.subscribe(fail)
        self.model = Model(on_conflict == "reject")
        self.streams: list[EventStream] = []
        self.read: list[list[Event]] = []
        self.reading: list[anyio.CancelScope | None] = []
        self.registrations: list[Registration] = []

    def publish(self, drafts: list[Draft], drop: bool) -> None:
        now = self.clock.now()
        batch = [draft.stamped(now) for draft in drafts]
        refused = self.model.publish(batch, drop, now)
        with pytest.raises(InvalidTransformError) if refused else nullcontext():
            self.bus.publish(batch, invalid="drop" if drop else "raise")

    def remove(self, frame: str) -> None:
        with suppress(UnknownFrameError):
            self.bus.remove_frame(frame)
        self.model.remove(frame, self.clock.now())

    def reserve(self, authority: str) -> None:
        if self.model.owner(OWNED) in (None, authority):
            self.registrations.append(self.bus.reserve(OWNED, authority=authority))
            self.model.reserved.append(authority)
        else:
            with pytest.raises(InvalidTransformError):
                self.bus.reserve(OWNED, authority=authority)

    def release(self, place: int) -> None:
        if self.registrations:
            self.registrations.pop(place % len(self.registrations)).close()
            self.model.reserved.pop(place % len(self.model.reserved))

    def toggle(self, place: int) -> None:
        scope = self.reading[place]
        if scope is None:
            self.start(place)
        else:
            scope.cancel()
            self.reading[place] = None

    def jump(self, seconds: int) -> None:
        before, by = self.clock.now(), seconds * SECOND
        self.clock.set(before + by)
        if by < 0:
            self.model.counted["resets"] += 1
            self.model.kept |= {child: edge.authority for child, edge in self.model.edges.items() if not edge.static}
            self.model.edges = {child: edge for child, edge in self.model.edges.items() if edge.static}
            self.model.tell(ClockReset(before + by, before))

    def join(self, capacity: int, stale_after: int | None) -> None:
        now = self.clock.now()
        known: list[Event] = [
            FrameAdded(now, child, edge.parent, edge.publisher, edge.static) for child, edge in self.model.edges.items()
        ]
        limit = math.inf if stale_after is None else stale_after * SECOND
        self.model.readers.append(Reader(capacity, limit, known, len(known)))
        self.streams.append(self.bus.events(capacity, stale_after))
        self.read.append([])
        self.reading.append(None)
        self.start(len(self.streams) - 1)

    def start(self, place: int) -> None:
        self.reading[place] = scope = anyio.CancelScope()

        async def read() -> None:
            with scope:
                async for happened in self.streams[place]:
                    self.read[place].append(happened)

        self.tasks.start_soon(read)

    async def play(self, bursts: list[Burst]) -> None:
        for burst in bursts:
            for place in burst.toggled:
                self.toggle(place % len(self.streams))
            await self.pass_time(0)
            for happening in burst.happenings:
                getattr(self, happening[0])(*happening[1:])
            await self.pass_time(0)
            await self.pass_time(round(burst.then * SECOND))
        for place, scope in enumerate(self.reading):
            if scope is None:
                self.start(place)
        self.bus.close()
        await self.clock.advance(0)
        for reader in self.model.readers:
            reader.flush()
            for kind in {type(happened).__name__ for happened in reader.read}:
                event(kind)
            if reader.dropped:
                event("dropped")
        self.check()

    async def pass_time(self, nanoseconds: int) -> None:
        """Let it pass, the model going from one instant at which a frame turns stale to the next."""
        end = self.clock.now() + nanoseconds
        await self.clock.advance(nanoseconds / SECOND)
        instants = {end - nanoseconds, end}
        for reader in self.model.readers:
            if reader.limit < math.inf:
                instants |= {edge.newest + int(reader.limit) + 1 for edge in self.model.edges.values()}
        for now in sorted(instant for instant in instants if end - nanoseconds <= instant <= end):
            for place, reader in enumerate(self.model.readers):
                if self.reading[place] is not None:
                    reader.look(self.model.edges, now)
        self.check()

    def check(self) -> None:
        for reader, read, stream in zip(self.model.readers, self.read, self.streams, strict=True):
            assert read == reader.read
            assert stream.dropped == reader.dropped
            assert len(stream.queue) == len(reader.pending)
        statistics, counted = self.bus.statistics(), self.model.counted
        assert dict(statistics.rejected) == {
            reason: counted[reason] for reason in ("reserved", "authority", "cycle") if counted[reason]
        }
        assert statistics.authority_conflicts == counted["conflicts"]
        assert statistics.kind_changes == counted["kinds"]
        assert statistics.reparented == counted["parents"]
        assert statistics.clock_resets == counted["resets"]
        assert statistics.callbacks_failed == counted["crashes"]
        assert statistics.frames == len(self.model.edges)


def fail(batch: tuple[TransformStamped, ...]) -> None:
    if any(sample.transform == CRASHES for sample in batch):
        raise Crash


# The schedules

DRAFTS = st.builds(
    Draft,
    st.sampled_from(EDGES),
    st.sampled_from([0, 0, 0, 1, 2, 3, -1]),
    st.sampled_from(AUTHORITIES),
    st.sampled_from([False, False, True]),
    st.sampled_from([False, False, False, True]),
)
PUBLISHES = st.tuples(st.just("publish"), st.lists(DRAFTS, min_size=1, max_size=3), st.booleans())
HAPPENINGS: st.SearchStrategy[Happening] = st.one_of(
    *[PUBLISHES] * 6,
    st.tuples(st.just("remove"), st.sampled_from(FRAMES)),
    st.tuples(st.just("reserve"), st.sampled_from(AUTHORITIES)),
    st.tuples(st.just("release"), st.integers(0, 3)),
    st.tuples(st.just("jump"), st.integers(-4, 4)) | PUBLISHES,
    st.tuples(st.just("join"), st.integers(1, 5), st.sampled_from([None, 0, 1, 2])) | PUBLISHES,
)
BURSTS = st.builds(
    Burst,
    st.sampled_from([(), (), (), (0,), (1,), (2,)]),
    st.lists(HAPPENINGS, min_size=2, max_size=6),
    st.sampled_from([0.0, 0.5, 1.5, 4.0]),
)


STRANGERS = Draft(("a", "b"), 0, "odometry", False, False)
# Two authorities quarrel over a parent and a kind; each claim is told once, until the frame is removed.
CLAIMS: list[Happening] = [
    ("publish", [Draft((parent, "b"), 0, authority, static, False)], True)
    for parent, authority, static in (("r", "slam", False), ("a", "odometry", False), ("r", "slam", True))
]
# A frame that is heard again in time does not turn stale, and then does.
HEARD = [*[Burst((), [("publish", [STRANGERS], True)], 0.5)] * 3, Burst((), [], 4.0)]
# A frame that has become static, then one that has always been: after a jump back, a new reader hears of both in order.
FIXED: list[Happening] = [
    ("publish", [Draft(edge, 0, "odometry", static, False)], True)
    for edge, static in ((("a", "b"), False), (("r", "a"), True), (("a", "b"), True))
]
REJOINED = [Burst((), [*FIXED, ("jump", -1), ("join", 5, None)], 0.5)] * 2
QUARREL = [Burst((), CLAIMS * 3, 0.5), Burst((), [("remove", "b"), *CLAIMS, ("jump", -1), *CLAIMS * 2], 4.0)]


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@example(on_conflict="last", bursts=QUARREL)
@example(on_conflict="last", bursts=HEARD)
@example(on_conflict="last", bursts=REJOINED)
@example(on_conflict="reject", bursts=QUARREL)
@given(on_conflict=st.sampled_from(["last", "reject"]), bursts=st.lists(BURSTS, min_size=2, max_size=10))
def test_every_reader_reads_exactly_what_the_model_says(run: Run, on_conflict: OnConflict, bursts: list[Burst]) -> None:
    async def play() -> None:
        async with anyio.create_task_group() as tasks:
            game = Game(on_conflict, tasks)
            game.join(1_000, 1)
            await game.play(bursts)

    run(play)

"""A slow and obvious model of a bus and its buffers: poses, trees of samples, and a bus.

Poses turn about one tilted axis only, so that complex numbers are enough to work them out.
"""

import cmath
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from tfbus import (
    LATEST,
    AheadError,
    DisconnectedError,
    ExtrapolationError,
    FutureExtrapolationError,
    Latest,
    Outcome,
    PastExtrapolationError,
    Transform,
    TransformLookupError,
    UnknownFrameError,
)

AXIS = (1 / 3, 2 / 3, 2 / 3)
ACROSS = (2 / 3, 1 / 3, -2 / 3)
"""At right angles to the axis; so is the next one, which is the axis times this one."""
ACROSS_TOO = (-2 / 3, 2 / 3, -1 / 3)


@dataclass(frozen=True)
class Pose:
    """A turn by `angle` rad about the axis, then a shift in m: `across` in the plane of the turn, `along` the axis."""

    angle: float
    across: complex
    along: float

    def __matmul__(self, other: "Pose") -> "Pose":
        turned = cmath.rect(1.0, self.angle) * other.across
        return Pose(self.angle + other.angle, self.across + turned, self.along + other.along)

    def inverse(self) -> "Pose":
        return Pose(-self.angle, -cmath.rect(1.0, -self.angle) * self.across, -self.along)

    def towards(self, other: "Pose", fraction: float) -> "Pose":
        """A straight line and an even turn. The two are less than half a turn apart, so this is the shorter arc."""
        return Pose(
            self.angle + fraction * (other.angle - self.angle),
            self.across + fraction * (other.across - self.across),
            self.along + fraction * (other.along - self.along),
        )

    def transform(self) -> Transform:
        parts = zip(ACROSS, ACROSS_TOO, AXIS, strict=True)
        x, y, z = (self.across.real * u + self.across.imag * v + self.along * w for u, v, w in parts)
        sine = math.sin(self.angle / 2)
        qx, qy, qz = (sine * part for part in AXIS)
        return Transform((x, y, z), (qx, qy, qz, math.cos(self.angle / 2)))

    def is_close(self, found: Transform) -> bool:
        """Whether a transform is this pose; the sign of the quaternion does not matter."""
        expected = self.transform()
        apart = math.dist(found.translation, expected.translation)
        cosine = sum(mine * its for mine, its in zip(expected.rotation, found.rotation, strict=True))
        return apart < 1e-9 and abs(cosine) > 1 - 1e-12


def pose(number: int) -> Pose:
    """One of many different poses, all less than half a turn apart."""
    return Pose((number * 7 % 29 - 14) / 10, complex(number % 11 - 5, number % 7 - 3), float(number % 13))


# A model of a tree: answers worked out from plain lists of samples; nothing is kept from one question to the next

At = int | Latest
Facts = tuple[object, ...]
Way = list[tuple[str, str, bool]]
"""The edges from source to target, each a child and its parent; True for those that are climbed."""
Steps = dict[str, list[tuple[str, tuple[str, str, bool]]]]
"""The frames that one edge leads to, each with that edge."""
Within = tuple[int, int] | None
"""The oldest and the newest stamp that count as the latest, in ns."""


@dataclass(frozen=True)
class Sample:
    parent: str
    child: str
    stamp: int
    pose: Pose
    static: bool = False


@dataclass(frozen=True)
class Answer:
    stamp: int
    static: bool
    pose: Pose


class Blocked(Exception):
    """There is no answer; any of these facts explains why."""

    def __init__(self, *acceptable: Facts) -> None:
        super().__init__(acceptable)
        self.acceptable = set(acceptable)

    @property
    def for_good(self) -> bool:
        """Whether waiting cannot help."""
        return any(facts[0] in (PastExtrapolationError, AheadError) for facts in self.acceptable)


def facts_of(error: TransformLookupError) -> Facts:
    if isinstance(error, UnknownFrameError):
        return type(error), error.frame
    if isinstance(error, ExtrapolationError):
        return type(error), error.child, error.oldest, error.newest
    return (type(error),)


@dataclass
class Child:
    """The moving samples of a frame in the order of their stamps, or its static one. The parent outlives them."""

    parent: str
    static: bool
    samples: list[Sample]

    @property
    def stamps(self) -> list[int]:
        return [] if self.static else [sample.stamp for sample in self.samples]

    def covers(self, at: int) -> bool:
        return self.static or (bool(self.samples) and self.samples[0].stamp <= at <= self.samples[-1].stamp)

    def parent_at(self, at: At) -> str:
        """The parent of the sample before, or of the oldest one."""
        if isinstance(at, Latest) or self.static or not self.samples:
            return self.parent
        before = [sample for sample in self.samples if sample.stamp <= at]
        return (before[-1] if before else self.samples[0]).parent

    def pose_at(self, at: int) -> Pose:
        if self.static:
            return self.samples[0].pose
        before = [sample for sample in self.samples if sample.stamp <= at][-1]
        after = next(sample for sample in self.samples if sample.stamp >= at)
        if before.parent != after.parent or before.stamp == at:
            return before.pose
        return before.pose.towards(after.pose, (at - before.stamp) / (after.stamp - before.stamp))

    def facts(self, name: str, at: At) -> Facts:
        """Those of the error that says that `at` is not covered."""
        stamps = self.stamps
        if not stamps:
            return FutureExtrapolationError, name, None, None
        kind = PastExtrapolationError if isinstance(at, int) and at < stamps[0] else FutureExtrapolationError
        return kind, name, stamps[0], stamps[-1]


@dataclass
class PlainTree:
    """`keep` in ns, or None."""

    keep: int | None
    children: dict[str, Child] = field(default_factory=dict)

    # What is stored

    def store(self, sample: Sample) -> Outcome:
        known = self.children.get(sample.child)
        if sample.static:
            self.children[sample.child] = Child(sample.parent, True, [sample])
            self.forget_what_it_contradicts(sample.child)
            return Outcome.REPLACED if known is not None and known.static else Outcome.INSERTED
        old = [] if known is None or known.static else known.samples
        newest = max((other.stamp for other in old), default=sample.stamp)
        if self.keep is not None and sample.stamp < newest - self.keep:
            return Outcome.EXPIRED
        samples = sorted(
            [*(other for other in old if other.stamp != sample.stamp), sample], key=lambda other: other.stamp
        )
        if self.keep is not None:
            samples = [other for other in samples if other.stamp >= samples[-1].stamp - self.keep]
        self.children[sample.child] = Child(samples[-1].parent, False, samples)
        self.forget_what_it_contradicts(sample.child)
        return Outcome.REPLACED if any(other.stamp == sample.stamp for other in old) else Outcome.INSERTED

    def forget_what_it_contradicts(self, name: str) -> None:
        """Frames without samples that would now stand in a loop are forgotten."""
        parents = {child: known.parent for child, known in self.children.items()}
        walk = climb(parents, name)
        if parents.get(walk[-1]) == name:
            for other in walk:
                if not self.children[other].samples:
                    del self.children[other]

    def remove(self, frame: str) -> None:
        self.children.pop(frame, None)

    def reset(self) -> None:
        for child in self.children.values():
            if not child.static:
                child.samples = []

    def within(self, keep: int | None) -> "PlainTree":
        """A copy of what lies in windows of this length; they have it from now on."""
        children = {}
        for name, child in self.children.items():
            samples = child.samples
            if keep is not None and not child.static:
                samples = [sample for sample in samples if sample.stamp >= samples[-1].stamp - keep]
            children[name] = Child(child.parent, child.static, list(samples))
        return PlainTree(keep, children)

    # What is asked

    def names(self) -> set[str]:
        named = set(self.children)
        for child in self.children.values():
            named |= {child.parent, *(sample.parent for sample in child.samples)}
        return named

    def lookup(self, target: str, source: str, at: At, within: Within = None) -> Answer:
        self.check_known(target, source)
        if isinstance(at, Latest):
            return self.at_latest(target, source, within)
        way = self.way(target, source, at)
        return Answer(at, all(self.children[name].static for name, _, _ in way), self.along(way, at))

    def at_latest(self, target: str, source: str, within: Within) -> Answer:
        """Source in target at the newest stamp that all moving edges of the newest way have reached."""
        way = self.way(target, source, LATEST)
        edges = {name: self.children[name] for name, _, _ in way}
        moving = {name: edge for name, edge in edges.items() if not edge.static}
        if not moving:
            if target == source and target in self.children:
                edges = {target: self.children[target]}
            stamps = [sample.stamp for edge in edges.values() for sample in edge.samples]
            return Answer(max(stamps, default=0), True, self.along(way, 0))
        empty = [edge.facts(name, LATEST) for name, edge in moving.items() if not edge.samples]
        if empty:
            raise Blocked(*empty)
        common = min(edge.stamps[-1] for edge in moving.values())
        lagging = [edge.facts(name, common + 1) for name, edge in moving.items() if edge.stamps[-1] == common]
        if within is not None and common < within[0]:
            raise Blocked(*lagging)
        if within is not None and common > within[1]:
            raise Blocked(*((AheadError, *facts[1:]) for facts in lagging))
        try:
            return Answer(common, False, self.along(self.way(target, source, common), common))
        except Blocked as error:
            raise Blocked(*lagging) from error

    def travel(self, target: str, source: str, at: At, source_at: At, fixed: str, within: Within = None) -> Answer:
        """Source at its own stamp, carried through the fixed frame."""
        self.check_known(target, source, fixed)
        legs: list[Answer] = []
        problems: list[Blocked] = []
        for question in ((target, fixed, at), (fixed, source, source_at)):
            try:
                legs.append(self.lookup(*question, within))
            except Blocked as problem:
                problems.append(problem)
        if problems:
            for_good = [problem for problem in problems if problem.for_good]
            raise Blocked(*(facts for problem in for_good or problems for facts in problem.acceptable))
        first, second = legs
        # Of a leg that is static, no stamp is the latest.
        by_source = at is LATEST and first.static and not second.static
        return Answer((second if by_source else first).stamp, first.static and second.static, first.pose @ second.pose)

    def check_known(self, *names: str) -> None:
        known = self.names()
        for name in names:
            if name not in known:
                raise Blocked((UnknownFrameError, name))

    # Ways

    def way(self, target: str, source: str, at: At) -> Way:
        """The way that counts: if there are two round a loop, the newest one if it holds, else the one with samples."""
        found = self.ways(target, source, at)
        if not found:
            raise Blocked((DisconnectedError,))
        if isinstance(at, Latest):
            return found[0]
        covered = [way for way in found if all(self.children[name].covers(at) for name, _, _ in way)]
        newest = self.ways(target, source, LATEST)
        for way in covered:
            if way in newest:
                return way
        if len(covered) > 1:
            raise Blocked((DisconnectedError,))
        if covered:
            return covered[0]
        errors = [facts for way in found for facts in self.deciding_facts(way, at)]
        raise Blocked(*([facts for facts in errors if facts[0] is FutureExtrapolationError] or errors))

    def deciding_facts(self, way: Way, at: int) -> list[Facts]:
        """The facts of an edge that has lost the stamp; else of one that has come least far."""
        errors = [self.children[name].facts(name, at) for name, _, _ in way if not self.children[name].covers(at)]
        past = [facts for facts in errors if facts[0] is PastExtrapolationError]
        reached = [facts[3] if isinstance(facts[3], int) else float("-inf") for facts in errors]
        return past or [facts for facts, reach in zip(errors, reached, strict=True) if reach == min(reached)]

    def ways(self, target: str, source: str, at: At) -> list[Way]:
        """Every way from source to target along the edges that hold at `at`."""
        steps: Steps = {}
        for name, child in self.children.items():
            parent = child.parent_at(at)
            steps.setdefault(name, []).append((parent, (name, parent, True)))
            steps.setdefault(parent, []).append((name, (name, parent, False)))
        return list(ways(steps, target, source, frozenset()))

    def along(self, way: Way, at: int) -> Pose:
        pose = Pose(0.0, 0j, 0.0)
        for name, _, up in way:
            edge = self.children[name].pose_at(at)
            pose = (edge if up else edge.inverse()) @ pose
        return pose


def ways(steps: Steps, target: str, here: str, seen: frozenset[str]) -> Iterator[Way]:
    """Every way that passes no frame twice."""
    if here == target:
        yield []
        return
    for there, step in steps.get(here, ()):
        if there not in seen:
            for rest in ways(steps, target, there, seen | {here}):
                yield [step, *rest]


def climb(parents: dict[str, str], name: str) -> list[str]:
    """A frame and all above it, until the root or until one comes again."""
    walk = [name]
    while name in parents and parents[name] not in walk:
        name = parents[name]
        walk.append(name)
    return walk


# A model of a bus: what it gives each buffer


@dataclass(frozen=True)
class Newest:
    """The newest edge of a child: `stamp` is None if it is static."""

    parent: str
    stamp: int | None


def note(edges: dict[str, Newest], sample: Sample) -> None:
    """Of two kinds the last one wins, of moving samples the newest."""
    before = edges.get(sample.child)
    if sample.static:
        edges[sample.child] = Newest(sample.parent, None)
    elif before is None or before.stamp is None or sample.stamp >= before.stamp:
        edges[sample.child] = Newest(sample.parent, sample.stamp)


def has_loop(edges: dict[str, Newest]) -> bool:
    parents = {child: edge.parent for child, edge in edges.items()}
    return any(name in climb(parents, parents[name]) for name in parents)


@dataclass
class Held:
    """One buffer. `unseen` has the newest moving edges of the bus that it has not seen, because it joined later."""

    tree: PlainTree
    unseen: dict[str, Newest]
    counted: Counter[str] = field(default_factory=Counter)
    on_the_bus: bool = True

    def offer(self, sample: Sample) -> None:
        """Store a sample, unless it is late and would wrongly be taken for the newest."""
        unseen = self.unseen.get(sample.child)
        late = unseen is not None and unseen.stamp is not None and not sample.static and sample.stamp < unseen.stamp
        if unseen is not None and late and sample.parent != unseen.parent:
            self.counted.update(("superseded", "expired"))
            return
        if not late:
            self.unseen.pop(sample.child, None)
        self.counted[self.tree.store(sample).value] += 1

    def remove(self, frame: str) -> None:
        self.tree.remove(frame)
        self.unseen.pop(frame, None)

    def reset(self) -> None:
        self.tree.reset()
        self.unseen.clear()


class PlainBus:
    """The newest edge of each child, the latched samples, and every buffer that has ever joined."""

    def __init__(self) -> None:
        self.edges: dict[str, Newest] = {}
        self.latched: dict[str, Sample] = {}
        self.buffers: list[Held] = []

    @property
    def on_the_bus(self) -> list[int]:
        """The numbers of the buffers that have joined and not left."""
        return [number for number, held in enumerate(self.buffers) if held.on_the_bus]

    def refuses(self, batch: Sequence[Sample]) -> bool:
        """Whether the newest edges would form a loop after the batch."""
        edges = dict(self.edges)
        for sample in batch:
            note(edges, sample)
        return has_loop(edges)

    def knows(self, frame: str) -> bool:
        """Whether the bus or a buffer on it knows a frame."""
        return any(frame in (child, edge.parent) for child, edge in self.edges.items()) or any(
            frame in self.buffers[number].tree.names() for number in self.on_the_bus
        )

    def publish(self, batch: Sequence[Sample]) -> None:
        for sample in batch:
            note(self.edges, sample)
            self.latched.pop(sample.child, None)
            if sample.static:
                self.latched[sample.child] = sample
            for number in self.on_the_bus:
                self.buffers[number].offer(sample)

    def remove(self, frame: str) -> None:
        self.edges.pop(frame, None)
        self.latched.pop(frame, None)
        for number in self.on_the_bus:
            self.buffers[number].remove(frame)

    def reset(self) -> None:
        """Note that the clock has jumped back."""
        self.edges = {child: edge for child, edge in self.edges.items() if edge.stamp is None}
        for number in self.on_the_bus:
            self.buffers[number].reset()

    def join(self, keep: int | None, prefill: int | None) -> None:
        """A buffer with a window of `keep` ns joins: it has the history of another one, then the latched samples."""
        if prefill is None:
            moving = {child: edge for child, edge in self.edges.items() if edge.stamp is not None}
            late = Held(PlainTree(keep), moving)
        else:
            other = self.buffers[prefill]
            late = Held(other.tree.within(keep), dict(other.unseen))
        for sample in self.latched.values():
            late.offer(sample)
        self.buffers.append(late)

"""A slow and obvious model of a tree: answers worked out from plain lists of samples, nothing kept between questions.

Its poses turn about one tilted axis only, so that complex numbers work them out.
"""

import cmath
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import TypeVar

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
    TransformStamped,
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
    authority: str = ""

    def stamped(self) -> TransformStamped:
        transform = self.pose.transform()
        return TransformStamped(self.parent, self.child, self.stamp, transform, self.authority, self.static)


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
        return type(error), error.child, error.stamp, error.oldest, error.newest, error.authority
    return (type(error),)


@dataclass
class Child:
    """The moving samples of a frame by their stamps, or its static one; parent and authority outlive them."""

    parent: str
    authority: str
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
        """The facts of the error that says that `at` is not covered."""
        stamps = self.stamps
        if not stamps:
            return FutureExtrapolationError, name, at, None, None, self.authority
        kind = PastExtrapolationError if isinstance(at, int) and at < stamps[0] else FutureExtrapolationError
        return kind, name, at, stamps[0], stamps[-1], self.authority


@dataclass
class PlainTree:
    """`keep` in ns, or None."""

    keep: int | None
    children: dict[str, Child] = field(default_factory=dict)

    # Storing

    def store(self, sample: Sample) -> Outcome:
        known = self.children.get(sample.child)
        if sample.static:
            self.children[sample.child] = Child(sample.parent, sample.authority, True, [sample])
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
        self.children[sample.child] = Child(samples[-1].parent, samples[-1].authority, False, samples)
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
            children[name] = Child(child.parent, child.authority, child.static, list(samples))
        return PlainTree(keep, children)

    # Questions

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
        common = self.common_stamp(way)
        if common is None:
            edges = [self.children[name] for name, _, _ in way]
            if target == source and target in self.children:
                edges = [self.children[target]]
            stamps = [sample.stamp for edge in edges for sample in edge.samples]
            return Answer(max(stamps, default=0), True, self.along(way, 0))
        moving = {name: self.children[name] for name, _, _ in way if not self.children[name].static}
        lagging = {name: edge for name, edge in moving.items() if edge.stamps[-1] == common}
        if within is not None and common < within[0]:
            raise Blocked(*(edge.facts(name, within[0]) for name, edge in lagging.items()))
        if within is not None and common > within[1]:
            raise Blocked(*((AheadError, *edge.facts(name, within[1])[1:]) for name, edge in lagging.items()))
        try:
            return Answer(common, False, self.along(self.way(target, source, common), common))
        except Blocked as error:
            lasting = all(len({sample.parent for sample in self.children[name].samples}) == 1 for name, _, _ in way)
            needed = max(edge.stamps[0] for edge in moving.values()) if lasting else common + 1
            raise Blocked(*(edge.facts(name, needed) for name, edge in lagging.items())) from error

    def common_stamp(self, way: Way) -> int | None:
        """The least of the newest stamps of the moving edges; None if all are static."""
        moving = {name: self.children[name] for name, _, _ in way if not self.children[name].static}
        empty = [edge.facts(name, LATEST) for name, edge in moving.items() if not edge.samples]
        if empty:
            raise Blocked(*empty)
        return min((edge.stamps[-1] for edge in moving.values()), default=None)

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
        reached = [facts[4] if isinstance(facts[4], int) else float("-inf") for facts in errors]
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


Found = TypeVar("Found")
Wanted = TypeVar("Wanted")


def answers_of(question: Callable[[], Found], model: Callable[[], Wanted]) -> tuple[Found, Wanted] | None:
    """Both answers; None if the model has none, and the error of the question says why."""
    try:
        wanted = model()
    except Blocked as blocked:
        assert facts_raised(question) in blocked.acceptable
        return None
    return question(), wanted


def compare(question: Callable[[], TransformStamped], model: Callable[[], Answer]) -> bool:
    """Ask both; whether there is an answer."""
    answers = answers_of(question, model)
    if answers is not None:
        check_answer(*answers)
    return answers is not None


def facts_raised(question: Callable[[], object]) -> Facts:
    try:
        found = question()
    except TransformLookupError as error:
        return facts_of(error)
    raise AssertionError(f"there is an answer: {found}")


def check_answer(found: TransformStamped, expected: Answer) -> None:
    assert (found.stamp, found.static) == (expected.stamp, expected.static)
    assert expected.pose.is_close(found.transform)

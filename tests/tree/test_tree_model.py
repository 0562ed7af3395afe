"""The tree against a model that keeps plain lists of samples and works out every answer from scratch."""

import copy
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise, product

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from transforms3d import affines, quaternions

from tfbus import (
    LATEST,
    DisconnectedError,
    Edge,
    ExtrapolationError,
    FutureExtrapolationError,
    InvalidTransformError,
    Latest,
    Outcome,
    PastExtrapolationError,
    Transform,
    TransformLookupError,
    TransformStamped,
    TransformTree,
    UnknownFrameError,
)

Matrix = npt.NDArray[np.float64]
At = int | Latest
Facts = tuple[object, ...]


class Blocked(Exception):
    """The model has no answer; any of these facts explains why."""

    def __init__(self, *acceptable: Facts) -> None:
        super().__init__(acceptable)
        self.acceptable = set(acceptable)

    @property
    def future(self) -> bool:
        return all(facts[0] is FutureExtrapolationError for facts in self.acceptable)


class Refused(Exception):
    """The newest parents, which these would be, form a circle."""

    def __init__(self, parents: dict[str, str]) -> None:
        super().__init__(parents)
        self.parents = parents


class Circle(Exception):
    """Frames hang on each other in a circle: the model says nothing about the answer."""


@dataclass
class Answer:
    matrix: Matrix
    stamp: int
    static: bool


@dataclass
class Child:
    """Moving samples in order of stamp, or one static sample; the newest parent and authority outlive them."""

    parent: str
    authority: str
    static: bool
    samples: list[TransformStamped] = field(default_factory=list)

    @property
    def moving(self) -> list[int]:
        return [] if self.static else [sample.stamp for sample in self.samples]

    def covers(self, at: int) -> bool:
        return self.static or (bool(self.moving) and min(self.moving) <= at <= max(self.moving))

    def parent_at(self, at: At) -> str:
        if isinstance(at, Latest) or not self.moving:
            return self.parent
        return ([sample for sample in self.samples if sample.stamp <= at] or self.samples[:1])[-1].parent

    def matrix_at(self, at: int) -> Matrix:
        if self.static:
            return matrix_of(self.samples[0].transform)
        before = [sample for sample in self.samples if sample.stamp <= at][-1]
        after = next(sample for sample in self.samples if sample.stamp >= at)
        if before.parent != after.parent or before.stamp == at:
            return matrix_of(before.transform)
        return interpolated(before.transform, after.transform, (at - before.stamp) / (after.stamp - before.stamp))

    def facts(self, name: str, at: At) -> Facts:
        """The facts of the error that says that `at` is not covered."""
        moving = self.moving
        if not moving:
            return FutureExtrapolationError, name, at, None, None, self.authority
        kind = PastExtrapolationError if isinstance(at, int) and at < min(moving) else FutureExtrapolationError
        return kind, name, at, min(moving), max(moving), self.authority


def matrix_of(transform: Transform) -> Matrix:
    matrix: Matrix = affines.compose(transform.translation, quaternions.quat2mat(transform.as_wxyz()), np.ones(3))
    return matrix


def interpolated(first: Transform, second: Transform, fraction: float) -> Matrix:
    """A straight line, and a turn about a fixed axis by the smaller angle."""
    turn = quaternions.qmult(quaternions.qinverse(first.as_wxyz()), second.as_wxyz())
    axis, angle = quaternions.quat2axangle(turn if turn[0] >= 0 else -turn)
    rotation = quaternions.qmult(first.as_wxyz(), quaternions.axangle2quat(axis, angle * fraction))
    translation = (1 - fraction) * np.array(first.translation) + fraction * np.array(second.translation)
    matrix: Matrix = affines.compose(translation, quaternions.quat2mat(rotation), np.ones(3))
    return matrix


class Model:
    def __init__(self, keep: int | None) -> None:
        self.keep = keep
        self.children: dict[str, Child] = {}

    # Storing

    def insert(self, batch: list[TransformStamped]) -> list[Outcome]:
        """Store all of a batch, or raise `Refused`."""
        trial = copy.deepcopy(self)
        outcomes = [trial.store(sample) for sample in batch]
        parents = {name: child.parent for name, child in trial.children.items() if child.samples}
        for name in parents:
            if name in climb(parents, parents[name]):
                raise Refused(parents)
        self.children = trial.children
        return outcomes

    def store(self, sample: TransformStamped) -> Outcome:
        known = self.children.get(sample.child)
        outcome = Outcome.INSERTED
        if sample.static:
            if known is not None and known.static:
                outcome = Outcome.REPLACED
            samples = [sample]
        else:
            samples = [] if known is None or known.static else known.samples
            newest = max((old.stamp for old in samples), default=sample.stamp)
            if self.keep is not None and sample.stamp < newest - self.keep:
                return Outcome.EXPIRED
            if any(old.stamp == sample.stamp for old in samples):
                outcome = Outcome.REPLACED
            samples = [old for old in samples if old.stamp != sample.stamp] + [sample]
            samples.sort(key=lambda old: old.stamp)
            if self.keep is not None:
                samples = [old for old in samples if old.stamp >= samples[-1].stamp - self.keep]
        newest_sample = samples[-1]
        self.children[sample.child] = Child(newest_sample.parent, newest_sample.authority, sample.static, samples)
        self.forget_empty_circle(sample.child)
        return outcome

    def forget_empty_circle(self, name: str) -> None:
        """A frame that was cleared and now contradicts the newest sample is forgotten."""
        parents = {child: known.parent for child, known in self.children.items()}
        walk = climb(parents, name)
        if parents.get(walk[-1]) == name:
            for other in walk:
                if not self.children[other].samples:
                    del self.children[other]

    def clear(self) -> None:
        for child in self.children.values():
            if not child.static:
                child.samples = []

    def frames(self) -> list[str]:
        named = set(self.children)
        for child in self.children.values():
            named |= {child.parent, *(sample.parent for sample in child.samples)}
        return sorted(named)

    def edges(self) -> list[Edge]:
        return [
            Edge(
                child.parent,
                name,
                child.static,
                len(child.samples),
                min(child.moving, default=None),
                max(child.moving, default=None),
                child.authority,
            )
            for name, child in sorted(self.children.items())
        ]

    # Answering

    def check_known(self, *names: str) -> None:
        for name in names:
            if name not in self.frames():
                raise Blocked((UnknownFrameError, name))

    def path(self, target: str, source: str, at: At) -> tuple[list[str], list[str], str]:
        """The frames below the common ancestor on source's side and on target's, lowest first, and the ancestor."""
        self.check_known(target, source)
        parents = {name: child.parent_at(at) for name, child in self.children.items()}
        above_source, above_target = climb(parents, source), climb(parents, target)
        common = next((name for name in above_source if name in above_target), None)
        circles = [name for name in parents if name in climb(parents, parents[name])]
        if common in circles or (common is None and {above_source[-1], above_target[-1]} & set(circles)):
            raise Circle
        if common is not None:
            return above_source[: above_source.index(common)], above_target[: above_target.index(common)], common
        stamp = None if isinstance(at, Latest) else at
        raise Blocked((DisconnectedError, target, source, (above_target[-1], above_source[-1]), stamp))

    def at_stamp(self, target: str, source: str, at: int) -> Matrix:
        ups, downs, _ = self.path(target, source, at)
        short = [name for name in ups + downs if not self.children[name].covers(at)]
        if short:
            errors = [self.children[name].facts(name, at) for name in short]
            past = [facts for facts in errors if facts[0] is PastExtrapolationError]
            # If all missing samples may still come, the error names the edge that lags most.
            last = min(reach(facts) for facts in errors)
            raise Blocked(*(past or [facts for facts in errors if reach(facts) == last]))
        matrix: Matrix = np.eye(4)
        for name in ups:
            matrix = self.children[name].matrix_at(at) @ matrix
        down: Matrix = np.eye(4)
        for name in downs:
            down = self.children[name].matrix_at(at) @ down
        return np.linalg.inv(down) @ matrix

    def latest_common(self, target: str, source: str) -> tuple[int, list[str], list[str]] | None:
        """The least newest stamp, who has it, and all moving edges; None if all is static."""
        ups, downs, _ = self.path(target, source, LATEST)
        moving = [name for name in ups + downs if not self.children[name].static]
        empty = [name for name in moving if not self.children[name].samples]
        if empty:
            raise Blocked(*(self.children[name].facts(name, LATEST) for name in empty))
        if not moving:
            return None
        common = min(max(self.children[name].moving) for name in moving)
        return common, [name for name in moving if max(self.children[name].moving) == common], moving

    def lookup(self, target: str, source: str, at: At, not_before: int | None = None) -> Answer:
        ups, downs, _ = self.path(target, source, at)
        if not isinstance(at, Latest):
            still = all(self.children[name].static for name in ups + downs)
            return Answer(self.at_stamp(target, source, at), at, still)
        found = self.latest_common(target, source)
        if found is None:
            stamps = [self.children[name].samples[0].stamp for name in ups + downs]
            if target == source and target in self.children:
                stamps = [sample.stamp for sample in self.children[target].samples]
            return Answer(self.at_stamp(target, source, 0), max(stamps, default=0), static=True)
        common, lagging, moving = found
        if not_before is not None and common < not_before:
            raise Blocked(*(self.children[name].facts(name, not_before) for name in lagging))
        try:
            return Answer(self.at_stamp(target, source, common), common, static=False)
        except Blocked as error:
            on_the_path = [self.children[name] for name in ups + downs]
            lasting = all(len({sample.parent for sample in child.samples}) == 1 for child in on_the_path)
            oldest = max(self.children[name].samples[0].stamp for name in moving)
            needed = oldest if lasting else common + 1
            raise Blocked(*(self.children[name].facts(name, needed) for name in lagging)) from error

    def travel(self, target: str, source: str, at: At, source_at: At, fixed: str) -> Answer:
        self.check_known(target, source, fixed)
        legs: list[Answer] = []
        problems: list[Blocked] = []
        for question in ((target, fixed, at), (fixed, source, source_at)):
            try:
                legs.append(self.lookup(*question))
            except Blocked as problem:
                problems.append(problem)
        if problems:
            for_good = [problem for problem in problems if not problem.future]
            raise Blocked(*(facts for problem in for_good or problems for facts in problem.acceptable))
        fixed_in_target, source_in_fixed = legs
        # Of a leg that is static, no stamp is the latest.
        moving_only_at_source = fixed_in_target.static and not source_in_fixed.static
        stamp = source_in_fixed.stamp if at is LATEST and moving_only_at_source else fixed_in_target.stamp
        static = fixed_in_target.static and source_in_fixed.static
        return Answer(fixed_in_target.matrix @ source_in_fixed.matrix, stamp, static)


def climb(parents: dict[str, str], name: str) -> list[str]:
    """A frame and all above it, until the root or until one comes again."""
    walk = [name]
    while name in parents and parents[name] not in walk:
        name = parents[name]
        walk.append(name)
    return walk


def reach(facts: Facts) -> float:
    newest = facts[4]
    return newest if isinstance(newest, int) else float("-inf")


def facts_of(error: TransformLookupError) -> Facts:
    if isinstance(error, UnknownFrameError):
        return type(error), error.frame
    if isinstance(error, DisconnectedError):
        return type(error), error.target, error.source, error.roots, error.stamp
    assert isinstance(error, ExtrapolationError)
    return type(error), error.child, error.stamp, error.oldest, error.newest, error.authority


# Small enough that samples on the edge of the window, one beyond it, and its slack of a sixteenth are met all the time.
KEEPS = (40, 160, None)
FRAMES = ("a", "b", "c", "d", "e")
START = 1_000

# Every two of them are less than half a turn apart, so the shorter arc is never in doubt.
ROTATIONS = (
    (0.0, 0.0, 0.0, 1.0),
    (0.0, 0.0, 0.0, -1.0),
    (0.0, 0.0, 0.7071067811865476, 0.7071067811865476),
    (-0.7071067811865476, 0.0, 0.0, -0.7071067811865476),
    (0.5, 0.5, 0.5, 0.5),
    (0.1, -0.7, 0.1, 0.7),
)

frames = st.sampled_from(FRAMES)
questions = st.tuples(frames, frames)
pairs = st.tuples(frames, frames).filter(lambda ends: ends[0] != ends[1])
coordinates = st.integers(-3, 3).map(float)
poses = st.builds(Transform, st.tuples(coordinates, coordinates, coordinates), st.sampled_from(ROTATIONS))
authorities = st.sampled_from(("", "odometry", "slam"))
steps = st.sampled_from((1, 2, 3, 10, 41, 170, 0, -1, -2, -5, -39, -40, -41, -160, -161))


class TreeMachine(RuleBasedStateMachine):
    tree: TransformTree
    model: Model

    @initialize(keep=st.sampled_from(KEEPS))
    def begin(self, keep: int | None) -> None:
        self.tree = TransformTree(None if keep is None else keep * 1e-9)
        self.model = Model(keep)

    # Changes

    @rule(ends=pairs, step=steps, pose=poses, authority=authorities)
    def move(self, ends: tuple[str, str], step: int, pose: Transform, authority: str) -> None:
        self.insert([TransformStamped(*ends, self.newest(ends[1]) + step, pose, authority)])

    @rule(child=frames, step=steps, pose=poses)
    def move_on_the_same_parent(self, child: str, step: int, pose: Transform) -> None:
        known = self.model.children.get(child)
        if known is not None:
            self.insert([TransformStamped(known.parent, child, self.newest(child) + step, pose, known.authority)])

    @rule(child=frames, count=st.integers(1, 60), step=st.sampled_from((1, 3)), pose=poses)
    def move_many_times(self, child: str, count: int, step: int, pose: Transform) -> None:
        known = self.model.children.get(child)
        if known is not None:
            first = self.newest(child) + step
            for stamp in range(first, first + count * step, step):
                self.insert([TransformStamped(known.parent, child, stamp, pose, known.authority)])

    @rule(ends=pairs, pose=poses, stamp=st.integers(START, START + 3), authority=authorities)
    def fix(self, ends: tuple[str, str], pose: Transform, stamp: int, authority: str) -> None:
        self.insert([TransformStamped(*ends, stamp, pose, authority, static=True)])

    @rule(
        ends=st.lists(pairs, min_size=2, max_size=4), step=steps, pose=poses, static=st.sampled_from((None, 0, 1, 2, 3))
    )
    def insert_a_batch(self, ends: list[tuple[str, str]], step: int, pose: Transform, static: int | None) -> None:
        stamp = max(self.newest(child) for _, child in ends) + step
        self.insert([TransformStamped(*both, stamp, pose, "", at == static) for at, both in enumerate(ends)])

    @rule(frame=frames)
    def remove_frame(self, frame: str) -> None:
        try:
            self.tree.remove_frame(frame)
        except UnknownFrameError as error:
            assert error.frame == frame
            assert frame not in self.model.frames()
        else:
            assert frame in self.model.frames()
            self.model.children.pop(frame, None)

    @rule()
    def clear(self) -> None:
        self.tree.clear()
        self.model.clear()

    @rule()
    def go_on_with_a_copy(self) -> None:
        original = self.tree
        self.tree = original.copy()
        original.clear()
        for child in list(self.model.children):
            original.remove_frame(child)

    # Questions

    @rule(ends=questions, data=st.data())
    def ask(self, ends: tuple[str, str], data: st.DataObject) -> None:
        self.compare_lookup(*ends, self.draw_stamp(data))

    @rule(ends=questions, data=st.data())
    def ask_for_no_older_answer(self, ends: tuple[str, str], data: st.DataObject) -> None:
        not_before = self.draw_stamp(data)
        self.compare_lookup(*ends, LATEST, None if isinstance(not_before, Latest) else not_before)

    @rule(data=st.data())
    def ask_everything_at_one_stamp(self, data: st.DataObject) -> None:
        at = self.draw_stamp(data)
        for target, source in product(FRAMES, FRAMES):
            self.compare_lookup(target, source, at)

    @rule(ends=questions, fixed=frames, data=st.data())
    def travel(self, ends: tuple[str, str], fixed: str, data: st.DataObject) -> None:
        at, source_at = self.draw_stamp(data), self.draw_stamp(data)
        travel = partial(self.tree.lookup, *ends, at, source_at=source_at, fixed=fixed)
        try:
            expected = self.model.travel(*ends, at, source_at, fixed)
        except Circle:
            assert_it_ends(travel)
        except Blocked as blocked:
            assert facts_raised(travel) in blocked.acceptable
        else:
            assert_same(travel(), expected)

    @rule(ends=questions, data=st.data(), times=st.sampled_from((1, 40)))
    def ask_for_many_at_once(self, ends: tuple[str, str], data: st.DataObject, times: int) -> None:
        drawn = [self.draw_stamp(data) for _ in range(4)]
        stamps = [at for at in drawn if not isinstance(at, Latest)]
        lookup_many = partial(self.tree.lookup_many, *ends, stamps * times)
        try:
            self.model.check_known(*ends)
            expected = [self.model.lookup(*ends, at) for at in stamps]
        except Circle:
            assert_it_ends(lookup_many)
        except Blocked as blocked:
            assert facts_raised(lookup_many) in blocked.acceptable
        else:
            matrices = [answer.matrix for answer in expected] * times
            assert np.allclose(lookup_many().matrices(), np.reshape(matrices, (-1, 4, 4)), rtol=0, atol=1e-9)

    @rule(ends=questions, data=st.data())
    def ask_for_the_chain(self, ends: tuple[str, str], data: st.DataObject) -> None:
        at = self.draw_stamp(data)
        chain = partial(self.tree.chain, *ends, at)
        try:
            ups, downs, common = self.model.path(*ends, at)
        except Circle:
            assert_it_ends(chain)
        except Blocked as blocked:
            assert facts_raised(chain) in blocked.acceptable
        else:
            assert chain() == [*downs, common, *reversed(ups)]

    @rule(ends=questions)
    def ask_for_the_latest_common_stamp(self, ends: tuple[str, str]) -> None:
        common = partial(self.tree.latest_common_stamp, *ends)
        try:
            found = self.model.latest_common(*ends)
        except Blocked as blocked:
            assert facts_raised(common) in blocked.acceptable
        else:
            assert common() == (None if found is None else found[0])

    @precondition(lambda self: self.model.children)
    @rule(data=st.data())
    def ask_for_the_parent(self, data: st.DataObject) -> None:
        name = data.draw(st.sampled_from(sorted(self.model.children)))
        child = self.model.children[name]
        at = self.draw_stamp(data)
        if isinstance(at, Latest) or child.covers(at):
            assert self.tree.parent(name, at) == child.parent_at(at)
        else:
            assert facts_raised(partial(self.tree.parent, name, at)) == child.facts(name, at)

    @invariant()
    def every_edge_is_as_in_the_model(self) -> None:
        if hasattr(self, "tree"):
            assert self.tree.edges() == self.model.edges()
            assert self.tree.frames() == self.model.frames()

    # How

    def newest(self, child: str) -> int:
        known = self.model.children.get(child)
        return max(known.moving, default=START) if known is not None else START

    def draw_stamp(self, data: st.DataObject) -> At:
        stamps = {stamp for child in self.model.children.values() for stamp in child.moving} or {START}
        if data.draw(st.booleans()):
            return LATEST
        return data.draw(st.sampled_from(sorted(stamps))) + data.draw(st.sampled_from((0, 1, -1)))

    def insert(self, batch: list[TransformStamped]) -> None:
        before = self.counts()
        try:
            expected = self.model.insert(batch)
        except Refused as refused:
            with pytest.raises(InvalidTransformError) as caught:
                self.tree.insert_many(batch)
            loop = caught.value.loop
            assert caught.value.reason == "cycle"
            assert loop[0] == loop[-1]
            assert all(refused.parents[child] == parent for child, parent in pairwise(loop))
            assert self.counts() == before
        else:
            assert self.tree.insert_many(batch) == expected
            assert self.counts() == before + Counter(expected)

    def counts(self) -> Counter[Outcome]:
        tree = self.tree
        return Counter(
            {Outcome.INSERTED: tree.inserted, Outcome.REPLACED: tree.replaced, Outcome.EXPIRED: tree.expired}
        )

    def compare_lookup(self, target: str, source: str, at: At, not_before: int | None = None) -> None:
        lookup = partial(self.tree.lookup, target, source, at, not_before=not_before)
        try:
            expected = self.model.lookup(target, source, at, not_before)
        except Circle:
            assert_it_ends(lookup)
        except Blocked as blocked:
            assert facts_raised(lookup) in blocked.acceptable
            assert not self.tree.can_transform(target, source, at, not_before=not_before)
        else:
            assert_same(lookup(), expected)
            assert self.tree.can_transform(target, source, at, not_before=not_before)


def facts_raised(question: Callable[[], object]) -> Facts:
    with pytest.raises(TransformLookupError) as caught:
        question()
    return facts_of(caught.value)


def assert_it_ends(question: Callable[[], object]) -> None:
    """With whatever answer, or with an error of ours."""
    with suppress(TransformLookupError):
        question()


def assert_same(answer: TransformStamped, expected: Answer) -> None:
    assert (answer.stamp, answer.static) == (expected.stamp, expected.static)
    assert np.allclose(answer.transform.matrix(), expected.matrix, rtol=0, atol=1e-9)


TestTreeAgainstTheModel = TreeMachine.TestCase
TestTreeAgainstTheModel.settings = settings(deadline=None, stateful_step_count=50)

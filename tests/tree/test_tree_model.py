"""The tree against a model that keeps plain lists of samples and works out every answer from scratch."""

from collections import Counter
from functools import partial
from itertools import pairwise, product

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from support.plain_tree import At, PlainTree, Pose, Sample, answers_of, climb, compare, facts_raised, pose

from tfbus import LATEST, Edge, InvalidTransformError, Latest, Outcome, TransformTree, UnknownFrameError

# Small enough that samples on the edge of the window, one beyond it, and its slack of a sixteenth are met all the time.
KEEPS = (40, 160, None)
FRAMES = ("a", "b", "c", "d", "e")
START = 1_000

frames = st.sampled_from(FRAMES)
questions = st.tuples(frames, frames)
pairs = st.tuples(frames, frames).filter(lambda ends: ends[0] != ends[1])
poses = st.integers(0, 28).map(pose)
authorities = st.sampled_from(("", "odometry", "slam"))
steps = st.sampled_from((1, 2, 3, 10, 41, 170, 0, -1, -2, -5, -39, -40, -41, -160, -161))


class TreeMachine(RuleBasedStateMachine):
    tree: TransformTree
    model: PlainTree

    @initialize(keep=st.sampled_from(KEEPS))
    def begin(self, keep: int | None) -> None:
        self.tree = TransformTree(None if keep is None else keep * 1e-9)
        self.model = PlainTree(keep)

    # Changes

    @rule(ends=pairs, step=steps, pose=poses, authority=authorities)
    def move(self, ends: tuple[str, str], step: int, pose: Pose, authority: str) -> None:
        self.insert([Sample(*ends, self.newest(ends[1]) + step, pose, False, authority)])

    @rule(child=frames, step=steps, pose=poses)
    def move_on_the_same_parent(self, child: str, step: int, pose: Pose) -> None:
        known = self.model.children.get(child)
        if known is not None:
            self.insert([Sample(known.parent, child, self.newest(child) + step, pose, False, known.authority)])

    @rule(child=frames, count=st.integers(1, 60), step=st.sampled_from((1, 3)), pose=poses)
    def move_many_times(self, child: str, count: int, step: int, pose: Pose) -> None:
        known = self.model.children.get(child)
        if known is not None:
            first = self.newest(child) + step
            for stamp in range(first, first + count * step, step):
                self.insert([Sample(known.parent, child, stamp, pose, False, known.authority)])

    @rule(ends=pairs, pose=poses, stamp=st.integers(START, START + 3), authority=authorities)
    def fix(self, ends: tuple[str, str], pose: Pose, stamp: int, authority: str) -> None:
        self.insert([Sample(*ends, stamp, pose, True, authority)])

    @rule(
        ends=st.lists(pairs, min_size=2, max_size=4), step=steps, pose=poses, static=st.sampled_from((None, 0, 1, 2, 3))
    )
    def insert_a_batch(self, ends: list[tuple[str, str]], step: int, pose: Pose, static: int | None) -> None:
        stamp = max(self.newest(child) for _, child in ends) + step
        self.insert([Sample(*both, stamp, pose, at == static) for at, both in enumerate(ends)])

    @rule(frame=frames)
    def remove_frame(self, frame: str) -> None:
        try:
            self.tree.remove_frame(frame)
        except UnknownFrameError as error:
            assert error.frame == frame
            assert frame not in self.model.names()
        else:
            assert frame in self.model.names()
            self.model.remove(frame)

    @rule()
    def clear(self) -> None:
        self.tree.clear()
        self.model.reset()

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
        compare(travel, partial(self.model.travel, *ends, at, source_at, fixed))

    @rule(ends=questions, data=st.data(), times=st.sampled_from((1, 40)))
    def ask_for_many_at_once(self, ends: tuple[str, str], data: st.DataObject, times: int) -> None:
        drawn = [self.draw_stamp(data) for _ in range(4)]
        stamps = [at for at in drawn if not isinstance(at, Latest)]
        lookup_many = partial(self.tree.lookup_many, *ends, stamps * times)

        def expected() -> list[Pose]:
            self.model.check_known(*ends)
            return [self.model.lookup(*ends, at).pose for at in stamps] * times

        if (answers := answers_of(lookup_many, expected)) is not None:
            found, wanted = answers
            assert all(one.is_close(other) for one, other in zip(wanted, found, strict=True))

    @rule(ends=questions, data=st.data())
    def ask_for_the_chain(self, ends: tuple[str, str], data: st.DataObject) -> None:
        at = self.draw_stamp(data)

        def expected() -> list[list[str]]:
            self.model.check_known(*ends)
            found = self.model.ways(*ends, at) or [self.model.way(*ends, at)]
            return [[*(parent if up else name for name, parent, up in reversed(way)), ends[1]] for way in found]

        if (answers := answers_of(partial(self.tree.chain, *ends, at), expected)) is not None:
            # There are two in a loop of late samples only.
            assert answers[0] in answers[1]

    @rule(ends=questions)
    def ask_for_the_latest_common_stamp(self, ends: tuple[str, str]) -> None:
        def expected() -> int | None:
            self.model.check_known(*ends)
            return self.model.common_stamp(self.model.way(*ends, LATEST))

        if (answers := answers_of(partial(self.tree.latest_common_stamp, *ends), expected)) is not None:
            assert answers[0] == answers[1]

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
            edges = [
                Edge(child.parent, name, child.static, len(child.samples), *ends_of(child.stamps), child.authority)
                for name, child in sorted(self.model.children.items())
            ]
            assert self.tree.edges() == edges
            assert self.tree.frames() == sorted(self.model.names())

    # How

    def newest(self, child: str) -> int:
        known = self.model.children.get(child)
        return max(known.stamps, default=START) if known is not None else START

    def draw_stamp(self, data: st.DataObject) -> At:
        stamps = {stamp for child in self.model.children.values() for stamp in child.stamps} or {START}
        if data.draw(st.booleans()):
            return LATEST
        return data.draw(st.sampled_from(sorted(stamps))) + data.draw(st.sampled_from((0, 1, -1)))

    def insert(self, batch: list[Sample]) -> None:
        """Store all of a batch, or nothing if the newest parents would form a loop."""
        before = self.counts()
        after = self.model.within(self.model.keep)
        outcomes = [after.store(sample) for sample in batch]
        parents = {name: child.parent for name, child in after.children.items() if child.samples}
        stamped = [sample.stamped() for sample in batch]
        if any(name in climb(parents, parents[name]) for name in parents):
            with pytest.raises(InvalidTransformError) as caught:
                self.tree.insert_many(stamped)
            loop = caught.value.loop
            assert caught.value.reason == "cycle"
            assert loop[0] == loop[-1]
            assert all(parents[child] == parent for child, parent in pairwise(loop))
            assert self.counts() == before
        else:
            assert self.tree.insert_many(stamped) == outcomes
            assert self.counts() == before + Counter(outcomes)
            self.model = after

    def counts(self) -> Counter[Outcome]:
        tree = self.tree
        return Counter(
            {Outcome.INSERTED: tree.inserted, Outcome.REPLACED: tree.replaced, Outcome.EXPIRED: tree.expired}
        )

    def compare_lookup(self, target: str, source: str, at: At, not_before: int | None = None) -> None:
        within = None if not_before is None else (not_before, 2**62)
        lookup = partial(self.tree.lookup, target, source, at, not_before=not_before)
        answerable = compare(lookup, partial(self.model.lookup, target, source, at, within))
        assert self.tree.can_transform(target, source, at, not_before=not_before) is answerable


def ends_of(stamps: list[int]) -> tuple[int | None, int | None]:
    return min(stamps, default=None), max(stamps, default=None)


TestTreeAgainstTheModel = TreeMachine.TestCase
TestTreeAgainstTheModel.settings = settings(deadline=None, stateful_step_count=50)

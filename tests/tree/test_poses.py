import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from support.samples import any_samples, moving, over, static, tree_of

from tfbus import LATEST, InvalidTransformError, Latest, Transform, TransformStamped, TransformTree
from tfbus.errors import TransformLookupError, UnknownFrameError
from tfbus.stamps import STAMP_MIN
from tfbus.tree.poses import PoseReader, Poses
from tfbus.tree.tree import forest_of

STAMPS = st.one_of(st.integers(-1, 12), st.just(LATEST))


def read(tree: TransformTree, fixed: str, at: int | Latest = LATEST) -> Poses:
    return PoseReader(forest_of(tree)).read(fixed, at)


def x_in(poses: Poses, frame: str) -> float:
    return float(poses.columns[0, poses.frames.index(frame)])


def check_against_lookups(tree: TransformTree, poses: Poses, fixed: str, at: int | Latest) -> None:
    """A frame is answered exactly if its lookup is, with the same transform."""
    assert poses.frames[0] == fixed
    for place, frame in enumerate(poses.frames):
        try:
            found = tree.lookup(fixed, frame, at)
        except TransformLookupError:
            assert not poses.answered[place], frame
        else:
            assert poses.answered[place], frame
            row = *found.transform.translation, *found.transform.rotation
            assert poses.columns[:, place] == pytest.approx(row, abs=1e-12)


@example([*over("a", "b", (0, 10)), *over("a", "c", (0, 10)), moving("b", "d", 0, 1.0), moving("c", "d", 9, 2.0)], 5)
@given(st.lists(any_samples("abcdef", last=10), max_size=15), STAMPS)
def test_each_pose_is_that_of_a_lookup(samples: list[TransformStamped], at: int | Latest) -> None:
    tree = TransformTree()
    for sample in samples:
        try:
            tree.insert(sample)
        except InvalidTransformError:
            continue
    for fixed in tree.frames():
        poses = read(tree, fixed, at)
        check_against_lookups(tree, poses, fixed, at)
        reachable = {frame for frame in tree.frames() if frame == fixed or tree.can_transform(fixed, frame, at)}
        assert reachable <= set(poses.frames)


@given(st.lists(st.integers(0, 6), min_size=1, max_size=12), st.lists(st.integers(0, 5), min_size=12, max_size=12))
def test_poses_of_turned_frames_with_stamps_of_their_own_are_those_of_lookups(
    parents: list[int], lags: list[int]
) -> None:
    tree = TransformTree()
    for number, parent in enumerate(parents, 1):
        above = f"f{min(parent, number - 1)}"
        for stamp in range(4):
            turned = Transform.from_xyz_rpy((1.0, 0.1 * stamp, -0.2), (0.3 * number, 0.2 * stamp, -1.1))
            tree.insert(TransformStamped(above, f"f{number}", 10 * stamp + lags[number - 1], turned))
    reader = PoseReader(forest_of(tree))
    for fixed in tree.frames():
        for at in (LATEST, 17, 30, 33):
            check_against_lookups(tree, reader.read(fixed, at), fixed, at)


def test_an_edge_without_a_sample_at_the_stamp_keeps_its_nearest_one() -> None:
    tree = tree_of(*over("map", "base", (10, 20)), static("base", "lidar", 1.0))
    late = read(tree, "map", 25)
    early = read(tree, "map", 5)
    assert (x_in(late, "base"), x_in(late, "lidar")) == (20.0, 21.0)
    assert (x_in(early, "base"), x_in(early, "lidar")) == (10.0, 11.0)
    assert late.answered.tolist() == early.answered.tolist() == [True, False, False]
    for at in (10, 11, 20):
        found = read(tree, "map", at)
        assert (x_in(found, "base"), found.answered.tolist()) == (float(at), [True, True, True])
    assert [read(tree, "map", at).answered.tolist()[1] for at in (9, 21)] == [False, False]


def test_an_unknown_fixed_frame_is_an_error() -> None:
    for at in (LATEST, 5):
        with pytest.raises(UnknownFrameError):
            read(tree_of(static("map", "a")), "mop", at)


def test_the_newest_stamps_are_those_not_after_the_stamp_and_static_frames_have_none() -> None:
    tree = tree_of(*over("map", "base", (10, 20, 30)), static("base", "lidar"))
    reader = PoseReader(forest_of(tree))

    def heard(at: int | Latest) -> dict[str, int]:
        poses = reader.read("map", at)
        return dict(zip(poses.frames, poses.newest.tolist(), strict=True))

    assert heard(LATEST) == {"map": STAMP_MIN, "base": 30, "lidar": STAMP_MIN}
    assert [heard(at)["base"] for at in (9, 10, 25, 30, 99)] == [STAMP_MIN, 10, 20, 30, 30]
    assert reader.read("map").static.tolist() == [False, False, True]


CHANGES = st.one_of(any_samples("abcd", last=10), st.sampled_from("abcd"), st.none())


@given(st.lists(CHANGES, max_size=12), st.sampled_from("abcd"))
def test_a_reader_that_is_kept_says_the_same_as_lookups_after_any_change(
    changes: list[TransformStamped | str | None], fixed: str
) -> None:
    tree = tree_of(static("a", "b", 1.0), static("b", "c", 1.0), moving("c", "d", 0, 1.0))
    reader = PoseReader(forest_of(tree))
    for change in changes:
        try:
            if change is None:
                tree.clear()
            elif isinstance(change, str):
                tree.remove_frame(change)
            else:
                tree.insert(change)
            check_against_lookups(tree, reader.read(fixed), fixed, LATEST)
        except (InvalidTransformError, UnknownFrameError):
            continue

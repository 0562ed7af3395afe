"""Covariances beside the history: kept and dropped with their samples."""

import numpy as np
import pytest
from support.samples import moving, static
from support.worlds import disturbed, random_covariance, random_transform, root, sigma_of, unsure, white

from tfbus import (
    SECOND,
    Covariance,
    FutureExtrapolationError,
    Hold,
    Transform,
    TransformStamped,
    TransformTree,
    UncertainSample,
)
from tfbus.geometry.covariance import Kind, lever_arm

ERROR = Covariance.of(xyz=0.1, rpy=0.01)


def test_an_edge_without_a_covariance_is_told_and_not_taken_for_zero_in_silence() -> None:
    tree = TransformTree()
    tree.insert_many([unsure("a", "b", 0), static("b", "c"), moving("c", "d", 0)])
    found = tree.lookup("a", "d", 0, covariance=True)
    assert found.exact == (("b", "c"), ("c", "d"))
    assert found.transform == tree.lookup("a", "d", 0).transform
    # Between two samples, both must be known; at a sample, that one.
    tree.insert(moving("a", "b", 10))
    assert [sigma_of(tree, "a", "b", at) for at in (0, 5, 10)] == [pytest.approx(0.1), None, None]
    many = tree.lookup_many("a", "b", (0, 5, 10), covariance=True)
    assert many.covariances[:, 0, 0].tolist() == pytest.approx([0.01, 0.0, 0.0])
    assert not tree.lookup("d", "d", covariance=True).covariance.matrix.any()


def test_the_covariance_goes_with_its_sample() -> None:
    tree = TransformTree(keep=1e-7)
    for stamp in range(0, 1000, 10):
        tree.insert(unsure("a", "b", stamp, stamp))
    assert sigma_of(tree, "a", "b", 990) == pytest.approx(990.0)
    tree.insert(unsure("a", "b", 990, 3.0))
    assert sigma_of(tree, "a", "b", 990) == pytest.approx(3.0)
    tree.insert(moving("a", "b", 990))
    assert sigma_of(tree, "a", "b", 990) is None
    tree.insert(unsure("a", "b", 955, 7.0))
    assert sigma_of(tree, "a", "b", 955) == pytest.approx(7.0)
    for copied in (tree.copy(), TransformTree(keep=1e-7)):
        copied.insert(unsure("a", "b", 991, 4.0))
        assert sigma_of(copied, "a", "b", 991) == pytest.approx(4.0)
    assert sigma_of(tree.copy(), "a", "b", 955) == pytest.approx(7.0)
    tree.clear()
    for stamp in (955, 980):
        tree.insert(moving("a", "b", stamp))
    assert sigma_of(tree, "a", "b", 980) is None, "a sample after a reset has no covariance of one before"


def test_a_static_covariance_is_replaced_with_its_sample_and_changes_of_the_kind_forget_it() -> None:
    tree = TransformTree()
    tree.insert(unsure("a", "b", 5, static=True))
    assert sigma_of(tree, "a", "b", 100) == pytest.approx(0.1)
    tree.insert(unsure("a", "b", 5, 0.2, static=True))
    assert sigma_of(tree, "a", "b", 100) == pytest.approx(0.2)
    tree.insert(static("a", "b", stamp=5))
    assert sigma_of(tree, "a", "b", 100) is None
    tree.insert(unsure("a", "b", 5, static=True))
    for stamp in (0, 5, 10):
        tree.insert(moving("a", "b", stamp))
    assert sigma_of(tree, "a", "b", 5) is None
    tree.insert(unsure("a", "b", 7))
    tree.insert(static("a", "b", stamp=7))
    assert sigma_of(tree, "a", "b", 7) is None


def test_a_change_of_the_parent_is_held_with_the_error_of_the_older_edge() -> None:
    tree = TransformTree()
    tree.insert_many([static("root", "a"), static("root", "b"), unsure("a", "c", 0, 0.1), unsure("b", "c", 10, 0.3)])
    found = tree.lookup("root", "c", 5, covariance=True)
    assert found.covariance.sigmas[0] == pytest.approx(0.1)
    assert found.exact == (("root", "a"),)
    assert tree.lookup("root", "c", 10, covariance=True).covariance.sigmas[0] == pytest.approx(0.3)


def test_a_policy_reads_the_error_of_the_sample_that_stands_in() -> None:
    tree = TransformTree()
    tree.insert_many([unsure("a", "b", 0, 0.1), unsure("a", "b", SECOND, 0.2)])
    found = tree.lookup("a", "b", 2 * SECOND, extrapolate=Hold(1.0), covariance=True)
    assert found.covariance.sigmas[0] == pytest.approx(0.2)
    assert found.extrapolated_by == SECOND
    with pytest.raises(FutureExtrapolationError):
        tree.lookup("a", "b", 2 * SECOND, covariance=True)


def test_many_answers_have_the_covariances_of_single_ones() -> None:
    rng = np.random.default_rng(1)
    tree = TransformTree(keep=None)
    for parent, child, every in (("map", "odom", 50), ("odom", "base", 10), ("map", "other", 30)):
        for stamp in range(0, 301, every):
            error = Covariance(random_covariance(rng, 0.1, 0.1))
            tree.insert(UncertainSample(parent, child, stamp, random_transform(rng), covariance=error))
    tree.insert(UncertainSample("base", "camera", 0, random_transform(rng), static=True, covariance=ERROR))
    tree.insert(static("other", "laser"))
    stamps = [*range(0, 301, 7), 300, 0]
    found = tree.lookup_many("laser", "camera", stamps, covariance=True)
    assert found.exact == (("other", "laser"),)
    assert found.stamps is not None
    assert found.stamps.tolist() == stamps
    for i, stamp in enumerate(stamps):
        one = tree.lookup("laser", "camera", stamp, covariance=True)
        assert found.covariances[i] == pytest.approx(one.covariance.matrix, rel=1e-9, abs=1e-15)
    # One by one: time travel, and a frame that changes its parent.
    travel = tree.lookup_many("camera", "camera", [300, 200], source_at=100, fixed="map", covariance=True)
    one = tree.lookup("camera", "camera", 200, source_at=100, fixed="map", covariance=True)
    assert travel.covariances[1] == pytest.approx(one.covariance.matrix)
    tree.insert(unsure("other", "base", 290))
    held = tree.lookup_many("laser", "camera", [285, 400], out_of_range="nan", covariance=True)
    assert held.covariances[0] == pytest.approx(tree.lookup("laser", "camera", 285, covariance=True).covariance.matrix)
    assert np.isnan(held.covariances[1]).all()


@pytest.mark.parametrize("count", [0, 3])
def test_many_answers_without_errors_say_so(count: int) -> None:
    tree = TransformTree()
    tree.insert_many([moving("a", "b", stamp) for stamp in (0, 10)])
    found = tree.lookup_many("a", "b", range(count), covariance=True)
    assert found.covariances.shape == (count, 6, 6)
    assert not found.covariances.any()
    assert found.exact == ((("a", "b"),) if count else ())


@pytest.mark.parametrize(
    ("kind", "in_frame"), [("independent", False), ("independent", True), ("drift", True), ("constant", False)]
)
def test_a_twist_has_the_error_of_the_motion_between_its_samples(kind: Kind, in_frame: bool) -> None:
    rng, worlds = np.random.default_rng(3), 1000
    # The reference climbs an edge that moves, and the frame hangs on one that moves and on one that does not.
    mount = random_transform(rng)
    ends = {name: [random_transform(rng), random_transform(rng)] for name in ("eye", "base")}
    errors, samples = {}, []
    for child, poses in ends.items():
        older = random_covariance(rng, 0.02, 0.01)
        arm = lever_arm(np.subtract(poses[1].translation, poses[0].translation))
        added = random_covariance(rng, 0.01, 0.005)
        newer = arm @ older @ arm.T + added if kind == "drift" else older
        first, other = white(rng, worlds, 12).reshape(worlds, 2, 6).swapaxes(0, 1)
        before = first @ root(older).T
        after = {
            "drift": before @ arm.T + other @ root(added).T,
            "constant": before,
            "independent": other @ root(older).T,
        }[kind]
        errors[child] = before, after
        for stamp, pose, matrix in zip((0, SECOND), poses, (older, newer), strict=True):
            samples.append(UncertainSample("map", child, stamp, pose, covariance=Covariance(matrix), kind=kind))
    fixed = random_covariance(rng, 0.01, 0.01)
    samples.append(UncertainSample("base", "hand", 0, mount, static=True, covariance=Covariance(fixed)))
    tree = TransformTree()
    tree.insert_many(samples)
    at, axes = SECOND // 4, "hand" if in_frame else "eye"
    found = tree.twist("hand", "eye", at, expressed_in=axes, covariance=True)
    assert found.exact == ()
    assert (found.linear, found.angular) == (
        tree.twist("hand", "eye", at, expressed_in=axes).linear,
        tree.twist("hand", "eye", at, expressed_in=axes).angular,
    )
    mounts = disturbed(mount, rng.standard_normal((worlds, 6)) @ root(fixed).T)
    moved = {
        child: [disturbed(pose, error) for pose, error in zip(ends[child], errors[child], strict=True)]
        for child in ends
    }
    twists = []
    for world in range(worlds):
        true = TransformTree()
        for child in ends:
            for stamp, drawn in zip((0, SECOND), moved[child], strict=True):
                true.insert(TransformStamped("map", child, stamp, Transform.from_matrix(drawn[world])))
        true.insert(TransformStamped("base", "hand", 0, Transform.from_matrix(mounts[world]), static=True))
        twist = true.twist("hand", "eye", at, expressed_in=axes)
        twists.append([*twist.linear, *twist.angular])
    truth = np.cov(np.array(twists).T)
    unit = np.sqrt(truth.diagonal())
    assert np.sqrt(found.covariance.diagonal()) == pytest.approx(unit, rel=0.07)
    assert found.covariance / np.outer(unit, unit) == pytest.approx(truth / np.outer(unit, unit), abs=0.12)


def test_a_twist_names_the_edges_without_an_error_and_refuses_third_axes() -> None:
    tree = TransformTree()
    tree.insert_many([unsure("map", "base", 0), moving("map", "base", 10), static("base", "hand")])
    assert tree.twist("hand", "map", 5, covariance=True).exact == (("map", "base"), ("base", "hand"))
    assert not tree.twist("map", "map", 5, covariance=True).covariance.any()
    with pytest.raises(ValueError, match="along the axes of 'map' or 'hand', not of 'base'"):
        tree.twist("hand", "map", 5, expressed_in="base", covariance=True)

"""Answers with covariances: against published values, Monte Carlo in worlds of known error, and closed forms."""

import os
import pickle
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from support.worlds import (
    covariance_around,
    disturbed,
    errors_of,
    is_positive,
    random_covariance,
    random_transform,
    root,
    white,
)

from tfbus import (
    SECOND,
    Covariance,
    Transform,
    TransformStamped,
    TransformTree,
    UncertainSample,
    UncertainTransform,
    joint,
)
from tfbus.geometry.covariance import Kind, Matrix, compose_jacobians

TREES = int(os.environ.get("UNCERTAIN_TREES", "1000"))
"""The number of random trees in the thorough suite."""


def chain_of(*edges: tuple[Transform, Matrix]) -> TransformTree:
    """The frames "0", "1", "2" and so on, each static in the one before it."""
    tree = TransformTree()
    for i, (transform, matrix) in enumerate(edges):
        error = Covariance(matrix)
        tree.insert(UncertainSample(str(i), str(i + 1), 0, transform, static=True, covariance=error))
    return tree


def test_gtsams_odometry_example_has_its_published_marginals() -> None:
    # GTSAM, examples/OdometryExample.cpp: a prior and two motions of 2 m ahead, as right perturbations.
    prior, step = np.diag([0.3, 0.3, 0.0, 0.0, 0.0, 0.1]) ** 2, np.diag([0.2, 0.2, 0.0, 0.0, 0.0, 0.1]) ** 2
    ahead = Transform((2.0, 0.0, 0.0))
    tree = chain_of(
        (Transform(), Covariance.from_right(prior, Transform()).matrix),
        (ahead, Covariance.from_right(step, ahead).matrix),
        (ahead, Covariance.from_right(step, ahead).matrix),
    )
    published = {
        "1": [[0.09, 0.0, 0.0], [0.0, 0.09, 0.0], [0.0, 0.0, 0.01]],
        "2": [[0.13, 0.0, 0.0], [0.0, 0.17, 0.02], [0.0, 0.02, 0.02]],
        "3": [[0.17, 0.0, 0.0], [0.0, 0.37, 0.06], [0.0, 0.06, 0.03]],
    }
    for frame, marginal in published.items():
        found = tree.lookup("0", frame, covariance=True)
        plane = found.covariance.right(found.transform)[np.ix_([0, 1, 5], [0, 1, 5])]
        assert plane == pytest.approx(np.array(marginal), abs=1e-12)


@pytest.mark.parametrize("axis", range(6))
def test_the_error_of_one_axis_of_an_edge_arrives_by_its_lever_arm(axis: int) -> None:
    # A quarter turn about z before the edge, and an arm of 2 m along its child's x, which is the parent's -x.
    half = Transform.from_axis_angle((0.0, 0.0, 1.0), np.pi, (5.0, 0.0, 0.0))
    matrix = np.zeros((6, 6))
    matrix[axis, axis] = 0.01
    quarter = Transform.from_axis_angle((0.0, 0.0, 1.0), np.pi / 2)
    tree = chain_of((quarter, np.zeros((6, 6))), (half, matrix), (Transform((2.0, 0.0, 0.0)), np.zeros((6, 6))))
    # In the axes of the target, the arm is (0, -2, 0), and the axes x, y, z of the edge are y, -x, z.
    expected = {0: (1, ()), 1: (0, ()), 2: (2, ()), 3: (4, ()), 4: (3, (2,)), 5: (5, (0,))}[axis]
    sigmas = np.zeros(6)
    sigmas[expected[0]] = 0.1
    sigmas[list(expected[1])] = 0.2
    assert tree.lookup("0", "3", covariance=True).covariance.sigmas == pytest.approx(sigmas, abs=1e-9)
    assert tree.lookup("3", "0", covariance=True).inverse().covariance.sigmas == pytest.approx(sigmas, abs=1e-9)


def random_chain(rng: np.random.Generator, rpy: float, n: int = 1000) -> tuple[UncertainTransform, Matrix]:
    """The answer across a random tree, and its true covariance by Monte Carlo, around the answer."""
    depth, tree = int(rng.integers(1, 7)), TransformTree()
    turn = int(rng.integers(0, depth + 1))
    draws, truth = white(rng, n, 6 * depth), np.tile(np.eye(4), (n, 1, 1))
    for i in range(depth):
        transform, matrix = random_transform(rng), random_covariance(rng, 0.05, rpy)
        # Up to the turn, the way from the target climbs.
        parent, child = (str(i + 1), str(i)) if i < turn else (str(i), str(i + 1))
        error = Covariance(matrix)
        tree.insert(UncertainSample(parent, child, 0, transform, static=True, covariance=error))
        edges = disturbed(transform, draws[:, 6 * i : 6 * i + 6] @ root(matrix).T)
        truth = truth @ (np.linalg.inv(edges) if i < turn else edges)
    found = tree.lookup("0", str(depth), covariance=True)
    return found, covariance_around(truth, found.transform.matrix())


def difference(found: Matrix, truth: Matrix) -> float:
    """The difference of two covariances as a part of the truth, each number in its own unit."""
    unit = np.sqrt(np.outer(truth.diagonal(), truth.diagonal()))
    return float(np.linalg.norm((found - truth) / unit) / np.linalg.norm(truth / unit))


def difference_of(seed: int, rpy: float, limit: float) -> tuple[UncertainTransform, float]:
    """The answer across a random tree, and its difference from Monte Carlo, with more draws if it is above a limit."""
    off = 0.0
    for draws in (1000, 30_000):
        found, truth = random_chain(np.random.default_rng(seed), rpy, draws)
        off = difference(found.covariance.matrix, truth)
        if off < limit or not found.linear:
            break
    return found, off


@pytest.mark.parametrize("trees", [25, pytest.param(TREES, marks=pytest.mark.thorough)])
def test_random_trees_agree_with_monte_carlo_up_to_a_twentieth_of_a_radian(trees: int) -> None:
    for seed in range(trees):
        assert difference_of(seed, 0.05, 0.03)[1] < 0.03, seed


@pytest.mark.parametrize("trees", [25, pytest.param(TREES, marks=pytest.mark.thorough)])
def test_beyond_first_order_an_answer_says_that_it_is_not_linear(trees: int) -> None:
    told = 0
    for seed in range(trees):
        found, off = difference_of(seed, np.random.default_rng(seed).uniform(0.05, 0.4), 0.05)
        if off > 0.05:
            told += 1
            assert not found.linear, seed
    assert told > trees // 5


def test_draws_of_an_answer_have_its_true_distribution_beyond_first_order() -> None:
    for seed in range(2):
        found, truth = random_chain(np.random.default_rng(seed), 0.4, 20_000)
        drawn = found.sample(20_000, rng=seed).matrices()
        assert difference(covariance_around(drawn, found.transform.matrix()), truth) < 0.05, seed
        assert difference(found.covariance.matrix, truth) > 0.05, seed


# A robot that drives a bend, and sends the pose that it believes in

STEP = SECOND // 10
AHEAD = Transform.from_axis_angle((0.0, 0.0, 1.0), 0.02, (0.05, 0.0, 0.0))
MOUNT = Transform.from_xyz_rpy((0.3, 0.1, 0.2), (0.1, -0.2, 0.3))
SLIP = np.diag([1e-3, 5e-4, 2e-4, 2e-4, 2e-4, 1e-3]) ** 2
FIX = np.diag([0.02, 0.03, 0.01, 0.004, 0.002, 0.01]) ** 2
STEPS, WORLDS, LOOKED_AT = 300, 3000, {100, 200, 290, 299, 300}


@cache
def driven(kind: Kind) -> tuple[TransformTree, dict[int, Matrix]]:
    """A tree of a robot whose errors are of a kind; and in many worlds, the truth at some steps, shape (n, 4, 4)."""
    rng, tree = np.random.default_rng(7), TransformTree(keep=None)
    believed, matrix = Transform(), np.zeros((6, 6)) if kind == "drift" else FIX
    true, truth = np.tile(np.eye(4), (WORLDS, 1, 1)), {}
    constant = white(rng, WORLDS, 6) @ root(FIX).T
    for step in range(STEPS + 1):
        if kind == "drift" and step:
            true = true @ disturbed(AHEAD, rng.standard_normal((WORLDS, 6)) @ root(SLIP).T)
        if step in LOOKED_AT:
            error = constant if kind == "constant" else rng.standard_normal((WORLDS, 6)) @ root(FIX).T
            truth[step] = true if kind == "drift" else disturbed(believed, error)
        sample = UncertainSample("odom", "base", step * STEP, believed, covariance=Covariance(matrix), kind=kind)
        tree.insert(sample)
        if kind == "drift":
            first, second = compose_jacobians(believed, AHEAD)
            matrix = first @ matrix @ first.T + second @ SLIP @ second.T
        believed = believed @ AHEAD
    tree.insert(UncertainSample("base", "camera", 0, MOUNT, static=True, covariance=Covariance(FIX / 16.0)))
    return tree, truth


def with_mount(truth: dict[int, Matrix]) -> dict[int, Matrix]:
    """The truth of the camera: its mount has one error in each world."""
    mount = disturbed(MOUNT, np.random.default_rng(8).standard_normal((WORLDS, 6)) @ root(FIX / 16.0).T)
    return {step: here @ mount for step, here in truth.items()}


def assert_right(found: Matrix, truth: Matrix) -> None:
    """Each standard deviation is within 5 % of the true one, and the covariances agree."""
    sigmas, true = np.sqrt(found.diagonal()), np.sqrt(truth.diagonal())
    assert (sigmas <= 1.05 * true + 1e-9).all(), sigmas / true
    assert (sigmas >= 0.95 * true - 1e-9).all(), sigmas / true
    assert difference(found, truth) < 0.15


@pytest.mark.parametrize("kind", ["independent", "drift", "constant"])
def test_time_travel_is_as_sure_as_the_kind_of_the_errors_allows(kind: Kind) -> None:
    tree, truth = driven(kind)
    camera = with_mount(truth)
    for now, before in ((300, 290), (300, 299), (200, 100)):
        found = tree.lookup("camera", "camera", now * STEP, source_at=before * STEP, fixed="odom", covariance=True)
        true = np.linalg.inv(camera[now]) @ camera[before]
        assert_right(found.covariance.matrix, covariance_around(true, found.transform.matrix()))
        drawn = found.sample(WORLDS, rng=1).matrices()
        assert_right(covariance_around(drawn, found.transform.matrix()), found.covariance.matrix)


@pytest.mark.parametrize("kind", ["independent", "drift", "constant"])
def test_two_answers_together_have_what_they_share_in_common(kind: Kind) -> None:
    tree, truth = driven(kind)
    camera = with_mount(truth)
    a = tree.lookup("odom", "camera", 290 * STEP, covariance=True)
    b = tree.lookup("odom", "base", 300 * STEP, covariance=True)
    errors = np.hstack((errors_of(camera[290], a.transform.matrix()), errors_of(truth[300], b.transform.matrix())))
    together = joint([a, b])
    assert_right(together.covariance, np.cov(errors.T))
    assert_right(together.difference(0, 1), np.cov((errors[:, 6:] - errors[:, :6]).T))
    drawn = [array.matrices() for array in together.sample(WORLDS, rng=2)]
    both = [errors_of(array, found.transform.matrix()) for array, found in zip(drawn, (a, b), strict=True)]
    assert_right(np.asarray(np.cov(np.hstack(both).T)), together.covariance)


def test_between_two_samples_an_error_of_a_drift_is_that_of_the_stamp() -> None:
    tree, _ = driven("drift")
    old, new, half = (
        tree.lookup("base", "base", 290 * STEP, source_at=at, fixed="odom", covariance=True).covariance.matrix[5, 5]
        for at in (295 * STEP, 296 * STEP, 295 * STEP + STEP // 2)
    )
    assert half == pytest.approx(0.5 * (old + new))
    assert half == pytest.approx(5.5 * SLIP[5, 5])


def test_close_stamps_between_the_same_samples_differ_little_even_if_the_samples_are_independent() -> None:
    tree = TransformTree()
    for stamp in (0, 1000, 2000):
        error = Covariance.of(xyz=1.0)
        tree.insert(UncertainSample("map", "marker", stamp, Transform(), covariance=error))

    def spread(a: int, b: int) -> float:
        pair = [tree.lookup("map", "marker", at, covariance=True) for at in (a, b)]
        return float(joint([*pair, *pair]).difference(1, 2)[0, 0])

    # (s' - s) (S0 + S1) within a segment; two independent ones at samples, or across whole segments.
    assert [spread(0, 0), spread(500, 501), spread(0, 1000), spread(0, 2000)] == pytest.approx([0.0, 0.002, 2.0, 2.0])
    # Half of each is the error of the sample between them: 1 + 1 - 2 * 0.5 * 0.5.
    assert spread(500, 1500) == pytest.approx(1.5)


@pytest.mark.parametrize(("xyz", "rpy"), [(1.0, 0.1), (1e5, 1e-6)])
def test_a_sender_that_becomes_surer_gives_no_negative_variance(xyz: float, rpy: float) -> None:
    rng = np.random.default_rng(9)
    surer = np.diag([0.0, xyz, 0.0, rpy, 0.0, 0.0]) ** 2
    for kind in ("independent", "drift", "constant"):
        tree = TransformTree(keep=None)
        for stamp in range(12):
            error = Covariance(random_covariance(rng, xyz, rpy) if stamp % 5 else surer)
            tree.insert(UncertainSample("a", "b", 10 * stamp, random_transform(rng), covariance=error, kind=kind))
        answers = [tree.lookup("a", "b", at, covariance=True) for at in range(0, 110, 7)]
        assert is_positive(joint(answers).covariance)
        travels = [tree.lookup("b", "b", at, source_at=110 - at, fixed="a", covariance=True) for at in range(0, 110, 7)]
        assert is_positive(joint(travels).covariance)


def test_ten_thousand_edges_give_a_covariance_and_its_closed_form() -> None:
    step, tree = Transform((1.0, 0.0, 0.0)), TransformTree()
    error = Covariance.of(xyz=0.01, rpy=(0.0, 0.0, 1e-6))
    tree.insert_many(
        [UncertainSample(str(i), str(i + 1), 0, step, static=True, covariance=error) for i in range(10_000)]
    )
    found = tree.lookup("0", "10000", covariance=True).covariance
    arms = np.arange(10_000.0)
    assert found.matrix[0, 0] == pytest.approx(10_000 * 1e-4)
    assert found.matrix[1, 1] == pytest.approx(10_000 * 1e-4 + 1e-12 * (arms * arms).sum())
    assert is_positive(found.matrix)


def test_far_from_the_origin_nothing_is_lost() -> None:
    # On the earth, 6,000 km from its centre: the arm between two frames is short all the same.
    far = Transform.from_axis_angle((0.0, 0.6, 0.8), 1.0, (4.1e6, 0.9e6, 4.8e6))
    tree = chain_of((far, np.zeros((6, 6))), (Transform((2.0, 0.0, 0.0)), Covariance.of(rpy=0.1).matrix))
    tree.insert(TransformStamped("2", "3", 0, Transform((1.0, 0.0, 0.0)), static=True))
    found = tree.lookup("0", "3", covariance=True).covariance
    assert np.linalg.eigvalsh(found.matrix[:3, :3]) == pytest.approx([0.0, 0.01, 0.01], abs=1e-9)


# Arithmetic of answers


def test_answers_compose_and_invert_with_what_they_share() -> None:
    rng = np.random.default_rng(10)
    tree = chain_of(*((random_transform(rng), random_covariance(rng, 0.1, 0.1)) for _ in range(3)))
    found: Callable[[str, str], UncertainTransform] = lambda a, b: tree.lookup(a, b, covariance=True)  # noqa: E731
    whole, half = found("0", "3"), found("0", "1")
    product = half @ found("1", "3")
    assert isinstance(product, UncertainTransform)
    assert product.covariance.matrix == pytest.approx(whole.covariance.matrix)
    back = half.inverse() @ whole
    assert isinstance(back, UncertainTransform)
    assert back.covariance.matrix == pytest.approx(found("1", "3").covariance.matrix)
    assert whole.inverse().covariance.matrix == pytest.approx(found("3", "0").covariance.matrix)
    cancelled = whole.inverse() @ whole
    assert isinstance(cancelled, UncertainTransform)
    assert cancelled.covariance.matrix == pytest.approx(np.zeros((6, 6)))


def test_the_shares_of_the_edges_add_up_and_the_greatest_is_first() -> None:
    tree = chain_of(
        (Transform(), Covariance.of(xyz=0.1).matrix),
        (Transform((1.0, 0.0, 0.0)), Covariance.of(xyz=(0.0, 0.3, 0.0)).matrix),
        (Transform(), np.zeros((6, 6))),
    )
    found = tree.lookup("0", "3", covariance=True)
    shares = found.shares()
    assert [share.child for share in shares] == ["2", "1", "3"]
    assert sum(share.matrix for share in shares) == pytest.approx(found.covariance.matrix)
    of_y = {share.child: share.matrix[1, 1] / found.covariance.matrix[1, 1] for share in shares}
    assert of_y == pytest.approx({"1": 0.1, "2": 0.9, "3": 0.0})


def test_points_move_with_the_lever_arm_and_their_own_error() -> None:
    tree = chain_of(
        (Transform.from_axis_angle((0.0, 0.0, 1.0), np.pi / 2), np.diag([1e-4, 4e-4, 9e-4, 0.0, 0.0, 1e-4])),
    )
    found = tree.lookup("0", "1", covariance=True)
    points, spread = found.move_points([(10.0, 0.0, 0.0), (0.0, 0.0, 0.0)], np.diag([1.0, 4.0, 9.0]))
    assert points == pytest.approx(np.array([(0.0, 10.0, 0.0), (0.0, 0.0, 0.0)]))
    # A yaw of 0.01 rad shifts the first point by 0.1 m along x.
    assert spread[0] == pytest.approx(np.diag([4.0 + 1e-4 + 1e-2, 1.0 + 4e-4, 9.0 + 9e-4]), abs=1e-12)
    assert spread[1] == pytest.approx(np.diag([4.0 + 1e-4, 1.0 + 4e-4, 9.0 + 9e-4]), abs=1e-12)


def test_the_ellipsoid_has_the_covariance_of_the_position() -> None:
    for seed in range(5):
        found, _ = random_chain(np.random.default_rng(seed), 0.05, 100)
        axes, rotation = found.ellipsoid(3.0)
        turn = Transform(rotation=rotation).matrix()[:3, :3]
        assert turn @ np.diag(np.square(axes)) @ turn.T / 9.0 == pytest.approx(found.covariance.matrix[:3, :3])


def test_an_answer_survives_pickling_with_its_error() -> None:
    found, _ = random_chain(np.random.default_rng(11), 0.05, 100)
    twin = pickle.loads(pickle.dumps(found))
    assert twin == found
    assert twin.covariance == found.covariance
    with pytest.raises(TypeError, match="covariance=True"):
        joint([TransformStamped("a", "b", 0, Transform())])  # type: ignore[list-item]

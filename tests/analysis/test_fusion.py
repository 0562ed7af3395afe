"""`fuse`: published results, a closed form, and the true error of what it gives."""

import math

import numpy as np
import pytest
from support.worlds import disturbed, random_covariance, random_transform, root

from tfbus import Covariance, Transform, TransformStamped, TransformTree, UncertainSample, UncertainTransform
from tfbus.analysis import fuse, nees
from tfbus.uncertainty import joint


def answers_of(*edges: tuple[str, str, Transform, Covariance], target: str = "map") -> list[UncertainTransform]:
    """The answers from the target to each frame without a child."""
    tree = TransformTree()
    tree.insert_many([UncertainSample(*edge[:2], 0, edge[2], static=True, covariance=edge[3]) for edge in edges])
    leaves = [child for _, child, *_ in edges if child not in {parent for parent, *_ in edges}]
    return [tree.lookup(target, leaf, covariance=True) for leaf in leaves]


def test_the_example_of_barfoot_and_furgale_is_fused_as_published() -> None:
    # The three poses, the fused one, its covariance and half the total are those of pytransform3d's test of this
    # example; there, and in each matrix here, the rotation comes first.
    poses = [
        [(0.8573, -0.2854, 0.4285, 3.5368), (-0.1113, 0.7098, 0.6956, -3.5165), (-0.5026, -0.6440, 0.5767, -0.9112)],
        [(0.5441, -0.6105, 0.5755, -1.0935), (0.8276, 0.5032, -0.2487, 5.5992), (-0.1377, 0.6116, 0.7791, 0.2690)],
        [(-0.0211, -0.7869, 0.6167, -3.0968), (-0.2293, 0.6042, 0.7631, 2.0868), (-0.9731, -0.1254, -0.1932, 2.0239)],
    ]
    variances = [(0.1, 0.2, 0.1, 2.0, 1.0, 1.0), (0.1, 0.1, 0.2, 1.0, 3.0, 1.0), (0.2, 0.1, 0.1, 1.0, 1.0, 5.0)]
    edges = []
    for name, rows, variance in zip("abc", poses, variances, strict=True):
        matrix = np.array([*rows, (0.0, 0.0, 0.0, 1.0)])
        left, _, right = np.linalg.svd(matrix[:3, :3])
        matrix[:3, :3] = left @ right
        pose = Transform.from_matrix(matrix)
        edges.append(("map", name, pose, Covariance.from_left(5.0 * np.diag(variance), pose, rotation_first=True)))
    fused = fuse(answers_of(*edges))
    expected = [
        (0.2967, -0.7157, 0.6323, -1.4887),
        (0.5338, 0.6733, 0.5116, 0.9935),
        (-0.7918, 0.1857, 0.5818, -2.7035),
    ]
    assert fused.transform.matrix()[:3] == pytest.approx(np.array(expected), abs=1e-3)
    covariance = [
        (0.14907707, -0.01935277, -0.0107348, -0.02442925, -0.09843835, 0.0054134),
        (-0.01935277, 0.14648459, 0.02055571, 0.11121064, 0.06272014, -0.08553834),
        (-0.0107348, 0.02055571, 0.15260209, -0.07451066, 0.06531188, -0.01890897),
        (-0.02442925, 0.11121064, -0.07451066, 2.10256906, 0.13695598, -0.29705468),
        (-0.09843835, 0.06272014, 0.06531188, 0.13695598, 2.29286157, -0.58004),
        (0.0054134, -0.08553834, -0.01890897, -0.29705468, -0.58004, 2.34528443),
    ]
    found = fused.covariance.left(fused.transform, rotation_first=True)
    assert found == pytest.approx(np.array(covariance), abs=1e-3)
    assert fused.total / 2.0 == pytest.approx(4.6537, abs=1e-3)
    assert fused.degrees == 12
    assert fused.consistent


def test_positions_are_weighed_by_their_variances() -> None:
    near, far = Covariance.of(xyz=1.0, rpy=0.01), Covariance.of(xyz=2.0, rpy=0.01)
    fused = fuse(answers_of(("map", "a", Transform(), near), ("map", "b", Transform((10.0, 0.0, 0.0)), far)))
    # The weights are 1 / 1 and 1 / 4; the residual has the variance 1 + 4.
    assert fused.transform.translation == pytest.approx((2.0, 0.0, 0.0))
    assert fused.covariance.sigmas[:3] == pytest.approx([math.sqrt(0.8)] * 3)
    assert fused.total == pytest.approx(100.0 / 5.0)
    assert not fuse(
        answers_of(("map", "a", Transform(), near), ("map", "b", Transform((20.0, 0.0, 0.0)), far))
    ).consistent


def test_an_error_that_the_answers_share_stays_in_the_fused_one() -> None:
    of_map, seen = Covariance.of(xyz=0.3, rpy=0.01), Covariance.of(xyz=0.4, rpy=0.01)
    base = ("map", "base", Transform(), of_map)
    fused = fuse(answers_of(base, ("base", "a", Transform(), seen), ("base", "b", Transform(), seen)))
    assert fused.covariance.sigmas[0] == pytest.approx(math.sqrt(0.09 + 0.16 / 2.0))


def test_the_fused_answer_has_the_error_that_it_says() -> None:
    rng = np.random.default_rng(3)
    answers, truth, totals = [], [], []
    for _ in range(150):
        true, edges = random_transform(rng), []
        for name in "ab":
            # So small that first order holds in the surest direction, too.
            matrix = random_covariance(rng, 0.002, 0.001)
            seen = disturbed(true, -rng.standard_normal((1, 6)) @ root(matrix).T)[0]
            edges.append(("map", name, Transform.from_matrix(seen), Covariance(matrix)))
        fused = fuse(answers_of(*edges))
        totals.append(fused.total)
        answers += answers_of(("map", "fused", fused.transform, fused.covariance))
        truth.append(true)
    assert nees(answers, truth, confidence=0.999).consistent
    # A chi-squared variable of six degrees of freedom has the mean 6 and the variance 12.
    assert np.mean(totals) == pytest.approx(6.0, abs=4.0 * math.sqrt(12.0 / len(totals)))


def test_answers_that_cannot_be_weighed_are_refused() -> None:
    error = Covariance.of(xyz=0.1, rpy=0.01)
    (answer,) = answers_of(("map", "a", Transform(), error))
    (flat,) = answers_of(("map", "b", Transform(), Covariance.of(xyz=(0.1, 0.1, 0.0), rpy=0.01)))
    (other,) = answers_of(("odom", "c", Transform(), error), target="odom")
    for answers, why in (
        ([], "no answer to fuse"),
        ([answer, flat], "counts as exact"),
        ([answer, answer], "two have the same error"),
        ([answer, other], "seen from one frame, not from 'map' and 'odom'"),
    ):
        with pytest.raises(ValueError, match=why):
            fuse(answers)
    with pytest.raises(ValueError, match="confidence"):
        fuse([answer], confidence=95.0)
    with pytest.raises(TypeError, match="covariance=True"):
        fuse([TransformStamped("map", "a", 0, Transform())])  # type: ignore[list-item]
    assert fuse([answer]).transform == answer.transform
    assert joint([answer]).covariance == pytest.approx(fuse([answer]).covariance.matrix)

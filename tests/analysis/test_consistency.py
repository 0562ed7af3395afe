"""`nees`: bounds by closed forms and tables, and the verdict on answers of known error."""

import math

import numpy as np
import pytest
from support.worlds import disturbed, random_covariance, random_transform, root

from tfbus import Covariance, Transform, TransformTree, UncertainSample, UncertainTransform
from tfbus.analysis import Consistency, nees
from tfbus.analysis.consistency import quantile


def answers_with(
    rng: np.random.Generator, said: float, count: int = 200
) -> tuple[list[UncertainTransform], list[Transform]]:
    """Answers across two edges that say `said` times their true standard deviations, and the truth."""
    answers, truth = [], []
    for _ in range(count):
        tree, true = TransformTree(), np.eye(4)
        for parent, child in (("a", "b"), ("b", "c")):
            transform, matrix = random_transform(rng), random_covariance(rng, 0.05, 0.02)
            error = Covariance(said * said * matrix)
            tree.insert(UncertainSample(parent, child, 0, transform, static=True, covariance=error))
            true = true @ disturbed(transform, rng.standard_normal((1, 6)) @ root(matrix).T)[0]
        answers.append(tree.lookup("a", "c", covariance=True))
        truth.append(Transform.from_matrix(true))
    return answers, truth


@pytest.mark.parametrize(("said", "verdict"), [(1.0, "consistent"), (0.8, "too sure"), (1.25, "not sure enough")])
def test_answers_that_know_their_error_pass_and_others_do_not(said: float, verdict: str) -> None:
    answers, truth = answers_with(np.random.default_rng(1), said)
    found = nees(answers, truth)
    assert str(found).startswith(verdict)
    assert found.consistent == (verdict == "consistent")
    assert found.ratio == pytest.approx(1.0 / said**2, rel=0.1)
    assert found.degrees.tolist() == [6] * len(answers)


def test_a_single_error_is_measured_in_standard_deviations_of_its_own_axis() -> None:
    tree = TransformTree()
    error = Covariance.of(xyz=(0.1, 0.2, 0.0), rpy=(0.0, 0.0, 0.01))
    tree.insert(UncertainSample("map", "base", 0, Transform((1.0, 0.0, 0.0)), static=True, covariance=error))
    answer = tree.lookup("map", "base", covariance=True)

    def of(*xyz: float, yaw: float = 0.0) -> Consistency:
        return nees([answer], [Transform.from_xyz_rpy((1.0 + xyz[0], *xyz[1:]), (0.0, 0.0, yaw))])

    assert of(0.3, 0.4, 0.0, yaw=-0.02).total == pytest.approx(9.0 + 4.0 + 4.0)
    assert of(0.3, 0.4, 0.0).degrees.tolist() == [3]
    assert of(0.0, 0.0, 0.1).total == math.inf
    assert not of(0.0, 0.0, 0.1).consistent


@pytest.mark.parametrize(
    ("probability", "degrees", "value"),
    # Abramowitz and Stegun, table 26.8; and for two degrees of freedom, -2 log(1 - p).
    [(0.975, 6, 14.4494), (0.025, 6, 1.2373), (0.95, 1, 3.8415), (0.5, 2, 2.0 * math.log(2.0)), (0.975, 100, 129.561)],
)
def test_the_bounds_are_quantiles_of_chi_squared(probability: float, degrees: int, value: float) -> None:
    assert quantile(probability, degrees) == pytest.approx(value, rel=1e-4)


def test_a_truth_is_needed_for_each_answer() -> None:
    answers, truth = answers_with(np.random.default_rng(2), 1.0, 2)
    with pytest.raises(ValueError, match="shorter"):
        nees(answers, truth[:1])
    with pytest.raises(ValueError, match="confidence"):
        nees(answers, truth, confidence=95.0)

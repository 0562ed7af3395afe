from dataclasses import astuple

import numpy as np
import pytest

from tfbus.analysis import PoseErrors, Statistics


def test_statistics_are_those_of_the_values() -> None:
    errors = PoseErrors(np.arange(4), np.array([1.0, 2.0, 3.0, 6.0]), np.zeros(4))
    translation, rotation = errors.statistics()
    assert astuple(translation) == pytest.approx((12.5**0.5, 3.0, 2.5, 3.5**0.5, 1.0, 6.0))
    assert rotation == Statistics(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

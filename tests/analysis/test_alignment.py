import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tfbus import Transform
from tfbus.analysis import Alignment

number = st.floats(-10.0, 10.0)
CORNERS = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0]])


@given(place=st.tuples(number, number, number), angles=st.tuples(number, number, number), scale=st.floats(0.1, 10.0))
def test_the_motion_between_two_point_sets_is_found(
    place: tuple[float, float, float], angles: tuple[float, float, float], scale: float
) -> None:
    motion = Transform.from_xyz_rpy(place, angles)
    found = Alignment.between(CORNERS, motion.apply(scale * CORNERS), with_scale=True)
    assert found.scale == pytest.approx(scale)
    assert found.transform.apply(found.scale * CORNERS) == pytest.approx(motion.apply(scale * CORNERS), abs=1e-9)


def test_a_mirrored_set_is_rotated_and_not_mirrored() -> None:
    found = Alignment.between(CORNERS, CORNERS * [1.0, 1.0, -1.0])
    assert np.linalg.det(found.transform.matrix()[:3, :3]) == pytest.approx(1.0)


def test_points_on_a_line_determine_nothing() -> None:
    line = np.outer(np.arange(5.0), [1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match="on a line"):
        Alignment.between(line, line)

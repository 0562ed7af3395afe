"""Axes of other worlds: the tables of REP 103, an aircraft's attitude, and the mirror images of left-handed worlds."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.strategies import transforms

from tfbus import Transform
from tfbus.axes import (
    BODY_FROM_OPTICAL,
    ENU_FROM_NED,
    FLU_FROM_FRD,
    FRD_FROM_FLU,
    NED_FROM_ENU,
    OPTICAL_FROM_BODY,
    UNITY,
    UNREAL,
    LeftHandedWorld,
)

# Each with the three numbers that it makes of (1, 2, 3), by the names of the axes.
TABLE = [
    (NED_FROM_ENU, (2.0, 1.0, -3.0)),
    (ENU_FROM_NED, (2.0, 1.0, -3.0)),
    (FRD_FROM_FLU, (1.0, -2.0, -3.0)),
    (FLU_FROM_FRD, (1.0, -2.0, -3.0)),
    (OPTICAL_FROM_BODY, (-2.0, -3.0, 1.0)),
    (BODY_FROM_OPTICAL, (3.0, -1.0, -2.0)),
]


@pytest.mark.parametrize(("transform", "moved"), TABLE)
def test_axes_are_exchanged_as_their_names_say(transform: Transform, moved: tuple[float, ...]) -> None:
    assert transform.apply((1.0, 2.0, 3.0)) == pytest.approx(moved, abs=1e-15)


@pytest.mark.parametrize(
    ("there", "back"),
    [(NED_FROM_ENU, ENU_FROM_NED), (FRD_FROM_FLU, FLU_FROM_FRD), (OPTICAL_FROM_BODY, BODY_FROM_OPTICAL)],
)
def test_there_and_back_is_the_identity(there: Transform, back: Transform) -> None:
    assert (there @ back).is_close(Transform.identity(), rotation_tolerance=1e-15)
    assert (there @ back).rotation[3] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("enu", "ned"),
    [
        # Roll, pitch and yaw in degrees. Level and to the north; level and to the east; nose up by 10 degrees, to the
        # north; right wing down by 20 degrees, to the south.
        ((0.0, 0.0, 90.0), (0.0, 0.0, 0.0)),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 90.0)),
        ((0.0, -10.0, 90.0), (0.0, 10.0, 0.0)),
        ((20.0, 0.0, -90.0), (20.0, 0.0, 180.0)),
    ],
)
def test_an_attitude_changes_on_both_sides(enu: tuple[float, ...], ned: tuple[float, ...]) -> None:
    enu_from_flu = Transform.from_xyz_rpy((0.0, 0.0, 0.0), enu, degrees=True)
    ned_from_frd = NED_FROM_ENU @ enu_from_flu @ FLU_FROM_FRD
    assert ned_from_frd.is_close(Transform.from_xyz_rpy((0.0, 0.0, 0.0), ned, degrees=True))
    assert (ENU_FROM_NED @ ned_from_frd @ FRD_FROM_FLU).is_close(enu_from_flu)


@pytest.mark.parametrize(
    ("world", "moved"), [(UNITY, (-2.0, 3.0, 1.0)), (UNREAL, (100.0, -200.0, 300.0))], ids=["unity", "unreal"]
)
def test_points_of_a_left_handed_world(world: LeftHandedWorld, moved: tuple[float, ...]) -> None:
    assert world.points((1.0, 2.0, 3.0)) == pytest.approx(moved)
    assert world.points_back([moved, moved]) == pytest.approx(np.array([[1.0, 2.0, 3.0]] * 2))
    # A mirrored triangle whose corners are in the other order has the mirrored normal.
    corners = np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)])
    first, second, third = world.points(corners)[world.triangles([(0, 1, 2)])[0]]
    normal = np.cross(second - first, third - first)
    assert normal / np.linalg.norm(normal) == pytest.approx(world.points((0.0, 0.0, 1.0)) / world.units)


@given(transforms(10.0), transforms(10.0), st.sampled_from([UNITY, UNREAL]))
def test_a_pose_of_a_left_handed_world_moves_its_points_as_ours_moves_ours(
    pose: Transform, point: Transform, world: LeftHandedWorld
) -> None:
    position, rotation = world.pose(pose)
    # The arithmetic of quaternions is the same in both worlds.
    moved = Transform(position, rotation).apply(world.points(point.translation))
    assert moved == pytest.approx(world.points(pose.apply(point.translation)), abs=1e-9 * world.units)
    assert world.pose_back(position, rotation).is_close(pose, translation_tolerance=1e-12)

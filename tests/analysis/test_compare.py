"""Errors of one trajectory against another, by closed forms and by evo."""

import math
from dataclasses import astuple
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.samples import moving, static, tree_of

from tfbus import SECOND, DisconnectedError, Transform, TransformStamped, TransformTree
from tfbus.analysis import Alignment, PoseErrors, Statistics, compare
from tfbus.stamps import STAMP_MAX, STAMP_MIN

MS = SECOND // 1_000


def tree(poses: list[tuple[int, Transform]]) -> TransformTree:
    return tree_of(*(TransformStamped("map", "base", stamp, pose) for stamp, pose in poses), keep=None)


def helix(count: int = 50, offset: Transform | None = None, scale: float = 1.0, late: int = 0) -> TransformTree:
    """A trajectory in space, moved as a whole by an offset after it was scaled."""
    moved = Transform() if offset is None else offset
    poses = []
    for k in range(count):
        angle = 0.1 * k
        at = (scale * math.cos(angle), scale * math.sin(angle), scale * 0.02 * k)
        poses.append((k * 100 * MS + late, moved @ Transform.from_xyz_rpy(at, (0.0, 0.0, angle))))
    return tree(poses)


def test_a_trajectory_has_no_error_to_itself() -> None:
    found = compare(helix(), helix(), "map", "base")
    assert (found.poses, found.of, found.alignment) == (50, (50, 50), None)
    for errors in (found.absolute, found.relative):
        assert errors.translation.max() == pytest.approx(0.0, abs=1e-15)
        assert errors.rotation.max() == pytest.approx(0.0, abs=1e-15)
    assert (len(found.absolute.stamps), len(found.relative.stamps)) == (50, 49)


def test_an_offset_is_an_absolute_error_and_no_relative_one_and_alignment_takes_it_away() -> None:
    offset = Transform.from_xyz_rpy((3.0, 4.0, 0.0), (0.0, 0.0, 0.0))
    found = compare(helix(), helix(offset=offset), "map", "base")
    translation, rotation = found.absolute.statistics()
    assert (translation.rmse, translation.mean, translation.min, translation.max) == pytest.approx((5.0,) * 4)
    assert (rotation.max, found.relative.translation.max()) == pytest.approx((0.0, 0.0), abs=1e-12)
    turned = Transform.from_xyz_rpy((3.0, 4.0, 5.0), (0.1, 0.2, 2.0))
    aligned = compare(helix(), helix(offset=turned), "map", "base", align=True)
    assert aligned.absolute.translation.max() == pytest.approx(0.0, abs=1e-12)
    assert aligned.absolute.rotation.max() == pytest.approx(0.0, abs=1e-7)
    assert aligned.alignment is not None
    assert aligned.alignment.scale == 1.0
    assert (aligned.alignment.transform @ turned).is_close(Transform())


def test_a_scale_is_found_if_it_is_wanted() -> None:
    scaled = helix(scale=2.0)
    assert compare(helix(), scaled, "map", "base", align=True).absolute.translation.max() > 0.5
    found = compare(helix(), scaled, "map", "base", align=True, scale=True)
    assert found.alignment is not None
    assert found.alignment.scale == pytest.approx(0.5)
    assert found.absolute.translation.max() == pytest.approx(0.0, abs=1e-12)


def test_a_drift_is_a_relative_error_over_the_steps() -> None:
    wanted = tree([(k * SECOND, Transform((float(k), 0.0, 0.0))) for k in range(7)])
    found = tree([(k * SECOND, Transform.from_xyz_rpy((1.1 * k, 0.0, 0.0), (0.01 * k, 0.0, 0.0))) for k in range(7)])
    one, two = (compare(wanted, found, "map", "base", delta=delta).relative for delta in (1, 2))
    assert one.translation == pytest.approx([0.1] * 6)
    assert one.rotation == pytest.approx([0.01] * 6)
    assert two.translation == pytest.approx([0.2] * 3)
    assert two.stamps.tolist() == [2 * SECOND, 4 * SECOND, 6 * SECOND]


def test_poses_are_compared_with_the_nearest_in_time_within_the_limit() -> None:
    wanted = tree([(k * 100 * MS, Transform((float(k), 0.0, 0.0))) for k in range(4)])
    stamps = [8, 95, 111, 195, 205, 300]
    found = tree([(stamp * MS, Transform((float(at), 0.0, 0.0))) for at, stamp in enumerate(stamps)])
    # The earlier one of two poses that are equally near is taken; the shorter trajectory leads.
    both = [compare(*pair, "map", "base") for pair in ((wanted, found), (found, wanted))]
    assert both[0].absolute.stamps.tolist() == [k * 100 * MS for k in range(4)]
    assert both[1].absolute.stamps.tolist() == [stamp * MS for stamp in (8, 95, 195, 300)]
    assert both[0].absolute.translation.tolist() == both[1].absolute.translation.tolist() == [0.0, 0.0, 1.0, 2.0]
    assert compare(wanted, found, "map", "base", max_difference=0.0).poses == 1


def test_poses_that_are_centuries_apart_do_not_belong_together() -> None:
    with pytest.raises(ValueError, match="no pose of 'base' in 'map' is at the same stamp"):
        compare(tree([(STAMP_MIN, Transform())]), tree([(STAMP_MAX, Transform())]), "map", "base")


def test_the_densest_edge_gives_the_stamps() -> None:
    def chained(late: int) -> TransformTree:
        slow = [moving("map", "odom", k * SECOND, float(k)) for k in range(5)]
        fast = [moving("odom", "base", k * 100 * MS, 0.0) for k in range(late, 50)]
        return tree_of(*slow, *fast, static("base", "laser", 1.0), keep=None)

    found = compare(chained(0), chained(0), "map", "laser")
    # After 4 s, there is no answer.
    assert found.poses == 41
    assert compare(chained(0), chained(10), "map", "laser").of == (41, 31)


def test_what_cannot_be_compared_is_an_error() -> None:
    with pytest.raises(ValueError, match=r"within 0.01 s: 50 from 0.000 s to 4.900 s in the reference, 50 from 50.000"):
        compare(helix(), helix(late=50 * SECOND), "map", "base")
    with pytest.raises(ValueError, match="'laser' does not move in 'base'"):
        compare(tree_of(static("base", "laser")), helix(), "base", "laser")
    with pytest.raises(DisconnectedError):
        compare(tree_of(static("a", "b"), static("c", "d")), helix(), "a", "d")
    line = tree([(k * SECOND, Transform((float(k), 0.0, 0.0))) for k in range(9)])
    with pytest.raises(ValueError, match="their points lie on a line"):
        compare(line, line, "map", "base", align=True)
    for wrong in ({"delta": 0}, {"max_difference": -1.0}):
        with pytest.raises(ValueError, match="must"):
            compare(line, line, "map", "base", **wrong)
    single = tree([(0, Transform())])
    with pytest.raises(ValueError, match="a step needs two poses"):
        compare(single, single, "map", "base").relative.statistics()


@given(angles=st.lists(st.floats(-3.1, 3.1), min_size=2, max_size=9))
def test_rotation_errors_are_the_angles_between(angles: list[float]) -> None:
    wanted = tree([(k * SECOND, Transform((float(k), 0.0, 0.0))) for k in range(len(angles))])
    found = tree(
        [(k * SECOND, Transform.from_axis_angle((1, 2, 3), a, (float(k), 0.0, 0.0))) for k, a in enumerate(angles)]
    )
    errors = compare(wanted, found, "map", "base").absolute
    assert errors.rotation == pytest.approx(np.abs(angles), abs=1e-12)


@pytest.mark.thorough
@pytest.mark.parametrize("align", [False, True])
@pytest.mark.parametrize("scale", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_the_errors_are_those_of_evo(tmp_path: Path, seed: int, align: bool, scale: bool) -> None:
    metrics = pytest.importorskip("evo.core.metrics")
    from evo.core import sync
    from evo.tools import file_interface

    rng = np.random.default_rng(seed)
    trees, trajectories = [], []
    for name, count in (("reference", 200), ("estimate", 230)):
        stamps = np.sort(rng.choice(20_000, count, replace=False)) * MS
        places = np.cumsum(rng.normal(size=(count, 3)), axis=0)
        turns = rng.normal(size=(count, 4))
        turns /= np.linalg.norm(turns, axis=1)[:, None]
        poses = [Transform(place, turn) for place, turn in zip(places.tolist(), turns.tolist(), strict=True)]
        trees.append(tree(list(zip(stamps.tolist(), poses, strict=True))))
        path = tmp_path / name
        lines = [
            (f"{stamp / SECOND:.9f}", *pose.translation, *pose.rotation)
            for stamp, pose in zip(stamps, poses, strict=True)
        ]
        path.write_text("\n".join(" ".join(map(str, line)) for line in lines))
        trajectories.append(file_interface.read_tum_trajectory_file(path))
    ours = compare(trees[0], trees[1], "map", "base", align=align, scale=scale and align, max_difference=0.0505)
    pair = sync.associate_trajectories(*trajectories, max_diff=0.0505)
    if align:
        pair[1].align(pair[0], correct_scale=scale)
    assert ours.poses == pair[0].num_poses > 20
    for kind, errors in ((metrics.APE, ours.absolute), (metrics.RPE, ours.relative)):
        for relation, values in (
            (metrics.PoseRelation.translation_part, errors.translation),
            (metrics.PoseRelation.rotation_angle_rad, errors.rotation),
        ):
            metric = kind(relation)
            metric.process_data(pair)
            assert values == pytest.approx(metric.error, abs=1e-9)
    statistics, _ = ours.absolute.statistics()
    metric = metrics.APE(metrics.PoseRelation.translation_part)
    metric.process_data(pair)
    theirs = metric.get_all_statistics()
    for key in ("rmse", "mean", "median", "std", "min", "max"):
        assert getattr(statistics, key) == pytest.approx(theirs[key], abs=1e-9)


number = st.floats(-10.0, 10.0)
CORNERS = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0]])


def test_a_mirrored_set_is_rotated_and_not_mirrored() -> None:
    found = Alignment.between(CORNERS, CORNERS * [1.0, 1.0, -1.0])
    assert np.linalg.det(found.transform.matrix()[:3, :3]) == pytest.approx(1.0)


def test_statistics_are_those_of_the_values() -> None:
    errors = PoseErrors(np.arange(4), np.array([1.0, 2.0, 3.0, 6.0]), np.zeros(4))
    translation, rotation = errors.statistics()
    assert astuple(translation) == pytest.approx((12.5**0.5, 3.0, 2.5, 3.5**0.5, 1.0, 6.0))
    assert rotation == Statistics(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

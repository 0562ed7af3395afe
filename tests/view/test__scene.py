import math

import numpy as np
import pytest
from support.samples import moving, over, static, tree_of

from tfbus import LATEST, SECOND, Latest, Transform, TransformStamped, TransformTree
from tfbus.errors import UnknownFrameError
from tfbus.tree.history import EdgeState
from tfbus.tree.tree import forest_of
from tfbus.view.page import NO_SCENE, Scene, SceneReader, largest_root


def read(
    tree: TransformTree, fixed: str = "map", at: int | Latest = LATEST, now: int = 0, selected: str | None = None
) -> Scene:
    return SceneReader(forest_of(tree), stale_after=1.0).read(fixed, at, now, selected)


def states(scene: Scene) -> dict[str, EdgeState]:
    return dict(zip(scene.frames, scene.states, strict=True))


def test_no_scene_has_nothing_to_draw() -> None:
    assert {len(part) for part in NO_SCENE} == {0}
    some = read(tree_of(moving("map", "base", 0)), selected="base")
    for none, one in zip(NO_SCENE, some, strict=True):
        if isinstance(none, np.ndarray) and isinstance(one, np.ndarray):
            assert (none.shape[1:], none.dtype) == (one.shape[1:], one.dtype)


def test_poses_are_positions_and_quaternions_with_w_first() -> None:
    tree = TransformTree()
    tree.insert(TransformStamped("map", "base", 0, Transform.from_xyz_rpy((1, 2, 3), (0, 0, math.pi / 2))))
    scene = read(tree)
    assert scene.frames == ("map", "base")
    assert scene.positions.tolist() == [[0, 0, 0], [1, 2, 3]]
    assert scene.wxyzs[1] == pytest.approx([math.sqrt(0.5), 0, 0, math.sqrt(0.5)])


def test_a_line_goes_from_each_frame_to_its_parent_in_the_colour_of_the_frame() -> None:
    scene = read(tree_of(moving("map", "odom", 0, 1.0), static("odom", "base", 2.0)), fixed="odom")
    assert scene.frames == ("odom", "base", "map")
    # From odom to map, and from base to odom.
    assert scene.lines[:, :, 0].tolist() == [[0, -1], [2, 0]]
    green, blue = [0x00, 0x9E, 0x73], [0x00, 0x72, 0xB2]
    assert scene.line_colours.tolist() == [[green, green], [blue, blue]]
    assert scene.colours.tolist() == [green, blue, blue]
    assert scene.parents.tolist() == [2, 0, -1]


def test_live_frames_are_stale_by_the_clock() -> None:
    tree = tree_of(moving("map", "old", 0), moving("map", "new", SECOND), static("map", "anchor"))
    assert states(read(tree, now=SECOND + 1)) == {
        "map": EdgeState.STATIC,
        "old": EdgeState.STALE,
        "new": EdgeState.MOVING,
        "anchor": EdgeState.STATIC,
    }
    assert states(read(tree, now=SECOND))["old"] is EdgeState.MOVING


def test_at_a_chosen_stamp_frames_are_stale_by_that_stamp() -> None:
    tree = tree_of(*over("map", "base", (0, 9 * SECOND)))
    far = 100 * SECOND
    assert states(read(tree, at=SECOND, now=far))["base"] is EdgeState.MOVING
    assert states(read(tree, at=2 * SECOND, now=far))["base"] is EdgeState.STALE
    assert states(read(tree, at=9 * SECOND, now=far))["base"] is EdgeState.MOVING
    assert states(read(tree, at=-SECOND, now=far))["base"] is EdgeState.SILENT


def test_frames_without_a_pose_are_not_drawn_but_the_others_are() -> None:
    tree = tree_of(moving("map", "base", 0), static("base", "lidar"), static("map", "anchor", 1.0))
    tree.clear()
    scene = read(tree)
    assert scene.frames == ("map", "anchor")
    assert scene.lines[:, :, 0].tolist() == [[1, 0]]
    assert scene.place("anchor") == 1
    assert scene.place("lidar") is None


def test_the_chain_of_the_selected_frame_leads_to_the_fixed_one() -> None:
    tree = tree_of(static("map", "a", 1.0), static("a", "b", 1.0), static("map", "c", -1.0), static("c", "d", -1.0))
    assert read(tree, "d", selected="b").chain == ("b", "a", "map", "c", "d")
    assert read(tree, "map", selected="b").chain == ("b", "a", "map")
    assert read(tree, "b", selected="map").chain == ("map", "a", "b")
    assert read(tree, "a", selected="b").chain == ("b", "a")
    assert read(tree, "a", selected="a").chain == ("a",)
    assert read(tree, "map", selected="b").chain_lines[:, :, 0].tolist() == [[2, 1], [1, 0]]


@pytest.mark.parametrize("selected", [None, "nobody"])
def test_without_a_selected_frame_there_is_no_chain(selected: str | None) -> None:
    scene = read(tree_of(static("map", "a")), selected=selected)
    assert scene.chain == ()
    assert scene.chain_lines.shape == (0, 2, 3)


def test_positions_far_away_are_exact_in_a_fixed_frame_that_is_near() -> None:
    tree = tree_of(static("map", "site", 4e8), static("site", "base", 0.001))
    assert read(tree, "site").positions[1, 0] == np.float32(0.001)


def test_an_unknown_fixed_frame_is_an_error() -> None:
    with pytest.raises(UnknownFrameError):
        read(tree_of(static("map", "a")), "mop")


def test_the_largest_root_has_the_most_frames_below_it_and_of_equals_the_first_by_name() -> None:
    small = [static("world", "a")]
    large = [static("map", "b"), static("b", "c")]
    assert largest_root(forest_of(tree_of(*small, *large))) == "map"
    assert largest_root(forest_of(tree_of(*small, static("map", "b")))) == "map"
    assert largest_root(forest_of(tree_of(static("world", "a"), static("zoo", "b")))) == "world"
    assert largest_root(forest_of(TransformTree())) is None

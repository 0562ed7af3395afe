from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("viser", reason="the live page needs viser")

from support.samples import static, tree_of
from support.viser_pages import viser_page

from tfbus import Transform, TransformStamped
from tfbus.robot import Box, Sphere, Visual
from tfbus.view.meshes import MeshFiles, solids_of
from tfbus.view.page import Page
from tfbus.view.screen import Solids

VISUALS = [
    Visual("base", Box((1.0, 2.0, 3.0)), Transform((0.0, 0.0, 0.5)), (1.0, 0.0, 0.0, 1.0)),
    Visual("tool", Sphere(0.5)),
    Visual("tool", Box((0.1, 0.1, 0.1)), Transform((1.0, 0.0, 0.0))),
]


def test_shapes_are_drawn_at_their_links_one_object_for_equal_triangles() -> None:
    tree = tree_of(static("map", "base", 2.0))
    turned = Transform((0.0, 0.0, 0.0), (2 / 9, 4 / 9, 5 / 9, 6 / 9))
    tree.insert(TransformStamped("base", "tool", 0, turned, static=True))
    page = Page(tree)
    with viser_page() as server:
        solids = Solids(server, solids_of(VISUALS, MeshFiles((), Path())))
        solids.draw(page.picture(0).scene)
        boxes, spheres = solids._handles
        assert boxes is not None
        assert spheres is not None
        # The box of the tool is 1 m along x of the tool: the first column of the matrix of (2, 4, 5, 6) / 9.
        x, y, z = 1 - 2 * (4 * 4 + 5 * 5) / 81, 2 * (2 * 4 + 5 * 6) / 81, 2 * (2 * 5 - 4 * 6) / 81
        positions = np.array([[2.0, 0.0, 0.5], [2.0 + x, y, z]])
        assert boxes.batched_positions == pytest.approx(positions, abs=1e-6)
        assert boxes.batched_wxyzs[1] == pytest.approx([6 / 9, 2 / 9, 4 / 9, 5 / 9])
        assert boxes.batched_scales == pytest.approx(np.array([[1.0, 2.0, 3.0], [0.1, 0.1, 0.1]]))
        assert boxes.batched_colors.tolist()[0] == [255, 0, 0]
        assert spheres.batched_positions.tolist() == [[2.0, 0.0, 0.0]]
        tree.insert(static("map", "base", 3.0))
        solids.draw(page.picture(0).scene)
        assert spheres.batched_positions.tolist() == [[3.0, 0.0, 0.0]]


def test_the_root_may_have_a_shape() -> None:
    page = Page(tree_of(static("base", "tool", 1.0)))
    with viser_page() as server:
        solids = Solids(server, solids_of(VISUALS[:1], MeshFiles((), Path())))
        solids.draw(page.picture(0).scene)
        assert solids._handles[0] is not None
        assert solids._handles[0].batched_positions.tolist() == [[0.0, 0.0, 0.5]]


def test_shapes_of_links_without_a_pose_and_of_a_hidden_robot_are_left_out() -> None:
    tree = tree_of(static("map", "base", 2.0), static("base", "tool", 1.0))
    page = Page(tree)
    with viser_page() as server:
        solids = Solids(server, solids_of(VISUALS, MeshFiles((), Path())))
        solids.draw(page.picture(0).scene)
        tree.remove_frame("tool")
        solids.draw(page.picture(0).scene)
        boxes, spheres = solids._handles
        assert boxes is not None
        assert len(boxes.batched_positions) == 1
        assert spheres is None
        solids.opacity = 0.0
        solids.draw(page.picture(0).scene)
        assert solids._handles == [None, None]
        solids.opacity = 0.25
        solids.draw(page.picture(0).scene)
        assert solids._handles[0] is not None
        assert solids._handles[0].opacity == 0.25

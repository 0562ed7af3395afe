import math
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("viser", reason="the live page needs viser")

from support.samples import moving, static, tree_of
from support.viser_pages import viser_page

from tfbus import LATEST, PointCloud
from tfbus.view import meshes
from tfbus.view.page import Page
from tfbus.view.screen import HIGHLIGHT, TRAIL, Canvas


def test_what_stands_out_has_colours_of_the_palette_of_okabe_and_ito() -> None:
    orange, purple = tuple(bytes.fromhex("e69f00")), tuple(bytes.fromhex("cc79a7"))
    assert (orange, purple, purple) == (HIGHLIGHT, TRAIL, meshes._PLACEHOLDER_COLOUR)
    assert len(set(meshes._NO_COLOUR)) == 1, "it is a grey"


def test_axes_dots_and_lines_are_where_the_scene_has_them() -> None:
    tree = tree_of(moving("map", "base", 0, 1.0), static("base", "lidar", 2.0))
    page = Page(tree)
    page.select("lidar")
    clicked: list[str] = []
    with viser_page() as server:
        canvas = Canvas(server, clicked.append)
        # The same number of frames is updated in place; another one is drawn anew.
        for sample in (None, moving("map", "base", 1, 5.0), static("base", "arm", 1.0)):
            if sample is not None:
                tree.insert(sample)
            picture = page.picture(0)
            canvas.draw(picture, 0.2)
            axes, dots = canvas._axes, canvas._dots
            assert axes is not None
            assert dots is not None
            assert np.array_equal(axes.batched_positions, picture.scene.positions)
            assert np.array_equal(axes.batched_wxyzs, picture.scene.wxyzs)
            assert np.array_equal(dots.batched_positions, picture.scene.positions)
            assert np.array_equal(dots.batched_colors, picture.scene.colours)
            assert np.array_equal(canvas._lines.points, picture.scene.lines)
            assert np.array_equal(canvas._lines.colors, picture.scene.line_colours)
            assert np.array_equal(canvas._chain.points, picture.scene.chain_lines)
            assert axes.axes_length == pytest.approx(0.2)
        canvas.draw(picture, 0.4)
        assert canvas._axes is not axes
        for place in (3, None, 99, 0):
            canvas._on_click(SimpleNamespace(instance_index=place))
    assert clicked == [picture.scene.frames[3], "map"]


def test_a_dot_is_a_regular_icosahedron_whose_faces_look_outward() -> None:
    with viser_page() as server:
        canvas = Canvas(server, print)
        canvas.draw(Page(tree_of(static("map", "base"))).picture(0), 0.2)
        assert canvas._dots is not None
        vertices, faces = canvas._dots.vertices, canvas._dots.faces
    assert (vertices.shape, faces.shape) == ((12, 3), (20, 3))
    radius = float(np.linalg.norm(vertices[0]))
    assert np.linalg.norm(vertices, axis=1) == pytest.approx(np.full(12, radius))
    edges = {(face[at - 1], face[at]) for face in faces.tolist() for at in range(3)}
    assert len(edges) == 60, "each edge belongs to two faces, once in each direction"
    assert edges == {(end, begin) for begin, end in edges}
    edge = radius / math.sin(2.0 * math.pi / 5.0)
    volume = np.linalg.det(vertices[faces].astype(np.float64)).sum() / 6.0
    assert volume == pytest.approx(5.0 / 12.0 * (3.0 + math.sqrt(5.0)) * edge**3, rel=1e-6)


def test_the_shapes_of_a_robot_are_drawn_with_each_picture() -> None:
    page = Page(tree_of(moving("map", "base", 0, 1.0)))
    drawn: list[object] = []
    with viser_page() as server:
        canvas = Canvas(server, print)
        canvas.draw(page.picture(0), 0.2)
        canvas.show_solids(SimpleNamespace(draw=drawn.append))  # type: ignore[arg-type]
        for _ in range(2):
            picture = page.picture(0)
            canvas.draw(picture, 0.2)
            assert drawn.pop() is picture.scene
    assert drawn == []


def test_labels_follow_their_frames_and_hide_when_they_are_not_wanted() -> None:
    tree = tree_of(moving("map", "base", 0, 1.0))
    page = Page(tree)
    page.labels = "all"
    with viser_page() as server:
        canvas = Canvas(server, print)
        canvas.draw(page.picture(0), 0.2)
        tree.insert(moving("map", "base", 1, 4.0))
        canvas.draw(page.picture(0), 0.2)
        assert [(label.text, label.position[0], label.visible) for label in canvas._labels] == [
            ("map", 0.0, True),
            ("base", 4.0, True),
        ]
        page.labels = "selection"
        page.select("map")
        canvas.draw(page.picture(0), 0.2)
        assert [label.visible for label in canvas._labels] == [True, False]


def test_points_are_moved_hidden_replaced_and_removed() -> None:
    cloud = PointCloud("map", LATEST, np.array([[0.0, 1.0, 2.0], [np.nan, 0.0, 0.0], [3.0, 4.0, 5.0]]))
    colours = np.array([[1, 1, 1], [2, 2, 2], [3, 3, 3]], np.uint8)
    with viser_page() as server:
        canvas = Canvas(server, print)
        canvas.add_points("scan", cloud, 0.05, colours)
        canvas.add_points("other", cloud, 0.05, (9, 9, 9))
        first = canvas._clouds["scan"]
        assert first.points.tolist() == [[0, 1, 2], [3, 4, 5]]
        assert first.colors.tolist() == [[1, 1, 1], [3, 3, 3]]
        assert not first.visible
        canvas.place_points("scan", (1.0, 2.0, 3.0, 0.1, 0.2, 0.3, 0.9))
        assert first.visible
        assert (first.position.tolist(), first.wxyz.tolist()) == ([1, 2, 3], [0.9, 0.1, 0.2, 0.3])
        canvas.place_points("scan", None)
        assert not first.visible
        canvas.remove_points("scan")
        canvas.add_points("third", cloud, 0.05, (9, 9, 9))
        names = [cloud.name for cloud in canvas._clouds.values()]
        assert len(set(names)) == 2
        canvas.add_points("other", cloud, 0.1, (9, 9, 9))
        assert canvas._clouds["other"].name == names[0]

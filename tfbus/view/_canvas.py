"""The 3D part of the page, in viser.

All axes are one object, and so are all lines; a frame of its own in the browser for each would stall it at a thousand.
World poses are computed here, and an object is sent again only if it has changed.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import viser

from tfbus.data import PointCloud
from tfbus.geometry.rows import Row
from tfbus.plain import printable
from tfbus.view._page import Picture
from tfbus.view._scene import NO_SCENE, Scene
from tfbus.view._solids import Solids

HIGHLIGHT = (230, 159, 0)
TRAIL = (204, 121, 167)
_DOT = 0.12
"""Radius of the dot at a frame's origin, relative to the length of its axes."""
_LINES = 2.0
_CHAIN = 5.0
"""Thickness of lines, in pixels."""


class Canvas:
    """Draws pictures into the browsers of a server.

    Parameters
    ----------
    server : viser.ViserServer
    clicked : callable
        Called with the name of a frame that was clicked, in a thread of viser.
    """

    def __init__(self, server: viser.ViserServer, clicked: Callable[[str], object]) -> None:
        self._server = server
        self._clicked = clicked
        self._drawn = Picture(NO_SCENE, (), NO_SCENE.lines)
        self._axes: viser.BatchedAxesHandle | None = None
        self._dots: viser.BatchedMeshHandle | None = None
        self._solids: Solids | None = None
        self._axes_length = 0.0
        self._labels: list[viser.LabelHandle] = []
        self._clouds: dict[str, viser.PointCloudHandle] = {}
        self._clouds_added = 0
        scene = server.scene
        nothing = np.empty((0, 2, 3), np.float32)
        self._lines = scene.add_line_segments(
            "/edges", nothing, np.empty((0, 2, 3), np.uint8), thickness=_LINES, thickness_units="screen"
        )
        self._chain = scene.add_line_segments("/chain", nothing, HIGHLIGHT, thickness=_CHAIN, thickness_units="screen")
        self._trails = scene.add_line_segments("/trails", nothing, TRAIL, thickness=_LINES, thickness_units="screen")

    def show_solids(self, solids: Solids) -> None:
        """Draw a robot's visible shapes from now on."""
        self._solids = solids

    def draw(self, picture: Picture, axes_length: float) -> None:
        """Bring the browsers to a picture, with axes of a length in m."""
        scene, drawn = picture.scene, self._drawn
        self._draw_frames(scene, axes_length)
        # What stays is not given to viser, which would compare it number by number.
        self._lines.points = scene.lines
        if scene.line_colours is not drawn.scene.line_colours:
            self._lines.colors = scene.line_colours
        if scene.chain_lines is not drawn.scene.chain_lines:
            self._chain.points = scene.chain_lines
        if picture.trails is not drawn.trails:
            self._trails.points = picture.trails
        self._drawn = picture
        self._draw_labels(scene, picture.labels)
        if self._solids is not None:
            self._solids.draw(scene)

    def add_points(self, name: str, cloud: PointCloud, size: float, colour: Any) -> None:
        """Add points, or replace those of the same name; they are hidden until they have a pose."""
        points = cloud.points[np.isfinite(cloud.points).all(axis=1)]
        colours = np.asarray(colour)
        if colours.ndim == 2:
            colours = colours[np.isfinite(cloud.points).all(axis=1)]
        if name not in self._clouds:
            self._clouds_added += 1
        # A name may have letters that viser's names give a meaning.
        node = self._clouds[name].name if name in self._clouds else f"/points/{self._clouds_added}"
        self._clouds[name] = self._server.scene.add_point_cloud(
            node,
            points.astype(np.float32),
            colours,
            point_size=size,
            point_shape="circle",
            precision="float32",
            visible=False,
        )

    def place_points(self, name: str, row: Row | None) -> None:
        """Move points to a pose in the fixed frame, or hide them."""
        cloud = self._clouds[name]
        if row is not None:
            x, y, z, qx, qy, qz, qw = row
            cloud.position = (x, y, z)
            cloud.wxyz = (qw, qx, qy, qz)
        cloud.visible = row is not None

    def remove_points(self, name: str) -> None:
        """Remove points."""
        self._clouds.pop(name).remove()

    def _draw_frames(self, scene: Scene, axes_length: float) -> None:
        axes, dots, drawn = self._axes, self._dots, self._drawn.scene
        same = len(scene.frames) == len(drawn.frames) and axes_length == self._axes_length
        if axes is not None and dots is not None and same:
            axes.batched_positions = scene.positions
            axes.batched_wxyzs = scene.wxyzs
            dots.batched_positions = scene.positions
            if scene.colours is not drawn.colours:
                dots.batched_colors = scene.colours
            return
        self._axes_length = axes_length
        # Arrays of another length would reach the browser one after the other.
        self._axes = self._server.scene.add_batched_axes(
            "/axes", scene.wxyzs, scene.positions, axes_length=axes_length, axes_radius=0.04 * axes_length
        )
        sphere = _sphere()
        self._dots = self._server.scene.add_batched_meshes_simple(
            "/origins",
            sphere[0] * (_DOT * axes_length),
            sphere[1],
            np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (len(scene.frames), 1)),
            scene.positions,
            batched_colors=scene.colours,
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
        )
        self._axes.on_click(self._on_click)
        self._dots.on_click(self._on_click)

    def _on_click(self, event: Any) -> None:
        frames, place = self._drawn.scene.frames, event.instance_index
        if place is not None and place < len(frames):
            self._clicked(frames[place])

    def _draw_labels(self, scene: Scene, frames: Sequence[str]) -> None:
        places = {frame: place for place, frame in enumerate(scene.frames)} if frames else {}
        for number, frame in enumerate(frames):
            if number == len(self._labels):
                self._labels.append(self._server.scene.add_label(f"/labels/{number}", printable(frame)))
            label = self._labels[number]
            label.text = printable(frame)
            label.position = scene.positions[places[frame]]
            label.visible = True
        for label in self._labels[len(frames) :]:
            label.visible = False


def _sphere() -> tuple[Any, Any]:
    """The vertices and faces of an icosahedron of radius one."""
    golden = (1.0 + 5.0**0.5) / 2.0
    corners = np.array([(0.0, a, b * golden) for a in (-1.0, 1.0) for b in (-1.0, 1.0)])
    vertices = np.concatenate([np.roll(corners, turn, axis=1) for turn in range(3)])
    vertices /= np.linalg.norm(vertices[0])
    # A face has three corners that are all as near to each other as two corners of the solid ever are.
    near = np.linalg.norm(vertices[:, None] - vertices, axis=2) < 1.1
    faces = [
        (i, j, k)
        for i in range(12)
        for j in range(i + 1, 12)
        for k in range(j + 1, 12)
        if near[i, j] and near[j, k] and near[i, k]
    ]
    outward = [face if np.linalg.det(vertices[list(face)]) > 0.0 else (face[0], face[2], face[1]) for face in faces]
    return vertices.astype(np.float32), np.array(outward, np.uint32)

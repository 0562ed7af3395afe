"""The page in the browsers: it brings canvas and panel to what the page shows at a moment."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import viser

from tfbus.data import PointCloud
from tfbus.errors import TransformLookupError
from tfbus.geometry.rows import Row
from tfbus.stamps import SECOND
from tfbus.view._canvas import Canvas
from tfbus.view._meshes import Solid
from tfbus.view._page import Page, Picture
from tfbus.view._panel import Panel, Post, set_value
from tfbus.view._scene import Scene
from tfbus.view._solids import Solids

_TEXTS_EVERY = SECOND // 2
_AXES = 0.25
"""Length of the axes, relative to the mean distance of frames from their parents."""
_SIGHT = np.array((1.4, -1.2, 0.8))
"""From the middle of the frames to the camera, relative to their extent."""


class Points(NamedTuple):
    """Points that a program adds."""

    cloud: PointCloud
    size: float
    colour: Any


class Screen:
    """Shows a page in the browsers of a server.

    Parameters
    ----------
    server : viser.ViserServer
    page : Page
    solids : sequence of Solid
        The visible shapes of a robot.
    post : callable
        Has a function called on the event loop, and the page drawn anew; viser's threads call it.
    """

    def __init__(self, server: viser.ViserServer, page: Page, solids: Sequence[Solid], post: Post) -> None:
        self._server = server
        self._page = page
        self._canvas = Canvas(server, lambda frame: post(lambda: page.select(frame)))
        self._panel = Panel(server, page, post)
        self._solids = Solids(server, solids) if solids else None
        if self._solids is not None:
            self._canvas.show_solids(self._solids)
            self._panel.robot.visible = True
        self._points: dict[str, Points] = {}
        self._drawn_points: dict[str, Points] = {}
        self._poses_of_points: dict[str, tuple[str, Row]] = {}
        self._fitted = False
        self._texts_due = 0

    def set_points(self, points: dict[str, Points]) -> None:
        """Show these points, by name, from the next `draw` on."""
        self._points = points

    def draw(self, now: int, elapsed: int, texts: bool) -> None:
        """Draw the page.

        Parameters
        ----------
        now : int
            The stamp (ns) that ages are counted from.
        elapsed : int
            A monotonic time, in ns; the texts are not written more often than people can read them.
        texts : bool
            Whether to write the texts in any case.
        """
        page = self._page
        picture = page.picture(now)
        if not self._fitted and picture.scene.lines.size:
            self._fit(picture.scene)
        if self._solids is not None:
            self._solids.opacity = self._panel.robot.value
        self._canvas.draw(picture, self._panel.axes_length.value)
        self._draw_points(picture)
        self._panel.show_time()
        if texts or elapsed >= self._texts_due:
            self._texts_due = elapsed + _TEXTS_EVERY
            self._panel.show(page.texts(now, picture.scene))

    def _fit(self, scene: Scene) -> None:
        """Choose the length of the axes, and put the cameras where all frames are seen."""
        self._fitted = True
        lengths = np.linalg.norm(scene.lines[:, 0] - scene.lines[:, 1], axis=1)
        typical = float(lengths[lengths > 0.0].mean()) if (lengths > 0.0).any() else 1.0
        set_value(self._panel.axes_length, round(min(max(_AXES * typical, 0.02), 2.0), 2))
        low, high = scene.positions.min(axis=0), scene.positions.max(axis=0)
        middle = (low + high).astype(np.float64) / 2.0
        position = middle + _SIGHT * max(float(np.linalg.norm(high - low)) / 1.5, 0.5)
        self._server.initial_camera.position = position
        self._server.initial_camera.look_at = middle
        for client in self._server.get_clients().values():
            client.camera.position = position
            client.camera.look_at = middle

    def _draw_points(self, picture: Picture) -> None:
        for name in [name for name in self._drawn_points if name not in self._points]:
            self._canvas.remove_points(name)
            del self._drawn_points[name]
        for name, points in self._points.items():
            if self._drawn_points.get(name) is not points:
                self._canvas.add_points(name, points.cloud, points.size, points.colour)
                self._drawn_points[name] = points
                self._poses_of_points.pop(name, None)
            fixed = picture.scene.frames[0] if picture.scene.frames else None
            self._canvas.place_points(name, None if fixed is None else self._pose_of_points(name, fixed))

    def _pose_of_points(self, name: str, fixed: str) -> Row | None:
        """The pose of points at their own stamp; that of an instant that has left the history stays as it was."""
        cloud = self._points[name].cloud
        try:
            row = self._page.tree.lookup(fixed, cloud.frame, cloud.stamp).transform._row
        except TransformLookupError:
            known = self._poses_of_points.get(name)
            return known[1] if known is not None and known[0] == fixed else None
        self._poses_of_points[name] = fixed, row
        return row

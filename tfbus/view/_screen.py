"""The page in the browsers: it brings canvas and panel to what the page shows at a moment."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import viser

from tfbus.data import PointCloud
from tfbus.errors import TransformLookupError
from tfbus.rows import Row
from tfbus.stamps import SECOND
from tfbus.view._canvas import Canvas
from tfbus.view._meshes import Solid
from tfbus.view._page import Page, Picture, Texts
from tfbus.view._panel import Panel, Post, set_value
from tfbus.view._scene import Scene
from tfbus.view._solids import Solids

_TEXTS_EVERY = SECOND // 2
_AXES = 0.25
"""Length of the axes, relative to the mean distance of frames from their parents."""
_VIEWPOINT = np.array((1.4, -1.2, 0.8))
"""From the middle of the frames to the camera, relative to their extent."""


class Points(NamedTuple):
    """Points that a program adds."""

    cloud: PointCloud
    size: float
    colour: Any


class Sight(NamedTuple):
    """The content of a page at a moment."""

    picture: Picture
    texts: Texts | None
    """None if they stay as they are."""
    points: Mapping[str, tuple[Points, Row | None]]
    """With their pose in the fixed frame; None for those that have none."""
    chosen: tuple[int, int, int] | None
    """The chosen stamp, and the start and end of the span in which it is, in ns; None while the page is live."""


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

    Notes
    -----
    `read` belongs to the event loop of the bus, `show` to that of viser: viser's queue of messages fails now and then
    if another thread fills it while viser's empties it.
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
        self._points: Mapping[str, Points] = {}
        self._drawn_points: dict[str, Points] = {}
        # By the identity of the points.
        self._poses_of_points: dict[int, tuple[str, Row]] = {}
        self._fitted = False
        self._texts_due = 0

    def set_points(self, points: Mapping[str, Points]) -> None:
        """Show these points, by name, from the next `read` on."""
        self._points = points

    def read(self, now: int, elapsed: int, texts: bool) -> Sight:
        """The content of the page now, for `show`.

        Parameters
        ----------
        now : int
            The stamp (ns) that ages are counted from.
        elapsed : int
            A monotonic time, in ns; the texts are not made more often than people can read them.
        texts : bool
            Whether to make the texts in any case.
        """
        page, line = self._page, self._page.timeline
        picture = page.picture(now)
        made = None
        if texts or elapsed >= self._texts_due:
            self._texts_due = elapsed + _TEXTS_EVERY
            made = page.texts(now, picture.scene)
        fixed = picture.scene.frames[0] if picture.scene.frames else None
        points = {name: (each, self._pose_of_points(each, fixed)) for name, each in self._points.items()}
        self._poses_of_points = {each: pose for each, pose in self._poses_of_points.items() if each in self._known()}
        chosen = None if line.stamp is None else (line.stamp, line.start, line.end)
        return Sight(picture, made, points, chosen)

    def show(self, sight: Sight) -> None:
        """Bring the browsers to what was read."""
        picture = sight.picture
        if not self._fitted and picture.scene.lines.size:
            self._fit(picture.scene)
        if self._solids is not None:
            self._solids.opacity = self._panel.robot.value
        with self._server.atomic():
            self._canvas.draw(picture, self._panel.axes_length.value)
            self._show_points(sight.points)
            self._panel.show_time(sight.chosen)
            if sight.texts is not None:
                self._panel.show(sight.texts)
        self._server.flush()

    def _fit(self, scene: Scene) -> None:
        """Choose the length of the axes, and put the cameras where all frames are seen."""
        self._fitted = True
        lengths = np.linalg.norm(scene.lines[:, 0] - scene.lines[:, 1], axis=1)
        typical = float(lengths[lengths > 0.0].mean()) if (lengths > 0.0).any() else 1.0
        set_value(self._panel.axes_length, round(min(max(_AXES * typical, 0.02), 2.0), 2))
        low, high = scene.positions.min(axis=0), scene.positions.max(axis=0)
        middle = (low + high).astype(np.float64) / 2.0
        position = middle + _VIEWPOINT * max(float(np.linalg.norm(high - low)) / 1.5, 0.25)
        self._server.initial_camera.position = position
        self._server.initial_camera.look_at = middle
        for client in self._server.get_clients().values():
            client.camera.position = position
            client.camera.look_at = middle

    def _show_points(self, points: Mapping[str, tuple[Points, Row | None]]) -> None:
        for name in [name for name in self._drawn_points if name not in points]:
            self._canvas.remove_points(name)
            del self._drawn_points[name]
        for name, (each, pose) in points.items():
            if self._drawn_points.get(name) is not each:
                self._canvas.add_points(name, each.cloud, each.size, each.colour)
                self._drawn_points[name] = each
            self._canvas.place_points(name, pose)

    def _known(self) -> set[int]:
        return {id(each) for each in self._points.values()}

    def _pose_of_points(self, points: Points, fixed: str | None) -> Row | None:
        """The pose of points at their own stamp; that of an instant that has left the history stays as it was."""
        if fixed is None:
            return None
        cloud = points.cloud
        try:
            row = self._page.tree.lookup(fixed, cloud.frame, cloud.stamp).transform._row
        except TransformLookupError:
            known = self._poses_of_points.get(id(points))
            return known[1] if known is not None and known[0] == fixed else None
        self._poses_of_points[id(points)] = fixed, row
        return row

"""The page in viser: a `Canvas` of frames, a robot's `Solids`, and a `Panel` of controls and texts.

All axes are one object, and so are all lines, because a browser with an object for each frame stalls at a thousand
frames. World poses are computed here, and an object is sent again only if it has changed.

This module and its `Page` run in viser's thread. Pictures, texts and copies of the tree take tens of ms with thousands
of frames, and the program's event loop must not wait for them. Besides, viser's queue of messages sometimes fails if
another thread fills it while viser's thread empties it.
"""

from collections.abc import Awaitable, Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import viser

from tfbus.data import PointCloud
from tfbus.errors import TransformLookupError
from tfbus.plain import printable
from tfbus.rows import Row, compose
from tfbus.stamps import SECOND, from_seconds
from tfbus.view.meshes import Solid
from tfbus.view.page import NO_SCENE, SPEEDS, Page, Picture, Scene, Texts
from tfbus.view.server import Controls


class Solids:
    """Draws solids at the poses of their links.

    Parameters
    ----------
    server : viser.ViserServer
    solids : sequence of Solid
    """

    def __init__(self, server: viser.ViserServer, solids: Sequence[Solid]) -> None:
        self._server = server
        groups: dict[str, list[Solid]] = {}
        for solid in solids:
            groups.setdefault(solid.key, []).append(solid)
        self._groups = list(groups.values())
        self._solids = [solid for group in self._groups for solid in group]
        self._origins = np.array([solid.visual.origin._row for solid in self._solids]).reshape(-1, 7).T
        self._handles: list[viser.BatchedMeshHandle | None] = [None] * len(self._groups)
        self._drawn: tuple[bool, ...] = ()
        self.opacity: float = 1.0
        """The opacity of all shapes, from 0 to 1; 0 hides them."""

    def draw(self, scene: Scene) -> None:
        """Move every shape to the pose of its link; shapes of links without a pose are left out."""
        places = {frame: place for place, frame in enumerate(scene.frames)} if self.opacity > 0.0 else {}
        links = [places.get(solid.visual.link, -1) for solid in self._solids]
        drawn = tuple(place >= 0 for place in links)
        rows = np.concatenate((scene.positions, scene.wxyzs[:, [1, 2, 3, 0]]), axis=1).T
        here = np.array([place for place in links if place >= 0], np.intp)
        columns = np.stack(compose((*rows[:, here],), (*self._origins[:, np.array(drawn, np.bool_)],)))
        positions, wxyzs = columns[:3].T, columns[[6, 3, 4, 5]].T
        begin = first = 0
        for number, group in enumerate(self._groups):
            mask = drawn[first : first + len(group)]
            part = slice(begin, begin + sum(mask))
            first, begin = first + len(group), part.stop
            handle = self._handles[number]
            if drawn != self._drawn:
                if handle is not None:
                    handle.remove()
                shown = [solid for solid, has_pose in zip(group, mask, strict=True) if has_pose]
                self._handles[number] = self._add(number, shown, positions[part], wxyzs[part]) if shown else None
            elif handle is not None:
                handle.opacity = self.opacity
                handle.batched_positions = positions[part]
                handle.batched_wxyzs = wxyzs[part]
        self._drawn = drawn

    def _add(
        self, number: int, solids: Sequence[Solid], positions: np.ndarray, wxyzs: np.ndarray
    ) -> viser.BatchedMeshHandle:
        return self._server.scene.add_batched_meshes_simple(
            f"/robot/{number}",
            solids[0].triangles.vertices,
            solids[0].triangles.faces,
            wxyzs,
            positions,
            batched_scales=np.array([solid.scale for solid in solids], np.float32),
            batched_colors=np.array([solid.colour for solid in solids], np.uint8),
            batched_opacities=np.array([solid.opacity for solid in solids], np.float32),
            opacity=self.opacity,
            flat_shading=True,
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
            side="double",
        )


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
    page : Page
        A click on a frame selects it there.
    controls : Controls
    """

    def __init__(self, server: viser.ViserServer, page: Page, controls: Controls) -> None:
        self._server = server
        self._page = page
        self._controls = controls
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
        # Unchanged arrays are not set again, because viser would compare them number by number.
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
        """Add points, or replace the points of the same name; they are hidden until they have a pose."""
        points = cloud.points[np.isfinite(cloud.points).all(axis=1)]
        colours = np.asarray(colour)
        if colours.ndim == 2:
            colours = colours[np.isfinite(cloud.points).all(axis=1)]
        if name not in self._clouds:
            self._clouds_added += 1
        # A name may contain letters with a special meaning in viser's names.
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

    # viser calls an async function on its own loop, in the order of the events, and others in many threads.
    async def _on_click(self, event: Any) -> None:
        frames, place = self._drawn.scene.frames, event.instance_index
        if place is not None and place < len(frames):
            frame = frames[place]
            self._controls.use("click", lambda: self._page.select(frame))

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


LARGEST = "(root of the largest tree)"
NONE = "(none)"
_SLIDER_STEP = 0.001
"""s."""


class Panel:
    """The controls and texts of a page.

    Parameters
    ----------
    server : viser.ViserServer
    page : Page
        The choices of people change it.
    controls : Controls
    """

    def __init__(self, server: viser.ViserServer, page: Page, controls: Controls) -> None:
        self._page = page
        self._controls = controls
        gui = server.gui
        self._status = gui.add_html("")
        self._fixed = gui.add_dropdown("Fixed frame", (LARGEST,), hint="The frame that stands still")
        self._search = gui.add_text("Search", "", hint="Part of the name of a frame")
        self._frame = gui.add_dropdown("Frame", (NONE,), hint="The selected frame, or one that matches the search")
        with gui.add_folder("Selected frame"):
            self._selection = gui.add_html("")
            trail = gui.add_button("Trail on or off", hint="Draw where this frame was in the last ten seconds")
        with gui.add_folder("Time"):
            names = ("Live", "Pause", "Play") if page.live else ("Pause", "Play")
            self._mode = gui.add_button_group("Mode", names)
            self._step = gui.add_button_group("Step", ("◀", "▶"), hint="To the sample before, or the next one")
            self._speed = gui.add_dropdown("Speed", tuple(f"× {speed:g}" for speed in SPEEDS), initial_value="× 1")
            self._slider = gui.add_slider(
                "Time [s]", 0.0, 1.0, _SLIDER_STEP, 0.0, disabled=page.live, hint="Seconds from the oldest sample"
            )
        with gui.add_folder("Show"):
            self._labels = gui.add_dropdown("Labels", ("selection", "all", "none"))
            self.axes_length: viser.GuiSliderHandle[float] = gui.add_slider("Axes [m]", 0.01, 2.0, 0.01, 0.2)
            self.robot: viser.GuiSliderHandle[float] = gui.add_slider(
                "Robot", 0.0, 1.0, 0.05, 0.5, visible=False, hint="Opacity of the robot: 0 hides it"
            )
        with gui.add_folder("Tree"):
            self._tree = gui.add_html("")
        with gui.add_folder("Events"):
            self._events = gui.add_html("")
        self._chosen(self._fixed, lambda value: page.choose_fixed(None if value == LARGEST else self._named(value)))
        self._chosen(self._frame, lambda value: page.select(None if value == NONE else self._named(value)))
        self._chosen(self._search, self._find)
        self._chosen(self._labels, lambda value: setattr(page, "labels", value))
        self._chosen(
            self._speed, lambda value: setattr(page.timeline, "speed", SPEEDS[self._speed.options.index(value)])
        )
        self._chosen(self._slider, self._seek)
        self._chosen(self.axes_length, lambda _: None)
        self._chosen(self.robot, lambda _: None)
        modes = {"Live": page.go_live, "Pause": page.freeze, "Play": page.play}
        self._pressed(self._mode, lambda value: modes[value]())
        self._pressed(self._step, lambda value: page.step(value == "▶"))
        self._pressed(trail, lambda _: page.toggle_trail())

    def show(self, texts: Texts) -> None:
        """Bring the panel to these texts."""
        self._status.content = texts.status
        self._selection.content = texts.selection
        self._tree.content = texts.tree
        self._events.content = texts.events
        _choices(self._fixed, LARGEST, texts.frames, texts.fixed)
        _choices(self._frame, NONE, texts.matches, texts.selected)

    def show_time(self, chosen: tuple[int, int, int] | None) -> None:
        """Move the slider to the chosen stamp: (stamp, begin of the span, end of the span) in ns."""
        self._slider.disabled = chosen is None
        if chosen is not None:
            stamp, start, end = chosen
            length = max((end - start) / SECOND, _SLIDER_STEP)
            if self._slider.max != length:
                self._slider.max = length
            set_value(self._slider, (stamp - start) / SECOND)

    def _chosen(self, control: Any, choose: Callable[[Any], object]) -> None:
        """Call a function with the value that somebody chooses in a browser."""
        control.on_update(self._callback(choose))

    def _pressed(self, control: Any, choose: Callable[[Any], object]) -> None:
        """Call a function with the name of the button that somebody presses."""
        control.on_click(self._callback(choose))

    def _callback(self, choose: Callable[[Any], object]) -> Callable[[Any], Awaitable[None]]:
        async def used(event: Any) -> None:
            # A value that the program itself sets has no client.
            if event.client_id is not None:
                value = event.target.value
                self._controls.use(id(event.target), lambda: choose(value))

        return used

    def _named(self, shown: str) -> str:
        """The frame that an option stands for."""
        tree = self._page.tree
        return shown if shown in tree else next((frame for frame in tree.frames() if printable(frame) == shown), shown)

    def _find(self, text: str) -> None:
        page = self._page
        page.search = text
        matches = [frame for frame in page.tree.frames() if text.casefold() in frame.casefold()]
        if len(matches) == 1 and text:
            page.select(matches[0])

    def _seek(self, seconds: float) -> None:
        line = self._page.timeline
        line.pause()
        line.seek(line.start + from_seconds(seconds))


def _choices(dropdown: viser.GuiDropdownHandle[str], first: str, names: tuple[str, ...], chosen: str | None) -> None:
    """Offer the names, and the chosen one even if it is not among them."""
    # A browser does not accept an option twice.
    names = tuple(dict.fromkeys(map(printable, names)))
    options = (first, *(name for name in names if name != first))
    shown = first if chosen is None else printable(chosen)
    if shown not in options:
        options = (*options, shown)
    if dropdown.options != options:
        dropdown.options = options
    set_value(dropdown, shown)


def set_value(control: Any, value: Any) -> None:
    """Set the value of a control of viser, whose types call it read-only."""
    control.value = value


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


class Screen:
    """Shows a page in the browsers of a server.

    Parameters
    ----------
    server : viser.ViserServer
    page : Page
    solids : sequence of Solid
        The visible shapes of a robot.
    controls : Controls
    """

    def __init__(self, server: viser.ViserServer, page: Page, solids: Sequence[Solid], controls: Controls) -> None:
        self._server = server
        self._page = page
        self._controls = controls
        self._canvas = Canvas(server, page, controls)
        self._panel = Panel(server, page, controls)
        self._solids = Solids(server, solids) if solids else None
        if self._solids is not None:
            self._canvas.show_solids(self._solids)
            self._panel.robot.visible = True
        self._drawn_points: dict[str, Points] = {}
        # By the identity of the points.
        self._poses_of_points: dict[int, tuple[str, Row]] = {}
        self._fitted = False
        self._texts_due = 0

    def draw(self, now: int, elapsed: int, points: Mapping[str, Points], texts: bool = False) -> None:
        """Apply the choices of people to the page, and draw it in all browsers.

        Parameters
        ----------
        now : int
            The stamp (ns) that ages are counted from.
        elapsed : int
            A monotonic time, in ns; unless somebody makes a choice, it limits how often texts are made.
        points : mapping of str to Points
            By name.
        texts : bool
            Whether to make the texts in any case.
        """
        page, line = self._page, self._page.timeline
        texts |= self._controls.apply()
        picture = page.picture(now)
        made = None
        if texts or elapsed >= self._texts_due:
            self._texts_due = elapsed + _TEXTS_EVERY
            made = page.texts(now, picture.scene)
        if not self._fitted and picture.scene.lines.size:
            self._fit(picture.scene)
        if self._solids is not None:
            self._solids.opacity = self._panel.robot.value
        with self._server.atomic():
            self._canvas.draw(picture, self._panel.axes_length.value)
            self._show_points(points, picture.scene.frames[0] if picture.scene.frames else None)
            self._panel.show_time(None if line.stamp is None else (line.stamp, line.start, line.end))
            if made is not None:
                self._panel.show(made)
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

    def _show_points(self, points: Mapping[str, Points], fixed: str | None) -> None:
        for name in [name for name in self._drawn_points if name not in points]:
            self._canvas.remove_points(name)
            del self._drawn_points[name]
        for name, each in points.items():
            if self._drawn_points.get(name) is not each:
                self._canvas.add_points(name, each.cloud, each.size, each.colour)
                self._drawn_points[name] = each
            self._canvas.place_points(name, self._pose_of_points(each, fixed))
        known = {id(each) for each in points.values()}
        self._poses_of_points = {each: pose for each, pose in self._poses_of_points.items() if each in known}

    def _pose_of_points(self, points: Points, fixed: str | None) -> Row | None:
        """The pose of points at their own stamp; once the history has dropped that stamp, the last pose stays."""
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

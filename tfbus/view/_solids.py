"""The visible shapes of a robot in viser: one object for all shapes with the same triangles."""

from collections.abc import Sequence

import numpy as np
import viser

from tfbus.rows import compose
from tfbus.view._meshes import Solid
from tfbus.view._scene import Scene


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
        self.opacity = 1.0
        """Of all shapes, from 0 to 1; 0 hides them."""

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

"""The triangles of visible shapes, and the search for mesh files."""

import logging
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote, urlsplit

import numpy as np
import numpy.typing as npt
import trimesh

from tfbus.plain import printable
from tfbus.robot.visual import Box, Cylinder, Mesh, Shape, Sphere, Visual

_PLACEHOLDER = 0.05
"""m; the side of the box that stands for a missing mesh."""
_PLACEHOLDER_COLOUR = (204, 121, 167)
_NO_COLOUR = (190, 190, 190)


class Triangles(NamedTuple):
    """A triangle mesh: vertices in m of shape (v, 3), and for each face the places of its vertices, (f, 3)."""

    vertices: npt.NDArray[np.float32]
    faces: npt.NDArray[np.uint32]


class Solid(NamedTuple):
    """A visible shape as it is drawn."""

    visual: Visual
    key: str
    """Equal for shapes with the same triangles."""
    triangles: Triangles
    scale: tuple[float, float, float]
    colour: tuple[int, int, int]
    opacity: float


class MeshFiles:
    """Finds and reads mesh files: STL, OBJ, DAE and whatever else trimesh reads.

    Parameters
    ----------
    package_paths : sequence of path
        Folders in which ``package://NAME/FILE`` is looked for: as ``NAME/FILE``, and if the folder is called NAME, as
        ``FILE``.
    folder : path
        The folder of the URDF, for relative paths.

    Attributes
    ----------
    missing : dict of str to str
        For each file that could not be used, why.
    """

    def __init__(self, package_paths: Iterable[Path], folder: Path) -> None:
        self._package_paths = tuple(package_paths)
        self._folder = folder
        self._read: dict[str, tuple[Triangles, tuple[int, int, int] | None] | None] = {}
        self.missing: dict[str, str] = {}

    def read(self, filename: str) -> tuple[Triangles, tuple[int, int, int] | None] | None:
        """The triangles of a file and its own colour, if it has one; None if it cannot be used."""
        if filename not in self._read:
            try:
                self._read[filename] = _read_mesh(self.find(filename))
            except Exception as error:  # noqa: BLE001 - the readers of trimesh raise whatever a bad file leads to
                self.missing[filename] = str(error) or type(error).__name__
                self._read[filename] = None
        return self._read[filename]

    def find(self, filename: str) -> Path:
        """The path of a file that a URDF names.

        Raises
        ------
        FileNotFoundError
            If there is none, or the name is an address in a network: nothing is fetched.
        """
        scheme, place, path, _, _ = urlsplit(filename)
        if scheme == "package":
            inside = unquote(path).lstrip("/")
            candidates = [folder / place / inside for folder in self._package_paths]
            candidates += [folder / inside for folder in self._package_paths if folder.resolve().name == place]
        elif scheme == "file":
            candidates = [Path(unquote(path))]
        elif len(scheme) > 1:
            raise FileNotFoundError(f"files of the kind {scheme}:// are not fetched")
        else:
            candidates = [self._folder / filename]
        for candidate in candidates:
            if candidate.is_file():
                return candidate
        if scheme == "package":
            raise FileNotFoundError(f"no folder of --package-path has the package {place!r} with this file")
        raise FileNotFoundError("there is no such file")


def solids_of(visuals: Sequence[Visual], files: MeshFiles) -> list[Solid]:
    """The visuals with their triangles; a small box stands for each mesh that is missing, and they are logged once."""
    solids = [_solid(visual, files) for visual in visuals]
    if files.missing:
        name, why = next(iter(files.missing.items()))
        logging.getLogger("tfbus").warning(
            "%d mesh files are missing, boxes stand for them: %s", len(files.missing), printable(f"{name} ({why})")
        )
    return solids


def _solid(visual: Visual, files: MeshFiles) -> Solid:
    shape = visual.shape
    own: tuple[int, int, int] | None = None
    scale: tuple[float, float, float]
    if isinstance(shape, Mesh):
        found = files.read(shape.filename)
        if found is None:
            side = _PLACEHOLDER
            return Solid(visual, "box", _unit(Box((1, 1, 1))), (side, side, side), _PLACEHOLDER_COLOUR, 0.6)
        (triangles, own), key, scale = found, f"mesh {shape.filename}", shape.scale
    elif isinstance(shape, Box):
        triangles, key, scale = _unit(shape), "box", shape.size
    elif isinstance(shape, Cylinder):
        triangles, key, scale = _unit(shape), "cylinder", (shape.radius, shape.radius, shape.length)
    else:
        triangles, key, scale = _unit(shape), "sphere", (shape.radius,) * 3
    if visual.colour is None:
        return Solid(visual, key, triangles, scale, own or _NO_COLOUR, 1.0)
    red, green, blue, opacity = visual.colour
    return Solid(visual, key, triangles, scale, (round(red * 255), round(green * 255), round(blue * 255)), opacity)


def _unit(shape: Shape) -> Triangles:
    """The triangles of a box of side one, or a cylinder or sphere of radius one."""
    if isinstance(shape, Box):
        mesh = trimesh.creation.box((1.0, 1.0, 1.0))
    elif isinstance(shape, Sphere):
        mesh = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
    else:
        mesh = trimesh.creation.cylinder(radius=1.0, height=1.0, sections=32)
    return _triangles(mesh)


def _read_mesh(path: Path) -> tuple[Triangles, tuple[int, int, int] | None]:
    mesh = trimesh.load_mesh(path)
    triangles = _triangles(mesh)
    if path.suffix.lower() == ".dae":
        triangles = triangles._replace(vertices=triangles.vertices * np.float32(_metres(mesh.units)))
    if not len(triangles.faces) or not np.isfinite(triangles.vertices).all():
        raise ValueError("it has no triangles, or some that are not finite")
    return triangles, _main_colour(mesh)


def _metres(units: str | None) -> float:
    """The unit of a COLLADA file in m, from trimesh's text such as ``0.01 * meters``."""
    number, star, _ = (units or "").partition("*")
    metres = float(number) if star else 1.0
    if not 0.0 < metres < np.inf:
        raise ValueError(f"its unit is {metres} m")
    return metres


def _triangles(mesh: trimesh.Trimesh) -> Triangles:
    return Triangles(np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32))


def _main_colour(mesh: trimesh.Trimesh) -> tuple[int, int, int] | None:
    """The colour of a mesh, if its file gives one: the mean of its faces or its material."""
    visual: Any = mesh.visual
    if visual is None:
        return None
    if visual.kind in ("face", "vertex"):
        red, green, blue = visual.face_colors[:, :3].mean(axis=0).round().astype(int).tolist()
    elif visual.kind == "texture":
        red, green, blue = (int(part) for part in visual.material.main_color[:3])
    else:
        return None
    return red, green, blue

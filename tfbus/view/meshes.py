"""The triangles of visible shapes, and the search for mesh files.

A mesh file may come from a stranger. A few bytes of it can stand for gigabytes: an archive, a texture, a scene that
repeats a shape. So the unfolded size is counted before trimesh reads the file, and textures are not decoded, because a
shape has one colour.
"""

import io
import json
import logging
import os
import struct
import zipfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote, urlsplit
from xml.parsers import expat

import numpy as np
import numpy.typing as npt
import trimesh

from tfbus.plain import printable
from tfbus.robot.model import Box, Cylinder, Mesh, Shape, Sphere, Visual
from tfbus.view.session import ROBOT, framed

MAX_BYTES = 67_108_864
"""The greatest size in bytes of a mesh file and all files that it refers to, unpacked."""
MAX_NUMBERS = 5_000_000
"""The greatest count of numbers in a text, or in a scene of COLLADA or glTF with its repetitions."""
MAX_VERTICES = 2_000_000
MAX_SHAPES = 10_000
"""The greatest number of shapes of one file, with repetitions."""
_KINDS = ("dae", "glb", "gltf", "obj", "off", "ply", "stl", "zae")
_IMAGES = (".bmp", ".dds", ".gif", ".jpeg", ".jpg", ".ktx2", ".png", ".tga", ".tif", ".tiff", ".webp")
_SPACE = np.zeros(256, np.bool_)
_SPACE[list(b' \t\r\n\v\f,;/[]{}:<>="')] = True
_CHUNK = 1_048_576
_PLACEHOLDER = 0.05
"""In m: the side of the box that stands for a missing mesh."""
_PLACEHOLDER_COLOUR = (150, 150, 150)
_PLACEHOLDER_OPACITY = 0.35
_NO_COLOUR = (190, 190, 190)
# It tells of each texture that is not decoded, and without a handler Python would print that.
logging.getLogger("trimesh").addHandler(logging.NullHandler())


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
    """Finds and reads mesh files: STL, OBJ, DAE, ZAE, glTF, PLY and OFF.

    Parameters
    ----------
    package_paths : sequence of path
        Folders in which ``package://NAME/FILE`` is looked for: as ``NAME/FILE``; or as ``FILE``, if the folder is
        called NAME.
    folder : path
        The folder of the URDF, for relative paths.

    Attributes
    ----------
    missing : dict of str to str
        The reason for each file that could not be used.
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
            # The name is checked, not the file: a symbolic link may leave the folder, as in every colcon workspace.
            inside = os.path.normpath(unquote(path).replace("\\", "/").lstrip("/"))
            if place in ("", ".", "..") or inside.split("/")[0] == ".." or "\0" in inside or ":" in inside:
                raise FileNotFoundError("the name leaves its package")
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


def robot_message(solids: Sequence[Solid]) -> bytes:
    """The shapes of a robot for the browsers, each mesh once; empty if there are none."""
    meshes = {solid.key: solid.triangles for solid in solids}
    places = {key: place for place, key in enumerate(meshes)}
    header = {
        "meshes": [{"vertices": len(each.vertices), "faces": len(each.faces)} for each in meshes.values()],
        "solids": [
            {
                "mesh": places[solid.key],
                "link": solid.visual.link,
                "xyz": solid.visual.origin.translation,
                "xyzw": solid.visual.origin.rotation,
                "scale": solid.scale,
                "colour": solid.colour,
                "opacity": solid.opacity,
            }
            for solid in solids
        ],
    }
    return framed(ROBOT, header, *(array for each in meshes.values() for array in each)) if solids else b""


def _solid(visual: Visual, files: MeshFiles) -> Solid:
    shape = visual.shape
    own: tuple[int, int, int] | None = None
    scale: tuple[float, float, float]
    if isinstance(shape, Mesh):
        found = files.read(shape.filename)
        if found is None:
            side = _PLACEHOLDER
            return Solid(
                visual, "box", _unit(Box((1, 1, 1))), (side, side, side), _PLACEHOLDER_COLOUR, _PLACEHOLDER_OPACITY
            )
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
    kind = path.suffix.lower()[1:]
    if kind not in _KINDS:
        raise ValueError(f"meshes of the kind .{kind} are not read")
    files: Any = _Files(path.parent)
    data = files.take(path)
    if kind in ("dae", "zae"):
        data, kind = _unpacked(data), "dae"
        _check_collada(data)
    elif kind in ("glb", "gltf"):
        _check_gltf(data)
    elif not _is_binary(kind, data):
        _check(_numbers(data), MAX_NUMBERS, "numbers")
    scene = trimesh.load_scene(io.BytesIO(data), file_type=kind, resolver=files)
    nodes = scene.graph.nodes_geometry
    _check(len(nodes), MAX_SHAPES, "shapes")
    meshes = [(pose, scene.geometry[name]) for pose, name in map(scene.graph.get, nodes)]
    meshes = [(pose, mesh) for pose, mesh in meshes if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces)]
    _check(sum(len(mesh.vertices) for _, mesh in meshes), MAX_VERTICES, "vertices")
    if not meshes:
        raise ValueError("it has no triangles")
    triangles = _joined(meshes)
    if kind == "dae":
        triangles = triangles._replace(vertices=triangles.vertices * np.float32(_metres(scene.units)))
    if not np.isfinite(triangles.vertices).all():
        raise ValueError("it has triangles that are not finite")
    return triangles, _mean_colour([mesh for _, mesh in meshes])


class _Files:
    """A resolver for trimesh: it may read the files in the folder of a mesh, except images."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._taken = 0

    def get(self, name: str) -> bytes:
        """The content of a file that a mesh names."""
        inside = os.path.normpath(unquote(name.strip()).replace("\\", "/"))
        if inside.lower().endswith(_IMAGES):
            raise FileNotFoundError("textures are not drawn")
        if inside.startswith(("/", "..")) or ":" in inside or "\0" in inside:
            raise FileNotFoundError("the name leaves the folder of the mesh")
        path = self._folder / inside
        if not path.is_file():
            raise FileNotFoundError(name)
        return self.take(path)

    __getitem__ = get

    def take(self, path: Path) -> bytes:
        """The content of a file, unless all files taken so far exceed the bound together."""
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1 - self._taken)
        self._taken += len(data)
        _check(self._taken, MAX_BYTES, "bytes")
        return data


def _check(found: int, most: int, what: str) -> None:
    if found > most:
        raise ValueError(f"it has more than {most} {what}")


def _numbers(data: bytes) -> int:
    """The number of words of a text; each number is one."""
    found = 0
    before = True
    for start in range(0, len(data), _CHUNK):
        space = _SPACE[np.frombuffer(data, np.uint8, min(_CHUNK, len(data) - start), start)]
        found += int(np.count_nonzero(space[:-1] & ~space[1:])) + int(before and not space[0])
        before = bool(space[-1])
    return found


def _is_binary(kind: str, data: bytes) -> bool:
    """Whether trimesh will read a file as binary."""
    if kind == "stl":
        return len(data) >= 84 and len(data) == 84 + 50 * int.from_bytes(data[80:84], "little")
    return kind == "ply" and b"format binary" in data[:1_000]


def _unpacked(data: bytes) -> bytes:
    """A COLLADA file, which may be in an archive."""
    if not zipfile.is_zipfile(io.BytesIO(data)):
        return data
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        scenes = [entry for entry in archive.infolist() if entry.filename.lower().endswith(".dae")]
        if not scenes:
            raise ValueError("its archive has no .dae")
        with archive.open(scenes[0]) as file:
            # The archive may claim a wrong size.
            unpacked = file.read(MAX_BYTES + 1)
    _check(len(unpacked), MAX_BYTES, "bytes, unpacked")
    return unpacked


class _Node:
    """A node of a COLLADA scene: its shapes and other nodes, by name or nested."""

    def __init__(self) -> None:
        self.shapes: list[str] = []
        self.named: list[str] = []
        self.nested: list[_Node] = []
        self.size: tuple[int, int] | None = None
        """The counts of shapes and numbers, with repetitions."""


def _check_collada(data: bytes) -> None:
    """Refuse a COLLADA file that unfolds to too much. trimesh copies a shape each time that a node names it."""
    _check(_numbers(data), MAX_NUMBERS, "numbers")
    nodes: dict[str, _Node] = {}
    stack: list[_Node] = []
    roots: list[_Node] = []
    numbers: dict[str, int] = {}
    shape = ""

    def begin(tag: str, attributes: dict[str, str]) -> None:
        nonlocal shape
        tag = tag.rpartition(":")[2]
        if tag in ("node", "visual_scene"):
            node = _Node()
            if tag == "visual_scene":
                roots.append(node)
            elif stack:
                stack[-1].nested.append(node)
            if "id" in attributes:
                nodes[attributes["id"]] = node
            stack.append(node)
        elif tag == "geometry":
            shape = attributes.get("id", "")
            numbers.setdefault(shape, 0)
        elif tag in ("instance_geometry", "instance_controller") and stack:
            stack[-1].shapes.append(attributes.get("url", "")[1:])
        elif tag == "instance_node" and stack:
            stack[-1].named.append(attributes.get("url", "")[1:])

    def end(tag: str) -> None:
        nonlocal shape
        tag = tag.rpartition(":")[2]
        if tag in ("node", "visual_scene"):
            stack.pop()
        elif tag == "geometry":
            shape = ""

    def count(text: str) -> None:
        if shape:
            numbers[shape] += len(text.split())

    def refuse(*_: object) -> None:
        raise ValueError("it declares entities, which COLLADA does not need")

    def size(node: _Node) -> tuple[int, int]:
        if node.size is None:
            # A node that contains itself, directly or through others, has no end.
            node.size = (MAX_SHAPES + 1, 0)
            parts = [(1, numbers.get(name, 0)) for name in node.shapes]
            parts += [size(each) for each in node.nested]
            parts += [size(nodes[name]) for name in node.named if name in nodes]
            node.size = sum(part[0] for part in parts), sum(part[1] for part in parts)
        return node.size

    parser = expat.ParserCreate()
    parser.buffer_text, parser.buffer_size = True, 65_536
    parser.StartElementHandler, parser.EndElementHandler = begin, end
    parser.CharacterDataHandler = count
    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = refuse
    parser.Parse(data, True)
    for root in roots:
        shapes, repeated = size(root)
        _check(shapes, MAX_SHAPES, "shapes, repeated ones included")
        _check(repeated, MAX_NUMBERS, "numbers, repeated ones included")


def _check_gltf(data: bytes) -> None:
    """Refuse a glTF file that unfolds to too much: its counts may be false, and shapes may share numbers."""
    text = data
    if data[:4] == b"glTF":
        (length,) = struct.unpack_from("<I", data, 12)
        text = data[20 : 20 + length]
    _check(_numbers(text), MAX_NUMBERS, "words")
    tree = json.loads(text)
    counts = [int(each["count"]) for each in tree.get("accessors", [])]
    primitives = [each for mesh in tree.get("meshes", []) for each in mesh["primitives"]]
    _check(len(primitives), MAX_SHAPES, "shapes")
    _check(len(tree.get("nodes", [])), MAX_SHAPES, "nodes")
    named = [place for each in primitives for place in (*each["attributes"].values(), each.get("indices"))]
    total = sum(counts) + sum(counts[place] for place in named if place is not None)
    _check(total, MAX_NUMBERS, "numbers")
    children = [child for node in tree.get("nodes", []) for child in node.get("children", [])]
    if len(set(children)) != len(children):
        raise ValueError("a node of it has several parents")


def _joined(meshes: Sequence[tuple[npt.NDArray[np.float64], trimesh.Trimesh]]) -> Triangles:
    """The triangles of several meshes, each at its pose."""
    vertices, faces, count = [], [], 0
    for pose, mesh in meshes:
        vertices.append((mesh.vertices @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32))
        # A mirror turns the faces inside out.
        turned = mesh.faces[:, ::-1] if np.linalg.det(pose[:3, :3]) < 0.0 else mesh.faces
        faces.append((turned + count).astype(np.uint32))
        count += len(mesh.vertices)
    return Triangles(np.concatenate(vertices), np.concatenate(faces))


def _metres(units: str | None) -> float:
    """The unit of a COLLADA file in m, from trimesh's text such as ``0.01 * meters``."""
    number, star, _ = (units or "").partition("*")
    metres = float(number) if star else 1.0
    if not 0.0 < metres < np.inf:
        raise ValueError(f"its unit is {metres} m")
    return metres


def _triangles(mesh: trimesh.Trimesh) -> Triangles:
    return Triangles(np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32))


def _mean_colour(meshes: Sequence[trimesh.Trimesh]) -> tuple[int, int, int] | None:
    """The colour of the meshes of a file, if it gives one: the mean over their faces."""
    found = [(len(mesh.faces), colour) for mesh in meshes if (colour := _main_colour(mesh)) is not None]
    if not found:
        return None
    faces, colours = zip(*found, strict=True)
    red, green, blue = np.average(colours, axis=0, weights=faces).round().astype(int).tolist()
    return red, green, blue


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

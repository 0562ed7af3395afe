import logging
from pathlib import Path

import numpy as np
import pytest

trimesh = pytest.importorskip("trimesh", reason="reading meshes needs trimesh")

from tfbus.robot import Box, Cylinder, Mesh, Sphere, Visual  # noqa: E402
from tfbus.view._meshes import MeshFiles, Solid, solids_of  # noqa: E402


@pytest.fixture
def box(tmp_path: Path) -> Path:
    """A folder with the box of 1, 2 and 3 m as ``robot/meshes/box.*``."""
    folder = tmp_path / "robot" / "meshes"
    folder.mkdir(parents=True)
    mesh = trimesh.creation.box((1.0, 2.0, 3.0))
    for kind in ("stl", "obj", "dae"):
        mesh.export(folder / f"box.{kind}")
    return tmp_path


def solid(shape: Box | Cylinder | Sphere | Mesh, files: MeshFiles | None = None, **rest: object) -> Solid:
    [found] = solids_of([Visual("base", shape, **rest)], files or MeshFiles((), Path()))  # type: ignore[arg-type]
    return found


def extents(found: Solid) -> list[float]:
    """The lengths along x, y and z in m, to the micrometre."""
    vertices = found.triangles.vertices * np.array(found.scale, np.float32)
    return [round(float(length), 6) for length in np.ptp(vertices, axis=0)]


@pytest.mark.parametrize("kind", ["stl", "obj", "dae"])
def test_meshes_of_the_usual_kinds_are_read(box: Path, kind: str) -> None:
    files = MeshFiles([box], Path())
    found = solid(Mesh(f"package://robot/meshes/box.{kind}", (1.0, 1.0, 0.5)), files)
    assert extents(found) == [1.0, 2.0, 1.5]
    assert files.missing == {}


@pytest.mark.parametrize(("unit", "side"), [("0.01", 0.02), ("1", 2.0), ("0.0254", 0.0508)])
def test_a_collada_file_says_its_unit(box: Path, unit: str, side: float) -> None:
    path = box / "robot" / "meshes" / "box.dae"
    text = path.read_text()
    assert "<unit" not in text
    path.write_text(text.replace("</asset>", f'<unit name="own" meter="{unit}"/></asset>', 1))
    assert extents(solid(Mesh(str(path), (1.0, 1.0, 1.0)))) == [side / 2, side, round(side * 1.5, 6)]


def test_a_collada_file_without_a_sensible_unit_is_missing(box: Path) -> None:
    path = box / "robot" / "meshes" / "box.dae"
    path.write_text(path.read_text().replace("</asset>", '<unit name="own" meter="0"/></asset>', 1))
    files = MeshFiles((), Path())
    assert files.read(str(path)) is None
    assert "unit" in files.missing[str(path)]


def test_a_package_is_looked_for_in_and_as_each_folder(box: Path) -> None:
    path = box / "robot" / "meshes" / "box.stl"
    name = "package://robot/meshes/box.stl"
    assert MeshFiles([box / "nowhere", box], Path()).find(name) == path
    assert MeshFiles([box / "robot"], Path()).find(name) == path


def test_a_path_is_relative_to_the_urdf_and_a_file_address_is_absolute(box: Path) -> None:
    path = box / "robot" / "meshes" / "box.stl"
    assert MeshFiles((), box / "robot").find("meshes/box.stl") == path
    assert MeshFiles((), Path()).find(path.as_uri()) == path


@pytest.mark.parametrize(
    ("filename", "why"),
    [
        ("package://robot/none.stl", "--package-path"),
        ("none.stl", "no such file"),
        ("file:///none.stl", "no such file"),
        ("http://127.0.0.1/box.stl", "not fetched"),
        ("package://other/meshes/box.stl", "'other'"),
    ],
)
def test_a_missing_mesh_is_a_box_and_one_warning_that_says_why(
    box: Path, caplog: pytest.LogCaptureFixture, filename: str, why: str
) -> None:
    files = MeshFiles([box], Path())
    with caplog.at_level(logging.WARNING, logger="tfbus"):
        found = solids_of([Visual("a", Mesh(filename)), Visual("b", Mesh(filename))], files)
    assert [extents(each) for each in found] == [[0.05] * 3] * 2
    assert why in files.missing[filename]
    [record] = caplog.records
    assert "1 mesh files are missing" in record.getMessage()
    assert why in record.getMessage()


@pytest.mark.parametrize("content", [b"", b"solid nothing\nendsolid nothing\n", b"\x00" * 200])
def test_a_damaged_mesh_counts_as_missing(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "bad.stl").write_bytes(content)
    files = MeshFiles((), tmp_path)
    assert files.read("bad.stl") is None
    assert set(files.missing) == {"bad.stl"}


@pytest.mark.parametrize(
    ("shape", "size"),
    [
        (Box((1.0, 2.0, 3.0)), [1.0, 2.0, 3.0]),
        (Cylinder(0.5, 3.0), [1.0, 1.0, 3.0]),
        (Cylinder(2.0, 1.0), [4.0, 4.0, 1.0]),
    ],
)
def test_other_shapes_have_the_size_of_the_urdf(shape: Box | Cylinder, size: list[float]) -> None:
    assert extents(solid(shape)) == size


def test_every_point_of_a_sphere_is_as_far_from_its_middle() -> None:
    found = solid(Sphere(2.0))
    distances = np.linalg.norm(found.triangles.vertices * np.array(found.scale), axis=1)
    assert distances == pytest.approx(np.full(len(distances), 2.0), abs=1e-5)


def test_shapes_with_the_same_triangles_have_the_same_key(box: Path) -> None:
    files = MeshFiles([box], Path())
    keys = [
        solid(shape, files).key
        for shape in (Box((1, 1, 1)), Box((2, 2, 2)), Sphere(1), Cylinder(1, 1), Mesh("package://robot/meshes/box.stl"))
    ]
    assert keys[0] == keys[1]
    assert len(set(keys)) == 4


def test_the_colour_is_that_of_the_urdf_else_of_the_file_else_grey(box: Path) -> None:
    # By hand, because trimesh wants SciPy to write colours.
    corners = ("0 0 0", "1 0 0", "0 1 0", "0 0 1")
    lines = [f"v {corner} {10 / 255} {20 / 255} {30 / 255}" for corner in corners]
    (box / "painted.obj").write_text("\n".join([*lines, "f 1 3 2", "f 1 2 4", "f 1 4 3", "f 2 3 4"]))
    files = MeshFiles([box], box)
    assert solid(Mesh("painted.obj"), files, colour=(1.0, 0.5, 0.0, 0.25)).colour == (255, 128, 0)
    assert solid(Mesh("painted.obj"), files, colour=(1.0, 0.5, 0.0, 0.25)).opacity == 0.25
    assert solid(Mesh("painted.obj"), files).colour == (10, 20, 30)
    assert solid(Sphere(1)).colour == (190, 190, 190)

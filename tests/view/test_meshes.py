import io
import json
import logging
import random
import shutil
import struct
import subprocess
import sys
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

trimesh = pytest.importorskip("trimesh", reason="reading meshes needs trimesh")

from tfbus.robot import Box, Cylinder, Mesh, Sphere, Visual  # noqa: E402
from tfbus.view.meshes import MAX_BYTES, MeshFiles, Solid, solids_of  # noqa: E402


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
    path.write_text(text.replace("</asset>", '<unit name="own" meter="0"/></asset>', 1))
    files = MeshFiles((), Path())
    assert files.read(str(path)) is None
    assert "unit" in files.missing[str(path)]


def test_a_package_is_looked_for_in_and_as_each_folder(box: Path) -> None:
    path = box / "robot" / "meshes" / "box.stl"
    name = "package://robot/meshes/box.stl"
    assert MeshFiles([box / "nowhere", box], Path()).find(name) == path
    assert MeshFiles([box / "robot"], Path()).find(name) == path
    assert MeshFiles([box], Path()).find("package://robot/urdf/../meshes/box.stl") == path


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


# Hostile files


def collada(scene: str, numbers: str = "0 1 2", nodes: str = "", head: str = "") -> bytes:
    """A COLLADA file with one triangle, named by its indices, as the geometry ``g``."""
    asset = '<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><asset/>'
    corners = (
        '<source id="p"><float_array id="a" count="9">0 0 0 1 0 0 0 1 0</float_array><technique_common>'
        '<accessor source="#a" count="3" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>'
        '<param name="Z" type="float"/></accessor></technique_common></source>'
        '<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>'
    )
    shape = (
        f'<library_geometries><geometry id="g"><mesh>{corners}<triangles count="1">'
        f'<input semantic="VERTEX" source="#v" offset="0"/><p>{numbers}</p></triangles></mesh></geometry>'
        "</library_geometries>"
    )
    scenes = (
        f'<library_visual_scenes><visual_scene id="s">{scene}</visual_scene></library_visual_scenes>'
        '<scene><instance_visual_scene url="#s"/></scene>'
    )
    library = f"<library_nodes>{nodes}</library_nodes>" if nodes else ""
    return f"{head}{asset}{shape}{library}{scenes}</COLLADA>".encode()


def gltf(points: bytes = bytes(36), **changed: Any) -> bytes:
    """A glTF file with three points, as one binary file."""
    tree: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"componentType": 5126, "count": 3, "type": "VEC3", "bufferView": 0}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"byteLength": len(points)}],
    }
    text = json.dumps(tree | changed).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I", len(text)) + b"JSON" + text + struct.pack("<I", len(points)) + b"BIN\0" + points
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


def zipped(data: bytes) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("scene.dae", data)
    return packed.getvalue()


ONE = '<node><instance_geometry url="#g"/></node>'
DOUBLED = "".join(
    f'<node id="n{level}">' + f'<instance_node url="#n{level - 1}"/>' * 2 + "</node>" for level in range(1, 30)
)
HOSTILE: dict[str, tuple[bytes, str]] = {
    "numbers.dae": (collada(ONE, "0 " * 5_000_001), "5000000 numbers"),
    "repeated.dae": (collada(ONE * 20, "0 " * 300_000), "repeated"),
    "doubled.dae": (
        collada('<node><instance_node url="#n29"/></node>', nodes=f'<node id="n0">{ONE}</node>{DOUBLED}'),
        "shapes",
    ),
    "endless.dae": (collada('<node id="a"><instance_node url="#a"/></node>'), "shapes"),
    "entities.dae": (collada(ONE, head='<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]>'), "entities"),
    "packed.zae": (zipped(bytes(MAX_BYTES + 1)), "bytes, unpacked"),
    "empty.zae": (zipped(b""), "no element found"),
    "words.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\n" + b"f 1 2 3\n" * 1_250_001, "5000000 numbers"),
    "claim.off": (b"OFF\n4000000000 4000000000 0\n0 0 0\n", "reshape"),
    "claim.stl": (bytes(80) + b"\xff" * 4 + bytes(50), "no triangles"),
    "claim.glb": (gltf(accessors=[{"componentType": 5126, "count": 400_000_000, "type": "VEC3"}]), "5000000 numbers"),
    "nodes.glb": (gltf(nodes=[{"children": [1, 1]}, {"mesh": 0}]), "several parents"),
    "shapes.glb": (gltf(meshes=[{"primitives": [{"attributes": {"POSITION": 0}}] * 10_001}]), "10000 shapes"),
    "deep.gltf": (b"[" * 100_000, "recursion"),
    "outside.gltf": (b'{"asset": {"version": "2.0"}, "buffers": [{"uri": "../../etc/passwd"}]}', "leaves the folder"),
    "archive.zip": (zipped(collada(ONE)), "the kind .zip"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_file_that_unfolds_to_too_much_is_missing_and_the_bound_is_named(tmp_path: Path, name: str) -> None:
    content, why = HOSTILE[name]
    (tmp_path / name).write_bytes(content)
    files = MeshFiles((), tmp_path)
    assert files.read(name) is None
    assert why in files.missing[name]


def test_the_files_of_these_tests_are_sound_but_for_what_they_are_about(tmp_path: Path) -> None:
    points = struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0)
    sound = {"a.dae": collada(ONE), "a.zae": zipped(collada(ONE)), "a.glb": gltf(points)}
    named = '<node><instance_node url="#n1"/></node>'
    sound["b.dae"] = collada(named, nodes=f'<node id="n1">{ONE}</node>')
    for name, content in sound.items():
        (tmp_path / name).write_bytes(content)
        files = MeshFiles((), tmp_path)
        found = files.read(name)
        assert found is not None, files.missing
        assert np.ptp(found[0].vertices, axis=0).tolist() == [1.0, 1.0, 0.0]


@pytest.mark.parametrize(
    "name",
    [
        *("package://robot/../secret.stl", "package://robot/meshes/../../secret.stl", "package://../secret.stl"),
        *("package://robot/%2e%2e/secret.stl", "package://robot/%2e%2e%2fsecret.stl", "package:///secret.stl"),
        *("package://robot/..%5csecret.stl", "package://./secret.stl", "package://robot//../secret.stl"),
    ],
)
def test_a_name_does_not_leave_its_package(box: Path, name: str) -> None:
    shutil.copy(box / "robot" / "meshes" / "box.stl", box / "secret.stl")
    for folder in (box, box / "robot"):
        files = MeshFiles([folder], Path())
        assert files.read(name) is None
        assert "leaves its package" in files.missing[name]


@pytest.mark.parametrize("name", ["../secret.mtl", "/secret.mtl", "a/../../secret.mtl"])
def test_what_a_mesh_refers_to_lies_in_its_folder(tmp_path: Path, name: str) -> None:
    (tmp_path / "secret.mtl").write_text("newmtl red\nKd 1 0 0\n")
    folder = tmp_path / "meshes"
    folder.mkdir()
    shape = "v 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl red\nf 1 2 3\n"
    (folder / "outside.obj").write_text(f"mtllib {name}\n{shape}")
    (folder / "inside.obj").write_text(f"mtllib own.mtl\n{shape}")
    (folder / "own.mtl").write_text("newmtl red\nKd 1 0 0\n")
    files = MeshFiles((), folder)
    outside, inside = files.read("outside.obj"), files.read("inside.obj")
    assert outside is not None
    assert inside is not None
    assert (outside[1], inside[1]) == (None, (255, 0, 0))


def test_a_mirrored_part_keeps_its_faces_outward(tmp_path: Path) -> None:
    box = trimesh.creation.box((1.0, 2.0, 3.0))
    scene = trimesh.Scene([box])
    scene.add_geometry(box, transform=np.diag([-1.0, 1.0, 1.0, 1.0]))
    scene.export(tmp_path / "two.glb")
    found = MeshFiles((), tmp_path).read("two.glb")
    assert found is not None
    corners = found[0].vertices[found[0].faces].astype(float)
    # The volume by the divergence theorem is positive where faces look outward.
    assert np.linalg.det(corners).sum() / 6.0 == pytest.approx(12.0)


PEAK = """
import resource, sys
from pathlib import Path
from tfbus.view.meshes import MeshFiles
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
files = MeshFiles((), Path(sys.argv[1]))
for name in sys.argv[2:]:
    files.read(name)
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024)
"""


@pytest.mark.thorough
@pytest.mark.skipif(sys.platform != "linux", reason="the unit of ru_maxrss is that of Linux")
def test_no_mesh_takes_more_than_a_gigabyte(tmp_path: Path) -> None:
    for name, (content, _) in HOSTILE.items():
        (tmp_path / name).write_bytes(content)
    # 12,000 pixels square, of which each row is zero.
    packer = zlib.compressobj(9)
    rows = b"".join(packer.compress(bytes(36_001)) for _ in range(12_000)) + packer.flush()
    parts = ((b"IHDR", struct.pack(">IIBBBBB", 12_000, 12_000, 8, 2, 0, 0, 0)), (b"IDAT", rows), (b"IEND", b""))
    chunks = (
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in parts
    )
    (tmp_path / "big.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks))
    (tmp_path / "painted.mtl").write_text("newmtl a\nKd 1 0 0\nmap_Kd big.png\n")
    shape = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl a\nf 1/1 2/1 3/1\n"
    (tmp_path / "painted.obj").write_text(f"mtllib painted.mtl\n{shape}")
    # The largest that are read, or almost.
    (tmp_path / "largest.dae").write_bytes(collada(ONE, "0 1 2 " * 1_660_000))
    count = (MAX_BYTES - 84) // 50
    (tmp_path / "largest.stl").write_bytes(
        bytes(80) + struct.pack("<I", count) + random.Random(1).randbytes(50 * count)
    )
    for name in [*HOSTILE, "painted.obj", "largest.dae", "largest.stl"]:
        command = [sys.executable, "-P", "-c", PEAK, str(tmp_path), name]
        assert int(subprocess.run(command, capture_output=True, check=True, timeout=120).stdout) < 1_024, name

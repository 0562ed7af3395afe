import errno
import json
import math
import os
from pathlib import Path

import pytest
from support.samples import moving, static

import tfbus
from tfbus import Buffer, Bus, MissingRecordingError, RecordingError, Transform, TransformStamped, TransformTree
from tfbus.recording import load_static, save_static

HALF = math.sqrt(0.5)


def test_what_was_saved_is_read_back_to_the_last_bit(tmp_path: Path) -> None:
    samples = [
        TransformStamped("base", "lidar", 0, Transform.from_xyz_rpy((0.1, 1e-300, -3), (1, 2, 3)), "me", static=True),
        static("base", "雷达"),
    ]
    for name in ("calibration.json", "calibration.yaml"):
        save_static(tmp_path / name, samples)
        assert load_static(tmp_path / name) == samples
    save_static(tmp_path / "empty.json", [])
    assert load_static(tmp_path / "empty.json") == []


def test_of_a_buffer_or_a_tree_the_static_frames_are_saved(tmp_path: Path) -> None:
    file = tmp_path / "calibration.json"
    with Bus() as bus, Buffer(bus) as buffer:
        bus.publish([moving("map", "base", 5), static("base", "lidar", 2.0, 7, "tape"), static("base", "camera")])
        for source in (buffer, buffer.tree):
            tfbus.save_static(file, source)
            assert tfbus.load_static(file) == [static("base", "camera"), static("base", "lidar", 2.0, 0, "tape")]
    tfbus.save_static(file, TransformTree())
    assert tfbus.load_static(file) == []


def test_moving_samples_are_refused_by_name_and_nothing_is_written(tmp_path: Path) -> None:
    file = tmp_path / "calibration.json"
    samples = [static("base", "lidar"), moving("map", "base", 5), moving("base", "arm", 5), moving("base", "arm", 6)]
    tree = TransformTree()
    tree.insert(moving("map", "base", 5))
    for source, named in (
        (samples, "'base', 'arm'"),
        (tree, "'base'"),
        ([moving("a", f"{i}", 1) for i in range(12)], "2 more"),
        ([moving("a", "b", i) for i in range(12)], "these move: 'b'"),
    ):
        with pytest.raises(ValueError, match="only static transforms are saved, but these move: ") as caught:
            save_static(file, source)
        assert str(caught.value).endswith(named)
    with pytest.raises(TypeError, match="expected a buffer, a tree or samples, not 5"):
        save_static(file, 5)  # type: ignore[arg-type]
    assert not file.exists()


def test_plain_data_of_samples_are_entries_and_a_tree_is_filled_by_them(tmp_path: Path) -> None:
    file = tmp_path / "a.json"
    entries = [static("base", "lidar", 2.0, 5, "survey"), moving("base", "camera", 7, 3.0)]
    file.write_text(json.dumps([entry.to_dict() for entry in entries]))
    found = load_static(file, authority="me")
    assert found == [static("base", "lidar", 2.0, 0, "survey"), static("base", "camera", 3.0, 0, "me")]
    tree = TransformTree()
    tree.insert_many(found)
    assert tree.lookup("base", "lidar").transform.translation == (2.0, 0.0, 0.0)


def test_a_file_written_by_hand_has_angles_in_either_unit(tmp_path: Path) -> None:
    pytest.importorskip("ruamel.yaml", reason="the extra bag is not installed")
    file = tmp_path / "calibration.yaml"
    file.write_text(
        """
        # The camera was measured on Monday.
        - {parent: base, child: camera, xyz: [1, 0, 0.5], rpy: [0, 0, 1.5707963267948966]}
        - {parent: base, child: lidar, rpy_deg: [0, 0, 90], authority: tape measure}
        - {parent: base, child: imu, quaternion: [0, 0, 1, 0]}
        - {parent: base, child: plate}
        """
    )
    camera, lidar, imu, plate = load_static(file, authority="me")
    assert camera.transform.is_close(Transform((1, 0, 0.5), (0, 0, HALF, HALF)))
    assert lidar.transform.is_close(Transform((0, 0, 0), (0, 0, HALF, HALF)))
    assert imu.transform.rotation == (0.0, 0.0, 1.0, 0.0)
    assert plate.transform == Transform()
    assert [sample.authority for sample in (camera, lidar, imu, plate)] == ["me", "tape measure", "me", "me"]


def entry(fields: str) -> bytes:
    return f'[{{"parent": "a", "child": "b", {fields}}}]'.encode()


LAUGHS = [f"&a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 12)]


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b'{"parent": "a", "child": "b"}', "it is not a list of transforms"),
        (b"[3]", "transform 1: expected a parent, a child and numbers, not 3"),
        (b"[1, {}, []]", "transform 1: "),
        (b'[{"child": "b"}]', "transform 1: it has no 'parent'"),
        (b'[{"parent": "a"}]', "transform 1: it has no 'child'"),
        (b'[{"parent": 1, "child": "b"}]', "transform 1: "),
        (b'[{"parent": ["a"], "child": "b"}]', "transform 1: "),
        (b'[{"parent": "a", "child": "b"}, {"parent": "a", "child": "a"}]', "transform 2: frame 'a' cannot be its own"),
        (entry('"zyx": []'), "transform 1: it has an unknown 'zyx'"),
        (entry('"xyz": [1, 2]'), "'xyz' is a list of 3 numbers, not [1, 2]"),
        (entry('"xyz": [1, 2, "3"]'), "'xyz' is a list of 3 numbers"),
        (entry('"xyz": [1, 2, true]'), "'xyz' is a list of 3 numbers"),
        (entry('"xyz": "abc"'), "'xyz' is a list of 3 numbers"),
        (entry('"xyz": [1e400, 1, 1]'), "transform 1: "),
        (entry(f'"xyz": [1{"0" * 400}, 1, 1]'), "transform 1: "),
        (entry('"quaternion": [0, 0, 0, 0]'), "transform 1: "),
        (entry('"rpy": [0, 0, 0], "rpy_deg": [0, 0, 0]'), "rpy and rpy_deg say the same"),
        (entry('"rotation": [0, 0, 0, 1], "quaternion": [0, 0, 0, 1]'), "say the same"),
        (entry('"authority": 1'), "transform 1: "),
        (entry('"transform": 1'), "transform 1: "),
        (b"\xff\xfe", "it is neither YAML nor JSON"),
        (b"[" * 700, ""),
        (b"- " * 10_000, ""),
        (b"? [a]\n: 1\n", ""),
        (b"- 2026-99-99\n- !!python/object:os.system {}\n", ""),
        # Aliases of aliases stand for billions of values.
        ("\n".join(["- &a0 [x]", *(f"- {each}" for each in LAUGHS)]).encode(), ""),
        (
            "\n".join(["a0: &a0 [x]", *(f"a{k}: {each}" for k, each in enumerate(LAUGHS, 1))]).encode()
            + b"\nlist:\n- {parent: a, child: b, xyz: *a11}\n",
            "",
        ),
        (f"- {{parent: a, child: b, xyz: [&a [{', '.join(['1'] * 9)}], *a, *a]}}\n".encode(), ""),
    ],
)
def test_a_wrong_or_hostile_file_is_an_error_of_bounded_length_that_names_the_entry(
    content: bytes, why: str, tmp_path: Path
) -> None:
    file = tmp_path / "a.yaml"
    file.write_bytes(content)
    with pytest.raises(RecordingError) as refused:
        load_static(file)
    assert why in str(refused.value)
    assert refused.value.path == str(file)
    assert len(str(refused.value)) < 1_500


def test_a_file_that_is_not_there_or_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"^file .*: there is no such file") as missing:
        load_static(tmp_path / "a.json")
    assert isinstance(missing.value, MissingRecordingError)
    with pytest.raises(RecordingError) as unreadable:
        load_static(tmp_path)
    assert str(unreadable.value) == f"file {str(tmp_path)!r}: it cannot be read: {os.strerror(errno.EISDIR)}"
    assert unreadable.value.reason == "unreadable"


def test_what_convert_writes_is_read(tmp_path: Path) -> None:
    pytest.importorskip("ruamel.yaml", reason="the extra bag is not installed")
    file = tmp_path / "statics.yaml"
    file.write_text(
        '- parent: "base"\n  child: "lidar"\n  translation: [1.0, 2.0, 3.0]\n  rotation: [0.0, 0.0, 1.0, 0.0]\n'
    )
    assert load_static(file) == [TransformStamped("base", "lidar", 0, Transform((1, 2, 3), (0, 0, 1, 0)), static=True)]

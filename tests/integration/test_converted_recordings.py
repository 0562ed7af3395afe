"""The files of `convert`, read by npm's reader of MCAP, and answered from by the real tf2."""

import base64
import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any, Literal

import pytest
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_typestore
from support.recorded import Line, write_mcap
from support.samples import static

from tfbus import SECOND, Transform, TransformStamped
from tfbus.recording import convert, load
from tfbus.tf_message import encode

pytestmark = pytest.mark.thorough

TYPES = get_typestore(Stores.ROS2_HUMBLE)
TF = "tf2_msgs/msg/TFMessage"
PACKAGES = ("@mcap/core@2", "fzstd@0.1")
START = 1_700_000_000 * SECOND

READ = """
const { McapStreamReader } = require("@mcap/core");
const { decompress } = require("fzstd");
const zstd = (buffer, size) => decompress(new Uint8Array(buffer), new Uint8Array(Number(size)));
const reader = new McapStreamReader({ decompressHandlers: { zstd }, validateCrcs: true });
reader.append(require("fs").readFileSync(process.argv[2]));
const channels = new Map();
for (let record; (record = reader.nextRecord()); ) {
  if (record.type === "Channel") channels.set(record.id, record);
  if (record.type !== "Message") continue;
  const data = Buffer.from(record.data).toString("base64");
  const { topic, messageEncoding } = channels.get(record.channelId);
  console.log(JSON.stringify([topic, messageEncoding, String(record.logTime), data]));
}
if (!reader.done()) throw new Error("the file ends too early");
"""

ASK_TF2 = """
import json, sys
import tf2_py
from geometry_msgs.msg import TransformStamped
from rclpy.duration import Duration
from rclpy.time import Time
asked = json.load(sys.stdin)
core = tf2_py.BufferCore(Duration(seconds=100_000))
for parent, child, stamp, numbers, static in asked["samples"]:
    message = TransformStamped()
    message.header.frame_id, message.child_frame_id = parent, child
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
    t, r = message.transform.translation, message.transform.rotation
    t.x, t.y, t.z, r.x, r.y, r.z, r.w = numbers
    (core.set_transform_static if static else core.set_transform)(message, "convert")
answers = []
for target, source, stamp in asked["questions"]:
    found = core.lookup_transform_core(target, source, Time(nanoseconds=stamp)).transform
    t, r = found.translation, found.rotation
    answers.append([t.x, t.y, t.z, r.x, r.y, r.z, r.w])
print(json.dumps(answers))
"""


def arm(k: int) -> list[TransformStamped]:
    """Two moving joints, a tenth of a second apart."""
    stamp = START + k * SECOND // 10
    return [
        TransformStamped("map", "base", stamp, Transform.from_xyz_rpy((k / 7, -k / 3, 0.1), (0.1, 0.2, k / 5))),
        TransformStamped("base", "arm", stamp, Transform.from_axis_angle((1.0, 2.0, 3.0), k / 4, (0.0, 0.3, k / 11))),
    ]


@pytest.fixture
def source(tmp_path: Path) -> Path:
    mount = Transform.from_xyz_rpy((0.1, 0.2, 0.3), (0.4, 0.5, 0.6))
    lines: list[Line] = [
        (START, "/tf_static", [static("arm", "camera", 1.0), TransformStamped("base", "rig", 0, mount, static=True)])
    ]
    lines += [(START + k * SECOND // 10 + 5, "/tf", arm(k)) for k in range(60)]
    return write_mcap(tmp_path / "source.mcap", lines)


@pytest.fixture(scope="module")
def node(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with npm's packages and the script that reads a file."""
    if not (shutil.which("node") and shutil.which("npm")):
        pytest.skip("node and npm are not installed")
    folder = tmp_path_factory.mktemp("node")
    command = ["npm", "install", "--no-audit", "--no-fund", *PACKAGES]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"npm cannot install {' and '.join(PACKAGES)}: {done.stderr[-200:]}")
    (folder / "read.js").write_text(READ)
    return folder


def test_npm_s_reader_finds_the_same_messages(tmp_path: Path, source: Path, node: Path) -> None:
    database = tmp_path / "run.db3"
    convert([source], database)
    schemas: tuple[Literal["ros", "foxglove"], ...] = ("ros", "foxglove")
    for schema in schemas:
        path = tmp_path / f"{schema}.mcap"
        convert([database], path, schema=schema)
        read = subprocess.run(["node", "read.js", str(path)], cwd=node, capture_output=True, text=True, check=True)
        found = [json.loads(line) for line in read.stdout.splitlines()]
        with path.open("rb") as file:
            expected = [
                [
                    channel.topic,
                    channel.message_encoding,
                    str(message.log_time),
                    base64.b64encode(message.data).decode(),
                ]
                for _, channel, message in make_reader(file).iter_messages()
            ]
        assert found == expected
        if schema == "ros":
            payloads = [base64.b64decode(data) for *_, data in found]
            assert payloads[1:] == [encode(arm(k)) for k in range(60)]
            assert all(encoding == "cdr" for _, encoding, _, _ in found)


@pytest.fixture(scope="module")
def ros2python() -> str:
    """A Python of ROS 2 with the real tf2."""
    for python in (os.environ.get("ROS2PYTHON", ""), "ros2python", "python3", "/usr/bin/python3"):
        path = shutil.which(python) if python else None
        if (
            path
            and not subprocess.run([path, "-c", "import tf2_py, rclpy"], capture_output=True, check=False).returncode
        ):
            return path
    pytest.skip("no Python has ROS 2's tf2_py; ROS2PYTHON names one")


def numbers_of(transform: Any) -> list[float]:
    return [getattr(transform.translation, axis) for axis in "xyz"] + [
        getattr(transform.rotation, axis) for axis in "xyzw"
    ]


def test_the_real_tf2_gives_the_same_answers_from_what_convert_wrote(
    tmp_path: Path, source: Path, ros2python: str
) -> None:
    database, path = tmp_path / "run.db3", tmp_path / "run.mcap"
    convert([source], database)
    convert([database], path)
    samples = []
    # Decoded by the official reader and by rosbags, not by tfbus.
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            decoded: Any = TYPES.deserialize_cdr(message.data, TF)
            for each in decoded.transforms:
                stamp = each.header.stamp.sec * SECOND + each.header.stamp.nanosec
                samples.append(
                    (
                        each.header.frame_id,
                        each.child_frame_id,
                        stamp,
                        numbers_of(each.transform),
                        "static" in channel.topic,
                    )
                )
    tree = load(source)
    questions = [
        (target, child, START + k * 77_777_777)
        for k in range(75)
        for target, child in (("map", "arm"), ("map", "camera"), ("camera", "rig"), ("rig", "map"))
    ]
    asked = json.dumps({"samples": samples, "questions": questions})
    done = subprocess.run([ros2python, "-c", ASK_TF2], input=asked, capture_output=True, text=True, check=True)
    answers = json.loads(done.stdout)
    assert len(answers) == len(questions) == 300
    for (target, child, stamp), answer in zip(questions, answers, strict=True):
        ours = tree.lookup(target, child, stamp).transform
        assert ours.is_close(Transform(answer[:3], answer[3:])), (target, child, stamp)

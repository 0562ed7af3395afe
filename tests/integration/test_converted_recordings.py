"""The files of `convert`, read by npm's reader of MCAP."""

import base64
import json
import shutil
import subprocess
from pathlib import Path
from typing import Literal

import pytest
from mcap.reader import make_reader
from support.recorded import Line, write_mcap
from support.samples import static

from tfbus import SECOND, Transform, TransformStamped
from tfbus.recording import convert
from tfbus.tf_message import encode

pytestmark = pytest.mark.thorough

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

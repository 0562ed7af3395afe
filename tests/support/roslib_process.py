"""A client of rosbridge that is not ours: npm's roslib, in a process of its own."""

import json
import shutil
import subprocess
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import anyio
import anyio.to_thread
import pytest

_PROGRAM = """
import { Ros, Topic } from "roslib";
const say = (fact) => console.log(JSON.stringify(fact));
const ros = new Ros({ url: process.argv[2] });
ros.on("error", (error) => { say({ error: String(error) }); process.exit(1); });
ros.on("connection", () => {
  for (const name of ["/tf_static", "/tf"]) {
    const topic = new Topic({ ros, name, messageType: "tf2_msgs/TFMessage" });
    topic.subscribe((message) => say({ topic: name, transforms: message.transforms }));
  }
  say({ connected: true });
});
"""


def install_roslib(folder: Path) -> None:
    """Install roslib into a folder; skips the test if it cannot be had."""
    node, npm = shutil.which("node"), shutil.which("npm")
    if node is None or npm is None:
        pytest.skip("roslib needs node and npm")
    (folder / "package.json").write_text('{"private": true, "type": "module"}')
    command = [npm, "install", "roslib", "--no-audit", "--no-fund"]
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)
    except subprocess.TimeoutExpired:
        pytest.skip("npm does not answer")
    if done.returncode:
        pytest.skip(f"npm cannot install roslib: {done.stderr[-200:]}")
    (folder / "listen.js").write_text(_PROGRAM)


@asynccontextmanager
async def roslib_client(folder: Path, url: str) -> AsyncIterator[list[dict[str, Any]]]:
    """The transforms that roslib, subscribed to ``/tf`` and ``/tf_static``, has heard."""
    heard: list[dict[str, Any]] = []
    async with (
        await anyio.open_process(["node", "listen.js", url], cwd=folder, stderr=None) as process,
        anyio.create_task_group() as tasks,
    ):
        connected = anyio.Event()

        async def read() -> None:
            rest = b""
            assert process.stdout is not None
            async for piece in process.stdout:
                *lines, rest = (rest + piece).split(b"\n")
                for line in lines:
                    fact = json.loads(line)
                    assert "error" not in fact, fact
                    if "connected" in fact:
                        connected.set()
                    else:
                        heard.append(fact)

        tasks.start_soon(read)
        try:
            with anyio.fail_after(30):
                await connected.wait()
            yield heard
        finally:
            process.kill()
            tasks.cancel_scope.cancel()

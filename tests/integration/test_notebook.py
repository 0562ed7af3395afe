"""A tree, a buffer and a loaded recording in a real kernel of Jupyter."""

from collections.abc import Iterator
from typing import Any

import pytest

pytest.importorskip("ipykernel", reason="a kernel needs ipykernel")

from jupyter_client.manager import KernelManager
from support.recorded import SMALL

pytestmark = [
    pytest.mark.thorough,
    # The packages of Jupyter warn of things that are not about tfbus.
    pytest.mark.filterwarnings("ignore"),
]

PATIENCE = 60.0


class Kernel:
    """A kernel that runs cells as a notebook does."""

    def __init__(self) -> None:
        self._manager = KernelManager()
        self._manager.start_kernel()
        self._client = self._manager.client()
        self._client.start_channels()
        self._client.wait_for_ready(timeout=PATIENCE)

    def run(self, cell: str) -> dict[str, Any]:
        """The output that a cell displays for its last line, by kind."""
        shown: list[dict[str, Any]] = []

        def note(message: dict[str, Any]) -> None:
            assert message["msg_type"] != "error", message["content"]
            if message["msg_type"] == "execute_result":
                shown.append(message["content"]["data"])

        reply = self._client.execute_interactive(cell, timeout=PATIENCE, output_hook=note)
        assert reply["content"]["status"] == "ok", reply
        [data] = shown
        return data

    def close(self) -> None:
        self._client.stop_channels()
        self._manager.shutdown_kernel(now=True)


@pytest.fixture(scope="module")
def kernel() -> Iterator[Kernel]:
    kernel = Kernel()
    yield kernel
    kernel.close()


def test_a_tree_a_buffer_and_a_recording_draw_themselves(kernel: Kernel) -> None:
    fill = "from tfbus import *; sample = TransformStamped('map', 'base', 5, Transform(), 'me')"
    tree = kernel.run(f"{fill}; tree = TransformTree(); tree.insert(sample); tree")
    buffer = kernel.run(f"{fill}; bus = Bus(); buffer = Buffer(bus); bus.publish(sample); buffer")
    recording = kernel.run(f"from tfbus.recording import load; load({str(SMALL)!r})")
    for data in (tree, buffer):
        assert ">base</span>" in data["text/html"]
        assert "from &#x27;me&#x27;" in data["text/html"]
    assert "<pre" in recording["text/html"]
    assert "Hz" in recording["text/html"]


def test_a_lookup_is_awaited_at_the_top_level_of_a_cell(kernel: Kernel) -> None:
    kernel.run("import tfbus; bus = tfbus.Bus(); buffer = tfbus.Buffer(bus); repr(buffer)")
    publish = "bus.publish(tfbus.TransformStamped('map', 'base', 5, tfbus.Transform((1.0, 2.0, 0.0))))"
    waiting = "import asyncio; task = asyncio.ensure_future(buffer.lookup('map', 'base', timeout=60.0)); task.done()"
    assert kernel.run(waiting)["text/plain"] == "False"
    assert kernel.run(f"{publish}; (await task).transform.translation")["text/plain"] == "(1.0, 2.0, 0.0)"
    assert kernel.run("(await buffer.lookup('map', 'base')).stamp")["text/plain"] == "5"

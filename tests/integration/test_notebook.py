"""A tree, a buffer, a loaded recording and its figures in a real kernel of Jupyter."""

from base64 import b64decode
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
            if message["msg_type"] in ("display_data", "execute_result"):
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


def test_from_a_recording_to_a_figure_and_a_number_there_is_no_loop(kernel: Kernel) -> None:
    pytest.importorskip("matplotlib")
    kernel.run(f"""
import numpy as np
from tfbus.analysis import compare
from tfbus.plot import plot_errors, plot_path, plot_transforms
from tfbus.recording import load
tree = load({str(SMALL)!r})
path = tree.lookup_many("map", "base_link", tree.stamps("map", "base_link"))
path""")
    length = "float(np.linalg.norm(np.diff(path.translations, axis=0), axis=1).sum())"
    assert float(kernel.run(length)["text/plain"]) > 1.0
    draw = (
        "plot_transforms(tree, 'map', 'base_link')",
        "plot_path(tree, 'map', 'base_link')",
        "plot_errors(compare(tree, tree, 'map', 'base_link'))",
    )
    for cell in (*draw, f"import matplotlib.pyplot; {draw[0]}"):
        # Whether pyplot runs or not, there is one picture.
        shown = kernel.run(cell)
        assert len(b64decode(shown["image/png"])) > 10_000, cell
        assert b64decode(shown["image/png"]).startswith(b"\x89PNG")


def test_a_lookup_is_awaited_at_the_top_level_of_a_cell(kernel: Kernel) -> None:
    kernel.run("import tfbus; bus = tfbus.Bus(); buffer = tfbus.Buffer(bus); repr(buffer)")
    publish = "bus.publish(tfbus.TransformStamped('map', 'base', 5, tfbus.Transform((1.0, 2.0, 0.0))))"
    waiting = "import asyncio; task = asyncio.ensure_future(buffer.lookup('map', 'base', timeout=60.0)); task.done()"
    assert kernel.run(waiting)["text/plain"] == "False"
    assert kernel.run(f"{publish}; (await task).transform.translation")["text/plain"] == "(1.0, 2.0, 0.0)"
    assert kernel.run("(await buffer.lookup('map', 'base')).stamp")["text/plain"] == "5"

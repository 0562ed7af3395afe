import errno
import signal
from pathlib import Path
from typing import Any

import httpx
import pytest

pytest.importorskip("trimesh", reason="the live page needs trimesh")

from support.commands import Command, check_wrong_call
from support.processes import free_address, new_domain, start_tfbus
from support.recorded import SMALL, write_mcap
from support.samples import moving

from tfbus import Buffer, Bus, view

ROBOT = Path(__file__).parents[3] / "demos" / "robot_arm.urdf"


@pytest.mark.parametrize("backend", ["asyncio", pytest.param("trio", marks=pytest.mark.thorough)])
@pytest.mark.parametrize(
    "of",
    [
        ("--domain", "DOMAIN", "--listen", "ADDRESS"),
        pytest.param((str(SMALL), "--urdf", str(ROBOT)), marks=pytest.mark.thorough),
    ],
)
def test_the_page_of_a_recording_or_of_a_domain_is_served_until_ctrl_c(of: tuple[str, ...], backend: str) -> None:
    places = {"DOMAIN": new_domain(), "ADDRESS": free_address()}
    options = (places.get(word, word) for word in of)
    with start_tfbus("view", *options, "--port", "0", "--backend", backend) as view:
        address = view.output.expect("http://127.0.0.1:")
        assert httpx.get(address, trust_env=False).status_code == 200
        assert view.end(signal.SIGINT) == 130
    assert view.output.text == f"{address}\n"
    assert view.errors.text.splitlines()[-1] == "open this address in a browser; Ctrl-C ends it"


def test_a_recording_is_no_live_page_and_has_the_options_of_the_command(
    tmp_path: Path, tfbus: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[dict[str, object]] = []

    class OccupiedView(view.View):
        def __init__(self, bus: Bus, buffer: Buffer, port: int, **options: Any) -> None:
            asked.append({"port": port, "edges": len(buffer.tree.edges()), **options})
            super().__init__(bus, buffer, port, **options)

        async def __aenter__(self) -> "OccupiedView":
            raise OSError(errno.EADDRINUSE, "in use")

    monkeypatch.setattr(view, "View", OccupiedView)
    recording = write_mcap(tmp_path / "run.mcap", [(0, "/tf", [moving("map", "base", 5)])])
    options = "--fixed map --trail base --rate 5 --port 8081 --origin https://robot.example"
    check_wrong_call(tfbus("view", recording, *options.split()), "cannot use port 8081: in use")
    (given,) = asked
    named = {"origins": ("https://robot.example",), "fixed": "map", "trails": ("base",), "rate": 5.0, "live": False}
    by_default = {"host": "127.0.0.1", "urdf": None, "package_paths": (), "edit": (), "save": None, "title": "run.mcap"}
    assert given == {"port": 8081, "edges": 1, **named, **by_default}

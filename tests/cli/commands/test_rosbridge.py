import signal
import socket
from pathlib import Path

import pytest

pytest.importorskip("wsproto", reason="serving pages with roslib needs wsproto")

import httpx
from support.commands import Command, check_wrong_call
from support.processes import new_domain, start_tfbus

from tfbus import Bus


@pytest.mark.parametrize("backend", ["asyncio", pytest.param("trio", marks=pytest.mark.thorough)])
def test_the_address_is_printed_and_the_page_served_until_ctrl_c(backend: str, tmp_path: Path) -> None:
    page = tmp_path / "robot.html"
    page.write_text("<p>a robot</p>")
    domain = ("--domain", new_domain(), "--backend", backend)
    with start_tfbus("rosbridge", "--port", "0", "--page", str(page), *domain) as server:
        address = server.output.expect("ws://127.0.0.1:").strip()
        shown = address.replace("ws:", "http:")
        assert httpx.get(shown, trust_env=False).text == "<p>a robot</p>"
        server.errors.expect(f"the page is at {shown}")
        assert server.end(signal.SIGINT) == 130


def test_a_port_that_is_taken_and_a_page_that_is_not_there_are_usage_errors(tfbus: Command) -> None:
    async def wait(bus: Bus) -> None:
        await bus.clock.sleep(30.0)

    with socket.create_server(("127.0.0.1", 0)) as taken:
        done = tfbus.on_domain(wait, "rosbridge", "--port", str(taken.getsockname()[1]))
    check_wrong_call(done, "cannot listen at 127.0.0.1")
    check_wrong_call(tfbus("rosbridge", "--page", "nowhere.html"), "cannot read the page nowhere.html")

import socket

import httpx
import pytest

pytest.importorskip("viser", reason="the live page needs viser")

from support.viser_pages import viser_page

from tfbus.view._server import start_server, stop_server


def test_the_page_comes_from_the_loopback_and_nothing_is_printed(capfd: pytest.CaptureFixture[str]) -> None:
    with viser_page() as server:
        assert server.get_host() == "127.0.0.1"
        assert httpx.get(f"http://127.0.0.1:{server.get_port()}", trust_env=False).status_code == 200
        assert server.request_share_url() is None
    assert capfd.readouterr() == ("", "")


def test_taken_ports_are_passed_over() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        server = start_server("127.0.0.1", taken.getsockname()[1])
        try:
            assert server.get_port() > taken.getsockname()[1]
        finally:
            stop_server(server)


def test_the_port_after_the_last_one_is_not_tried() -> None:
    try:
        taken = socket.create_server(("127.0.0.1", 65_535))
    except OSError:
        pytest.skip("the last port is taken by another program")
    with taken, pytest.raises(OSError, match="in use"):
        start_server("127.0.0.1", 65_535)

import signal
import socket

import pytest

pytest.importorskip("foxglove", reason="serving Foxglove needs foxglove-sdk")

from support.commands import Command, check_wrong_call
from support.processes import new_domain, start_tfbus

from tfbus import Bus


@pytest.mark.parametrize("backend", ["asyncio", pytest.param("trio", marks=pytest.mark.thorough)])
def test_the_address_is_printed_and_served_until_ctrl_c(backend: str) -> None:
    domain = ("--domain", new_domain(), "--backend", backend)
    with start_tfbus("foxglove", "--port", "0", *domain) as server:
        address = server.output.expect("ws://127.0.0.1:")
        with socket.create_connection(("127.0.0.1", int(address.rpartition(":")[2]))):
            pass
        assert server.end(signal.SIGINT) == 130
    assert "Foxglove" in server.errors.text


def test_a_port_that_is_taken_is_a_usage_error(tfbus: Command) -> None:
    async def wait(bus: Bus) -> None:
        await bus.clock.sleep(30.0)

    with socket.create_server(("127.0.0.1", 0)) as taken:
        done = tfbus.on_domain(wait, "foxglove", "--port", str(taken.getsockname()[1]))
    check_wrong_call(done, "cannot listen at 127.0.0.1")

import errno
import os
import socket

import pytest
from support.commands import Command, check_wrong_call
from support.processes import free_address, new_domain, start_tfbus


@pytest.mark.thorough
@pytest.mark.parametrize("backend", ["asyncio", "trio"])
def test_programs_that_know_only_the_router_hear_each_other(backend: str) -> None:
    address, domain = free_address(), new_domain()
    options = ("--connect", address, "--domain", domain)
    with start_tfbus("router", "--listen", address, "--backend", backend) as router:
        assert router.errors.expect("routing") == f"routing at {address} …"
        with (
            start_tfbus("static", "base_link", "laser", "--xyz", "1", "2", "3", "--robot", "r1", *options),
            start_tfbus("echo", "base_link", "laser", "--robots", "r*", *options) as echo,
        ):
            assert echo.output.expect("Translation") == "- Translation: [1.000000, 2.000000, 3.000000] m"
        assert router.end() == 130


def test_an_address_in_use_is_a_usage_error(tfbus: Command) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"tcp/127.0.0.1:{server.getsockname()[1]}"
        done = tfbus("router", "--listen", address)
    check_wrong_call(done, f"cannot listen at {address}: {os.strerror(errno.EADDRINUSE)}")


def test_an_address_that_no_program_can_have_is_a_usage_error(tfbus: Command) -> None:
    check_wrong_call(tfbus("router", "--listen", "7447"), "an address is like tcp/")

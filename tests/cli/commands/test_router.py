import errno
import os
from pathlib import Path

import pytest
from support.commands import Command, check_wrong_call
from support.processes import free_address, new_domain, start_tfbus


@pytest.mark.thorough
@pytest.mark.parametrize("backend", ["asyncio", "trio"])
def test_programs_that_know_only_the_router_hear_each_other(backend: str) -> None:
    address, domain = free_address(), new_domain()
    options = ("--connect", address, "--domain", domain)
    with start_tfbus("router", "--listen", address, "--backend", backend) as router:
        assert router.errors.expect("routing") == f"routing at {address}, until Ctrl-C"
        with (
            start_tfbus("static", "base_link", "laser", "--xyz", "1", "2", "3", "--robot", "r1", *options),
            start_tfbus("echo", "base_link", "laser", "--robots", "r*", *options) as echo,
        ):
            assert echo.output.expect("Translation") == "- Translation: [1.000000, 2.000000, 3.000000] m"
            with start_tfbus("tree", *options) as tree:
                assert tree.wait() == 0
            assert tree.errors.text == f"hears 2 peers by a router at {address}\n"
        assert router.end() == 130


@pytest.mark.thorough
def test_routers_that_are_connected_are_as_one() -> None:
    addresses, domain = [free_address(), free_address()], ("--domain", new_domain())
    with (
        start_tfbus("router", "--listen", addresses[0]),
        start_tfbus("router", "--listen", addresses[1], "--connect", addresses[0]) as router,
        start_tfbus("broadcast", *domain, "--connect", addresses[0]),
        start_tfbus("listen", *domain, "--connect", addresses[1]) as listen,
    ):
        said = f"routing at {addresses[1]}, and on to {addresses[0]}, until Ctrl-C"
        assert router.errors.expect("routing") == said
        assert "INFO" in listen.output.expect("base_laser: ")


@pytest.mark.thorough
def test_a_router_announces_nobody_whom_its_file_of_rules_refuses(tmp_path: Path) -> None:
    file = tmp_path / "rules.json5"
    file.write_text(
        """{access_control: {
            enabled: true, default_permission: "allow",
            rules: [{
                id: "guests", messages: ["liveliness_token"], flows: ["ingress"], permission: "deny",
                key_exprs: ["tfbus/*/guest/@alive/**"],
            }],
            subjects: [{id: "all"}], policies: [{rules: ["guests"], subjects: ["all"]}],
        }}""",
        encoding="utf-8",
    )
    address, domain = free_address(), new_domain()
    options = ("--connect", address, "--domain", domain)
    with (
        start_tfbus("router", "--listen", address, "--config", str(file)),
        start_tfbus("static", "map", "base", "--robot", "r1", *options),
        start_tfbus("echo", "map", "base", "--robot", "guest", *options) as guest,
    ):
        guest.output.expect("Translation")
        with start_tfbus("tree", *options) as tree:
            assert tree.wait() == 0
    assert tree.errors.text == f"hears 1 peer by a router at {address}\n"


def test_a_file_of_settings_that_cannot_be_used_is_a_usage_error(tfbus: Command, tmp_path: Path) -> None:
    file = tmp_path / "rules.json5"
    check_wrong_call(tfbus("router", "--config", file), f"cannot read {file}: {os.strerror(errno.ENOENT)}")
    file.write_text("{no: 1}", encoding="utf-8")
    check_wrong_call(tfbus("router", "--config", file), f"zenoh does not take the settings in {file}: unknown field")

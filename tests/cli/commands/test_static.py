import json
import math
from collections.abc import Sequence

import pytest
from support.commands import check_wrong_call, command
from support.processes import new_domain
from support.programs import free_address, tfbus

from tfbus import Transform
from tfbus.cli.commands.static import describe

HALF = math.sqrt(0.5)
TURNED = (0.0, 0.0, HALF, HALF)
"""By 90 degrees about the third axis."""


def test_whoever_joins_later_gets_it_and_it_may_be_killed_and_started_with_other_numbers() -> None:
    domain = new_domain()
    with tfbus("static", "base_link", "laser", "--xyz", "0.1", "-2", ".5", "--domain", domain) as static:
        said = static.errors.expect("publishing")
        with tfbus("echo", "base_link", "laser", "--rate", "20", "--json", "--domain", domain) as echo:
            first = json.loads(echo.output.expect("{"))
            static.process.kill()
            turned = ("--rpy", "0", "0", "1.5707963267948966", "--domain", domain)
            with tfbus("static", "base_link", "laser", *turned):
                second = json.loads(echo.output.expect(r'"translation": \[0\.0, 0\.0, 0\.0\]'))
    assert said == (
        f"publishing 'laser' in 'base_link' on domain '{domain}', until Ctrl-C: xyz 0.1 -2 0.5 m, rpy 0 0 0 rad"
    )
    assert (first["target"], first["source"], first["static"]) == ("base_link", "laser", True)
    assert first["translation"] == [0.1, -2.0, 0.5]
    assert first["rotation"] == [0.0, 0.0, 0.0, 1.0]
    assert second["rotation"] == pytest.approx(TURNED)
    assert static.output.text == ""


@pytest.mark.parametrize("backend", ["asyncio", "trio"])
def test_a_quaternion_is_x_y_z_w_and_ctrl_c_ends_it_with_status_130(backend: str) -> None:
    domain, address = new_domain(), free_address()
    options = ("--domain", domain, "--backend", backend)
    turned = ("--quaternion", *map(str, TURNED), "--authority", "me", "--listen", address)
    with tfbus("static", "map", "odom", *turned, *options) as static:
        with tfbus("tree", "--duration", "0", "--json", "--connect", address, *options) as tree:
            assert tree.wait() == 0
        assert static.end() == 130
    assert json.loads(tree.output.text)["frames"]["odom"]["authority"] == "me"
    (line,) = static.errors.text.splitlines()
    assert line.endswith("xyz 0 0 0 m, rpy 0 0 1.5708 rad")


def test_the_transform_is_told_in_metres_and_radians() -> None:
    transform = Transform.from_xyz_rpy((1.5, 0.0, -0.25), (0.1, -0.2, 0.3))
    assert describe(transform) == "xyz 1.5 0 -0.25 m, rpy 0.1 -0.2 0.3 rad"


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (("a", "b", "--rpy", "0", "0", "1", "--quaternion", "0", "0", "0", "1"), "give one of them"),
        (("a", "b", "--quaternion", "0", "0", "0", "0"), "zero quaternion"),
        (("a", "b", "--quaternion", "0", "0", "0", "2"), "its norm is 2"),
        (("a", "b", "--xyz", "nan", "0", "0"), "not finite"),
        (("a", "b", "--rpy", "0", "inf", "0"), "not finite"),
        (("a", "b", "--xyz", "1", "2", "x"), "--xyz"),
        (("a", "b", "--xyz", "1", "2"), "--xyz"),
        (("a", "a"), "its own parent"),
        (("/a", "b"), "write 'a'"),
        (("a", "/b"), "write 'b'"),
        (("", "b"), "must not be empty"),
        (("a", "\udcff"), "UTF-8"),
        (("a",), "CHILD"),
    ],
)
def test_a_wrong_call_is_one_line_on_standard_error_and_status_2(
    arguments: Sequence[str], why: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    check_wrong_call(command("static", monkeypatch, capsys)(*arguments), why)

import json
import math
from collections.abc import Sequence

import anyio.lowlevel
import pytest
from support.commands import START, Command, check_wrong_call
from support.processes import new_domain
from support.programs import start_tfbus

from tfbus import Bus, Transform, TransformStamped

HALF = math.sqrt(0.5)
TURNED = (0.0, 0.0, HALF, HALF)
"""By 90 degrees about the third axis."""


@pytest.mark.parametrize(
    ("options", "transform", "authority", "numbers"),
    [
        ((), Transform(), "tfbus static", "xyz 0 0 0 m, rpy 0 0 0 rad"),
        (
            ("--xyz", "0.1", "-2", ".5", "--authority", "me"),
            Transform((0.1, -2.0, 0.5)),
            "me",
            "xyz 0.1 -2 0.5 m, rpy 0 0 0 rad",
        ),
        (
            ("--rpy", "0", "0", str(math.pi / 2)),
            Transform((0, 0, 0), TURNED),
            "tfbus static",
            "xyz 0 0 0 m, rpy 0 0 1.5708 rad",
        ),
        (
            ("--quaternion", *map(str, TURNED), "--xyz", "1", "2", "3", "--backend", "trio"),
            Transform((1, 2, 3), TURNED),
            "tfbus static",
            "xyz 1 2 3 m, rpy 0 0 1.5708 rad",
        ),
    ],
)
def test_it_publishes_one_static_transform_for_everybody_until_ctrl_c(
    tfbus: Command, options: Sequence[str], transform: Transform, authority: str, numbers: str
) -> None:
    received: list[TransformStamped] = []

    async def join_late(bus: Bus) -> None:
        await bus.clock.sleep(1.0)
        with bus.subscribe(received.extend):
            await anyio.lowlevel.checkpoint()

    done = tfbus.on_domain(join_late, "static", "base_link", "laser", *options, "--domain", "yard")
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr == f"publishing 'laser' in 'base_link' on domain 'yard', until Ctrl-C: {numbers}\n"
    (sample,) = received
    assert (sample.parent, sample.child, sample.stamp) == ("base_link", "laser", START)
    assert (sample.authority, sample.static) == (authority, True)
    assert sample.transform.is_close(transform)


@pytest.mark.thorough
def test_it_may_be_killed_and_started_again_with_other_numbers() -> None:
    domain = new_domain()
    with start_tfbus("static", "base_link", "laser", "--xyz", "0.1", "-2", ".5", "--domain", domain) as static:
        static.errors.expect("publishing")
        with start_tfbus("echo", "base_link", "laser", "--rate", "20", "--json", "--domain", domain) as echo:
            first = json.loads(echo.output.expect("{"))
            static.process.kill()
            turned = ("--rpy", "0", "0", str(math.pi / 2), "--domain", domain)
            with start_tfbus("static", "base_link", "laser", *turned):
                second = json.loads(echo.output.expect(r'"translation": \[0\.0, 0\.0, 0\.0\]'))
    assert (first["target"], first["source"], first["static"]) == ("base_link", "laser", True)
    assert (first["translation"], first["rotation"]) == ([0.1, -2.0, 0.5], [0.0, 0.0, 0.0, 1.0])
    assert second["rotation"] == pytest.approx(TURNED)
    assert static.output.text == ""


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
    arguments: Sequence[str], why: str, tfbus: Command
) -> None:
    check_wrong_call(tfbus("static", *arguments), why)

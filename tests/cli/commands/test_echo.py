import json
import signal
import subprocess
from collections.abc import Sequence

import pytest
from support.commands import check_wrong_call, command
from support.processes import new_domain
from support.programs import PATIENCE, TFBUS, free_address, tfbus

from tfbus import SECOND, Transform, TransformStamped, from_seconds
from tfbus.cli.commands.echo import describe, to_json

MOVING = TransformStamped(
    "map", "base_link", 1_700_000_000_000_000_001, Transform.from_xyz_rpy((1, -2, 0.5), (0, 0, -0.5))
)


def test_a_transform_is_printed_as_by_tf2_echo_with_its_age_and_both_frames() -> None:
    # sin(0.25) = 0.247404, cos(0.25) = 0.968912, and 0.5 rad are 28.647890 degrees.
    assert describe(MOVING, MOVING.stamp + SECOND // 4).split("\n") == [
        "At 1700000000.000000001 s, age 250 ms: 'base_link' in 'map'",
        "- Translation: [1.000000, -2.000000, 0.500000] m",
        "- Rotation: in quaternion (xyzw) [0.000000, 0.000000, -0.247404, 0.968912]",
        "            in rpy (rad)          [0.000000, 0.000000, -0.500000]",
        "            in rpy (deg)          [0.000000, 0.000000, -28.647890]",
    ]


def test_a_stamp_has_nine_decimals_also_before_the_beginning_of_time() -> None:
    assert describe(MOVING.replace(stamp=from_seconds(-1.5)), 0).startswith("At -1.500000000 s, age 1.5 s: ")


def test_a_static_transform_has_no_stamp_and_no_age() -> None:
    static = MOVING.replace(static=True)
    assert describe(static, 0).startswith("At any time: 'base_link' in 'map'\n")
    assert json.loads(to_json(static, 0))["age"] is None


def test_json_has_the_stamp_as_an_integer_and_the_age_in_seconds() -> None:
    line = to_json(MOVING, MOVING.stamp + SECOND // 4)
    assert "\n" not in line
    assert json.loads(line) == {
        "target": "map",
        "source": "base_link",
        "stamp": 1_700_000_000_000_000_001,
        "translation": [1.0, -2.0, 0.5],
        "rotation": list(MOVING.transform.rotation),
        "static": False,
        "age": 0.25,
    }


@pytest.mark.parametrize("backend", ["asyncio", "trio"])
def test_it_says_once_what_is_missing_and_prints_as_soon_as_nothing_is(backend: str) -> None:
    domain, address = new_domain(), free_address()
    options = ("--domain", domain, "--backend", backend)
    with tfbus("echo", "camera", "base_laser", "--rate", "10", "--json", "--listen", address, *options) as echo:
        waiting = echo.errors.expect("waiting")
        with tfbus("broadcast", "--connect", address, *options):
            missing = echo.errors.expect("waiting")
            with tfbus("static", "base_link", "camera", "--xyz", "0", "0", "1", "--connect", address, *options):
                answers = [json.loads(echo.output.expect("")) for _ in range(3)]
        assert echo.end() == 130
    assert waiting == f"waiting for transforms on domain '{domain}' …"
    assert missing == "waiting for 'base_laser' in 'camera': frame 'camera' is not known"
    assert echo.errors.text == f"{waiting}\n{missing}\n"
    assert [answer["translation"] for answer in answers] == [[0.1, 0.0, -0.8]] * 3
    stamps = [answer["stamp"] for answer in answers]
    assert stamps == sorted(stamps)


def test_a_dead_broadcaster_is_told_where_there_is_an_age_limit_and_forgiven_when_it_is_back() -> None:
    options = ("--domain", new_domain())
    with tfbus("broadcast", *options) as broadcaster:
        broadcaster.errors.expect("broadcasting")
        with tfbus("echo", "base_link", "base_laser", "--rate", "5", "--max-age", "0.5", *options) as echo:
            echo.output.expect(r"^At \d+\.\d{9} s, age .* ms: 'base_laser' in 'base_link'$")
            broadcaster.end(signal.SIGKILL)
            assert "from 'robot_tf_publisher'" in echo.errors.expect("waiting for 'base_laser' in 'base_link': frame")
            echo.output.skip()
            with tfbus("broadcast", *options):
                echo.output.expect("^At")
            echo.errors.expect("waiting for 'base_laser' in 'base_link': frame")
    # Once for each time, although it was asked five times a second.
    assert echo.errors.text.count("waiting for 'base_laser'") == 2


def test_a_static_path_is_printed_again_and_again() -> None:
    options = ("--domain", new_domain())
    with (
        tfbus("static", "base_link", "laser", *options),
        tfbus("echo", "laser", "base_link", "--rate", "20", *options) as echo,
    ):
        for _ in range(3):
            echo.output.expect("^At any time: 'base_link' in 'laser'$")


def test_a_reader_that_has_had_enough_is_no_traceback() -> None:
    options = ("--domain", new_domain())
    command = [TFBUS, "echo", "laser", "base_link", "--rate", "50", *options]
    with (
        tfbus("static", "base_link", "laser", *options),
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as echo,
    ):
        assert echo.stdout is not None
        assert echo.stderr is not None
        assert echo.stdout.readline().startswith("At")
        echo.stdout.close()
        assert echo.stderr.read() == ""
        assert echo.wait(PATIENCE) == 0


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (("map", "/base_link"), "write 'base_link'"),
        (("", "base_link"), "must not be empty"),
        (("map",), "SOURCE"),
        (("map", "base_link", "--rate", "0"), "--rate"),
        (("map", "base_link", "--max-age=-1"), "--max-age"),
    ],
)
def test_a_wrong_call_is_one_line_on_standard_error_and_status_2(
    arguments: Sequence[str], why: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    check_wrong_call(command("echo", monkeypatch, capsys)(*arguments), why)

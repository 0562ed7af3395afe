"""The demos as a user runs them."""

import asyncio
import cmath
import contextlib
import gc
import io
import json
import math
import random
import re
import runpy
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import quote

import anyio
import httpx
import pytest
import uvicorn
from support.processes import Program, free_ports
from support.samples import moving, static, tree_of
from websockets.asyncio.client import connect as connect_async
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin

import tfbus
from tfbus import Bus, SimulatedClock
from tfbus.cli.commands import tutorial
from tfbus.testing import simulate

DEMOS = Path(__file__).parents[2] / "demos"


def load(name: str) -> dict[str, Any]:
    return runpy.run_path(str(DEMOS / name))


def output_of(demo: str, *arguments: str, quiet: bool = False) -> list[str]:
    """The lines that a demo prints when it is run as a script."""
    command = [sys.executable, str(DEMOS / demo), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr == "" or not quiet
    return done.stdout.splitlines()


def printed_by(demo: str) -> list[str]:
    """The lines that a demo prints when its file is run in this process, which costs less than one of its own."""
    with contextlib.redirect_stdout(io.StringIO()) as output:
        runpy.run_path(str(DEMOS / demo), run_name="__main__")
    return output.getvalue().splitlines()


async def said_in_simulated_time(demo: str, capsys: pytest.CaptureFixture[str]) -> list[str]:
    """The lines that a demo prints when its main function is called with a clock of ours."""
    clock = SimulatedClock()
    main = load(demo)["main"]
    await simulate(clock, lambda: main(clock))
    return capsys.readouterr().out.splitlines()


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("demo", "lines"), [("future_transform", 3), ("two_robots", 8), ("message_filter", 8), ("robot_arm", 5)]
)
def test_a_demo_that_is_tested_in_simulated_time_runs_as_a_script(demo: str, lines: int) -> None:
    assert len(output_of(f"{demo}.py", quiet=True)) == lines


@pytest.mark.anyio
async def test_the_script_prints_what_the_command_prints(capsys: pytest.CaptureFixture[str]) -> None:
    await tutorial.run_robot(SimulatedClock(), duration=3.0)
    command = capsys.readouterr().out

    demo = load("robot_setup.py")
    clock = SimulatedClock()
    with anyio.move_on_after(30):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(lambda: demo["main"](clock))
            await clock.advance(3.5)
            tasks.cancel_scope.cancel()
    assert capsys.readouterr().out == command


@pytest.mark.anyio
async def test_a_detection_comes_out_80_ms_later_one_fails_at_once_and_one_times_out(
    capsys: pytest.CaptureFixture[str],
) -> None:
    now, old, unknown = await said_in_simulated_time("future_transform.py", capsys)
    # At 0.5 s the robot is at 0.5 m, its camera 0.3 m further, and the thing 2 m before that.
    assert now == "seen just now: after 80 ms: (2.800, 0.000, 0.500) in the map"
    assert old == (
        "seen a minute ago: after 0 ms: PastExtrapolationError: frame 'base_link': asked for -59.420 s, "
        "oldest sample is -0.080 s (59.3 s too early), from 'odometry'"
    )
    assert unknown == (
        "seen by an unknown camera: after 500 ms: LookupTimeoutError: no transform from 'arm_camera' to 'map' "
        "within 0.5 s: frame 'arm_camera' is not known, did you mean 'camera'?"
    )


@pytest.mark.thorough
def test_the_demo_of_a_drop_out_tells_how_far_off_each_answer_is() -> None:
    held, straight, refused, nearest = output_of("drop_out.py")
    # The chord of the turn since the sample, on a circle of radius 2 m and with 4 s a turn.
    assert f"{4 * math.sin(math.pi / 4 * 0.2):.2f} m off (extrapolated by 0.20 s, gap 0.00 s)" in held
    assert f"{2 - 2 * math.cos(math.pi / 4):.2f} m off (extrapolated by 0.00 s, gap 1.00 s)" in straight
    assert "between samples at 2.000 s and 3.000 s, which are 1 s apart" in refused
    assert f"{4 * math.sin(math.pi / 4 * 0.1):.2f} m off (extrapolated by 0.10 s, gap 0.00 s)" in nearest


@pytest.mark.anyio
async def test_one_robot_sees_the_gripper_of_another_with_the_same_frames(capsys: pytest.CaptureFixture[str]) -> None:
    *moments, heading, first, _, _, last = await said_in_simulated_time("two_robots.py", capsys)
    assert len(moments) == 3
    for seconds, line in zip((0.2, 0.6, 1.0), moments, strict=True):
        # The map's plane as complex numbers; each robot looks along its circle.
        angles = cmath.exp(0.5j * seconds), cmath.exp(1j * seconds)
        camera, gripper = 2 * angles[0] + 0.2j * angles[0], 3 * angles[1] + 0.5j * angles[1]
        seen = (gripper - camera) / (1j * angles[0])
        assert line == (
            f"after {seconds} s, gripper in map: ({gripper.real:.3f}, {gripper.imag:.3f}, 0.400); "
            f"robot2/gripper in robot1/camera: ({seen.real:.3f}, {seen.imag:.3f}, -0.600)"
        )
    assert heading == "'robot2/gripper' in 'robot1/camera', latest: 1.000 s"
    assert re.fullmatch(r"  robot1/camera -> robot1/base_link +static +from 'robot1'", first)
    assert re.fullmatch(r"  robot2/base_link <- robot2/gripper +static +from 'robot2'", last)


@pytest.mark.thorough
def test_the_demo_of_a_fleet_shows_what_each_view_brings() -> None:
    options = ["--robots", "12", "--frames", "3", "--rate", "10", "--processes", "2", "--seconds", "2"]
    heading, _, nobody, in_full, slowly, last = output_of("fleet.py", *options, quiet=True)
    assert heading.startswith("12 robots x 3 frames x 10 Hz in 2 processes, ")
    peers = [int(re.split("  +", line)[1]) for line in (nobody, in_full, slowly)]
    assert peers == [0, 10, 12]
    samples = [float(re.findall(r"cores +(\d+) ", line)[0]) for line in (nobody, in_full, slowly)]
    # At most what ten robots publish, and of all the newest samples once a second.
    assert samples[0] == 0
    assert 0 < samples[2] < samples[1] < 1.2 * 10 * 3 * 10
    assert last.startswith("the ten publish ")


@pytest.mark.thorough
def test_the_demo_of_clocks_is_as_far_off_as_its_clock_unless_it_corrects() -> None:
    pytest.importorskip("zenoh")
    assert output_of("clocks.py") == [
        "as it is: the clock of 'odometry' is 0.30 s ahead, the answer is 0.30 m off",
        "corrected: the clock of 'odometry' is 0.30 s ahead, the answer is 0.00 m off",
    ]


@pytest.mark.thorough
def test_the_demo_of_a_watch_redraws_no_more_than_can_be_seen() -> None:
    *redrawn, summary = output_of("watch.py")
    numbers = [re.findall(r"\d+\.\d+", line) for line in redrawn]
    # In a hurry ten times a second, with the sample of the turn before; then whenever 0.1 m is full at 2.4 mm a sample.
    hurried = [(0.0, 0.0), *((k / 10, 1.5 * (k / 10 - 0.01)) for k in range(1, 11))]
    crept = [(2.36 + 0.42 * k, 1.5 + 0.24 * (0.36 + 0.42 * k)) for k in range(7)]
    expected = [[f"{time:.2f}", f"{x:.3f}"] for time, x in hurried + crept]
    assert numbers == expected
    # While a redraw is held back, all samples but the last go by: of 9 at first, of 10 in a hurry, of 9 in a creep.
    assert summary == f"redrawn {len(expected)} times; {8 + 9 * 10 + 7 * 8} updates went by unseen"


@pytest.mark.anyio
async def test_the_demo_of_a_message_filter_places_five_detections_and_tells_of_the_other_two(
    capsys: pytest.CaptureFixture[str],
) -> None:
    lines = await said_in_simulated_time("message_filter.py", capsys)
    # At t s the robot is at t m, and what it sees is 2 m ahead; odometry is 80 ms late.
    placed = [f"x = {2.5 + 0.1 * tick:.3f} m, 80 ms after it was seen" for tick in range(5)]
    assert [line for line in lines if line.startswith("x")] == placed
    old, unknown = (line for line in lines if line.startswith("dropped"))
    assert old.startswith("dropped, too old: frame 'camera': asked for -59.300 s, oldest sample is -0.080 s")
    assert unknown.endswith("frame 'arm_camera' is not known, did you mean 'camera'?")
    assert lines[-1] == "7 detections, 5 placed, dropped: {'too old': 1, 'unknown frame': 1}"


@pytest.mark.anyio
async def test_what_the_camera_of_the_arm_sees_is_where_the_closed_form_puts_it(
    capsys: pytest.CaptureFixture[str],
) -> None:
    lines = await said_in_simulated_time("robot_arm.py", capsys)
    assert len(lines) == 5
    for detection, line in enumerate(lines):
        # Each is seen half way between two messages of the joints, 195 ms after the one before was placed.
        place = arm_sees(0.195 + 0.2 * detection)
        found = re.fullmatch(r"\((.+)\) in the base, after 5 ms; by the closed form \((.+)\)", line)
        assert found
        # Between two messages the joints are taken to move evenly: a tenth of a mm, and another half is rounded off.
        for numbers in found.groups():
            assert [float(number) for number in numbers.split(", ")] == pytest.approx(place, abs=7e-4)


def arm_sees(seconds: float) -> tuple[float, float, float]:
    """The position of a thing 0.6 m ahead of the camera, seen from the foot of the arm."""
    swing = math.sin(2.0 * seconds)
    pan, angles = 1.2 * swing, (0.4 * swing, (0.4 - 0.9) * swing, (0.4 - 0.9 + 0.8) * swing)
    parts = (0.4, 0.35, 0.1 + 0.05 + 0.6)
    reach = sum(part * math.cos(angle) for part, angle in zip(parts, angles, strict=True))
    height = 0.5 - sum(part * math.sin(angle) for part, angle in zip(parts, angles, strict=True))
    return reach * math.cos(pan), reach * math.sin(pan), height


@pytest.mark.thorough
def test_the_demo_of_a_recording_finds_the_camera_where_it_was_and_keeps_the_file(tmp_path: Path) -> None:
    path = tmp_path / "kept.mcap"
    expected = []
    for second in (1, 2, 4):
        # The map's plane as complex numbers: 2 m from its origin, and 0.3 m on along the circle.
        camera = (2 + 0.3j) * cmath.exp(2j * math.pi * second / 8)
        expected.append(f"({camera.real:.3f}, {camera.imag:.3f}, 0.500) at {second}.00 s")
    for arguments in ([], [str(path)]):
        assert output_of("record_and_replay.py", *arguments, quiet=True) == [
            # 50 a second for 8 s with both ends, and the camera's place.
            "recorded: 402 samples",
            *(f"the camera was at {place}" for place in expected),
            f"and once more at {expected[-1]}",
        ]
    assert path.stat().st_size > 0


@pytest.mark.thorough
def test_the_demo_of_a_scan_makes_a_wall_straight_that_was_seen_bent() -> None:
    late, bent, straight, by_now = output_of("deskew.py")
    assert late == "the transform of the last ray came 30 ms late"
    # Each ray's way to the wall, drawn from where the robot was at the first ray.
    xs = []
    for ray in range(181):
        angle, seconds = math.pi / 2 * (ray / 180 - 0.5), 0.1 * ray / 180
        xs.append((3.0 - 2.0 * seconds) / math.cos(angle + 1.5 * seconds) * math.cos(angle))
    assert bent == f"all rays at one instant: the wall is {min(xs):.3f} m to {max(xs):.3f} m away"
    assert straight == "each ray at its own: the wall is 3.000 m to 3.000 m away"
    # The plane as complex numbers: the robot has driven 0.2 m and turned by 0.15 rad.
    seen = (3.0 - 0.2) * cmath.exp(-0.15j)
    assert by_now == f"seen straight ahead at first, and by now at ({seen.real:.3f}, {seen.imag:.3f})"


@pytest.mark.thorough
def test_the_demo_of_a_path_agrees_with_the_cycloid_that_the_tool_goes_along() -> None:
    path, *speeds, body, late = output_of("path_and_velocity.py")
    velocities = [abs(0.5 + 2j * cmath.exp(0.001j * (k + 0.5))) for k in range(10_000)]
    assert path == f"10001 positions, a path of {0.001 * math.fsum(velocities):.3f} m"
    assert len(speeds) == 3
    for second, line in zip((1, 3, 5), speeds, strict=True):
        speed = abs(0.5 + 2j * cmath.exp(1j * second))
        assert line == f"at {second} s: {speed:.3f} m/s, by the closed form {speed:.3f} m/s; 1.000 rad/s"
    assert body == f"the table at 0.500 m/s carries the tool at {abs(0.5 + 2j * cmath.exp(5j)):.3f} m/s"
    assert late == "at 5 s and 11 s there is an answer: [True, False]"


def test_the_demo_of_a_boat_finds_the_buoy_20_m_ahead_by_its_compass() -> None:
    pyproj = pytest.importorskip("pyproj", reason="needs pyproj")
    demo = load("gps_map.py")
    spots = [tuple(map(float, line.partition(": ")[2].split())) for line in printed_by("gps_map.py")]
    for (_, fix, heading), (latitude, longitude) in zip(demo["fixes"](), spots, strict=True):
        ahead, _, distance = pyproj.Geod(ellps="WGS84").inv(fix.longitude, fix.latitude, longitude, latitude)
        # The places are printed to a tenth of a metre.
        assert distance == pytest.approx(20.0, abs=0.2)
        assert math.remainder(ahead - heading, 360.0) == pytest.approx(0.0, abs=0.5)


def test_the_demo_of_a_lidar_in_a_picture_finds_each_pole_in_the_row_and_column_of_its_instant() -> None:
    demo = load("lidar_in_picture.py")
    for pole, line in zip(demo["POLES"], printed_by("lidar_in_picture.py"), strict=True):
        column, row = map(float, re.findall(r"(?:column|row) +([\d.]+)", line))
        angle = demo["TURN"] * demo["ROW_TIME"] * round(row)
        # Into the base that has turned by this angle, and to the camera 0.1 m ahead and 0.2 m above.
        ahead = math.cos(angle) * pole[0] + math.sin(angle) * pole[1] - 0.1
        left = math.cos(angle) * pole[1] - math.sin(angle) * pole[0]
        x, y = -left / ahead, (0.2 - pole[2]) / ahead
        radial = 1.0 - 0.1 * (x * x + y * y) + 0.01 * (x * x + y * y) ** 2
        assert (column, row) == pytest.approx((320.0 + 400.0 * x * radial, 240.0 + 400.0 * y * radial), abs=0.06)


@pytest.mark.thorough
def test_the_demo_of_drivers_in_threads_loses_nothing_and_keeps_each_drivers_order() -> None:
    refused, counted, apart = output_of("driver_threads.py")
    assert re.fullmatch(r"RuntimeError: .*bus\.threadsafe.*", refused)
    assert counted == "{'left_wheel': 50, 'right_wheel': 50}, in order: True, dropped: 0"
    # Each has gone 49 steps of 1 cm, the other way.
    assert apart == f"the wheels are {2 * 49 / 100:.2f} m apart"


@pytest.mark.thorough
def test_the_demo_of_ros_finds_the_wall_where_the_robot_saw_it() -> None:
    pytest.importorskip("cyclonedds", reason='pip install "tfbus[dds]"')
    # The laser is 0.2 m before the base, and sees the wall 4 m away.
    assert output_of("ros_bridge.py") == [f"hit {0.2 + 4.0:.2f} m before the place of the robot, in odom"]


@pytest.mark.thorough
def test_the_demo_of_rerun_logs_a_recording_and_a_bus_alike(tmp_path: Path) -> None:
    rerun = pytest.importorskip("rerun", reason="pip install rerun-sdk")
    chunk = pytest.importorskip("rerun.chunk")
    demo = load("rerun_frames.py")
    samples = [moving("map", "r 1/base", 1_700_000_000_123_456_789 + k, float(k)) for k in range(3)]
    samples.append(static("r 1/base", "lidar", 2.0))

    def log_bus() -> None:
        with Bus() as bus, bus.subscribe(demo["log_batch"]):
            bus.publish(samples)

    found = []
    for name, log in (("tree", lambda: demo["log_tree"](tree_of(*samples))), ("bus", log_bus)):
        with rerun.RecordingStream("test"):
            rerun.save(tmp_path / name)
            log()
            rerun.get_thread_local_data_recording().flush()
        rows: list[dict[str, Any]] = []
        for part in chunk.RrdReader(tmp_path / name).stream().to_chunks():
            if "Transform3D:translation" in part.to_record_batch().schema.names:
                rows += [{**row, "entity": part.entity_path} for row in part.to_record_batch().to_pylist()]
        poses = [
            (
                row["entity"],
                getattr(row.get("stamp"), "value", None),
                *(row[f"Transform3D:{name}"][0] for name in ("parent_frame", "child_frame", "translation")),
            )
            for row in rows
        ]
        found.append(sorted(poses, key=str))
    base = r"/tf/r\ 1\/base"
    assert (
        found[0]
        == found[1]
        == sorted(
            [
                *(
                    (base, sample.stamp, "map", "r 1/base", [float(k), 0.0, 0.0])
                    for k, sample in enumerate(samples[:3])
                ),
                ("/tf/lidar", None, "r 1/base", "lidar", [2.0, 0.0, 0.0]),
            ],
            key=str,
        )
    )


@pytest.mark.thorough
def test_the_demo_of_events_tells_the_story_of_the_tool() -> None:
    lines = output_of("events_and_ownership.py")
    (refused,) = (line for line in lines if line.startswith("refused"))
    assert refused.startswith("refused (reserved, owner 'arm'): frame 'gripper_tool' is reserved for 'arm'")
    found = [re.match(r"(\d+\.\d+) s: (.*)", line) for line in lines]
    events = [(float(match[1]), match[2]) for match in found if match]
    # Silent for more than 0.5 s after 1.0 s; taken up after 0.25 s, and held for 2 s.
    assert [(round(seconds, 3), text.partition(",")[0].partition(":")[0]) for seconds, text in events] == [
        (0.0, "moving frame 'base_link' is new under 'odom'"),
        (0.25, "static frame 'gripper_tool' is new under 'flange'"),
        (0.25, "a sample from 'other_arm' was rejected"),
        (1.5, "frame 'base_link' is stale"),
        (2.0, "frame 'base_link' is live again"),
        (2.25, "frame 'gripper_tool' was removed"),
        (2.25, "moving frame 'odom' is new under 'map'"),
        (2.25, "frame 'odom' comes from two authorities"),
    ]
    assert lines[-1] == "rejected: {'reserved': 1}, conflicts: 1"


@pytest.mark.parametrize(
    ("demo", "page"),
    [
        ("localisation", "localisation"),
        ("how_sure", "uncertainty"),
        pytest.param("scans_in_map", "recordings", marks=pytest.mark.thorough),
    ],
)
def test_a_demo_prints_what_its_page_says(demo: str, page: str) -> None:
    said = "\n".join(printed_by(f"{demo}.py"))
    assert f"```text\n{said}\n```" in (DEMOS / "guide" / f"{page}.md").read_text()


@pytest.mark.thorough
def test_the_programs_of_the_tutorial_meet_in_any_order_and_after_a_restart(monkeypatch: pytest.MonkeyPatch) -> None:
    with TemporaryDirectory() as folder:
        monkeypatch.setenv("TFBUS_RUNTIME_DIR", folder)
        with Program(sys.executable, DEMOS / "tf_listener.py") as listener:
            listener.output.expect("frame 'base_link' is not known")
            for _ in range(2):
                with Program(sys.executable, DEMOS / "tf_broadcaster.py") as broadcaster:
                    listener.output.expect(r"^base_link \(1.1, 0.2, 0.2\)$")
                    assert broadcaster.end() == 0
                    assert broadcaster.errors.text == ""
                listener.output.expect("asked for the latest|newest sample is")
            assert listener.end() == 0
        assert listener.errors.text == ""


@pytest.mark.thorough
def test_scans_of_another_process_are_placed_by_the_transforms_of_their_stamps(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("zenoh")
    with TemporaryDirectory() as folder:
        monkeypatch.setenv("TFBUS_RUNTIME_DIR", folder)
        assert output_of("scans_between_processes.py") == ["the wall is at x = 5.000 m in odom"] * 5


def test_the_demo_of_simulated_time_patrols_for_an_hour_and_jumps_back() -> None:
    *pictures, reset, on_the_base, on_the_map = printed_by("simulated_time.py")
    assert len(pictures) == 4
    for quarter, line in zip((1, 2, 3, 4), pictures, strict=True):
        # Half way and more between two samples a second apart, on a straight line between them.
        before, after = (cmath.exp(2j * math.pi * (900 * quarter - back) / 600) for back in (1, 0))
        place = 0.25 * before + 0.75 * after
        assert line == (
            f"picture at {900 * quarter - 0.25:.2f} s: ({place.real:.3f}, {place.imag:.3f}, 1.500), known 0.25 s later"
        )
    assert reset == "ClockResetError: the clock jumped back from 3601.000 s to 0.000 s"
    assert (on_the_base, on_the_map) == ("camera on the base: True", "camera on the map: False")


@contextlib.contextmanager
def web_application(*options: str) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """The web application under a real server on loopback: its address, and its process, which has its log."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        fd = str(listener.fileno())
        command = [sys.executable, "-m", "uvicorn", "web_app:app", "--fd", fd, "--app-dir", str(DEMOS), *options]
        with subprocess.Popen(command, pass_fds=[listener.fileno()], stderr=subprocess.PIPE, text=True) as process:
            assert process.stderr is not None
            for line in process.stderr:
                if "startup complete" in line:
                    break
            try:
                yield f"127.0.0.1:{listener.getsockname()[1]}", process
            finally:
                process.terminate()


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    """The address of the web application."""
    with web_application() as (address, process):
        yield address
        process.terminate()
        log = process.communicate(timeout=30)[1]
        assert "Traceback" not in log
        assert "shutdown complete" in log


def get(path: str) -> httpx.Response:
    return httpx.get(f"http://{path}", timeout=30, trust_env=False)


def is_on_its_circle(answer: dict[str, Any]) -> bool:
    x, y, _ = answer["transform"]["translation"]
    return math.hypot(x, y) == pytest.approx(1.0)


def test_the_web_application_answers_a_transform_as_json(server: str) -> None:
    response = get(f"{server}/transforms/robot1/base_link")
    assert response.status_code == 200
    answer = response.json()
    assert is_on_its_circle(answer)
    x, y, z = answer["transform"]["translation"]
    qx, qy, qz, qw = answer["transform"]["rotation"]
    # The robot looks along its circle, a quarter turn ahead of where it stands.
    assert (2 * qw * qz, 1 - 2 * qz * qz) == pytest.approx((x, -y))
    assert (z, qx, qy) == (0, 0, 0)


def test_the_web_application_streams_changes_as_events_and_to_a_socket(server: str) -> None:
    with httpx.stream("GET", f"http://{server}/changes/robot1/base_link", timeout=30, trust_env=False) as response:
        assert response.headers["content-type"].startswith("text/event-stream")
        lines = [line for line, _ in zip(response.iter_lines(), range(4), strict=False)]
    assert lines[1] == lines[3] == ""
    events = [json.loads(line.removeprefix("data: ")) for line in (lines[0], lines[2])]
    with connect(f"ws://{server}/poses/robot1/base_link", proxy=None) as poses:
        messages = [json.loads(poses.recv(timeout=30)) for _ in range(2)]
    for first, second in (events, messages):
        assert is_on_its_circle(first)
        assert is_on_its_circle(second)
        assert first["stamp"] < second["stamp"]


def test_the_web_application_has_a_page_and_shows_the_tree(server: str) -> None:
    assert get(server).headers["content-type"].startswith("text/html")
    assert [line.split()[-1] for line in get(f"{server}/tree").text.splitlines()] == [
        "map",
        "'odometry'",
        "'calibration'",
    ]


def test_the_web_application_waits_for_a_transform_of_the_future_as_long_as_it_may(server: str) -> None:
    now = get(f"{server}/transforms/robot1/base_link").json()["stamp"]
    response = get(f"{server}/transforms/robot1/base_link?at={now + 200_000_000}&timeout=10")
    assert (response.status_code, response.json()["stamp"]) == (200, now + 200_000_000)
    response = get(f"{server}/transforms/robot1/base_link?at={now + 3_600_000_000_000}&timeout=0.1")
    assert response.status_code == 504
    assert re.search(r"frame 'robot1/base_link': asked for .* short\), from 'odometry'", response.json()["message"])


def test_the_web_application_says_404_with_close_matches_for_an_unknown_frame(server: str) -> None:
    response = get(f"{server}/transforms/robot1/base_lnk?timeout=0.1")
    assert response.status_code == 404
    assert response.json()["cause"]["close_matches"][0] == "robot1/base_link"


@pytest.mark.parametrize(
    ("question", "status"), [("at=5", 410), ("timeout=nan", 422), ("at=99999999999999999999", 422), ("at=1.5", 422)]
)
def test_the_web_application_names_the_fault_of_a_question_without_an_answer(
    server: str, question: str, status: int
) -> None:
    assert get(f"{server}/transforms/robot1/base_link?{question}").status_code == status


@pytest.mark.parametrize("question", ["timeout=1e308", "timeout=inf", "timeout=60.1", "timeout=1e400"])
def test_the_web_application_holds_nothing_for_a_client_that_would_wait_for_ever(server: str, question: str) -> None:
    response = get(f"{server}/transforms/nowhere?{question}")
    assert response.status_code == 422
    assert "less than or equal to 60" in response.text


@pytest.mark.thorough
def test_the_web_application_streams_no_frame_that_nobody_has_published(server: str) -> None:
    assert get(f"{server}/changes/robot1/lazer").status_code == 404
    with connect(f"ws://{server}/poses/robot1/lazer", proxy=None) as poses:
        with pytest.raises(ConnectionClosed):
            poses.recv(timeout=30)
        assert poses.close_code == 4404


@pytest.mark.thorough
def test_nothing_stays_in_the_web_application_of_clients_that_have_left() -> None:
    async def leave(address: str, politely: bool) -> None:
        # A static transform changes once: after that, the service has nothing more to send.
        question = "robot1/laser?target=robot1/base_link"
        async with connect_async(f"ws://{address}/poses/{question}", proxy=None) as poses:
            await poses.recv()
            if not politely:
                poses.transport.abort()

    async def main() -> None:
        with socket.create_server(("127.0.0.1", 0)) as listener, anyio.fail_after(60):
            config = uvicorn.Config(load("web_app.py")["app"], log_level="error")
            service = uvicorn.Server(config)
            serving = asyncio.create_task(service.serve([listener]))
            while not service.started:  # noqa: ASYNC110 - uvicorn has no event
                await asyncio.sleep(0.01)
            before = len(asyncio.all_tasks())
            address = f"127.0.0.1:{listener.getsockname()[1]}"
            await asyncio.gather(*(leave(address, number % 2 == 0) for number in range(40)))
            while len(asyncio.all_tasks()) > before:  # noqa: ASYNC110
                await asyncio.sleep(0.01)
            gc.collect()
            assert not [thing for thing in gc.get_objects() if isinstance(thing, tfbus.Watch)]
            service.should_exit = True
            await serving

    asyncio.run(main())


def test_the_page_with_roslib_gets_the_robot_on_its_circle() -> None:
    pytest.importorskip("wsproto", reason="serving pages with roslib needs wsproto")
    (port,) = free_ports(1)
    command = [sys.executable, str(DEMOS / "tf_in_page.py"), str(port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            address = process.stdout.readline().strip()
            page = httpx.get(address, timeout=30, trust_env=False).text
            assert "new ROSLIB.TFClient(" in page
            with connect(address.replace("http:", "ws:"), proxy=None, origin=Origin(address)) as socket:
                goal = {"source_frames": ["laser"], "target_frame": "map", "rate": 20}
                request = {"op": "send_action_goal", "id": "1", "action": "/tf2_web_republisher", "action_type": ""}
                socket.send(json.dumps({**request, "args": goal, "feedback": True}))
                (found,) = json.loads(socket.recv(timeout=30))["values"]["transforms"]
        finally:
            process.terminate()
    x, y, z = found["transform"]["translation"].values()
    # The laser is 0.1 m ahead on the tangent of the circle of 1 m.
    assert (math.hypot(x, y), z) == pytest.approx((math.hypot(1.0, 0.1), 0.2))


@pytest.mark.parametrize("loop", ["asyncio", pytest.param("uvloop", marks=pytest.mark.thorough)])
def test_at_a_signal_the_web_application_ends_its_streams_and_waits(loop: str) -> None:
    pytest.importorskip(loop)

    async def main(address: str, process: subprocess.Popen[str]) -> None:
        begun = [asyncio.Event() for _ in range(40)]

        async def read_events(client: httpx.AsyncClient, begin: asyncio.Event) -> None:
            async with client.stream("GET", "/changes/robot1/laser") as response:
                # A stream that is cut off raises.
                async for _ in response.aiter_lines():
                    begin.set()

        async def read_poses(target: str, begin: asyncio.Event) -> None:
            async with connect_async(f"ws://{address}/poses/robot1/laser?target={target}", proxy=None) as poses:
                with contextlib.suppress(ConnectionClosed):
                    while await poses.recv():
                        begin.set()
            assert poses.close_code == 1012

        async def ask(client: httpx.AsyncClient) -> None:
            assert (await client.get("/transforms/nowhere?timeout=60")).status_code == 503

        limits = httpx.Limits(max_connections=None)
        async with (
            httpx.AsyncClient(base_url=f"http://{address}", timeout=60, trust_env=False, limits=limits) as client,
            asyncio.timeout(60),
            asyncio.TaskGroup() as tasks,
        ):
            for _ in range(20):
                tasks.create_task(ask(client))
            for begin in begun[:20]:
                tasks.create_task(read_events(client, begin))
            for begin, target in zip(begun[20:], 10 * ["map", "robot1/base_link"], strict=True):
                tasks.create_task(read_poses(target, begin))
            for begin in begun:
                await begin.wait()
            # The questions came first, so all of them wait by now.
            process.terminate()
        log = process.communicate(timeout=30)[1]
        assert "shutdown complete" in log
        assert "Traceback" not in log
        assert "ERROR" not in log

    with web_application("--loop", loop) as (address, process):
        asyncio.run(main(address, process))


def test_the_web_application_sends_nothing_to_pages_of_other_sites(server: str) -> None:
    port = server.rpartition(":")[2]
    for origin in ("http://evil.example", "null", f"http://127.0.0.1:{int(port) + 1}", f"https://{server}"):
        with (
            pytest.raises(InvalidStatus, match="403"),
            connect(f"ws://{server}/poses/robot1/base_link", origin=Origin(origin), proxy=None),
        ):
            pytest.fail("connected")
    with connect(f"ws://{server}/poses/robot1/base_link", origin=Origin(f"http://{server}"), proxy=None) as poses:
        assert is_on_its_circle(json.loads(poses.recv(timeout=30)))


def test_the_web_application_does_not_answer_to_other_names(server: str) -> None:
    for path in ("", "/tree", "/transforms/robot1/base_link", "/changes/robot1/base_link"):
        response = httpx.get(f"http://{server}{path}", headers={"Host": "evil.example"}, timeout=30, trust_env=False)
        assert response.status_code == 400
    evil = {"Host": "evil.example"}
    with (
        pytest.raises(InvalidStatus, match="400"),
        connect(f"ws://{server}/poses/robot1/base_link", additional_headers=evil, proxy=None),
    ):
        pytest.fail("connected")


@pytest.mark.thorough
def test_the_web_application_has_a_defined_answer_for_every_question(server: str) -> None:
    draw = random.Random(34)
    names = ["map", "robot1/base_link", " ", "%", "+", "🤖", "1_0", "'", "..", "x" * 500]
    pieces = ["9" * 401, "-", "1e308", "nan", "٣", "\0", *names]

    def text() -> str:
        return quote("".join(draw.choice(pieces) for _ in range(draw.randrange(1, 4))), safe="")

    with httpx.Client(base_url=f"http://{server}", timeout=30, trust_env=False) as client:
        for _ in range(300):
            target, frame = (draw.choice(["map", quote("robot1/base_link"), text()]) for _ in range(2))
            questions = [f"{draw.choice(['at', 'timeout', text()])}={text()}" for _ in range(draw.randrange(3))]
            response = client.get(f"/transforms/{frame}?{'&'.join([*questions, f'target={target}', 'timeout=0'])}")
            assert response.status_code in (200, 404, 410, 422, 504)


@pytest.mark.thorough
def test_the_live_view_serves_a_page_until_ctrl_c() -> None:
    with Program(sys.executable, DEMOS / "live_view.py") as demo:
        address = demo.output.expect("open http://127.0.0.1:").removeprefix("open ")
        assert httpx.get(address, trust_env=False).status_code == 200
        assert demo.end() == 0
    assert demo.output.text.splitlines()[1:] == ["the end"]
    assert demo.errors.text == ""

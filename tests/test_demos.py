"""The demos as a user runs them."""

import re
import runpy
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import anyio
import httpx
import pytest

from tfbus import SimulatedClock, tutorial
from tfbus.testing import simulate

DEMOS = Path(__file__).parent.parent / "demos"


def load(name: str) -> dict[str, Any]:
    return runpy.run_path(str(DEMOS / name))


@pytest.mark.anyio
async def test_the_script_prints_what_the_command_prints(capsys: pytest.CaptureFixture[str]) -> None:
    await tutorial.run(SimulatedClock(), duration=3.0)
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
    clock = SimulatedClock()
    demo = load("future_transform.py")
    await simulate(clock, lambda: demo["main"](clock))
    now, old, unknown = capsys.readouterr().out.splitlines()
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


def test_the_demo_of_future_transforms_runs_as_a_script() -> None:
    done = subprocess.run(
        [sys.executable, DEMOS / "future_transform.py"], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0
    assert len(done.stdout.splitlines()) == 3


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    """The web application under a real server on loopback; its address."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        fd = str(listener.fileno())
        command = [sys.executable, "-m", "uvicorn", "web_app:app", "--fd", fd, "--app-dir", str(DEMOS)]
        with subprocess.Popen(command, pass_fds=[listener.fileno()], stderr=subprocess.PIPE, text=True) as process:
            assert process.stderr is not None
            for line in process.stderr:
                if "startup complete" in line:
                    break
            yield f"http://127.0.0.1:{listener.getsockname()[1]}/transforms"
            process.terminate()
            log = process.communicate(timeout=30)[1]
            assert "Traceback" not in log
            assert "shutdown complete" in log


def get(url: str) -> httpx.Response:
    return httpx.get(url, timeout=30, trust_env=False)


def test_the_web_application_answers_a_transform_as_json(server: str) -> None:
    response = get(f"{server}/map/base_link")
    assert response.status_code == 200
    answer = response.json()
    x, y, z = answer["translation"]
    qx, qy, qz, qw = answer["rotation"]
    assert x * x + y * y == pytest.approx(1.0)
    # The robot looks along its circle, a quarter turn ahead of where it stands.
    assert (2 * qw * qz, 1 - 2 * qz * qz) == pytest.approx((x, -y))
    assert (z, qx, qy) == (0, 0, 0)


def test_the_web_application_waits_for_a_transform_of_the_future(server: str) -> None:
    stamp = get(f"{server}/map/base_link").json()["stamp"] + 200_000_000
    response = get(f"{server}/map/base_link?at={stamp}&timeout=10")
    assert (response.status_code, response.json()["stamp"]) == (200, stamp)


def test_the_web_application_says_504_when_the_time_is_up(server: str) -> None:
    stamp = get(f"{server}/map/base_link").json()["stamp"] + 3_600_000_000_000
    response = get(f"{server}/map/base_link?at={stamp}&timeout=0.1")
    assert response.status_code == 504
    assert re.search(r"frame 'base_link': asked for .* short\), from 'odometry'", response.json()["error"])


def test_the_web_application_says_404_with_close_matches_for_an_unknown_frame(server: str) -> None:
    response = get(f"{server}/map/base_lnk?timeout=0.1")
    assert response.status_code == 404
    assert response.json()["close_matches"] == ["base_link"]


@pytest.mark.parametrize("question", ["at=5", "at=1.5", "timeout=-1", "timeout=nan", "at=99999999999999999999"])
def test_the_web_application_says_400_for_a_question_without_an_answer(server: str, question: str) -> None:
    assert get(f"{server}/map/base_link?{question}").status_code == 400

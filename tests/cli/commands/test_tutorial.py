"""``tfbus broadcast``, ``tfbus listen`` and ``tfbus demo``."""

import re
import signal

import pytest
from support.commands import START, Command
from support.processes import new_domain, start_tfbus

from tfbus import SECOND, Buffer, Bus, SimulatedClock, Transform, TransformBroadcaster, TransformStamped
from tfbus.cli.commands import tutorial
from tfbus.testing import simulate

BACKENDS = ["asyncio", "trio"]
LASER = Transform((0.1, 0.0, 0.2))
ERROR = (
    'Received an exception trying to transform a point from "base_laser" to "base_link": '
    "no transform from 'base_laser' to 'base_link' within 0.5 s: "
)
LATE = rf"^\[ERROR\] \d+\.\d{{9}}: {ERROR}frame 'base_laser': newest sample is .* old, .*'robot_tf_publisher'$"
INFO = (
    r"^\[ INFO\] \d+\.\d{9}: base_laser: \(1\.00, 0\.20\. 0\.00\) -----> base_link: \(1\.10, 0\.20, 0\.20\) "
    r"at time \d+\.\d\d$"
)


def line(at: float, newest: float) -> str:
    return f"[ INFO] {at:.9f}: base_laser: (1.00, 0.20. 0.00) -----> base_link: (1.10, 0.20, 0.20) at time {newest:.2f}"


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_simulated_demo_prints_ten_lines_that_are_known_to_the_byte(tfbus: Command, backend: str) -> None:
    for _ in range(3):
        done = tfbus("demo", "--simulated", "--duration", "10", "--backend", backend)
        assert done.stdout.splitlines() == [line(second, second - 0.01) for second in range(1, 11)]
        assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(
    ("options", "times"),
    [
        # With a broadcast every 0.5 s, the line of 0.8 s has the transform of 0.5 s.
        (
            ("--duration", "0.8", "--rate", "2", "--listen-rate", "2.5"),
            [("0.400000000", "0.00"), ("0.800000000", "0.50")],
        ),
        (("--duration", "0.9"), []),
        (("--duration", "0.3", "--listen-rate", "10"), [(f"0.{k}00000000", f"0.{k - 1}9") for k in (1, 2, 3)]),
    ],
)
def test_the_number_of_lines_follows_from_duration_and_rate(
    tfbus: Command, options: tuple[str, ...], times: list[tuple[str, str]]
) -> None:
    done = tfbus("demo", "--simulated", *options)
    found = re.findall(r"^\[ INFO\] (\S+): .* at time (\S+)$", done.stdout, re.MULTILINE)
    assert found == times


def test_without_a_broadcaster_the_lines_say_which_frame_is_missing(tfbus: Command) -> None:
    done = tfbus("demo", "--simulated", "--duration", "2", "--no-broadcaster")
    assert (done.returncode, done.stderr) == (0, "")
    missing = [f"[ERROR] {second}.500000000: {ERROR}frame 'base_link' is not known" for second in (1, 2)]
    assert done.stdout.splitlines() == missing


@pytest.mark.anyio
async def test_a_transform_that_the_bus_refuses_is_logged_once_and_the_next_ones_are_sent(
    caplog: pytest.LogCaptureFixture,
) -> None:
    clock = SimulatedClock()
    with Bus(clock) as bus, Buffer(bus) as buffer:
        TransformBroadcaster(bus, authority="intruder").send("base_laser", "base_link", Transform())

        async def robot() -> None:
            for _ in range(2):
                with clock.move_on_after(1.0):
                    await tutorial.send_laser(bus)
                bus.remove_frame("base_link")

        await simulate(clock, robot)
        assert buffer.lookup_nowait("base_link", "base_laser").transform == LASER
    assert [record.getMessage() for record in caplog.records] == [
        "dropped a sample: the edge 'base_link' -> 'base_laser' would close a loop of parents: "
        "base_laser -> base_link -> base_laser, with edges from 'intruder'"
    ]


@pytest.mark.parametrize(("options", "rate"), [((), 100), (("--rate", "20", "--backend", "trio"), 20)])
def test_the_transform_of_the_laser_is_sent_at_the_rate_until_ctrl_c(
    tfbus: Command, options: tuple[str, ...], rate: int
) -> None:
    received: list[TransformStamped] = []

    async def listen(bus: Bus) -> None:
        with bus.subscribe(received.extend):
            await bus.clock.sleep(4.2 / rate)

    done = tfbus.on_domain(listen, "broadcast", "--domain", "yard", *options)
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr == f"broadcasting 'base_laser' in 'base_link' at {rate} Hz on domain 'yard', until Ctrl-C\n"
    assert received == [
        TransformStamped("base_link", "base_laser", START + tick * SECOND // rate, LASER, "robot_tf_publisher")
        for tick in range(5)
    ]


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_listener_waits_for_a_broadcaster_and_prints_a_line_a_period_from_then_on(
    tfbus: Command, backend: str
) -> None:
    async def broadcast(bus: Bus) -> None:
        for seconds in (2.0, 0.75):
            await bus.clock.sleep(seconds)
            bus.publish(TransformStamped("base_link", "base_laser", bus.clock.now(), LASER, "slam"))
        await bus.clock.sleep(1.9)

    done = tfbus.on_domain(broadcast, "listen", "--rate", "2", "--domain", "yard", "--backend", backend)
    assert (done.returncode, done.stderr) == (130, "waiting for transforms on domain 'yard' …\n")
    # The samples are of 102 s and 102.75 s; the lookup of 104 s wants one of the last second, and gives up after 0.5 s.
    assert done.stdout.splitlines() == [
        *(line(at, newest) for at, newest in ((102.5, 102.0), (103.0, 102.75), (103.5, 102.75))),
        f"[ERROR] 104.500000000: {ERROR}frame 'base_laser': newest sample is 1.75 s old, and may be 1 s old "
        "(max_age), from 'slam'",
    ]


@pytest.mark.thorough
@pytest.mark.parametrize("backend", BACKENDS)
def test_either_program_may_be_killed_and_started_again(backend: str) -> None:
    options = ("--domain", new_domain(), "--backend", backend)
    with start_tfbus("listen", "--rate", "5", *options) as listener:
        waiting = listener.errors.expect("waiting")
        with start_tfbus("broadcast", *options) as broadcaster:
            listener.output.expect(INFO)
            assert broadcaster.end(signal.SIGKILL) == -signal.SIGKILL
        listener.output.expect(LATE)
        with start_tfbus("broadcast", *options) as broadcaster:
            listener.output.expect(INFO)
            assert listener.end(signal.SIGKILL) == -signal.SIGKILL
            with start_tfbus("listen", *options) as another:
                another.output.expect(INFO)
                assert (another.end(), broadcaster.end()) == (130, 130)
    assert listener.errors.text == f"{waiting}\n"
    assert set(another.errors.text.splitlines()) <= {waiting}


@pytest.mark.thorough
@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("time", ["--simulated", "--duration=inf"])
def test_ctrl_c_ends_the_demo_with_status_130_and_no_traceback(backend: str, time: str) -> None:
    with start_tfbus("demo", "--listen-rate", "20", "--backend", backend, time) as demo:
        demo.output.expect(r"^\[ INFO\] ")
        assert demo.end(signal.SIGINT) == 130
    assert demo.errors.text == ""
    assert [line for line in demo.output.text.splitlines() if not line.startswith("[ INFO] ")] == []

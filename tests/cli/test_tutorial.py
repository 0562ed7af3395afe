import re

import anyio
import pytest

from tfbus import Buffer, Bus, SimulatedClock, Transform, TransformBroadcaster
from tfbus.cli import tutorial
from tfbus.testing import simulate

pytestmark = pytest.mark.anyio

LINE = re.compile(
    r"\[ INFO\] \d+\.\d{9}: base_laser: \(1\.00, 0\.20\. 0\.00\) -----> "
    r"base_link: \(1\.10, 0\.20, 0\.20\) at time \d+\.\d\d"
)
MISSING = (
    'Received an exception trying to transform a point from "base_laser" to "base_link": '
    "no transform from 'base_laser' to 'base_link' within 0.5 s: "
)


async def test_ten_seconds_give_ten_lines_of_the_tutorials_form() -> None:
    lines: list[str] = []
    await tutorial.run(SimulatedClock(), duration=10.0, output=lines.append)
    assert len(lines) == 10
    assert all(LINE.fullmatch(line) for line in lines)


async def test_the_first_line_comes_one_second_after_the_start() -> None:
    lines: list[str] = []
    await tutorial.run(SimulatedClock(start=1248138527_200823000), duration=1.0, output=lines.append)
    (line,) = lines
    assert line.startswith("[ INFO] 1248138528.200823000: ")
    assert line.endswith("at time 1248138528.19")


@pytest.mark.parametrize(("duration", "rate", "lines"), [(0.9, 1.0, 0), (0.3, 10.0, 3), (2.5, 2.0, 5)])
async def test_the_number_of_lines_follows_from_duration_and_rate(duration: float, rate: float, lines: int) -> None:
    clock = SimulatedClock()
    output: list[str] = []
    await tutorial.run(clock, duration=duration, listen_rate=rate, output=output.append)
    assert len(output) == lines
    assert clock.now() == round(duration * 1e9)


async def test_without_a_broadcaster_the_listener_says_once_a_second_what_is_missing() -> None:
    lines: list[str] = []
    await tutorial.run(SimulatedClock(), duration=3.0, broadcaster=False, output=lines.append)
    assert lines == [f"[ERROR] {second}.500000000: {MISSING}frame 'base_link' is not known" for second in range(1, 4)]


async def test_a_broadcaster_that_dies_is_noticed_and_one_that_returns_too() -> None:
    clock = SimulatedClock()
    lines: list[str] = []

    async def robot() -> None:
        with Bus(clock) as bus, Buffer(bus) as buffer:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(lambda: tutorial.listen(buffer, output=lines.append))
                for lifetime, silence in ((2.505, 3.0), (2.0, 0.0)):
                    with clock.move_on_after(lifetime):
                        await tutorial.broadcast(bus)
                    await clock.sleep(silence)
                tasks.cancel_scope.cancel()

    await simulate(clock, robot)
    assert ["ERROR" in line for line in lines] == [False, False, False, True, True, False, False]
    # The last transform is of 2.5 s, and at 4 s nothing older than 3 s will do.
    assert lines[3] == (
        f"[ERROR] 4.500000000: {MISSING}frame 'base_laser': asked for 3.500 s, "
        "newest sample is 2.500 s (1 s short), from 'robot_tf_publisher'"
    )


async def test_a_wrong_transform_gives_a_wrong_point() -> None:
    with Bus(SimulatedClock()) as bus, Buffer(bus) as buffer:
        TransformBroadcaster(bus).send("base_link", "base_laser", Transform((0.0, 0.0, 5.0)))
        lines: list[str] = []
        await simulate(
            bus.clock,  # type: ignore[arg-type]
            lambda: tutorial.listen(buffer, lines=1, output=lines.append),
        )
    assert "base_link: (1.00, 0.20, 5.00)" in lines[0]


async def test_a_broadcaster_that_is_refused_because_of_somebody_else_goes_on(
    caplog: pytest.LogCaptureFixture,
) -> None:
    clock = SimulatedClock()
    with Bus(clock) as bus, Buffer(bus) as buffer:
        TransformBroadcaster(bus, authority="intruder").send("base_laser", "base_link", Transform())

        async def robot() -> None:
            with clock.move_on_after(1.0):
                await tutorial.broadcast(bus)
            bus.remove_frame("base_link")
            with clock.move_on_after(1.0):
                await tutorial.broadcast(bus)

        await simulate(clock, robot)
        assert buffer.lookup_nowait("base_link", "base_laser").transform == tutorial.BASE_FROM_LASER
    assert [record.getMessage() for record in caplog.records] == [
        "not sent: the edge 'base_link' -> 'base_laser' would close a loop of parents: "
        "base_laser -> base_link -> base_laser, with edges from 'intruder'"
    ]

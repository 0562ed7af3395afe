import anyio
import pytest

from tfbus import SECOND, Buffer, Bus, SimulatedClock, Transform, TransformBroadcaster
from tfbus.cli import tutorial
from tfbus.testing import simulate

pytestmark = pytest.mark.anyio

MISSING = (
    'Received an exception trying to transform a point from "base_laser" to "base_link": '
    "no transform from 'base_laser' to 'base_link' within 0.5 s: "
)


async def test_each_second_has_a_line_with_the_newest_transform() -> None:
    lines: list[str] = []
    await tutorial.run(SimulatedClock(), duration=10.0, output=lines.append)
    assert lines == [
        f"[ INFO] {second}.000000000: base_laser: (1.00, 0.20. 0.00) -----> base_link: (1.10, 0.20, 0.20) "
        f"at time {second - 1}.99"
        for second in range(1, 11)
    ]


async def test_the_first_line_comes_one_second_after_the_start() -> None:
    lines: list[str] = []
    await tutorial.run(SimulatedClock(start=1248138527_200823000), duration=1.0, output=lines.append)
    (line,) = lines
    assert line.startswith("[ INFO] 1248138528.200823000: ")
    assert line.endswith("at time 1248138528.19")


@pytest.mark.parametrize(("duration", "rate", "lines"), [(0.9, 1.0, 0), (0.3, 10.0, 3), (2.5, 2.0, 5)])
async def test_the_number_of_lines_follows_from_duration_and_rate(duration: float, rate: float, lines: int) -> None:
    start = 1_000 * SECOND
    clock = SimulatedClock(start)
    output: list[str] = []
    await tutorial.run(clock, duration=duration, listen_rate=rate, output=output.append)
    assert len(output) == lines
    assert clock.now() == start + round(duration * 1e9)


async def test_without_a_broadcaster_each_line_says_which_frame_is_missing() -> None:
    lines: list[str] = []
    await tutorial.run(SimulatedClock(), duration=3.0, broadcaster=False, output=lines.append)
    assert lines == [f"[ERROR] {second}.500000000: {MISSING}frame 'base_link' is not known" for second in range(1, 4)]


async def test_lines_are_errors_while_the_broadcaster_is_dead() -> None:
    clock = SimulatedClock()
    lines: list[str] = []

    async def robot() -> None:
        with Bus(clock) as bus, Buffer(bus) as buffer:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(lambda: tutorial.listen(buffer, output=lines.append))
                with clock.move_on_after(2.505):
                    await tutorial.broadcast(bus)
                await clock.sleep(3.0)
                with clock.move_on_after(2.0):
                    await tutorial.broadcast(bus)
                tasks.cancel_scope.cancel()

    await simulate(clock, robot)
    assert ["ERROR" in line for line in lines] == [False, False, False, True, True, False, False]
    # The newest transform is that of 2.5 s; the lookup of 4 s, given up at 4.5 s, wants one younger than a second.
    assert lines[3] == (
        f"[ERROR] 4.500000000: {MISSING}frame 'base_laser': asked for 3.500 s, "
        "newest sample is 2.500 s (1 s short), from 'robot_tf_publisher'"
    )


async def test_the_point_follows_the_transform() -> None:
    with Bus(SimulatedClock()) as bus, Buffer(bus) as buffer:
        TransformBroadcaster(bus).send("base_link", "base_laser", Transform((0.0, 0.0, 5.0)))
        lines: list[str] = []
        await simulate(
            bus.clock,  # type: ignore[arg-type]
            lambda: tutorial.listen(buffer, lines=1, output=lines.append),
        )
    assert "base_link: (1.00, 0.20, 5.00)" in lines[0]


async def test_a_broadcaster_that_the_bus_rejects_logs_it_once_and_goes_on(
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
        "dropped a sample: the edge 'base_link' -> 'base_laser' would close a loop of parents: "
        "base_laser -> base_link -> base_laser, with edges from 'intruder'"
    ]

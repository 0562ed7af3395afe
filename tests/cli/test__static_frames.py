import pytest
from support.samples import moving, static

from tfbus import Bus, SimulatedClock
from tfbus.cli._static_frames import publish_static
from tfbus.testing import simulate

pytestmark = pytest.mark.anyio


async def test_a_refused_frame_is_shown_once_and_published_when_its_place_is_free(
    capsys: pytest.CaptureFixture[str],
) -> None:
    clock = SimulatedClock()
    with Bus(clock) as bus:
        bus.publish(moving("laser", "base", 0, authority="stranger"))

        async def free() -> None:
            await clock.sleep(2.5)
            bus.remove_frame("base")

        async def publish() -> None:
            await publish_static(bus, [static("base", "laser"), static("base", "arm")])

        async def both() -> None:
            import anyio

            async with anyio.create_task_group() as tasks:
                tasks.start_soon(free)
                tasks.start_soon(publish)

        await simulate(clock, both)
        assert bus.statistics().frames == 2
    errors = capsys.readouterr().err
    assert errors.count("refused, and tried again once a second: the edge 'base' -> 'laser' would close a loop") == 1
    assert clock.now() == 3_000_000_000

import signal

import pytest
from support.commands import START, Command
from support.processes import new_domain, start_tfbus

from tfbus import SECOND, Bus, Transform, TransformStamped


@pytest.mark.parametrize("backend", ["asyncio", "trio"])
def test_it_sends_the_transform_of_the_laser_at_its_rate_until_ctrl_c(tfbus: Command, backend: str) -> None:
    received: list[TransformStamped] = []

    async def listen(bus: Bus) -> None:
        with bus.subscribe(received.extend):
            await bus.clock.sleep(0.21)

    done = tfbus.on_domain(listen, "broadcast", "--rate", "20", "--domain", "yard", "--backend", backend)
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr == "broadcasting 'base_laser' in 'base_link' at 20 Hz on domain 'yard', until Ctrl-C\n"
    laser = Transform((0.1, 0.0, 0.2))
    assert received == [
        TransformStamped("base_link", "base_laser", START + tick * SECOND // 20, laser, "robot_tf_publisher")
        for tick in range(5)
    ]


def test_by_default_it_sends_a_hundred_times_a_second(tfbus: Command) -> None:
    async def wait(bus: Bus) -> None:
        await bus.clock.sleep(0.1)

    assert " at 100 Hz on domain 'tf'" in tfbus.on_domain(wait, "broadcast").stderr


@pytest.mark.thorough
def test_a_termination_ends_it_at_once_and_silently() -> None:
    with start_tfbus("broadcast", "--domain", new_domain()) as broadcaster:
        greeting = broadcaster.errors.expect("broadcasting")
        assert broadcaster.end(signal.SIGTERM) == -signal.SIGTERM
    assert broadcaster.errors.text == f"{greeting}\n"

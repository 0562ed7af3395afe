import signal

import pytest
from support.commands import START, Command
from support.processes import free_address, new_domain, start_tfbus

from tfbus import SECOND, Bus, Transform, TransformStamped

POINT = r"base_laser: \(1\.00, 0\.20\. 0\.00\) -----> base_link: \(1\.10, 0\.20, 0\.20\) at time \d+\.\d\d$"
INFO = rf"^\[ INFO\] \d+\.\d{{9}}: {POINT}"
MISSING = (
    r'^\[ERROR\] \d+\.\d{9}: Received an exception trying to transform a point from "base_laser" to "base_link": '
    r"no transform from 'base_laser' to 'base_link' within 0\.5 s: frame 'base_laser': asked for \d+\.\d+ s, "
    r"newest sample is \d+\.\d+ s \(.* short\), from 'robot_tf_publisher'$"
)


@pytest.mark.parametrize("backend", ["asyncio", "trio"])
def test_it_waits_for_a_broadcaster_and_prints_a_line_a_period_from_then_on(tfbus: Command, backend: str) -> None:
    async def broadcast(bus: Bus) -> None:
        for seconds in (2.0, 0.75):
            await bus.clock.sleep(seconds)
            laser = Transform((0.1, 0.0, 0.2))
            bus.publish(TransformStamped("base_link", "base_laser", bus.clock.now(), laser, "slam"))
        await bus.clock.sleep(1.9)

    done = tfbus.on_domain(broadcast, "listen", "--rate", "2", "--domain", "yard", "--backend", backend)
    assert (done.returncode, done.stderr) == (130, "waiting for transforms on domain 'yard' …\n")
    # The samples are of 102 s and 102.75 s; the lookup of 104 s wants one of the last second, and gives up after 0.5 s.
    expected = [(102.5, 102.0), (103.0, 102.75), (103.5, 102.75)]
    *found, error = done.stdout.splitlines()
    assert found == [
        f"[ INFO] {at:.9f}: base_laser: (1.00, 0.20. 0.00) -----> base_link: (1.10, 0.20, 0.20) at time {newest:.2f}"
        for at, newest in expected
    ]
    assert START == 100 * SECOND
    assert error == (
        '[ERROR] 104.500000000: Received an exception trying to transform a point from "base_laser" to "base_link": '
        "no transform from 'base_laser' to 'base_link' within 0.5 s: frame 'base_laser': asked for 103.500 s, "
        "newest sample is 102.750 s (750 ms short), from 'slam'"
    )


@pytest.mark.thorough
@pytest.mark.parametrize("backend", ["asyncio", "trio"])
def test_either_program_may_be_killed_and_started_again(backend: str) -> None:
    domain, address = new_domain(), free_address()
    options = ("--domain", domain, "--backend", backend)
    with start_tfbus("listen", "--rate", "5", "--connect", address, *options) as listener:
        waiting = listener.errors.expect("waiting")
        with start_tfbus("broadcast", "--listen", address, *options) as broadcaster:
            listener.output.expect(INFO)
            assert broadcaster.end(signal.SIGKILL) == -signal.SIGKILL
        listener.output.expect(MISSING)
        with start_tfbus("broadcast", "--listen", address, *options) as broadcaster:
            listener.output.expect(INFO)
            assert listener.end(signal.SIGKILL) == -signal.SIGKILL
            with start_tfbus("listen", "--connect", address, *options) as another:
                another.output.expect(INFO)
                assert (another.end(), broadcaster.end()) == (130, 130)
    # Neither a traceback, nor anything that zenoh prints by itself.
    assert listener.errors.text == f"{waiting}\n"
    assert set(another.errors.text.splitlines()) <= {waiting}


@pytest.mark.thorough
@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, -signal.SIGTERM)])
def test_a_signal_ends_it_silently_while_it_waits(number: signal.Signals, status: int) -> None:
    with start_tfbus("listen", "--domain", new_domain()) as listener:
        waiting = listener.errors.expect("waiting")
        assert listener.end(number) == status
    assert listener.errors.text == f"{waiting}\n"

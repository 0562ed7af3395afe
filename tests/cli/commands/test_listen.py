"""The second of the tutorial's two programs, with the first one in another process."""

import signal

import pytest
from support.processes import new_domain
from support.programs import free_address, tfbus

POINT = r"base_laser: \(1\.00, 0\.20\. 0\.00\) -----> base_link: \(1\.10, 0\.20, 0\.20\) at time \d+\.\d\d$"
INFO = rf"^\[ INFO\] \d+\.\d{{9}}: {POINT}"
MISSING = (
    r'^\[ERROR\] \d+\.\d{9}: Received an exception trying to transform a point from "base_laser" to "base_link": '
    r"no transform from 'base_laser' to 'base_link' within 0\.5 s: frame 'base_laser': asked for \d+\.\d+ s, "
    r"newest sample is \d+\.\d+ s \(.* short\), from 'robot_tf_publisher'$"
)


def test_a_listener_without_a_broadcaster_waits_says_so_once_and_prints_as_soon_as_there_is_one() -> None:
    domain = new_domain()
    with tfbus("listen", "--rate", "5", "--domain", domain) as listener:
        listener.errors.expect("waiting")
        with tfbus("broadcast", "--rate", "50", "--domain", domain) as broadcaster:
            for _ in range(3):
                listener.output.expect(INFO)
            assert (listener.end(), broadcaster.end()) == (130, 130)
    # Neither a traceback, nor anything that zenoh would like to tell.
    assert listener.errors.text == f"waiting for transforms on domain '{domain}' …\n"


@pytest.mark.parametrize("backend", ["asyncio", "trio"])
def test_either_may_be_killed_and_started_again_and_the_listener_says_what_is_missing_meanwhile(backend: str) -> None:
    address = free_address()
    domain = new_domain()
    options = ("--domain", domain, "--backend", backend)
    with tfbus("broadcast", "--listen", address, *options) as broadcaster:
        broadcaster.errors.expect("broadcasting")
        with tfbus("listen", "--connect", address, *options) as listener:
            listener.output.expect(INFO)
            assert broadcaster.end(signal.SIGKILL) == -signal.SIGKILL
            listener.output.expect(MISSING)
            with tfbus("broadcast", "--listen", address, *options):
                listener.output.expect(INFO)
                assert listener.end(signal.SIGKILL) == -signal.SIGKILL
                with tfbus("listen", "--connect", address, *options) as another:
                    another.output.expect(INFO)
    for program in (listener, another):
        assert set(program.errors.text.splitlines()) <= {f"waiting for transforms on domain '{domain}' …"}


@pytest.mark.parametrize("backend", ["asyncio", "trio"])
def test_ctrl_c_ends_one_that_still_waits(backend: str) -> None:
    with tfbus("listen", "--domain", new_domain(), "--listen", free_address(), "--backend", backend) as listener:
        waiting = listener.errors.expect("waiting")
        assert listener.end() == 130
    assert listener.errors.text == f"{waiting}\n"


def test_terminating_it_ends_it_at_once_and_without_a_word() -> None:
    with tfbus("listen", "--domain", new_domain()) as listener:
        waiting = listener.errors.expect("waiting")
        assert listener.end(signal.SIGTERM) == -signal.SIGTERM
    assert listener.errors.text == f"{waiting}\n"

"""The switch between namespaces itself: a delay is a delay, a cut one way is one way, and nothing outlives it."""

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from socket import socket

import pytest
from support.namespaces import Network, absent

pytestmark = pytest.mark.skipif(absent() is not None, reason=absent() or "")
PATIENCE = 20.0


@pytest.fixture
def network() -> Iterator[Network]:
    with Network(3) as network:
        yield network


@pytest.fixture
def sockets(network: Network) -> Iterator[list[socket]]:
    sockets = [network.socket(place) for place in network.places]
    for each in sockets:
        each.settimeout(PATIENCE)
    yield sockets
    for each in sockets:
        each.close()


def say(text: str, of: socket, to: socket) -> None:
    of.sendto(text.encode(), to.getsockname())


def hear(at: socket) -> str:
    return at.recv(100).decode()


def test_a_cut_one_way_is_one_way_until_it_is_mended_and_a_third_hears_all(
    network: Network, sockets: list[socket]
) -> None:
    first, second, third = sockets
    network.spoil([(0, 1)], loss=1.0)
    say("lost", first, second)
    say("back", second, first)
    say("aside", first, third)
    assert (hear(first), hear(third)) == ("back", "aside")
    network.spoil([(0, 1)])
    say("mended", first, second)
    assert hear(second) == "mended"


def test_a_delay_is_a_delay_and_keeps_the_order(network: Network, sockets: list[socket]) -> None:
    first, second, _ = sockets
    network.spoil(network.ways([0], [1]), delay=0.2)
    began = time.monotonic()
    for number in range(20):
        say(f"{number}", first, second)
    assert [hear(second) for _ in range(20)] == [f"{number}" for number in range(20)]
    assert time.monotonic() - began >= 0.2


def test_a_part_of_the_packets_is_lost(network: Network, sockets: list[socket]) -> None:
    first, second, _ = sockets
    network.spoil(network.ways([0]), loss=0.5)
    for _ in range(200):
        say("perhaps", first, second)
    network.spoil(network.ways([0]))
    say("end", first, second)
    heard = 0
    while hear(second) != "end":
        heard += 1
    assert 60 < heard < 140


def test_the_namespaces_end_with_a_process_that_is_killed() -> None:
    program = "from support.namespaces import Network; n = Network(1); print(n.within(0)[1], flush=True); input()"
    paths = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", program], stdin=pipe, stdout=pipe, text=True, env=paths) as process:
        assert process.stdout is not None
        namespace = Path(process.stdout.readline().strip().removeprefix("--net="))
        assert namespace.exists()
        process.kill()
    until = time.monotonic() + PATIENCE
    while namespace.exists():
        assert time.monotonic() < until
        time.sleep(0.01)

"""Faults at random between processes: some seconds after each, all buses hold the same, and nothing untrue was told.

`FAULT_SEEDS` in the environment has the first and the last seed, and `FAULT_SECONDS` the time for each; `FAULT_LIMIT`
is the time until all are equal.
"""

import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.fault_world import LIMIT, OneMachine, Routers, short_directory
from support.namespaces import Network, absent
from support.processes import Crowd, crowd

FIRST, LAST = (int(seed) for seed in os.environ.get("FAULT_SEEDS", "1 1").split())
SECONDS = float(os.environ.get("FAULT_SECONDS", "15"))
SEEDS = range(FIRST, LAST + 1)
DROP_LOST = pytest.mark.parametrize("drop_lost", [False, True], ids=["kept", "dropped"])


@pytest.fixture
def directory() -> Iterator[Path]:
    with short_directory() as path:
        yield path


@pytest.fixture
def processes(directory: Path) -> Iterator[Crowd]:
    # They end before the directory vanishes, in which they would show their names again meanwhile.
    del directory
    with crowd() as together:
        yield together


def tell(capsys: pytest.CaptureFixture[str], line: str) -> None:
    with capsys.disabled():
        print(f"\n{line}")


@pytest.mark.thorough
@DROP_LOST
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("loopback", [False, True], ids=["sockets", "ports"])
def test_all_buses_of_one_machine_are_equal_after_each_fault(
    processes: Crowd, directory: Path, seed: int, drop_lost: bool, loopback: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    tell(capsys, OneMachine(processes, seed, drop_lost, directory, loopback).run(seconds=SECONDS))


@pytest.mark.thorough
@DROP_LOST
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", ["one router", "two routers", "both links"])
def test_all_buses_behind_routers_are_equal_after_each_fault(
    processes: Crowd, directory: Path, seed: int, drop_lost: bool, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("zenoh", reason='pip install "tfbus[zenoh]"')
    routers, inside = 2 if kind == "two routers" else 1, directory if kind == "both links" else None
    with Routers(processes, seed, drop_lost, routers, inside) as world:
        tell(capsys, world.run(seconds=SECONDS))


@pytest.mark.thorough
@pytest.mark.skipif(absent() is not None, reason=absent() or "")
@DROP_LOST
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("routers", [0, 1, 2], ids=["one listens", "one router", "two routers"])
def test_all_buses_of_several_machines_are_equal_after_each_fault(
    processes: Crowd, seed: int, drop_lost: bool, routers: int, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("zenoh", reason='pip install "tfbus[zenoh]"')
    with Network(routers + 4) as network, Routers(processes, seed, drop_lost, routers, network=network) as world:
        tell(capsys, world.run(seconds=SECONDS))


@pytest.mark.thorough
@pytest.mark.skipif(absent() is not None, reason=absent() or "")
def test_processes_that_are_cut_off_from_a_router_hold_up_no_other(processes: Crowd) -> None:
    pytest.importorskip("zenoh", reason='pip install "tfbus[zenoh]"')
    with Network(9) as network, Routers(processes, 1, False, 1, network=network) as world:
        for place in network.places[5:]:
            world.add(f"{place}", ("zenoh",), world.members[0].links, network.within(place))
        world.start(*world.members)
        world.check()
        away = network.ways(network.places[3:])
        network.spoil([*away, *((other, place) for place, other in away)], loss=1.0)
        first, second, *_ = world.members
        first.process.wait(event="PeerLost")
        began = time.monotonic()
        # The router takes all the others for lost within a sign of life of each other.
        first.process.ask("until", peers=1)
        world.publish(first, "later")
        second.process.ask("until", has=["later"])
        assert time.monotonic() - began < LIMIT / 2

"""Buses in processes of their own, linked on this machine; `tests/stress/test_links_faults.py` breaks things at random.

Most tests run over both links of tfbus: the one of one machine, and zenoh by a router.
"""

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from start_together import measure
from support.processes import PATIENCE, Crowd, PeerProcess, Place, crowd

pytest.importorskip("zenoh", reason='pip install "tfbus[zenoh]"')
pytestmark = pytest.mark.thorough

BACKENDS = ("asyncio", "trio", "asyncio+uvloop")
SECONDS = 3
BLOCKED = 3.0
"""The seconds for which a slow process does not return to its event loop."""
RATE = 50.0
"""Batches of 20 that each of three processes sends a second: the queue of a link has room for all of them."""


@pytest.fixture
def processes() -> Iterator[Crowd]:
    with crowd() as together:
        yield together


@pytest.fixture(params=["local", "router"])
def place(request: pytest.FixtureRequest) -> Place:
    return Place(request.param)


def meet(*processes: PeerProcess) -> None:
    for process in processes:
        process.ask("until", peers=len(processes) - 1)


def moving(child: str, x: float) -> dict[str, Any]:
    return {"parent": "map", "child": child, "stamp": time.time_ns(), "x": x}


def send_in_turn(processes: list[PeerProcess]) -> None:
    """Have all processes publish at once for some seconds, and check that each has received everything once."""
    batches = round(RATE * SECONDS)
    names = [f"p{number}" for number in range(len(processes))]
    started = [
        process.start("stream", authority=name, batches=batches, rate=RATE)
        for process, name in zip(processes, names, strict=True)
    ]
    for process, number in zip(processes, started, strict=True):
        process.finish(number)
    for process in processes:
        process.ask("until", last=dict.fromkeys(names, batches - 1))
    for process in processes:
        facts = process.ask("facts")
        whole = {"batches": batches, "samples": 20 * batches, "last": batches - 1}
        faults = {"missing": 0, "not_in_order": 0, "not_whole": 0}
        assert facts["tallies"] == dict.fromkeys(names, whole | faults)
        assert facts["bus"]["samples"] == 3 * 20 * batches
        for link in facts["links"]:
            assert (link["lost"], link["rejected"], link["queue"]["dropped"]) == (0, {}, 0)


def test_three_processes_have_every_sample_once(processes: Crowd, place: Place) -> None:
    links = [place.first(), place.other(), place.other()]
    members = [processes.add(link, backend=backend) for link, backend in zip(links, BACKENDS, strict=True)]
    meet(*members)
    send_in_turn(members)
    for member in members:
        (link,) = member.ask("facts")["links"]
        # All of them hear each other directly, so none passes on what it receives. It may send a little more than its
        # own samples: until a router has said who listens, a link also sends to those that hear it slowly.
        assert link["duplicates"] == 0
        assert link["sent_samples"] < link["received_samples"]


def test_a_ring_of_three_domains_brings_every_sample_once(processes: Crowd) -> None:
    places = [Place("local"), Place("router"), Place("local")]
    members = [
        processes.begin(places[number].first(), places[number - 1].other(), backend=backend)
        for number, backend in enumerate(BACKENDS)
    ]
    for member in members:
        for link in (0, 1):
            member.ask("until", peers=1, link=link)
    send_in_turn(members)


@pytest.mark.parametrize(("place", "drop_lost"), [("local", False), ("router", True)], indirect=["place"])
def test_what_a_killed_process_has_said_is_the_same_for_those_who_heard_it_and_for_late_joiners(
    drop_lost: bool, processes: Crowd, place: Place
) -> None:
    listener = processes.add(place.first(drop_lost=drop_lost))
    listener.ask("statics", names=["own"])
    victim, other = (processes.add(place.other(drop_lost=drop_lost), backend=backend) for backend in BACKENDS[1:])
    victim.ask("statics", names=["lidar", "camera"], x=1.0, authority="urdf")
    victim.ask("publish", samples=[{**moving("base", 1.0), "authority": "wheels"}])
    for process in (listener, other):
        process.ask("until", static=["own", "lidar", "camera"], has=["base"], peers=2)
    victim.kill()
    for process in (listener, other):
        lost = process.wait(event="PeerLost")
        assert (lost["authorities"], lost["frames"]) == (["urdf", "wheels"], ["base", "camera", "lidar"])
        assert len(process.said(event="PeerJoined")) == 2
    other.kill()
    kept = {"own": 0.0} if drop_lost else {"own": 0.0, "lidar": 1.0, "camera": 1.0, "base": 1.0}
    late = processes.add(place.other(drop_lost=drop_lost))
    together = (listener, late)
    for process in together:
        process.ask("until", x=kept, lacks=[name for name in ("lidar", "camera", "base") if name not in kept])
    # The samples of the next process are newer, on every bus.
    again = processes.add(place.other(drop_lost=drop_lost), backend="trio")
    again.ask("until", x=kept)
    again.ask("statics", names=["lidar"], x=2.0)
    for process in together:
        process.ask("until", x=kept | {"lidar": 2.0})
        assert process.ask("facts")["x"] == kept | {"lidar": 2.0}
    # A removal is for all that comes later.
    late.ask("remove", frame="lidar")
    again.ask("until", lacks=["lidar"])
    latest = processes.add(place.other(drop_lost=drop_lost))
    latest.ask("until", x={name: x for name, x in kept.items() if name != "lidar"}, peers=3)
    assert "lidar" not in latest.ask("facts")["x"]


def test_a_process_that_is_held_up_for_a_part_of_its_lease_is_not_lost(processes: Crowd) -> None:
    place = Place("router")
    listener = processes.add(place.first(lease=4.0, drop_lost=True))
    held_up = processes.add(place.other(lease=4.0))
    held_up.ask("statics", names=["lidar"], authority="urdf")
    listener.ask("until", static=["lidar"], peers=1)
    for _ in range(2):
        held_up.signal(signal.SIGSTOP)
        time.sleep(1.5)
        held_up.signal(signal.SIGCONT)
        # The next one begins at another moment between two signs of life.
        time.sleep(0.7)
    held_up.ask("statics", names=["camera"])
    listener.ask("until", static=["lidar", "camera"], peers=1)
    assert not listener.said(event="PeerLost")


def test_a_slow_and_a_frozen_process_delay_no_other(processes: Crowd, place: Place) -> None:
    # The lease outlasts the test, so no peer is spared by being lost.
    broadcaster = processes.add(place.first(lease=60.0))
    reader, slow, frozen = (processes.add(place.other(lease=60.0), backend=backend) for backend in BACKENDS)
    meet(broadcaster, reader, slow, frozen)
    frozen.signal(signal.SIGSTOP)
    blocked = slow.start("block", seconds=BLOCKED)
    sent = broadcaster.ask("stream", authority="wheels", batches=3_000, rate=1_000)
    reader.ask("until", last={"wheels": 2_999})
    tally = reader.ask("facts")["tallies"]["wheels"]
    assert (tally["missing"], tally["not_in_order"], tally["not_whole"]) == (0, 0, 0)
    # A call that waited for the slow one would take as long as that is blocked, and one for the frozen one for ever.
    assert sent["longest_call"] < BLOCKED
    assert broadcaster.ask("facts")["longest_pause"] < BLOCKED
    # All of it was kept for the slow one.
    slow.finish(blocked)
    slow.ask("until", last={"wheels": 2_999})
    facts = slow.ask("facts")
    assert facts["tallies"]["wheels"]["missing"] == 0
    assert facts["links"][0]["queue"]["dropped"] == 0
    # Static frames are not lost for the frozen one.
    broadcaster.ask("statics", names=["lidar"])
    reader.ask("until", static=["lidar"])
    frozen.signal(signal.SIGCONT)
    frozen.ask("until", static=["lidar"])


def test_a_lookup_in_one_process_is_answered_by_another(processes: Crowd, place: Place) -> None:
    asking = processes.add(place.first(), backend="trio")
    answering = processes.add(place.other())
    meet(asking, answering)
    question = asking.start("lookup", target="map", source="lidar", at=1_500)
    answering.ask("statics", names=["unrelated"])
    answering.ask("publish", samples=[{"parent": "map", "child": "base", "stamp": 1_000, "x": 1.0, "authority": "w"}])
    answering.ask("publish", samples=[{"parent": "base", "child": "lidar", "stamp": 0, "x": 0.5, "static": True}])
    asking.ask("until", has=["base", "lidar", "unrelated"])
    assert asking.said(id=question) == []
    answering.ask("publish", samples=[{"parent": "map", "child": "base", "stamp": 2_000, "x": 2.0, "authority": "w"}])
    found = asking.finish(question)
    assert (found["x"], found["stamp"]) == (2.0, 1_500)


# Programs that end without the end of their link, while messages keep coming.
BEGIN = """
import asyncio, gc, sys, time
import anyio
from tfbus import Bus, LocalLink
from tfbus.links.zenoh import ZenohLink

# The broadcaster's stamps are of another time.
bus = Bus(max_behind=None)
link = ZenohLink(bus, DOMAIN, connect=ADDRESS) if ADDRESS else LocalLink(bus, DOMAIN)

async def main():
    heard = asyncio.Event()
    bus.subscribe(lambda batch: heard.set())
    await link.__aenter__()
    await heard.wait()

async def listen():
    with bus.stream() as batches:
        async with link:
            async for batch in batches:
                print("ready", flush=True)

loop = asyncio.new_event_loop()
"""
CRASH = "loop.run_until_complete(main())\nprint('crash', flush=True)\n"
CRASHES = {
    "the loop is closed": "loop.close(); time.sleep(0.1)",
    "the loop is left": "",
    "the link is forgotten": "loop.close(); del link; gc.collect()",
    "the program exits": "sys.exit(0)",
}
LISTEN = """
try:
    anyio.run(listen, backend=BACKEND)
except KeyboardInterrupt:
    print("interrupted")
"""


@contextmanager
def program_beside(processes: Crowd, place: Place, text: str, **names: str) -> Iterator[subprocess.Popen[str]]:
    """A program with a link, to which another process sends all the time, and which that loses in the end."""
    broadcaster = processes.add(place.first())
    broadcaster.start("stream", authority="wheels", batches=1_000_000, rate=1_000, size=5)
    address = place.address if place.carrier == "router" else ""
    for name, value in (names | {"DOMAIN": place.domain, "ADDRESS": address}).items():
        text = text.replace(name, repr(value))
    with subprocess.Popen(
        [sys.executable, "-P", "-c", text], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            yield process
        finally:
            process.kill()
    broadcaster.wait(event="PeerLost")


@pytest.mark.parametrize("end", CRASHES.values(), ids=CRASHES.keys())
def test_a_link_that_was_never_ended_does_not_keep_the_program(end: str, processes: Crowd, place: Place) -> None:
    with program_beside(processes, place, BEGIN + CRASH + end) as program:
        assert (*program.communicate(timeout=PATIENCE), program.returncode) == ("crash\n", "", 0)


@pytest.mark.parametrize("backend", ["asyncio", "trio"])
def test_ctrl_c_ends_a_program_with_a_link(backend: str, processes: Crowd, place: Place) -> None:
    with program_beside(processes, place, BEGIN + LISTEN, BACKEND=backend) as program:
        assert program.stdout is not None
        assert program.stdout.readline() == "ready\n"
        program.send_signal(signal.SIGINT)
        output, errors = program.communicate(timeout=PATIENCE)
    assert (output.splitlines()[-1], errors, program.returncode) == ("interrupted", "", 0)


def test_processes_that_start_together_all_have_every_static_frame(place: Place) -> None:
    assert max(facts.met for facts in measure(8, place)) < PATIENCE

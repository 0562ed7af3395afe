"""Buses in processes of their own, linked over the loopback; `tests/stress/test_links_faults.py` has hosts apart."""

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from start_together import measure
from support.processes import PATIENCE, Crowd, PeerProcess, crowd, free_ports, new_domain

pytestmark = pytest.mark.thorough

BACKENDS = ("asyncio", "trio", "asyncio+uvloop")
SECONDS = 10
BLOCKED = 3.0
"""The seconds for which a slow process does not return to its event loop."""
RATE = 500 / 3
"""Batches of 20 that each of three processes sends a second: 10,000 samples in all."""


@pytest.fixture
def processes() -> Iterator[Crowd]:
    with crowd() as together:
        yield together


class Place:
    """A domain of one test, and addresses to listen at."""

    def __init__(self, listeners: int = 1) -> None:
        self.domain = new_domain()
        self.addresses = [f"tcp/127.0.0.1:{port}" for port in free_ports(listeners)]

    def first(self, **options: Any) -> dict[str, Any]:
        return {"domain": self.domain, "listen": self.addresses[0], **options}

    def other(self, **options: Any) -> dict[str, Any]:
        return {"domain": self.domain, "connect": self.addresses[0], **options}


@pytest.fixture
def place() -> Place:
    return Place()


def meet(*processes: PeerProcess) -> None:
    for process in processes:
        process.ask("until", peers=len(processes) - 1)


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


def test_three_processes_in_a_ring_have_every_sample_once(processes: Crowd) -> None:
    place = Place(3)
    ring = zip(place.addresses, [*place.addresses[1:], place.addresses[0]], BACKENDS, strict=True)
    members = [
        processes.begin({"domain": place.domain, "listen": here, "connect": there}, backend=backend)
        for here, there, backend in ring
    ]
    meet(*members)
    send_in_turn(members)
    for member in members:
        (link,) = member.ask("facts")["links"]
        # All of them hear each other directly, so none passes anything on.
        assert link["duplicates"] == 0
        assert link["sent_samples"] == link["received_samples"] / 2


def test_a_ring_of_three_domains_brings_every_sample_once(processes: Crowd) -> None:
    places = [Place(), Place(), Place()]
    members = [
        processes.begin(places[number].first(), places[number - 1].other(), backend=backend)
        for number, backend in enumerate(BACKENDS)
    ]
    for member in members:
        for link in (0, 1):
            member.ask("until", peers=1, link=link)
    send_in_turn(members)


def test_processes_may_start_in_any_order(processes: Crowd, place: Place) -> None:
    late = processes.add(place.other())
    late.ask("statics", names=["before"])
    first = processes.add(place.first())
    first.ask("until", static=["before"])
    first.ask("statics", names=["after"])
    late.ask("until", static=["after"])
    # The first one may end and come back.
    first.kill()
    late.wait(event="PeerLost")
    again = processes.add(place.first(), backend="trio")
    again.ask("until", static=["before"])
    again.ask("statics", names=["again"])
    late.ask("until", static=["again"])


@pytest.mark.parametrize("drop_lost", [True, False])
def test_a_killed_broadcaster_is_lost_and_refreshes_its_static_frames_when_it_is_back(
    drop_lost: bool, processes: Crowd, place: Place
) -> None:
    listener = processes.add(place.first(drop_lost=drop_lost))
    listener.ask("statics", names=["own"])
    broadcaster = processes.add(place.other())
    broadcaster.ask("statics", names=["lidar", "camera"], x=1.0, authority="urdf")
    broadcaster.ask("stream", authority="wheels", batches=5, rate=1_000, size=2)
    listener.ask("until", static=["lidar", "camera"], last={"wheels": 4})
    joined = listener.wait(event="PeerJoined")
    broadcaster.kill()
    lost = listener.wait(event="PeerLost")
    assert lost == {
        "event": "PeerLost",
        "link": place.domain,
        "peer": joined["peer"],
        "authorities": ["urdf", "wheels"],
        "frames": ["camera", "lidar", "wheels/0", "wheels/1"],
    }
    if drop_lost:
        listener.ask("until", lacks=lost["frames"])
    facts = listener.ask("facts")
    assert facts["static"] == (["own"] if drop_lost else ["camera", "lidar", "own"])
    assert facts["moving"] == ([] if drop_lost else ["wheels/0", "wheels/1"])
    again = processes.add(place.other(), backend="trio")
    again.ask("until", static=["own"])
    again.ask("statics", names=["lidar", "camera"], x=2.0, authority="urdf")
    assert listener.wait(event="PeerJoined")["peer"] != joined["peer"]
    # A late joiner receives the new values.
    third = processes.add(place.other())
    for process in (listener, third):
        process.ask("until", static=["lidar", "camera"], x={"lidar": 2.0, "camera": 2.0})


def test_a_frozen_process_is_lost_and_comes_back_with_its_static_frames(processes: Crowd, place: Place) -> None:
    listener = processes.add(place.first(lease=1.0, drop_lost=True))
    frozen = processes.add(place.other(lease=1.0))
    frozen.ask("statics", names=["lidar"], authority="urdf")
    # The late joiner has it from the cache.
    other = processes.add(place.other(lease=1.0, drop_lost=True), backend="trio")
    for process in (listener, other):
        process.ask("until", static=["lidar"], peers=2)
    frozen.signal(signal.SIGSTOP)
    for process in (listener, other):
        lost = process.wait(event="PeerLost")
        assert (lost["authorities"], lost["frames"]) == (["urdf"], ["lidar"])
        process.ask("until", lacks=["lidar"], peers=1)
    listener.ask("statics", names=["meanwhile"])
    frozen.signal(signal.SIGCONT)
    for process in (listener, other):
        process.ask("until", static=["lidar"], peers=2)
    frozen.ask("until", static=["meanwhile"], peers=2)


def test_a_process_that_is_held_up_for_a_part_of_its_lease_is_not_lost(processes: Crowd, place: Place) -> None:
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
    # A put that waited for the slow one would take as long as that is blocked, and one for the frozen one for ever.
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


def test_a_process_that_is_much_too_slow_drops_and_counts_the_oldest_batches(processes: Crowd, place: Place) -> None:
    broadcaster = processes.add(place.first(lease=60.0))
    slow = processes.add(place.other(lease=60.0, capacity=100))
    meet(broadcaster, slow)
    blocked = slow.start("block", seconds=1.0)
    broadcaster.ask("stream", authority="wheels", batches=500, rate=1_000)
    broadcaster.ask("statics", names=["lidar"])
    slow.finish(blocked)
    slow.ask("until", last={"wheels": 499}, static=["lidar"])
    facts = slow.ask("facts")
    queue, tally = facts["links"][0]["queue"], facts["tallies"]["wheels"]
    assert tally["batches"] + tally["missing"] == 500
    assert queue["dropped"] == tally["missing"] >= 1
    assert (tally["not_in_order"], tally["not_whole"]) == (0, 0)


def test_when_the_first_process_dies_the_others_go_on_and_another_one_joins_them(processes: Crowd) -> None:
    # At the meeting point, where other programs of this machine may be.
    domain = {"domain": new_domain()}
    first = processes.add(domain)
    second, third = processes.add(domain), processes.add(domain, backend="trio")
    meet(first, second, third)
    first.kill()
    for process in (second, third):
        process.wait(event="PeerLost")
    second.ask("statics", names=["lidar"])
    second.ask("stream", authority="wheels", batches=10, rate=1_000)
    third.ask("until", static=["lidar"], last={"wheels": 9})
    late = processes.add(domain)
    meet(second, third, late)
    late.ask("until", static=["lidar"])
    late.ask("statics", names=["camera"])
    for process in (second, third):
        process.ask("until", static=["camera"])


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


def test_removed_frames_leave_everywhere_and_late_joiners_never_hear_of_them(processes: Crowd, place: Place) -> None:
    owner, other = processes.add(place.first()), processes.add(place.other(), backend="trio")
    meet(owner, other)
    owner.ask("statics", names=["lidar", "camera"])
    owner.ask("stream", authority="wheels", batches=3, rate=1_000, size=2)
    other.ask("until", static=["lidar", "camera"], last={"wheels": 2})
    owner.ask("remove", frame="lidar")
    # A process that has not published a frame may remove it too.
    other.ask("remove", frame="wheels/0")
    for process in (owner, other):
        process.ask("until", lacks=["lidar", "wheels/0"], has=["wheels/1"])
    late = processes.add(place.other())
    late.ask("until", static=["camera"], peers=2)
    owner.ask("stream", authority="last", batches=1, rate=1, size=1)
    late.ask("until", has=["last/0"])
    facts = late.ask("facts")
    assert (facts["static"], facts["moving"]) == (["camera"], ["last/0"])
    assert facts["bus"]["samples"] == 2


def test_a_static_frame_that_comes_and_goes_is_there_at_last(processes: Crowd, place: Place) -> None:
    owner, other = processes.add(place.first()), processes.add(place.other(), backend="trio")
    meet(owner, other)
    owner.ask("churn", frame="lidar", times=1_000)
    late = processes.add(place.other())
    for process in (other, late):
        process.ask("until", x={"lidar": 1_000.0})


# Programs that end without the end of their link, while messages keep coming.
BEGIN = """
import asyncio, gc, sys, time
import anyio
from tfbus import Bus
from tfbus.links.zenoh import ZenohLink

# The broadcaster's stamps are of another time.
bus = Bus(max_behind=None)
link = ZenohLink(bus, DOMAIN, connect=ADDRESS)

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
    for name, value in (names | {"DOMAIN": place.domain, "ADDRESS": place.addresses[0]}).items():
        text = text.replace(name, repr(value))
    with subprocess.Popen(
        [sys.executable, "-c", text], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
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


def test_processes_that_start_together_all_have_every_static_frame() -> None:
    assert max(measure(processes=8)) < PATIENCE

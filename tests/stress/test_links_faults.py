"""Faults at random between processes in network namespaces: some seconds after each, all buses hold the same frames.

The last process publishes nothing, and hears only some frames; it holds those, and newly moving ones come to it.

`FAULT_SECONDS` and `FAULT_SEED` in the environment make it last longer, or begin otherwise; `FAULT_KINDS` has the names
of the faults: a process is killed and another one takes its place (``kill``), also while it cannot reach one of the
others (``late``), one is stopped for a while, a pair of hosts is cut off from each other, one host from all others, or
all from all, or one loses three of ten packets for a while, where the program nft is installed. `FAULT_LIMIT` is the
time until all are equal. More than four minutes need longer limits:
``THOROUGH_LIMIT=800 FAULT_SECONDS=600 pytest -o faulthandler_timeout=900 ...``
"""

import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from itertools import count
from random import Random
from typing import Any
from uuid import uuid4

import pytest
from support.processes import PATIENCE, Crowd, PeerProcess, crowd, new_domain

pytestmark = pytest.mark.thorough

SECONDS = float(os.environ.get("FAULT_SECONDS", "60"))
SEED = int(os.environ.get("FAULT_SEED", "1"))
LOSSY = " lossy" if shutil.which("nft") else ""
KINDS = os.environ.get("FAULT_KINDS", f"kill late stop cut isolate all{LOSSY}").split()
HOSTS = 5
WATCHED = ["1/a", "1/d", "2/b", "3/a", "3/c", "4/d", "moves"]
WHOLE_AGAIN = float(os.environ.get("FAULT_LIMIT", "10"))
"""s; so long after a fault all buses are equal."""
LEASE = 4.0


class Host:
    """A network namespace with an address, in which a process may live."""

    def __init__(self, name: str, number: int) -> None:
        self.name = name
        self.address = f"10.98.77.{number}"
        self.prefix = ("ip", "netns", "exec", name)

    def run(self, *command: str) -> None:
        subprocess.run([*self.prefix, *command], check=True, capture_output=True, timeout=PATIENCE)

    def cut(self, other: "Host") -> None:
        self.run("ip", "route", "add", "blackhole", f"{other.address}/32")

    def mend(self, other: "Host") -> None:
        self.run("ip", "route", "delete", "blackhole", f"{other.address}/32")

    def begin_to_lose(self) -> None:
        chain = "add table inet lossy; add chain inet lossy input { type filter hook input priority 0; }"
        self.run("nft", f"{chain}; add rule inet lossy input numgen random mod 100 < 30 drop")

    def end_to_lose(self) -> None:
        self.run("nft", "delete table inet lossy")


@pytest.fixture
def hosts() -> Iterator[list[Host]]:
    ip = shutil.which("ip")
    if ip is None or os.geteuid() != 0:
        pytest.skip("network namespaces need root and the program ip")
    tag = uuid4().hex[:6]
    switch, made = f"tg{tag}s", [Host(f"tg{tag}{number}", number) for number in range(1, HOSTS + 1)]

    def call(*arguments: str) -> None:
        done = subprocess.run([ip, *arguments], capture_output=True, text=True, timeout=PATIENCE, check=False)
        if done.returncode:
            pytest.skip(f"no network namespaces here: {done.stderr.strip()}")

    try:
        for name in (switch, *(host.name for host in made)):
            call("netns", "add", name)
        call("-n", switch, "link", "add", "bridge", "type", "bridge")
        call("-n", switch, "link", "set", "bridge", "up")
        for host in made:
            call("-n", switch, "link", "add", host.name, "type", "veth", "peer", "eth0", "netns", host.name)
            call("-n", switch, "link", "set", host.name, "master", "bridge", "up")
            call("-n", host.name, "address", "add", f"{host.address}/24", "dev", "eth0")
            call("-n", host.name, "link", "set", "eth0", "up")
            call("-n", host.name, "link", "set", "lo", "up")
        yield made
    finally:
        for name in (switch, *(host.name for host in made)):
            subprocess.run([ip, "netns", "delete", name], capture_output=True, timeout=PATIENCE, check=False)


class World:
    """A process in each of some namespaces; all but the last publish and remove frames while faults befall them."""

    def __init__(self, hosts: list[Host], processes: Crowd, rng: Random, apart: list[Host] | None = None) -> None:
        self._hosts = hosts
        self._processes = processes
        self._rng = rng
        self._domain = new_domain()
        self._numbers = count()
        self._cut: list[tuple[Host, Host]] = []
        self._stopped: list[PeerProcess] = []
        self._lossy: list[Host] = []
        self.faults = ["start"]
        self.times: list[tuple[float, str]] = []
        self.members: list[PeerProcess] = []
        if apart is not None:
            self.cut(*apart)
        for host in hosts:
            self.members.append(self._start(host))

    def _start(self, host: Host) -> PeerProcess:
        first = self._hosts[0]
        options: dict[str, Any] = {"domain": self._domain, "lease": LEASE, "drop_lost": True}
        if host is first:
            options |= {"listen": f"tcp/{host.address}:17447"}
        else:
            options |= {"listen": f"tcp/{host.address}:17448", "connect": f"tcp/{first.address}:17447"}
        watches = host is self._hosts[-1]
        if watches:
            options["frames"] = WATCHED
        process = self._processes.add(options, prefix=host.prefix, backend=self._rng.choice(("asyncio", "trio")))
        name = host.address.rpartition(".")[2]
        if not watches:
            process.ask("statics", names=[f"{name}/{frame}" for frame in "abc"], x=float(next(self._numbers)))
        return process

    def fault(self) -> None:
        """Break something."""
        rng, hosts = self._rng, self._hosts
        kind = rng.choice(KINDS)
        self.faults.append(kind)
        victim, other = rng.sample(range(len(hosts)), 2)
        if kind in ("cut", "late"):
            self.cut(hosts[victim], hosts[other])
        elif kind in ("isolate", "all"):
            for place, one in enumerate(hosts):
                for other in range(place):
                    if kind == "all" or victim in (place, other):
                        self.cut(one, hosts[other])
        if kind in ("kill", "late"):
            self.members[victim].kill()
            self.members[victim] = self._start(hosts[victim])
        elif kind == "stop":
            self.members[victim].signal(signal.SIGSTOP)
            self._stopped.append(self.members[victim])
        elif kind == "lossy":
            hosts[victim].begin_to_lose()
            self._lossy.append(hosts[victim])

    def cut(self, one: Host, other: Host) -> None:
        """Cut two hosts off from each other, until all is repaired."""
        one.cut(other)
        other.cut(one)
        self._cut.append((one, other))

    def live(self) -> None:
        """Publish and remove here and there, while something is broken; then let it stay so for a while."""
        for _ in range(self._rng.randrange(1, 8)):
            process = self._rng.choice([one for one in self.members[:-1] if one not in self._stopped])
            frame = f"{self._rng.randrange(1, len(self._hosts))}/{self._rng.choice('abcd')}"
            known = process.ask("facts")
            if frame in known["static"] and self._rng.random() < 0.4:
                process.ask("remove", frame=frame)
            else:
                process.ask("statics", names=[frame], x=float(next(self._numbers)))
        time.sleep(self._rng.choice((0.1, 0.5, 2.0, 5.0)))

    def mend(self) -> None:
        """Repair everything."""
        for one, other in self._cut:
            one.mend(other)
            other.mend(one)
        for process in self._stopped:
            process.signal(signal.SIGCONT)
        for host in self._lossy:
            host.end_to_lose()
        for broken in (self._cut, self._stopped, self._lossy):
            broken.clear()

    def check_equal(self) -> None:
        """Wait until all buses hold the same frames with the same values."""
        began = time.monotonic()
        while True:
            held = [process.ask("facts") for process in self.members]
            watched = {frame: x for frame, x in held[0]["x"].items() if frame in WATCHED}
            others = len(self._hosts) - 1
            expected = [held[0]["x"]] * others + [watched]
            if [facts["x"] for facts in held] == expected and self.peers() == [others] * (others + 1):
                break
            if time.monotonic() - began > WHOLE_AGAIN:
                views = [(facts["links"][0]["peers"], sorted(facts["x"].items())) for facts in held]
                raise AssertionError(f"not equal {WHOLE_AGAIN:g} s after {self.faults[-1]!r}: {views}")
            time.sleep(0.05)
        self._check_moving(began + WHOLE_AGAIN)
        self.times.append((time.monotonic() - began, self.faults[-1]))

    def peers(self) -> list[int]:
        """The number of peers of each process."""
        return [process.ask("facts")["links"][0]["peers"] for process in self.members]

    def _check_moving(self, until: float) -> None:
        """Check that a moving frame comes to the one that hears only some, without a question."""
        process, watcher = self._rng.choice(self.members[:-1]), self.members[-1]
        x = -float(next(self._numbers))
        sample = {"parent": "map", "child": "moves", "x": x}
        process.ask("publish", samples=[sample | {"stamp": time.time_ns()}])
        while watcher.ask("facts")["x"].get("moves") != x:
            assert time.monotonic() < until, f"no moving frame comes after {self.faults[-1:]}"
            time.sleep(0.05)
            process.ask("publish", samples=[sample | {"stamp": time.time_ns()}])
        process.ask("remove", frame="moves")


@pytest.fixture
def processes() -> Iterator[Crowd]:
    with crowd() as together:
        yield together


def test_hosts_that_cannot_reach_each_other_at_first_meet_when_they_can(hosts: list[Host], processes: Crowd) -> None:
    three = hosts[:3]
    world = World(three, processes, Random(SEED), apart=three[1:])
    while world.peers() != [2, 1, 1]:
        time.sleep(0.05)
    # All that zenoh tries of itself is over.
    time.sleep(1.0)
    assert world.peers() == [2, 1, 1]
    world.mend()
    world.check_equal()


def test_hosts_without_an_address_hear_only_themselves(hosts: list[Host], processes: Crowd) -> None:
    domain = {"domain": new_domain()}
    apart, one, two = (processes.add(domain, prefix=host.prefix) for host in (hosts[0], hosts[1], hosts[1]))
    for process in (one, two):
        process.ask("until", peers=1)
    apart.ask("statics", names=["apart"])
    one.ask("statics", names=["together"])
    two.ask("until", static=["together"])
    assert two.ask("facts")["static"] == ["together"]
    assert apart.ask("facts")["links"][0]["peers"] == 0


def test_after_each_fault_all_buses_hold_the_same_frames(
    hosts: list[Host], processes: Crowd, capsys: pytest.CaptureFixture[str]
) -> None:
    world = World(hosts, processes, Random(SEED))
    world.check_equal()
    until = time.monotonic() + SECONDS
    while time.monotonic() < until:
        world.fault()
        world.live()
        world.mend()
        world.check_equal()
    with capsys.disabled():
        slowest = ", ".join(f"{seconds:.1f} s after {kind!r}" for seconds, kind in sorted(world.times)[:-4:-1])
        print(f"\n{len(world.faults) - 1} faults of seed {SEED}, the slowest until all buses were equal: {slowest}")

"""Processes that publish and remove frames while faults befall them, and what all buses have to agree on after each."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from random import Random
from typing import Any
from uuid import uuid4

import pytest
from support.processes import PATIENCE, Crowd, PeerProcess, Program, free_address, new_domain

LIMIT = float(os.environ.get("FAULT_LIMIT", "10"))
"""s; so long after a fault all buses are equal."""
ROUTER_LEASE = 4.0
Said = tuple[bool, int, float]
"""Whether a sample is static, its stamp, and its x, which no other has."""


class Member:
    """A place for processes one after another, each with links to some networks; what the newest has heard."""

    def __init__(self, name: str, networks: tuple[str, ...], links: list[dict[str, Any]], prefix: tuple[str, ...]):
        self.name = name
        self.networks = networks
        self.links = links
        self.prefix = prefix
        self.process: PeerProcess
        self.ids: list[str] = []
        self.busy: int | None = None
        self.stopped = False

    def begin(self, processes: Crowd, backend: str) -> None:
        self.process = processes.begin(*self.links, backend=backend, prefix=self.prefix, keeps=True)
        self.log: list[Any] = []
        self.shown: dict[str, Said] = {}
        self.present: set[str] = set()
        self.lost: set[str] = set()
        self.heard: list[tuple[str, Said]] = []
        self.again: list[tuple[str, Said]] = []
        self._ever: set[tuple[str, Said]] = set()
        self._read = 0

    def ready(self) -> None:
        self.ids = self.process.wait(event="ready")["ids"]

    def look(self, drop_lost: bool) -> None:
        """Follow what its bus has heard, as a tree does."""
        news = self.process.ask("heard", since=self._read)["heard"]
        self.log += news
        self._read += len(news)
        for kind, name, *said in news:
            if kind == "removal":
                self.shown.pop(name, None)
                if drop_lost:
                    # A link may put removed frames back on the bus.
                    self._ever = {each for each in self._ever if each[0] != name}
            elif kind == "joined":
                assert name not in self.present
                self.present.add(name)
            elif kind == "lost":
                self.present.remove(name)
                self.lost.add(name)
            else:
                sample = (name, (said[0], said[1], said[2]))
                self.heard.append(sample)
                if sample in self._ever:
                    self.again.append(sample)
                self._ever.add(sample)
                known = self.shown.get(name)
                if known is None or said[0] or known[0] or said[1] >= known[1]:
                    self.shown[name] = sample[1]


class World:
    """Some processes of one domain, and the faults of a kind of network."""

    faults: tuple[str, ...] = ()

    def __init__(self, processes: Crowd, seed: int, drop_lost: bool) -> None:
        self.rng = Random(seed)
        self.domain = new_domain()
        self.drop_lost = drop_lost
        self.members: list[Member] = []
        self.story = ["start"]
        self.times: list[tuple[float, str]] = []
        self.dead: set[str] = set()
        self._processes = processes
        self._numbers = count(1)
        self._said: dict[tuple[str, Said], str] = {}
        self._removed: set[str] = set()
        # Frames of which a process that was killed has spoken so late that nobody need have heard it.
        self._recent: set[str] = set()
        self._mending: list[Callable[[], object]] = []

    def add(
        self, name: str, networks: tuple[str, ...], links: list[dict[str, Any]], prefix: tuple[str, ...] = ()
    ) -> None:
        options = {"domain": self.domain, "drop_lost": self.drop_lost}
        self.members.append(Member(name, networks, [options | link for link in links], prefix))

    def start(self, *members: Member) -> None:
        """Start processes at once."""
        for member in members:
            member.begin(self._processes, self.rng.choice(("asyncio", "trio", "asyncio+uvloop")))
        for member in members:
            member.ready()
            self.publish(member, *(f"{member.name}/{frame}" for frame in "abc"))
            self.publish(member, f"{member.name}/moves")

    def kill(self, member: Member) -> None:
        member.process.kill()
        self.dead.update(member.ids)

    def publish(self, member: Member, *frames: str) -> None:
        for frame in frames:
            static, x = not frame.endswith("moves"), float(next(self._numbers))
            stamp = 0 if static else time.time_ns()
            self._said[frame, (static, stamp, x)] = member.ids[0]
            self._recent.add(frame)
            sample = {"parent": "map", "child": frame, "stamp": stamp, "x": x, "static": static}
            member.process.ask("publish", samples=[sample])

    def remove(self, member: Member, frame: str) -> None:
        self._removed.add(frame)
        member.process.ask("remove", frame=frame)

    @property
    def awake(self) -> list[Member]:
        return [member for member in self.members if not member.stopped and member.busy is None]

    def break_something(self, *kinds: str) -> None:
        self.story.append(self.rng.choice(kinds or self.faults))
        getattr(self, f"fault_{self.story[-1]}")(*self.rng.sample(self.members, 2))

    def live(self) -> None:
        """Publish and remove here and there, and let what is broken stay so for a while."""
        for _ in range(self.rng.randrange(1, 8)):
            member = self.rng.choice(self.awake)
            owner = self.rng.choice((member.name, member.name, "shared"))
            frame = f"{owner}/{self.rng.choice(['a', 'b', 'c', 'd'] + ['moves'] * (owner != 'shared'))}"
            if self.rng.random() < 0.25:
                self.remove(member, f"{self.rng.choice((frame, self.rng.choice(self.members).name + '/b'))}")
            else:
                self.publish(member, frame)
        time.sleep(self.rng.choice((0.0, 0.1, 0.5, 2.0, 5.0, 12.0)[: self.longest_pauses]))

    longest_pauses = 6
    """So many of the pauses of `live` are drawn from, the shortest first."""

    def mend(self) -> None:
        for member in self.members:
            if member.stopped:
                member.process.signal(signal.SIGCONT)
                member.stopped = False
            if member.busy is not None:
                member.process.finish(member.busy)
                member.busy = None
        while self._mending:
            self._mending.pop()()

    # Faults of processes

    def fault_kill(self, member: Member, _: Member) -> None:
        self.kill(member)
        self.start(member)

    def fault_kill_two(self, *members: Member) -> None:
        for member in members:
            self.kill(member)
        time.sleep(self.rng.choice((0.0, 0.5)))
        self.start(*members)

    def fault_stop(self, member: Member, _: Member) -> None:
        member.process.signal(signal.SIGSTOP)
        member.stopped = True

    def fault_kill_beside_a_stopped_one(self, member: Member, other: Member) -> None:
        self.fault_stop(other, member)
        self.fault_kill(member, other)

    def fault_block(self, member: Member, _: Member) -> None:
        member.busy = member.process.start("block", seconds=self.rng.choice((0.5, 2.0, 6.0)))

    # Checks

    def check(self) -> None:
        """Wait until all buses are equal, and check that what has happened until then was true."""
        began = time.monotonic()
        while (why := self._unequal()) is not None:
            assert time.monotonic() - began < LIMIT, f"{LIMIT:g} s after {self.story[-3:]}: {why}"
            time.sleep(0.02)
        self.times.append((time.monotonic() - began, self.story[-1]))
        for member in self.members:
            assert member.again == [], (
                f"{member.name} heard twice after {self.story[-3:]}: {member.again} {member.log[-60:]}"
            )
            assert set(member.heard) <= self._said.keys(), "invented"
            member.heard.clear()
            links = member.process.ask("facts")
            assert [link["rejected"] for link in links["links"]] == [{}] * len(member.ids)
            assert links["bus"]["rejected"].keys() <= {"behind"}
        shown = self.members[0].shown
        if self.drop_lost:
            assert not [frame for frame, said in shown.items() if self._said[frame, said] in self.dead]
        alive = {frame for (frame, _), speaker in self._said.items() if speaker not in self.dead or not self.drop_lost}
        spoken = {
            frame for frame in alive - self._removed - self._recent if not self.drop_lost or self._answered_for(frame)
        }
        assert spoken <= shown.keys(), f"forgotten after {self.story[-3:]}: {spoken - shown.keys()}"
        self._recent.clear()

    def _answered_for(self, frame: str) -> bool:
        """Whether it is the frame of one process, and that is there."""
        newest = max(said for name, said in self._said if name == frame)
        return not frame.startswith("shared/") and self._said[frame, newest] not in self.dead

    def _unequal(self) -> str | None:
        for member in self.members:
            member.look(self.drop_lost)
        for member in self.members:
            first = self.members[0]
            if member.shown != first.shown:
                names = sorted(member.shown.keys() | first.shown.keys())
                differ = {n: two for n in names if (two := (member.shown.get(n), first.shown.get(n)))[0] != two[1]}
                heard = {each.name: [news for news in each.log if news[1] in differ] for each in self.members}
                return f"{member.name} and {first.name}: {differ}; {heard}"
            others = {
                other_id
                for other in self.members
                if other is not member
                for network, other_id in zip(other.networks, other.ids, strict=True)
                if network in member.networks
            }
            if member.present != others:
                return (
                    f"{member.name} hears {len(member.present & others)} of {len(others)} and {member.present - others}"
                )
        return None

    def run(self, rounds: int = 0, seconds: float = 0.0) -> str:
        """Break and mend for so many rounds or so long; returns a line about it."""
        self.start(*self.members)
        self.check()
        until = time.monotonic() + seconds
        while len(self.story) <= rounds or time.monotonic() < until:
            self.break_something()
            self.live()
            self.mend()
            self.check()
        slowest = ", ".join(f"{seconds:.1f} s after {kind}" for seconds, kind in sorted(self.times)[:-4:-1])
        return f"{len(self.story) - 1} faults; the slowest until all buses were equal: {slowest}"


class OneMachine(World):
    """Five processes that meet in a directory."""

    faults = (
        *("kill", "kill", "kill_two", "kill_beside_a_stopped_one", "stop", "block"),
        *("stale_names", "full_file_table", "vanished_directory", "open_directory"),
    )

    def __init__(self, processes: Crowd, seed: int, drop_lost: bool, directory: Path, loopback: bool = False) -> None:
        super().__init__(processes, seed, drop_lost)
        self._directory = directory / "run"
        self._loopback = loopback
        for number in range(1, 6):
            self.add(f"{number}", ("local",), [{"directory": str(self._directory), "loopback": loopback}])

    def check(self) -> None:
        super().check()
        # All names are shown again, and those of the dead are gone. A socket is no name on the loopback.
        until = time.monotonic() + LIMIT
        while (names := len(list(self._directory.glob("[0-9a-f]*-*"))) - len(self.members)) != 0:
            if self._loopback and names > 0:
                break
            assert time.monotonic() < until, f"{names} names too many after {self.story[-3:]}"
            time.sleep(0.02)
        for member in self.members:
            # The kernel knows who lives, so nobody else is ever lost.
            assert member.lost <= self.dead

    def fault_stale_names(self, member: Member, other: Member) -> None:
        """Leave names behind at which nobody listens, or nobody answers, or which are something else."""
        (domain, *_) = {path.name.partition("-")[0] for path in self._directory.iterdir()}
        for kind in ("deaf", "dead", "text", "folder"):
            path = self._directory / f"{domain}-{self.rng.randrange(16**12):016x}{self.rng.randrange(16**8):08x}"
            if kind in ("deaf", "dead"):
                listener = socket.socket(socket.AF_UNIX)
                listener.bind(str(path))
                if kind == "deaf":
                    listener.listen()
                    self._mending.append(listener.close)
                else:
                    listener.close()
            elif kind == "text":
                path.write_text("nothing")
            else:
                path.mkdir()
                self._mending.append(path.rmdir)
        self.fault_kill(member, other)

    def fault_full_file_table(self, member: Member, other: Member) -> None:
        member.busy = member.process.start("fill_file_table", seconds=self.rng.choice((0.5, 2.0)))
        self.fault_kill(other, member)

    def fault_vanished_directory(self, member: Member, other: Member) -> None:
        while self._directory.exists():
            # A link may show its name again meanwhile.
            shutil.rmtree(self._directory, ignore_errors=True)
        if self.rng.random() < 0.5:
            self.fault_kill(member, other)

    def fault_open_directory(self, member: Member, _: Member) -> None:
        """Let other users enter the directory, so that nobody begins there until that is mended."""
        self.kill(member)
        self._directory.chmod(0o755)
        member.begin(self._processes, "asyncio")
        with pytest.raises(EOFError, match="PermissionError"):
            member.process.wait(event="ready")
        self._directory.chmod(0o700)
        self.start(member)


class Host:
    """A network namespace with an address, in which a process may live."""

    def __init__(self, name: str, number: int) -> None:
        self.name = name
        self.address = f"10.98.77.{number}"
        self.prefix = ("ip", "netns", "exec", name)

    def run(self, *command: str) -> None:
        subprocess.run([*self.prefix, *command], check=True, capture_output=True, timeout=PATIENCE)

    def silence(self, other: "Host") -> None:
        """Let nothing more go to another host."""
        self.run("ip", "route", "add", "blackhole", f"{other.address}/32")

    def speak(self, other: "Host") -> None:
        self.run("ip", "route", "delete", "blackhole", f"{other.address}/32")

    def begin_to_lose(self) -> None:
        chain = "add table inet lossy; add chain inet lossy input { type filter hook input priority 0; }"
        self.run("nft", f"{chain}; add rule inet lossy input numgen random mod 100 < 30 drop")

    def end_to_lose(self) -> None:
        self.run("nft", "delete table inet lossy")


@contextmanager
def hosts(how_many: int) -> Iterator[list[Host]]:
    """Network namespaces that reach each other by a switch; skips where there are none."""
    ip = shutil.which("ip")
    if ip is None or os.geteuid() != 0:
        pytest.skip("network namespaces need root and the program ip")
    tag = uuid4().hex[:6]
    switch, made = f"tg{tag}s", [Host(f"tg{tag}{number}", number) for number in range(1, how_many + 1)]

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


_ROUTER = """
import sys, anyio
from tfbus.links.zenoh import ZenohRouter
async def main(listen, *connect):
    async with ZenohRouter(listen, connect=connect):
        print("ready", flush=True)
        await anyio.sleep_forever()
anyio.run(main, *sys.argv[1:])
"""


class Router:
    """A router in a process, at an address of its own."""

    def __init__(self, address: str, host: Host | None) -> None:
        self.address = address
        self.host = host
        self.others: list[str] = []
        self.program: Program | None = None

    def start(self) -> None:
        prefix = () if self.host is None else self.host.prefix
        self.program = Program(*prefix, sys.executable, "-P", "-c", _ROUTER, self.address, *self.others)
        self.program.output.expect("ready")

    def signal(self, number: signal.Signals) -> None:
        assert self.program is not None
        self.program.process.send_signal(number)

    def kill(self) -> None:
        assert self.program is not None
        self.program.__exit__(None, None, None)


class Routers(World):
    """Processes of several hosts that are clients of one router, or of either of two that are connected.

    With `machines`, each of two hosts has two more processes, of which none has a link to a router: a bridge with both
    links joins them to the others.
    """

    def __init__(
        self,
        processes: Crowd,
        seed: int,
        drop_lost: bool,
        routers: int,
        apart: list[Host] | None,
        directory: Path | None = None,
    ) -> None:
        super().__init__(processes, seed, drop_lost)
        self.faults = (
            "kill",
            "kill_two",
            "kill_beside_a_stopped_one",
            "stop",
            "block",
            "router_killed",
            "router_stopped",
        )
        self.hosts = apart or []
        if apart is not None:
            self.faults += ("cut", "one_way", "flapping", "router_cut")
            self.faults += ("lossy",) * bool(shutil.which("nft"))
        places: list[Host | None] = [*self.hosts[-routers:]] if apart else [None] * routers
        addresses = [free_address() if place is None else f"tcp/{place.address}:17447" for place in places]
        self.routers = [Router(*router) for router in zip(addresses, places, strict=True)]
        for number in range(4):
            host = self.hosts[number] if apart else None
            turned = addresses[number % routers :] + addresses[: number % routers]
            link: dict[str, Any] = {"connect": turned, "lease": ROUTER_LEASE}
            prefix = () if host is None else host.prefix
            if directory is None or number > 1:
                self.add(f"{number}", ("zenoh",), [link], prefix)
            else:
                inside = {"directory": str(directory / f"{number}")}
                self.add(f"{number}", ("zenoh", f"local{number}"), [link, inside], prefix)
                self.add(f"{number}-", (f"local{number}",), [inside], prefix)
                self.add(f"{number}--", (f"local{number}",), [inside], prefix)

    def __enter__(self) -> "Routers":
        for router in self.routers:
            router.start()
            # The first one that is started again looks for the others too.
            router.others = [other.address for other in self.routers if other is not router]
            for other in self.routers:
                if other.program is None:
                    other.others = [router.address]
        return self

    def __exit__(self, *_: object) -> None:
        self._mending.clear()
        for router in self.routers:
            if router.program is not None:
                with suppress(ProcessLookupError):
                    router.signal(signal.SIGCONT)
                router.kill()

    def _cut(self, one: Host, other: Host) -> None:
        one.silence(other)
        self._mending.append(lambda: one.speak(other))

    def _host_of(self, member: Member) -> Host:
        return next(host for host in self.hosts if host.prefix == member.prefix)

    def _cut_off(self, host: Host) -> None:
        for router in self.routers:
            assert router.host is not None
            self._cut(host, router.host)
            self._cut(router.host, host)

    def fault_cut(self, member: Member, _: Member) -> None:
        self._cut_off(self._host_of(member))

    def fault_one_way(self, member: Member, _: Member) -> None:
        router = self.rng.choice(self.routers).host
        assert router is not None
        self._cut(*self.rng.sample((self._host_of(member), router), 2))

    def fault_flapping(self, member: Member, other: Member) -> None:
        for _ in range(5):
            self.fault_cut(member, other)
            time.sleep(self.rng.choice((0.1, 0.3, 1.0)))
            self.mend()
            time.sleep(self.rng.choice((0.1, 0.3, 1.0)))

    def fault_lossy(self, member: Member, _: Member) -> None:
        host = self._host_of(member)
        host.begin_to_lose()
        self._mending.append(host.end_to_lose)

    def fault_router_killed(self, member: Member, other: Member) -> None:
        router = self.rng.choice(self.routers)
        router.kill()
        if len(self.routers) > 1:
            # The other one is enough.
            self.live()
            self.check()
        elif self.rng.random() < 0.3:
            self.fault_kill(member, other)
        self._mending.append(router.start)

    def fault_router_stopped(self, _: Member, __: Member) -> None:
        router = self.rng.choice(self.routers)
        router.signal(signal.SIGSTOP)
        self._mending.append(lambda: router.signal(signal.SIGCONT))

    def fault_router_cut(self, _: Member, __: Member) -> None:
        router = self.rng.choice(self.routers).host
        assert router is not None
        for host in self.hosts:
            if host is not router:
                self._cut(host, router)
                self._cut(router, host)


@contextmanager
def short_directory() -> Iterator[Path]:
    """A temporary directory with a path that sockets can have."""
    with tempfile.TemporaryDirectory(prefix="tf", dir="/tmp") as directory:
        yield Path(directory)

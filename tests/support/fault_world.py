"""Processes that publish and remove frames while faults befall them, and what all buses have to agree on after each."""

import os
import shutil
import signal
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from itertools import count
from pathlib import Path
from random import Random
from typing import Any

import pytest
from support.namespaces import Network, Way
from support.processes import Crowd, PeerProcess, Program, free_address, new_domain

LIMIT = float(os.environ.get("FAULT_LIMIT", "10"))
"""s; so long after a fault all buses are equal."""
ROUTER_LEASE = 4.0
Said = tuple[bool, int, float]
"""Whether a sample is static, its stamp, and its x, which no other has."""


class Member:
    """A place for processes one after another, each with links to some networks; what the newest has heard."""

    def __init__(
        self, name: str, networks: tuple[str, ...], links: list[dict[str, Any]], within: Sequence[str]
    ) -> None:
        self.name = name
        self.within = within
        self.networks = networks
        self.links = links
        self.process: PeerProcess
        self.ids: list[str] = []
        self.busy: int | None = None
        self.stopped = False

    def begin(self, processes: Crowd, backend: str) -> None:
        self.process = processes.begin(*self.links, backend=backend, keeps=True, within=self.within)
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
        self, name: str, networks: tuple[str, ...], links: list[dict[str, Any]], within: Sequence[str] = ()
    ) -> None:
        options = {"domain": self.domain, "drop_lost": self.drop_lost}
        self.members.append(Member(name, networks, [options | link for link in links], within))

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
        time.sleep(self.rng.choice((0.0, 0.1, 0.5, 2.0, 5.0, 12.0)))

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

    def run(self, seconds: float) -> str:
        """Break and mend for so long; returns a line about it."""
        self.start(*self.members)
        self.check()
        until = time.monotonic() + seconds
        while time.monotonic() < until:
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
        while (names := len(list(self._directory.glob("*/[0-9a-f]*"))) - len(self.members)) != 0:
            if self._loopback and names > 0:
                break
            assert time.monotonic() < until, f"{names} names too many after {self.story[-3:]}"
            time.sleep(0.02)
        for member in self.members:
            # The kernel knows who lives, so nobody else is ever lost.
            assert member.lost <= self.dead

    def fault_stale_names(self, member: Member, other: Member) -> None:
        """Leave names behind at which nobody listens, or nobody answers, or which are something else."""
        (folder,) = self._directory.iterdir()
        for kind in ("deaf", "dead", "text", "folder"):
            path = folder / f"{self.rng.randrange(16**12):016x}{self.rng.randrange(16**8):08x}"
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

    def __init__(self, address: str, within: Sequence[str]) -> None:
        self.address = address
        self._within = within
        self.others: list[str] = []
        self.program: Program | None = None

    def start(self) -> None:
        self.program = Program(*self._within, sys.executable, "-P", "-c", _ROUTER, self.address, *self.others)
        self.program.output.expect("ready")

    def signal(self, number: signal.Signals) -> None:
        assert self.program is not None
        self.program.process.send_signal(number)

    def kill(self) -> None:
        assert self.program is not None
        self.program.__exit__(None, None, None)


class Routers(World):
    """Processes that are clients of one router, or of either of two that are connected; without any, the first listens.

    With a directory, each of two has two more beside it, of which none has a link to a router: a bridge with both
    links joins them to the others. With a network, each router and each process is in a namespace of its own.
    """

    faults: tuple[str, ...] = ("kill", "kill_two", "kill_beside_a_stopped_one", "stop", "block")

    def __init__(
        self,
        processes: Crowd,
        seed: int,
        drop_lost: bool,
        routers: int,
        directory: Path | None = None,
        network: Network | None = None,
    ) -> None:
        super().__init__(processes, seed, drop_lost)
        places = network.places if network else range(routers + 4)
        addresses = [f"tcp/{network.address(place)}:7447" if network else free_address() for place in places]
        within = [network.within(place) if network else [] for place in places]
        self.routers = [Router(addresses[place], within[place]) for place in range(routers)]
        self._network = network
        if routers:
            self.faults += ("router_killed", "router_stopped")
        if network:
            self.faults += ("cut", "cut", "cut_one_way", "cut_one_way", "flap", "slow", "slow")
        for number in range(4):
            first = number % max(1, routers)
            link: dict[str, Any] = {"connect": [addresses[first], *addresses[:first], *addresses[first + 1 : routers]]}
            if number == routers == 0:
                link = {"listen": addresses[0]}
            link["lease"] = ROUTER_LEASE
            if directory is None or number > 1:
                self.add(f"{number}", ("zenoh",), [link], within[routers + number])
            else:
                inside = {"directory": str(directory / f"{number}")}
                self.add(f"{number}", ("zenoh", f"local{number}"), [link, inside])
                self.add(f"{number}-", (f"local{number}",), [inside])
                self.add(f"{number}--", (f"local{number}",), [inside])

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

    # Faults of the network

    def _spoil(self, ways: Sequence[Way], loss: float = 1.0, delay: float = 0.0) -> None:
        assert self._network is not None
        self._network.spoil(ways, loss, delay)
        self._mending.append(partial(self._network.spoil, ways))

    def _ways(self) -> tuple[list[Way], list[Way]]:
        """All ways from a router or a process, to all others or to one of them, and back."""
        assert self._network is not None
        place, other = self.rng.sample(self._network.places, 2)
        away = self._network.ways([place], self.rng.choice((None, None, [other])))
        self.story[-1] += f" {away}"
        return away, [(other, place) for place, other in away]

    def fault_cut(self, *_: Member) -> None:
        away, back = self._ways()
        self._spoil(away + back)
        if len(self.routers) > 1 and away[0][0] < 2 and len(away) > 1:
            # The other router is enough.
            self.live()
            self.check()

    def fault_cut_one_way(self, *_: Member) -> None:
        self._spoil(self.rng.choice(self._ways()))

    def fault_flap(self, *_: Member) -> None:
        away, back = self._ways()
        for _again in range(self.rng.randrange(2, 8)):
            self._spoil(away + back)
            time.sleep(self.rng.choice((0.1, 0.5, 1.5, 5.0)))
            self._mending.pop()()
            time.sleep(self.rng.choice((0.0, 0.1, 0.5, 2.0)))

    def fault_slow(self, *_: Member) -> None:
        """Delay what a router or a process hears or says, and lose some of it."""
        for ways in self._ways():
            self._spoil(ways, self.rng.choice((0.0, 0.05, 0.2)), self.rng.choice((0.0, 0.05, 0.3)))


@contextmanager
def short_directory() -> Iterator[Path]:
    """A temporary directory with a path that sockets can have."""
    with tempfile.TemporaryDirectory(prefix="tf", dir="/tmp") as directory:
        yield Path(directory)

"""This process and others: peers that answer commands, programs as a user runs them, allocations and open files."""

import json
import os
import queue
import re
import signal
import socket
import subprocess
import sys
import threading
import tracemalloc
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from itertools import count, islice
from pathlib import Path
from types import TracebackType
from typing import IO, Any
from uuid import uuid4

import anyio
import pytest

PATIENCE = 60.0
"""Seconds; far more than anything takes."""

on_one_loop = pytest.mark.parametrize("anyio_backend", [("asyncio", {})], ids=["asyncio"])
"""For a slow test of other programs, which do not notice which loop runs here."""

_PROGRAM = Path(__file__).parent / "peer_process.py"
_numbers = count()
# Systems give ports above these to whoever asks for any; processes of tests begin far apart.
_ports = (12_000 + (os.getpid() * 997 + number) % 20_000 for number in count())


def free_ports(how_many: int) -> list[int]:
    """Ports of the loopback that nobody listens at, and that nobody is given before the test uses them."""
    return list(islice(filter(is_free, _ports), how_many))


def is_free(port: int) -> bool:
    """Whether nobody listens at a port of the loopback."""
    try:
        socket.create_server(("127.0.0.1", port)).close()
    except OSError:
        return False
    return True


def new_domain() -> str:
    """The name of a domain that no other test uses."""
    return f"test-{uuid4().hex}"


def free_address() -> str:
    """An address on the loopback at which no program listens."""
    return f"tcp/127.0.0.1:{free_ports(1)[0]}"


_dds_domains = count(os.getpid())


def new_dds_domain() -> int:
    """A domain of DDS that is not ROS's default one, and that no other process of this run uses at the same time."""
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    return 100 + worker + next(_dds_domains) % (100 // workers) * workers


class Place:
    """A domain of one test: on this machine, or behind the router in the process of its first member."""

    def __init__(self, carrier: str) -> None:
        self.carrier = carrier
        self.domain = new_domain()
        self.address = free_address()

    def first(self, **options: Any) -> dict[str, Any]:
        return self._link("listen", options)

    def other(self, **options: Any) -> dict[str, Any]:
        return self._link("connect", options)

    def _link(self, side: str, options: dict[str, Any]) -> dict[str, Any]:
        if self.carrier == "router":
            return {"domain": self.domain, side: self.address, **options}
        options.pop("lease", None)
        return {"domain": self.domain, **options}


class PeerProcess:
    """One such process, begun by the words `within` if there are some; its output is kept until a test asks for it."""

    def __init__(
        self, *links: dict[str, Any], backend: str = "asyncio", keeps: bool = False, within: Iterable[str] = ()
    ) -> None:
        arguments = {"backend": backend, "links": links, "keeps": keeps}
        command = [*within, sys.executable, str(_PROGRAM), json.dumps(arguments)]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        self._said: queue.Queue[dict[str, Any] | None] = queue.Queue()
        self._kept: list[dict[str, Any]] = []
        self.errors = ""
        self._readers = [threading.Thread(target=read) for read in (self._read_output, self._read_errors)]
        for reader in self._readers:
            reader.start()

    @property
    def pid(self) -> int:
        return self._process.pid

    def start(self, do: str, **arguments: Any) -> int:
        """Send a command; returns its number for `finish`."""
        number = next(_numbers)
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps({"id": number, "do": do, **arguments}) + "\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            self._process.wait(PATIENCE)
            for reader in self._readers:
                reader.join(PATIENCE)
            raise EOFError(f"the process has ended with {self._process.returncode}; {self.errors}") from None
        return number

    def finish(self, number: int) -> dict[str, Any]:
        """Wait for the answer to a command."""
        return self.wait(id=number)

    def ask(self, do: str, **arguments: Any) -> dict[str, Any]:
        """Send a command, and wait for its answer."""
        return self.finish(self.start(do, **arguments))

    def wait(self, **facts: Any) -> dict[str, Any]:
        """The first line of its output, kept or new, that has all of `facts`."""
        for said in self._kept:
            if facts.items() <= said.items():
                self._kept.remove(said)
                return said
        while True:
            try:
                news = self._said.get(timeout=PATIENCE)
            except queue.Empty:
                raise TimeoutError(f"{facts} was not said, but {self._kept}; {self.errors}") from None
            if news is None:
                raise EOFError(f"the process ended before it said {facts}, after {self._kept}; {self.errors}")
            if facts.items() <= news.items():
                return news
            self._kept.append(news)

    def said(self, **facts: Any) -> list[dict[str, Any]]:
        """The lines of its output that nobody has waited for, with all of `facts`."""
        self.ask("facts")
        return [said for said in self._kept if facts.items() <= said.items()]

    def signal(self, number: signal.Signals) -> None:
        self._process.send_signal(number)

    def kill(self) -> None:
        """Kill it."""
        self._process.kill()
        self._process.wait(PATIENCE)

    def end(self) -> int:
        """Let it end by itself; returns its exit status."""
        if self._process.stdin is not None and not self._process.stdin.closed:
            self._process.stdin.close()
        try:
            return self._process.wait(PATIENCE)
        finally:
            self.clean_up()

    def clean_up(self) -> None:
        if self._process.poll() is None:
            os.kill(self.pid, signal.SIGCONT)
            self.kill()
        for reader in self._readers:
            reader.join(PATIENCE)
        for stream in (self._process.stdin, self._process.stdout, self._process.stderr):
            if stream is not None and not stream.closed:
                try:
                    stream.close()
                except BrokenPipeError:
                    continue

    def _read_output(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._said.put(json.loads(line))
        self._said.put(None)

    def _read_errors(self) -> None:
        assert self._process.stderr is not None
        for line in self._process.stderr:
            self.errors += line


class Crowd:
    """Processes that end with the test."""

    def __init__(self) -> None:
        self.members: list[PeerProcess] = []

    def add(self, *links: dict[str, Any], **how: Any) -> PeerProcess:
        """Start a process, and wait until its links are open."""
        process = self.begin(*links, **how)
        process.wait(event="ready")
        return process

    def begin(self, *links: dict[str, Any], **how: Any) -> PeerProcess:
        """Start a process, as a `PeerProcess` says."""
        process = PeerProcess(*links, **how)
        self.members.append(process)
        return process


@contextmanager
def crowd() -> Iterator[Crowd]:
    together = Crowd()
    try:
        yield together
    finally:
        for member in together.members:
            member.clean_up()


async def until(holds: Callable[[], bool]) -> None:
    """Wait until something holds in this process."""
    with anyio.fail_after(PATIENCE):
        while not holds():  # noqa: ASYNC110 - zenoh's threads wake no event here
            await anyio.sleep(0.002)


def peak_of(call: Callable[[], object]) -> int:
    """The bytes that a call had allocated at most."""
    tracemalloc.start()
    try:
        call()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


OPEN_FILES = Path("/proc/self/fd")


def is_open(path: Path) -> bool:
    """Whether a file, or one in a folder, is open; False where the system does not tell."""
    found = []
    for descriptor in OPEN_FILES.iterdir() if OPEN_FILES.is_dir() else ():
        # The one by which they are listed has gone.
        with suppress(OSError):
            found.append(descriptor.readlink())
    path = path.resolve()
    return any(path in (each, *each.parents) for each in found)


# Programs as a user runs them, each in a process of its own; a test waits for the lines that they print

TFBUS = str(Path(sys.executable).with_name("tfbus"))


class Lines:
    """The lines that a process prints to one of its streams."""

    def __init__(self, file: IO[str]) -> None:
        self._file = file
        self._changed = threading.Condition()
        self._lines: list[str] = []
        self._read = 0
        self._ended = False
        self._reader = threading.Thread(target=self._follow)
        self._reader.start()

    @property
    def text(self) -> str:
        """All output so far."""
        with self._changed:
            return "".join(self._lines)

    def expect(self, pattern: str) -> str:
        """Wait for the next line that contains the pattern, after those that were expected before."""
        with self._changed:
            while True:
                while self._read < len(self._lines):
                    self._read += 1
                    if re.search(pattern, self._lines[self._read - 1]):
                        return self._lines[self._read - 1].rstrip("\n")
                arrived = not self._ended and self._changed.wait(PATIENCE)
                assert arrived or self._read < len(self._lines), f"no {pattern!r} in {''.join(self._lines)!r}"

    def skip(self) -> None:
        """Ignore the lines that have been printed by now."""
        with self._changed:
            self._read = len(self._lines)

    def join(self) -> None:
        """Wait for the end of the stream."""
        self._reader.join()

    def _follow(self) -> None:
        for line in self._file:
            with self._changed:
                self._lines.append(line)
                self._changed.notify_all()
        with self._changed:
            self._ended = True
            self._changed.notify_all()


class Program:
    """A process that is killed at the end of the ``with``, unless it has ended before."""

    def __init__(self, *command: str | Path, environment: Mapping[str, str] | None = None) -> None:
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, encoding="utf-8", env=environment
        )
        assert self.process.stdout is not None
        assert self.process.stderr is not None
        self.output = Lines(self.process.stdout)
        self.errors = Lines(self.process.stderr)

    def end(self, number: int = signal.SIGINT) -> int:
        """Send a signal, by default that of Ctrl-C, and wait for the end; returns the exit status."""
        self.process.send_signal(number)
        return self.wait()

    def wait(self) -> int:
        """Wait for the end of the process and of its output; returns the exit status."""
        status = self.process.wait(PATIENCE)
        self.output.join()
        self.errors.join()
        return status

    def __enter__(self) -> "Program":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        with self.process:
            self.process.kill()
            self.output.join()
            self.errors.join()


def start_tfbus(*arguments: str) -> Program:
    """Start the command ``tfbus``."""
    return Program(TFBUS, *arguments)

"""Processes that run `peer_process.py` and answer its commands."""

import json
import os
import queue
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count, islice
from pathlib import Path
from typing import Any
from uuid import uuid4

import anyio

PATIENCE = 60.0
"""Seconds; far more than anything takes."""

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


class PeerProcess:
    """One such process; its output is kept until a test asks for it."""

    def __init__(self, *links: dict[str, Any], backend: str = "asyncio", prefix: tuple[str, ...] = ()) -> None:
        command = [*prefix, sys.executable, str(_PROGRAM), json.dumps({"backend": backend, "links": links})]
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

    def add(self, *links: dict[str, Any], backend: str = "asyncio", prefix: tuple[str, ...] = ()) -> PeerProcess:
        """Start a process, and wait until its links are open."""
        process = self.begin(*links, backend=backend, prefix=prefix)
        process.wait(event="ready")
        return process

    def begin(self, *links: dict[str, Any], backend: str = "asyncio", prefix: tuple[str, ...] = ()) -> PeerProcess:
        """Start a process."""
        process = PeerProcess(*links, backend=backend, prefix=prefix)
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

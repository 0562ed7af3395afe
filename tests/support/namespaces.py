"""Network namespaces that a switch in user space joins; it delays, loses or cuts what passes from one to another.

The switch is a process that makes the namespaces, without names, and a TUN device in each. Both last as long as the
switch and the processes within, and the switch ends with its input: nothing outlives a test, however that ends.
"""

import asyncio
import ctypes
import json
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterable
from contextlib import suppress
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

_DEVICE = Path("/dev/net/tun")
_CLONE_NEWNET = 0x40000000
_TUNSETIFF, _IFF_TUN, _IFF_NO_PI = 0x400454CA, 0x0001, 0x1000

Way = tuple[int, int]
"""From one namespace to another, by their numbers."""


def absent() -> str | None:
    """A reason why namespaces cannot be made here."""
    if sys.platform != "linux" or os.geteuid() != 0:
        return "only root makes network namespaces, on Linux"
    missing = [name for name in ("ip", "nsenter") if shutil.which(name) is None]
    return f"no {', '.join(missing) or _DEVICE}" if missing or not _DEVICE.exists() else None


class Network:
    """Namespaces with the numbers from 0 on, which hear each other at once until a way is spoiled."""

    def __init__(self, places: int) -> None:
        self.places = range(places)
        self._switch = subprocess.Popen(
            [sys.executable, "-P", __file__, str(places)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self._files: list[int] = self._read()

    def address(self, place: int) -> str:
        return f"10.0.0.{place + 1}"

    def within(self, place: int) -> list[str]:
        """The words before a command that runs in a namespace."""
        return ["nsenter", f"--net={self._namespace(place)}"]

    def ways(self, places: Iterable[int], others: Iterable[int] | None = None) -> list[Way]:
        """All ways from some namespaces to the others, or to those that are given."""
        places = set(places)
        others = set(self.places if others is None else others) - places
        return [(place, other) for place in places for other in others]

    def spoil(self, ways: Iterable[Way], loss: float = 0.0, delay: float = 0.0) -> None:
        """Lose a part of what goes these ways, and delay the rest by some seconds; by default neither any more."""
        assert self._switch.stdin is not None
        self._switch.stdin.write(json.dumps([[*ways], loss, delay]) + "\n")
        self._switch.stdin.flush()
        self._read()

    def socket(self, place: int) -> socket.socket:
        """A datagram socket of a namespace, for this process."""
        libc = ctypes.CDLL(None, use_errno=True)
        with Path("/proc/thread-self/ns/net").open() as here, Path(self._namespace(place)).open() as there:
            try:
                _check(libc.setns(there.fileno(), _CLONE_NEWNET))
                made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            finally:
                _check(libc.setns(here.fileno(), _CLONE_NEWNET))
        made.bind((self.address(place), 0))
        return made

    def __enter__(self) -> "Network":
        return self

    def __exit__(self, *_: object) -> None:
        with self._switch:
            self._switch.kill()

    def _namespace(self, place: int) -> str:
        return f"/proc/{self._switch.pid}/fd/{self._files[place]}"

    def _read(self) -> Any:
        assert self._switch.stdout is not None
        line = self._switch.stdout.readline()
        assert line, "the switch has ended"
        return json.loads(line)


def _check(result: int) -> None:
    if result != 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))


def _make_namespace(place: int) -> tuple[int, int]:
    """Go into a new namespace; returns open files of it, and of the device in it."""
    import fcntl

    _check(ctypes.CDLL(None, use_errno=True).unshare(_CLONE_NEWNET))
    device = os.open(_DEVICE, os.O_RDWR | os.O_NONBLOCK)
    name = b"tun".ljust(16, b"\0") + (_IFF_TUN | _IFF_NO_PI).to_bytes(2, sys.byteorder)
    fcntl.ioctl(device, _TUNSETIFF, name.ljust(40, b"\0"))
    for command in (f"address add 10.0.0.{place + 1}/24 dev tun", "link set tun up", "link set lo up"):
        subprocess.run(["ip", *command.split()], check=True)
    return os.open("/proc/self/ns/net", os.O_RDONLY), device


async def _switch(places: int) -> None:
    loop = asyncio.get_running_loop()
    namespaces, devices = zip(*map(_make_namespace, range(places)), strict=True)
    spoiled: dict[Way, tuple[float, float]] = {}
    rng = Random(0)

    def write(device: int, packet: bytes) -> None:
        # One whose queue is full loses the packet, as other networks do.
        with suppress(BlockingIOError):
            os.write(device, packet)

    def pass_on(place: int) -> None:
        with suppress(BlockingIOError):
            while packet := os.read(devices[place], 65536):
                other = packet[19] - 1
                if packet[0] >> 4 != 4 or other not in range(places):
                    continue
                loss, delay = spoiled.get((place, other), (0.0, 0.0))
                if rng.random() < loss:
                    continue
                if delay:
                    loop.call_later(delay, write, devices[other], packet)
                else:
                    write(devices[other], packet)

    for place in range(places):
        loop.add_reader(devices[place], partial(pass_on, place))
    commands = asyncio.StreamReader()
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(commands), sys.stdin)
    print(json.dumps(namespaces), flush=True)
    async for line in commands:
        for place in range(places):
            # They were sent before.
            pass_on(place)
        ways, loss, delay = json.loads(line)
        spoiled.update(((place, other), (loss, delay)) for place, other in ways)
        print("true", flush=True)


if __name__ == "__main__":
    asyncio.run(_switch(int(sys.argv[1])))

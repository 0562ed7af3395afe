"""A process with a bus and its links that reads commands as lines of JSON, and writes its answers as such lines.

Its only argument is JSON too: ``{"backend": .., "links": [{"domain": .., ..}, ..]}``, with the arguments of each link:
of a `ZenohLink` if it has an address, else of a `LocalLink`. With ``"keeps": true`` it keeps all that it hears.
A line ``{"id": 7, "do": "publish", ..}`` is answered by ``{"id": 7, ..}`` when it is done; what happens on the bus
comes by itself, as ``{"event": "PeerLost", ..}``. It ends at the end of its input.
"""

import json
import os
import resource
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import AsyncExitStack, suppress
from dataclasses import asdict
from typing import Any

import anyio
import anyio.lowlevel

from tfbus import (
    Buffer,
    Bus,
    LocalLink,
    PeerJoined,
    PeerLost,
    PeerRejected,
    SystemClock,
    Transform,
    TransformStamped,
    UnknownFrameError,
)
from tfbus.geometry.stamped import Batch
from tfbus.links import DomainLink

_PROBE = 0.01


def tell(**facts: Any) -> None:
    sys.stdout.write(json.dumps(facts) + "\n")
    sys.stdout.flush()


class Tally:
    """Counts the batches of one authority, which are numbered by the stamps of their samples."""

    def __init__(self) -> None:
        self.batches = 0
        self.samples = 0
        self.last = -1
        self.missing = 0
        self.not_in_order = 0
        self.not_whole = 0

    def count(self, batch: Batch) -> None:
        stamp = batch[0].stamp
        whole = all(sample.stamp == stamp for sample in batch)
        if not whole or len({sample.child for sample in batch}) != len(batch):
            self.not_whole += 1
        if stamp <= self.last:
            self.not_in_order += 1
        else:
            self.missing += stamp - self.last - 1
        self.batches += 1
        self.samples += len(batch)
        self.last = stamp


class Program:
    def __init__(self, bus: Bus, links: list[DomainLink], keeps: bool) -> None:
        self.bus = bus
        self.links = links
        self.buffer = Buffer(bus, keep=None)
        self.tallies: defaultdict[str, Tally] = defaultdict(Tally)
        self.static: set[str] = set()
        self.moving: set[str] = set()
        self.x: dict[str, float] = {}
        self.longest_pause = 0.0
        self.heard: list[tuple[Any, ...]] | None = [] if keeps else None
        self._changed = anyio.Event()
        bus.subscribe(self._arrived, self._removed)

    def _arrived(self, batch: Batch) -> None:
        self.tallies[batch[0].authority].count(batch)
        for sample in batch:
            new, old = (self.static, self.moving) if sample.static else (self.moving, self.static)
            new.add(sample.child)
            old.discard(sample.child)
            self.x[sample.child] = sample.transform.translation[0]
            self._keep("sample", sample.child, sample.static, sample.stamp, sample.transform.translation[0])
        self._changed.set()

    def _removed(self, frame: str) -> None:
        self.static.discard(frame)
        self.moving.discard(frame)
        self.x.pop(frame, None)
        self._keep("removal", frame)
        self._changed.set()

    def _keep(self, *fact: Any) -> None:
        if self.heard is not None:
            self.heard.append(fact)

    async def tell_events(self) -> None:
        with self.bus.events(stale_after=None) as events:
            async for event in events:
                match event:
                    case PeerJoined(link=link, peer=peer):
                        tell(event="PeerJoined", link=link, peer=peer)
                        self._keep("joined", peer)
                    case PeerLost(link=link, peer=peer, authorities=authorities, frames=frames):
                        tell(event="PeerLost", link=link, peer=peer, authorities=authorities, frames=frames)
                        self._keep("lost", peer)
                    case PeerRejected(peer=peer, reason=reason):
                        tell(event="PeerRejected", peer=peer, reason=reason)
                self._changed.set()

    async def watch_pauses(self) -> None:
        """Measure the longest time for which the event loop was busy."""
        while True:
            due = time.monotonic() + _PROBE
            await anyio.sleep(_PROBE)
            self.longest_pause = max(self.longest_pause, time.monotonic() - due)

    async def do(self, command: dict[str, Any]) -> None:
        number, name = command.pop("id"), command.pop("do")
        answer = await getattr(self, f"do_{name}")(**command)
        tell(id=number, **(answer or {}))

    async def do_publish(self, samples: list[dict[str, Any]]) -> None:
        """One batch."""
        self.bus.publish([as_sample(**sample) for sample in samples])

    async def do_statics(self, names: list[str], x: float = 0.0, authority: str = "") -> None:
        """Publish static frames under the map, as one batch."""
        self.bus.publish([as_sample("map", name, 0, x, authority, static=True) for name in names])

    async def do_stream(
        self, authority: str, batches: int, rate: float, size: int = 20, start: int = 0
    ) -> dict[str, Any]:
        """Publish numbered batches, `rate` of them a second, of frames named after the authority."""
        began = time.monotonic()
        longest_call = 0.0
        for number in range(start, start + batches):
            batch = [
                as_sample("map", f"{authority}/{child}", number, float(number), authority) for child in range(size)
            ]
            before = time.monotonic()
            self.bus.publish(batch)
            longest_call = max(longest_call, time.monotonic() - before)
            due = began + (number - start + 1) / rate
            await anyio.sleep(max(0.0, due - time.monotonic()))
        return {"longest_call": longest_call, "seconds": time.monotonic() - began}

    async def do_remove(self, frame: str) -> None:
        # Another process may have been faster.
        with suppress(UnknownFrameError):
            self.bus.remove_frame(frame)

    async def do_lookup(self, target: str, source: str, at: int | None = None) -> dict[str, Any]:
        """Wait for a transform for as long as it takes."""
        found = await (self.buffer.lookup(target, source) if at is None else self.buffer.lookup(target, source, at))
        return {"x": found.transform.translation[0], "stamp": found.stamp, "authority": found.authority}

    async def do_until(
        self,
        has: list[str] | None = None,
        lacks: list[str] | None = None,
        static: list[str] | None = None,
        peers: int | None = None,
        last: dict[str, int] | None = None,
        x: dict[str, float] | None = None,
        link: int = 0,
    ) -> dict[str, Any]:
        """Wait until some frames exist, do not exist, or are static, and all other conditions hold.

        `peers` is a number of peers; `last` has numbers of last batches by authority, and `x` positions by frame.
        """

        def holds() -> bool:
            return (
                set(has or ()) <= self.static | self.moving
                and set(static or ()) <= self.static
                and not set(lacks or ()) & (self.static | self.moving)
                and (peers is None or len(self.links[link].peers) == peers)
                and all(self.tallies[authority].last >= number for authority, number in (last or {}).items())
                and all(self.x.get(frame) == place for frame, place in (x or {}).items())
            )

        began = time.monotonic()
        await self._until(holds)
        return {"seconds": time.monotonic() - began, "static": sorted(self.static), "moving": sorted(self.moving)}

    async def _until(self, holds: Callable[[], bool]) -> None:
        while not holds():
            self._changed = anyio.Event()
            await self._changed.wait()

    async def do_block(self, seconds: float) -> None:
        """Keep the event loop busy."""
        time.sleep(seconds)  # noqa: ASYNC251 - that is what is asked for

    async def do_heard(self, since: int) -> dict[str, Any]:
        """All that was heard since then."""
        assert self.heard is not None
        return {"heard": self.heard[since:]}

    async def do_fill_file_table(self, seconds: float) -> None:
        """Have no file left to open for a while."""
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (min(soft, 256), hard))
        files = []
        with suppress(OSError):
            while True:
                files.append(os.open(os.devnull, os.O_RDONLY))
        await anyio.sleep(seconds)
        for file in files:
            os.close(file)

    async def do_stamp(self, authority: str, messages: int, rate: float) -> None:
        """Publish single samples, each with the time of the machine's steady clock as its stamp."""
        began = time.monotonic()
        for number in range(messages):
            self.bus.publish([as_sample("map", authority, time.monotonic_ns(), authority=authority)])
            await anyio.sleep(max(0.0, began + (number + 1) / rate - time.monotonic()))

    async def do_delays(self, authority: str, messages: int) -> dict[str, Any]:
        """Measure how many ns after their stamps samples are published here."""
        delays: list[int] = []

        def note(batch: Batch) -> None:
            now = time.monotonic_ns()
            delays.extend(now - sample.stamp for sample in batch if sample.authority == authority)
            self._changed.set()

        with self.bus.subscribe(note):
            tell(event="noting")
            await self._until(lambda: len(delays) >= messages)
        return {"delays": delays}

    async def do_facts(self) -> dict[str, Any]:
        """All counters."""
        statistics = self.bus.statistics()
        with open("/proc/self/statm", encoding="ascii") as file:  # noqa: ASYNC230, PTH123
            pages = int(file.read().split()[1])
        return {
            "tallies": {authority: vars(tally) for authority, tally in self.tallies.items()},
            "links": [asdict(link.statistics()) for link in self.links],
            "ids": [link.id for link in self.links],
            "bus": {"samples": statistics.samples, "rejected": statistics.rejected, "frames": statistics.frames},
            "static": sorted(self.static),
            "moving": sorted(self.moving),
            "x": self.x,
            "longest_pause": self.longest_pause,
            "megabytes": pages * 4096 / 1e6,
            "cpu": time.process_time(),
        }


def as_sample(
    parent: str, child: str, stamp: int, x: float = 0.0, authority: str = "", static: bool = False
) -> TransformStamped:
    return TransformStamped(parent, child, stamp, Transform((x, 0.0, 0.0)), authority, static)


def link_of(bus: Bus, options: dict[str, Any]) -> DomainLink:
    if not {"connect", "listen"} & options.keys():
        return LocalLink(bus, **options)
    from tfbus.links.zenoh import ZenohLink

    return ZenohLink(bus, **options)


async def main(links: list[dict[str, Any]], keeps: bool) -> None:
    with Bus(SystemClock()) as bus:
        async with AsyncExitStack() as stack:
            program = Program(bus, [link_of(bus, options) for options in links], keeps)
            tasks = await stack.enter_async_context(anyio.create_task_group())
            tasks.start_soon(program.tell_events)
            tasks.start_soon(program.watch_pauses)
            tell(event="joining")
            for link in program.links:
                await stack.enter_async_context(link)
            tell(event="ready", ids=[link.id for link in program.links])
            async for line in anyio.wrap_file(sys.stdin):
                tasks.start_soon(program.do, json.loads(line))
            tasks.cancel_scope.cancel()
        tell(event="ended")


if __name__ == "__main__":
    arguments = json.loads(sys.argv[1])
    backend, _, loop = arguments["backend"].partition("+")
    keeps = arguments.get("keeps", False)
    anyio.run(main, arguments["links"], keeps, backend=backend, backend_options={"use_uvloop": True} if loop else {})

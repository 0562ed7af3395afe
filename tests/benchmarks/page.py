"""The load of the live page, and how fast a change reaches a browser: ``python tests/benchmarks/page.py``.

Phases without and with a viewer alternate in one process, so that the difference of their CPU times is the page's own.
The viewer is another process; it receives what a browser receives, and draws nothing.
"""

import os
import statistics
import sys
import time
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path

import anyio
from anyio.abc import ByteReceiveStream, Process
from support.pr2 import BAG, URDF

from tfbus import SECOND, Buffer, Bus, Transform, TransformStamped
from tfbus.recording import open_recording
from tfbus.view import View

VIEWER = Path(__file__).with_name("page_viewer.py")
PHASE = 8.0
"""s."""
ROUNDS = 3

Batches = Callable[[int], Sequence[TransformStamped]]


def pr2() -> Batches:
    """The PR2's moving frames, with new stamps; the first batch has the static ones too."""
    with open_recording(BAG) as recording:
        messages = [message.batch for message in recording.messages()]
    static = [sample for batch in messages for sample in batch if sample.static]
    moving = [batch for batch in messages if len(batch) > 30 and not batch[0].static]
    state = {"count": 0}

    def next_batch(now: int) -> Sequence[TransformStamped]:
        number = state["count"]
        state["count"] += 1
        new = moving[number % len(moving)]
        restamped = [TransformStamped(s.parent, s.child, now, s.transform, s.authority) for s in new]
        return restamped if number else [*static, *restamped]

    return next_batch


def crowd(count: int, depth: int = 10) -> Batches:
    """Frames in chains; all move with each batch, and x of each counts the batches in mm."""
    state = {"count": 0}

    def next_batch(now: int) -> Sequence[TransformStamped]:
        state["count"] += 1
        pose = Transform((state["count"] / 1_000, 0.1, 0.2))
        return [
            TransformStamped("map" if i % depth == 0 else f"f{i - 1}", f"f{i}", now, pose, "crowd")
            for i in range(count)
        ]

    return next_batch


@asynccontextmanager
async def viewer_of(view: View) -> AsyncIterator[Process]:
    """A viewer of a page, in another process."""
    command = [sys.executable, str(VIEWER), view.address.rpartition(":")[2]]
    async with await anyio.open_process(command, stderr=None) as viewer:
        while not view.viewers:  # noqa: ASYNC110 - the page has no event for it
            await anyio.sleep(0.05)
        # It gets the whole page first.
        await anyio.sleep(2.0)
        yield viewer
        viewer.kill()


async def drain(output: ByteReceiveStream) -> None:
    """Read what nobody needs, so that the pipe does not fill."""
    async for _ in output:
        pass


async def load(name: str, batches: Batches, rate: float, urdf: Path | None) -> None:
    """Print the share of a core that the page takes, with and without a viewer."""
    bus = Bus()
    with Buffer(bus) as buffer:
        shares: dict[str, list[float]] = {"no page": [], "nobody looks": [], "watched": []}

        async def phase() -> float:
            cpu, since = time.process_time(), time.monotonic()
            async for _ in bus.clock.ticks(rate):
                if time.monotonic() - since >= PHASE:
                    break
                bus.publish(batches(bus.clock.now()))
            return (time.process_time() - cpu) / (time.monotonic() - since) * 100.0

        for _ in range(ROUNDS):
            shares["no page"].append(await phase())
            async with View(bus, buffer, 0, rate=rate, urdf=urdf) as view:
                shares["nobody looks"].append(await phase())
                async with viewer_of(view) as viewer:
                    assert viewer.stdout is not None
                    async with anyio.create_task_group() as tasks:
                        tasks.start_soon(drain, viewer.stdout)
                        shares["watched"].append(await phase())
                        tasks.cancel_scope.cancel()
        medians = {kind: statistics.median(found) for kind, found in shares.items()}
        print(name, {kind: [round(share, 1) for share in found] for kind, found in shares.items()})
        print(f"  page nobody looks at: {medians['nobody looks'] - medians['no page']:+.1f} % of a core")
        print(f"  page that is watched: {medians['watched'] - medians['no page']:+.1f} % of a core", flush=True)


async def latency(count: int) -> None:
    """Print the time from a publish to the arrival of the change, of one frame among so many."""
    bus = Bus()
    batches = crowd(count)
    delays: list[float] = []
    with Buffer(bus) as buffer:
        bus.publish(batches(bus.clock.now()))
        async with View(bus, buffer, 0) as view, AsyncExitStack() as stack:
            viewer = await stack.enter_async_context(viewer_of(view))
            sent: list[int] = []
            received: list[int] = []

            async def read() -> None:
                text = b""
                assert viewer.stdout is not None
                async for part in viewer.stdout:
                    text += part
                    while b"\n" in text:
                        line, _, text = text.partition(b"\n")
                        received.append(int(line.split()[0]))

            async with anyio.create_task_group() as tasks:
                tasks.start_soon(read)
                for number in range(60):
                    # Not in step with the page.
                    await anyio.sleep(0.2 + 0.013 * (number % 7))
                    sent.append(time.monotonic_ns())
                    bus.publish(batches(bus.clock.now()))
                await anyio.sleep(0.5)
                tasks.cancel_scope.cancel()
    for time_sent in sent:
        after = [arrived for arrived in received if arrived > time_sent]
        if after:
            delays.append((after[0] - time_sent) / SECOND * 1_000.0)
    delays.sort()
    print(
        f"a change reaches the viewer after {statistics.median(delays):.1f} ms in the median, "
        f"{delays[int(0.9 * len(delays))]:.1f} ms in nine of ten cases ({len(delays)} changes, {count} frames)",
        flush=True,
    )


def main() -> None:
    print(f"load of the machine: {os.getloadavg()[0]:.1f}", flush=True)
    anyio.run(latency, 80)
    if BAG.is_file():
        anyio.run(load, "PR2, 83 frames, 56 visuals, 20 Hz", pr2(), 20.0, URDF)
    anyio.run(load, "1,000 frames, 10 Hz", crowd(1_000), 10.0, None)
    print(f"load of the machine: {os.getloadavg()[0]:.1f}")


if __name__ == "__main__":
    main()

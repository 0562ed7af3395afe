"""A bus is recorded: in order, within bounds, and whole whatever happens."""

import os
import random
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from io import BytesIO
from itertools import count
from pathlib import Path

import anyio
import anyio.from_thread
import anyio.to_thread
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from support.asking import Asked, settle
from support.samples import any_samples, moving, static

from tfbus import (
    SECOND,
    Bus,
    BusClosedError,
    QueueStatistics,
    RecorderStatistics,
    RecordingDropped,
    RecordingFailed,
    SimulatedClock,
    Transform,
    TransformStamped,
)
from tfbus.recording.recorder import Recorder, WriteQueue
from tfbus.recording.recording import open_recording

pytestmark = pytest.mark.anyio

PATIENCE = 60.0
"""Real seconds after which a test that hangs is given up."""


def recorded(path: Path) -> list[tuple[int, tuple[TransformStamped, ...]]]:
    """The times and batches in a file in which nothing is wrong."""
    with open_recording(path) as recording:
        messages = list(recording.messages())
        assert recording.finished
    assert all(not message.errors for message in messages)
    return [(message.received, message.batch) for message in messages]


def noise(count: int, child: str = "base") -> list[TransformStamped]:
    """Samples that no compression makes smaller than about 50 bytes."""
    numbers = random.Random(count)
    return [
        TransformStamped("map", child, stamp, Transform((numbers.random(), numbers.random(), numbers.random())))
        for stamp in range(count)
    ]


def offered(statistics: RecorderStatistics) -> int:
    queue = statistics.queue
    return statistics.samples + sum(statistics.refused.values()) + queue.pending + queue.dropped + queue.conflated


async def until(true: Callable[[], bool]) -> None:
    """Wait for what a thread does: there is no event to wait for."""
    with anyio.fail_after(PATIENCE):
        while not true():  # noqa: ASYNC110
            await anyio.sleep(0.001)


class Pipe:
    """A named pipe as the disk: nothing goes on when it is full, and it fails when nobody reads any more."""

    def __init__(self, path: Path) -> None:
        os.mkfifo(path)
        self.path = path
        self.data = b""
        self._reading = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        self._thread = threading.Thread(target=self._drain)

    def drain(self) -> None:
        """Take what comes from now on, until the writer closes it."""
        os.set_blocking(self._reading, True)
        self._thread.start()

    def _drain(self) -> None:
        while piece := os.read(self._reading, 65_536):
            self.data += piece

    def break_off(self) -> None:
        os.close(self._reading)
        self._reading = -1

    def close(self) -> None:
        if self._thread.ident is not None:
            self._thread.join(PATIENCE)
        if self._reading >= 0:
            self.break_off()

    def messages(self) -> int:
        self._thread.join(PATIENCE)
        return sum(1 for _ in make_reader(BytesIO(self.data)).iter_messages())


@pytest.fixture
def pipe(tmp_path: Path) -> Iterator[Pipe]:
    with closing(Pipe(tmp_path / "pipe.mcap")) as pipe:
        yield pipe


async def test_latched_samples_come_before_published_ones(path: Path) -> None:
    clock = SimulatedClock(7 * SECOND)
    with Bus(clock) as bus:
        bus.publish(
            [static("map", "a", authority="survey"), moving("a", "b", 1), static("map", "c", authority="survey")]
        )
        async with Recorder(bus, path):
            clock.set(8 * SECOND)
            bus.publish(moving("a", "b", 2, authority="odometry"))
            clock.set(9 * SECOND)
            bus.publish([moving("a", "b", 3, authority="odometry"), static("b", "d", authority="survey")])
        bus.publish(moving("a", "b", 4))
    latched = (static("map", "a", authority="survey"), static("map", "c", authority="survey"))
    assert recorded(path) == [
        (7 * SECOND, latched),
        (8 * SECOND, (moving("a", "b", 2, authority="odometry"),)),
        (9 * SECOND, (static("b", "d", authority="survey"),)),
        (9 * SECOND, (moving("a", "b", 3, authority="odometry"),)),
    ]


async def test_what_is_flushed_can_be_read_while_the_recording_goes_on(bus: Bus, path: Path) -> None:
    async with Recorder(bus, path) as recorder:
        for number in range(1, 4):
            bus.publish(moving("map", "a", number))
            await recorder.flush()
            # Nothing is pending, so there is nothing to wait for.
            await recorder.flush()
            assert (recorder.statistics().samples, recorder.statistics().queue.pending) == (number, 0)
            with open_recording(path) as recording:
                *messages, unfinished = recording.messages()
                assert len(messages) == number
                assert [error.reason for error in unfinished.errors] == ["unfinished"]
                assert not recording.finished
    await recorder.flush()


async def test_a_flush_does_not_wait_for_what_comes_meanwhile(path: Path) -> None:
    published: list[int] = []

    async def publish_without_end(bus: Bus) -> None:
        for number in count():
            bus.publish(moving("map", "a", number))
            published.append(number)
            await anyio.lowlevel.checkpoint()

    with Bus(SimulatedClock()) as bus, anyio.fail_after(PATIENCE):
        async with Recorder(bus, path) as recorder, anyio.create_task_group() as tasks:
            tasks.start_soon(publish_without_end, bus)
            while len(published) < 100:
                await anyio.lowlevel.checkpoint()
            before = len(published)
            await recorder.flush()
            tasks.cancel_scope.cancel()
            assert recorder.statistics().samples >= before


async def test_what_a_message_cannot_hold_is_counted_and_not_pending(bus: Bus, path: Path) -> None:
    async with Recorder(bus, path) as recorder:
        # A stamp of ROS has 31 bits for the seconds.
        bus.publish([moving("map", "a", 2**31 * SECOND), moving("map", "b", 2**31 * SECOND - 1)])
        await recorder.flush()
        statistics = recorder.statistics()
    assert (statistics.samples, statistics.messages, sum(statistics.refused.values())) == (1, 1, 1)
    assert (statistics.queue.pending, offered(statistics)) == (0, 2)


async def test_several_tasks_may_wait_for_a_flush(bus: Bus, path: Path) -> None:
    async with Recorder(bus, path) as recorder, anyio.create_task_group() as tasks:
        bus.publish(moving("map", "a", 1))
        asked = [Asked(tasks, recorder.flush) for _ in range(3)]
        await until(lambda: all(each.ended for each in asked))
        assert recorder.statistics().samples == 1


async def test_a_few_samples_are_written_soon_without_a_flush(bus: Bus, path: Path) -> None:
    async with Recorder(bus, path) as recorder:
        # The second one comes when a chunk has just ended, and nothing comes behind it.
        for number in (1, 2):
            bus.publish(moving("map", "a", number))
            assert recorder.statistics().queue.pending == 1
            await until(lambda number=number: recorder.statistics().samples == number)  # type: ignore[misc]


async def test_a_chunk_ends_every_half_second_and_not_with_each_write(bus: Bus, path: Path) -> None:
    begin = anyio.current_time()
    async with Recorder(bus, path):
        for number in range(40):
            bus.publish(moving("map", "a", number))
            await anyio.sleep(0.01)
    elapsed = anyio.current_time() - begin
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    # The first write ends one, and so does the end; there is a write every 50 ms.
    assert len(summary.chunk_indexes) <= 2 + elapsed / 0.5


async def test_each_time_that_dropping_begins_there_is_one_event(path: Path) -> None:
    with Bus(SimulatedClock()) as bus, bus.events() as events:
        # Also if something is pending from the beginning on.
        bus.publish(static("map", "rig"))
        async with Recorder(bus, path, capacity=10) as recorder:
            for _ in range(2):
                for sample in noise(15):
                    bus.publish(sample)
                await recorder.flush()
                await settle()
        bus.close()
        told = [event async for event in events if isinstance(event, RecordingDropped)]
    assert [event.dropped for event in told] == [1, 6]
    assert recorder.statistics().queue.dropped == 10


async def test_a_disk_that_hangs_does_not_block_publishers(pipe: Pipe) -> None:
    with Bus(SimulatedClock()) as bus, bus.events() as events:
        async with Recorder(bus, pipe.path, capacity=100, overwrite=True) as recorder:
            for sample in noise(5_000):
                bus.publish(sample)
                if sample.stamp % 50 == 0:
                    await settle()
            await until(lambda: recorder.statistics().queue.dropped > 0)
            assert offered(recorder.statistics()) == 5_000
            assert recorder.error is None
            pipe.drain()
        statistics = recorder.statistics()
        bus.close()
        assert RecordingDropped in [type(event) async for event in events]
    assert offered(statistics) == 5_000
    assert statistics.samples == pipe.messages()


async def test_a_body_that_is_cancelled_in_the_middle_of_a_write_leaves_a_whole_file(bus: Bus, pipe: Pipe) -> None:
    recorders = []

    async def record(bus: Bus) -> None:
        async with Recorder(bus, pipe.path, overwrite=True) as recorder:
            recorders.append(recorder)
            for sample in noise(6_000):
                bus.publish(sample)
            await until(lambda: recorder.statistics().samples > 0)
            # Far from all, for nobody empties the pipe.
            assert recorder.statistics().queue.pending > 2_000
            tasks.cancel_scope.cancel()
            pipe.drain()
            await anyio.sleep_forever()

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(record, bus)
    # The recorder has left the bus.
    bus.publish(moving("map", "a", 1))
    (recorder,) = recorders
    assert offered(recorder.statistics()) == recorder.statistics().samples == 6_000
    assert pipe.messages() == 6_000


async def test_an_error_of_the_body_is_raised_as_it_is_and_the_file_is_whole(path: Path) -> None:
    with Bus(SimulatedClock()) as bus, pytest.raises(LookupError, match="the body's own"):
        async with Recorder(bus, path):
            bus.publish(moving("map", "a", 1))
            raise LookupError("the body's own")
    assert len(recorded(path)) == 1


async def test_a_disk_that_fails_causes_an_event_and_the_body_goes_on(
    pipe: Pipe, caplog: pytest.LogCaptureFixture
) -> None:
    with Bus(SimulatedClock(3 * SECOND)) as bus, bus.events() as events, anyio.fail_after(PATIENCE):
        async with Recorder(bus, pipe.path, overwrite=True) as recorder:
            pipe.break_off()
            # More than are passed to the disk at once.
            for sample in noise(5_000):
                bus.publish(sample)
            await recorder.flush()
            assert isinstance(recorder.error, BrokenPipeError)
            bus.publish(moving("map", "base", 10_000))
            await settle()
        await recorder.flush()
        bus.close()
        failures = [event async for event in events if isinstance(event, RecordingFailed)]
    assert failures == [RecordingFailed(3 * SECOND, str(pipe.path), recorder.error)]
    statistics = recorder.statistics()
    # Also the one that was published later.
    assert (statistics.samples, statistics.queue.pending, statistics.queue.dropped) == (0, 0, 5_001)
    assert ["has ended early, with 0 samples in it" in record.message for record in caplog.records] == [True]


def remove(path: Path) -> None:
    path.unlink()


def replace(path: Path) -> None:
    path.with_name("other").write_bytes(b"other")
    path.with_name("other").replace(path)


def cut(path: Path) -> None:
    os.truncate(path, path.stat().st_size - 1)


@pytest.mark.parametrize(
    ("harm", "why"),
    [(remove, "removed or replaced the file"), (replace, "removed or replaced the file"), (cut, "cut the file")],
)
@pytest.mark.parametrize("more", [True, False])
async def test_a_file_that_is_removed_replaced_or_cut_meanwhile_ends_the_recording(
    path: Path, harm: Callable[[Path], None], why: str, more: bool
) -> None:
    with Bus(SimulatedClock()) as bus, bus.events() as events:
        async with Recorder(bus, path) as recorder:
            bus.publish(moving("map", "a", 1))
            await recorder.flush()
            await anyio.to_thread.run_sync(harm, path)
            if more:
                for stamp in (2, 3):
                    bus.publish(moving("map", "a", stamp))
                    await recorder.flush()
        bus.close()
        (failed,) = [event async for event in events if isinstance(event, RecordingFailed)]
    assert failed.error is recorder.error
    assert why in str(recorder.error)
    statistics = recorder.statistics()
    assert (statistics.samples, statistics.messages, statistics.queue.dropped) == (0, 0, 3 if more else 1)


@pytest.mark.parametrize("move", [True, False])
async def test_a_file_that_is_moved_is_finished_and_told_and_another_working_directory_is_no_harm(
    bus: Bus, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, move: bool
) -> None:
    monkeypatch.chdir(tmp_path)
    path, moved = tmp_path / "run.mcap", tmp_path / "moved.mcap"
    async with Recorder(bus, "run.mcap") as recorder:
        bus.publish(moving("map", "a", 1))
        await recorder.flush()
        if move:
            await anyio.to_thread.run_sync(path.replace, moved)
        else:
            monkeypatch.chdir("/")
        bus.publish(moving("map", "a", 2))
    assert ("somebody moved the file" in str(recorder.error)) == move
    assert recorder.statistics().samples == len(recorded(moved if move else path)) == 2


async def test_a_disk_that_fails_at_the_end_causes_an_event_and_raises_nothing(pipe: Pipe) -> None:
    with Bus(SimulatedClock()) as bus, bus.events() as events:
        async with Recorder(bus, pipe.path, overwrite=True) as recorder:
            await recorder.flush()
            pipe.break_off()
        bus.close()
        assert [type(event) async for event in events] == [RecordingFailed]
    assert isinstance(recorder.error, BrokenPipeError)


KILLED = """
import sys, anyio
from tfbus import Bus, TransformBroadcaster, Transform
from tfbus.recording.recorder import Recorder

async def main():
    with Bus() as bus:
        broadcaster = TransformBroadcaster(bus, authority="odometry")
        async with Recorder(bus, sys.argv[1]) as recorder:
            for stamp in range(1_000_000):
                broadcaster.send("map", "base", Transform((1 / (stamp + 1), 0.0, 0.0)), at=stamp)
                if stamp == 100 or stamp % 2_000 == 0:
                    # The disk gets it in its own time: a flush would hurry it.
                    while recorder.statistics().samples <= stamp:
                        await anyio.sleep(0.01)
                    print(recorder.statistics().samples, flush=True)
                elif stamp % 10 == 0:
                    await anyio.sleep(0.001)

anyio.run(main, backend=sys.argv[2])
"""


@pytest.mark.thorough
@pytest.mark.parametrize("backend", ["asyncio", "trio"])
@pytest.mark.parametrize("lines", [1, 3])
def test_all_samples_but_the_last_ones_can_be_read_after_sigkill(path: Path, backend: str, lines: int) -> None:
    command = [sys.executable, "-P", "-c", KILLED, str(path), backend]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        written = [int(process.stdout.readline()) for _ in range(lines)]
        process.kill()
        written += map(int, process.stdout.read().split())
        assert process.wait(PATIENCE) == -9
    with open_recording(path) as recording:
        assert not recording.finished
        samples = [sample for message in recording.messages() for sample in message.batch]
    assert len(samples) >= written[-1] >= 1
    assert samples == [
        TransformStamped("map", "base", stamp, Transform((1 / (stamp + 1), 0.0, 0.0)), "odometry")
        for stamp in range(len(samples))
    ]


async def test_an_existing_file_is_kept(bus: Bus, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_text("precious")
    recorder = Recorder(bus, path)
    with pytest.raises(FileExistsError):
        await recorder.__aenter__()
    bus.publish(moving("map", "a", 1))
    assert offered(recorder.statistics()) == 0
    assert path.read_text() == "precious"
    async with Recorder(bus, path, overwrite=True):
        bus.publish(moving("map", "a", 2))
    assert len(recorded(path)) == 1


async def test_a_recorder_that_cannot_start_raises(bus: Bus, tmp_path: Path, path: Path) -> None:
    full = tmp_path / "full.mcap"
    full.symlink_to("/dev/full")
    with pytest.raises(FileNotFoundError):
        async with Recorder(bus, tmp_path / "nowhere" / "run.mcap"):
            raise AssertionError("not reached")
    with pytest.raises(OSError, match="No space"):
        async with Recorder(bus, full, overwrite=True):
            raise AssertionError("not reached")
    bus.close()
    with pytest.raises(BusClosedError):
        async with Recorder(bus, path):
            raise AssertionError("not reached")
    assert not (tmp_path / "run.mcap").exists()


async def test_a_recorder_cancelled_while_opening_its_file_leaves_nothing_behind(bus: Bus, tmp_path: Path) -> None:
    path = tmp_path / "pipe.mcap"
    os.mkfifo(path)
    recorder = Recorder(bus, path, overwrite=True)
    async with anyio.create_task_group() as tasks:
        asked = Asked(tasks, recorder.__aenter__)
        await settle()
        asked.cancel()
        await settle()
        # A pipe opens when there is a reader.
        assert not asked.ended
        data = await anyio.to_thread.run_sync(path.read_bytes)
    assert asked.cancelled
    bus.publish(moving("map", "a", 1))
    assert offered(recorder.statistics()) == 0
    assert list(make_reader(BytesIO(data)).iter_messages()) == []


async def test_a_recorder_is_entered_only_once_and_before_flush(bus: Bus, tmp_path: Path, path: Path) -> None:
    recorder = Recorder(bus, path)
    with pytest.raises(RuntimeError, match="enter the recorder first"):
        await recorder.flush()
    async with recorder:
        with pytest.raises(RuntimeError, match="entered once"):
            await recorder.__aenter__()
    with pytest.raises(ValueError, match="capacity"):
        Recorder(bus, tmp_path / "other.mcap", capacity=0)


async def test_a_bus_that_is_closed_in_the_body_ends_nothing_else(bus: Bus, path: Path) -> None:
    async with Recorder(bus, path):
        bus.publish(moving("map", "a", 1))
        bus.close()
    assert len(recorded(path)) == 1


async def test_after_a_jump_back_of_the_clock_the_times_in_the_file_go_back_too(path: Path) -> None:
    clock = SimulatedClock(9 * SECOND)
    with Bus(clock) as bus:
        async with Recorder(bus, path) as recorder:
            bus.publish(moving("map", "a", 1))
            clock.set(5 * SECOND)
            bus.publish(moving("map", "a", 2))
        assert recorder.statistics().samples == 2
    with path.open("rb") as file:
        times = [message.log_time for _, _, message in make_reader(file).iter_messages(log_time_order=False)]
    assert times == [9 * SECOND, 5 * SECOND]


def test_a_recorder_that_has_not_begun_has_a_name_and_counts_nothing(tmp_path: Path, path: Path) -> None:
    recorder = Recorder(Bus(), path, capacity=7)
    assert repr(recorder) == f"<Recorder of {str(tmp_path / 'run.mcap')!r}: 0 samples>"
    queue = QueueStatistics("recording", "drop_oldest", 7, 0, 0)
    assert recorder.statistics() == RecorderStatistics(0, 0, 0, {}, queue)


steps = st.lists(st.lists(any_samples("abc", 3), min_size=1, max_size=5) | st.integers(1, 8), max_size=40)


def count_moving(samples: list[TransformStamped]) -> int:
    return sum(not sample.static for sample in samples)


@given(steps, st.integers(1, 6))
def test_every_sample_is_read_or_counted_and_the_newest_static_ones_are_read(
    steps: list[list[TransformStamped] | int], capacity: int
) -> None:
    queue = WriteQueue(capacity)
    put: list[TransformStamped] = []
    read: list[tuple[int, TransformStamped]] = []
    for now, step in enumerate(steps):
        if isinstance(step, int):
            batches = queue.get_slice(step)
            # A single batch may be larger, and so may the kept static samples.
            assert len(batches) == 1 or sum(len(batch) for _, batch in batches) <= max(step, len("abc"))
            read += [(published, sample) for published, batch in batches for sample in batch]
        else:
            queue.put(tuple(step), now)
            put += step
        # Batches are bounded as well as samples, each has up to five, and a static sample of each child is kept.
        assert len(queue) <= 5 * capacity + len("abc")
    # Within the capacity, except for a single batch that is larger.
    assert count_moving(put) - queue.dropped - count_moving([sample for _, sample in read]) <= max(capacity, 5)
    while batches := queue.get_slice(3):
        read += [(published, sample) for published, batch in batches for sample in batch]
    assert len(put) == len(read) + queue.dropped + queue.conflated
    assert queue.dropped <= count_moving(put)
    times = [published for published, _ in read]
    assert times == sorted(times)
    newest = {sample.child: sample for sample in put if sample.static}
    assert {sample.child: sample for _, sample in read if sample.static} == newest

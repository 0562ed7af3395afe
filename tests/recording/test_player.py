"""A recording is played into a bus in time, steered, looped and cancelled."""

import asyncio
import math
import sys
import threading
from collections.abc import Awaitable, Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from typing import Any

import anyio
import anyio.lowlevel
import anyio.to_thread
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.asking import Asked, settle
from support.processes import is_open
from support.recorded import SMALL, WRONG_IN_SMALL, batches_in, write_mcap, write_recording
from support.samples import moving, static
from trio.testing import MockClock

from tfbus import (
    SECOND,
    Buffer,
    Bus,
    BusClosedError,
    ClockReset,
    ClockResetError,
    FrameRemoved,
    RecordingError,
    SimulatedClock,
    SystemClock,
)
from tfbus.bus.queues import TimedBatch
from tfbus.geometry.stamped import Batch
from tfbus.recording import Player, RecordedMessage, Recorder
from tfbus.recording.player import ReadAhead
from tfbus.stamps import STAMP_MAX

pytestmark = pytest.mark.anyio

Run = Callable[[Callable[[], Awaitable[None]]], None]

PATIENCE = 60.0
"""Real seconds after which a test that hangs is given up."""

AS_FAST_AS_POSSIBLE = math.inf
START = 1_700_000_000 * SECOND


def drive(seconds: Iterable[float], authority: str = "odometry") -> list[TimedBatch]:
    """A child that is at t m at t s, recorded as it was sent."""
    stamps = [START + round(time * SECOND) for time in seconds]
    return [(stamp, (moving("map", "base", stamp, (stamp - START) / SECOND, authority),)) for stamp in stamps]


def x_at(buffer: Buffer, seconds: float) -> float:
    return buffer.lookup_nowait("map", "base", START + round(seconds * SECOND)).transform.translation[0]


ABOUT_TO_OPEN: dict[str, Callable[[], object]] = {}


@cache
def hear_of_opened_files() -> None:
    """Call what is in `ABOUT_TO_OPEN` for a file; once, because no interface removes an audit hook, and each costs."""

    def hear(event: str, arguments: tuple[object, ...]) -> None:
        if ABOUT_TO_OPEN and event == "open" and (call := ABOUT_TO_OPEN.get(str(arguments[0]))):
            call()

    sys.addaudithook(hear)


@contextmanager
def before_opening(path: Path, call: Callable[[], object]) -> Iterator[None]:
    """Call a function in each thread that is about to open a file."""
    hear_of_opened_files()
    ABOUT_TO_OPEN[str(path)] = call
    try:
        yield
    finally:
        del ABOUT_TO_OPEN[str(path)]


class Listener:
    """Collects the batches of a bus, with the clock's time."""

    def __init__(self, bus: Bus, patience: float = PATIENCE) -> None:
        self.entries: list[TimedBatch] = []
        self._patience = patience
        self._bus = bus
        self._registration = bus.subscribe(self._hear)
        self.arrived = anyio.Event()

    def _hear(self, batch: Batch) -> None:
        self.entries.append((self._bus.clock.now(), batch))
        self.arrived.set()

    @property
    def batches(self) -> list[Batch]:
        return [batch for _, batch in self.entries]

    async def until(self, count: int) -> None:
        with anyio.fail_after(self._patience):
            while len(self.entries) < count:
                self.arrived = anyio.Event()
                await self.arrived.wait()


async def played(path: Path, clock: SimulatedClock | None = None, **options: Any) -> tuple[Player, Listener]:
    """Play a recording as fast as possible, and listen."""
    with Bus(clock) as bus:
        heard, player = Listener(bus), Player(bus, path, rate=AS_FAST_AS_POSSIBLE, **options)
        await player.play()
    return player, heard


async def test_samples_are_published_as_they_were_recorded(tmp_path: Path) -> None:
    batches: list[Batch] = [
        (static("map", "rig", authority="survey"),),
        (moving("map", "base", 7, 1.0, "odometry"), moving("base", "arm", 9, 2.0, "arm")),
        (moving("map", "base", 8, 1.5),),
    ]
    path = write_recording(tmp_path / "run.mcap", *((START + k, batch) for k, batch in enumerate(batches)))
    with Bus() as bus:
        heard = Listener(bus)
        player = Player(bus, path, rate=AS_FAST_AS_POSSIBLE)
        assert (player.start, player.end, player.position) == (None, None, None)
        await player.play()
    assert heard.batches == batches
    assert (player.start, player.end, player.position) == (START, START + 2, START + 2)
    assert (player.played, player.messages, player.passes, player.bad) == (4, 3, 1, {})


async def test_an_offset_moves_the_stamps_of_moving_samples(bus: Bus, tmp_path: Path) -> None:
    path = write_recording(tmp_path / "run.mcap", (START, (static("map", "rig"), moving("map", "base", 7, 1.0))))
    heard = Listener(bus)
    await Player(bus, path, rate=AS_FAST_AS_POSSIBLE, offset=1e-8).play()
    assert heard.batches == [(static("map", "rig"),), (moving("map", "base", 17, 1.0),)]


async def test_a_task_that_a_message_wakes_sees_all_messages_of_that_log_time(tmp_path: Path) -> None:
    frames = ["base", *(f"f{number}" for number in range(9))]
    lines = [(received, "/tf", [moving("map", frame, received)]) for received in (5, 7) for frame in frames]
    path = write_mcap(tmp_path / "run.mcap", lines)
    with Bus(SimulatedClock()) as bus, Buffer(bus) as buffer:

        async def look() -> tuple[int, int]:
            await buffer.lookup("map", "base", 5)
            return bus.clock.now(), buffer.lookup_nowait("map", "f8").stamp

        async with anyio.create_task_group() as tasks:
            asked = Asked(tasks, look)
            await Player(bus, path, rate=1.0).play()
        assert asked.answer == (5, 5)


async def test_messages_out_of_order_do_not_turn_the_clock_back(bus: Bus, tmp_path: Path) -> None:
    lines = [(received, "/tf", [moving("map", "base", received)]) for received in (5, 3, 9)]
    path = write_mcap(tmp_path / "run.mcap", lines, finish=False)
    heard = Listener(bus)
    await Player(bus, path, rate=AS_FAST_AS_POSSIBLE).play()
    assert bus.statistics().clock_resets == 0
    assert [now for now, _ in heard.entries] == [5, 5, 9]


async def watch_positions(bus: Bus, buffer: Buffer, seen: list[float]) -> None:
    """A timed task: twice as often as there are samples, it looks where the base is."""
    async for _ in bus.clock.ticks(200.0):
        found = await buffer.lookup("map", "base")
        seen.append(found.transform.translation[0])


@pytest.mark.parametrize("runs", [2, pytest.param(6, marks=pytest.mark.thorough)])
@pytest.mark.parametrize("backend", ["asyncio", "trio"])
def test_timed_tasks_see_the_same_in_each_run(tmp_path: Path, backend: str, runs: int) -> None:
    # Several blocks, so that the reading thread is busy meanwhile.
    path = write_recording(tmp_path / "run.mcap", *drive(k / 100 for k in range(600)))

    async def observe() -> list[float]:
        seen: list[float] = []
        with Bus(SimulatedClock()) as bus, Buffer(bus) as buffer:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(watch_positions, bus, buffer, seen)
                await Player(bus, path, rate=AS_FAST_AS_POSSIBLE).play()
                tasks.cancel_scope.cancel()
        return seen

    # The first look waits for the first sample. From then on there is one half way to a sample and one just before it.
    found = [anyio.run(observe, backend=backend) for _ in range(runs)]
    assert found == [[0.0, *((look - 1) // 2 / 100 for look in range(1, 1_199))]] * runs


@pytest.mark.parametrize("simulated", [True, False])
async def test_looping_forgets_the_moving_samples_of_the_last_pass_and_keeps_the_static_ones(
    tmp_path: Path, simulated: bool
) -> None:
    # The buffer keeps ten seconds, so it would refuse the first sample behind those of the last pass.
    entries = drive((0.0, 18.0, 19.0, 20.0))
    path = write_recording(tmp_path / "run.mcap", (START, (static("base", "rig", 5.0),)), *entries)
    found: list[object] = []
    with (
        Bus(SimulatedClock() if simulated else None) as bus,
        Buffer(bus) as buffer,
        bus.events(stale_after=None) as events,
    ):

        def ask(batch: Batch) -> None:
            if batch == entries[0][1]:
                found.append(buffer.can_transform("map", "rig", START))
                found.append(buffer.can_transform("map", "base", START + 20 * SECOND))
            if batch == entries[3][1]:
                found.append(x_at(buffer, 19.5))
                if player.passes == 2:
                    scope.cancel()

        bus.subscribe(ask)
        player = Player(bus, path, rate=AS_FAST_AS_POSSIBLE, loop=True)
        with anyio.CancelScope() as scope, anyio.fail_after(PATIENCE):
            await player.play()
        expired = sum(each.expired for each in bus.statistics().buffers)
        bus.close()
        told = [event async for event in events]
    assert found == [True, False, 19.5] * 3
    assert expired == 0
    resets = [(event.before, event.stamp) for event in told if isinstance(event, ClockReset)]
    removed = [event.frame for event in told if isinstance(event, FrameRemoved)]
    assert (resets, removed) == (([(START + 20 * SECOND, START)] * 2, []) if simulated else ([], ["base"] * 2))


async def test_a_task_that_waited_for_the_last_sample_runs_before_the_clock_jumps(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "run.mcap", *drive((0.0, 1.0)))
    with Bus(SimulatedClock(START)) as bus, Buffer(bus) as buffer, anyio.fail_after(PATIENCE):

        async def think_about_it() -> float:
            await buffer.lookup("map", "base", START + SECOND)
            for _ in range(200):
                await anyio.lowlevel.checkpoint()
            return x_at(buffer, 1.0)

        async with anyio.create_task_group() as playing:
            async with anyio.create_task_group() as asking:
                last = Asked(asking, think_about_it)
                never = Asked(asking, partial(buffer.lookup, "map", "base", START + 2 * SECOND))
                await settle()
                playing.start_soon(Player(bus, path, rate=AS_FAST_AS_POSSIBLE, loop=True).play)
            playing.cancel_scope.cancel()
    assert last.answer == 1.0
    assert isinstance(never.error, ClockResetError)


async def test_a_frame_that_another_sends_again_is_not_removed_with_those_that_were_played(tmp_path: Path) -> None:
    arm = (START + 2 * SECOND, (moving("map", "arm", START + 2 * SECOND),))
    path = write_recording(tmp_path / "run.mcap", *drive((0.0, 1.0)), arm)
    with Bus() as bus, bus.events(stale_after=None) as events:
        player = Player(bus, path, rate=AS_FAST_AS_POSSIBLE)
        heard: list[str] = []

        def begin_again(batch: Batch) -> None:
            heard.append(batch[0].child)
            if heard == ["base", "base", "arm", "base", "base"]:
                bus.publish(moving("map", "arm", 5, authority="another"))
            if heard[-1] == "arm" and len(heard) < 7:
                player.seek(START)

        bus.subscribe(begin_again)
        await player.play()
        bus.close()
        removed = [event.frame async for event in events if isinstance(event, FrameRemoved)]
    assert heard == ["base", "base", "arm"] + ["base", "base", "arm"] * 2
    assert removed == ["base", "arm", "base"]


async def test_a_frame_that_is_already_removed_is_no_error(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "run.mcap", *drive((0.0, 1.0)))
    with Bus() as bus:
        player = Player(bus, path, rate=AS_FAST_AS_POSSIBLE)
        await player.play()
        bus.remove_frame("base")
        await player.play()
    assert (player.played, player.passes) == (4, 2)


async def test_a_range_begins_with_the_static_transforms_from_before(tmp_path: Path) -> None:
    entries = drive(range(10))
    path = write_recording(
        tmp_path / "run.mcap",
        (START, (static("base", "rig", 1.0, authority="survey"), static("base", "mast"))),
        *entries[:4],
        (START + 3 * SECOND, (static("base", "rig", 2.0, authority="survey"),)),
        *entries[4:],
    )
    since, until = START + 5 * SECOND, START + 7 * SECOND
    for clock in (SimulatedClock(), None):
        player, heard = await played(path, clock, since=since, until=until)
        samples = [sample for batch in heard.batches for sample in batch]
        assert set(samples[:2]) == {static("base", "rig", 2.0, authority="survey"), static("base", "mast")}
        assert samples[2:] == [sample for _, (sample,) in entries[5:8]]
        assert (player.start, player.end, player.position) == (since, until, until)
        if clock is not None:
            assert {now for now, batch in heard.entries if batch[0].static} == {since}


@pytest.mark.parametrize("simulated", [True, False])
async def test_a_seek_begins_with_the_static_transforms_and_only_one_back_is_an_event(
    tmp_path: Path, simulated: bool
) -> None:
    rig, first, second, third = entries = [(START, (static("base", "rig"),)), *drive((0.0, 3_600.0, 7_200.0))]
    seeks = {2: second[0], 4: first[0], 6: third[0]}
    with Bus(SimulatedClock() if simulated else None) as bus, bus.events(stale_after=None) as events:
        heard = Listener(bus)
        player = Player(bus, write_recording(tmp_path / "run.mcap", *entries), rate=AS_FAST_AS_POSSIBLE)

        def jump(_: Batch) -> None:
            if len(heard.entries) in seeks:
                player.seek(seeks[len(heard.entries)])

        bus.subscribe(jump)
        await player.play()
        bus.close()
        told = [type(event) async for event in events if isinstance(event, (ClockReset, FrameRemoved))]
    assert told == [ClockReset if simulated else FrameRemoved]
    assert heard.batches == [entry[1] for entry in (rig, first, rig, second, rig, first, rig, third)]
    if simulated:
        assert [now for now, _ in heard.entries] == [
            START + hours * 3_600 * SECOND for hours in (0, 0, 1, 1, 0, 0, 2, 2)
        ]
    assert player.passes == 1


async def test_a_seek_behind_the_end_does_not_end_a_loop(bus: Bus, tmp_path: Path) -> None:
    path = write_recording(tmp_path / "run.mcap", *drive(range(5)))
    heard = Listener(bus)
    player = Player(bus, path, rate=AS_FAST_AS_POSSIBLE, loop=True)
    player.seek(START + 3_600 * SECOND)
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(player.play)
        await heard.until(10)
        tasks.cancel_scope.cancel()
    assert player.passes >= 2


async def test_a_loop_ends_where_there_is_nothing_to_play(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "run.mcap", *drive(range(5)))
    with Bus(SimulatedClock()) as bus, anyio.fail_after(PATIENCE):
        player = Player(bus, path, rate=AS_FAST_AS_POSSIBLE, loop=True, since=START + 3_600 * SECOND)
        player.seek(START + 7_200 * SECOND)
        await player.play()
    assert (player.played, player.passes, player.position) == (0, 2, None)


def times_in(
    path: Path,
    steer: Callable[[Player, Listener], Awaitable[None]] | None = None,
    *,
    simulated: bool = True,
    **options: Any,
) -> list[float]:
    """The times at which messages are heard, in s since the call of `play`; `steer` commands the player meanwhile."""
    times: list[float] = []

    async def play() -> None:
        # The clock of the loop is not at zero at the beginning.
        await anyio.sleep(1_000.0)
        begin = anyio.current_time()
        with Bus(SimulatedClock(START) if simulated else None) as bus:
            # Without a limit: the clock of the loop jumps to it while a thread reads.
            heard, player = Listener(bus, math.inf), Player(bus, path, **options)
            bus.subscribe(lambda _: times.append(anyio.current_time() - begin))
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(player.play)
                if steer is not None:
                    await steer(player, heard)

    # trio's own clock jumps to the next deadline whenever nothing runs.
    anyio.run(play, backend="trio", backend_options={"clock": MockClock(autojump_threshold=0)})
    return times


@pytest.mark.parametrize("simulated", [True, False])
@pytest.mark.parametrize(
    ("rate", "times"),
    [
        *((rate, (0.0, 0.5, 0.501, 9.0)) for rate in (1.0, 2.0, 0.25)),
        (1e-9, (0.0, 3e-9)),
        *((rate, (0.0, 1.0, 1_000_000.0)) for rate in (1e12, 1e300, AS_FAST_AS_POSSIBLE)),
    ],
)
def test_each_message_is_published_at_its_time(
    tmp_path: Path, simulated: bool, rate: float, times: tuple[float, ...]
) -> None:
    path = write_recording(tmp_path / "run.mcap", *drive(times))
    expected = [time / rate for time in times]
    assert times_in(path, simulated=simulated, rate=rate) == pytest.approx(expected, abs=2e-6)


@pytest.mark.parametrize("simulated", [True, False])
@pytest.mark.parametrize(("rate", "left"), [(None, 7.0), (5.0, 2.0 + (10.0 - 5.0) / 5.0)])
def test_a_pause_and_a_new_rate_count_from_their_moment(
    tmp_path: Path, simulated: bool, rate: float | None, left: float
) -> None:
    async def steer(player: Player, heard: Listener) -> None:
        await heard.until(1)
        await anyio.sleep(3.0)
        player.pause()
        await anyio.sleep(100.0)
        player.resume()
        if rate is not None:
            await anyio.sleep(2.0)
            player.rate = rate

    path = write_recording(tmp_path / "run.mcap", *drive((0.0, 10.0)))
    expected = [0.0, 3.0 + 100.0 + left]
    assert times_in(path, steer, simulated=simulated) == pytest.approx(expected, abs=1e-6)


def test_a_player_can_be_paused_and_go_on_before_any_event_loop_runs(tmp_path: Path) -> None:
    player = Player(Bus(), write_recording(tmp_path / "run.mcap", *drive((0.0, 10.0))))
    player.pause()
    player.resume()
    assert not player.paused


@pytest.mark.parametrize("simulated", [True, False])
@pytest.mark.parametrize(
    ("goes_on", "left"),
    # Another rate alone does not end the pause.
    [(Player.resume, 10.0), (Player.step, 0.0), (lambda player: setattr(player, "rate", 5.0), 1_000.0 + 10.0 / 5.0)],
    ids=["resume", "step", "rate"],
)
def test_a_paused_player_that_waits_is_woken_by_what_makes_it_go_on(
    tmp_path: Path, simulated: bool, goes_on: Callable[[Player], None], left: float
) -> None:
    async def steer(player: Player, heard: Listener) -> None:
        await heard.until(1)
        player.pause()
        await anyio.sleep(100.0)
        goes_on(player)
        with anyio.move_on_after(1_000.0):
            await heard.until(2)
        player.resume()

    path = write_recording(tmp_path / "run.mcap", *drive((0.0, 10.0)))
    assert times_in(path, steer, simulated=simulated) == pytest.approx([0.0, 100.0 + left], abs=1e-6)


def test_a_simulated_clock_advances_steadily_between_messages(tmp_path: Path) -> None:
    seen: list[float] = []

    async def tick(player: Player, _: Listener) -> None:
        async for number in player.bus.clock.ticks(50.0):
            assert player.bus.clock.now() == START + number * SECOND // 50
            seen.append(anyio.current_time())
            if number == 500:
                return

    assert times_in(write_recording(tmp_path / "run.mcap", *drive((0.0, 10.0))), tick, rate=4.0)[-1] == 2.5
    # A step is 20 ms.
    assert all(abs(number / 50.0 / 4.0 - (time - seen[0])) < 0.021 for number, time in enumerate(seen))


def test_a_range_begins_at_since_even_if_the_first_message_is_later(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "run.mcap", *drive((0.0, 10.0)))
    assert times_in(path, simulated=False, since=START + 4 * SECOND) == pytest.approx([6.0], abs=1e-6)


@pytest.mark.parametrize("finish", [True, False])
async def test_the_event_loop_does_not_read_the_file(tmp_path: Path, finish: bool) -> None:
    lines = [(received, "/tf", batch) for received, batch in drive((0.0, 0.5))]
    path = write_mcap(tmp_path / "run.mcap", lines, finish=finish)
    readers: set[int] = set()
    with Bus(SimulatedClock()) as bus, before_opening(path, lambda: readers.add(threading.get_ident())):
        await Player(bus, path, rate=AS_FAST_AS_POSSIBLE).play()
    assert readers
    assert threading.get_ident() not in readers


@pytest.mark.parametrize(
    ("chosen", "children"),
    [
        ({"prefix": "x/"}, ["x/base"]),
        ({"namespaces": True}, ["base", "r1/arm"]),
        ({"topics": ["/r1/tf"]}, ["arm"]),
    ],
)
async def test_the_topics_that_are_chosen_are_played(
    tmp_path: Path, chosen: dict[str, Any], children: list[str]
) -> None:
    lines = [(START, "/tf", [moving("map", "base", START)]), (START + 1, "/r1/tf", [moving("map", "arm", START)])]
    _, heard = await played(write_mcap(tmp_path / "run.mcap", lines), **chosen)
    assert [sample.child for batch in heard.batches for sample in batch] == children


async def test_problems_in_a_recording_are_counted_and_the_rest_is_played(bus: Bus) -> None:
    player = Player(bus, SMALL, rate=AS_FAST_AS_POSSIBLE)
    await player.play()
    statistics = bus.statistics()
    # The loop of parents only the bus can see.
    assert {**player.bad, **statistics.rejected} == WRONG_IN_SMALL
    assert player.played == statistics.samples + WRONG_IN_SMALL["cycle"]


async def test_a_played_recording_can_be_recorded_again(bus: Bus, tmp_path: Path) -> None:
    entries = [(START, (static("base", "rig", authority="survey"),)), *drive(k / 50 for k in range(500))]
    path, copy = write_recording(tmp_path / "run.mcap", *entries), tmp_path / "copy.mcap"
    async with Recorder(bus, copy):
        await Player(bus, path, rate=AS_FAST_AS_POSSIBLE).play()
    assert batches_in(copy) == batches_in(path)


def test_a_file_that_a_thread_opens_while_plain_asyncio_cancels_play_is_closed(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "run.mcap", *drive((0.0,)))
    go_on = threading.Event()

    async def main() -> None:
        loop, opening = asyncio.get_running_loop(), asyncio.Event()

        def hold_the_thread() -> None:
            loop.call_soon_threadsafe(opening.set)
            go_on.wait(PATIENCE)

        with Bus() as bus, before_opening(path, hold_the_thread):
            task = asyncio.create_task(Player(bus, path).play())
            await opening.wait()
            task.cancel()
            for _ in range(10):
                await asyncio.sleep(0)
            ended_early = task.done()
            go_on.set()
            with pytest.raises(asyncio.CancelledError):
                await task
            assert not ended_early
            assert not is_open(path)

    asyncio.run(main())


async def test_only_one_task_may_play(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "run.mcap", *drive((0.0, 3_600.0)))
    with Bus() as bus:
        heard = Listener(bus)
        player = Player(bus, path)
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(player.play)
            await heard.until(1)
            with pytest.raises(RuntimeError, match="played already"):
                await player.play()
            tasks.cancel_scope.cancel()


async def test_another_task_must_not_advance_the_simulated_clock(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "run.mcap", *drive((0.0, 1.0)))
    clock = SimulatedClock()
    with Bus(clock) as bus:
        async with anyio.create_task_group() as tasks:
            asked = Asked(tasks, Player(bus, path).play)
            with anyio.fail_after(PATIENCE):
                while not asked.ended:
                    await clock.advance(1.0)
    assert isinstance(asked.error, RuntimeError)
    assert "another task is advancing" in str(asked.error)


async def test_a_closed_bus_ends_play_with_bus_closed_error(tmp_path: Path) -> None:
    bus, path = Bus(), write_recording(tmp_path / "run.mcap", *drive(range(1_000)))
    bus.subscribe(lambda _: bus.close())
    player = Player(bus, path, rate=AS_FAST_AS_POSSIBLE)
    with pytest.raises(BusClosedError):
        await player.play()
    assert player.played == 1


async def test_an_invalid_file_raises_recording_error_each_time(tmp_path: Path) -> None:
    player = Player(Bus(), tmp_path / "run.mcap")
    for _ in range(2):
        with pytest.raises(RecordingError, match="no such file"):
            await player.play()


@pytest.mark.parametrize(
    ("options", "error", "why"),
    [
        *(({"rate": rate}, ValueError, "greater than zero") for rate in (0.0, -1.0, math.nan)),
        ({"rate": "2"}, TypeError, "must be a number"),
        ({"since": 1.5}, TypeError, "from_seconds"),
        ({"since": 5, "until": 4}, ValueError, "end before it begins"),
        ({"topics": ["/tf"], "namespaces": True}, ValueError, "."),
        ({"prefix": "/r1"}, ValueError, "."),
    ],
)
def test_wrong_options_are_refused_at_once(options: dict[str, Any], error: type[Exception], why: str) -> None:
    with Bus() as bus:
        with pytest.raises(error, match=why):
            Player(bus, "nowhere.mcap", **options)
        player = Player(bus, "nowhere.mcap")
        with pytest.raises(ValueError, match="greater than zero"):
            player.rate = 0.0
        with pytest.raises(TypeError, match="from_seconds"):
            player.seek(1.5)  # type: ignore[arg-type]


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(st.integers(0, 20), min_size=1, max_size=30).map(sorted),
    st.dictionaries(st.integers(1, 40), st.integers(0, 22), max_size=6),
)
def test_play_continues_where_seek_says_at_any_time(
    run: Run, tmp_path: Path, times: list[int], seeks: dict[int, int]
) -> None:
    """Against a model: a list, in which the n-th message that is heard makes it jump."""
    entries = drive(times)
    path = write_recording(tmp_path / "run.mcap", *entries)
    expected: list[TimedBatch] = []
    at = 0
    while at < len(entries):
        expected.append(entries[at])
        at += 1
        if len(expected) in seeks:
            at = sum(time < seeks[len(expected)] for time in times)

    async def play() -> None:
        with Bus(SimulatedClock()) as bus:
            heard = Listener(bus)
            player = Player(bus, path, rate=AS_FAST_AS_POSSIBLE)

            def jump(_: Batch) -> None:
                if len(heard.entries) in seeks:
                    player.seek(START + seeks[len(heard.entries)] * SECOND)

            bus.subscribe(jump)
            await player.play()
            assert heard.entries == expected

    run(play)


async def test_recorded_stamps_are_not_compared_with_the_clock(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "run.mcap", (1, (moving("map", "base", 2 * 10**18, 1.0),)))
    for clock in (SimulatedClock(5), SystemClock()):
        bus = Bus(clock, reject_ahead=True)
        await Player(bus, path, rate=math.inf).play()
        assert (bus.statistics().samples, bus.statistics().rejected) == (1, {})


async def test_a_step_may_go_to_the_last_stamp(bus: Bus, tmp_path: Path) -> None:
    path = write_mcap(
        tmp_path / "run.mcap",
        [(time, "/tf", [moving("map", "base", number)]) for number, time in enumerate((0, STAMP_MAX))],
    )
    player = Player(bus, path)
    for _ in range(2):
        player.step()
    await player.play()
    assert (player.position, player.played, bus.clock.now()) == (STAMP_MAX, 2, STAMP_MAX)


@pytest.mark.every_loop
@pytest.mark.parametrize("simulated", [True, False])
async def test_a_paused_player_steps_from_message_to_message(tmp_path: Path, simulated: bool) -> None:
    entries = drive([0, 100, 101, 200])
    path = write_recording(tmp_path / "run.mcap", *entries)
    with Bus(SimulatedClock() if simulated else None) as bus:
        heard, player = Listener(bus), Player(bus, path)
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(player.play)
            for steps, count in ((0, 1), (1, 2), (2, 4)):
                assert player.paused == (count > 1)
                for _ in range(steps):
                    player.step()
                    assert player.paused
                await heard.until(count)
                assert heard.batches == [batch for _, batch in entries[:count]]
                player.pause()
        assert player.position == START + 200 * SECOND
        if simulated:
            assert bus.clock.now() == START + 200 * SECOND


async def test_a_bounded_number_of_blocks_is_read_ahead_and_an_error_comes_behind_the_last_good_one() -> None:
    taken: list[int] = []

    def torn() -> Iterator[RecordedMessage]:
        for number in range(2_000):
            taken.append(number)
            yield RecordedMessage(number, (), ())
        raise OSError("the tape is torn")

    async with ReadAhead(torn(), 2) as blocks:
        found = [message.received for message in await anext(blocks)]
        size = len(found)
        with anyio.fail_after(PATIENCE):
            while len(taken) < 3 * size:  # noqa: ASYNC110
                await anyio.sleep(0.001)
        for _ in range(3):
            await settle()
        assert len(taken) == 3 * size < 2_000
        with pytest.raises(OSError, match="torn"):
            async for block in blocks:
                found += [message.received for message in block]
    assert found == list(range(2_000))

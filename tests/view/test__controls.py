import threading
from functools import partial

import anyio
import pytest
from anyio.lowlevel import checkpoint

from tfbus.view.server import CAPACITY, Controls

pytestmark = pytest.mark.anyio


@pytest.mark.every_loop
async def test_functions_of_another_thread_are_called_on_the_loop_in_their_order() -> None:
    done = anyio.Event()
    called: list[object] = []
    controls = Controls(lambda: called.append("drawn"))
    controls.bind()

    def note(number: int) -> None:
        called.append((number, threading.get_ident()))

    def use() -> None:
        for number in range(3):
            controls.put(partial(note, number))
        controls.put(done.set)

    thread = threading.Thread(target=use)
    thread.start()
    await done.wait()
    thread.join()
    await checkpoint()
    assert [call for call in called if call != "drawn"] == [(number, threading.get_ident()) for number in range(3)]
    assert called[-1] == "drawn"


async def test_the_oldest_are_dropped_and_counted_when_there_are_too_many() -> None:
    called: list[int] = []
    controls = Controls(lambda: None)
    controls.bind()
    for number in range(CAPACITY + 2):
        controls.put(partial(called.append, number))
    statistics = controls.statistics()
    assert (statistics.pending, statistics.dropped, statistics.overflow) == (1_000, 2, "drop_oldest")
    done = anyio.Event()
    controls.put(done.set)
    await done.wait()
    assert called == list(range(3, CAPACITY + 2))
    assert controls.statistics().pending == 0


@pytest.mark.every_loop
async def test_one_that_raises_is_logged_and_the_next_is_called(caplog: pytest.LogCaptureFixture) -> None:
    done = anyio.Event()
    controls = Controls(lambda: None)
    controls.bind()
    controls.put(lambda: 1 / 0)
    controls.put(done.set)
    with anyio.fail_after(30.0):
        await done.wait()
    assert [record.exc_info[0] for record in caplog.records if record.exc_info] == [ZeroDivisionError]


@pytest.mark.every_loop
async def test_a_turn_of_the_loop_calls_one_function() -> None:
    called: list[int] = []
    seen: list[int] = []
    done = anyio.Event()
    controls = Controls(lambda: None)
    controls.bind()
    for number in range(100):
        controls.put(partial(called.append, number))
    controls.put(done.set)
    while not done.is_set():
        seen.append(len(called))
        await checkpoint()
    # A checkpoint may take several turns, yet it never waits for the whole queue.
    assert len(set(seen)) > 20


async def test_after_the_end_nothing_is_called() -> None:
    called: list[int] = []
    controls = Controls(lambda: None)
    controls.bind()
    controls.put(lambda: called.append(1))
    controls.end()
    controls.put(lambda: called.append(2))
    await anyio.wait_all_tasks_blocked()
    assert called == []


def test_a_loop_that_has_ended_is_no_error_for_the_browser() -> None:
    controls = Controls(lambda: None)

    async def bind() -> None:
        controls.bind()

    anyio.run(bind)
    controls.put(lambda: None)
    controls.put(lambda: None)
    assert controls.statistics().pending == 0

import threading
from functools import partial

import anyio
import pytest
from anyio.lowlevel import checkpoint

from tfbus.view._controls import CAPACITY, Controls

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
    await anyio.wait_all_tasks_blocked()
    assert called == list(range(2, CAPACITY + 2))
    assert controls.statistics().pending == 0


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

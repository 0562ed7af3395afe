from threading import Event, Thread

import anyio
import pytest

from tfbus._aio.loops import join_all, wait_for_all

pytestmark = [pytest.mark.anyio, pytest.mark.every_loop]


async def test_threads_are_waited_for_until_they_end_or_the_time_is_over() -> None:
    may_end = Event()
    stuck, ended = Thread(target=may_end.wait), Thread(target=may_end.is_set)
    for thread in (stuck, ended):
        thread.start()
    assert not await wait_for_all([stuck, ended], 0.01)
    with anyio.CancelScope() as scope:
        # The end of a cancelled task waits too.
        scope.cancel()
        assert await wait_for_all([ended], 60.0)
    assert not scope.cancelled_caught
    join_all([stuck], 0.0)
    assert stuck.is_alive()
    may_end.set()
    assert await wait_for_all([stuck, ended], 60.0)
    assert await wait_for_all([], 0.0)

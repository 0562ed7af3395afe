from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import pytest

from tfbus.bus.bus import OwnerThread


def owner() -> OwnerThread:
    """That of a bus that is made here; only the thread of its intake is of interest."""
    return OwnerThread(SimpleNamespace(thread=0))


Run = Callable[[Callable[[], Awaitable[None]]], None]


def in_thread(call: Callable[[], object]) -> BaseException | None:
    """The error that a call raises in another thread."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(call).exception()


def test_without_a_loop_the_owner_is_the_thread_that_made_the_bus() -> None:
    claim = owner()
    claim.check()
    error = in_thread(claim.check)
    assert isinstance(error, RuntimeError)
    assert "bus.threadsafe" in str(error)
    claim.check()


def test_the_thread_of_the_first_loop_becomes_and_stays_the_owner(run: Run) -> None:
    claim = owner()

    async def use() -> None:
        claim.check()

    assert in_thread(lambda: run(use)) is None
    with pytest.raises(RuntimeError, match=r"bus\.threadsafe"):
        claim.check()


def test_a_loop_in_the_thread_that_made_the_bus_leaves_it_to_no_other_loop(run: Run) -> None:
    claim = owner()

    async def use() -> None:
        claim.check()

    run(use)
    assert isinstance(in_thread(lambda: run(use)), RuntimeError)
    claim.check()


def test_made_on_a_loop_the_owner_is_the_thread_of_that_loop(run: Run) -> None:
    claims: list[OwnerThread] = []

    async def make() -> None:
        claims.append(owner())

    assert in_thread(lambda: run(make)) is None
    with pytest.raises(RuntimeError, match=r"bus\.threadsafe"):
        claims[0].check()

"""Random schedules of everything that can happen on a bus and to its buffers, against the model in `support.oracle`.

Buffers join late, with and without prefill and prefix, and leave; samples come late or from the future, reparent frames
in the past, turn static, or would close a loop; frames are removed, the clock jumps, lookups wait and are cancelled.
"""

import logging
import os
from collections.abc import Awaitable, Callable

import pytest
from support.oracle.game import Game
from support.oracle.schedule import Burst, random_schedule, smaller

Run = Callable[[Callable[[], Awaitable[None]]], None]

SCHEDULES = int(os.environ.get("ORACLE_SCHEDULES", "10000"))
"""On each loop, in the thorough suite."""

PARTS = 20
"""Tests that share them, so that they can run in several processes."""


@pytest.fixture(autouse=True)
def quiet(monkeypatch: pytest.MonkeyPatch) -> None:
    """Log nothing, because formatting the lines takes a good part of the time."""
    monkeypatch.setattr(logging.getLogger("tfbus"), "disabled", True)


def failure_of(run: Run, bursts: list[Burst]) -> BaseException | None:
    async def play_here() -> None:
        await Game().play(bursts)

    try:
        run(play_here)
    except (Exception, pytest.fail.Exception) as failure:  # noqa: BLE001
        return failure
    return None


def play(run: Run, seeds: range) -> None:
    """Play a schedule for each seed; of one that fails, leave out all that it fails without."""
    for seed in seeds:
        bursts = random_schedule(seed)
        failure = failure_of(run, bursts)
        if failure is not None:
            while (less := next((other for other in smaller(bursts) if failure_of(run, other)), None)) is not None:
                bursts = less
            raise AssertionError(f"seed {seed}; this is enough: {bursts}") from failure_of(run, bursts)


@pytest.mark.every_loop
def test_every_buffer_answers_as_the_model_says_whatever_happens(run: Run) -> None:
    play(run, range(15))


@pytest.mark.thorough
@pytest.mark.parametrize("part", range(PARTS))
def test_every_buffer_answers_as_the_model_says_in_ten_thousand_schedules(run: Run, part: int) -> None:
    play(run, range(part, SCHEDULES, PARTS))

"""Random schedules of everything that can happen on a bus and to its buffers, against the model in `support.oracle`.

Buffers join late, with and without prefill and prefix, and leave; samples come late or from the future, reparent frames
in the past, turn static, or would close a loop; frames are removed, the clock jumps, lookups wait and are cancelled.
"""

import logging
import os
from collections.abc import Awaitable, Callable

import pytest
from hypothesis import HealthCheck, given, seed, settings
from support.oracle.game import Game
from support.oracle.schedule import Burst, schedules

Run = Callable[[Callable[[], Awaitable[None]]], None]

SCHEDULES = int(os.environ.get("ORACLE_SCHEDULES", "2000"))
"""On each loop, in the thorough suite. Ten thousand take about four minutes a loop on two cores."""

PARTS = 20
"""Tests that share them, so that they can run in several processes."""


@pytest.fixture(autouse=True)
def quiet(monkeypatch: pytest.MonkeyPatch) -> None:
    """Log nothing, because formatting the lines takes a good part of the time."""
    monkeypatch.setattr(logging.getLogger("tfbus"), "disabled", True)


def play(run: Run, bursts: list[Burst]) -> None:
    async def play_here() -> None:
        await Game().play(bursts)

    run(play_here)


@pytest.mark.every_loop
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(bursts=schedules)
def test_every_buffer_answers_as_the_model_says_whatever_happens(run: Run, bursts: list[Burst]) -> None:
    play(run, bursts)


@pytest.mark.thorough
@pytest.mark.parametrize("part", range(PARTS))
def test_every_buffer_answers_as_the_model_says_in_thousands_of_schedules(run: Run, part: int) -> None:
    # The parts would all have the same schedules if they were derandomised as other tests are.
    @seed(part)
    @settings(max_examples=SCHEDULES // PARTS, derandomize=False)
    @given(bursts=schedules)
    def play_part(bursts: list[Burst]) -> None:
        play(run, bursts)

    play_part()

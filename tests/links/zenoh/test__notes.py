import math
from collections.abc import Callable
from typing import Any

import anyio
import anyio.lowlevel
import anyio.to_thread
import pytest

from tfbus.links._receive_queue import Presence
from tfbus.links.zenoh._notes import MOST_ASKING, Noted, Notes

pytestmark = [pytest.mark.anyio, pytest.mark.every_loop]

QUERY: Any = object()
NOTES: list[tuple[Callable[[Notes], object], Noted]] = [
    (lambda notes: notes.add_change("a", Presence.LEFT), Noted([("a", Presence.LEFT)], [], [], [], set())),
    (
        lambda notes: notes.add_connection("a", "tcp/x:1", "tcp/y:2"),
        Noted([], [("a", "tcp/x:1", "tcp/y:2")], [], [], set()),
    ),
    (lambda notes: notes.add_question(QUERY), Noted([], [], [QUERY], [], set())),
    (lambda notes: notes.add_answer("a", None, b""), Noted([], [], [], [("a", None, b"")], set())),
    (lambda notes: notes.add_hearer("a"), Noted([], [], [], [], {"a"})),
    (Notes.stir, Noted([], [], [], [], set())),
]


async def test_whatever_a_thread_notes_wakes_the_loop_and_is_taken_once() -> None:
    notes = Notes(lambda: 7.0)
    notes.bind()
    for note, noted in NOTES:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(notes.wait, math.inf)
            await anyio.wait_all_tasks_blocked()
            await anyio.to_thread.run_sync(note, notes)
        # What comes before the wait begins is no less noted.
        await notes.wait(math.inf)
        assert notes.since == 7.0
        assert notes.take() == noted
        assert (notes.since, notes.take()) == (math.inf, Noted([], [], [], [], set()))
        with anyio.move_on_after(0.01) as nothing_came:
            await notes.wait(math.inf)
        assert nothing_came.cancelled_caught


async def test_without_a_note_the_wait_ends_when_somebody_is_due() -> None:
    notes = Notes(lambda: 7.0)
    notes.bind()
    await notes.wait(7.0)
    assert notes.since == math.inf


async def test_notes_before_there_is_a_loop_are_kept_with_the_time_of_the_first() -> None:
    time = 3.0
    notes = Notes(lambda: time)
    notes.add_answer("a", ["0"], b"x")
    time = 4.0
    notes.add_answer("b", [], b"")
    assert notes.since == 3.0
    notes.bind()
    await notes.wait(math.inf)
    assert notes.take().heard_by == [("a", ["0"], b"x"), ("b", [], b"")]


async def test_questions_and_hearers_have_a_bound() -> None:
    notes = Notes(lambda: 0.0)
    assert all(notes.add_question(QUERY) for _ in range(MOST_ASKING))
    assert not notes.add_question(QUERY)
    for number in range(MOST_ASKING + 1):
        notes.add_hearer(f"{number}")
    noted = notes.take()
    assert (len(noted.asking), len(noted.hearers)) == (MOST_ASKING, MOST_ASKING)
    assert notes.add_question(QUERY)

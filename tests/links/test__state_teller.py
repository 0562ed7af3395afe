from collections.abc import Sequence
from itertools import pairwise

import pytest

from tfbus.links._entries import MovingFrame, RemovedFrame
from tfbus.links._state import CHUNK, LinkState, StateEntry, StateStep
from tfbus.links._state_teller import MOST_KEPT, StateTeller

Written = tuple[list[str], int, int]


class Writer:
    """Writes the names in an answer, where its changes begin and end, and counts."""

    def __init__(self, most: int = CHUNK) -> None:
        self.count = 0
        self._most = most

    def write(self, entries: Sequence[StateEntry], step: StateStep) -> Written:
        self.count += 1
        if len(entries) > self._most:
            raise ValueError("too many")
        return [entry.frame for entry in entries if not hasattr(entry, "samples")], step.since, step.number


def state_of(*frames: str) -> LinkState:
    state = LinkState()
    for frame in frames:
        state.change(frame, MovingFrame(frame))
    return state


def test_whoever_asks_the_same_gets_the_same_message_until_the_state_changes() -> None:
    state, writer = state_of("a", "b"), Writer()
    teller = StateTeller(state, writer.write)
    first = teller.answer(0)
    assert first == (["a", "b"], 0, 2)
    assert teller.answer(0) is first
    assert teller.answer(1) == (["b"], 1, 2)
    assert (teller.answer(0), writer.count) == (first, 2)
    state.change("a", RemovedFrame(b"0123456789abcdef", 7, "a"))
    assert teller.answer(0) == (["b", "a"], 0, 3)
    assert teller.answer(1) == (["b", "a"], 1, 3)
    assert teller.answer(2) == (["a"], 2, 3)


def test_what_is_too_much_for_one_message_is_told_in_smaller_parts() -> None:
    state, writer = state_of(*"abcdefgh"), Writer(most=1)
    teller = StateTeller(state, writer.write)
    since, told = 0, []
    for _ in range(8):
        names, begin, since = teller.answer(since)
        told.append((names, begin, since))
    assert told == [([name], number, number + 1) for number, name in enumerate("abcdefgh")]
    attempts = writer.count
    assert [teller.answer(number) for number in range(8)] == told
    assert writer.count == attempts


def test_nothing_is_answered_when_no_message_holds_a_single_change() -> None:
    teller = StateTeller(state_of("a"), Writer(most=0).write)
    assert teller.answer(0) is None


def test_only_the_newest_answers_are_kept() -> None:
    state, writer = state_of(*map(str, range(2 * MOST_KEPT))), Writer()
    teller = StateTeller(state, writer.write)
    asked = range(MOST_KEPT + 1)
    for since in asked:
        teller.answer(since)
    for since in reversed(asked):
        teller.answer(since)
    # All but the first, which had made room for the last.
    assert writer.count == len(asked) + 1


@pytest.mark.parametrize("size", [CHUNK - 1, CHUNK, CHUNK + 1, 3 * CHUNK])
def test_a_peer_that_asks_on_is_told_everything_in_chunks(size: int) -> None:
    frames = [str(number) for number in range(size)]
    teller = StateTeller(state_of(*frames), Writer().write)
    answers = [teller.answer(0)]
    while answers[-1][2] < size:
        answers.append(teller.answer(answers[-1][2]))
    assert [name for names, _, _ in answers for name in names] == frames
    assert all(before[2] == after[1] for before, after in pairwise(answers))
    assert len(answers) == -(-size // CHUNK)

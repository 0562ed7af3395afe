import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.samples import static

from tfbus.links._entries import MovingFrame, OutgoingBatch, RemovedFrame
from tfbus.links._mirror import Mirror
from tfbus.links._state import CHUNK, MOST_GONE, LinkState, StateEntry, StateStep

ORIGIN, OTHER = b"0123456789abcdef", b"another origin !"


def kept(frame: str, sequence: int = 1, origin: bytes = ORIGIN) -> OutgoingBatch:
    return OutgoingBatch(origin, sequence, (static("map", frame),))


def gone(frame: str, sequence: int = 2, lost: bool = False) -> RemovedFrame:
    return RemovedFrame(ORIGIN, sequence, frame, lost)


def names(entries: list[StateEntry]) -> list[str]:
    return [entry.samples[0].child if isinstance(entry, OutgoingBatch) else entry.frame for entry in entries]


def tell(mirror: Mirror, entries: list[StateEntry]) -> None:
    """Note the entries of an answer, as an inbox does."""
    for entry in entries:
        if isinstance(entry, OutgoingBatch):
            mirror.static(entry.samples[0].child, entry.origin, entry.sequence)
        else:
            mirror.entry(entry)


def test_each_change_has_a_number_and_only_the_newest_of_each_frame_is_told() -> None:
    state = LinkState()
    state.change("s", kept("s"))
    state.change("m", MovingFrame("m"))
    state.change("t", kept("t"))
    state.change("s", kept("s", 5))
    state.change("m", gone("m"))
    assert state.number == 5
    entries, step = state.changes(0)
    assert (names(entries), step) == (["t", "s", "m"], StateStep(0, 5, state.digest))
    assert entries[1:] == [state.entry("s"), gone("m")]
    assert [names(state.changes(since)[0]) for since in (3, 4, 5)] == [["s", "m"], ["m"], []]


def test_a_frame_is_brought_as_static_as_moving_or_not_at_all() -> None:
    state = LinkState()
    state.change("s", kept("s"))
    state.change("m", MovingFrame("m"))
    state.change("x", gone("x"))
    assert [state.brings(frame) for frame in "smx?"] == [True, True, False, False]
    assert [type(state.entry(frame)) for frame in "smx?"] == [OutgoingBatch, MovingFrame, RemovedFrame, type(None)]


def test_the_digest_depends_on_what_is_there_and_not_on_how_it_came_there() -> None:
    one, other = LinkState(), LinkState()
    one.change("s", kept("s"))
    one.change("m", MovingFrame("m"))
    other.change("m", kept("m"))
    other.change("x", MovingFrame("x"))
    other.change("m", MovingFrame("m"))
    other.change("s", kept("s"))
    assert one.digest != other.digest
    other.change("x", gone("x"))
    assert one.digest == other.digest != 0
    for entry in (kept("s", 2), kept("s", 1, OTHER), MovingFrame("s")):
        other.change("s", entry)
        assert one.digest != other.digest


def test_a_long_state_is_told_in_chunks() -> None:
    state = LinkState()
    for number in range(2 * CHUNK):
        state.change(f"{number}", kept(f"{number}"))
    first, step = state.changes(0)
    assert (len(first), step) == (CHUNK, StateStep(0, CHUNK, 0, final=False))
    last, step = state.changes(CHUNK)
    assert (len(last), step) == (CHUNK, StateStep(CHUNK, 2 * CHUNK, state.digest)), "there is nothing behind it"
    state.change("0", kept("0", 9))
    second, step = state.changes(CHUNK, 400)
    assert (len(second), step) == (400, StateStep(CHUNK, CHUNK + 400, 0, final=False))
    third, step = state.changes(CHUNK + 400)
    assert (names(third)[-1], len(third)) == ("0", 101)
    assert step == StateStep(CHUNK + 400, 2 * CHUNK + 1, state.digest)


@pytest.mark.parametrize("since", [7, 2**64 - 1])
def test_a_number_that_was_not_reached_gives_the_whole_state(since: int) -> None:
    state = LinkState()
    state.change("s", kept("s"))
    assert state.changes(since) == state.changes(0)


def test_of_very_many_frames_that_went_the_oldest_are_forgotten_and_who_missed_them_gets_the_whole_state() -> None:
    state = LinkState()
    state.change("s", kept("s"))
    for number in range(MOST_GONE + 1):
        state.change(f"{number}", gone(f"{number}"))
    # The first to go was change 2.
    entries, step = state.changes(1)
    assert (names(entries)[:2], step.since) == (["s", "1"], 0)
    entries, step = state.changes(2)
    assert (names(entries)[:1], step.since) == (["1"], 2)


def test_a_frame_that_has_come_back_is_not_forgotten_with_those_that_went() -> None:
    state = LinkState()
    state.change("s", gone("s"))
    entry = kept("s", 3)
    state.change("s", entry)
    for number in range(MOST_GONE + 1):
        state.change(f"{number}", gone(f"{number}"))
    assert (state.entry("s"), state.entry("0")) == (entry, None)


def test_a_frame_that_changes_for_ever_takes_no_more_memory() -> None:
    state = LinkState()
    for number in range(10_000):
        state.change("s", kept("s", number))
    assert len(state._log) < 2_000
    assert names(state.changes(9_998)[0]) == ["s"]


CHANGES = st.lists(st.tuples(st.sampled_from("abcde"), st.sampled_from(("static", "moving", "gone", "lost", "ask"))))


@given(changes=CHANGES, limit=st.integers(1, 4))
@settings(max_examples=200)
def test_a_mirror_that_asks_now_and_then_agrees_at_last(changes: list[tuple[str, str]], limit: int) -> None:
    state, mirror = LinkState(), Mirror(100)

    def ask() -> None:
        entries, step = state.changes(mirror.asks(), limit)
        if step.since == 0:
            mirror.begins_anew()
        tell(mirror, entries)
        mirror.answered(step)

    for sequence, (frame, change) in enumerate(changes):
        if change == "ask":
            ask()
        elif change == "static":
            state.change(frame, kept(frame, sequence))
        elif change == "moving":
            state.change(frame, MovingFrame(frame))
        else:
            state.change(frame, gone(frame, sequence, lost=change == "lost"))
    for _ in range(10):
        ask()
    assert mirror.agrees
    assert [frame in mirror for frame in "abcde"] == [state.brings(frame) for frame in "abcde"]

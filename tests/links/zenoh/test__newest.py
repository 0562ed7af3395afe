import pytest
from support.samples import moving, static

from tfbus.links._entries import OutgoingBatch, RemovedFrame
from tfbus.links._inbox import ReceivedBatch
from tfbus.links._message import Message, read_message
from tfbus.links._outbox import Turn
from tfbus.links._peers import MAX_PEERS
from tfbus.links._state import StateStep
from tfbus.links.zenoh._newest import _TOGETHER, NewestSamples, Thinning

ORIGIN = b"0123456789abcdef"
STEP = StateStep(3, 5, 99, message=7)


def said(messages: list[Message]) -> dict[str, tuple[int, int]]:
    """The number of the batch and the stamp of each frame in some messages."""
    found = {}
    for message in messages:
        received = read_message(message.payload, message.attachment)
        assert (received.number, received.step) == (0, StateStep(5, 5, 99))
        for entry in received.entries:
            assert isinstance(entry, ReceivedBatch)
            found.update({sample.child: (entry.sequence, sample.stamp) for sample in entry.samples})
    return found


def turn(*entries: OutgoingBatch | RemovedFrame) -> Turn:
    return Turn(list(entries), {}, STEP)


def test_the_newest_sample_of_each_moving_frame_is_told_once_with_its_number() -> None:
    newest = NewestSamples()
    newest.note(turn(OutgoingBatch(ORIGIN, 1, [moving("map", "a", 1), static("map", "s"), moving("map", "b", 2)])))
    newest.note(turn(OutgoingBatch(ORIGIN, 2, [moving("map", "a", 3)])))
    assert said(newest.take()) == {"a": (2, 3), "b": (1, 2)}
    (claim,) = newest.take()
    assert said([claim]) == {}, "the claim is told all the same"


def test_there_is_something_untold_after_a_turn_and_after_a_claim_until_it_is_taken() -> None:
    newest = NewestSamples()
    assert not newest.untold
    newest.note(turn(OutgoingBatch(ORIGIN, 1, [moving("map", "a", 1)])))
    assert newest.untold
    newest.take()
    assert not newest.untold
    newest.claim(STEP)
    assert newest.untold
    assert said(newest.take()) == {}
    assert not newest.untold


def test_what_was_removed_or_is_static_now_or_cannot_be_sent_is_not_told() -> None:
    newest = NewestSamples()
    newest.note(turn(OutgoingBatch(ORIGIN, 1, [moving("map", name, 1) for name in "abcd"])))
    newest.note(turn(RemovedFrame(ORIGIN, 2, "a"), OutgoingBatch(ORIGIN, 3, [static("map", "b")])))
    newest.note(turn(OutgoingBatch(ORIGIN, 4, [moving("map", "c", 2**62)])))
    assert said(newest.take()) == {"d": (1, 1)}


def test_very_many_frames_are_told_in_several_messages() -> None:
    newest = NewestSamples()
    newest.note(turn(OutgoingBatch(ORIGIN, 1, [moving("map", f"{number}", 1) for number in range(2_001)])))
    messages = newest.take()
    assert len(messages) == 3
    assert [len(said([message])) for message in messages] == [1_000, 1_000, 1]


def test_samples_with_long_authorities_are_told_in_as_many_messages_as_they_need() -> None:
    newest = NewestSamples()
    long = [moving("map", f"{number}", 1, authority=f"{number}" + "x" * 60_000) for number in range(40)]
    newest.note(turn(OutgoingBatch(ORIGIN, 1, long)))
    messages = newest.take()
    assert len(messages) == 4
    assert said(messages).keys() == {f"{number}" for number in range(40)}


def test_before_the_first_claim_there_is_nothing_to_tell() -> None:
    assert NewestSamples().take() == []


@pytest.mark.parametrize(
    ("time", "taken"), [(0.0, True), (0.02, True), (0.03, False), (0.44, False), (0.46, True), (0.5, True)]
)
def test_of_each_sender_as_much_is_taken_as_the_rate_allows_and_what_comes_together(time: float, taken: bool) -> None:
    now = [100.0]
    thinning = Thinning(2.0, lambda: now[0])
    assert thinning.takes("a")
    now[0] += time
    assert thinning.takes("a") is taken
    assert thinning.takes("b"), "each sender has its own time"
    now[0] = 100.8
    assert thinning.takes("a") is (time < 0.45), "the time counts from the last message that was taken"


def test_what_comes_together_does_not_put_off_the_next_time() -> None:
    now = [0.0]
    thinning = Thinning(1.0, lambda: now[0])
    taken = []
    for now[0] in (0.0, 0.01, _TOGETHER, 0.5, 0.91):
        taken.append(thinning.takes("a"))
    assert taken == [True, True, True, False, True]


def test_the_memory_of_senders_is_bounded() -> None:
    thinning = Thinning(1.0, lambda: 5.0)
    for number in range(MAX_PEERS + 1):
        assert thinning.takes(f"{number}")
    assert len(thinning._taken) == 1

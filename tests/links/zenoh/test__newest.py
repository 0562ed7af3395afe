from support.samples import moving, static

from tfbus.links._entries import OutgoingBatch, RemovedFrame
from tfbus.links._inbox import ReceivedBatch
from tfbus.links._message import Message, read_message
from tfbus.links._outbox import Turn
from tfbus.links._state import StateStep
from tfbus.links.zenoh._newest import NewestSamples

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
    newest.note(turn(OutgoingBatch(ORIGIN, 1, [moving("map", f"{number}", 1) for number in range(2_500)])))
    messages = newest.take()
    assert len(messages) == 3
    assert len(said(messages)) == 2_500


def test_before_the_first_claim_there_is_nothing_to_tell() -> None:
    assert NewestSamples().take() == []

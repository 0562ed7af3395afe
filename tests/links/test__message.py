from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import strategies as some
from support.samples import moving, static

from tfbus import SECOND, InvalidTransformError, TransformStamped
from tfbus.links import _message
from tfbus.links._attachment import MAX_ENTRIES, PublishedBatch, pack, unpack
from tfbus.links._carrier import SendReport
from tfbus.links._entries import MovingFrame, OutgoingBatch, RemovedFrame
from tfbus.links._inbox import ReceivedBatch
from tfbus.links._message import (
    _LONGEST_AUTHORITY,
    FULL_MESSAGE,
    MAX_BYTES,
    MAX_SAMPLES,
    Message,
    MessageWriter,
    can_hold,
    read_message,
    read_message_in_parts,
    write_answer,
)
from tfbus.links._state import StateStep
from tfbus.tf_message import MAX_NAME, MalformedMessageError, encode

ORIGIN, OTHER = b"0123456789abcdef", b"another origin !"
TOO_LATE = 2**31 * SECOND
Batch = list[TransformStamped]


class Writer:
    """A writer, the entries of a turn, and the errors of what could not be sent."""

    def __init__(self) -> None:
        self.refused: list[Exception] = []
        self.report = SendReport(self.refused.append)
        self._writer = MessageWriter(self.report)
        self._entries: list[OutgoingBatch | RemovedFrame] = []
        self._sequence = 0

    def add(self, *samples: TransformStamped, origin: bytes = ORIGIN) -> None:
        self._sequence += 1
        self._entries.append(OutgoingBatch(origin, self._sequence, samples))

    def remove(self, frame: str, origin: bytes = ORIGIN) -> None:
        self._sequence += 1
        self._entries.append(RemovedFrame(origin, self._sequence, frame))

    def write(self) -> list[Message]:
        entries, self._entries = self._entries, []
        return self._writer.write(entries)

    def sent(self) -> list[Batch | RemovedFrame]:
        """The contents of all messages of a turn, one after the other."""
        return [content for message in self.write() for content in contents(message)]


def entries_of(message: Message) -> list[ReceivedBatch | RemovedFrame]:
    received = read_message(message.payload, message.attachment)
    assert received.errors == []
    return [entry for entry in received.entries if not isinstance(entry, MovingFrame)]


def contents(message: Message) -> list[Batch | RemovedFrame]:
    entries = entries_of(message)
    found = [entry if isinstance(entry, RemovedFrame) else list[TransformStamped](entry.samples) for entry in entries]
    assert message.samples == sum(len(content) for content in found if isinstance(content, list))
    return found


def shapes(messages: Sequence[Message]) -> list[list[int]]:
    """The number of samples of each batch of each message."""
    return [[len(content) for content in contents(message) if isinstance(content, list)] for message in messages]


# Messages.


def test_one_message_holds_batches_and_removals_in_order_with_their_origins_numbers_and_authorities() -> None:
    writer = Writer()
    first = [moving("map", "a", 1, authority="slam"), static("map", "s"), moving("map", "a", 2)]
    writer.add(*first)
    writer.remove("a", origin=OTHER)
    writer.add(moving("map", "b", 3), origin=OTHER)
    (message,) = writer.write()
    one, removal, other = entries_of(message)
    assert isinstance(one, ReceivedBatch)
    assert isinstance(other, ReceivedBatch)
    assert (one.origin, one.sequence, one.samples, one.authorities) == (ORIGIN, 1, first, ["slam", "", ""])
    assert removal == RemovedFrame(OTHER, 2, "a")
    assert (other.origin, other.sequence, other.samples) == (OTHER, 3, [moving("map", "b", 3)])
    assert writer.write() == []


@given(wanted=st.lists(st.lists(some.samples(at=some.stamps(0, TOO_LATE - 1)), min_size=1, max_size=3), max_size=3))
def test_every_batch_is_read_as_it_was_written(wanted: list[Batch]) -> None:
    writer = Writer()
    for samples in wanted:
        writer.add(*samples)
    assert writer.sent() == wanted
    assert writer.report.not_sent == {}


def test_live_messages_are_numbered_and_an_answer_has_no_number() -> None:
    writer = Writer()
    numbers = []
    for stamp in range(3):
        writer.add(moving("map", "a", stamp))
        numbers += [unpack(message.attachment).number for message in writer.write()]
    assert numbers == [1, 2, 3]
    answer = write_answer(
        [OutgoingBatch(OTHER, 2, [static("map", "s", authority="calibration")]), MovingFrame("m")], StateStep(3, 9, 77)
    )
    unpacked = unpack(answer.attachment)
    assert (answer.number, unpacked.number, unpacked.step) == (0, 0, StateStep(3, 9, 77))
    assert unpacked.entries == (PublishedBatch(OTHER, 2, (("calibration", True, 1),)), MovingFrame("m"))


STEP = StateStep(4, 6, 99)


def steps(messages: list[Message]) -> list[tuple[int, StateStep | None]]:
    """The number of each message, and what it claims."""
    return [(message.number, unpack(message.attachment).step) for message in messages]


def test_the_step_of_a_turn_is_in_its_only_message_or_behind_all_of_them() -> None:
    writer = MessageWriter(SendReport(print))
    batch = OutgoingBatch(ORIGIN, 1, [moving("map", "a", 1)] * FULL_MESSAGE)
    bad = OutgoingBatch(ORIGIN, 2, [moving("map", "a", 2**62)])
    assert steps(writer.write([OutgoingBatch(ORIGIN, 1, [moving("map", "a", 1)])], STEP)) == [
        (1, STEP._replace(message=1))
    ]
    assert steps(writer.write([batch, batch], STEP)) == [(2, None), (3, None), (0, STEP._replace(message=3))]
    assert steps(writer.write([batch], STEP)) == [(4, None), (0, STEP._replace(message=4))]
    assert steps(writer.write([bad], STEP)) == [(0, STEP._replace(message=4))]
    assert steps([writer.claim(STEP)]) == [(0, STEP._replace(message=4))]


@pytest.mark.thorough
def test_a_full_message_is_followed_by_another_and_batches_stay_whole() -> None:
    writer = Writer()
    for _ in range(FULL_MESSAGE + 1):
        writer.add(moving("map", "a", 1))
    writer.add(*[moving("map", "b", stamp) for stamp in range(FULL_MESSAGE - 2)])
    writer.add(*[moving("map", "c", stamp) for stamp in range(2 * FULL_MESSAGE)])
    writer.add(moving("map", "d", 1))
    # The batch of c fills a message of its own, for no message has more than twice as many samples.
    assert [message.samples for message in writer.write()] == [FULL_MESSAGE, 1, FULL_MESSAGE - 2, 2 * FULL_MESSAGE, 1]


def test_removals_count_as_samples_do() -> None:
    writer = Writer()
    for number in range(FULL_MESSAGE + 1):
        writer.remove(f"{number}")
    assert [len(contents(message)) for message in writer.write()] == [FULL_MESSAGE, 1]
    assert FULL_MESSAGE < MAX_ENTRIES


def test_entries_that_one_attachment_cannot_hold_go_out_in_several_messages() -> None:
    writer = Writer()
    for number in range(300):
        writer.add(moving("map", "a", 1), moving("map", "a", 2), origin=number.to_bytes(16))
    messages = writer.write()
    assert len(messages) == 2
    assert shapes(messages) == [[2] * 150] * 2
    assert [unpack(message.attachment).number for message in messages] == [1, 2]
    assert writer.report.not_sent == {}


def test_no_message_is_larger_than_what_others_accept() -> None:
    writer = Writer()
    long = "x" * (MAX_NAME - 10)
    half = [moving(long, f"{long}{number}", 1) for number in range(1_500)]
    writer.add(*half)
    writer.add(*half)
    writer.add(moving("map", "a", 1))
    messages = writer.write()
    assert shapes(messages) == [[1_500], [1_500, 1]]
    assert all(len(message.payload) + len(message.attachment) <= MAX_BYTES for message in messages)


@pytest.mark.parametrize(("spare", "messages"), [(0, 1), (-1, 2)])
def test_payload_and_attachment_together_may_fill_a_message(
    spare: int, messages: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = Writer()

    def written() -> list[Message]:
        for name in "ab":
            writer.add(moving("map", name, 1, authority="slam"))
        return writer.write()

    (whole,) = written()
    monkeypatch.setattr(_message, "MAX_BYTES", len(whole.payload) + len(whole.attachment) + spare)
    assert len(written()) == messages


def test_the_longest_authority_is_sent() -> None:
    longest = moving("map", "a", 1, authority="x" * _LONGEST_AUTHORITY)
    assert can_hold(longest)
    writer = Writer()
    writer.add(longest)
    assert writer.sent() == [[longest]]


def test_a_batch_too_large_for_a_message_is_counted_and_its_neighbours_go_out() -> None:
    writer = Writer()
    writer.add(moving("map", "a", 1))
    long = "x" * (MAX_NAME - 10)
    writer.add(*[moving(long, f"{long}{number}", 1) for number in range(3_000)])
    writer.add(moving("map", "c", 1))
    assert writer.sent() == [[moving("map", "a", 1)], [moving("map", "c", 1)]]
    assert writer.report.not_sent == {"oversized": 3_000}
    assert len(writer.refused) == 1


def test_a_batch_of_more_samples_than_a_bus_publishes_in_one_turn_is_neither_sent_nor_taken() -> None:
    samples = tuple(moving("map", f"{number}", 1) for number in range(MAX_SAMPLES + 1))
    writer = Writer()
    writer.add(*samples)
    assert writer.write() == []
    assert writer.report.not_sent == {"oversized": MAX_SAMPLES + 1}
    attachment = pack(1, [PublishedBatch(ORIGIN, 1, (("", False, len(samples)),))])
    with pytest.raises(MalformedMessageError, match="oversized"):
        list(read_message_in_parts(encode(samples), attachment))


# Refusals.


BAD = [
    pytest.param(moving("map", "bad", TOO_LATE), "stamp", id="after 2038"),
    pytest.param(moving("map", "bad", -TOO_LATE - 1), "stamp", id="before 1901"),
    pytest.param(moving("map", "\ud800", 1), "frame name", id="half a character"),
    pytest.param(moving("x" * (MAX_NAME + 1), "bad", 1), "frame name", id="a long name"),
    pytest.param(moving("map", "bad", 1, authority="\ud800"), "authority", id="half a character of an authority"),
    pytest.param(moving("map", "bad", 1, authority="x" * 65_536), "authority", id="a long authority"),
    pytest.param(static("map", "bad", authority="\ud800"), "authority", id="a static one"),
]


@pytest.mark.parametrize(("bad", "reason"), BAD)
def test_samples_that_no_message_can_hold_are_counted_while_the_rest_of_their_batch_goes_out(
    bad: TransformStamped, reason: str
) -> None:
    writer = Writer()
    good = [moving("map", "a", stamp) for stamp in range(4)]
    writer.add(good[0], bad, good[1], bad)
    writer.add(bad)
    writer.remove("b")
    writer.add(*good[2:])
    (message,) = writer.write()
    assert contents(message) == [good[:2], RemovedFrame(ORIGIN, 3, "b"), good[2:]]
    assert [entry.sequence for entry in entries_of(message)] == [1, 3, 4]
    assert writer.report.not_sent == {reason: 3}
    assert len(writer.refused) == 3
    assert all(isinstance(error, InvalidTransformError) and error.reason == reason for error in writer.refused)
    assert not can_hold(bad)


def test_a_turn_without_a_message_uses_no_number() -> None:
    writer = Writer()
    for number in (1, 2):
        writer.add(moving("map", "a", TOO_LATE))
        assert writer.write() == []
        writer.add(moving("map", "a", 1))
        assert [unpack(message.attachment).number for message in writer.write()] == [number]


def test_a_turn_that_is_skipped_has_a_number_and_its_time_is_told_later() -> None:
    refused: list[Exception] = []
    writer = MessageWriter(SendReport(refused.append))
    writer.skip(5)
    writer.skip()
    (message,) = writer.write([RemovedFrame(ORIGIN, 1, "a")])
    received = read_message(message.payload, message.attachment)
    assert (received.number, received.time) == (3, 5)


@pytest.mark.parametrize("frame", ["\ud800", "x" * (MAX_NAME + 1)])
def test_removals_that_no_message_can_hold_are_counted_and_not_sent(frame: str) -> None:
    writer = Writer()
    writer.add(moving("map", "a", 1))
    writer.remove(frame)
    writer.add(moving("map", "b", 1))
    assert writer.sent() == [[moving("map", "a", 1)], [moving("map", "b", 1)]]
    assert writer.report.not_sent == {"frame name": 1}


def test_bad_samples_among_many_good_ones_are_found() -> None:
    writer = Writer()
    for number in range(1_000):
        authority = "\ud800" if number % 100 == 0 else f"{number}"
        writer.add(moving("map", "a", number, authority=authority), origin=(number % 300).to_bytes(16))
    stamps = [batch[0].stamp for batch in writer.sent() if isinstance(batch, list)]
    assert stamps == [number for number in range(1_000) if number % 100]
    assert writer.report.not_sent == {"authority": 10}


# Reading.


def test_samples_that_cannot_be_decoded_are_errors_and_the_others_stay_in_their_batches() -> None:
    samples = [moving("map", "a", 1), moving("?map", "bad", 1), moving("map", "b", 1)]
    entries = [PublishedBatch(ORIGIN, n, (("slam", False, count),)) for n, count in ((1, 2), (2, 1))]
    received = read_message(encode(samples).replace(b"?map", b"/map"), pack(5, entries))
    assert received.number == 5
    assert [error.authority for error in received.errors] == ["slam"]
    batches = [entry for entry in received.entries if isinstance(entry, ReceivedBatch)]
    assert [[sample.child for sample in batch.samples] for batch in batches] == [["a"], ["b"]]


def test_a_payload_that_does_not_fit_its_attachment_is_refused() -> None:
    with pytest.raises(MalformedMessageError, match="tags"):
        read_message(encode([moving("map", "a", 1)]), pack(1, []))

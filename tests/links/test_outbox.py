from collections.abc import Sequence
from itertools import chain

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import strategies as some
from support.samples import moving, static

from tfbus import SECOND, InvalidTransformError, TransformStamped
from tfbus.links.attachment import MAX_ENTRIES, Entry, PublishedBatch, RemovedFrame, unpack
from tfbus.links.outbox import MAX_BYTES, MAX_SAMPLES, Message, Outbox
from tfbus.links.relay import Piece
from tfbus.tf_message import MAX_NAME, decode

ORIGIN, OTHER = b"0123456789abcdef", b"another origin !"
TOO_LATE = 2**31 * SECOND


class Sender:
    """An outbox, and what it has told."""

    def __init__(self, frames: set[str] | None = None) -> None:
        self.notified = 0
        self.refused: list[Exception] = []
        self.outbox = Outbox(frames, self._note, self.refused.append)
        self._sequence = 0

    def _note(self) -> None:
        self.notified += 1

    def take(self, *samples: TransformStamped, origin: bytes = ORIGIN, send: bool = True) -> None:
        self._sequence += 1
        self.outbox.take(Piece(origin, self._sequence, samples), send)

    def remove(self, frame: str, origin: bytes = ORIGIN, lost: bool = False, send: bool = True) -> None:
        self._sequence += 1
        self.outbox.remove(origin, self._sequence, frame, lost, send)

    def sent(self) -> list[TransformStamped | RemovedFrame]:
        """All that is to go out now, behind each other."""
        return list(chain.from_iterable(map(contents, self.outbox.flush())))

    def kept(self) -> dict[str, TransformStamped | RemovedFrame | None]:
        """What changes for late joiners."""
        self.outbox.flush()
        changes = self.outbox.take_statics(1_000_000)
        return {frame: None if message is None else contents(message)[0] for frame, message in changes.items()}


def batches(message: Message) -> list[tuple[Entry, list[TransformStamped]]]:
    """The entries of a message, and the samples of each."""
    attachment = unpack(message.attachment)
    decoded = decode(message.payload, attachment.tags())
    assert decoded.errors == []
    samples = iter(decoded.samples)
    found = []
    for entry in attachment.entries:
        count = entry.count if isinstance(entry, PublishedBatch) else 0
        found.append((entry, [sample for _, sample in zip(range(count), samples, strict=False) if sample is not None]))
    assert list(samples) == []
    assert message.samples == sum(len(batch) for _, batch in found)
    return found


def contents(message: Message) -> list[TransformStamped | RemovedFrame]:
    found: list[TransformStamped | RemovedFrame] = []
    for entry, samples in batches(message):
        found += [entry] if isinstance(entry, RemovedFrame) else samples
    return found


def shapes(messages: Sequence[Message]) -> list[list[int]]:
    """How many samples each batch of each message has."""
    return [[len(samples) for _, samples in batches(message)] for message in messages]


# Messages.


def test_what_gathers_in_a_turn_is_one_message_in_order_with_whole_batches() -> None:
    sender = Sender()
    first = [moving("map", "a", 1, authority="slam"), static("map", "s"), moving("map", "a", 2)]
    sender.take(*first)
    sender.remove("a", origin=OTHER)
    sender.take(moving("map", "b", 3), origin=OTHER)
    assert (sender.notified, sender.outbox.pending) == (3, 5)
    (message,) = sender.outbox.flush()
    runs = (("slam", False, 1), ("", True, 1), ("", False, 1))
    assert batches(message) == [
        (PublishedBatch(ORIGIN, 1, runs), first),
        (RemovedFrame(OTHER, 2, "a"), []),
        (PublishedBatch(OTHER, 3, (("", False, 1),)), [moving("map", "b", 3)]),
    ]
    assert (sender.outbox.pending, sender.outbox.flush()) == (0, [])


@given(wanted=st.lists(st.lists(some.samples(at=some.stamps(0, TOO_LATE - 1)), min_size=1, max_size=5), max_size=5))
def test_every_batch_goes_out_as_it_is(wanted: list[list[TransformStamped]]) -> None:
    sender = Sender()
    for samples in wanted:
        sender.take(*samples)
    messages = sender.outbox.flush()
    assert [samples for message in messages for _, samples in batches(message)] == wanted
    assert sender.outbox.not_sent == {}


def test_messages_are_numbered_and_what_is_kept_has_no_number() -> None:
    sender = Sender()
    numbers = []
    for stamp in range(3):
        sender.take(moving("map", "a", stamp), static("map", "s", stamp))
        numbers += [unpack(message.attachment).number for message in sender.outbox.flush()]
        (kept,) = sender.outbox.take_statics(100).values()
        assert kept is not None
        assert unpack(kept.attachment).number == 0
    assert numbers == [1, 2, 3]


def test_a_message_has_about_so_many_samples_and_batches_stay_whole() -> None:
    sender = Sender()
    for _ in range(MAX_SAMPLES + 1):
        sender.take(moving("map", "a", 1))
    sender.take(*[moving("map", "b", stamp) for stamp in range(MAX_SAMPLES - 2)])
    sender.take(*[moving("map", "c", stamp) for stamp in range(2 * MAX_SAMPLES)])
    sender.take(moving("map", "d", 1))
    assert shapes(sender.outbox.flush()) == [[1] * MAX_SAMPLES, [1, MAX_SAMPLES - 2, 2 * MAX_SAMPLES], [1]]


def test_removals_count_as_samples_do() -> None:
    sender = Sender()
    for number in range(MAX_SAMPLES + 1):
        sender.remove(f"{number}")
    assert sender.outbox.pending == MAX_SAMPLES + 1
    assert [len(batches(message)) for message in sender.outbox.flush()] == [MAX_SAMPLES, 1]
    assert MAX_SAMPLES < MAX_ENTRIES


def test_what_is_too_much_for_one_message_goes_in_several() -> None:
    sender = Sender()
    for number in range(300):
        sender.take(moving("map", "a", 1), moving("map", "a", 2), origin=number.to_bytes(16))
    messages = sender.outbox.flush()
    assert len(messages) == 2
    assert shapes(messages) == [[2] * 150] * 2
    assert [unpack(message.attachment).number for message in messages] == [1, 2]
    assert sender.outbox.not_sent == {}


def test_no_message_is_larger_than_what_others_take() -> None:
    sender = Sender()
    long = "x" * (MAX_NAME - 10)
    half = [moving(long, f"{long}{number}", 1) for number in range(1_500)]
    sender.take(*half)
    sender.take(*half)
    sender.take(moving("map", "a", 1))
    messages = sender.outbox.flush()
    assert shapes(messages) == [[1_500], [1_500, 1]]
    assert all(len(message.payload) + len(message.attachment) <= MAX_BYTES for message in messages)


def test_a_batch_that_is_too_large_by_itself_is_counted_and_what_is_beside_it_goes() -> None:
    sender = Sender()
    sender.take(moving("map", "a", 1))
    sender.take(*[moving("map", "b", stamp) for stamp in range(MAX_BYTES // 80)])
    sender.take(moving("map", "c", 1))
    assert sender.sent() == [moving("map", "a", 1), moving("map", "c", 1)]
    assert sender.outbox.not_sent == {"oversized": MAX_BYTES // 80}
    assert len(sender.refused) == 1


# What cannot be sent.


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
def test_what_no_message_can_hold_is_left_out_and_counted_while_the_rest_of_its_batch_goes(
    bad: TransformStamped, reason: str
) -> None:
    sender = Sender()
    good = [moving("map", "a", stamp) for stamp in range(4)]
    sender.take(good[0], bad, good[1], bad)
    sender.take(bad)
    sender.remove("b")
    sender.take(*good[2:])
    (message,) = sender.outbox.flush()
    assert [samples for _, samples in batches(message)] == [good[:2], [], good[2:]]
    assert [entry.sequence for entry, _ in batches(message)] == [1, 3, 4]
    assert sender.outbox.not_sent == {reason: 3}
    assert len(sender.refused) == 3
    assert all(isinstance(error, InvalidTransformError) and error.reason == reason for error in sender.refused)
    assert sender.outbox.take_statics(100) == {}


def test_when_nothing_can_be_sent_no_message_goes_and_no_number_is_missed() -> None:
    sender = Sender()
    for number in (1, 2):
        sender.take(moving("map", "a", TOO_LATE))
        assert sender.outbox.flush() == []
        sender.take(moving("map", "a", 1))
        assert [unpack(message.attachment).number for message in sender.outbox.flush()] == [number]


@pytest.mark.parametrize("frame", ["\ud800", "x" * (MAX_NAME + 1)])
def test_the_removal_of_what_was_never_sent_is_counted_and_not_sent(frame: str) -> None:
    sender = Sender()
    sender.take(moving("map", "a", 1))
    sender.remove(frame)
    sender.take(moving("map", "b", 1))
    assert sender.sent() == [moving("map", "a", 1), moving("map", "b", 1)]
    assert sender.outbox.not_sent == {"frame name": 1}


def test_many_bad_ones_among_many_good_ones_are_found() -> None:
    sender = Sender()
    for number in range(1_000):
        authority = "\ud800" if number % 100 == 0 else f"{number}"
        sender.take(moving("map", "a", number, authority=authority), origin=(number % 300).to_bytes(16))
    sent = sender.sent()
    assert [sample.stamp for sample in sent if isinstance(sample, TransformStamped)] == [
        number for number in range(1_000) if number % 100
    ]
    assert sender.outbox.not_sent == {"authority": 10}


# Only some frames.


def test_only_wanted_frames_go_out_or_are_kept_and_nobody_is_told_of_others() -> None:
    sender = Sender({"a", "s"})
    sender.take(moving("map", "b", 1), moving("map", "a", 1), static("map", "t"), static("map", "s"))
    sender.take(moving("map", "b", 2))
    sender.take(moving("a", "b", 2))
    sender.remove("b")
    assert sender.notified == 1
    sender.remove("a")
    sender.remove("s")
    assert sender.outbox.pending == 4
    assert sender.sent() == [
        moving("map", "a", 1),
        static("map", "s"),
        RemovedFrame(ORIGIN, 5, "a"),
        RemovedFrame(ORIGIN, 6, "s"),
    ]
    assert sender.kept() == {"s": RemovedFrame(ORIGIN, 6, "s")}


def test_a_link_for_no_frame_at_all_sends_nothing() -> None:
    sender = Sender(set())
    sender.take(moving("map", "a", 1), static("map", "s"))
    sender.remove("a")
    assert (sender.sent(), sender.kept(), sender.notified) == ([], {}, 0)


# Static frames.


def test_the_newest_sample_of_each_static_frame_is_kept_alone_with_its_tag_and_number() -> None:
    sender = Sender()
    newest = static("world", "s", 3.0, authority="calibration")
    sender.take(static("map", "s", 1.0), moving("map", "a", 1), static("map", "t"))
    sender.take(moving("map", "b", 1), static("map", "s", 2.0), newest, origin=OTHER)
    sender.outbox.flush()
    changes = sender.outbox.take_statics(100)
    assert {frame: contents(message) for frame, message in changes.items() if message} == {
        "s": [newest],
        "t": [static("map", "t")],
    }
    kept = changes["s"]
    assert kept is not None
    assert unpack(kept.attachment).entries == (PublishedBatch(OTHER, 2, (("calibration", True, 1),)),)
    assert sender.kept() == {}


def test_nothing_is_kept_before_it_has_gone_out_live() -> None:
    sender = Sender()
    sender.take(static("map", "s"))
    assert (sender.outbox.statics, sender.outbox.take_statics(100)) == ({}, {})
    sender.outbox.flush()
    assert list(sender.outbox.statics) == ["s"]


def test_a_static_frame_that_turns_moving_is_not_kept_any_more() -> None:
    sender = Sender()
    sender.take(static("map", "s"), static("map", "t"))
    assert sender.kept() == {"s": static("map", "s"), "t": static("map", "t")}
    sender.take(moving("map", "s", 1))
    sender.take(static("map", "t", 2.0), moving("map", "t", 1))
    assert sender.kept() == {"s": None, "t": None}
    sender.take(moving("map", "s", 2))
    sender.remove("s")
    assert sender.kept() == {}
    sender.take(static("map", "s"), moving("map", "s", 3), static("map", "s", 4.0))
    assert sender.kept() == {"s": static("map", "s", 4.0)}


def test_a_static_frame_that_is_removed_has_a_tombstone_and_a_moving_one_has_none() -> None:
    sender = Sender()
    sender.take(static("map", "s"), moving("map", "a", 1))
    sender.kept()
    sender.remove("s")
    sender.remove("a")
    assert sender.kept() == {"s": RemovedFrame(ORIGIN, 2, "s")}
    sender.remove("s")
    assert sender.kept() == {}
    sender.take(static("map", "s", 5.0))
    assert sender.kept() == {"s": static("map", "s", 5.0)}


def test_what_is_kept_can_be_taken_a_few_at_a_time() -> None:
    sender = Sender()
    sender.take(*[static("map", f"{number}") for number in range(250)])
    sender.take(*[static("map", f"bad {number}", authority="\ud800") for number in range(250)])
    sender.take(*[static("map", f"{number}") for number in range(250, 301)])
    sender.outbox.flush()
    taken = []
    while changes := sender.outbox.take_statics(100):
        assert len(changes) <= 100
        taken += list(changes)
    assert taken == [f"{number}" for number in range(301)]
    assert sender.outbox.statics == {}


def test_what_is_kept_follows_what_comes_in_by_the_same_link_and_is_not_sent_back() -> None:
    sender = Sender()
    sender.take(static("map", "s"), static("map", "t"), static("map", "u"), static("map", "v"))
    sender.kept()
    sender.notified = 0
    theirs = static("map", "s", 7.0)
    sender.take(theirs, moving("map", "t", 1), static("map", "new"), moving("map", "a", 1), origin=OTHER, send=False)
    sender.remove("u", origin=OTHER, send=False)
    sender.remove("v", origin=OTHER, lost=True, send=False)
    assert (sender.notified, sender.outbox.pending) == (3, 0)
    assert sender.sent() == []
    assert sender.kept() == {"s": theirs, "t": None, "u": RemovedFrame(OTHER, 3, "u"), "v": None}


def test_nobody_is_woken_for_what_comes_in_and_is_not_kept_here() -> None:
    sender = Sender()
    sender.take(static("map", "s"))
    sender.kept()
    sender.notified = 0
    sender.take(static("map", "t"), moving("map", "a", 1), send=False)
    sender.remove("t", send=False)
    sender.remove("a", send=False)
    assert (sender.notified, sender.outbox.pending, sender.sent(), sender.kept()) == (0, 0, [], {})


@given(
    st.lists(
        st.tuples(
            st.sampled_from(("static", "moving", "remove", "lose", "flush", "take")),
            st.sampled_from("ab"),
            st.booleans(),
        ),
        max_size=30,
    )
)
def test_what_is_kept_is_the_last_of_what_was_sent_or_followed_it(steps: list[tuple[str, str, bool]]) -> None:
    sender = Sender()
    model: dict[str, TransformStamped | None] = {}
    kept: dict[str, TransformStamped | RemovedFrame | None] = {}
    for number, (step, frame, send) in enumerate(steps):
        if step == "flush":
            sender.outbox.flush()
        elif step == "take":
            for name, message in sender.outbox.take_statics(1).items():
                kept[name] = None if message is None else contents(message)[0]
        elif step == "static":
            sample = static("map", frame, float(number))
            sender.take(sample, send=send)
            if send or model.get(frame):
                model[frame] = sample
        else:
            model[frame] = None
            if step == "moving":
                sender.take(moving("map", frame, number), send=send)
            else:
                sender.remove(frame, lost=step == "lose", send=send)
    kept |= sender.kept()
    for frame in "ab":
        last = kept.get(frame)
        assert (None if isinstance(last, RemovedFrame) else last) == model.get(frame)

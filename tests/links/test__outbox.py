from collections.abc import Callable

from hypothesis import given
from hypothesis import strategies as st
from support.samples import moving, static
from tfbus.links._entries import OutgoingBatch, RemovedFrame
from tfbus.links._outbox import Outbox

from tfbus import TransformStamped

ORIGIN, OTHER = b"0123456789abcdef", b"another origin !"
Kept = dict[str, tuple[TransformStamped, ...] | RemovedFrame | None]


class Sender:
    """An outbox, and how often it has notified."""

    def __init__(self, frames: set[str] | None = None) -> None:
        self.notified = 0
        self.outbox = Outbox(frames, self._note)
        self._sequence = 0

    def _note(self) -> None:
        self.notified += 1

    def add(self, *samples: TransformStamped, origin: bytes = ORIGIN, echo: bool = False) -> None:
        self._sequence += 1
        self.outbox.add_batch(OutgoingBatch(origin, self._sequence, samples), echo)

    def remove(self, frame: str, origin: bytes = ORIGIN, lost: bool = False, echo: bool = False) -> None:
        self._sequence += 1
        self.outbox.add_removal(RemovedFrame(origin, self._sequence, frame, lost), echo)

    def turn(self) -> tuple[list[tuple[TransformStamped, ...] | RemovedFrame], Kept]:
        """The entries of a turn, and its changes of static frames."""
        turn = self.outbox.flush()
        kept = {frame: None if entry is None else contents(entry) for frame, entry in turn.statics.items()}
        return [contents(entry) for entry in turn.entries], kept

    def kept(self) -> Kept:
        return self.turn()[1]


def contents(entry: OutgoingBatch | RemovedFrame) -> tuple[TransformStamped, ...] | RemovedFrame:
    return tuple(entry.samples) if isinstance(entry, OutgoingBatch) else entry


# Entries.


def test_a_turn_has_its_batches_and_removals_in_order_with_their_origins_and_numbers() -> None:
    sender = Sender()
    first = (moving("map", "a", 1, authority="slam"), static("map", "s"), moving("map", "a", 2))
    sender.add(*first)
    sender.remove("a", origin=OTHER)
    sender.add(moving("map", "b", 3), origin=OTHER)
    assert (sender.notified, sender.outbox.pending) == (3, 5)
    one, removal, other = sender.outbox.flush().entries
    assert isinstance(one, OutgoingBatch)
    assert isinstance(other, OutgoingBatch)
    assert (one.origin, one.sequence, one.samples) == (ORIGIN, 1, first)
    assert removal == RemovedFrame(OTHER, 2, "a")
    assert (other.origin, other.sequence, other.samples) == (OTHER, 3, (moving("map", "b", 3),))
    assert (sender.outbox.pending, sender.turn()) == (0, ([], {}))


def test_only_wanted_frames_go_out_or_are_kept_and_others_notify_nobody() -> None:
    sender = Sender({"a", "s"})
    sender.add(moving("map", "b", 1), moving("map", "a", 1), static("map", "t"), static("map", "s"))
    sender.add(moving("map", "b", 2))
    sender.add(moving("a", "b", 2))
    sender.remove("b")
    assert sender.notified == 1
    sender.remove("a")
    sender.remove("s")
    assert sender.outbox.pending == 4
    removals = [RemovedFrame(ORIGIN, 5, "a"), RemovedFrame(ORIGIN, 6, "s")]
    assert sender.turn() == ([(moving("map", "a", 1), static("map", "s")), *removals], {"s": removals[1]})


def test_a_link_for_no_frame_at_all_sends_nothing() -> None:
    sender = Sender(set())
    sender.add(moving("map", "a", 1), static("map", "s"))
    sender.remove("a")
    assert (sender.turn(), sender.notified) == (([], {}), 0)


# Static frames.


def test_the_newest_sample_of_each_static_frame_is_kept_alone_with_its_origin_and_number() -> None:
    sender = Sender()
    newest = static("world", "s", 3.0, authority="calibration")
    sender.add(static("map", "s", 1.0), moving("map", "a", 1), static("map", "t"))
    sender.add(moving("map", "b", 1), static("map", "s", 2.0), newest, origin=OTHER)
    statics = sender.outbox.flush().statics
    assert {frame: entry and contents(entry) for frame, entry in statics.items()} == {
        "s": (newest,),
        "t": (static("map", "t"),),
    }
    kept = statics["s"]
    assert isinstance(kept, OutgoingBatch)
    assert (kept.origin, kept.sequence) == (OTHER, 2)
    assert sender.kept() == {}


def test_a_static_frame_that_turns_moving_is_not_kept_any_more() -> None:
    sender = Sender()
    sender.add(static("map", "s"), static("map", "t"))
    assert sender.kept() == {"s": (static("map", "s"),), "t": (static("map", "t"),)}
    sender.add(moving("map", "s", 1))
    sender.add(static("map", "t", 2.0), moving("map", "t", 1))
    assert sender.kept() == {"s": None, "t": None}
    sender.add(moving("map", "s", 2))
    sender.remove("s")
    assert sender.kept() == {}
    sender.add(static("map", "s"), moving("map", "s", 3), static("map", "s", 4.0))
    assert sender.kept() == {"s": (static("map", "s", 4.0),)}


def test_a_removed_static_frame_leaves_a_tombstone_and_a_moving_one_leaves_none() -> None:
    sender = Sender()
    sender.add(static("map", "s"), moving("map", "a", 1))
    sender.kept()
    sender.remove("s")
    sender.remove("a")
    assert sender.kept() == {"s": RemovedFrame(ORIGIN, 2, "s")}
    sender.remove("s")
    assert sender.kept() == {}
    sender.add(static("map", "s", 5.0))
    assert sender.kept() == {"s": (static("map", "s", 5.0),)}


def test_the_loss_of_a_static_frame_is_a_tombstone_for_all_links_but_the_one_that_lost_it() -> None:
    for echo in (False, True):
        sender = Sender()
        sender.add(static("map", "s"))
        sender.kept()
        sender.remove("s", lost=True, echo=echo)
        loss = RemovedFrame(ORIGIN, 2, "s", lost=True)
        assert sender.turn() == ([] if echo else [loss], {"s": None if echo else loss})


def test_an_echo_does_not_go_out_and_replaces_what_is_kept() -> None:
    sender = Sender()
    sender.add(static("map", "s"), static("map", "t"), static("map", "u"))
    sender.kept()
    sender.notified = 0
    theirs = static("map", "s", 7.0)
    sender.add(theirs, moving("map", "t", 1), static("map", "new"), moving("map", "a", 1), origin=OTHER, echo=True)
    sender.remove("u", origin=OTHER, echo=True)
    assert (sender.notified, sender.outbox.pending) == (2, 0)
    assert sender.turn() == ([], {"s": (theirs,), "t": None, "u": RemovedFrame(OTHER, 3, "u")})
    assert not any(map(sender.outbox.state.brings, ("s", "t", "u", "new", "a"))), "another link brings them"
    sender.add(static("map", "s", 8.0), origin=OTHER, echo=True)
    assert sender.notified == 3
    # Not brought any more, but still kept for late joiners.
    sender.add(moving("map", "s", 9), origin=OTHER, echo=True)
    assert (sender.notified, sender.kept()) == (4, {"s": None})


def test_a_frame_that_another_link_brings_now_is_released_with_the_number_of_what_is_lost() -> None:
    sender = Sender()
    sender.add(static("map", "s"), moving("map", "a", 1))
    sender.add(static("map", "s"), static("map", "a"), origin=OTHER, echo=True)
    state = sender.outbox.state
    assert state.entry("s") == RemovedFrame(ORIGIN, 1, "s", lost=True)
    # A moving frame is in the state without a number.
    assert state.entry("a") == RemovedFrame(bytes(16), 0, "a", lost=True)


def test_a_turn_tells_what_it_changes_of_the_state_unless_an_echo_has_changed_it() -> None:
    sender = Sender()
    turns: list[Callable[[], None]] = [
        lambda: sender.add(moving("map", "a", 1), static("map", "s")),
        lambda: sender.add(moving("map", "a", 2)),
        lambda: sender.remove("s"),
        lambda: sender.add(static("map", "a"), origin=OTHER, echo=True),
        lambda: sender.add(moving("map", "a", 4)),
    ]
    steps = []
    for add in turns:
        add()
        step = sender.outbox.flush().step
        assert step is not None
        steps.append((step.since, step.number))
    # By the fourth, another link brings "a", which no entry tells: peers are to ask.
    assert steps == [(0, 2), (2, 2), (2, 3), (4, 4), (4, 5)]


def test_an_echo_of_frames_that_are_not_kept_notifies_nobody() -> None:
    sender = Sender()
    sender.add(static("map", "s"))
    sender.kept()
    sender.notified = 0
    sender.add(static("map", "t"), moving("map", "a", 1), echo=True)
    sender.remove("t", echo=True)
    sender.remove("a", echo=True)
    assert (sender.notified, sender.outbox.pending, sender.turn()) == (0, 0, ([], {}))
    assert sender.outbox.state.entry("t") is None


def test_a_removal_of_a_frame_that_the_link_never_brought_is_told_to_late_joiners_too() -> None:
    sender = Sender()
    sender.remove("unknown")
    assert sender.outbox.state.entry("unknown") == RemovedFrame(ORIGIN, 1, "unknown")
    assert sender.notified == 1


@given(
    st.lists(
        st.tuples(
            st.sampled_from(("static", "moving", "remove", "lose", "flush")), st.sampled_from("ab"), st.booleans()
        ),
        max_size=30,
    )
)
def test_what_is_kept_is_the_last_sample_that_was_sent_or_came_behind_it(steps: list[tuple[str, str, bool]]) -> None:
    sender = Sender()
    model: dict[str, TransformStamped | None] = {}
    kept: Kept = {}
    for number, (step, frame, echo) in enumerate(steps):
        if step == "flush":
            kept |= sender.kept()
        elif step == "static":
            sample = static("map", frame, float(number))
            sender.add(sample, echo=echo)
            if not echo or model.get(frame):
                model[frame] = sample
        else:
            model[frame] = None
            if step == "moving":
                sender.add(moving("map", frame, number), echo=echo)
            else:
                sender.remove(frame, lost=step == "lose", echo=echo)
    kept |= sender.kept()
    for frame in "ab":
        last, expected = kept.get(frame), model.get(frame)
        assert (None if isinstance(last, RemovedFrame) else last) == (None if expected is None else (expected,))

from tfbus.links._entries import MovingFrame, RemovedFrame
from tfbus.links._mirror import Mirror
from tfbus.links._state import StateStep, digest_moving, digest_static

ORIGIN = b"0123456789abcdef"
S = digest_static("s", ORIGIN, 7)
M = digest_moving("m")


def test_live_messages_without_a_gap_are_all_that_is_needed() -> None:
    mirror = Mirror(10)
    assert not mirror.agrees, "nobody knows what was before"
    mirror.static("s", ORIGIN, 7)
    mirror.claimed(StateStep(0, 1, S))
    assert (mirror.agrees, mirror.number) == (True, 1)
    mirror.moving("m")
    mirror.claimed(StateStep(1, 2, S ^ M))
    assert mirror.agrees
    mirror.entry(RemovedFrame(ORIGIN, 9, "s"))
    mirror.claimed(StateStep(2, 3, M))
    mirror.claimed(StateStep(3, 3, M))
    assert (mirror.agrees, mirror.number, "s" in mirror, "m" in mirror) == (True, 3, False, True)


def test_a_step_that_begins_behind_what_was_told_shows_a_gap() -> None:
    mirror = Mirror(10)
    mirror.claimed(StateStep(0, 0, 0))
    # The tombstone of a frame that is not in the digest.
    mirror.claimed(StateStep(1, 1, 0))
    assert (mirror.agrees, mirror.asks()) == (False, 0)
    mirror.answered(StateStep(0, 1, 0))
    assert (mirror.agrees, mirror.number) == (True, 1)


def test_a_message_of_a_turn_that_is_missing_makes_its_claim_void_but_not_the_next_one() -> None:
    mirror = Mirror(10)
    mirror.claimed(StateStep(0, 0, 0))
    mirror.lost_message()
    mirror.claimed(StateStep(0, 2, 0))
    assert (mirror.agrees, mirror.number) == (False, 0)
    mirror.answered(StateStep(0, 2, 0))
    mirror.moving("m")
    mirror.claimed(StateStep(2, 3, M))
    assert mirror.agrees


def test_a_missing_message_of_moving_samples_is_no_reason_to_ask() -> None:
    mirror = Mirror(10)
    mirror.moving("m")
    mirror.claimed(StateStep(0, 1, M))
    mirror.lost_message()
    mirror.claimed(StateStep(1, 1, M))
    assert mirror.agrees


def test_a_digest_that_differs_makes_it_ask_for_everything() -> None:
    mirror = Mirror(10)
    mirror.static("s", ORIGIN, 6)
    mirror.claimed(StateStep(0, 1, S))
    assert (mirror.agrees, mirror.asks()) == (False, 0)
    mirror.begins_anew()
    mirror.static("s", ORIGIN, 7)
    mirror.answered(StateStep(0, 1, S))
    assert (mirror.agrees, mirror.take_whole(), mirror.take_whole()) == (True, True, False)


def test_what_comes_live_between_a_question_and_its_answer_is_asked_for_again() -> None:
    mirror = Mirror(10)
    assert mirror.asks() == 0
    mirror.moving("m")
    mirror.claimed(StateStep(1, 2, S ^ M))
    # The answer is older than that.
    mirror.begins_anew()
    mirror.static("s", ORIGIN, 7)
    mirror.answered(StateStep(0, 1, S))
    assert (mirror.agrees, mirror.asks()) == (False, 1)
    mirror.entry(MovingFrame("m"))
    mirror.answered(StateStep(1, 2, S ^ M))
    assert mirror.agrees
    assert {"m", "s"} == {frame for frame in "ms" if frame in mirror}


def test_an_answer_in_parts_agrees_with_the_last_one() -> None:
    mirror = Mirror(10)
    mirror.begins_anew()
    mirror.static("s", ORIGIN, 7)
    mirror.answered(StateStep(0, 1, 0, final=False))
    assert (mirror.agrees, mirror.asks()) == (False, 1)
    mirror.moving("m")
    mirror.answered(StateStep(1, 2, S ^ M))
    assert mirror.agrees


def test_a_claim_that_was_overtaken_changes_nothing() -> None:
    mirror = Mirror(10)
    mirror.moving("m")
    mirror.claimed(StateStep(0, 5, M))
    mirror.claimed(StateStep(0, 4, S))
    assert (mirror.agrees, mirror.number) == (True, 5)


def test_a_number_that_somebody_has_made_up_is_forgotten_when_the_peer_itself_answers() -> None:
    mirror = Mirror(10)
    mirror.claimed(StateStep(900, 900, 1))
    mirror.asks()
    mirror.begins_anew()
    mirror.moving("m")
    mirror.answered(StateStep(0, 1, M))
    assert mirror.agrees
    mirror.claimed(StateStep(1, 1, M))
    assert mirror.agrees


def test_a_frame_that_changes_its_kind_counts_once() -> None:
    mirror = Mirror(10)
    mirror.moving("s")
    mirror.static("s", ORIGIN, 7)
    assert not mirror.has_moving("s")
    mirror.claimed(StateStep(0, 2, S))
    assert mirror.agrees
    mirror.moving("s")
    assert mirror.has_moving("s")
    mirror.gone("s")
    mirror.gone("s")
    assert not mirror.has_moving("s")
    mirror.claimed(StateStep(2, 4, 0))
    assert mirror.agrees


def test_a_peer_with_too_many_frames_overfills_it_until_it_tells_all_anew() -> None:
    mirror = Mirror(2)
    for frame in "aba":
        mirror.moving(frame)
    assert not mirror.overfull
    mirror.moving("c")
    assert (mirror.overfull, "c" in mirror) == (True, False)
    assert mirror.has_moving("b")
    mirror.begins_anew()
    assert not mirror.overfull
    assert not mirror.has_moving("b"), "what it brings is all to be told again"

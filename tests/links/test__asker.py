from random import Random

import pytest

from tfbus.links._asker import (
    FIRST_PAUSE,
    LONGEST_PATIENCE,
    LONGEST_PAUSE,
    MOST_OPEN,
    PATIENCE,
    PATIENCE_EACH,
    SETTLING,
    Asker,
)


class Scene:
    def __init__(self) -> None:
        self.time = 100.0
        self.asker = Asker(lambda: self.time, Random(1))

    def wait(self) -> float:
        """Let time pass until the asker has something to do; returns how long that was."""
        due = self.asker.next_due()
        assert due is not None
        waited = due - self.time
        self.time = due
        return waited


def test_a_new_peer_is_asked_at_once_and_one_that_has_missed_something_a_little_later() -> None:
    scene = Scene()
    assert scene.asker.next_due() is None
    assert scene.asker.want("new", at_once=True)
    assert scene.asker.take_due() == ["new"]
    assert scene.asker.want("late")
    assert not scene.asker.want("late"), "it is known already"
    assert scene.asker.take_due() == []
    assert 0.5 * SETTLING <= scene.wait() <= 1.5 * SETTLING
    assert scene.asker.take_due() == ["late"]


def test_a_question_that_live_messages_have_answered_is_never_asked() -> None:
    scene = Scene()
    scene.asker.want("a")
    scene.asker.satisfied("a")
    assert scene.asker.next_due() is None


def test_pauses_double_up_to_the_longest_and_have_a_jitter() -> None:
    scene = Scene()
    scene.asker.want("a", at_once=True)
    scene.asker.take_due()
    waits = []
    for _ in range(10):
        scene.asker.failed("a")
        waits.append(scene.wait())
        assert scene.asker.take_due() == ["a"]
    expected = [min(FIRST_PAUSE * 2**k, LONGEST_PAUSE) for k in range(10)]
    ratios = [wait / mean for wait, mean in zip(waits, expected, strict=True)]
    assert all(0.5 <= ratio <= 1.5 for ratio in ratios)
    assert len(set(ratios)) == 10
    scene.asker.progressed("a")
    assert scene.asker.take_due() == ["a"], "progress is followed by the next question at once"
    scene.asker.failed("a")
    assert scene.wait() <= 1.5 * FIRST_PAUSE


def test_a_question_without_an_answer_is_asked_again() -> None:
    scene = Scene()
    scene.asker.want("a", at_once=True)
    scene.asker.take_due()
    assert scene.wait() == pytest.approx(PATIENCE)
    assert scene.asker.take_due() == []
    assert scene.wait() <= 1.5 * FIRST_PAUSE
    assert scene.asker.take_due() == ["a"]


def test_a_peer_that_has_no_time_is_given_ever_more() -> None:
    scene = Scene()
    scene.asker.want("a", at_once=True)
    patience = PATIENCE
    for _ in range(6):
        assert scene.asker.take_due() == ["a"]
        assert scene.wait() == pytest.approx(patience)
        patience = min(2 * patience, LONGEST_PATIENCE)
        assert scene.asker.take_due() == []
        scene.wait()
    assert patience == LONGEST_PATIENCE
    # An answer that is of no use is an answer.
    scene.asker.take_due()
    scene.asker.progressed("a")
    scene.asker.take_due()
    scene.asker.failed("a")
    scene.wait()
    assert scene.asker.take_due() == ["a"]
    assert scene.wait() == pytest.approx(PATIENCE)


def test_peers_that_are_asked_with_many_others_have_more_time() -> None:
    scene = Scene()
    scene.asker.want("first", at_once=True)
    scene.asker.take_due()
    others = [f"{number}" for number in range(20)]
    for name in others:
        scene.asker.want(name, at_once=True)
    assert scene.asker.take_due() == others
    assert scene.wait() == pytest.approx(PATIENCE), "the first one was asked alone"
    scene.asker.satisfied("first")
    assert scene.wait() == pytest.approx(20 * PATIENCE_EACH)


def test_so_many_questions_are_open_at_once_and_no_more() -> None:
    scene = Scene()
    for number in range(MOST_OPEN + 2):
        scene.asker.want(f"{number}", at_once=True)
    assert len(scene.asker.take_due()) == MOST_OPEN
    assert scene.asker.take_due() == []
    due = scene.asker.next_due()
    assert due is not None
    assert due > scene.time, "those that have to wait are no reason to look again"
    scene.asker.satisfied("0")
    assert scene.asker.take_due() == [f"{MOST_OPEN}"]
    # An answer to a question that nobody has asked changes nothing.
    scene.asker.failed("nobody")
    assert len(scene.asker.take_due()) == 0

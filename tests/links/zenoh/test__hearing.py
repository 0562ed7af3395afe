from random import Random

from tfbus.links.zenoh._hearing import (
    DEAF,
    FIRST_PAUSE,
    LONGEST_PAUSE,
    MOST_SILENT,
    SECOND_PAUSE,
    SETTLED_PAUSE,
    Hearing,
)


class Scene:
    def __init__(self) -> None:
        self.time = 50.0
        self.hearing = Hearing(lambda: self.time, Random(1))

    def wait(self, seconds: float) -> list[str]:
        self.time += seconds
        return self.hearing.take_due()

    def until_due(self) -> float:
        began = self.time
        while not self.wait(0.01):
            assert self.time < began + 2 * LONGEST_PAUSE
        return self.time - began


def is_about(measured: float, seconds: float) -> bool:
    return 0.8 * seconds <= measured <= 1.2 * seconds + 0.02


def test_a_peer_is_asked_soon_and_then_ever_more_seldom_until_it_leaves() -> None:
    scene = Scene()
    assert scene.wait(1_000) == []
    assert scene.hearing.next_due() is None
    scene.hearing.joined("a")
    assert scene.wait(0) == []
    pause = FIRST_PAUSE
    for _ in range(6):
        assert is_about((scene.hearing.next_due() or 0.0) - scene.time, pause)
        assert is_about(scene.until_due(), pause)
        assert not scene.hearing.is_deaf("a", hears=True)
        pause = min(2 * pause, LONGEST_PAUSE)
    scene.hearing.left("a")
    assert scene.wait(1_000) == []
    assert not scene.hearing.is_deaf("a", hears=False)


def test_a_peer_is_asked_no_later_than_it_is_due() -> None:
    scene = Scene()
    scene.hearing.joined("a")
    for _ in range(3):
        scene.time = scene.hearing.next_due() or 0.0
        assert scene.hearing.take_due() == ["a"]
        assert scene.hearing.take_due() == []


def test_one_answer_that_it_hears_nothing_is_no_proof_and_several_in_a_row_are() -> None:
    scene = Scene()
    scene.hearing.joined("a")
    scene.until_due()
    for _ in range(3):
        assert [scene.hearing.is_deaf("a", hears=False) for _ in range(DEAF - 1)] == [False] * (DEAF - 1)
        assert is_about(scene.until_due(), SECOND_PAUSE)
        assert not scene.hearing.is_deaf("a", hears=True)
    # Again and again, with time in between for a remedy.
    for _ in range(3):
        assert [scene.hearing.is_deaf("a", hears=False) for _ in range(DEAF)] == [False] * (DEAF - 1) + [True]
        assert is_about(scene.until_due(), 2 * FIRST_PAUSE)


def test_a_peer_that_comes_back_is_asked_anew() -> None:
    scene = Scene()
    scene.hearing.joined("a")
    for _ in range(5):
        scene.until_due()
    scene.hearing.is_deaf("a", hears=False)
    scene.hearing.joined("a")
    assert is_about(scene.until_due(), FIRST_PAUSE)
    assert not scene.hearing.is_deaf("a", hears=False)


def test_a_peer_that_never_answers_is_taken_for_deaf_a_few_times_only() -> None:
    scene = Scene()
    assert not scene.hearing.is_silent("a")
    scene.hearing.joined("a")
    scene.until_due()
    for _ in range(2):
        verdicts = [scene.hearing.is_silent("a") for _ in range(DEAF * (MOST_SILENT + 2))]
        assert verdicts == ([False] * (DEAF - 1) + [True]) * MOST_SILENT + [False] * 2 * DEAF
        scene.hearing.joined("a")


def test_silence_is_no_reason_to_ask_more_often() -> None:
    scene = Scene()
    scene.hearing.joined("a")
    pause = FIRST_PAUSE
    for _ in range(2 * DEAF * MOST_SILENT):
        assert is_about(scene.until_due(), pause)
        scene.hearing.is_silent("a")
        pause = min(2 * pause, LONGEST_PAUSE)


def test_a_peer_that_tells_by_itself_that_it_hears_need_not_be_asked_soon() -> None:
    scene = Scene()
    scene.hearing.is_heard("a")
    assert scene.wait(1_000) == []
    scene.hearing.joined("a")
    scene.until_due()
    scene.hearing.is_deaf("a", hears=False)
    scene.hearing.is_heard("a")
    assert is_about(scene.until_due(), SETTLED_PAUSE)
    assert not scene.hearing.is_deaf("a", hears=False), "it was heard in between"
    for _ in range(3):
        scene.hearing.is_heard("a")
        assert not scene.hearing.is_deaf("a", hears=True)
    assert is_about(scene.until_due(), SETTLED_PAUSE)
    # Seldom stays seldom.
    scene.until_due()
    scene.until_due()
    before = scene.time
    scene.hearing.is_heard("a")
    assert scene.time - before + scene.until_due() > 2 * SETTLED_PAUSE

"""The copies of the map against a plain model, and the questions by which they come to agree."""

import random
from collections.abc import Iterable
from contextlib import suppress

import pytest
from support.samples import moving, static

from tfbus import TransformStamped
from tfbus.links.replica import (
    CHUNK,
    MANY_ORIGINS,
    MOST_REMEMBERED,
    MOST_REMOVALS,
    PATIENCE,
    SETTLING,
    Agreement,
    Claim,
    OutgoingBatch,
    Provenance,
    Question,
    RemovedFrame,
    Replica,
    TooManyEntriesError,
    View,
)

OTHER = b"another bus....."
Model = dict[str, tuple[int, bytes]]


class Copy(View):
    """A copy of the map with one view."""

    def __init__(self, max_frames: int = 100) -> None:
        self.replica = Replica()
        self._max_frames = max_frames
        super().__init__(self.replica)

    @property
    def ranks(self) -> Model:
        return {frame: known.source.rank for frame, known in self.replica.entries.items()}

    def note(
        self, frame: str, rank: tuple[int, bytes], sample: TransformStamped | None, *, settles: bool = False
    ) -> bool:
        number, origin = rank
        most = self._max_frames
        return self.replica.note(
            frame, Provenance(origin, number), sample, self.route, max_frames=most, settles=settles
        )


def filled(frames: Iterable[str], number: int = 1) -> Copy:
    copy = Copy()
    for frame in frames:
        copy.note(frame, (number, OTHER), static("map", frame))
    return copy


def test_a_frame_that_moves_all_the_time_is_not_in_the_digest_until_it_rests() -> None:
    copy, still = filled("a"), filled("a")
    for step in range(100):
        copy.note("m", (2 + step, OTHER), moving("map", "m", step), settles=True)
        assert copy.claim(step * 0.1).digest == still.claim(0.0).digest
    # It is told to who asks, settled or not.
    assert len(copy.changes(0, 10.0)[0]) == 2
    rested = copy.claim(9.9 + SETTLING)
    still.note("m", (101, OTHER), moving("map", "m", 99))
    assert rested.digest == still.claim(20.0).digest


def test_of_two_samples_of_one_batch_the_newer_is_held() -> None:
    copy = Copy()
    assert copy.note("a", (1, OTHER), moving("map", "a", 5))
    assert not copy.note("a", (1, OTHER), moving("map", "a", 4))
    assert copy.note("a", (1, OTHER), moving("map", "a", 6))
    assert not copy.note("a", (1, OTHER), None)


def test_removals_take_no_room_of_frames_and_all_origins_together_have_a_bound() -> None:
    copy = Copy(2)
    for number in range(3 * MANY_ORIGINS):
        for sample in (static("map", f"{number}"), None):
            copy.note(f"{number}", (2 * number + (sample is None), OTHER), sample)
    copy.note("a", (10**6, OTHER), static("map", "a"))
    copy.note("b", (10**6, OTHER), static("map", "b"))
    for _ in range(100):
        with pytest.raises(TooManyEntriesError):
            copy.note("0", (10**6, OTHER), static("map", "0"))
    taken = 2
    for number in range(50):
        with suppress(TooManyEntriesError):
            taken += copy.note(f"of {number}", (1, number.to_bytes(16, "big")), static("map", f"of {number}"))
    assert taken == 2 * MANY_ORIGINS
    for number in range(MOST_REMOVALS + 1):
        copy.note(f"more {number}", (10**6 + number, OTHER), None)
    assert len(copy.ranks) == MOST_REMOVALS + taken


def test_copies_forget_the_same_removals_in_whatever_order_they_come() -> None:
    removals = [(f"f{number}", (number, OTHER)) for number in range(MOST_REMOVALS + 2_000)]
    copies = []
    for seed in range(2):
        copy = Copy()
        random.Random(seed).shuffle(removals)
        for place, (frame, rank) in enumerate(removals):
            copy.note(frame, rank, None)
            if place % 1_000 == seed:
                copy.claim(place)
        copies.append(copy)
    expected = {f"f{number}" for number in range(2_000, MOST_REMOVALS + 2_000)}
    assert [set(copy.ranks) for copy in copies] == [expected, expected]
    assert copies[0].claim(1e6).digest == copies[1].claim(1e6).digest
    told = set()
    claim = Claim(0, 0, 0, final=False)
    while not claim.final:
        chunk, claim = copies[0].changes(claim.sequence, 1e6)
        told |= {entry.frame for entry in chunk if isinstance(entry, RemovedFrame)}
    assert told == expected


def test_views_of_one_copy_agree_with_copies_of_their_own_frames_and_a_frame_that_is_brought_on_stays() -> None:
    both, left, right = Replica(), filled(["l", "x"]), filled(["r", "x"])
    views = View(both), View(both)
    for view, frame in zip((*views, *views), ("l", "r", "x", "x"), strict=True):
        before = both.sequence
        both.note(frame, Provenance(OTHER, 1), static("map", frame), view.route)
        # Also a frame that the other view has is told since then.
        assert len(view.changes(before, 0.0)[0]) == 1
    assert [view.claim(0.0).digest for view in views] == [copy.claim(0.0).digest for copy in (left, right)]
    both.note("x", Provenance(OTHER, 2), static("map", "x"), views[0].route)
    for copy in (left, right):
        copy.note("x", (2, OTHER), static("map", "x"))
    assert [view.claim(0.0).digest for view in views] == [copy.claim(0.0).digest for copy in (left, right)]
    assert [len(view.changes(0, 0.0)[0]) for view in views] == [2, 2]
    both.narrow([views[0]], keep_removals=True)
    assert set(both.entries) == {"r", "x"}
    assert views[1].claim(0.0).digest == right.claim(0.0).digest


# The next question


class Asker:
    """One link that follows the copies of some peers, which a test fills."""

    def __init__(self, *peers: str) -> None:
        random.seed(1)
        self.now = 0.0
        self.is_behind = False
        self.copy = Copy(1_000)
        self.agreement = Agreement()
        self.peers = {peer: Copy(1_000) for peer in peers}
        self.number = 0
        for peer in peers:
            self.agreement.joined(peer, self.copy, self.now)

    def say(self, *peers: str, heard: bool = True) -> None:
        """Some peers hold a new entry; the link hears it live, or does not."""
        self.number += 1
        frame, rank = f"f{self.number}", (self.number, OTHER)
        for copy in [self.peers[peer] for peer in peers] + [self.copy] * heard:
            copy.note(frame, rank, static("map", frame))

    def sign(self, peer: str) -> None:
        self.agreement.told(peer, self.peers[peer].claim(self.now), self.now)

    def next_question(self, within: float = 1e6) -> Question | None:
        """Let time pass until there is a question."""
        end = self.now + within
        while (question := self.agreement.question(self.now, self.is_behind)) is None:
            if self.agreement.next_due() > end:
                self.now = end
                return None
            self.now = max(self.now, self.agreement.next_due())
        return question

    def answer(self, question: Question, limit: int = CHUNK) -> Claim:
        told, claim = self.peers[question.peer].changes(question.since, self.now, limit=limit)
        news = [self.copy.note(frame, rank, static("map", frame)) for frame, rank in map(self._rank, told)]
        self.agreement.answered(question.peer, claim, any(news), self.now)
        return claim

    @staticmethod
    def _rank(told: OutgoingBatch | RemovedFrame) -> tuple[str, tuple[int, bytes]]:
        assert isinstance(told, OutgoingBatch)
        return told.samples[0].child, (told.sequence, told.origin)


def test_a_peer_that_comes_back_is_asked_for_what_is_new() -> None:
    link = Asker("a")
    link.say("a", heard=False)
    link.answer(link.next_question() or Question("", 0))
    link.agreement.left("a")
    link.say("a", heard=False)
    link.agreement.joined("a", link.copy, link.now)
    link.sign("a")
    question = link.next_question()
    assert question == Question("a", 1)
    link.answer(question)
    # It may have begun anew meanwhile.
    link.agreement.left("a")
    link.peers["a"] = Copy(10)
    link.say("a", heard=False)
    link.agreement.joined("a", link.copy, link.now, must_ask=True)
    question = link.next_question()
    assert question == Question("a", 2)
    assert link.answer(question).since == 0
    assert link.copy.ranks.items() >= link.peers["a"].ranks.items()
    for number in range(MOST_REMEMBERED + 1):
        link.agreement.joined(f"{number}", link.copy, link.now, must_ask=True)
        asked = link.next_question()
        assert asked is not None
        link.agreement.answered(asked.peer, Claim(0, 5, 0), True, link.now)
        link.agreement.left(asked.peer)
    for peer, since in (("0", 0), ("1", 5), (f"{MOST_REMEMBERED}", 5)):
        link.agreement.joined(peer, link.copy, link.now, must_ask=True)
        assert link.next_question() == Question(peer, since)
        link.agreement.left(peer)


def pauses(link: Asker, times: int, end: str) -> list[float]:
    """The times from the end of one question to the next, if none is of use."""
    found = []
    for _ in range(times):
        before = link.now
        link.sign("a")
        question = link.next_question()
        assert question is not None
        found.append(link.now - before)
        if end == "unanswered":
            link.agreement.unanswered("a", link.now)
        elif end == "late":
            link.now += PATIENCE
            assert link.agreement.question(link.now) is None
        else:
            # Its answer contradicts its claim.
            sequence = link.peers["a"].claim(link.now).sequence
            link.agreement.answered("a", Claim(question.since, sequence, 1), False, link.now)
            link.say("a", heard=False)
    return found


@pytest.mark.parametrize("end", ["unanswered", "late", "fruitless"])
def test_a_peer_whose_answers_are_of_no_use_is_asked_ever_less_often(end: str) -> None:
    link = Asker("a")
    if end == "fruitless":
        link.say("a", heard=False)
        link.answer(link.next_question() or Question("", 0))
        link.say("a", heard=False)
    found = pauses(link, 15, end)
    if end == "fruitless":
        assert all(0.3 * 2**count <= pause or pause > 59.9 for count, pause in enumerate(found))
        assert 59.9 < max(found) < 60.1
    else:
        # A sign shows that it lives, so it is asked again soon.
        assert max(found) < 0.21


def test_a_silent_peer_without_a_sign_of_life_is_asked_ever_less_often_and_others_meanwhile() -> None:
    link = Asker("a")
    found = []
    for _ in range(12):
        before = link.now
        assert link.next_question() == Question("a", 0)
        found.append(link.now - before)
        link.agreement.unanswered("a", link.now)
    assert found[0] == 0.0
    assert all(0.6 * 2**count <= pause or pause > 59.9 for count, pause in enumerate(found[1:]))
    assert 59.9 < max(found) < 60.1
    link.agreement.joined("b", link.copy, link.now, must_ask=True)
    assert link.next_question(0.0) == Question("b", 0)


def test_a_peer_that_still_fetches_the_copies_of_others_is_asked_once_it_has_them_or_after_ten_seconds() -> None:
    link = Asker("a", "b")
    link.answer(link.next_question(0.0) or Question("", 0))
    link.say("b", heard=False)
    for _ in range(3):
        link.agreement.told("b", link.peers["b"].claim(link.now)._replace(final=False), link.now)
        assert link.next_question(3.0) is None
    assert link.next_question(1.1) == Question("b", 0)
    link.answer(Question("b", 0))
    link.say("b", heard=False)
    link.agreement.told("b", link.peers["b"].claim(link.now)._replace(final=False), link.now)
    link.sign("b")
    assert link.next_question(0.7) == Question("b", 1)


@pytest.mark.parametrize("end", ["answers", "leaves", "is heard live"])
def test_a_link_fetches_until_it_has_the_last_answer_or_needs_it_no_more(end: str) -> None:
    link = Asker("a", "b")
    link.answer(link.next_question(0.0) or Question("", 0))
    for _ in range(3):
        link.say("a", heard=False)
    link.sign("a")
    link.answer(link.next_question() or Question("", 0), limit=2)
    assert link.agreement.fetches
    match end:
        case "answers":
            link.answer(link.next_question(0.0) or Question("", 0))
        case "leaves":
            link.agreement.left("a")
        case "is heard live":
            link.copy.note("f3", (3, OTHER), static("map", "f3"))
            link.sign("a")
            assert link.next_question() is None
    assert not link.agreement.fetches


def test_a_link_that_is_behind_asks_only_the_first_question_at_once_and_one_in_ten_seconds() -> None:
    link = Asker("a", "b")
    link.is_behind = True
    link.say("a", heard=False)
    link.answer(link.next_question(0.0) or Question("", 0))
    for peer in ("a", "b"):
        link.say(peer, heard=False)
        link.sign(peer)
        link.agreement.missed(peer, link.now)
    asked = []
    for _ in range(2):
        asked_from = link.now
        question = link.next_question()
        assert question is not None
        assert 9.9 <= link.now - asked_from <= 10.5
        link.answer(question)
        asked.append(question.peer)
    assert sorted(asked) == ["a", "b"]

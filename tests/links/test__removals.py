import pytest

from tfbus.links._outbox import Outbox
from tfbus.links._peers import Peer
from tfbus.links._provenance import Provenance
from tfbus.links._removals import Removals

A, B = b"a" * 16, b"b" * 16
OUTBOX = Outbox(None, lambda: None)


def word(sequence: int, peer: Peer, lost: bool = False, origin: bytes = A, live: bool = True) -> Provenance:
    return Provenance(origin, sequence, OUTBOX, peer, live, lost)


def test_a_removal_outdates_what_was_said_before_it_by_whomever_and_nothing_after_it() -> None:
    removals = Removals()
    peer = Peer("p")
    removals.gone(A, "s", 5, word(7, peer, origin=B))
    removals.gone(B, "s", 7, word(7, peer, origin=B))
    removals.remove("s", word(7, peer, origin=B))
    later = Peer("p")
    assert [removals.is_late(word(number, later), "s") for number in (4, 5, 6)] == [True, True, False]
    assert [removals.is_late(word(number, later, origin=B), "s") for number in (7, 8)] == [True, False]
    assert not removals.is_late(word(1, later), "other")
    assert not removals.was_lost(word(5, later), "s")
    assert removals.rank("s") == (7, B) < (7, b"c" * 16)
    assert removals.rank("other") < (0, bytes(16))


def test_what_was_lost_is_news_again_from_the_teller_and_from_peers_met_later() -> None:
    removals = Removals()
    old, teller = Peer("old"), Peer("teller")
    removals.gone(A, "s", 5, word(9, teller, lost=True, origin=B))
    later = Peer("old")
    assert [removals.is_late(word(5, peer), "s") for peer in (old, teller, later)] == [True, False, False]
    assert [removals.is_late(word(4, peer), "s") for peer in (old, teller, later)] == [True] * 3
    assert not removals.is_late(word(6, old), "s")
    assert removals.was_lost(word(5, old), "s")
    assert removals.ranks == {}


def test_what_was_lost_with_the_peer_that_brought_it_is_news_from_peers_met_later_only() -> None:
    removals = Removals()
    peer = Peer("p")
    removals.gone(A, "s", 5)
    assert removals.is_late(word(5, peer), "s")
    assert removals.was_lost(word(5, peer), "s")
    assert not removals.is_late(word(5, Peer("p")), "s")


def test_of_two_removals_of_samples_of_one_origin_that_of_the_newer_sample_is_remembered() -> None:
    removals = Removals()
    peer = Peer("p")
    removals.gone(A, "s", 5, word(9, peer))
    removals.gone(A, "s", 4, word(10, peer, lost=True))
    assert removals.is_late(word(5, Peer("q")), "s")
    assert not removals.was_lost(word(5, peer), "s")
    removals.gone(A, "s", 5, word(11, peer, lost=True))
    assert not removals.is_late(word(5, Peer("q")), "s")


def test_of_very_many_removals_the_first_are_forgotten_and_one_that_is_repeated_is_the_last() -> None:
    removals = Removals()
    peer = Peer("p")
    unknown = removals.rank("unknown")
    for number in range(10_000):
        removals.remove(f"{number}", word(number, peer))
    assert removals.rank("0") == (0, A)
    removals.remove("0", word(20_000, peer))
    removals.remove("one more", word(20_001, peer))
    assert [removals.rank(frame) for frame in ("0", "1", "2")] == [(20_000, A), unknown, (2, A)]


@pytest.mark.parametrize("live", [True, False])
def test_of_the_removals_that_are_forgotten_the_highest_number_outdates_live_samples_of_unknown_frames(
    live: bool,
) -> None:
    removals = Removals()
    peer = Peer("p")
    for number in range(10_002):
        removals.gone(A, f"{number}", number, word(number, peer))
        removals.remove(f"{number}", word(number, peer))
    assert len(removals) == 20_001
    assert [removals.is_late(word(number, peer, live=live), "new") for number in (1, 2)] == [live, False]
    assert not removals.is_late(word(1, peer, live=live, origin=B), "new")
    removals.clear()
    assert len(removals) == 0
    assert not removals.is_late(word(1, peer, live=live), "new")


def test_the_numbers_of_a_limited_count_of_origins_outlive_the_removals() -> None:
    removals = Removals()
    peer = Peer("p")
    for number in range(11_002):
        removals.gone(b"%16d" % number, "s", 1)
    assert len(removals) == 11_000
    known = [removals.is_late(word(1, peer, origin=b"%16d" % number), "s") for number in (1, 2, 1_001, 1_002)]
    assert known == [False, True, True, True]

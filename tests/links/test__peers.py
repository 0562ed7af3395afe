import pytest
from tfbus.links._mirror import Mirror
from tfbus.links._peers import MAX_PEERS, Peer, Peers

Report = tuple[str, str, str]


def peers_and_reports() -> tuple[Peers, list[Report]]:
    reports: list[Report] = []
    return Peers(lambda peer, reason, error: reports.append((peer, reason, str(error)))), reports


def known(peers: Peers, name: str) -> Peer:
    peer = peers.find(name)
    assert peer is not None
    return peer


def test_a_peer_is_made_once_and_keeps_its_state() -> None:
    peers, _ = peers_and_reports()
    peer = known(peers, "a")
    peer.number = 7
    assert known(peers, "a") is peer
    assert known(peers, "b") is not peer
    assert (peer.id, peer.number, peer.present, peer.authorities, peer.frames) == ("a", 7, False, set(), set())


def test_only_peers_that_have_announced_themselves_are_present() -> None:
    peers, _ = peers_and_reports()
    for name in "cab":
        known(peers, name)
    assert list(peers.present) == []
    for name in "ca":
        known(peers, name).present = True
    assert list(peers.present) == ["a", "c"]
    peers.forget("c")
    assert list(peers.present) == ["a"]


def test_a_frame_is_brought_by_peers_that_have_told_so() -> None:
    peers, _ = peers_and_reports()
    first, second, _ = (known(peers, name) for name in "abc")
    first.mirror, second.mirror = Mirror(10), Mirror(10)
    assert not peers.brings("s", None)
    first.mirror.static("s", bytes(16), 1)
    assert [peers.brings("s", besides) for besides in (None, first, second)] == [True, False, True]
    second.mirror.moving("s")
    assert peers.brings("s", first)
    assert not peers.brings("t", None)
    peers.forget("b")
    assert not peers.brings("s", first)


def test_a_peer_that_comes_back_is_a_new_and_younger_one() -> None:
    peers, _ = peers_and_reports()
    first = known(peers, "a")
    assert peers.forget("a") is first
    assert peers.forget("a") is None
    again = known(peers, "a")
    assert again is not first
    assert again.age > first.age


def test_all_peers_can_be_forgotten_at_once() -> None:
    peers, _ = peers_and_reports()
    all_of_them = [known(peers, name) for name in "ab"]
    assert peers.forget_all() == all_of_them
    assert peers.forget_all() == []
    assert known(peers, "a") not in all_of_them


def test_peers_are_limited_in_number_and_one_that_goes_makes_room() -> None:
    peers, reports = peers_and_reports()
    for number in range(MAX_PEERS):
        known(peers, f"{number}")
    for _ in range(3):
        assert peers.find("one too many") is None
    assert peers.rejected == {"too many peers": 3}
    assert [report[:2] for report in reports] == [("one too many", "too many peers")]
    assert known(peers, "0").id == "0"
    peers.forget("0")
    assert known(peers, "one too many").id == "one too many"
    assert peers.find("0") is None


def test_an_announced_peer_evicts_the_first_unannounced_one() -> None:
    peers, _ = peers_and_reports()
    for number in range(MAX_PEERS):
        assert peers.make_room(f"{number}") is None
        known(peers, f"{number}").present = number == 0
    assert peers.make_room("0") is None
    assert peers.make_room("2") is None
    gone = peers.make_room("new")
    assert gone is not None
    assert gone.id == "1"
    assert known(peers, "new").id == "new"


def test_announced_peers_are_never_evicted() -> None:
    peers, _ = peers_and_reports()
    for number in range(MAX_PEERS):
        known(peers, f"{number}").present = True
    assert peers.make_room("new") is None
    assert peers.find("new") is None


def test_refusals_are_counted_each_time_and_reported_once_for_each_peer_and_reason() -> None:
    peers, reports = peers_and_reports()
    known(peers, "a")
    known(peers, "b")
    for text in ("first", "second"):
        for name in "ab":
            for reason in ("tags", "version"):
                peers.reject(name, reason, ValueError(text))
    peers.reject("a", "too many frames", ValueError("many"), 1_000)
    assert peers.rejected == {"tags": 4, "version": 4, "too many frames": 1_000}
    assert reports == [
        ("a", "tags", "first"),
        ("a", "version", "first"),
        ("b", "tags", "first"),
        ("b", "version", "first"),
        ("a", "too many frames", "many"),
    ]


def test_refusals_of_a_peer_that_comes_back_are_reported_again() -> None:
    peers, reports = peers_and_reports()
    for _ in range(2):
        known(peers, "a")
        peers.reject("a", "tags", ValueError())
        peers.forget("a")
    assert len(reports) == 2


@pytest.mark.parametrize("strangers", [1, 100_000])
def test_refusals_of_unknown_peers_are_reported_once_for_each_reason(strangers: int) -> None:
    peers, reports = peers_and_reports()
    for number in range(strangers):
        peers.reject(f"{number}", "version", ValueError())
    assert peers.rejected == {"version": strangers}
    assert len(reports) == 1
    assert peers.present == ()

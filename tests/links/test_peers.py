import pytest

from tfbus.links.peers import MAX_PEERS, Peer, Peers

Report = tuple[str, str, str]


def peers_and_reports() -> tuple[Peers, list[Report]]:
    reports: list[Report] = []
    return Peers(lambda peer, reason, error: reports.append((peer, reason, str(error)))), reports


def known(peers: Peers, name: str) -> Peer:
    peer = peers.find(name)
    assert peer is not None
    return peer


def test_a_peer_is_made_once_and_keeps_what_is_known_of_it() -> None:
    peers, _ = peers_and_reports()
    peer = known(peers, "a")
    peer.number = 7
    assert known(peers, "a") is peer
    assert known(peers, "b") is not peer
    assert (peer.id, peer.number, peer.present, peer.authorities, peer.frames) == ("a", 7, False, set(), set())


def test_only_those_who_have_said_so_are_present() -> None:
    peers, _ = peers_and_reports()
    for name in "cab":
        known(peers, name)
    assert list(peers.present) == []
    for name in "ca":
        known(peers, name).present = True
    assert list(peers.present) == ["a", "c"]
    peers.forget("c")
    assert list(peers.present) == ["a"]


def test_who_has_gone_and_comes_back_is_somebody_new() -> None:
    peers, _ = peers_and_reports()
    first = known(peers, "a")
    assert peers.forget("a") is first
    assert peers.forget("a") is None
    again = known(peers, "a")
    assert again is not first
    assert again.age > first.age


def test_everybody_can_be_forgotten_at_once() -> None:
    peers, _ = peers_and_reports()
    all_of_them = [known(peers, name) for name in "ab"]
    assert peers.forget_all() == all_of_them
    assert peers.forget_all() == []
    assert known(peers, "a") not in all_of_them


def test_there_is_room_for_so_many_peers_and_for_others_when_some_have_gone() -> None:
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


def test_who_says_that_he_is_there_takes_the_place_of_the_first_who_has_not() -> None:
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


def test_there_is_no_room_where_everybody_has_said_that_he_is_there() -> None:
    peers, _ = peers_and_reports()
    for number in range(MAX_PEERS):
        known(peers, f"{number}").present = True
    assert peers.make_room("new") is None
    assert peers.find("new") is None


def test_what_is_refused_is_counted_each_time_and_told_once_for_each_peer_and_reason() -> None:
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


def test_who_comes_back_is_told_of_again() -> None:
    peers, reports = peers_and_reports()
    for _ in range(2):
        known(peers, "a")
        peers.reject("a", "tags", ValueError())
        peers.forget("a")
    assert len(reports) == 2


@pytest.mark.parametrize("strangers", [1, 100_000])
def test_strangers_without_end_are_told_of_once_for_each_reason(strangers: int) -> None:
    peers, reports = peers_and_reports()
    for number in range(strangers):
        peers.reject(f"{number}", "version", ValueError())
    assert peers.rejected == {"version": strangers}
    assert len(reports) == 1
    assert peers.present == ()

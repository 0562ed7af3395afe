import math
from contextlib import suppress
from random import Random
from uuid import uuid4

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tfbus.links.zenoh._dialing import Dialing
from tfbus.links.zenoh._introductions import (
    FIRST_PAUSE,
    LONGEST_DELAY,
    LONGEST_PAUSE,
    MISSING_TIME,
    MOST_MISSING,
    MOST_NAMED,
    Introductions,
)
from tfbus.links.zenoh._keys import FIRST_SESSION, NO_ROBOT, Keys
from tfbus.links.zenoh._listening import Listening
from tfbus.links.zenoh._settings import settings
from tfbus.tf_message import MalformedMessageError


class End:
    """One link; `others` are those that it knows, each with its robot."""

    def __init__(self, *robots: str, domain: str = "tf", listen: str = "tcp/10.0.0.7:7447") -> None:
        self.time = 50.0
        self.id = uuid4().hex
        self.others: dict[str, str] = {}
        self.dialing = Dialing(lambda: self.time)
        keys = Keys(domain, self.id, robots=robots or ("*",))
        listening = Listening(settings(listen, None, None, 2.0))
        self.introductions = Introductions(keys, listening, self.dialing, lambda: self.time, Random(1))

    def knows(self, *addresses: str, robot: str = NO_ROBOT, id: str | None = None) -> str:  # noqa: A002
        """Note a peer, and where it listens; returns its id."""
        peer = id or uuid4().hex
        self.others[peer] = robot
        for address in reversed(addresses):
            self.dialing.reached(peer, address)
        return peer

    def told_by(self, other: "End") -> bytes:
        """The answer to a question of this link."""
        question = self.introductions.question(self.others)
        return other.introductions.answer(question, self.id, other.others)

    def until_asked(self, *peers: str) -> float:
        """The time until somebody is to be asked, and is."""
        due = self.introductions.next_due()
        assert due is not None
        waited, self.time = due - self.time, due
        assert self.introductions.take_due(peers, lambda _: True) in peers
        return waited

    def dialled(self) -> list[tuple[str, str]]:
        self.time += 1.0
        return self.dialing.take_due()


def test_one_peer_is_asked_soon_after_a_change_and_then_ever_more_seldom() -> None:
    end = End()
    assert end.introductions.next_due() is None
    assert end.introductions.take_due(["a"], lambda _: True) is None
    for _ in range(2):
        end.introductions.changed()
        assert end.introductions.take_due(["a"], lambda _: True) is None
        assert end.until_asked("a", "b") == FIRST_PAUSE
        pause = FIRST_PAUSE
        for _ in range(10):
            assert 0.8 * pause <= end.until_asked("a", "b") <= 1.2 * pause
            pause = min(2 * pause, LONGEST_PAUSE)
    assert pause == LONGEST_PAUSE


def test_all_are_asked_sooner_or_later() -> None:
    end, asked = End(), set[str | None]()
    end.introductions.changed()
    for _ in range(100):
        end.time += 2 * LONGEST_PAUSE
        asked.add(end.introductions.take_due(["a", "b", "c", "silent"], lambda peer: peer != "silent"))
    assert asked == {"a", "b", "c"}


def test_nobody_is_asked_while_peers_come_and_go_but_for_a_bound() -> None:
    end = End()
    asked = []
    for _ in range(2 * math.ceil(LONGEST_DELAY)):
        end.introductions.changed()
        end.time += 1.0
        asked.append(end.introductions.take_due(["a"], lambda _: True))
    assert [second for second, peer in enumerate(asked, 1) if peer] == [LONGEST_DELAY, 2 * LONGEST_DELAY]


def test_where_nobody_is_there_nobody_is_due() -> None:
    end = End()
    end.introductions.changed()
    end.time += FIRST_PAUSE
    assert end.introductions.take_due(["silent"], lambda _: False) is None
    assert end.introductions.next_due() is None


def test_a_peer_that_is_named_twice_and_has_not_come_is_dialled() -> None:
    here, third = End(), End()
    third.others[here.id] = NO_ROBOT
    both = here.knows(id=third.knows("tcp/10.0.0.1:1"))
    lost = third.knows("tcp/10.0.0.2:1", "tcp/10.0.0.2:2")
    here.introductions.changed()
    here.until_asked("third")
    here.introductions.take(here.told_by(third), here.others)
    assert here.dialled() == []
    # The next question comes soon.
    assert here.introductions.next_due() == here.time - 1.0 + FIRST_PAUSE
    here.time += MISSING_TIME - 1.1
    here.introductions.take(here.told_by(third), here.others)
    assert here.dialled() == []
    here.introductions.take(here.told_by(third), here.others)
    assert set(here.dialing.addresses(lost)) == {"tcp/10.0.0.2:1", "tcp/10.0.0.2:2"}
    assert [peer for peer, _ in here.dialled()] == [lost]
    assert not here.dialing.is_dialled(both)
    # Where others know it besides, it is tried at once.
    third.knows("tcp/10.0.0.2:3", id=lost)
    here.introductions.take(here.told_by(third), here.others)
    assert here.dialled()[:1] == [(lost, "tcp/10.0.0.2:3")]


@pytest.mark.parametrize(
    ("waits", "dialled"), [((MISSING_TIME / 2, MISSING_TIME / 2), True), ((LONGEST_PAUSE, 0.0), False)]
)
def test_a_missing_peer_is_remembered_for_a_while_though_others_do_not_name_it(
    waits: tuple[float, float], dialled: bool
) -> None:
    here, third = End(), End()
    here.time = 2 * LONGEST_PAUSE
    lost = third.knows("tcp/10.0.0.2:1")
    answer = here.told_by(third)
    here.introductions.take(answer, ())
    here.time += waits[0]
    here.introductions.take(b"", ())
    here.time += waits[1]
    here.introductions.take(answer, ())
    assert [peer for peer, _ in here.dialled()] == [lost] * dialled


def test_a_missing_peer_that_is_named_again_after_a_long_time_is_dialled() -> None:
    here, third = End(), End()
    lost = third.knows("tcp/10.0.0.2:1")
    answer = here.told_by(third)
    here.introductions.take(answer, ())
    here.time += LONGEST_PAUSE
    here.introductions.take(answer, ())
    assert [peer for peer, _ in here.dialled()] == [lost]


def test_a_peer_that_has_come_in_between_is_no_more_missing_than_a_new_one() -> None:
    here, third = End(), End()
    lost = third.knows("tcp/10.0.0.2:1")
    answer = here.told_by(third)
    here.introductions.take(answer, ())
    here.time += MISSING_TIME
    here.introductions.take(answer, (lost,))
    here.introductions.take(answer, ())
    assert here.dialled() == []


def test_whoever_asks_tells_where_it_listens() -> None:
    here, third = End(listen="tcp/10.0.0.3:7447"), End()
    third.knows(id=here.id)
    assert here.told_by(third) == b""
    assert third.dialing.addresses(here.id) == ["tcp/10.0.0.3:7447"]
    other = End()
    assert here.id.encode() in other.told_by(third)
    assert b"tcp/10.0.0.3:7447" in other.told_by(third)


def test_a_question_has_a_line_of_addresses_one_of_whom_it_wants_and_one_of_the_beginnings_of_whom_it_knows() -> None:
    here = End("r$*", "s", domain="yard", listen="tcp/10.0.0.3:7447")
    here.knows(id="0123456789" + "a" * 22)
    here.knows(id="b" * 32)
    wanted = b"tfbus/yard/r$*/@alive/*/*,tfbus/yard/s/@alive/*/*"
    assert here.introductions.question(here.others) == b"tcp/10.0.0.3:7447\n" + wanted + b"\n01234567bbbbbbbb"


def test_nobody_is_named_whom_the_asker_has_or_who_asks() -> None:
    here, third = End(), End()
    third.knows(id=here.id)
    common = [here.knows(id=third.knows("tcp/10.0.0.1:1")) for _ in range(3)]
    lacked = {third.knows("tcp/10.0.0.1:1") for _ in range(3)}
    for known in (common, common[:1], []):
        here.others = dict.fromkeys(known, NO_ROBOT)
        named = {line.split("/")[4] for line in here.told_by(third).decode().split("\n")}
        assert named == lacked | set(common) - set(known)


def test_only_those_are_named_that_the_asker_wants_and_dialled_of_its_domain() -> None:
    third = End()
    wanted = [third.knows("tcp/10.0.0.1:1", robot="r1"), third.knows("tcp/10.0.0.1:1", robot="s")]
    third.knows("tcp/10.0.0.1:1", robot="t1")
    here = End("r$*", "s")
    told = here.told_by(third).decode().split("\n")
    assert [line.split("/")[4] for line in told] == wanted
    elsewhere = End(domain="yard")
    assert elsewhere.told_by(third) == b""
    for _ in range(2):
        with pytest.raises(MalformedMessageError, match="2 lines"):
            elsewhere.introductions.take("\n".join(told).encode(), ())
        elsewhere.time += MISSING_TIME
    assert elsewhere.dialled() == []


@pytest.mark.parametrize(
    ("asker", "teller", "named"),
    [
        ("tcp/127.0.0.1:7447", "tcp/127.0.0.1:7448", ["tcp/127.0.0.1:1", "tcp/10.0.0.1:1"]),
        ("tcp/10.0.0.3:7447", "tcp/10.0.0.4:7447", ["tcp/10.0.0.1:1"]),
    ],
)
def test_addresses_of_one_machine_are_told_on_it_only(asker: str, teller: str, named: list[str]) -> None:
    here, third = End(listen=asker), End(listen=teller)
    lost = third.knows("tcp/127.0.0.1:1", "tcp/10.0.0.1:1")
    (line,) = here.told_by(third).decode().split("\n")
    assert line.split(" ") == [Keys("tf", lost).token(FIRST_SESSION), *named]


def test_of_very_many_some_are_named_and_later_others() -> None:
    here, third = End(), End()
    many = {third.knows("tcp/10.0.0.1:1") for _ in range(2 * MOST_NAMED)}
    told = [{line.split("/")[4] for line in here.told_by(third).decode().split("\n")} for _ in range(20)]
    assert {len(each) for each in told} == {MOST_NAMED}
    assert set[str]().union(*told) == many


def test_so_many_are_remembered_for_missing_and_only_for_a_while() -> None:
    here, third = End(), End()
    for _ in range(MOST_MISSING // MOST_NAMED + 1):
        third.others.clear()
        for _ in range(MOST_NAMED):
            third.knows("tcp/10.0.0.1:1")
        here.introductions.take(here.told_by(third), ())
    assert len(here.introductions._missing) == MOST_MISSING
    here.time += LONGEST_PAUSE
    here.introductions.take(b"", ())
    assert here.introductions._missing == {}


@given(
    st.binary() | st.lists(st.sampled_from(["\n", ",", " ", "*", "$*", "/", "tcp/10.0.0.1:1", "tfbus"])).map("".join)
)
def test_whatever_is_asked_or_answered_harms_nobody(said: bytes | str) -> None:
    end = End()
    peer = end.knows("tcp/10.0.0.1:1")
    content = said if isinstance(said, bytes) else said.encode()
    with suppress(MalformedMessageError):
        told = end.introductions.answer(content, uuid4().hex, end.others)
        assert told in (b"", f"{Keys('tf', peer).token(FIRST_SESSION)} tcp/10.0.0.1:1".encode())
    with suppress(MalformedMessageError):
        end.introductions.take(content, ())
    token = Keys("tf", uuid4().hex).token(FIRST_SESSION).encode()
    for _ in range(2):
        with suppress(MalformedMessageError):
            end.introductions.take(token + b" " + content, ())
        end.time += MISSING_TIME
    for _, address in end.dialled():
        assert address.startswith("tcp/10.0.0.1:1")

import math
import threading
from collections.abc import AsyncIterator, Callable, Collection, Iterable
from contextlib import asynccontextmanager
from queue import Queue
from time import monotonic
from types import SimpleNamespace
from typing import Any, ClassVar, cast
from uuid import uuid4

import anyio
import anyio.from_thread
import anyio.lowlevel
import anyio.to_thread
import pytest
import zenoh
from support.processes import free_ports, new_domain, until

from tfbus.links._message import Message
from tfbus.links._receive_queue import Answer, Presence, Question, Received
from tfbus.links.zenoh import _sessions
from tfbus.links.zenoh._dialing import FIRST_PAUSE, Dialing
from tfbus.links.zenoh._filters import write_filter
from tfbus.links.zenoh._hearing import DEAF
from tfbus.links.zenoh._keys import FIRST_SESSION, NO_ROBOT, Keys
from tfbus.links.zenoh._notes import MOST_ASKING
from tfbus.links.zenoh._opening import OpenQuestion
from tfbus.links.zenoh._sessions import ZenohSessions
from tfbus.links.zenoh._settings import patch_settings, settings
from tfbus.links.zenoh._unmet import Unmet
from tfbus.tf_message import MalformedMessageError

pytestmark = pytest.mark.anyio


class End:
    """The sessions of one link, which listen at an address of their own and connect to nobody."""

    def __init__(self, domain: str, connect: str | None = None, frames: Collection[str] | None = None) -> None:
        self.domain = domain
        self.id = f"{uuid4().int | 1 << 127:032x}"
        self.address = f"tcp/127.0.0.1:{free_ports(1)[0]}"
        self.items: Queue[Received] = Queue()
        self.dialing = Dialing(monotonic)
        # Without gossip they hear of others only from each other.
        config = settings(self.address, connect or [], {"id": self.id, "scouting/gossip/enabled": False}, 2.0)
        keys = Keys(domain, self.id, filter="" if frames is None else write_filter(["*"], frames))
        self.sessions = ZenohSessions(
            config, lambda where: patch_settings(where, None, 2.0), keys, self.items.put, self.dialing
        )

    async def next(self) -> Received:
        await until(lambda: not self.items.empty())
        return self.items.get()

    def lose(self, other: "End") -> None:
        """Have another end be one that was lost."""
        self.lose_at(other.id, other.address)

    def lose_at(self, peer: str, address: str) -> None:
        self.dialing.reached(peer, address)
        self.dialing.left(peer)
        with self.sessions._lock:
            self.sessions._notes.stir()


@asynccontextmanager
async def running(*made: End) -> AsyncIterator[None]:
    async with anyio.create_task_group() as tasks:
        for end in made:
            await anyio.to_thread.run_sync(end.sessions.open)
            tasks.start_soon(end.sessions.keep_connected)
        yield
        tasks.cancel_scope.cancel()
    for end in made:
        for closing in end.sessions.close():
            await anyio.to_thread.run_sync(closing.join)


@asynccontextmanager
async def ends(count: int = 2) -> AsyncIterator[list[End]]:
    domain = new_domain()
    made = [End(domain) for _ in range(count)]
    async with running(*made):
        yield made


@asynccontextmanager
async def joined_to(here: End) -> AsyncIterator[End]:
    """An end that has connected to another one, once both have met."""
    joining = End(here.domain, connect=here.address)
    async with running(joining):
        assert await joining.next() == Received(here.id, Presence.JOINED)
        assert await here.next() == Received(joining.id, Presence.JOINED)
        yield joining


async def test_a_lost_peer_is_reached_again_by_a_patch_that_carries_everything() -> None:
    async with ends() as (here, there):
        here.lose(there)
        assert await here.next() == Received(there.id, Presence.JOINED)
        assert await there.next() == Received(here.id, Presence.JOINED)
        here.sessions.put(Message(b"to there", b"", 1))
        assert await there.next() == Received(here.id, (b"to there", b""), 8, moving=True)
        there.sessions.put(Message(b"to here", b"", 1))
        assert await here.next() == Received(there.id, (b"to here", b""), 7, moving=True)
        for asking, asked in ((here, there), (there, here)):
            asking.sessions.ask(asked.id, 7)
            question = (await asked.next()).content
            assert isinstance(question, Question)
            assert str(question.handle.query.key_expr) == asked.sessions._keys.own("state")
            asked.sessions.answer(question.handle, Message(b"answer", b"", 0))
            assert await asking.next() == Received(asked.id, Answer((b"answer", b"")), 6)


@pytest.mark.thorough
async def test_a_patch_carries_what_a_filter_wants_and_its_end_ends_that() -> None:
    domain = new_domain()
    here, there = End(domain), End(domain, frames=["base", "lidar"])
    async with running(here, there):
        here.lose(there)
        assert await here.next() == Received(there.id, Presence.JOINED)
        assert await there.next() == Received(here.id, Presence.JOINED)
        ((name, frames),) = here.sessions.filters.items()
        assert frames == {"base", "lidar"}
        assert not here.sessions.is_heard()
        with anyio.fail_after(30):
            # On a busy machine zenoh may drop one.
            while there.items.empty():
                here.sessions.put(Message(b"all", b"", 1))
                here.sessions.put_part(name, Message(b"part", b"", 1))
                await anyio.sleep(0.1)
        assert await there.next() == Received(here.id, (b"part", b""), 4, moving=True)
        here.sessions._drop_patch(there.id)
        assert here.sessions.filters == {}


async def test_a_patch_ends_with_its_peer_and_is_made_again() -> None:
    async with ends() as (here, there):
        here.lose(there)
        assert (await here.next()).content is Presence.JOINED
        for closing in there.sessions.close():
            await anyio.to_thread.run_sync(closing.join)
        assert await here.next() == Received(there.id, Presence.LEFT)


@pytest.mark.thorough
async def test_whoever_else_is_at_the_address_of_a_lost_peer_now_is_met_instead() -> None:
    async with ends(3) as (here, there, gone):
        here.lose_at(gone.id, there.address)
        assert await here.next() == Received(there.id, Presence.JOINED)
        # It may have seen the patch that looked for the other one, which is dialled there no more.
        await until(lambda: there.sessions._present.keys() == {here.id})
        assert here.sessions._present.keys() == here.sessions._patches.keys() == {there.id}
        assert here.dialing.addresses(gone.id) == []
        await until(lambda: here.dialing.next_due() is None)


async def test_whoever_is_no_link_at_the_address_of_a_lost_peer_is_not_dialled_for_ever(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("tfbus.links.zenoh._sessions._MEETING_TIME", 0.3)
    here, bare, gone = End(new_domain()), f"{1 << 127:032x}", f"{(1 << 127) + 1:032x}"
    address = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    with zenoh.open(settings(address, [], {"id": bare}, 2.0)):
        async with running(here):
            here.lose_at(gone, address)
            await until(lambda: here.sessions._unmet.next_due() is not None)
            assert not any(map(here.dialing.is_dialled, (bare, gone)))
            assert here.sessions._unmet.take_due(()) == []
            assert here.dialing.addresses(gone) == []


async def test_two_ends_that_never_reached_each_other_meet_through_a_third(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("FIRST_PAUSE", "MISSING_TIME"):
        monkeypatch.setattr(f"tfbus.links.zenoh._introductions.{name}", 0.2)
    async with ends(1) as (third,), joined_to(third) as here, joined_to(third) as there:
        # zenoh tells them nothing of each other.
        for end, other in ((here, there), (there, here)):
            assert await end.next() == Received(other.id, Presence.JOINED)
        here.sessions.put(Message(b"to there", b"", 1))
        await until(lambda: not there.items.empty())
        assert await there.next() == Received(here.id, (b"to there", b""), 8, moving=True)


async def test_an_address_at_which_nobody_listens_is_forgotten_if_there_is_another() -> None:
    here, peer = End(new_domain()), f"{1 << 127:032x}"
    first, second = (f"tcp/127.0.0.1:{port}" for port in free_ports(2))
    for address in (first, second):
        here.dialing.reached(peer, address)
    for _ in range(2):
        await here.sessions._patch(peer, first)
    assert here.dialing._addresses == {peer: [second]}
    await here.sessions._patch(peer, second)
    assert here.dialing._addresses == {peer: [second]}


@pytest.mark.thorough
async def test_nobody_at_the_address_is_tried_again() -> None:
    async with ends() as (here, there):
        here.lose_at(there.id, f"tcp/127.0.0.1:{free_ports(1)[0]}")
        await until(lambda: (here.dialing.next_due() or 0) > monotonic() + 0.5)
        assert here.items.empty()
        here.lose(there)
        assert await here.next() == Received(there.id, Presence.JOINED)


@pytest.mark.thorough
async def test_an_end_that_does_not_hear_those_who_ask_it_dials_them() -> None:
    async with ends(1) as (here,), joined_to(here) as joining:
        await until(lambda: here.id in joining.dialing._addresses)
        # As if zenoh had never told of it. The other end has accepted the connection, and cannot dial this one.
        joining.sessions._present.note(here.id, (None, FIRST_SESSION), Presence.LEFT)
        joining.sessions._notes.take()
        assert await joining.next() == Received(here.id, Presence.LEFT)
        assert await joining.next() == Received(here.id, Presence.JOINED)
        assert here.items.empty()


@pytest.mark.thorough
async def test_a_peer_that_does_not_hear_this_end_is_dialled_until_it_does() -> None:
    # Both are connected by their first sessions, as when a connection has come back.
    async with ends(1) as (here,), joined_to(here) as joining:
        # As after faults in which zenoh has lost it at that end only.
        here.sessions._present.note(joining.id, (None, FIRST_SESSION), Presence.LEFT)
        assert await here.next() == Received(joining.id, Presence.LEFT)
        assert await here.next() == Received(joining.id, Presence.JOINED)
        assert (None, FIRST_SESSION) not in here.sessions._present[joining.id]
        assert joining.items.empty()
        # Now it hears the first session again, so the other one ends.
        here.sessions._present.note(joining.id, (None, FIRST_SESSION), Presence.JOINED)
        await until(lambda: here.sessions._present[joining.id] == {(None, FIRST_SESSION)})
        assert here.items.empty()


@pytest.mark.thorough
async def test_two_ends_that_are_connected_and_have_never_met_dial_each_other() -> None:
    async with ends(1) as (here,), joined_to(here) as joining:
        for end, other in ((here, joining), (joining, here)):
            # As if zenoh had told of their connection, and of nothing else.
            end.sessions._present.note(other.id, (None, FIRST_SESSION), Presence.LEFT)
            end.sessions._notes.take()
            end.sessions._hearing.left(other.id)
            end.dialing._addresses.clear()
            assert await end.next() == Received(other.id, Presence.LEFT)
        for end, other in ((here, joining), (joining, here)):
            end.sessions._notes.add_connection(other.id, "tcp/127.0.0.1:1", other.address)
        for end, other in ((here, joining), (joining, here)):
            assert await end.next() == Received(other.id, Presence.JOINED)


async def test_a_peer_whose_connection_was_gone_before_anybody_looked_is_dialled(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # The connections behind which nobody was met are looked after much later.
    monkeypatch.setattr(Unmet, "connected", lambda *_: None)
    async with ends() as (here, there):
        here.sessions._notes.add_connection(there.id, "tcp/127.0.0.1:1", there.address)
        for presence in (Presence.JOINED, Presence.LEFT):
            here.sessions._present.note(there.id, (None, FIRST_SESSION), presence)
            assert await here.next() == Received(there.id, presence)
        assert await here.next() == Received(there.id, Presence.JOINED)
        assert await there.next() == Received(here.id, Presence.JOINED)


async def test_what_is_sent_for_a_filter_that_nobody_has_is_declared_no_more() -> None:
    async with ends(1) as (here,):
        declared = here.sessions._main.publishers._parts
        for name in ("first", "second"):
            here.sessions.put_part(name, Message(b"part", b"", 1))
        here.sessions.serve({"second"})
        assert declared.keys() == {"second"}
        here.sessions.serve(())
        assert not declared


async def test_a_peer_is_asked_by_its_own_key_which_costs_a_router_nothing_for_other_robots() -> None:
    async with ends(1) as (here,), joined_to(here) as joining:
        joining.sessions.ask(here.id, 0)
        joining.sessions.ask_history(here.id, 1.0, "")
        for kind in ("state", "history"):
            question = await here.next()
            assert str(question.content.handle.query.key_expr) == here.sessions._keys.own(kind)
            question.content.handle.drop()


async def test_whoever_asks_and_hears_directly_tells_so() -> None:
    async with ends(1) as (here,), joined_to(here) as joining:
        told: Queue[bytes] = Queue()
        here.sessions._main._note_heard = told.put
        joining.sessions.ask(here.id, 0)
        await here.next()
        token = told.get_nowait()
        assert here.sessions._keys.heard_link(token) == joining.id
        assert here.sessions._keys.heard_link(b"\xff") is None
        joining.sessions._present.note(here.id, (None, FIRST_SESSION), Presence.LEFT)
        joining.sessions.ask(here.id, 0)
        await here.next()
        assert told.empty()


class Patch:
    """A session to one peer that notes whether it was closed."""

    is_open = True

    def __init__(self, peer: str) -> None:
        self.peer = peer
        self.closed = 0

    def close(self) -> object:
        self.closed += 1
        return SimpleNamespace(is_alive=lambda: False)


class Alone(End):
    """The sessions of a link that was not opened, and a peer whose first session it hears."""

    def __init__(self, frames: Collection[str] | None = None) -> None:
        super().__init__(new_domain(), frames=frames)
        self.peer = uuid4().hex
        self.dialing.reached(self.peer, "tcp/10.0.0.7:1")
        self.patch: Any = Patch(self.peer)

    def hears(self, name: str = FIRST_SESSION) -> None:
        self.sessions._note_directly(self.peer, name, Presence.JOINED, NO_ROBOT)

    def question(self, asker: str | None = None) -> Any:
        """A question of a link whether it is heard, which notes whether it was dropped."""
        token = None if asker == "" else Keys(self.domain, asker or self.peer).token(FIRST_SESSION).encode()
        payload = None if token is None else SimpleNamespace(to_bytes=lambda: token)
        dropped: list[bool] = []
        return SimpleNamespace(payload=payload, attachment=None, drop=lambda: dropped.append(True), dropped=dropped)

    def note(self) -> None:
        """Note the changes, as `keep_connected` does."""
        self.sessions._note(self.sessions._notes.take().changes)


async def test_a_peer_is_present_while_one_of_its_ways_is() -> None:
    alone = Alone()
    alone.sessions._patches[alone.peer] = alone.patch
    alone.hears()
    alone.sessions._note_by_patch(alone.patch, "other", Presence.JOINED, NO_ROBOT)
    # By a patch that was dropped.
    alone.sessions._note_by_patch(cast(Any, Patch(alone.peer)), "late", Presence.JOINED, NO_ROBOT)
    assert alone.sessions._present == {alone.peer: {(None, FIRST_SESSION), (alone.patch, "other")}}
    assert [alone.items.get_nowait() for _ in range(1)] == [Received(alone.peer, Presence.JOINED)]
    alone.sessions._note_directly(alone.peer, FIRST_SESSION, Presence.LEFT, NO_ROBOT)
    assert alone.items.empty()
    # The end of a patch ends what came by it.
    alone.sessions._filters.joined((alone.peer, alone.patch, "other"), write_filter(["*"], ["base"]))
    assert list(alone.sessions.filters.values()) == [{"base"}]
    alone.sessions._drop_patch(alone.peer)
    assert alone.sessions.filters == {}
    assert alone.items.get_nowait() == Received(alone.peer, Presence.LEFT)
    assert (dict(alone.sessions._present), alone.patch.closed, len(alone.sessions._closing)) == ({}, 1, 1)
    assert alone.sessions._notes.take().changes == [
        (alone.peer, Presence.JOINED),
        (alone.peer, Presence.LEFT),
        (alone.peer, Presence.LEFT),
    ]


async def test_an_answer_that_cannot_be_sent_is_logged_and_frees_its_place(caplog: pytest.LogCaptureFixture) -> None:
    alone = Alone()
    query = alone.question()
    question = OpenQuestion(query, "state")
    alone.sessions._main._questions.add(question)
    alone.sessions.answer(question, Message(b"", b"", 0, 0))
    await until(lambda: bool(caplog.records))
    assert (query.dropped, len(alone.sessions._main._questions)) == ([True], 0)
    (record,) = caplog.records
    assert (record.name, record.message) == ("tfbus", "an answer could not be sent")
    assert record.exc_info is not None
    assert isinstance(record.exc_info[1], AttributeError)


async def test_a_peer_is_dialled_while_an_answer_waits_for_one_that_is_frozen() -> None:
    alone = Alone()
    frozen, dialled = threading.Event(), anyio.Event()
    answered: list[list[Any]] = []

    def answer(answers: Iterable[Any]) -> None:
        answered.append(list(answers))
        frozen.wait(10)

    async def dial(peer: str, address: str) -> None:
        assert (peer, address) == (alone.peer, "tcp/10.0.0.7:1")
        dialled.set()

    alone.sessions._main.answer_hearing = answer  # type: ignore[method-assign]
    alone.sessions._patch = dial  # type: ignore[method-assign]
    alone.dialing._now = lambda: monotonic() + FIRST_PAUSE
    questions = [alone.question() for _ in range(3)]
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(alone.sessions.keep_connected, 0.0)
        try:
            with anyio.fail_after(5):
                alone.sessions._note_asked(questions[0])
                await until(lambda: bool(answered))
                alone.dialing.left(alone.peer)
                # Who asks meanwhile asks again.
                alone.sessions._note_asked(questions[1])
                await dialled.wait()
                assert not frozen.is_set()
                frozen.set()
                waiting = alone.sessions._hearing_answers
                assert waiting is not None
                await until(waiting.done)
                alone.sessions._note_asked(questions[2])
                await until(lambda: len(answered) == 2)
        finally:
            frozen.set()
            tasks.cancel_scope.cancel()
    assert answered == [[(questions[0], [], b"")], [(questions[2], [], b"")]]


async def test_missing_peers_are_noted_only_while_the_loop_has_time() -> None:
    alone, missing = Alone(), uuid4().hex
    answer = f"{Keys(alone.domain, missing).token(FIRST_SESSION)} tcp/127.0.0.1:1".encode()

    async def tell(interval: float) -> None:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(alone.sessions.keep_connected, interval)
            alone.sessions._notes.add_answer(alone.peer, None, answer)
            await until(lambda: alone.sessions._notes.since == math.inf)
            tasks.cancel_scope.cancel()

    # Any time is more than three times nothing.
    await tell(0.0)
    assert alone.sessions._introductions._missing == {}
    while missing not in alone.sessions._introductions._missing:
        await tell(0.1)


async def test_a_peer_that_is_lost_is_dialled_and_asked_no_more_until_it_is_there() -> None:
    alone = Alone()
    alone.hears()
    alone.note()
    assert alone.peer in alone.sessions._hearing._checks
    alone.sessions._patches[alone.peer] = alone.patch
    alone.sessions._deaf.add(alone.peer)
    alone.sessions._note_directly(alone.peer, FIRST_SESSION, Presence.LEFT, NO_ROBOT)
    alone.note()
    assert alone.dialing.is_dialled(alone.peer)
    assert (alone.sessions._hearing._checks, alone.sessions._deaf, alone.sessions._patches) == ({}, set(), {})
    alone.hears()
    alone.note()
    assert not alone.dialing.is_dialled(alone.peer)
    # It had gone and come again in between: nobody is lost.
    alone.sessions._notes.add_change(alone.peer, Presence.LEFT)
    alone.note()
    assert not alone.dialing.is_dialled(alone.peer)
    assert alone.peer in alone.sessions._hearing._checks


@pytest.mark.parametrize("deaf", [False, True])
async def test_a_peer_that_is_heard_directly_needs_a_patch_only_while_it_is_deaf(deaf: bool) -> None:
    alone = Alone()
    alone.sessions._patches[alone.peer] = alone.patch
    if deaf:
        alone.sessions._deaf.add(alone.peer)
    # Another session than the first is no direct connection.
    alone.hears("another")
    alone.note()
    assert (alone.patch.closed, alone.sessions._hearing._checks) == (0, {})
    alone.hears()
    alone.note()
    assert alone.patch.closed == (not deaf)
    assert list(alone.sessions._hearing._checks) == [alone.peer]


@pytest.mark.parametrize("answer", [[], None])
async def test_a_peer_that_does_not_hear_this_link_twice_is_dialled_until_it_does(answer: list[str] | None) -> None:
    alone = Alone()
    alone.hears()
    alone.note()
    for number in range(DEAF):
        assert not alone.dialing.is_dialled(alone.peer), number
        alone.sessions._patches[alone.peer] = alone.patch
        alone.sessions._judge(alone.peer, answer)
    assert alone.dialing.is_dialled(alone.peer)
    assert alone.sessions._deaf == {alone.peer}
    assert alone.patch.closed == 1
    # It hears the patch, but not the first session yet.
    alone.sessions._patches[alone.peer] = again = Patch(alone.peer)  # type: ignore[assignment]
    alone.sessions._judge(alone.peer, ["patch"])
    assert (alone.dialing.is_dialled(alone.peer), alone.sessions._deaf, again.closed) == (True, {alone.peer}, 0)
    alone.sessions._judge(alone.peer, [FIRST_SESSION, "patch"])
    assert (alone.dialing.is_dialled(alone.peer), alone.sessions._deaf, again.closed) == (False, set(), 1)


async def test_the_silence_of_a_peer_that_another_way_reaches_proves_nothing() -> None:
    alone = Alone()
    alone.hears("another")
    alone.sessions._hearing.joined(alone.peer)
    for _ in range(2 * DEAF):
        alone.sessions._judge(alone.peer, None)
    assert alone.sessions._deaf == set()


async def test_whoever_asks_twice_whether_it_is_heard_and_is_not_is_dialled() -> None:
    alone = Alone()
    sessions, query = alone.sessions, alone.question()
    for names in ([], [FIRST_SESSION], [], []):
        assert not alone.dialing.is_dialled(alone.peer)
        sessions._note_unheard([(query, names, b""), (alone.question(""), [], b"")])
    assert alone.dialing.is_dialled(alone.peer)
    assert alone.dialing._addresses == {alone.peer: ["tcp/10.0.0.7:1"]}
    # Its time is not put off by the next question.
    due = alone.dialing.next_due()
    sessions._note_unheard([(query, [], b"")])
    assert alone.dialing.next_due() == due
    assert sessions._unheard == {alone.peer: 3}
    for count, left in ((MOST_ASKING, MOST_ASKING), (MOST_ASKING + 1, 0)):
        sessions._unheard.update(f"{count}, {k}" for k in range(count - len(sessions._unheard)))
        sessions._note_unheard([])
        assert len(sessions._unheard) == left


async def test_questions_and_those_who_hear_are_kept_up_to_a_bound_and_strangers_are_not() -> None:
    alone = Alone()
    alone.hears()
    alone.hears("another")
    query = alone.question()
    assert alone.sessions._names_heard(query) == sorted([FIRST_SESSION, "another"])
    assert alone.sessions._names_heard(alone.question(uuid4().hex)) == []
    for unknown in (alone.question(""), alone.question("no id")):
        with pytest.raises(MalformedMessageError, match="token"):
            alone.sessions._note_asked(unknown)
    for number in range(MOST_ASKING):
        alone.sessions._note_asked(query)
        alone.sessions._note_heard(Keys(alone.domain, f"{number + 1:032x}").token(FIRST_SESSION).encode())
    assert query.dropped == []
    with pytest.raises(MalformedMessageError, match="busy"):
        alone.sessions._note_asked(query)
    alone.sessions._note_heard(Keys(alone.domain, alone.peer).token(FIRST_SESSION).encode())
    noted = alone.sessions._notes.take()
    assert (len(noted.asking), len(noted.hearers)) == (MOST_ASKING, MOST_ASKING)
    assert alone.peer not in noted.hearers


async def test_the_loop_sleeps_until_the_next_peer_is_due() -> None:
    alone = Alone()
    assert alone.sessions._next_due() == math.inf
    alone.sessions._unmet.connected("a", "tcp/10.0.0.7:1")
    times = [alone.sessions._next_due()]
    alone.sessions._hearing.joined(alone.peer)
    times.append(alone.sessions._next_due())
    alone.dialing.reached(alone.peer, "tcp/10.0.0.7:1")
    alone.dialing.left(alone.peer)
    times.append(alone.sessions._next_due())
    # Connections are looked after in 3 s, a peer is asked in 0.8 s or more, a lost one dialled in 0.3 s.
    assert times == sorted(times, reverse=True)
    assert len(set(times)) == 3
    assert times[-1] == alone.dialing.next_due()


async def test_the_end_leaves_answers_behind_and_closes_patches_once(caplog: pytest.LogCaptureFixture) -> None:
    alone = Alone()
    began, may_end, answered = threading.Event(), threading.Event(), list[Any]()

    def answer(question: Any, _: Message) -> None:
        began.set()
        may_end.wait(10)
        answered.append(question)

    cast(Any, alone.sessions._main).answer = answer
    alone.sessions._patches[alone.peer] = alone.patch
    closing = threading.Thread()
    alone.sessions._closing = [closing]
    for question in ("first", "second"):
        alone.sessions.answer(question, Message(b"", b"", 0))  # type: ignore[arg-type]
    assert began.wait(10)
    threads = alone.sessions.close()
    assert answered == [], "nobody waits for it"
    assert closing in threads
    assert (len(threads), alone.patch.closed, alone.sessions._patches) == (3, 1, {})
    may_end.set()
    alone.sessions._answering.shutdown()
    assert (answered, caplog.records) == (["first"], [])


async def test_whoever_is_told_again_that_it_is_not_heard_is_dialled(caplog: pytest.LogCaptureFixture) -> None:
    alone, answered = Alone(), list[Any]()
    main: Any = alone.sessions._main
    main.answer_hearing = answered.extend
    query = alone.question()
    for _ in range(DEAF):
        assert not alone.dialing.is_dialled(alone.peer)
        alone.sessions._answer_hearing([query])
        waiting = alone.sessions._hearing_answers
        assert waiting is not None
        await until(waiting.done)
    assert alone.dialing.is_dialled(alone.peer)
    assert (answered, caplog.records) == ([(query, [], b"")] * DEAF, [])

    def fail(_: object) -> None:
        raise MemoryError

    main.answer_hearing = fail
    alone.sessions._answer_hearing([query])
    await until(lambda: bool(caplog.records))
    assert [record.message for record in caplog.records] == ["an answer could not be sent"]


async def test_a_link_is_heard_if_a_peer_has_no_filter_or_somebody_subscribes() -> None:
    alone, heard = Alone(), [False]
    alone.sessions._main.publishers = SimpleNamespace(is_heard=lambda: heard[0])  # type: ignore[assignment]
    assert not alone.sessions.is_heard()
    heard[0] = True
    assert alone.sessions.is_heard()
    heard[0] = False
    alone.hears()
    assert alone.sessions.is_heard()
    alone.sessions._filters.joined((alone.peer, None, FIRST_SESSION), write_filter(["*"], ["base"]))
    assert not alone.sessions.is_heard()


async def test_newest_samples_go_to_those_sessions_that_are_heard_slowly() -> None:
    alone, sent = Alone(), list[tuple[str, Message]]()

    def publishers(name: str, heard: bool) -> Any:
        return SimpleNamespace(is_heard_slowly=lambda: heard, put_slowly=lambda message: sent.append((name, message)))

    alone.sessions._main.publishers = publishers("main", False)
    assert not alone.sessions.is_heard_slowly()
    for name, heard, is_open in (
        ("first", True, True),
        ("second", True, True),
        ("deaf", False, True),
        ("new", True, False),
    ):
        patch: Any = Patch(name)
        patch.publishers, patch.is_open = publishers(name, heard), is_open
        alone.sessions._patches[name] = patch
    assert alone.sessions.is_heard_slowly()
    messages = [Message(b"1", b"", 1), Message(b"2", b"", 1)]
    alone.sessions.put_slowly(messages)
    assert sent == [(name, message) for message in messages for name in ("first", "second")]


async def test_whoever_was_found_instead_is_dialled_if_it_is_a_link_that_is_not_there() -> None:
    alone = Alone()
    dialing, unmet = alone.dialing, alone.sessions._unmet
    link, bare = uuid4().hex, uuid4().hex
    alone.hears()
    for session, is_link in ((alone.id, True), (link, True), (bare, False), (alone.peer, True)):
        alone.sessions._note_found(session, is_link, "tcp/10.0.0.8:1")
    assert dialing.addresses(alone.id) == []
    assert [dialing.addresses(session)[0] for session in (link, bare, alone.peer)] == ["tcp/10.0.0.8:1"] * 3
    assert [session for session in (alone.id, link, bare, alone.peer) if dialing.is_dialled(session)] == [link]
    assert unmet._looks.keys() == {bare}


class Dialled(Patch):
    """A patch for a lost peer; a test says what it finds, and whether it opens."""

    found: tuple[str, bool] | None = None
    fails = met = False
    opens: Any = None
    made: ClassVar[list["Dialled"]]

    def __init__(self, _config: object, _keys: Keys, peer: str, *_: object) -> None:
        super().__init__(peer)
        self.made.append(self)

    def open(self) -> None:
        if self.fails:
            raise OSError("nobody is there any more")
        if self.opens is not None:
            self.opens()

    async def meet(self, is_present: Callable[[], bool], seconds: float) -> None:
        assert seconds == _sessions._MEETING_TIME
        self.met = is_present()

    def found_instead(self) -> tuple[str, bool] | None:
        return self.found


@pytest.fixture
def dialled(monkeypatch: pytest.MonkeyPatch) -> type[Dialled]:
    """The class of the patches that the sessions make; nobody is reachable over UDP."""

    class One(Dialled):
        made: ClassVar[list[Dialled]] = []

    async def is_reachable(address: str) -> bool:
        return not address.startswith("udp/")

    monkeypatch.setattr(_sessions, "Patch", One)
    monkeypatch.setattr(_sessions, "is_reachable", is_reachable)
    return One


@pytest.mark.parametrize(
    ("ways", "deaf", "found", "kept", "taken"),
    [
        (["patch"], False, None, True, False),
        (["patch"], False, ("other", True), True, False),
        ([], False, None, False, False),
        ([], False, ("other", True), False, True),
        (["patch", "direct"], False, None, False, False),
        (["patch", "direct"], True, None, True, False),
    ],
)
async def test_a_patch_stays_if_it_reaches_its_peer_and_nothing_else_does(
    dialled: type[Dialled], ways: list[str], deaf: bool, found: tuple[str, bool] | None, kept: bool, taken: bool
) -> None:
    alone = Alone()
    dialled.found = found
    if "patch" in ways:
        alone.sessions._present.note(alone.peer, (None, "x"), Presence.JOINED)
    if "direct" in ways:
        alone.hears()
    if deaf:
        alone.sessions._deaf.add(alone.peer)
    await alone.sessions._patch(alone.peer, "tcp/10.0.0.7:1")
    made: list[Any] = dialled.made
    (patch,) = made
    assert list(alone.sessions._patches.values()) == [patch] * kept
    assert (patch.closed, patch.met) == (not kept, ways != [])
    assert alone.dialing.addresses(alone.peer) == ([] if taken else ["tcp/10.0.0.7:1"])
    assert alone.dialing.addresses("other") == (["tcp/10.0.0.7:1"] if taken else [])


async def test_nobody_is_dialled_twice_or_where_nobody_can_be_reached(dialled: type[Dialled]) -> None:
    alone = Alone()
    await alone.sessions._patch(alone.peer, "udp/10.0.0.7:1")
    assert dialled.made == []
    alone.sessions._patches[alone.peer] = alone.patch
    await alone.sessions._patch(alone.peer, "tcp/10.0.0.7:1")
    assert (dialled.made, alone.patch.closed) == ([], 0)


async def test_a_patch_that_does_not_open_ends(dialled: type[Dialled]) -> None:
    alone = Alone()
    dialled.fails = True
    await alone.sessions._patch(alone.peer, "tcp/10.0.0.7:1")
    assert ([patch.closed for patch in dialled.made], alone.sessions._patches) == ([1], {})


async def test_a_patch_that_opens_for_long_is_not_waited_for_at_the_end(dialled: type[Dialled]) -> None:
    alone = Alone()
    may_open, opened = threading.Event(), list[bool]()

    def open_slowly(_: Dialled) -> None:
        anyio.from_thread.run_sync(scope.cancel)
        opened.append(may_open.wait(10))

    dialled.opens = open_slowly
    with anyio.CancelScope() as scope:
        await alone.sessions._patch(alone.peer, "tcp/10.0.0.7:1")
    assert (scope.cancelled_caught, opened) == (True, [])
    may_open.set()


async def test_answers_come_from_peers_that_are_heard_directly_or_by_a_patch() -> None:
    alone = Alone()
    assert not alone.sessions._answers(alone.peer)
    alone.sessions._patches[alone.peer] = alone.patch
    assert alone.sessions._answers(alone.peer)
    alone.sessions._patches.clear()
    alone.hears()
    assert alone.sessions._answers(alone.peer)


async def test_a_link_hears_all_of_those_who_do_not_serve_its_filter_while_they_are_there() -> None:
    alone = Alone()
    notes, heard = alone.sessions._notes, list[frozenset[str]]()
    # A link without a filter hears all of everybody in any case.
    alone.sessions._note_served(alone.peer, False)
    assert notes.since == math.inf
    alone = Alone(frames=["base"])
    notes, main = alone.sessions._notes, cast(Any, alone.sessions._main)
    main.hear_all_of = heard.append
    alone.hears()
    notes.take()
    for served, changed in ((True, False), (False, True), (False, False), (True, True), (False, True)):
        alone.sessions._note_served(alone.peer, served)
        assert (notes.since < math.inf) is changed, served
        notes.take()
        alone.sessions._hear_unserved()
        assert heard.pop() == (set() if served else {alone.peer})
    alone.sessions._note_directly(alone.peer, FIRST_SESSION, Presence.LEFT, NO_ROBOT)
    alone.hears()
    alone.sessions._note_directly(alone.peer, FIRST_SESSION, Presence.LEFT, NO_ROBOT)
    notes.take()
    alone.sessions._hear_unserved()
    assert heard == [set()]

    def fail(_: object) -> None:
        raise zenoh.ZError("the session is closed")

    main.hear_all_of = fail
    alone.sessions._hear_unserved()
    assert notes.since < math.inf, "it is tried again"


async def one_round(alone: Alone, interval: float = 0.0) -> None:
    """Have the link look once after what was noted; any time is later than an interval of nothing allows."""
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(alone.sessions.keep_connected, interval)
        await until(lambda: alone.sessions._notes.since == math.inf)
        await anyio.wait_all_tasks_blocked()
        tasks.cancel_scope.cancel()


async def test_a_peer_that_is_heard_directly_is_asked_soon_after_a_change_of_its_connection() -> None:
    alone = Alone()
    alone.hears()
    alone.note()
    hearing, indirect = alone.sessions._hearing, uuid4().hex
    hearing.is_heard(alone.peer)
    seldom = hearing.next_due()
    assert seldom is not None
    alone.sessions._present.note(indirect, (None, "x"), Presence.JOINED)
    for session in (alone.peer, indirect, "nobody"):
        alone.sessions._notes.add_connection(session, "tcp/127.0.0.1:1", "tcp/10.0.0.7:1")
    await one_round(alone)
    assert hearing._checks.keys() == {alone.peer}
    assert (hearing.next_due() or math.inf) < seldom


@pytest.mark.parametrize("frames", [None, ["base"]])
async def test_whom_a_filter_does_not_suffice_for_is_looked_after_in_each_round(frames: list[str] | None) -> None:
    alone, heard = Alone(frames), list[frozenset[str]]()
    cast(Any, alone.sessions._main).hear_all_of = heard.append
    alone.hears()
    alone.sessions._note_served(alone.peer, False)
    await one_round(alone)
    assert heard == ([] if frames is None else [{alone.peer}])


async def test_silence_proves_nothing_while_the_loop_has_no_time_and_an_answer_does() -> None:
    alone = Alone()
    alone.sessions._main.ask_hearing = lambda *_: None  # type: ignore[method-assign]
    alone.hears()
    alone.note()
    for answer, deaf in ((None, False), ([], True)):
        for _ in range(DEAF):
            assert not alone.dialing.is_dialled(alone.peer)
            alone.sessions._notes.add_answer(alone.peer, answer, b"")
            await one_round(alone)
        assert alone.dialing.is_dialled(alone.peer) is deaf


async def test_those_who_hear_this_link_are_asked_seldom_and_those_who_are_due_at_once() -> None:
    alone, asked = Alone(), list[tuple[Any, ...]]()
    hearing = alone.sessions._hearing
    alone.sessions._main.ask_hearing = lambda *question: asked.append(question)  # type: ignore[method-assign]
    alone.hears()
    alone.note()
    soon = hearing.next_due()
    alone.sessions._note_heard(Keys(alone.domain, alone.peer).token(FIRST_SESSION).encode())
    await one_round(alone)
    assert (hearing.next_due() or 0.0) > (soon or math.inf)
    assert asked == []
    hearing._now = alone.sessions._introductions._now = lambda: monotonic() + 1_000.0
    alone.sessions._notes.stir()
    await one_round(alone)
    # It is asked whether it hears this link, and for those whom this link lacks.
    known = alone.sessions._introductions.question([alone.peer])
    assert [(question[0], *question[2:]) for question in asked] == [(alone.peer,), (alone.peer, known)]
    for _, take, *_ in asked:
        take([FIRST_SESSION], b"named")
    assert alone.sessions._notes.take().heard_by == [(alone.peer, [FIRST_SESSION], b"named")] * 2


async def test_whoever_is_connected_and_was_not_met_is_dialled(monkeypatch: pytest.MonkeyPatch) -> None:
    alone, found, called = Alone(), list[tuple[str, str]](), list[tuple[str, str]]()

    async def find(_: Unmet, connected: list[tuple[str, str | None]], *_rest: object) -> list[tuple[str, str]]:
        found.extend((session, address or "") for session, address in connected)
        return [(session, "tcp/10.0.0.9:1") for session, _ in connected]

    async def dial(peer: str, address: str) -> None:
        called.append((peer, address))

    monkeypatch.setattr(Unmet, "find", find)
    alone.sessions._patch = dial  # type: ignore[method-assign]
    alone.sessions._patches[alone.peer] = alone.patch
    for session in ("bare", alone.peer):
        alone.sessions._notes.add_connection(session, "tcp/127.0.0.1:1", "tcp/10.0.0.8:1")
    await one_round(alone)
    assert found == [("bare", "tcp/10.0.0.8:1"), (alone.peer, "tcp/10.0.0.8:1")]
    assert called == [("bare", "tcp/10.0.0.9:1")], "the other one is dialled already"

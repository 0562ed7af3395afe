import struct
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from queue import Queue
from types import SimpleNamespace
from typing import Any
from uuid import uuid4

import pytest
import zenoh
from support.processes import PATIENCE

from tfbus.links._history import LONGEST_HISTORY
from tfbus.links._message import MAX_BYTES, Message
from tfbus.links._receive_queue import Answer, HistoryAnswer, HistoryQuestion, Presence, Question, Received
from tfbus.links.zenoh._filters import name_of, write_filter
from tfbus.links.zenoh._keys import FIRST_SESSION, NO_ROBOT, Keys
from tfbus.links.zenoh._session import MOST_NAMES, MOST_QUESTIONS, ZenohSession
from tfbus.links.zenoh._settings import settings
from tfbus.tf_message import MalformedMessageError

A, B = uuid4().hex, uuid4().hex


class End:
    """One session, and the items that it has received."""

    def __init__(self, id: str, domain: str, config: zenoh.Config) -> None:  # noqa: A002
        self.id = id
        self.items: Queue[Received] = Queue()
        self.heard_by: Queue[bytes] = Queue()
        self.session = ZenohSession(config, Keys(domain, id), self.items.put, self._note, note_heard=self.heard_by.put)

    def _note(self, link: str, name: str, presence: Presence, robot: str) -> None:
        assert (name, robot) == (FIRST_SESSION, NO_ROBOT)
        self.items.put(Received(link, presence))

    def next(self) -> Received:
        return self.items.get(timeout=PATIENCE)

    def up_to(self, sender: str, content: Any) -> list[Received]:
        """The items up to one with some content, which is the last of them."""
        came = [self.next()]
        while (came[-1].sender, came[-1].content) != (sender, content):
            came.append(self.next())
        return came


Join = Callable[[str], End]


@pytest.fixture
def join(address: str, domain: str) -> Iterator[Join]:
    """Opens a session; the first one is where others connect to."""
    with ExitStack() as stack:
        ends: list[End] = []

        def open_one(id: str) -> End:  # noqa: A002
            end = End(id, domain, settings([] if ends else address, address if ends else None, None, 2.0))
            stack.callback(end.session.close)
            end.session.open()
            ends.append(end)
            return end

        yield open_one


@contextmanager
def stranger(address: str, domain: str) -> Iterator[zenoh.Session]:
    """A program that speaks zenoh and has no link; it has found a program that has one."""
    session = zenoh.open(settings([], address, None, 2.0))
    found: Queue[zenoh.Sample] = Queue()
    watch = session.liveliness().declare_subscriber(f"tfbus/{domain}/*/@alive/*/*", found.put, history=True)
    try:
        found.get(timeout=PATIENCE)
        watch.undeclare()
        yield session
    finally:
        session.close()


def meet(first: End, second: End) -> None:
    """Wait until both know of each other."""
    first.up_to(second.id, Presence.JOINED)
    second.up_to(first.id, Presence.JOINED)


def test_each_end_receives_that_the_other_has_joined_and_left(join: Join) -> None:
    first, second = join(A), join(B)
    assert first.next() == Received(B, Presence.JOINED)
    assert second.next() == Received(A, Presence.JOINED)
    second.session.close()
    assert first.next() == Received(B, Presence.LEFT)


def test_a_live_message_is_received_as_payload_and_attachment_with_its_size(join: Join) -> None:
    first, second = join(A), join(B)
    meet(first, second)
    first.session.publishers.put(Message(b"payload", b"beside", 1))
    assert second.next() == Received(A, (b"payload", b"beside"), 13, moving=True)
    second.session.publishers.put(Message(b"", b"", 0))
    # Its own message did not come back.
    assert first.next() == Received(B, (b"", b""), 0, moving=True)


def test_a_question_and_its_answer_are_received(join: Join) -> None:
    first, second = join(A), join(B)
    meet(first, second)
    second.session.ask(A, 2**40)
    question = first.next()
    assert (question.sender, question.content.since, question.moving) == ("", 2**40, False)
    first.session.answer(question.content.handle, Message(b"payload", b"beside", 1))
    assert second.next() == Received(A, Answer((b"payload", b"beside")), 13)


def test_a_question_tells_that_the_peer_is_heard_if_it_is(join: Join, domain: str) -> None:
    first, second = join(A), join(B)
    meet(first, second)
    for heard in ({}, {"heard": True}):
        second.session.ask(A, 0, **heard)
        first.next().content.handle.drop()
    assert first.heard_by.get(timeout=PATIENCE) == Keys(domain, B).token(FIRST_SESSION).encode()
    assert first.heard_by.empty()


def test_a_question_that_is_not_answered_ends(join: Join) -> None:
    first, second = join(A), join(B)
    meet(first, second)
    second.session.ask(A, 0)
    first.next().content.handle.drop()
    assert second.next() == Received(A, Answer(None))


def test_questions_are_limited_in_number_and_malformed_ones_are_dropped(join: Join, address: str, domain: str) -> None:
    first = join(A)
    with stranger(address, domain) as session:
        key = f"tfbus/{domain}/~/state/{A}"
        for payload in (None, b"", bytes(7), bytes(9)):
            assert list(session.get(key, payload=payload)) == []
        replies = [session.get(key, payload=bytes(8)) for _ in range(MOST_QUESTIONS + 1)]
        refused = [first.next().content for _ in range(4)]
        assert [error.reason for error in refused] == ["question"] * 4
        questions = [first.next().content for _ in range(MOST_QUESTIONS)]
        assert list(replies[-1]) == []
        assert first.next().content.reason == "busy"
        for question in questions:
            first.session.answer(question.handle, Message(b"payload", b"", 0))
        assert [len(list(reply)) for reply in replies[:-1]] == [1] * MOST_QUESTIONS
        again = session.get(key, payload=bytes(8))
        first.session.answer(first.next().content.handle, Message(b"payload", b"", 0))
        assert len(list(again)) == 1
    assert not first.session._questions


def test_the_end_does_not_overtake_a_live_message(join: Join) -> None:
    first, second = join(A), join(B)
    meet(first, second)
    for number in range(200):
        first.session.publishers.put(Message(b"%d" % number, b"", 1))
    first.session.close()
    came = [item.content for item in second.up_to(A, Presence.LEFT)[:-1]]
    assert came == [(b"%d" % number, b"") for number in range(200)]


def test_a_message_without_an_attachment_is_received_with_an_empty_one(join: Join, address: str, domain: str) -> None:
    first = join(A)
    with stranger(address, domain) as session:
        session.put(f"tfbus/{domain}/~/live/{B}", b"payload")
        assert first.next() == Received(B, (b"payload", b""), 7, moving=True)


KEYS_WITHOUT_A_LINK = [
    "**",
    "tfbus/**",
    "tfbus/{domain}/**",
    "tfbus/{domain}/*/*/{id}",
    "tfbus/{domain}/*/live/{id}",
    "tfbus/{domain}/~/live/*",
    "tfbus/{domain}/~/live/robot",
    "tfbus/{domain}/~/live/{id}0",
    "tfbus/{domain}/~/live/ä",
    "tfbus/{domain}/ä/live/{id}",
    "tfbus/{domain}/~/live/" + "x" * 5_000,
]


@pytest.mark.parametrize("key", KEYS_WITHOUT_A_LINK)
def test_a_message_whose_key_names_no_link_is_refused(
    key: str, join: Join, address: str, domain: str, capfd: pytest.CaptureFixture[str]
) -> None:
    first = join(A)
    with stranger(address, domain) as session:
        session.put(key.format(domain=domain, id=B), b"payload")
        item = first.next()
        session.put(f"tfbus/{domain}/~/live/{B}", b"the next one")
        *others, _ = first.up_to(B, (b"the next one", b""))
    assert (item.sender, item.moving, item.content.reason) == ("", False, "key")
    assert len(str(item.content)) < 400
    assert others == []
    assert "error" not in capfd.readouterr().err


@pytest.mark.parametrize("key", ["~/live/{id}/more", "live/{id}", "~/state/{id}", "{id}"])
def test_other_keys_of_the_domain_are_not_received(key: str, join: Join, address: str, domain: str) -> None:
    first = join(A)
    with stranger(address, domain) as session:
        session.put(f"tfbus/{domain}/{key.format(id=B)}", b"payload")
        session.put(f"tfbus/{domain}/~/live/{B}", b"the next one")
        assert first.next().content == (b"the next one", b"")


@pytest.mark.parametrize(
    "token",
    [
        "tfbus/{domain}/~/@alive/*/0",
        "tfbus/{domain}/~/@alive/robot/0",
        "tfbus/{domain}/~/@alive/{id}/x",
        "*/*/*/@alive/{id}/0",
    ],
)
def test_a_token_whose_key_names_no_link_is_refused(token: str, join: Join, address: str, domain: str) -> None:
    first = join(A)
    with stranger(address, domain) as session:
        declared = session.liveliness().declare_token(token.format(domain=domain, id=B))
        item = first.next()
        assert (item.sender, item.content.reason) == ("", "key")
        declared.undeclare()


def test_deletions_are_not_received(join: Join, address: str, domain: str) -> None:
    first = join(A)
    with stranger(address, domain) as session:
        session.delete(f"tfbus/{domain}/~/live/{B}")
        session.put(f"tfbus/{domain}/~/live/{B}", b"the next one")
        assert first.next().content == (b"the next one", b"")


@pytest.mark.parametrize("sizes", [(MAX_BYTES + 1, 0), (0, MAX_BYTES + 1), (MAX_BYTES, 1)])
def test_a_message_that_is_too_large_is_refused(sizes: tuple[int, int], join: Join, address: str, domain: str) -> None:
    first = join(A)
    with stranger(address, domain) as session:
        payload, attachment = map(bytes, sizes)
        block = zenoh.CongestionControl.BLOCK
        session.put(f"tfbus/{domain}/~/live/{B}", payload, attachment=attachment, congestion_control=block)
        item = first.next()
    assert isinstance(item.content, MalformedMessageError)
    assert (item.sender, item.content.reason) == (B, "oversized")
    assert item.size == 0


def test_the_largest_message_is_received(join: Join, address: str, domain: str) -> None:
    first = join(A)
    with stranger(address, domain) as session:
        block = zenoh.CongestionControl.BLOCK
        session.put(f"tfbus/{domain}/~/live/{B}", bytes(MAX_BYTES), congestion_control=block)
        item = first.next()
    assert (item.size, item.content) == (MAX_BYTES, (bytes(MAX_BYTES), b""))


def test_a_client_that_reaches_nobody_raises(domain: str, address: str) -> None:
    config = settings(None, address, {"mode": "client"}, 2.0)
    with pytest.raises(OSError, match="Unable to connect"):
        ZenohSession(config, Keys(domain, A), print, print).open()


def test_a_session_closed_before_it_was_open_does_not_stay_open(join: Join, domain: str, address: str) -> None:
    first = join(A)
    second = End(B, domain, settings([], address, None, 2.0))
    second.session.close()
    second.session.open()
    assert second.session.session.is_closed()
    assert not second.session.is_open
    third = join(uuid4().hex)
    # The one that joins after it is the first that is seen.
    assert first.next() == Received(third.id, Presence.JOINED)
    second.session.close()
    assert second.items.empty()


def closed_end() -> End:
    """An end that was not opened; a test calls it as zenoh's threads do."""
    return End(A, "yard", zenoh.Config())


class Payload(bytes):
    """The bytes of a sample, as zenoh has them."""

    def to_bytes(self) -> bytes:
        return bytes(self)


class Asked:
    """A query, and whether it was dropped."""

    key_expr = "tfbus/yard/~/history/" + A
    attachment: Payload | None = None

    def __init__(self, payload: bytes | None) -> None:
        self.payload = None if payload is None else Payload(payload)
        self.dropped = 0

    def drop(self) -> None:
        self.dropped += 1


@pytest.mark.parametrize(
    ("payload", "asked"),
    [
        (None, None),
        (bytes(7), None),
        (struct.pack("<d", 1.5), (1.5, "")),
        (struct.pack("<d", 1.5) + b"lidar", (1.5, "lidar")),
        (struct.pack("<d", 1.5) + b"x" * 2**16, (1.5, "x" * 2**16)),
        (struct.pack("<d", 1.5) + b"x" * (2**16 + 1), None),
        (struct.pack("<d", LONGEST_HISTORY), (LONGEST_HISTORY, "")),
        (struct.pack("<d", LONGEST_HISTORY * 1.001), None),
        (struct.pack("<d", 0.25), (0.25, "")),
        (struct.pack("<d", 0.0), None),
        (struct.pack("<d", float("nan")), None),
        (struct.pack("<d", 1.5) + b"\xff", None),
    ],
)
def test_a_question_for_the_last_seconds_is_received_or_refused(
    payload: bytes | None, asked: tuple[float, str] | None
) -> None:
    end, query = closed_end(), Asked(payload)
    if asked is None:
        with pytest.raises(ValueError, match=r"question|utf-8"):
            end.session._receive_history_question(query)  # type: ignore[arg-type]
        assert (end.items.qsize(), len(end.session._questions)) == (0, 0)
        return
    end.session._receive_history_question(query)  # type: ignore[arg-type]
    question = end.next().content
    assert isinstance(question, HistoryQuestion)
    assert ((question.seconds, question.after), question.handle.query, query.dropped) == (asked, query, 0)
    assert len(end.session._questions) == 1
    # Whatever becomes of it, it takes no place of others.
    del question
    assert not end.session._questions


def test_of_what_a_question_brings_only_so_much_is_read() -> None:
    end, query = closed_end(), Asked(bytes(8))
    query.attachment = Payload(b"x" * (MOST_NAMES + 1))
    end.session._receive_question(query)  # type: ignore[arg-type]
    assert end.heard_by.get_nowait() == b"x" * MOST_NAMES
    end.session._note_heard = None
    end.session._receive_question(query)  # type: ignore[arg-type]
    assert (end.items.qsize(), query.dropped) == (2, 0)


def test_the_filters_of_others_come_and_go_and_wrong_ones_are_refused() -> None:
    end = closed_end()
    for link in (A, B):
        token = Keys("yard", link, filter=write_filter(["*"], ["base"])).filter_token(FIRST_SESSION)
        came = SimpleNamespace(key_expr=token, kind=zenoh.SampleKind.PUT)
        went = SimpleNamespace(key_expr=token, kind=zenoh.SampleKind.DELETE)
        end.session._receive_filter(came)  # type: ignore[arg-type]
        # Its own is no peer's.
        assert len(end.session._filters.wanted) == (link == B)
    end.session._receive_filter(went)  # type: ignore[arg-type]
    assert end.session._filters.wanted == {}
    end.session._closed = True
    end.session._receive_filter(came)  # type: ignore[arg-type]
    assert end.session._filters.wanted == {}
    assert end.items.empty()
    end.session._closed = False
    malformed = Keys("yard", B, filter="x").filter_token(FIRST_SESSION)
    for key, sender, reason in (("tfbus/yard/x", "", "key"), (malformed, B, "filter")):
        wrong = SimpleNamespace(key_expr=key, kind=zenoh.SampleKind.PUT)
        end.session._receive_filter(wrong)  # type: ignore[arg-type]
        item = end.next()
        assert (item.sender, item.content.reason) == (sender, reason)


def test_the_filter_of_a_link_that_was_there_before_is_known_as_soon_as_the_link_is(address: str, domain: str) -> None:
    chunk = write_filter(["*"], ["base"])
    first = ZenohSession(settings(address, [], None, 2.0), Keys(domain, A, filter=chunk), print, lambda *_: None)
    second = End(B, domain, settings([], address, None, 2.0))
    with ExitStack() as stack:
        for session in (first, second.session):
            stack.callback(session.close)
            session.open()
        assert second.next() == Received(A, Presence.JOINED)
        assert second.session._filters.wanted == {name_of(chunk): {"base"}}


def test_a_link_hears_presence_of_others_only() -> None:
    end = closed_end()
    for link in (A, B):
        for kind in (zenoh.SampleKind.PUT, zenoh.SampleKind.DELETE):
            sample: Any = SimpleNamespace(key_expr=Keys("yard", link).token(FIRST_SESSION), kind=kind)
            end.session._receive_presence(sample)
    assert [end.next() for _ in range(2)] == [Received(B, Presence.JOINED), Received(B, Presence.LEFT)]
    assert end.items.empty()


def test_of_the_slow_keys_of_others_messages_are_received_at_their_rate_and_no_deletions() -> None:
    end = closed_end()
    receive = end.session._receive_slow(0.001)
    for link in (A, B, B):
        key = Keys("yard", link).own("slow")
        for kind, payload in ((zenoh.SampleKind.DELETE, b""), (zenoh.SampleKind.PUT, b"put")):
            sample: Any = SimpleNamespace(key_expr=key, kind=kind, payload=Payload(payload), attachment=None)
            receive(sample)
    # What comes together is one.
    assert [end.next() for _ in range(2)] == [Received(B, (b"put", b""), 3, moving=True)] * 2
    assert end.items.empty()


def test_a_peer_without_the_filter_is_heard_by_its_live_key_alone() -> None:
    end = closed_end()
    end.session._keys = keys = Keys("yard", A, filter=write_filter(["*"], ["base"]))
    live, part = (
        SimpleNamespace(key_expr=key, kind=zenoh.SampleKind.PUT, payload=Payload(data), attachment=beside)
        for key, data, beside in (
            (Keys("yard", B).own("live"), b"all", None),
            (Keys("yard", B).part(name_of(keys.filter)), b"part", Payload(b"!")),
        )
    )
    end.session._receive_all(live)  # type: ignore[arg-type]
    assert end.next() == Received(B, (b"all", b""), 3, moving=True)
    end.session._receive_live(part)  # type: ignore[arg-type]
    assert end.next() == Received(B, (b"part", b"!"), 5, moving=True)
    end.session._unfiltered = {B: None}  # type: ignore[dict-item]
    end.session._receive_live(part)  # type: ignore[arg-type]
    live.kind = zenoh.SampleKind.DELETE
    end.session._receive_all(live)  # type: ignore[arg-type]
    assert end.items.empty()


class Network:
    """Notes the questions that a session asks; a test answers them as zenoh's threads do."""

    def __init__(self, end: End, failing: bool = False) -> None:
        self.asked: list[tuple[str, zenoh.handlers.Callback[Any], dict[str, Any]]] = []
        self._failing = failing
        end.session._session = self  # type: ignore[assignment]

    def get(self, key: str, handler: Any, **options: Any) -> None:
        if self._failing:
            raise zenoh.ZError("the session is closed")
        self.asked.append((key, handler, options))

    def reply(self, payload: bytes | None, encoding: str = "", end: bool = True) -> None:
        """Answer the newest question, and end it; an error for None."""
        _, handler, _ = self.asked[-1]
        sample = SimpleNamespace(payload=Payload(payload or b""), attachment=Payload(b"!"), encoding=encoding)
        handler.callback(SimpleNamespace(ok=None if payload is None else sample))
        if end:
            handler.drop()  # type: ignore[misc]


def test_an_answer_is_received_once_and_tells_whether_the_filter_is_served() -> None:
    end, served = closed_end(), list[tuple[str, bool]]()
    end.session._note_served = lambda *noted: served.append(noted)
    network = Network(end)
    end.session.ask(B, 5, heard=True)
    network.reply(None, end=False)
    network.reply(b"first", "tfbus/state;filters", end=False)
    network.reply(b"second")
    assert end.next() == Received(B, Answer((b"first", b"!")), 6)
    end.session.ask(B, 6)
    network.reply(b"older", "tfbus/state")
    assert end.next() == Received(B, Answer((b"older", b"!")), 6)
    end.session.ask_history(B, 1.5, "lidar")
    network.reply(b"history", "tfbus/state")
    assert end.next() == Received(B, HistoryAnswer((b"history", b"!")), 8)
    assert served == [(B, True), (B, False)]
    end.session.ask(B, 7)
    network.reply(None)
    assert end.next() == Received(B, Answer(None))
    kinds = ("state", "state", "history", "state")
    assert [key for key, _, _ in network.asked] == [f"tfbus/yard/*/{kind}/{B}" for kind in kinds]
    options = [options for _, _, options in network.asked]
    assert [each["payload"] for each in options[1:3]] == [struct.pack("<Q", 6), struct.pack("<d", 1.5) + b"lidar"]
    assert [each["attachment"] for each in options[:3]] == [Keys("yard", A).token(FIRST_SESSION), None, None]
    assert not any(handler.indirect for _, handler, _ in network.asked), "a thread of its own would come later"
    Network(end, failing=True)
    end.session.ask(B, 8)
    assert end.next() == Received(B, Answer(None))
    assert end.items.empty()


@pytest.mark.parametrize(
    ("replies", "names"),
    [
        ((), None),
        ((None,), None),
        ((b"",), []),
        ((None, b"0,x"), ["0", "x"]),
        ((b"0", b"1"), ["0"]),
        ((b"x" * MOST_NAMES + b"y",), ["x" * MOST_NAMES]),
        ((b"\xff",), ["\ufffd"]),
    ],
)
def test_the_sessions_that_a_peer_hears_are_told_once(replies: Sequence[bytes | None], names: list[str] | None) -> None:
    end, told = closed_end(), list[tuple[list[str] | None, bytes]]()
    network = Network(end)
    end.session.ask_hearing(B, lambda *answer: told.append(answer), b"known")
    for reply in replies:
        network.reply(reply, end=False)
    ((key, handler, options),) = network.asked
    handler.drop()  # type: ignore[misc]
    assert told == [(names, b"" if names is None else b"!")]
    assert (key, options["payload"]) == (f"tfbus/yard/*/hears/{B}", Keys("yard", A).token(FIRST_SESSION))
    assert options["attachment"] == b"known"
    assert not handler.indirect, "a thread of its own would come later"
    Network(end, failing=True)
    end.session.ask_hearing(B, lambda *answer: told.append(answer))
    assert len(told) == 1


def test_whoever_asks_is_told_the_sessions_that_are_heard_of_it() -> None:
    replies: list[tuple[str, str, bytes | None]] = []

    class Heard(Asked):
        def reply(self, key: str, names: str, attachment: bytes | None) -> None:
            if self.payload is None:
                raise zenoh.ZError("the asker has gone")
            replies.append((key, names, attachment))

    queries: list[Any] = [Heard(None), Heard(b"a"), Heard(b"b")]
    names = [["gone"], ["0", "x"], ["x" * (MOST_NAMES + 1)]]
    closed_end().session.answer_hearing(zip(queries, names, (b"", b"named", b""), strict=True))
    own = f"tfbus/yard/~/hears/{A}"
    assert replies == [(own, "0,x", b"named"), (own, "x" * MOST_NAMES, None)]
    assert [query.dropped for query in queries] == [1, 1, 1]


def test_connections_are_noted_with_their_session_and_both_addresses() -> None:
    end, noted = closed_end(), list[tuple[str, str, str]]()
    event: Any = SimpleNamespace(link=SimpleNamespace(zid=7, src="tcp/127.0.0.1:1", dst="tcp/127.0.0.1:2"))
    end.session._receive_connection(event)
    end.session._note_connection = lambda *connection: noted.append(connection)
    end.session._receive_connection(event)
    assert noted == [("7", "tcp/127.0.0.1:1", "tcp/127.0.0.1:2")]


def test_connections_are_told_that_were_made_while_the_session_began_and_later(address: str, domain: str) -> None:
    (here, near), (there, far) = ((f"{uuid4().int | 1 << 127:032x}", Queue[tuple[str, str, str]]()) for _ in range(2))
    with ExitStack() as stack:
        for id, noted in ((here, near), (there, far)):  # noqa: A001
            config = settings([] if noted is far else address, address if noted is far else None, {"id": id}, 2.0)
            note = lambda *connection, noted=noted: noted.put(connection)  # noqa: E731
            session = ZenohSession(config, Keys(domain, id), print, print, note_connection=note)
            stack.callback(session.close)
            session.open()
        dialled, accepted = far.get(timeout=PATIENCE), near.get(timeout=PATIENCE)
    assert (dialled[0], dialled[2]) == (here, address)
    assert (accepted[0], accepted[1]) == (there, address)
    assert accepted[2] == dialled[1]


def test_a_session_that_is_closed_need_not_be_closed_at_the_end_of_the_program() -> None:
    session = ZenohSession(settings("tcp/127.0.0.1:0", [], None, 2.0), Keys("yard", A), print, print)
    assert not session.is_open
    session.open()
    at_exit = session._close_at_exit
    assert at_exit is not None
    assert (session.is_open, at_exit.alive) == (True, True)
    session.close().join()
    assert not at_exit.alive


def test_a_session_opens_in_a_thread_that_the_interpreter_waits_for() -> None:
    end, daemons = closed_end(), list[bool]()
    end.session._open = lambda: daemons.append(threading.current_thread().daemon)  # type: ignore[method-assign]
    # As a worker thread of trio.
    worker = threading.Thread(target=end.session.open, daemon=True)
    worker.start()
    worker.join()
    assert daemons == [False]


def test_a_link_with_a_filter_hears_all_of_some_peers_while_they_need_it(address: str, domain: str) -> None:
    chunk, came, met = write_filter(["*"], ["base"]), Queue[Received](), Queue[str]()
    here = ZenohSession(
        settings(address, [], None, 2.0),
        Keys(domain, A, filter=chunk),
        came.put,
        lambda link, *_: met.put(link),
    )
    peers = [End(link, domain, settings([], address, None, 2.0)) for link in (B, uuid4().hex)]
    with ExitStack() as stack:
        for session in (here, *(peer.session for peer in peers)):
            stack.callback(session.close)
            session.open()
        assert {met.get(timeout=PATIENCE) for _ in peers} == {peer.id for peer in peers}
        for unfiltered in ({B}, {B}, {peer.id for peer in peers}, {peers[1].id}, {peers[1].id, "gone"}, set(), {B}):
            here.hear_all_of(unfiltered)
            for peer in peers:
                # The question goes behind what was declared, and its end comes behind what was sent.
                here.ask(peer.id, 0)
                questions = (item.content for item in iter(peer.next, None))
                question = next(content for content in questions if isinstance(content, Question))
                for kind in ("all", "part", "all"):
                    message = Message(kind.encode(), b"", 1)
                    if kind == "all":
                        peer.session.publishers.put(message)
                    else:
                        peer.session.publishers.put_part(name_of(chunk), message)
                question.handle.drop()
                heard = iter(lambda: came.get(timeout=PATIENCE).content, Answer(None))
                assert [payload for payload, _ in heard] == ([b"all"] * 2 if peer.id in unfiltered else [b"part"])


def test_a_session_that_has_ended_has_no_connections() -> None:
    end = closed_end()
    end.session._session = zenoh.open(settings("tcp/127.0.0.1:0", [], None, 2.0))
    assert (end.session.connected(), end.session.routers()) == (set(), [])
    end.session._session.close()
    assert (end.session.connected(), end.session.routers()) == (set(), [])

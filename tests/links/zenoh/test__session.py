import errno
import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from queue import Queue
from typing import Any
from uuid import uuid4

import pytest
import zenoh
from support.processes import PATIENCE, free_ports, new_domain

from tfbus.links.outbox import MAX_BYTES, Message
from tfbus.links.receive_queue import Arrival
from tfbus.links.zenoh._session import ZenohSession
from tfbus.links.zenoh._settings import settings
from tfbus.tf_message import MalformedMessageError

A, B = uuid4().hex, uuid4().hex


class End:
    """One session, and what it has brought."""

    def __init__(self, id: str, prefix: str, config: zenoh.Config) -> None:  # noqa: A002
        self.id = id
        self.arrivals: Queue[Arrival] = Queue()
        self.session = ZenohSession(config, prefix, id, self.arrivals.put)

    def next(self) -> Arrival:
        return self.arrivals.get(timeout=PATIENCE)

    def up_to(self, sender: str, content: Any) -> list[Arrival]:
        """All that comes before something, which is the last one."""
        came = [self.next()]
        while (came[-1].sender, came[-1].content) != (sender, content):
            came.append(self.next())
        return came


@pytest.fixture
def address() -> str:
    return f"tcp/127.0.0.1:{free_ports(1)[0]}"


@pytest.fixture
def prefix() -> str:
    return f"tfbus/{new_domain()}"


Join = Callable[[str], End]


@pytest.fixture
def join(address: str, prefix: str) -> Iterator[Join]:
    """Opens a session; the first one is where others connect to."""
    with ExitStack() as stack:
        ends: list[End] = []

        def open_one(id: str) -> End:  # noqa: A002
            end = End(id, prefix, settings([] if ends else address, address if ends else None, None, 2.0))
            stack.callback(end.session.close)
            end.session.open()
            ends.append(end)
            return end

        yield open_one


@contextmanager
def stranger(address: str, prefix: str) -> Iterator[zenoh.Session]:
    """A program that speaks zenoh and has no link; it has found somebody who has one."""
    session = zenoh.open(settings([], address, None, 2.0))
    found: Queue[zenoh.Sample] = Queue()
    watch = session.liveliness().declare_subscriber(f"{prefix}/@alive/*", found.put, history=True)
    try:
        found.get(timeout=PATIENCE)
        watch.undeclare()
        yield session
    finally:
        session.close()


def meet(first: End, second: End) -> None:
    """Wait until both know of each other."""
    first.up_to(second.id, True)
    second.up_to(first.id, True)


def test_each_hears_that_the_other_is_there_and_that_it_has_gone(join: Join) -> None:
    first, second = join(A), join(B)
    assert first.next() == Arrival(B, True)
    assert second.next() == Arrival(A, True)
    second.session.close()
    assert first.next() == Arrival(B, False)


def test_a_live_message_comes_as_two_pieces_of_bytes_with_its_size(join: Join) -> None:
    first, second = join(A), join(B)
    meet(first, second)
    first.session.put(Message(b"payload", b"beside", 1))
    assert second.next() == Arrival(A, (b"payload", b"beside"), 13, moving=True)
    second.session.put(Message(b"", b"", 0))
    # Its own one did not come back.
    assert first.next() == Arrival(B, (b"", b""), 0, moving=True)


def test_a_static_message_comes_to_those_who_are_there_and_to_those_who_come_later(join: Join) -> None:
    first = join(A)
    assert first.session.statics.apply({"lidar": Message(b"old", b"1", 1)}) == []
    second = join(B)
    assert second.up_to(A, (b"old", b"1"))[-1] == Arrival(A, (b"old", b"1"), 4, moving=False)
    assert first.session.statics.apply({"lidar": Message(b"new", b"2", 1)}) == []
    assert second.up_to(A, (b"new", b"2"))[-1] == Arrival(A, (b"new", b"2"), 4, moving=False)


def test_what_was_heard_is_heard_again_if_that_is_wanted(join: Join) -> None:
    first, second = join(A), join(B)
    meet(first, second)
    assert first.session.statics.apply({"lidar": Message(b"there", b"", 1)}) == []
    assert second.next() == Arrival(A, (b"there", b""), 5, moving=False)
    second.session.hear_again()
    assert second.next() == Arrival(A, (b"there", b""), 5, moving=False)
    # And from now on once again.
    assert first.session.statics.apply({"lidar": Message(b"new", b"", 1)}) == []
    assert second.next() == Arrival(A, (b"new", b""), 3, moving=False)
    first.session.put(Message(b"last", b"", 0))
    assert second.next() == Arrival(A, (b"last", b""), 4, moving=True)


def test_a_static_message_never_overtakes_the_live_one_before_it_nor_the_end_a_live_one(join: Join) -> None:
    first, second = join(A), join(B)
    meet(first, second)
    for number in range(200):
        message = Message(b"%d" % number, b"", 1)
        first.session.put(message)
        assert first.session.statics.apply({f"frame {number}": message}) == []
    first.session.close()
    came = [(int(arrival.content[0]), arrival.moving) for arrival in second.up_to(A, False)[:-1]]
    assert [number for number, moving in came if moving] == list(range(200))
    # It may come later, when zenoh asks for what there is on a key that is new.
    assert all((number, True) in came[:place] for place, (number, moving) in enumerate(came) if not moving)


def test_a_message_without_an_attachment_comes_with_an_empty_one(join: Join, address: str, prefix: str) -> None:
    first = join(A)
    with stranger(address, prefix) as session:
        session.put(f"{prefix}/live/{B}", b"payload")
        assert first.next() == Arrival(B, (b"payload", b""), 7, moving=True)


KEYS_OF_NOBODY = [
    "**",
    "tfbus/**",
    "{prefix}/**",
    "{prefix}/*/{id}",
    "{prefix}/live/*",
    "{prefix}/live/robot",
    "{prefix}/live/{id}0",
    "{prefix}/live/ä",
    "{prefix}/static/*/*",
    "{prefix}/static/robot/lidar",
    "*/*/static/{id}/lidar",
    "{prefix}/live/" + "x" * 5_000,
]


@pytest.mark.parametrize("key", KEYS_OF_NOBODY)
def test_a_message_whose_key_names_no_link_is_refused(
    key: str, join: Join, address: str, prefix: str, capfd: pytest.CaptureFixture[str]
) -> None:
    first = join(A)
    with stranger(address, prefix) as session:
        session.put(key.format(prefix=prefix, id=B), b"payload")
        arrival = first.next()
        session.put(f"{prefix}/live/{B}", b"the next one")
        *others, _ = first.up_to(B, (b"the next one", b""))
    assert (arrival.sender, arrival.moving, arrival.content.reason) == ("", False, "key")
    assert len(str(arrival.content)) < 400
    # A key may be for both subscribers, live and static.
    assert {other.content.reason for other in others} <= {"key"}
    assert "error" not in capfd.readouterr().err


@pytest.mark.parametrize("key", ["{prefix}/live/{id}/more", "{prefix}/static/{id}", "{prefix}/{id}", "{prefix}/live"])
def test_other_keys_of_the_domain_do_not_come(key: str, join: Join, address: str, prefix: str) -> None:
    first = join(A)
    with stranger(address, prefix) as session:
        session.put(key.format(prefix=prefix, id=B), b"payload")
        session.put(f"{prefix}/live/{B}", b"the next one")
        assert first.next().content == (b"the next one", b"")


@pytest.mark.parametrize("token", ["{prefix}/@alive/*", "{prefix}/@alive/robot", "*/*/@alive/{id}"])
def test_whoever_is_there_under_a_name_that_is_no_links_is_refused(
    token: str, join: Join, address: str, prefix: str
) -> None:
    first = join(A)
    with stranger(address, prefix) as session:
        declared = session.liveliness().declare_token(token.format(prefix=prefix, id=B))
        arrival = first.next()
        assert (arrival.sender, arrival.content.reason) == ("", "key")
        declared.undeclare()


def test_what_is_deleted_does_not_come(join: Join, address: str, prefix: str) -> None:
    first = join(A)
    with stranger(address, prefix) as session:
        session.delete(f"{prefix}/live/{B}")
        session.put(f"{prefix}/live/{B}", b"the next one")
        assert first.next().content == (b"the next one", b"")


@pytest.mark.parametrize("sizes", [(MAX_BYTES + 1, 0), (0, MAX_BYTES + 1), (MAX_BYTES, 1)])
def test_a_message_that_is_too_large_is_refused(sizes: tuple[int, int], join: Join, address: str, prefix: str) -> None:
    first = join(A)
    with stranger(address, prefix) as session:
        payload, attachment = map(bytes, sizes)
        block = zenoh.CongestionControl.BLOCK
        session.put(f"{prefix}/live/{B}", payload, attachment=attachment, congestion_control=block)
        arrival = first.next()
    assert isinstance(arrival.content, MalformedMessageError)
    assert (arrival.sender, arrival.content.reason) == (B, "oversized")
    assert arrival.size == 0


def test_the_largest_message_comes(join: Join, address: str, prefix: str) -> None:
    first = join(A)
    with stranger(address, prefix) as session:
        block = zenoh.CongestionControl.BLOCK
        session.put(f"{prefix}/live/{B}", bytes(MAX_BYTES), congestion_control=block)
        arrival = first.next()
    assert (arrival.size, arrival.content) == (MAX_BYTES, (bytes(MAX_BYTES), b""))


def test_a_port_that_is_taken_is_an_error_of_the_system(prefix: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        config = settings(f"tcp/127.0.0.1:{server.getsockname()[1]}", None, None, 2.0)
        with pytest.raises(OSError, match="zenoh cannot open a session") as caught:
            ZenohSession(config, prefix, A, print).open()
    assert caught.value.errno == errno.EADDRINUSE
    assert ".rs:" not in str(caught.value)


def test_what_only_zenoh_has_against_an_address_has_no_number(prefix: str) -> None:
    config = settings("tls/127.0.0.1:0", None, None, 2.0)
    with pytest.raises(OSError, match="private key") as caught:
        ZenohSession(config, prefix, A, print).open()
    assert caught.value.errno is None


def test_a_client_says_that_nobody_is_there(prefix: str, address: str) -> None:
    config = settings(None, address, {"mode": "client"}, 2.0)
    with pytest.raises(OSError, match="Unable to connect"):
        ZenohSession(config, prefix, A, print).open()


def test_a_session_that_was_closed_before_it_was_open_does_not_stay_open(join: Join, prefix: str, address: str) -> None:
    first = join(A)
    second = End(B, prefix, settings([], address, None, 2.0))
    second.session.close()
    second.session.open()
    third = join(uuid4().hex)
    # Whoever comes behind it is the first to be seen.
    assert first.next() == Arrival(third.id, True)
    second.session.close()
    assert second.arrivals.empty()

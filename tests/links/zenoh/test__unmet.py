from contextlib import ExitStack
from queue import Queue
from uuid import uuid4

import pytest
import zenoh

from tfbus.links._receive_queue import Received
from tfbus.links.zenoh._dialing import MOST_ADDRESSES
from tfbus.links.zenoh._keys import Keys
from tfbus.links.zenoh._session import ZenohSession
from tfbus.links.zenoh._settings import settings
from tfbus.links.zenoh._unmet import MOST_ROUTERS, MOST_UNMET, PAUSES, Unmet, find_deaf


class Scene:
    def __init__(self) -> None:
        self.time = 50.0
        keys = Keys("tf", uuid4().hex)
        own = ZenohSession(zenoh.Config(), keys, Queue[Received]().put, lambda *_: None)
        self.unmet = Unmet(own, keys, lambda: self.time)

    def wait(self, seconds: float, *present: str) -> list[str]:
        self.time += seconds
        return [session for session, _ in self.unmet.take_due(present)]

    def connected(self, session: str, address: str = "tcp/x:1") -> None:
        self.unmet.connected(session, address)


def test_a_connection_is_looked_after_several_times_and_then_no_more() -> None:
    scene = Scene()
    assert scene.unmet.next_due() is None
    scene.connected("a")
    for pause in PAUSES:
        assert scene.unmet.next_due() == pytest.approx(scene.time + pause, abs=0.2)
        assert scene.wait(pause - 0.1) == []
        assert scene.wait(0.2) == ["a"]
    assert scene.wait(1_000) == []


def test_whoever_is_present_is_not_looked_after_later_either() -> None:
    scene = Scene()
    for name in ("a", "b"):
        scene.connected(name)
    assert scene.wait(0.1, "a") == []
    assert scene.wait(1_000) == ["b"]


def test_a_connection_that_is_made_again_is_looked_after_anew() -> None:
    scene = Scene()
    scene.connected("a")
    assert scene.wait(PAUSES[0]) == ["a"]
    scene.connected("a")
    assert scene.wait(PAUSES[0] - 0.1) == []
    assert scene.wait(0.1) == ["a"]


@pytest.mark.anyio
async def test_zenoh_is_asked_nothing_before_somebody_was_not_met(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene()
    asked: list[str] = []

    def routers(_: ZenohSession) -> list[str]:
        asked.append("routers")
        return ["router"]

    monkeypatch.setattr(ZenohSession, "routers", routers)
    monkeypatch.setattr(ZenohSession, "connected", lambda _: set())
    connected = [("met", "tcp/x:1"), ("unmet", "tcp/y:1"), ("router", "tcp/z:1"), ("dialled", "tcp/u:1")]
    assert await scene.unmet.find(connected, (), "dialled".__eq__) == []
    assert asked == []
    scene.time += PAUSES[0]
    assert await scene.unmet.find([], ("met",), "dialled".__eq__) == [("unmet", "tcp/y:1")]
    assert asked == ["routers"]
    # One that is known for a router is looked after no more, nor asked about.
    assert await scene.unmet.find([("router", "tcp/z:1")], (), "dialled".__eq__) == []
    assert list(scene.unmet._looks) == ["unmet", "dialled"]
    assert asked == ["routers"]


def test_so_many_connections_are_remembered() -> None:
    scene = Scene()
    for number in range(MOST_UNMET + 1):
        scene.connected(f"s{number}")
    scene.time += 1.0
    scene.connected("s0")
    assert scene.wait(PAUSES[0] - 1) == [f"s{number}" for number in range(1, MOST_UNMET)]
    assert scene.wait(1.0) == ["s0"]


def test_a_router_is_not_looked_after_also_when_it_has_gone() -> None:
    scene = Scene()
    scene.connected("a")
    scene.unmet.is_router("a")
    scene.connected("a")
    assert scene.wait(1_000) == []
    # The oldest are forgotten.
    for number in range(MOST_ROUTERS):
        scene.unmet.is_router(f"r{number}")
    for name in ("a", "r0"):
        scene.connected(name)
    assert scene.wait(1_000) == ["a"]


def test_the_newest_addresses_of_a_session_are_told_once_each() -> None:
    scene = Scene()
    for port in (1, 2, 3, 2, 4, 5, 6):
        scene.connected("a", f"tcp/x:{port}")
    scene.time += PAUSES[0]
    newest = [f"tcp/x:{port}" for port in (6, 5, 4, 2)]
    assert len(newest) == MOST_ADDRESSES
    for pause in (0.0, *PAUSES[1:]):
        scene.time += pause
        assert scene.unmet.take_due(()) == [("a", newest)]


def test_a_connected_session_of_another_domain_or_of_a_robot_that_is_not_heard_is_not_deaf(
    address: str, domain: str
) -> None:
    first, *ids, bare = (f"{uuid4().int | 1 << 127:032x}" for _ in range(5))
    here = Keys(domain, first, robots=("r$*",))
    others = [Keys(domain, ids[0], "r1"), Keys(domain, ids[1], "s1"), Keys(f"{domain}/b", ids[2], "r1")]
    with ExitStack() as stack:
        opened: list[ZenohSession] = []
        for keys in (here, *others):
            config = settings([] if opened else address, address if opened else None, {"id": keys.link}, 2.0)
            opened.append(ZenohSession(config, keys, Queue[Received]().put, lambda *_: None))
            stack.callback(opened[-1].close)
            opened[-1].open()
        stack.enter_context(zenoh.open(settings([], address, {"id": bare}, 2.0)))
        gone = uuid4().hex
        looks = [(session, ["tcp/x:1", "tcp/x:2"]) for session in (*ids, bare, gone)]
        found = find_deaf(opened[0], here, looks)
        assert opened[0].connected() == {*ids, bare}
        assert found == [
            look for session in (ids[0], bare, gone) for look in ((session, "tcp/x:1"), (session, "tcp/x:2"))
        ]

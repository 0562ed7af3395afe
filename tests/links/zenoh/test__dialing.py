from types import SimpleNamespace

import anyio
import pytest
from support.processes import free_ports

from tfbus.links.zenoh._dialing import (
    FIRST_PAUSE,
    LONG_PAUSE,
    MOST_PEERS,
    SHORT_PAUSE,
    SHORT_TIME,
    Dialing,
    is_reachable,
)


class Scene:
    def __init__(self) -> None:
        self.time = 50.0
        self.dialing = Dialing(lambda: self.time)

    def next(self) -> tuple[float, list[tuple[str, str]]]:
        """The time until a peer is dialled, and the choice of the peer."""
        due = self.dialing.next_due()
        assert due is not None
        waited, self.time = due - self.time, due
        return waited, self.dialing.take_due()


def test_a_peer_that_was_reached_and_is_lost_is_dialled_until_it_is_back() -> None:
    scene = Scene()
    scene.dialing.reached("a", "tcp/here:1")
    assert scene.dialing.next_due() is None
    scene.dialing.left("a")
    assert scene.dialing.take_due() == []
    waits = []
    for _ in range(5):
        waited, who = scene.next()
        waits.append(round(waited, 6))
        assert who == [("a", "tcp/here:1")]
    assert waits == [FIRST_PAUSE, 2 * FIRST_PAUSE, 4 * FIRST_PAUSE, SHORT_PAUSE, SHORT_PAUSE]
    scene.dialing.joined("a")
    assert scene.dialing.next_due() is None
    scene.dialing.left("a")
    assert round(scene.next()[0], 6) == FIRST_PAUSE


@pytest.mark.parametrize(("waited", "pause"), [(SHORT_TIME - 1, 2 * FIRST_PAUSE), (SHORT_TIME, LONG_PAUSE)])
def test_after_a_while_the_pauses_are_long(waited: float, pause: float) -> None:
    scene = Scene()
    scene.time = 10 * SHORT_TIME
    scene.dialing.reached("a", "tcp/here:1")
    scene.dialing.left("a")
    scene.time += waited
    assert scene.dialing.take_due() == [("a", "tcp/here:1")]
    until_next, who = scene.next()
    assert (round(until_next, 6), who) == (pause, [("a", "tcp/here:1")])


def test_a_peer_that_was_never_reached_is_not_dialled() -> None:
    scene = Scene()
    scene.dialing.left("a")
    assert scene.dialing.next_due() is None


def test_only_the_newest_peers_are_remembered() -> None:
    scene = Scene()
    for number in range(MOST_PEERS + 1):
        scene.dialing.reached(f"{number}", "tcp/here:1")
        scene.dialing.left(f"{number}")
    assert len(scene.next()[1]) == MOST_PEERS
    scene.dialing.left("0")
    assert "0" not in [peer for peer, _ in scene.next()[1]]


def test_all_addresses_of_a_peer_are_tried_in_turn_the_newest_first() -> None:
    scene = Scene()
    for address in ("tcp/there:1", "tcp/there:2", "tcp/there:1", "tcp/there:3"):
        scene.dialing.reached("a", address)
    scene.dialing.left("a")
    tried = [address for _ in range(4) for _, address in scene.next()[1]]
    assert [address[-1] for address in tried] == ["3", "1", "2", "3"]


def test_a_peer_is_dialled_no_more_where_somebody_else_listens_now() -> None:
    scene = Scene()
    for address in ("tcp/there:1", "tcp/there:2"):
        scene.dialing.reached("a", address)
    assert not scene.dialing.is_dialled("a")
    scene.dialing.left("a")
    assert scene.dialing.is_dialled("a")
    scene.dialing.taken("a", "tcp/there:2")
    scene.dialing.taken("a", "tcp/there:3")
    scene.dialing.taken("nobody", "tcp/there:1")
    assert [scene.next()[1] for _ in range(2)] == [[("a", "tcp/there:1")]] * 2
    scene.dialing.taken("a", "tcp/there:1")
    assert scene.dialing.next_due() is None
    assert not scene.dialing.is_dialled("a")


def test_an_address_at_which_nobody_listens_is_forgotten_unless_it_is_the_only_one() -> None:
    scene = Scene()
    for address in ("tcp/there:1", "tcp/there:2"):
        scene.dialing.reached("a", address)
    scene.dialing.refused("a", "tcp/there:3")
    scene.dialing.refused("nobody", "tcp/there:1")
    assert scene.dialing.addresses("a") == ["tcp/there:2", "tcp/there:1"]
    for address in ("tcp/there:2", "tcp/there:1"):
        scene.dialing.refused("a", address)
    assert scene.dialing.addresses("a") == ["tcp/there:1"]
    assert scene.dialing.addresses("nobody") == []


@pytest.mark.anyio
async def test_an_address_is_probed_if_it_is_one_of_tcp() -> None:
    closed = f"127.0.0.1:{free_ports(1)[0]}"
    assert await is_reachable(f"quic/{closed}")
    for protocol in ("tcp", "tls"):
        with pytest.raises(ConnectionRefusedError):
            await is_reachable(f"{protocol}/{closed}")


@pytest.mark.anyio
@pytest.mark.parametrize(
    ("failure", "reachable"), [(None, True), (OSError("no route to host"), False), (TimeoutError(), False)]
)
async def test_whoever_cannot_be_reached_may_listen_later(
    failure: OSError | None, reachable: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    called: list[object] = []

    async def connect(host: str, port: int) -> object:
        called.append((host, port))
        if failure is not None:
            raise failure
        return SimpleNamespace(aclose=close)

    async def close() -> None:
        called.append("close")

    monkeypatch.setattr(anyio, "connect_tcp", connect)
    for address in ("tcp/robot.local:7447", "tls/[fe80::1]:7448#iface=eth0"):
        assert await is_reachable(address) is reachable
    probed = [("robot.local", 7447), ("fe80::1", 7448)]
    assert called == (probed if failure else [probed[0], "close", probed[1], "close"])

from typing import Any

import pytest

from tfbus.links.zenoh._dialing import MOST_ADDRESSES
from tfbus.links.zenoh._listening import MOST_CONNECTIONS, Listening
from tfbus.links.zenoh._settings import MEETING_POINT, settings


def listening(listen: Any = None, connect: Any = None, config: Any = None) -> Listening:
    return Listening(settings(listen, connect, config, 2.0))


def test_an_address_that_is_given_is_known_from_the_beginning() -> None:
    found = listening(["tcp/10.0.0.7:7447", "udp/[fe80::1]:7448#iface=eth0"], "tcp/10.0.0.8:7447")
    assert found.addresses() == ["tcp/10.0.0.7:7447", "udp/[fe80::1]:7448"]
    assert not found.is_local


@pytest.mark.parametrize("listens", ["tcp/10.0.0.7:7447", "tcp/0.0.0.0:7447"])
def test_a_connection_to_the_port_of_an_address_was_made_by_the_other_end(listens: str) -> None:
    found = listening(listens)
    assert not found.is_dialled("tcp/10.0.0.7:7447", "tcp/10.0.0.8:40001")
    assert found.is_dialled("tcp/10.0.0.7:40001", "tcp/10.0.0.8:7447")
    # The same port of another protocol is another one.
    assert found.is_dialled("udp/10.0.0.7:7447", "udp/10.0.0.8:7447")
    assert found.addresses() == ["tcp/10.0.0.7:7447"]


def test_where_the_host_is_open_it_is_that_of_the_connections() -> None:
    found = listening(["tcp/0.0.0.0:7447", "tcp/[::]:7448"])
    assert found.addresses() == []
    for host in ("10.0.0.7", "10.1.0.7", "10.0.0.7"):
        found.is_dialled(f"tcp/{host}:40001", "tcp/10.0.0.8:7447")
    ends = [f"tcp/{host}:{port}" for port in (7447, 7448) for host in ("10.0.0.7", "10.1.0.7")]
    assert found.addresses() == ends[:MOST_ADDRESSES]


def test_where_the_port_is_open_it_is_the_one_to_which_several_connect() -> None:
    found = listening("tcp/127.0.0.1:0")
    assert found.is_local
    assert found.is_dialled("tcp/127.0.0.1:40001", "tcp/127.0.0.1:40007"), "it may be either"
    assert found.is_dialled("tcp/127.0.0.1:40001", "tcp/127.0.0.1:40007"), "the same again"
    assert not found.is_dialled("tcp/127.0.0.1:40001", "tcp/127.0.0.1:40008")
    assert found.addresses() == ["tcp/127.0.0.1:40001"]


def test_a_link_is_at_the_meeting_point_only_if_others_come_there() -> None:
    found = listening()
    assert found.addresses() == []
    assert found.is_dialled("tcp/127.0.0.1:40001", MEETING_POINT)
    assert found.addresses() == []
    assert not found.is_dialled(MEETING_POINT, "tcp/127.0.0.1:40001")
    assert found.addresses() == [MEETING_POINT]


@pytest.mark.parametrize(
    ("listen", "config", "local"),
    [
        (None, None, True),
        (["tcp/127.0.0.1:7447", "unixsock-stream/tmp/tf"], None, True),
        (["tcp/127.0.0.1:7447", "tcp/10.0.0.7:7447"], None, False),
        (None, {"listen/endpoints": {"peer": ["tcp/0.0.0.0:0"]}}, False),
        (None, {"listen/endpoints": {"peer": ["tcp/localhost:0"], "router": []}}, True),
    ],
)
def test_a_link_is_local_if_it_listens_on_this_machine_only(listen: Any, config: Any, local: bool) -> None:
    assert listening(listen, config=config).is_local is local


def test_so_many_connections_are_remembered() -> None:
    found = listening("tcp/10.0.0.7:0")
    for port in range(MOST_CONNECTIONS + 1):
        assert found.is_dialled(f"tcp/10.0.0.7:{10_000 + port}", "tcp/10.0.0.8:7447")
    # The first is forgotten, and the second is not.
    assert found.is_dialled("tcp/10.0.0.7:10000", "tcp/10.0.0.9:7447")
    assert not found.is_dialled("tcp/10.0.0.7:10002", "tcp/10.0.0.9:7447")


@pytest.mark.parametrize("near", ["", "unixsock-stream/tmp/tf", "tcp/10.0.0.7", "\n"])
def test_what_has_no_port_tells_nothing(near: str) -> None:
    found = listening("tcp/0.0.0.0:7447")
    for far in ("a", "b"):
        assert found.is_dialled(near, far)
    assert found.addresses() == []

"""How a link's zenoh session is set up: on this machine only, unless addresses say otherwise."""

import json
import math
import re
from collections.abc import Iterable, Mapping
from typing import Any

import zenoh

from tfbus.stamps import as_duration

MEETING_POINT = "tcp/127.0.0.1:17447"
"""Where links on one machine find each other: whoever comes first listens here, and everybody connects to it."""

Addresses = str | Iterable[str]

_ON_NETWORK = re.compile(r"(tcp|udp|tls|quic|ws)/(\[[^\]]+\]|[^:/?#\s]+):(?P<port>\d{1,5})([?#].*)?")
_ENCRYPTED = ("tls/", "quic/")
_ON_MACHINE = re.compile(r"(unixsock-stream|unixpipe|serial|vsock)/.+")


def settings(
    listen: Addresses | None, connect: Addresses | None, config: Mapping[str, Any] | None, lease: float
) -> zenoh.Config:
    """The configuration of a session.

    Parameters
    ----------
    listen, connect : str or iterable of str, or None
        zenoh's endpoints, such as ``tcp/192.168.1.5:7447``. With neither, and none in `config`, the link meets others
        at `MEETING_POINT`. With one of them, nothing is done by itself but, where nobody says where to listen, to do
        so at a port of the loopback; and not even that if it only connects over TLS or QUIC.
    config : mapping of str to any, or None
        zenoh's own settings by their path, such as ``transport/link/tls/root_ca_certificate``; they come last, so
        they win.
    lease : float
        After how many s of silence others take this end for lost; each announces its own.

    Raises
    ------
    ValueError
        If an address is none, zenoh does not know a setting or takes no such value for it, or `lease` is no time.
    TypeError
        If something is of another type.
    """
    own = dict(config or {})
    listens = listen is not None or _gives_addresses(own, "listen")
    addressed = listens or connect is not None or _gives_addresses(own, "connect")
    silence = as_duration(lease, "lease")
    if not 0 < silence < math.inf:
        raise ValueError(f"lease must be a time that passes, got {lease}")
    connects = [] if connect is None else _endpoints(connect)
    loopback = ["tcp/127.0.0.1:0"] if addressed else [MEETING_POINT, "tcp/127.0.0.1:0"]
    if connects and all(address.startswith(_ENCRYPTED) for address in connects):
        # Who goes to others with a certificate leaves no door open without one.
        loopback = []
    values: dict[str, Any] = {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "listen/endpoints": loopback if listen is None else _endpoints(listen),
        "connect/endpoints": [] if addressed else [MEETING_POINT],
        # A peer is there before the other end, or without it, and goes on trying; a client says that nobody is there.
        "connect/exit_on_failure": False,
        "connect/timeout_ms": {"peer": -1, "router": -1, "client": 0},
        "connect/retry": {"period_init_ms": 200, "period_max_ms": 1_000, "period_increase_factor": 2},
        "scouting/delay": 100,
        "transport/link/tx/lease": max(1, round(silence * 1_000)),
        # What is cached for late joiners is told apart by time.
        "timestamping/enabled": True,
        # It would leave a file open for each link that there was.
        "transport/shared_memory/enabled": False,
        # What is larger is not even put together.
        "transport/link/rx/max_message_size": 2**23,
    }
    if not listens:
        # Somebody else holds the meeting point, as a rule.
        values |= {"listen/exit_on_failure": False, "listen/timeout_ms": 0}
    if connect is not None:
        values["connect/endpoints"] = connects
    result = zenoh.Config()
    for path, value in (values | own).items():
        try:
            result.insert_json5(path, json.dumps(value))
        except (zenoh.ZError, TypeError) as error:
            why = without_source(error)
            raise ValueError(f"zenoh does not take {value!r} for its setting {path!r}: {why}") from None
    return result


def without_source(error: Exception) -> str:
    """What zenoh says, but for where in its own source it says so."""
    return re.sub(r" at /\S+\.rs:\d+\.?", "", str(error))


def _gives_addresses(own: Mapping[str, Any], which: str) -> bool:
    return any(path == which or str(path).startswith(f"{which}/endpoints") for path in own)


def _endpoints(addresses: Addresses) -> list[str]:
    endpoints = [addresses] if isinstance(addresses, str) else list(addresses)
    for address in endpoints:
        # zenoh takes some that it can never reach, and would try for ever.
        on_network = _ON_NETWORK.fullmatch(address)
        if not (int(on_network["port"]) < 2**16 if on_network else _ON_MACHINE.fullmatch(address)):
            raise ValueError(f"an address is like tcp/192.168.1.5:7447, not {address!r}")
    return endpoints

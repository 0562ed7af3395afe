"""The settings of a link's zenoh session: on this machine only, unless addresses say otherwise."""

import json
import math
import re
from collections.abc import Iterable, Mapping
from typing import Any

import zenoh

from tfbus.links.zenoh._lease import default_lease
from tfbus.stamps import as_duration

MEETING_POINT = "tcp/127.0.0.1:17447"
"""The address at which links on one machine find each other: the first one listens there, and all connect to it."""

SIGNS_OF_LIFE = 2
"""So many go out in each lease, so one may be late by half of it."""

Addresses = str | Iterable[str]

_ON_NETWORK = re.compile(r"(tcp|udp|tls|quic|ws)/(\[[^\]]+\]|[^:/?#\s]+):(?P<port>\d{1,5})([?#].*)?")
_ENCRYPTED = ("tls/", "quic/")
_LOOPBACK = re.compile(r"[a-z]+/(127(\.\d{1,3}){3}|\[::1\]|localhost):.+")
_ON_MACHINE = re.compile(r"(unixsock-stream|unixpipe|serial|vsock)/.+")


def settings(
    listen: Addresses | None, connect: Addresses | None, config: Mapping[str, Any] | None, lease: float | None
) -> zenoh.Config:
    """The configuration of a session.

    Parameters
    ----------
    listen, connect : str or iterable of str, or None
        zenoh's endpoints, such as ``tcp/192.168.1.5:7447``. Without any, here or in `config`, the link meets others at
        `MEETING_POINT`. A link that only connects listens on a port of the loopback as well, unless it connects over
        TLS or QUIC only.
    config : mapping of str to any, or None
        zenoh's own settings by their path, such as ``transport/link/tls/root_ca_certificate``; they override all
        others.
    lease : float or None
        Seconds of silence after which others take this end for lost; each end announces its own. None is for
        `default_lease`.

    Raises
    ------
    ValueError
        If an address is malformed, zenoh refuses a setting or its value, or `lease` is not positive and finite.
    TypeError
        If an argument has another type.
    """
    own = dict(config or {})
    own_listen, own_connect = _gives_addresses(own, "listen"), _gives_addresses(own, "connect")
    listens = listen is not None or own_listen
    silence = default_lease() if lease is None else as_duration(lease, "lease")
    if not 0 < silence < math.inf:
        raise ValueError(f"lease must be a time that passes, got {lease}")
    if listens or connect is not None or own_connect:
        connects_to = [] if connect is None else _endpoints(connect)
        # A link that proves itself to others by a certificate accepts nobody without one.
        proven = connects_to and all(address.startswith(_ENCRYPTED) for address in connects_to)
        listens_at = [] if proven else ["tcp/127.0.0.1:0"]
    else:
        connects_to = [MEETING_POINT]
        listens_at = [MEETING_POINT, "tcp/127.0.0.1:0"]
    if listen is not None:
        listens_at = _endpoints(listen)
    values: dict[str, Any] = {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "listen/endpoints": listens_at,
        "connect/endpoints": connects_to,
        # A peer may start before the other end and goes on trying; a client fails when nobody is there.
        "connect/exit_on_failure": False,
        "connect/timeout_ms": {"peer": -1, "router": -1, "client": 0},
        "connect/retry": {"period_init_ms": 200, "period_max_ms": 1_000, "period_increase_factor": 2},
        "scouting/delay": 100,
        "transport/link/tx/lease": max(1, round(silence * 1_000)),
        # zenoh's four cost fifty links that rest four times as much.
        "transport/link/tx/keep_alive": SIGNS_OF_LIFE,
        # It would leave a file open for each link that has ended.
        "transport/shared_memory/enabled": False,
        # Larger messages are not even assembled.
        "transport/link/rx/max_message_size": 2**23,
    }
    if not listens:
        # Usually another link holds the meeting point.
        values |= {"listen/exit_on_failure": False, "listen/timeout_ms": 0}
    on_loopback = all(map(_LOOPBACK.fullmatch, (*listens_at, *connects_to)))
    if listens_at and on_loopback and not own_listen and not own_connect:
        # Whoever hears of another link reaches it, so one of the two dials. Where both do, zenoh closes half of the
        # connections again, which doubles what it costs fifty links to meet.
        values["scouting/gossip/autoconnect_strategy"] = {"peer": {"to_router": "always", "to_peer": "greater-zid"}}
    result = zenoh.Config()
    for path, value in (values | own).items():
        try:
            result.insert_json5(path, json.dumps(value))
        except (zenoh.ZError, TypeError) as error:
            why = without_source_location(error)
            raise ValueError(f"zenoh does not take {value!r} for its setting {path!r}: {why}") from None
    return result


def patch_settings(address: str, config: Mapping[str, Any] | None, lease: float | None) -> zenoh.Config:
    """The configuration of a session that connects to one address, and to nobody that it hears of there."""
    own = {
        path: value
        for path, value in (config or {}).items()
        if path not in ("id", "mode") and path.partition("/")[0] not in ("listen", "connect", "scouting")
    }
    return settings([], address, own | {"scouting/gossip/enabled": False}, lease)


def without_source_location(error: Exception) -> str:
    """An error's text without the location in zenoh's own source."""
    return re.sub(r" at /\S+\.rs:\d+\.?", "", str(error))


def _gives_addresses(own: Mapping[str, Any], which: str) -> bool:
    return any(path == which or str(path).startswith(f"{which}/endpoints") for path in own)


def _endpoints(addresses: Addresses) -> list[str]:
    endpoints = [addresses] if isinstance(addresses, str) else list(addresses)
    for address in endpoints:
        # zenoh accepts some that it can never reach, and would try for ever.
        on_network = _ON_NETWORK.fullmatch(address)
        if not (int(on_network["port"]) < 2**16 if on_network else _ON_MACHINE.fullmatch(address)):
            raise ValueError(f"an address is like tcp/192.168.1.5:7447, not {address!r}")
    return endpoints

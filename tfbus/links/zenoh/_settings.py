"""The settings of a link's zenoh session: on this machine only, unless addresses say otherwise."""

import json
import math
import os
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

UNSENT = 8
"""So many buffers of 64 KiB may wait for each peer before live messages are dropped; zenoh's two are full whenever its
thread waits for a CPU for some ms."""

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
    listens = listen is not None or _gives_addresses(own, "listen")
    silence = default_lease() if lease is None else as_duration(lease, "lease")
    if not 0 < silence < math.inf:
        raise ValueError(f"lease must be a time that passes, got {lease}")
    listens_at, connects_to = _addresses(listen, connect, own)
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
        "transport/link/tx/queue/size/data": UNSENT,
        # It would leave a file open for each link that has ended.
        "transport/shared_memory/enabled": False,
        # Larger messages are not even assembled.
        "transport/link/rx/max_message_size": 2**23,
    }
    if not listens:
        # Usually another link holds the meeting point.
        values |= {"listen/exit_on_failure": False, "listen/timeout_ms": 0}
    result = zenoh.Config()
    for path, value in (values | own).items():
        try:
            result.insert_json5(path, json.dumps(value))
        except (zenoh.ZError, TypeError) as error:
            why = without_source_location(error)
            raise ValueError(f"zenoh does not take {value!r} for its setting {path!r}: {why}") from None
    return result


def identity(listen: Addresses | None, connect: Addresses | None, config: Mapping[str, Any] | None) -> dict[str, Any]:
    """The settings of zenoh that are a new link's own: its ``"id"``, and whom it dials.

    Where two links that hear of each other both dial, zenoh makes many connections twice and closes half of them. That
    nearly doubles the cost of the meeting of fifty links. So a link that is on the loopback only dials only those with
    smaller ids; zenoh compares the bytes from the last to the first. Links on a network dial all, because others may
    not reach them, and have smaller ids than those on the loopback, because they may not reach these.

    Parameters
    ----------
    listen, connect, config
        As for `settings`.
    """
    own = config or {}
    listens_at, connects_to = _addresses(listen, connect, own)
    on_loopback = (
        bool(listens_at)
        and all(map(_LOOPBACK.fullmatch, (*listens_at, *connects_to)))
        and not any(path == "id" or str(path).partition("/")[0] in ("listen", "connect") for path in own)
    )
    id = bytearray(os.urandom(16))  # noqa: A001 - zenoh calls it so
    for place in (0, -1):
        # For any order of bytes. An id must not begin with 0.
        id[place] = 0xC0 | id[place] if on_loopback else 0x80 | id[place] & 0x3F
    own_settings: dict[str, Any] = {"id": id.hex()}
    if on_loopback:
        strategy = {"peer": {"to_router": "always", "to_peer": "greater-zid"}}
        own_settings["scouting/gossip/autoconnect_strategy"] = strategy
    return own_settings


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


def _addresses(
    listen: Addresses | None, connect: Addresses | None, own: Mapping[str, Any]
) -> tuple[list[str], list[str]]:
    """The addresses at which a session listens and to which it connects, unless zenoh's own settings say otherwise."""
    given = listen is not None or connect is not None
    if not given and not _gives_addresses(own, "listen") and not _gives_addresses(own, "connect"):
        return [MEETING_POINT, "tcp/127.0.0.1:0"], [MEETING_POINT]
    connects_to = [] if connect is None else endpoints(connect)
    if listen is not None:
        return endpoints(listen), connects_to
    # A link that proves itself to others by a certificate accepts nobody without one.
    proven = connects_to and all(address.startswith(_ENCRYPTED) for address in connects_to)
    return [] if proven else ["tcp/127.0.0.1:0"], connects_to


def is_on_this_machine(address: str) -> bool:
    """Whether an address leads to the same machine wherever it is used, and so to another one from elsewhere."""
    return bool(_LOOPBACK.fullmatch(address) or _ON_MACHINE.fullmatch(address))


def _gives_addresses(own: Mapping[str, Any], which: str) -> bool:
    return any(path == which or str(path).startswith(f"{which}/endpoints") for path in own)


def endpoints(addresses: Addresses) -> list[str]:
    """One address or several, each checked; raises `ValueError`."""
    found = [addresses] if isinstance(addresses, str) else list(addresses)
    for address in found:
        # zenoh accepts some that it can never reach, and would try for ever.
        on_network = _ON_NETWORK.fullmatch(address)
        if not (int(on_network["port"]) < 2**16 if on_network else _ON_MACHINE.fullmatch(address)):
            raise ValueError(f"an address is like tcp/192.168.1.5:7447, not {address!r}")
    return found

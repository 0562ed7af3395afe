"""How a link's zenoh session is set up: on this machine only, unless addresses say otherwise."""

import json
from collections.abc import Iterable, Mapping
from typing import Any

import zenoh

from tfbus.stamps import as_duration

MEETING_POINT = "tcp/127.0.0.1:17447"
"""Where links on one machine find each other: whoever comes first listens here, and everybody connects to it."""

Addresses = str | Iterable[str]


def settings(
    listen: Addresses | None, connect: Addresses | None, config: Mapping[str, Any] | None, lease: float
) -> zenoh.Config:
    """The configuration of a session.

    Parameters
    ----------
    listen, connect : str or iterable of str, or None
        zenoh's endpoints, such as ``tcp/192.168.1.5:7447``. With neither, and none in `config`, the link meets others
        at `MEETING_POINT`. With one of them, nothing is done by itself but to listen at a port of the loopback.
    config : mapping of str to any, or None
        zenoh's own settings by their path, such as ``transport/link/tls/root_ca_certificate``; they come last, so
        they win.
    lease : float
        After how many s of silence a peer is lost.

    Raises
    ------
    ValueError
        If zenoh does not know a setting, or takes no such value for it.
    """
    own = dict(config or {})
    addressed = listen is not None or connect is not None
    addressed = addressed or any(path.startswith(("listen", "connect")) for path in own)
    loopback = ["tcp/127.0.0.1:0"] if addressed else [MEETING_POINT, "tcp/127.0.0.1:0"]
    values: dict[str, Any] = {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "listen/endpoints": loopback if listen is None else _endpoints(listen),
        "connect/endpoints": [] if addressed else [MEETING_POINT],
        # It is there before the other end, or without it.
        "connect/exit_on_failure": False,
        "connect/timeout_ms": 0,
        "connect/retry": {"period_init_ms": 200, "period_max_ms": 1_000, "period_increase_factor": 2},
        "transport/link/tx/lease": max(1, round(as_duration(lease, "lease") * 1_000)),
        # What is cached for late joiners is told apart by time.
        "timestamping/enabled": True,
    }
    if listen is None:
        # Somebody else holds the meeting point, as a rule.
        values |= {"listen/exit_on_failure": False, "listen/timeout_ms": 0}
    if connect is not None:
        values["connect/endpoints"] = _endpoints(connect)
    result = zenoh.Config()
    for path, value in (values | own).items():
        try:
            result.insert_json5(path, json.dumps(value))
        except (zenoh.ZError, TypeError) as error:
            raise ValueError(f"zenoh does not take {value!r} for its setting {path!r}: {error}") from None
    return result


def _endpoints(addresses: Addresses) -> list[str]:
    return [addresses] if isinstance(addresses, str) else list(addresses)

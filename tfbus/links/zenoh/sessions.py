"""The sessions of zenoh: their settings, above all their addresses, their beginning, and their end.

Nobody waits for ever for an end. A session closes within milliseconds; zenoh gives up waiting for a frozen peer after
10 s. The event loop waits a second for that, and the interpreter, at its end, a few: a callback of zenoh after that end
would abort the process, and so would a thread that comes back from a call of zenoh.
"""

import atexit
import json
import math
import os
import re
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import zenoh

from tfbus._aio.loops import join_all, wait_for_all
from tfbus.links.seams import MAX_MESSAGE
from tfbus.stamps import as_duration

LEASE: Final = 4.0
"""s of silence after which the other end takes a session for lost; zenoh gives four signs of life in each lease."""
OPENING_TIME: Final = 2.0
"""s; a router that has not answered by then is passed over for the next one."""
UNSENT: Final = 8
"""Buffers of 64 KiB that may wait for the router before messages are dropped. zenoh's default is two, which are full
whenever its thread waits for a CPU for some ms."""
MAX_LINKS: Final = 10_000
"""A link hears so many others, and a router takes so many sessions; zenoh's default is a thousand, and it refuses more
of them silently."""
RECEIVING_THREADS: Final = 32
"""Threads of a router. zenoh ends a connection that is cut off by a call that waits 10 s in one of them (its issue
2718). By default there are two: after two such losses both waited, and the router passed on nothing meanwhile."""
CLOSING_TIME: Final = 1.0
"""s that the event loop waits for the end of a session."""
LONGEST_CLOSE: Final = 15.0
"""s that the interpreter waits for the end of all sessions, and the opening of a link for a router of its own."""
THREAD: Final = "tfbus and zenoh end"
"""The name of each thread for whose end the interpreter waits."""
_first_user: int | None = None
"""The id of the process that has used zenoh first. A process that was forked from it has no threads of zenoh."""

Addresses = str | Iterable[str]
Settings = Mapping[str, Any] | str | os.PathLike[str]
"""Settings of zenoh by their path, or the name of a file of zenoh's settings, in JSON5."""

_ADDRESS = re.compile(
    r"(tcp|udp|tls|quic|ws)/(\[[^\]]+\]|[^:/?#\s]+):(?P<port>\d{1,5})([?#].*)?"
    r"|(unixsock-stream|unixpipe|serial|vsock)/.+"
)
# Each session draws its own id, and the arguments say the rest.
_NOT_TO_SET = re.compile("id|mode|listen|listen/endpoints.*|connect|connect/endpoints.*")


def session_config(
    listen: Addresses | None, connect: Addresses, config: Settings | None, lease: float | None
) -> zenoh.Config:
    """The settings of a router, which keeps trying to reach all other routers, or of a client of any of some routers.

    Parameters
    ----------
    listen : str or iterable of str, or None
        zenoh's endpoints, such as ``tcp/192.168.1.5:7447``, at which a router listens; None for a client.
    connect : str or iterable of str
        The endpoints of other routers.
    config : mapping of str to any, or str or path, or None
        zenoh's own settings by their path, such as ``transport/link/tls/root_ca_certificate``, or the name of a file
        of such settings; they override all others.
    lease : float or None
        Seconds of silence after which the other end takes this one for lost; each end announces its own. None is for
        `LEASE`.

    Raises
    ------
    ValueError
        If an address is malformed, zenoh refuses a setting or its value, or `lease` is not positive and finite.
    TypeError
        If an argument has another type.
    OSError
        If the file cannot be read.
    """
    silence = LEASE if lease is None else as_duration(lease, "lease")
    if not 0 < silence < math.inf:
        raise ValueError(f"lease must be a time that passes, got {lease}")
    values: dict[str, Any] = {
        "mode": "client" if listen is None else "router",
        "listen/endpoints": endpoints(listen or ()),
        "connect/endpoints": endpoints(connect),
        # For routers, which go on trying; a client tries each address once.
        "connect/retry": {"period_init_ms": 200, "period_max_ms": 1_000, "period_increase_factor": 2},
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        # It would wait so long for routers that scouting finds.
        "scouting/delay": 0,
        "transport/unicast/open_timeout": round(OPENING_TIME * 1_000),
        "transport/unicast/max_sessions": MAX_LINKS,
        "transport/link/tx/lease": max(1, round(silence * 1_000)),
        "transport/link/tx/queue/size/data": UNSENT,
        # It would leave a file open for each link that has ended.
        "transport/shared_memory/enabled": False,
        # Larger messages are not even assembled; zenoh adds a key and some headers to each.
        "transport/link/rx/max_message_size": MAX_MESSAGE + 2**17,
    }
    result = zenoh.Config()
    own: dict[str, Any] = {}
    if isinstance(config, str | os.PathLike):
        default, result = result, _read_settings(config)
        chosen = [path for path in ("id", *values) if result.get_json(path) != default.get_json(path)]
        own = {path: json.loads(result.get_json(path)) for path in chosen}
    elif config is not None:
        own = dict(config)
    for path in own:
        if _NOT_TO_SET.fullmatch(path):
            raise ValueError(f"zenoh's setting {path!r} is not for config: give addresses by connect and listen")
    for path, value in (values | own).items():
        try:
            result.insert_json5(path, json.dumps(value))
        except (zenoh.ZError, TypeError) as error:
            why = without_source_location(error)
            raise ValueError(f"zenoh does not take {value!r} for its setting {path!r}: {why}") from None
    return result


def _read_settings(file: str | os.PathLike[str]) -> zenoh.Config:
    text = Path(file).read_text(encoding="utf-8")
    try:
        return zenoh.Config.from_json5(text)
    except zenoh.ZError as error:
        raise ValueError(f"zenoh does not take the settings in {file}: {without_source_location(error)}") from None


def open_session(config: zenoh.Config, settings: Mapping[str, object] | None = None) -> zenoh.Session:
    """Open a session with some more settings; blocks.

    Raises
    ------
    OSError
        If it cannot listen where it should, or as a client reaches nobody; with its `errno`, if there is one.
    """
    if config.get_json("mode") == '"router"':
        # zenoh reads it once in a process, with its first session.
        os.environ.setdefault("ZENOH_RUNTIME", f"(rx: (worker_threads: {RECEIVING_THREADS}))")
    try:
        for path, value in (settings or {}).items():
            config.insert_json5(path, json.dumps(value))
        return zenoh.open(config)
    except BaseException as error:  # It panics at some addresses, such as tcp/host:7447?rel=3.
        raise os_error(error, "zenoh cannot open a session") from error


def os_error(error: BaseException, what: str) -> OSError:
    """An error of zenoh as the operating system's, with its `errno` if it names one."""
    text = f"{what}: {without_source_location(error)}"
    number = re.search(r"\(os error (\d+)\)", text)
    return OSError(int(number[1]), text) if number else OSError(text)


def endpoints(addresses: Addresses) -> list[str]:
    """One address or several, each checked; raises `ValueError`."""
    found = [addresses] if isinstance(addresses, str) else list(addresses)
    for address in found:
        # zenoh accepts some that it can never reach, and would try for ever.
        parts = _ADDRESS.fullmatch(address)
        if parts is None or int(parts["port"] or 0) >= 2**16:
            raise ValueError(f"an address is like tcp/192.168.1.5:7447, not {address!r}")
    return found


def without_source_location(error: BaseException) -> str:
    return re.sub(r" at /\S+\.rs:\d+\.?", "", str(error)).strip()


# The end


def use_zenoh() -> None:
    """Note that this process uses zenoh from now on.

    Raises
    ------
    RuntimeError
        If it was forked from one that did: zenoh's threads are there, and its sessions here would hear nobody.
    """
    global _first_user
    _first_user = _first_user or os.getpid()
    if _first_user != os.getpid():
        raise RuntimeError(
            "this process was forked from one that uses zenoh, whose threads are not here: start it with the method "
            "'spawn' of multiprocessing, or fork before the first link"
        )


def close_session(close: Callable[[], object]) -> None:
    """Call the method that closes a session; a second call does nothing, and so does one in a child made by `fork`."""
    if _first_user == os.getpid():
        # zenoh may give up waiting for a peer; that peer notices the end by itself.
        with suppress(zenoh.ZError):
            close()


def begin_to_close(close: Callable[[], object]) -> threading.Thread:
    """Call `close_session` in a thread of its own; returns the thread."""
    # Not a thread that the interpreter waits for without a limit.
    closing = threading.Thread(target=close_session, args=(close,), name=THREAD, daemon=True)
    closing.start()
    return closing


async def wait_until_closed(closing: Sequence[threading.Thread], warn: Callable[[Exception], object]) -> None:
    """Wait a second for such threads, also when cancelled, and warn if that was too short."""
    if not await wait_for_all(closing, CLOSING_TIME):
        warn(TimeoutError(f"zenoh has not closed its session within {CLOSING_TIME:g} s, and goes on in the background"))


@atexit.register
def _wait_at_exit() -> None:
    join_all([thread for thread in threading.enumerate() if thread.name == THREAD], LONGEST_CLOSE)

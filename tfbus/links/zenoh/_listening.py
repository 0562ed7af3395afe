"""The addresses at which a link listens: others need them to dial it."""

import json
import re
from collections.abc import Iterator
from typing import Any

import zenoh

from tfbus.links.zenoh._dialing import MOST_ADDRESSES, newest_first
from tfbus.links.zenoh._settings import MEETING_POINT, is_on_this_machine

MOST_CONNECTIONS = 1_000
"""So many are remembered, the newest."""
_ADDRESS = re.compile(r"(?P<protocol>[a-z]+)/(?P<host>\[[^\]]*\]|[^:/?#\s]+):(?P<port>\d+)")
_ANY_HOST = ("0.0.0.0", "[::]")


class Listening:
    """Tells which connections others have made, and where this link can be reached.

    The address of a peer that was dialled is good for later; the one of a peer that has dialled this link is not, but
    the near end of such a connection is where this link listens. The configuration may leave host or port open.

    Parameters
    ----------
    config : zenoh.Config

    Attributes
    ----------
    is_local : bool
        Whether only this machine can reach the link.
    """

    def __init__(self, config: zenoh.Config) -> None:
        given = list(_texts(json.loads(config.get_json("listen/endpoints"))))
        found = [match for match in map(_ADDRESS.match, given) if match is not None and match["port"] != "0"]
        self.is_local = all(map(is_on_this_machine, given))
        self._ports = {(match["protocol"], match["port"]) for match in found}
        self._open = [match for match in found if match["host"] in _ANY_HOST]
        # Usually another link listens at the meeting point.
        self._known = [match[0] for match in found if match["host"] not in _ANY_HOST and match[0] != MEETING_POINT]
        self._hosts: list[str] = []
        self._far: dict[str, str] = {}

    def is_dialled(self, near: str, far: str) -> bool:
        """Note the two ends of a connection; returns whether this link has made it, as far as is known."""
        match = _ADDRESS.match(near)
        if match is None:
            return True
        if (match["protocol"], match["port"]) in self._ports or self._far.get(near, far) != far:
            self._known = newest_first(near, self._known)
            return False
        self._far[near] = far
        if len(self._far) > MOST_CONNECTIONS:
            del self._far[next(iter(self._far))]
        self._hosts = newest_first(match["host"], self._hosts)
        return True

    def addresses(self) -> list[str]:
        """The addresses at which this link listens, as far as they are known."""
        anywhere = [f"{match['protocol']}/{host}:{match['port']}" for match in self._open for host in self._hosts]
        return list(dict.fromkeys([*self._known, *anywhere]))[:MOST_ADDRESSES]


def _texts(value: Any) -> Iterator[str]:
    """All texts in a value of JSON."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, (list, dict)):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _texts(part)

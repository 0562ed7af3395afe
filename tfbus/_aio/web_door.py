"""The door of a web server: the requests that it answers.

A browser connects to servers of its own machine for any web page, and names that page in the header ``Origin``. A page
whose host name was redirected to this machine (DNS rebinding) asks for another ``Host``. Only browsers send
``Origin``. A program without this header is let in, because a program could send any header.
"""

import ipaddress
import logging
import re
import socket
from collections.abc import Iterable
from contextlib import suppress
from typing import NamedTuple

MAX_HEAD = 16_384
"""The greatest length in bytes of the head of a request."""
HEAD_TIME = 10.0
"""The time in s in which the head of a request must come."""
HEAD_END = b"\r\n\r\n"
_ORIGIN = re.compile(r"(https?)://(\[[0-9a-f:.]+\]|[^\s/?#@:\[\]]+)(?::([0-9]{1,5}))?", re.IGNORECASE)
_HOST = re.compile(r"(\[[0-9a-f:.]+\]|[^\s/?#@:\[\]]+)(?::([0-9]{1,5}))?", re.IGNORECASE)
_APPLICATION = re.compile(r"(?!https?:)[a-z][a-z0-9+.-]*://[^\s/?#@]*", re.IGNORECASE)
"""The origin of an application that is made of web pages, such as ``file://``."""
_PORTS = {"http": 80, "https": 443}


class _Place(NamedTuple):
    """A host in lower case, IPv6 addresses without brackets, and a port if one was named."""

    host: str
    port: int | None


class WebDoor:
    """Decides about the head of each request, before the server sees a byte of it.

    Parameters
    ----------
    host : str
        The address that the server listens at.
    origins : iterable of str
        Other pages that may use the server, such as ``https://robot.example:8443``; the server answers to the names
        of their hosts as well. An application made of web pages has an origin such as ``file://``. ``*`` allows all.

    Attributes
    ----------
    refused : int
        Requests that were refused.

    Raises
    ------
    TypeError, ValueError
        If an origin is not a text, or is malformed.
    """

    def __init__(self, host: str, origins: Iterable[str] = ()) -> None:
        if isinstance(origins, str):
            raise TypeError(f"origins must be several addresses, not {origins!r}")
        own = socket.gethostname().lower()
        short = own.partition(".")[0]
        self.refused: int = 0
        self._names = {"localhost", host.lower().rstrip("."), own, short, f"{short}.local"}
        self._origins: set[tuple[str, _Place]] = set()
        self._applications: set[str] = set()
        self._anything = False
        for origin in origins:
            if origin == "*":
                self._anything = True
                continue
            if _APPLICATION.fullmatch(origin):
                self._applications.add(origin.lower())
                continue
            found = _ORIGIN.fullmatch(origin)
            if found is None:
                raise ValueError(f"an origin is like 'https://robot.example:8443', or '*', not {origin!r}")
            scheme, place = _origin(found)
            self._origins.add((scheme, place))
            self._names.add(place.host)

    def answer(self, received: bytes) -> bytes | None:
        """The answer to a request that is refused; None if the server may see it.

        Parameters
        ----------
        received : bytes
            The head of the request, with `HEAD_END` in it; bytes without it are refused.
        """
        status, why = self._judge(received)
        if not status:
            return None
        self.refused += 1
        if self.refused == 1:
            logging.getLogger("tfbus").warning("a request was refused, and later ones are only counted: %s", why)
        text = f"{why}\n".encode()
        return (
            f"HTTP/1.1 {status}\r\nContent-Type: text/plain; charset=utf-8\r\nX-Content-Type-Options: nosniff\r\n"
            f"Content-Length: {len(text)}\r\nConnection: close\r\n\r\n"
        ).encode() + text

    def _judge(self, received: bytes) -> tuple[str, str]:
        headers = _headers(received)
        if headers is None:
            return "400 Bad Request", "this is not a request of HTTP"
        hosts, origins = headers.get("host", []), headers.get("origin", [])
        if len(hosts) != 1 or len(origins) > 1:
            return "400 Bad Request", "a request has one Host, and no more than one Origin"
        if self._anything:
            return "", ""
        found = _HOST.fullmatch(hosts[0])
        if found is None:
            return "400 Bad Request", f"no host has the name {hosts[0]!a}"
        host = _place(found[1], found[2])
        # An address cannot be redirected here, but a name can, by its owner.
        if host.host not in self._names and not _is_address(host.host):
            return "403 Forbidden", f"this server is not {hosts[0]!a}; origins= allows other names"
        if origins and not self._is_own(origins[0], host):
            return "403 Forbidden", f"pages of {origins[0]!a} may not use this server; origins= allows others"
        return "", ""

    def _is_own(self, origin: str, host: _Place) -> bool:
        """Whether a page comes from this server itself, or `origins` allows it."""
        found = _ORIGIN.fullmatch(origin)
        if found is None:
            return origin.lower() in self._applications
        scheme, place = _origin(found)
        if (scheme, place) in self._origins:
            return True
        same_host = place.host == host.host or (_is_loopback(place.host) and _is_loopback(host.host))
        return same_host and place.port == (host.port or _PORTS[scheme])


def _headers(received: bytes) -> dict[str, list[str]] | None:
    """The values of each header by its name in lower case; None if there is no head of a request."""
    head, end, _ = received.partition(HEAD_END)
    if not end or len(head) > MAX_HEAD:
        return None
    first, *lines = head.decode("latin-1").split("\r\n")
    if not re.fullmatch(r"[A-Z]+ \S+ HTTP/1\.[01]", first):
        return None
    found: dict[str, list[str]] = {}
    for line in lines:
        name, colon, value = line.partition(":")
        # Servers disagree about a name with a space, and about a line that continues the line before.
        if not colon or not re.fullmatch(r"[!#-'*+\-.0-9A-Z^-z|~]+", name) or re.search(r"[\r\n\0]", value):
            return None
        found.setdefault(name.lower(), []).append(value.strip(" \t"))
    return found


def _origin(found: re.Match[str]) -> tuple[str, _Place]:
    scheme = found[1].lower()
    place = _place(found[2], found[3])
    return scheme, _Place(place.host, place.port or _PORTS[scheme])


def _place(host: str, port: str | None) -> _Place:
    name = host.lower().strip("[]").rstrip(".")
    with suppress(ValueError):
        name = str(ipaddress.ip_address(name))
    return _Place(name, None if port is None else int(port))


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def _is_loopback(host: str) -> bool:
    return host == "localhost" or (_is_address(host) and ipaddress.ip_address(host).is_loopback)

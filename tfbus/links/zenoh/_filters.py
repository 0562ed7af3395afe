"""The filters of links that hear only some frames, as they tell them by tokens.

A filter names robots and frames. It is the last part of the token's key, so whoever sees the token knows the filter: it
comes with the peer, stays as long, and nobody has to ask for it or to remember it.
"""

import json
import threading
from base64 import urlsafe_b64decode, urlsafe_b64encode
from collections import Counter
from collections.abc import Collection, Mapping

import zenoh

from tfbus.links._hash import hash_bytes

MOST_FILTERS = 100
"""So many filters are served; whoever has another one hears all."""
MOST_TOKENS = 2_000
"""So many tokens of filters are noted; a link whose token is not hears all."""
LONGEST_FILTER = 16_000
"""Characters of a key: about 500 names of 20 letters."""

Token = tuple[str, object, str]
"""The link that a token is of, the session here that tells of it, and the name of the session there."""


def write_filter(robots: Collection[str], frames: Collection[str]) -> str:
    """A filter as a part of a key; empty if it would be too long.

    Parameters
    ----------
    robots : collection of str
        zenoh's key expressions of one chunk.
    frames : collection of str
    """
    text = json.dumps([sorted(robots), sorted(frames)], separators=(",", ":"))
    chunk = urlsafe_b64encode(text.encode()).decode()
    return chunk if len(chunk) <= LONGEST_FILTER else ""


def read_filter(chunk: str) -> tuple[list[zenoh.KeyExpr], frozenset[str]]:
    """The robots and frames of a filter.

    Raises
    ------
    ValueError
        If it is malformed, or too long.
    """
    if len(chunk) > LONGEST_FILTER:
        raise ValueError(f"a filter of {len(chunk)} characters, more than {LONGEST_FILTER}")
    try:
        robots, frames = json.loads(urlsafe_b64decode(chunk))
        if not isinstance(frames, list) or not all(isinstance(frame, str) for frame in frames):
            raise ValueError("a filter without frames")
        return [zenoh.KeyExpr(robot) for robot in robots], frozenset(frames)
    except (ValueError, TypeError, RecursionError, zenoh.ZError) as error:
        raise ValueError(f"a malformed filter: {error}") from None


def name_of(chunk: str) -> str:
    """The name of a filter in the keys of messages: 32 hexadecimal digits."""
    return hash_bytes(chunk.encode(), 16).hex()


class Filters:
    """The filters of all links whose tokens are there; for any thread.

    Parameters
    ----------
    robot : str
        That of this link.

    Attributes
    ----------
    wanted : mapping of str to frozenset of str
        The frames of each filter that wants any of this link, by the filter's name; another object after each change.
    are_served : bool
        Whether all were understood, and are not too many; otherwise some links that have one have to hear all.
    """

    def __init__(self, robot: str) -> None:
        self._robot = zenoh.KeyExpr(robot)
        self._lock = threading.Lock()
        self._tokens: dict[str, set[Token]] = {}
        self._links: Counter[str] = Counter()
        self._refused: set[str] = set()
        self.wanted: Mapping[str, frozenset[str]] = {}

    @property
    def are_served(self) -> bool:
        return not self._refused

    def cover(self, links: Collection[str]) -> bool:
        """Whether each of some links has a filter that is served."""
        with self._lock:
            return self.are_served and all(link in self._links for link in links)

    def joined(self, token: Token, chunk: str) -> None:
        """Note the token of a filter.

        Raises
        ------
        ValueError
            If the filter cannot be served.
        """
        with self._lock:
            tokens = self._tokens.get(chunk, set())
            if token not in tokens and self._links.total() >= MOST_TOKENS:
                raise ValueError(f"more than {MOST_TOKENS} tokens of filters")
            self._tokens[chunk] = tokens
            if token not in tokens:
                tokens.add(token)
                self._links[token[0]] += 1
                if len(tokens) == 1:
                    self._begin(chunk)

    def left(self, token: Token, chunk: str) -> None:
        """Note that the token of a filter has gone."""
        with self._lock:
            tokens = self._tokens.get(chunk, set())
            if token in tokens:
                tokens.remove(token)
                self._links[token[0]] -= 1
                if not self._links[token[0]]:
                    del self._links[token[0]]
                if not tokens:
                    self._end(chunk)

    def lose(self, session: object) -> None:
        """Note that all tokens have gone that a session has told of."""
        with self._lock:
            gone = [(token, chunk) for chunk, tokens in self._tokens.items() for token in tokens if token[1] is session]
        for token, chunk in gone:
            self.left(token, chunk)

    def _begin(self, chunk: str) -> None:
        try:
            robots, frames = read_filter(chunk)
            if any(robot.includes(self._robot) for robot in robots):
                if len(self.wanted) >= MOST_FILTERS:
                    raise ValueError(f"more than {MOST_FILTERS} filters")
                self.wanted = {**self.wanted, name_of(chunk): frames}
        except ValueError:
            self._refused.add(chunk)
            raise

    def _end(self, chunk: str) -> None:
        del self._tokens[chunk]
        self._refused.discard(chunk)
        name = name_of(chunk)
        self.wanted = {known: frames for known, frames in self.wanted.items() if known != name}

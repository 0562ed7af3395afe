"""The questions by which a link finds the peers of its peers that it has not met.

zenoh tells a newcomer once of the others, and each of them once of the newcomer. Where that is lost, or the dial that
follows fails because something is cut at that moment, two links never meet, although a third one knows both. So a link
asks one of its peers, any, for those that it lacks: soon after each change, and then ever more seldom. It dials those
that are named twice.
"""

import re
from collections.abc import Callable, Container, Iterable, Mapping
from itertools import islice
from random import Random

import zenoh

from tfbus.links.zenoh._dialing import MOST_ADDRESSES, Dialing
from tfbus.links.zenoh._keys import FIRST_SESSION, Keys
from tfbus.links.zenoh._listening import Listening
from tfbus.links.zenoh._settings import endpoints, is_on_this_machine
from tfbus.tf_message import MalformedMessageError

FIRST_PAUSE = 2.0
LONGEST_PAUSE = 300.0
"""s between two questions: at first, and then twice that time, up to the longest."""
LONGEST_DELAY = 20.0
"""s; while peers come and go the first question waits for an end of that, but not longer."""
MISSING_TIME = 1.5
"""s between the first and the last answer that names a peer which is then dialled; until then it may come by itself."""
MOST_NAMED = 100
"""So many peers are named in one answer, drawn from all that the asker lacks."""
MOST_MISSING = 100
"""So many missing peers are remembered, so whoever invents peers has few addresses dialled."""
MOST_BYTES = 2**18
"""So much is read of a question or of an answer."""
_MOST_EXPRESSIONS = 1_000
_PLAIN = re.compile(r"[\w.:/%@\[\]-]{1,300}", re.ASCII)
_DIGITS = 8
"""So much of each id is told in a question."""


class Introductions:
    """Decides whom to ask when, answers such questions, and judges the answers.

    Parameters
    ----------
    keys : Keys
        Those of the link.
    listening : Listening
        Where the link listens.
    dialing : Dialing
        Has the addresses of peers, and dials those that are missing.
    now : callable
        Returns a monotonic time in s.
    random : Random, optional
    """

    def __init__(
        self,
        keys: Keys,
        listening: Listening,
        dialing: Dialing,
        now: Callable[[], float],
        random: Random | None = None,
    ) -> None:
        self._keys = keys
        self._listening = listening
        self._dialing = dialing
        self._now = now
        self._random = Random() if random is None else random
        self._due: float | None = None
        self._pause = FIRST_PAUSE
        self._changed: float | None = None
        self._missing: dict[str, float] = {}

    def changed(self) -> None:
        """Note that a peer has come or gone."""
        now = self._now()
        if self._changed is None:
            self._changed = now
        self._pause = FIRST_PAUSE
        self._due = min(now + FIRST_PAUSE, self._changed + LONGEST_DELAY)

    def next_due(self) -> float | None:
        """The time of the next question; None while there is nobody to ask."""
        return self._due

    def take_due(self, present: Iterable[str], answers: Callable[[str], bool]) -> str | None:
        """The peer to ask now, one of those that are there and answer; None before the time, or if there is none."""
        now = self._now()
        if self._due is None or now < self._due:
            return None
        self._changed = None
        peers = [peer for peer in present if answers(peer)]
        if not peers:
            self._due = None
            return None
        self._due = now + self._pause * self._random.uniform(0.8, 1.2)
        self._pause = min(2 * self._pause, LONGEST_PAUSE)
        return self._random.choice(peers)

    def question(self, present: Iterable[str]) -> bytes:
        """Ask a peer for those that this link lacks: say where this link listens, whom it wants, and whom it has."""
        known = "".join(peer[:_DIGITS] for peer in present)
        return "\n".join((" ".join(self._listening.addresses()), ",".join(self._keys.heard("@alive")), known)).encode()

    def answer(self, question: bytes, asker: str, robots: Mapping[str, str]) -> bytes:
        """Name the peers that the asker wants and lacks, each with its addresses; and note where the asker listens.

        Parameters
        ----------
        question : bytes
        asker : str
            The link that asks.
        robots : mapping of str to str
            The peers that are there, each with its robot.

        Raises
        ------
        MalformedMessageError
            If it is no such question.
        """
        lines = question[:MOST_BYTES].decode("ascii", "replace").split("\n")
        if len(lines) != 3:
            raise MalformedMessageError("introduction", f"a question for peers has {len(lines)} lines")
        listens, expressions, known = lines
        for address in self._useful(listens.split(" ")):
            self._dialing.reached(asker, address)
        try:
            wanted = [zenoh.KeyExpr(expression) for expression in expressions.split(",")[:_MOST_EXPRESSIONS]]
        except zenoh.ZError as error:
            raise MalformedMessageError("introduction", f"a question for peers: {error}") from None
        has = {known[start : start + _DIGITS] for start in range(0, len(known), _DIGITS)} | {asker[:_DIGITS]}
        named = []
        for peer, robot in robots.items():
            if peer[:_DIGITS] in has:
                continue
            token = self._keys.token_of(robot, peer, FIRST_SESSION)
            key = zenoh.KeyExpr(token)
            if any(expression.includes(key) for expression in wanted):
                named.append(" ".join((token, *self._useful(self._dialing.addresses(peer)))))
        if len(named) > MOST_NAMED:
            named = self._random.sample(named, MOST_NAMED)
        return "\n".join(named).encode()

    def take(self, answer: bytes, present: Container[str]) -> None:
        """Have the peers dialled that an answer names, as one before it did.

        Parameters
        ----------
        answer : bytes
        present : container of str
            The peers that are there.

        Raises
        ------
        MalformedMessageError
            If a line of it names no link that this one hears, or what is no address; all else was taken.
        """
        now = self._now()
        named = {}
        foreign = 0
        for line in answer[:MOST_BYTES].decode("ascii", "replace").split("\n")[:MOST_NAMED]:
            token, *addresses = line.split(" ")
            link = self._keys.heard_link(token.encode())
            foreign += bool(line) and not (link and all(map(_is_address, addresses)))
            if link is not None and link != self._keys.link and link not in present:
                named[link] = self._useful(addresses)
        self._missing = {
            peer: since
            for peer, since in self._missing.items()
            if peer not in present and (peer in named or now - since < LONGEST_PAUSE)
        }
        for peer, addresses in named.items():
            since = self._missing.get(peer)
            if since is not None and now - since >= MISSING_TIME:
                for address in reversed(addresses):
                    self._dialing.reached(peer, address)
                if not self._dialing.is_dialled(peer):
                    self._dialing.left(peer)
            elif since is None and len(self._missing) < MOST_MISSING:
                self._missing[peer] = now
                self._due = now + FIRST_PAUSE
        if foreign:
            raise MalformedMessageError("introduction", f"{foreign} lines of an answer name no link or no address")

    def _useful(self, addresses: Iterable[str]) -> list[str]:
        """The well-formed addresses among some that lead to the same machine for others."""
        valid = [address for address in islice(addresses, MOST_ADDRESSES) if _is_address(address)]
        return [address for address in valid if self._listening.is_local or not is_on_this_machine(address)]


def _is_address(address: str) -> bool:
    """Whether an address that a stranger names may be dialled: plain letters, without options of zenoh, no device."""
    if not _PLAIN.fullmatch(address) or address.startswith("serial/"):
        return False
    try:
        endpoints(address)
    except ValueError:
        return False
    return True

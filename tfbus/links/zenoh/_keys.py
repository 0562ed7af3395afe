"""The keys of a link on zenoh.

Where *robot* is ``~`` for a link without one, and *link* is 32 hexadecimal digits that each link draws at random::

    tfbus/domain/robot/live/link      all that is published and removed, one message a turn of the link's event loop
    tfbus/domain/robot/only/link/name
                                      what is published and removed of the frames of one filter, by the filter's name
    tfbus/domain/robot/slow/link      the newest sample of each moving frame, now and then, while somebody subscribes
    tfbus/domain/robot/state/link     a queryable: the link's state, or what has changed of it since a number
    tfbus/domain/robot/history/link   a queryable: the last seconds of the link's moving frames
    tfbus/domain/robot/hears/link     a queryable: whether the link hears the asker; see `tfbus.links.zenoh._hearing`;
                                      and whom it knows that the asker lacks; see `tfbus.links.zenoh._introductions`
    tfbus/domain/robot/@alive/link/session
                                      a liveliness token for each session of the link; the first session is ``0``
    tfbus/domain/robot/@only/link/session/filter
                                      another one, of a link that hears only some frames: its filter
"""

import os
import re
from dataclasses import dataclass

import zenoh

from tfbus.links.zenoh._filters import name_of
from tfbus.tf_message import MalformedMessageError

NO_ROBOT = "~"
ANY_ROBOT = "*"
FIRST_SESSION = "0"
LONGEST_NAME = 200
_LONGEST_SHOWN = 100

_ID = re.compile("[0-9a-f]{32}")
_SESSION = re.compile("0|[0-9a-f]{32}")
_FILTER = re.compile(r"[\w-]+=*", re.ASCII)
_NAME = re.compile(r"[\w.-]+", re.ASCII)


@dataclass(frozen=True, slots=True)
class Keys:
    """The keys of one link.

    Parameters
    ----------
    domain : str
    link : str
    robot : str
    robots : tuple of str
        The robots of those that the link hears, as zenoh's key expressions of one chunk.
    slow_robots : tuple of (str, float)
        The same for those of which it hears the slow key, at most so many times a second.
    filter : str
        What it tells of the frames that it hears, by `tfbus.links.zenoh._filters`; empty if it hears all.
    """

    domain: str
    link: str
    robot: str = NO_ROBOT
    robots: tuple[str, ...] = ("*",)
    slow_robots: tuple[tuple[str, float], ...] = ()
    filter: str = ""

    def own(self, kind: str) -> str:
        """The key of this link for one of the kinds above."""
        return f"tfbus/{self.domain}/{self.robot}/{kind}/{self.link}"

    def token(self, session: str) -> str:
        """The key of the liveliness token of one of this link's sessions."""
        return self.token_of(self.robot, self.link, session)

    def token_of(self, robot: str, link: str, session: str) -> str:
        """The key of the liveliness token of a session of a link of the domain."""
        return f"tfbus/{self.domain}/{robot}/@alive/{link}/{session}"

    def part(self, name: str) -> str:
        """The key of this link for what is about the frames of one filter."""
        return f"{self.own('only')}/{name}"

    def filter_token(self, session: str) -> str:
        """The key of the liveliness token by which one of this link's sessions tells its filter."""
        return f"{self.own('@only')}/{session}/{self.filter}"

    def filter_tokens(self) -> str:
        """The key expression of such tokens of all links of the domain."""
        return f"tfbus/{self.domain}/*/@only/*/*/*"

    def heard(self, kind: str) -> list[str]:
        """The key expressions of a kind of all links that this one hears."""
        if self.filter and kind == "live":
            return [f"tfbus/{self.domain}/{robot}/only/*/{name_of(self.filter)}" for robot in self.robots]
        end = "*/*" if kind == "@alive" else "*"
        slow = [robot for robot, _ in self.slow_robots] if kind == "@alive" else []
        return [f"tfbus/{self.domain}/{robot}/{kind}/{end}" for robot in dict.fromkeys([*self.robots, *slow])]

    def slow(self) -> list[tuple[str, float]]:
        """The key expressions of the slow keys that this link hears, each with its rate in Hz."""
        return [(f"tfbus/{self.domain}/{robot}/slow/*", rate) for robot, rate in self.slow_robots]

    def of(self, kind: str, link: str, robot: str) -> str:
        """The key of one other link, or with `ANY_ROBOT` an expression for it.

        A router compares an expression with the keys of all robots: with a thousand of them that takes it 5 ms.
        """
        return f"tfbus/{self.domain}/{robot}/{kind}/{link}"

    def session(self, key: str) -> tuple[str, str] | None:
        """The link and the session that a token's key belongs to; None if it names none."""
        rest, _, session = key.rpartition("/")
        link = self.sender(rest, "@alive")
        return (link, session) if link is not None and _SESSION.fullmatch(session) else None

    def robot_of(self, key: str) -> str:
        """The robot that a key of the domain belongs to."""
        return key.removeprefix(f"tfbus/{self.domain}/").partition("/")[0]

    def heard_link(self, token: bytes) -> str | None:
        """The link that a token belongs to; None for one that this link does not mean to hear."""
        key = token.decode("ascii", "replace")
        found = self.session(key)
        if found is None or not any(zenoh.KeyExpr(heard).includes(key) for heard in self.heard("@alive")):
            return None
        return found[0]

    def check_token(self, token: bytes) -> None:
        """Raise `MalformedMessageError` for what is no token of a link of the domain."""
        if self.session(token.decode("ascii", "replace")) is None:
            raise MalformedMessageError("token", f"no link has the token {token[:_LONGEST_SHOWN]!r}")

    def filter_of(self, key: str) -> tuple[str, str, str] | None:
        """The link, the session and the filter that such a token's key belongs to; None if it names none."""
        rest, _, chunk = key.rpartition("/")
        rest, _, session = rest.rpartition("/")
        link = self.sender(rest, "@only")
        named = link is not None and _SESSION.fullmatch(session) and _FILTER.fullmatch(chunk)
        return (link, session, chunk) if link is not None and named else None

    def sender(self, key: str, kind: str) -> str | None:
        """The link that a key of one kind belongs to; None if it names none."""
        robot, _, rest = key.removeprefix(f"tfbus/{self.domain}/").partition("/")
        link = rest.removeprefix(f"{kind}/")
        if not _ID.fullmatch(link) or not (robot == NO_ROBOT or _NAME.fullmatch(robot)):
            return None
        return link if key == f"tfbus/{self.domain}/{robot}/{kind}/{link}" else None


def new_id() -> str:
    """A random name of a link, of a session, or of whoever asks or answers lookups: 32 hexadecimal digits."""
    return os.urandom(16).hex()


def check_domain(domain: str) -> str:
    """Return a domain.

    Raises
    ------
    ValueError
        If it cannot be part of a key.
    """
    if len(domain) > LONGEST_NAME or not re.fullmatch(rf"{_NAME.pattern}(/{_NAME.pattern})*", domain, re.ASCII):
        raise ValueError(
            "a domain is made of letters, digits, '-', '_' and '.', with '/' between them, "
            f"{LONGEST_NAME} at most, not {domain!r}"
        )
    return domain


def check_robot(robot: str) -> str:
    """Return the name of a robot.

    Raises
    ------
    ValueError
        If it cannot be part of a key.
    """
    if len(robot) > LONGEST_NAME or not _NAME.fullmatch(robot):
        raise ValueError(
            f"a robot's name is made of letters, digits, '-', '_' and '.', {LONGEST_NAME} at most, not {robot!r}"
        )
    return robot


def robots_expression(pattern: str) -> str:
    """The key expression for the robots of a pattern, in which ``*`` stands for any letters.

    Raises
    ------
    ValueError
        If no name of a robot can match it.
    """
    if len(pattern) > LONGEST_NAME or not re.fullmatch(r"[\w.*-]+", pattern, re.ASCII):
        raise ValueError(f"the name of a robot, or a pattern such as 'r*', is needed, not {pattern!r}")
    collapsed = re.sub(r"\*+", "*", pattern)
    return collapsed if collapsed == "*" else collapsed.replace("*", "$*")

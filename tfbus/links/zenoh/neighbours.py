"""The case in which a router is connected to another one, or a link to its router, and is told nothing by it.

Connected zenoh routers tell each other once, when a connection begins, what their clients declare: subscribers and
tokens. Two defects of zenoh 1.10 lose that, until the connection breaks again. In both, one router is told too little,
and keeps what it was told before: links that have gone stay present, and others are never heard.

- Two routers that connect to each other have one transport of two connections. If one router takes all for lost, and
  the other one does not yet, a new connection joins the old transport of that one, which sees no reason to tell
  anything.
- A transport that ends and begins anew within the 100 ms in which a router computes its routes only once is no change.
  Nor is a router that comes in that time after another one has gone, because it gets the place of that one.

So each router of tfbus has an id that shows that it is one, and a token. A router that is connected without its token
is one of these cases, because zenoh tells tokens and subscribers by the same way. The cure is a new session with
another id, which is a new router to all others: it is told everything. Its clients connect again, as after any break.

A link is told nothing if it has connected while the session of the router closed: zenoh 1.10 panics then if it is asked
for tokens, keeps the connection, and reads nothing from it. So a link waits for the token of its router too, unless it
is told of other links, and the cure is the same.

Nothing here heals a third defect, of routers in a ring. A token that ends within some ms of the break of a connection
is not taken back at its other end, because the first router finds no connection any more, and those around do not pass
it on yet. So a link that ended at this moment stays present there, until its router is not reached on any way.
"""

import os
import threading
from random import uniform
from typing import Any, Final

import zenoh

PATIENCE: Final = 2.0, 5.0
"""s; so long a router may be connected without its token; drawn at random, so that not both begin anew at once."""
PERIOD: Final = 1.0
"""s between two looks at the connected routers."""
PAUSE_TO_BEGIN: Final = 0.5
"""s between the end of a session and the next one, which is no change for other routers if it comes too soon."""
PAUSE_TO_LISTEN: Final = 0.05
"""s between two attempts to open another session, while the address of the one before is not free yet."""
MOST_ROUTERS: Final = 10_000
"""So many tokens are remembered."""
_MARK: Final = b"tfbus".hex()
_TOKENS: Final = "tfbus/@router/"


def new_id() -> str:
    """An id for a session of a router of tfbus."""
    return _MARK + os.urandom(11).hex()


class Neighbours:
    """The routers of tfbus that a session is connected to.

    Attributes
    ----------
    declared : list
        To be kept until the session ends.
    """

    def __init__(self, session: zenoh.Session) -> None:
        self._info = session.info
        self._patience = uniform(*PATIENCE)
        self._lock = threading.Lock()
        self._heard: set[str] = set()
        # Since when each router is connected without its token.
        self._silent: dict[str, float] = {}
        take = zenoh.handlers.Callback(self._take, indirect=False)
        self._liveliness = session.liveliness()
        self.declared: list[Any] = [self._liveliness.declare_subscriber(f"{_TOKENS}*", take, history=True)]

    def announce(self) -> None:
        """Tell others that this session is a router too."""
        self.declared.append(self._liveliness.declare_token(f"{_TOKENS}{self._info.zid()}"))

    def are_silent(self, now: float) -> bool:
        """Whether one of them has been connected too long without its token; to be called every `PERIOD`."""
        connected = {router for zid in self._info.routers_zid() if (router := str(zid)).startswith(_MARK)}
        with self._lock:
            missing = connected - self._heard
        self._silent = {router: self._silent.get(router, now) for router in missing}
        return any(now - since >= self._patience for since in self._silent.values())

    def _take(self, sample: zenoh.Sample) -> None:
        router = str(sample.key_expr)[len(_TOKENS) :]
        with self._lock:
            if sample.kind == zenoh.SampleKind.DELETE:
                self._heard.discard(router)
            elif router.startswith(_MARK) and len(self._heard) < MOST_ROUTERS:
                self._heard.add(router)

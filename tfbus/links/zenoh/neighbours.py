"""The case in which a router is connected to another one and is told nothing by it.

Connected zenoh routers tell each other once, when a connection begins, what their clients declare: subscribers and
tokens. Two defects of zenoh 1.10 lose that, until the connection breaks again. In both, one router is told too little,
and keeps what it was told before: links that have gone stay present, and others are never heard.

- Two routers that connect to each other have one transport of two connections. If one router takes all for lost, and
  the other one does not yet, a new connection joins the old transport of that one, which sees no reason to tell
  anything.
- A transport that ends and begins anew within the 100 ms in which a router computes its routes only once is no change.

So each router of tfbus has a token. A router whose token has gone while the router is connected is one of these cases,
because zenoh tells tokens and subscribers by the same way. The cure is a new session, which is another router to all
others: it is told everything. Its clients connect again, as after any break.
"""

import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final

import zenoh

PATIENCE: Final = 3.0
"""s; so long a router may be connected without its token."""
PERIOD: Final = 0.5
"""s between two looks while the token of any router is missing."""
MOST_MISSING: Final = 1_000
_TOKENS: Final = "tfbus/@router/"


class Neighbours:
    """The session of a router, with the other routers of tfbus that it has heard of.

    Parameters
    ----------
    session : zenoh.Session
    changed : callable
        Called, in zenoh's threads, when a token has gone.
    """

    def __init__(self, session: zenoh.Session, changed: Callable[[], object]) -> None:
        self._session = session
        self._info = session.info
        self._changed = changed
        self._lock = threading.Lock()
        self._missing: dict[str, None] = {}
        # Since when each router is connected without its token.
        self._silent: dict[str, float] = {}
        take = zenoh.handlers.Callback(self._take, indirect=False)
        liveliness = session.liveliness()
        self._declared: list[Any] = [
            liveliness.declare_subscriber(f"{_TOKENS}*", take, history=True),
            liveliness.declare_token(f"{_TOKENS}{self._info.zid()}"),
        ]

    @property
    def period(self) -> float | None:
        """The time in s after which `are_silent` is to be called again; None if not before `changed`."""
        return PERIOD if self._missing else None

    def are_silent(self, now: float) -> bool:
        """Whether a router has been connected for `PATIENCE` without its token, which it has had before."""
        connected = {str(zid) for zid in self._info.routers_zid()} if self._missing else set()
        with self._lock:
            missing = connected & self._missing.keys()
        self._silent = {router: self._silent.get(router, now) for router in missing}
        return any(now - since >= PATIENCE for since in self._silent.values())

    def close(self) -> None:
        """Close the session; blocks."""
        try:
            self._session.close()
        finally:
            # The garbage collector does not see through zenoh's objects.
            self._declared.clear()

    def _take(self, sample: zenoh.Sample) -> None:
        router = str(sample.key_expr)[len(_TOKENS) :]
        with self._lock:
            if sample.kind == zenoh.SampleKind.PUT:
                self._missing.pop(router, None)
                return
            self._missing[router] = None
            if len(self._missing) > MOST_MISSING:
                del self._missing[next(iter(self._missing))]
        with suppress(Exception):
            self._changed()

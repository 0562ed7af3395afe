"""`Confirmation`, which looks whether a server has taken the static frames of a link.

A server tells nobody what it refuses: rosbridge_suite writes it to its own log, and then a static frame never arrives.
One of ROS 2 does so once its logger has failed, for the next client that advertises a topic whose last client has just
left; it forgets that topic after ten seconds. But a server gives its clients back what they publish on a topic to which
they subscribe. So what does not come back was not taken.
"""

import logging
from collections.abc import Callable, Sequence

import anyio

from tfbus.geometry.stamped import TransformStamped

CONFIRM_TIME, LONGEST_CONFIRM_TIME = 2.0, 30.0
"""s; static frames that have not come back for so long are sent again, and then after twice that time each."""


class Confirmation:
    """Compares what comes with what was sent; see the module.

    Parameters
    ----------
    url : str
        How log lines call the server.
    publish_again : callable
        Publishes all static frames.

    Attributes
    ----------
    doubted : bool
        Whether the server may have refused the topic, so that it has to be advertised again.
    """

    def __init__(self, url: str, publish_again: Callable[[], object]) -> None:
        self._url = url
        self._publish_again = publish_again
        self._missing: dict[str, TransformStamped] = {}
        self._sent = anyio.Event()
        self._complete = anyio.Event()
        self.doubted = False

    def expect(self, samples: Sequence[TransformStamped]) -> None:
        """All static frames, which are published now, have to come back."""
        self._missing = {sample.child: sample for sample in samples}

    def sent(self) -> None:
        """The message with them is on its way."""
        self._sent.set()

    def heard(self, samples: Sequence[TransformStamped | None]) -> None:
        """Static frames have come, with their names in ROS."""
        if not self._missing:
            return
        for sample in samples:
            own = None if sample is None else self._missing.get(sample.child)
            if sample is None or own is None or (own.parent, own.stamp) != (sample.parent, sample.stamp):
                continue
            if own.transform.is_close(sample.transform):
                del self._missing[own.child]
        if not self._missing:
            self._complete.set()

    async def run(self, refused: Callable[[str, Exception, int], object]) -> None:
        """Publish again what does not come back, until cancelled; `refused` is called as that of a `SendReport`."""
        pause, told = CONFIRM_TIME, False
        while True:
            await self._sent.wait()
            self._sent, self._complete = anyio.Event(), anyio.Event()
            if self._missing:
                with anyio.move_on_after(pause):
                    await self._complete.wait()
            if not self._missing:
                if told:
                    logging.getLogger("tfbus").warning("%s has taken all static frames now", self._url)
                pause, told, self.doubted = CONFIRM_TIME, False, False
            elif not self._sent.is_set():
                if not told:
                    refused("not confirmed", self._error(), len(self._missing))
                told = self.doubted = True
                pause = min(2 * pause, LONGEST_CONFIRM_TIME)
                self._publish_again()
            # Otherwise more was sent meanwhile, and has its time too.

    def _error(self) -> ConnectionError:
        count, some = len(self._missing), next(iter(self._missing))
        what = f"the static frame {some!r}" if count == 1 else f"{count} static frames, such as {some!r},"
        why = f"within {CONFIRM_TIME:g} s, so it has not taken it: its log may say why"
        return ConnectionError(f"{self._url} has not given back {what} {why}; the link tries again")

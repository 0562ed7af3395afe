"""The plain publishing, in Python: the definition of what ``tfbus/_kernel.c`` does in its place."""

from collections.abc import Callable, Sized
from threading import get_ident
from typing import Any, Protocol

from tfbus.bus._python_judge import Judge
from tfbus.geometry.stamped import Batch, TransformStamped


class Feed(Protocol):
    """The plain insertion of a buffer; see `tfbus.waiting.live_tree`."""

    def insert(self, batch: Batch) -> bool:
        """Insert a batch if it is plain; return whether it was."""


class Intake:
    """The plain way of published samples into the buffers of a bus.

    Parameters
    ----------
    judge : Judge
    kind : type
        The class of samples.
    listeners : tuple of containers
        Whatever is in one of them has to hear of each batch.

    Attributes
    ----------
    feeds : tuple of (Feed, callable)
        One for each buffer, and the function that inserts a batch which is not plain.
    samples : int
        Number of samples that were taken.
    thread : int
        The only thread that may publish.
    open : bool
        Whether anything is taken.
    """

    __slots__ = ("_judge", "_kind", "_listeners", "feeds", "open", "samples", "thread")

    def __init__(self, judge: Judge, kind: type[TransformStamped], listeners: tuple[Sized, ...]) -> None:
        self._judge = judge
        self._kind = kind
        self._listeners = listeners
        self.feeds: tuple[tuple[Feed, Callable[[Batch], object]], ...] = ()
        self.samples = 0
        self.thread = 0
        self.open = True

    def take(self, samples: object, invalid: object) -> bool:
        """Judge a batch and insert it into all buffers, if it is plain and nobody else listens.

        Returns
        -------
        bool
            Whether it was; else nothing was done. Here a batch that is not one sample or a tuple is not plain.

        Raises
        ------
        BaseException
            The first that a buffer raises, after all others have the batch.
        """
        if not self.open or get_ident() != self.thread or (invalid != "raise" and invalid != "drop"):
            return False
        if any(self._listeners):
            return False
        kind = self._kind
        batch: tuple[Any, ...]
        if type(samples) is kind:
            batch = (samples,)
        elif type(samples) is tuple and samples:
            for sample in samples:
                if type(sample) is not kind:
                    return False
            batch = samples
        else:
            return False
        if not self._judge.accepts(batch):
            return False
        self.samples += len(batch)
        first = None
        for feed, insert in self.feeds:
            try:
                if not feed.insert(batch):
                    insert(batch)
            except BaseException as error:  # noqa: BLE001 - the first one is raised after all have the batch
                if first is None:
                    first = error
        if first is not None:
            raise first
        return True

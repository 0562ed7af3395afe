"""Imports that wait until a command runs, as ``lazy from ... import ...`` does from Python 3.15 on (PEP 810).

To parse the words of a command, or to print its help, Python needs the types of the arguments only; the work of the
command takes longer to load than all else. So the modules of the command line import the names of their work in a
block::

    with lazy_imports():
        from tfbus.bus.bus import Bus

Within `deferring`, such a block loads nothing, and binds each name to a promise that serves in annotations only. The
function that `deferring` gives replaces all promises by the real objects. Outside of `deferring` the block does
nothing.
"""

import builtins
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial, reduce
from typing import Any

_scopes: dict[str, dict[str, Any]] | None = None
"""The names of each module that has promises, while imports are deferred."""


class _Promise:
    """A name of a module that is not loaded yet."""

    def __init__(self, load: Callable[[], Any], *path: str) -> None:
        self._load = load
        self._path = path

    def __getattr__(self, name: str) -> "_Promise":
        if name.startswith("__"):
            raise AttributeError(name)
        return _Promise(self._load, *self._path, name)

    def __or__(self, _: object) -> "_Promise":
        return self

    __ror__ = __getitem__ = __or__

    def kept(self) -> Any:
        """The real object."""
        return reduce(getattr, self._path, self._load())


@contextmanager
def lazy_imports() -> Iterator[None]:
    """Defer the imports in the body of a ``with`` at the top of a module, within `deferring`."""
    if _scopes is None:
        yield
        return
    found, real_import = _scopes, builtins.__import__

    def promise(name: str, scope: dict[str, Any], _: object, names: Sequence[str] | None, __: int) -> _Promise:
        found[scope["__name__"]] = scope
        return _Promise(partial(real_import, name, fromlist=names or ()))

    builtins.__import__ = promise  # type: ignore[assignment]
    try:
        yield
    finally:
        builtins.__import__ = real_import


@contextmanager
def deferring() -> Iterator[Callable[[], None]]:
    """Defer the lazy imports of all modules that are loaded in the body of a ``with``; yields how to make up for them.

    A module that still has promises at the end is forgotten, and is loaded again when it is imported the next time.
    """
    global _scopes
    promised = _scopes = {}

    def load() -> None:
        global _scopes
        _scopes = None
        while promised:
            _, scope = promised.popitem()
            for name, value in list(scope.items()):
                if isinstance(value, _Promise):
                    scope[name] = value.kept()

    try:
        yield load
    finally:
        _scopes = None
        for module in promised:
            del sys.modules[module]

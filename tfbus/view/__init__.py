"""The live 3D page: a `View` serves a page on which people see the frames of a buffer and move through its history.

`session` decides what each browser is sent, without a browser and without an event loop. `page/` has the files that the
browser loads. Needs ``pip install "tfbus[view]"``.
"""

from tfbus.errors import pip_install

try:
    from tfbus.view.view import View
except ImportError as error:
    if error.name is None or error.name.startswith("tfbus"):
        raise
    raise ImportError(f"for the live page, tfbus needs more packages: {pip_install('view')} ({error})") from error

__all__ = ["View"]

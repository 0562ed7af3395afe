"""The live 3D page: a `View` serves a page on which people see the frames of a buffer and move through its history.

`page` decides on the content of a picture, without a browser and without an event loop. `screen` draws it with viser,
and `server` starts viser behind a door. Needs ``pip install "tfbus[view]"``.
"""

from tfbus.errors import pip_install

try:
    from tfbus.view.view import View
except ImportError as error:
    if error.name is None or error.name.startswith("tfbus"):
        raise
    raise ImportError(f"for the live page, tfbus needs more packages: {pip_install('view')} ({error})") from error

__all__ = ["View"]

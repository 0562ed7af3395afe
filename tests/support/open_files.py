"""The files that this process has open."""

from contextlib import suppress
from pathlib import Path

OPEN_FILES = Path("/proc/self/fd")


def is_open(path: Path) -> bool:
    """Whether a file, or one in a folder, is open; False where the system does not tell."""
    found = []
    for descriptor in OPEN_FILES.iterdir() if OPEN_FILES.is_dir() else ():
        # The one by which they are listed has gone.
        with suppress(OSError):
            found.append(descriptor.readlink())
    path = path.resolve()
    return any(path in (each, *each.parents) for each in found)

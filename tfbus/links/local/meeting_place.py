"""`MeetingPlace`: how the links of one domain find each other in a directory of the user.

The directory has one folder for each domain, named by a hash of it, so that a look costs nothing for other domains. The
folder has one file for each link: a Unix socket, or, with `loopback`, a text with the port of the loopback at which the
link listens and a key. The name of a file is the time of the link's opening and a part of its id, so any two links
agree about which is the younger. A file without a listener belongs to a process that was killed, and the first link
that finds the file removes it. If that link came between the two steps of a beginning, the owner finds its name missing
at its next look, and shows it again, as after any other loss of the file. The last link to leave removes the folder.

The directory is the one that was given, or named by ``TFBUS_RUNTIME_DIR``, or else ``tfbus`` in ``XDG_RUNTIME_DIR``, or
else ``tfbus-UID`` in the directory for temporary files. It belongs to the user and is closed to all others, which is
checked before anything is trusted.
"""

import os
import re
import secrets
import socket
import stat
import struct
import tempfile
import time
from contextlib import suppress
from hashlib import blake2b
from pathlib import Path
from typing import Final

from tfbus.links.local.connection import KEY

BACKLOG: Final = 1024
LONGEST_PATH: Final = 100
"""Bytes; systems have room for 104 to 108 in the address of a Unix socket."""
SEND_BUFFER: Final = 2**18
_TRIES = 5
_IS_NAME = re.compile("[0-9a-f]{24}").fullmatch
_OTHERWISE = "or set TFBUS_RUNTIME_DIR to a directory of your own"


def runtime_directory() -> Path:
    """The directory of the user in which links meet."""
    if own := os.environ.get("TFBUS_RUNTIME_DIR"):
        return Path(own)
    if users := os.environ.get("XDG_RUNTIME_DIR"):
        return Path(users, "tfbus")
    name = f"tfbus-{os.getuid()}" if hasattr(os, "getuid") else "tfbus"
    return Path(tempfile.gettempdir(), name)


def make_private(directory: Path, *, parents: bool = False) -> None:
    """Make a directory that only its user can enter, and perhaps its parents, as the system makes any.

    Raises
    ------
    PermissionError
        If it is another user's, or others can enter it, or it cannot be made.
    FileNotFoundError
        If it, or its parent, has vanished again.
    """
    try:
        directory.mkdir(mode=0o700, parents=parents, exist_ok=True)
        found = directory.lstat()
    except (PermissionError, FileExistsError, NotADirectoryError) as error:
        problem = f"cannot be made a directory ({error.strerror}): make it one with mode 700"
        raise PermissionError(f"{directory} {problem}, {_OTHERWISE}") from error
    if not hasattr(os, "geteuid"):
        return
    if not stat.S_ISDIR(found.st_mode):
        problem = "is no directory: remove it"
    elif found.st_uid != os.geteuid():
        problem = f"belongs to the user {found.st_uid}, and this process is of {os.geteuid()}: remove it"
    elif found.st_mode & 0o077:
        mode = stat.S_IMODE(found.st_mode)
        problem = f"has the mode {mode:o}, so other users can enter it: run chmod 700 {directory}"
    else:
        return
    raise PermissionError(f"{directory} {problem}, {_OTHERWISE}")


class MeetingPlace:
    """The files of one domain, and the one of a link among them.

    Parameters
    ----------
    domain : str
    link : str
        The id of the link.
    directory : str, optional
        The directory of the user; by default that of the environment.
    loopback : bool, optional
        Whether to use ports of the loopback instead of Unix sockets; by default only where there are none. Links of one
        domain meet if they agree.

    Attributes
    ----------
    name : str
        The name of the link's file; empty unless it is open. A younger link has a greater one.
    key : bytes
        The users who may read the file know it; zeros for Unix sockets, where the kernel tells who connects.
    """

    def __init__(self, domain: str, link: str, directory: str | None, loopback: bool | None) -> None:
        # A program may go to another directory while its links look for others.
        self._root = (runtime_directory() if directory is None else Path(directory)).absolute()
        self.loopback: bool = not hasattr(socket, "AF_UNIX") if loopback is None else loopback
        self._family = socket.AF_INET if self.loopback else socket.AF_UNIX
        kind = "loopback" if self.loopback else "unix"
        self._directory = self._root / blake2b(f"{kind} {domain}".encode(), digest_size=6).hexdigest()
        self._link = link
        self.name: str = ""
        self.key: bytes = bytes(KEY)

    def open(self) -> socket.socket:
        """Listen, and show the link's name; also again, when the name has vanished.

        Raises
        ------
        PermissionError
            If another user could meddle.
        OSError
            If it is not possible to listen.
        """
        self.name = self.name or f"{time.time_ns():016x}{self._link[:8]}"
        for _ in range(_TRIES):
            # Somebody may remove the directory meanwhile, or the last other link its folder.
            with suppress(FileNotFoundError):
                return self._listen()
        return self._listen()

    def _listen(self) -> socket.socket:
        path = self._directory / self.name
        if not self.loopback and len(os.fsencode(path)) > LONGEST_PATH:
            problem = f"the path of a socket may have {LONGEST_PATH} bytes, and {path} is too long"
            raise OSError(f"{problem}: set TFBUS_RUNTIME_DIR to a shorter path")
        make_private(self._root, parents=True)
        make_private(self._directory)
        listener = socket.socket(self._family)
        try:
            listener.setblocking(False)
            listener.bind(("127.0.0.1", 0) if self.loopback else str(path))
            listener.listen(BACKLOG)
            if self.loopback:
                # Another program may have the port of before, and know the key that was said there.
                key = secrets.token_bytes(KEY)
                with os.fdopen(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600), "w") as file:
                    file.write(f"{listener.getsockname()[1]} {key.hex()}")
                self.key = key
        except OSError:
            listener.close()
            raise
        return listener

    def names(self) -> list[str]:
        """The names of all links, and of this one unless somebody has removed it; none if the directory has gone."""
        # Every link looks again and again, and a path for each file would take half of its work at rest.
        with suppress(OSError), os.scandir(self._directory) as files:
            return [file.name for file in files if _IS_NAME(file.name)]
        return []

    def dial(self, name: str) -> tuple[socket.socket, bytes]:
        """Connect to a link without waiting; returns the socket and the key.

        A port of the loopback may be connected later; the socket has room as soon as it is.

        Raises
        ------
        OSError
            If the link is not there or has no room.
        ConnectionRefusedError
            If its file has no listener, or is no file of a link; then the file is removed.
        """
        path, key = self._directory / name, self.key
        sock = socket.socket(self._family)
        try:
            sock.setblocking(False)
            if self.loopback:
                port, _, digits = path.read_text().partition(" ")
                key = bytes.fromhex(digits)
                with suppress(BlockingIOError):
                    sock.connect(("127.0.0.1", int(port)))
            else:
                sock.connect(str(path))
            self._prepare(sock)
        except (OSError, ValueError, OverflowError) as error:
            sock.close()
            if isinstance(error, OSError) and not isinstance(error, ConnectionRefusedError):
                raise
            self.remove(name)
            raise ConnectionRefusedError(f"nobody listens at {path}") from error
        return sock, key

    def accept(self, listener: socket.socket) -> socket.socket:
        """Accept a connection that waits.

        Raises
        ------
        PermissionError
            If a process of another user has the other end.
        OSError
            If none waits, or there is no free file.
        """
        sock, _ = listener.accept()
        try:
            self._prepare(sock)
        except OSError:
            sock.close()
            raise
        return sock

    def _prepare(self, sock: socket.socket) -> None:
        sock.setblocking(False)
        if self.loopback:
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        if hasattr(socket, "SO_PEERCRED"):
            _, user, _ = struct.unpack("3i", sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
            if user != os.geteuid():
                raise PermissionError(f"a process of the user {user} has connected")

    def remove(self, name: str) -> None:
        """Remove the file of a link that is not there."""
        with suppress(OSError):
            (self._directory / name).unlink()

    def close(self) -> None:
        """Remove the link's own file, and the folder if it is empty."""
        if self.name:
            self.remove(self.name)
            self.name = ""
            with suppress(OSError):
                self._directory.rmdir()

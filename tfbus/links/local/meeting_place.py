"""`MeetingPlace`: how the links of one domain find each other in a directory of the user.

The folder of a domain has one file for each of its links: a Unix socket, or, with `loopback`, a text with the port of
the loopback at which the link listens and a key. Its name is the time of the link's opening and a part of its id, so
that any two links agree about which is the younger. A name becomes visible once the link listens, by a rename. So a
file without a listener belongs to a process that was killed, and the first link that finds the file removes it.

The directory is the one that was given, or named by ``TFBUS_RUNTIME_DIR``, or else ``tfbus`` in ``XDG_RUNTIME_DIR``, or
else ``tfbus-UID`` in the directory for temporary files. It belongs to the user and is closed to all others, which is
checked before anything is trusted.
"""

import errno
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

from tfbus.stamps import SECOND

BACKLOG: Final = 1024
LONGEST_PATH: Final = 100
"""Bytes; systems have room for 104 to 108 in the address of a Unix socket."""
SETTLED: Final = SECOND // 10
"""ns; the time of a folder's last change is only as fine as the ticks of the system, so two changes may share one."""
FORGOTTEN: Final = 60 * SECOND
"""ns after which a file that was never made visible belongs to a process that was killed."""
SEND_BUFFER: Final = 2**18
_NAME = re.compile(r"\.?([0-9a-f]{16})[0-9a-f]{8}")
_OTHERWISE = "or set TFBUS_RUNTIME_DIR to a directory of your own"


def runtime_directory() -> Path:
    """The directory of the user in which links meet."""
    if own := os.environ.get("TFBUS_RUNTIME_DIR"):
        return Path(own)
    if users := os.environ.get("XDG_RUNTIME_DIR"):
        return Path(users, "tfbus")
    name = f"tfbus-{os.getuid()}" if hasattr(os, "getuid") else "tfbus"
    return Path(tempfile.gettempdir(), name)


def make_private(directory: Path, *, parents: bool) -> None:
    """Make a directory that only its user can enter.

    Parameters
    ----------
    directory : Path
    parents : bool
        Whether to make the directories above it too, which others may be able to enter.

    Raises
    ------
    PermissionError
        If it is another user's, or others can enter it, or it cannot be made.
    FileNotFoundError
        If it has vanished again, or the directory above it is not there and need not be made.
    """
    try:
        directory.mkdir(mode=0o700, parents=parents, exist_ok=True)
        found = directory.lstat()
    except (PermissionError, FileExistsError, NotADirectoryError) as error:
        problem = f"{directory} cannot be made a directory ({error.strerror}): make it one with mode 700, {_OTHERWISE}"
        raise PermissionError(problem) from error
    if not hasattr(os, "geteuid"):
        return
    if not stat.S_ISDIR(found.st_mode):
        raise PermissionError(f"{directory} is no directory: remove it, {_OTHERWISE}")
    if found.st_uid != os.geteuid():
        owner = f"belongs to the user {found.st_uid}, and this process is of {os.geteuid()}"
        raise PermissionError(f"{directory} {owner}: remove it, {_OTHERWISE}")
    if found.st_mode & 0o077:
        mode = f"has the mode {stat.S_IMODE(found.st_mode):o}, so other users can enter it"
        raise PermissionError(f"{directory} {mode}: run chmod 700 {directory}, {_OTHERWISE}")


class MeetingPlace:
    """The folder of one domain, and the file of one link in it.

    Parameters
    ----------
    domain : str
    link : str
        The id of the link.
    directory : str, optional
        The directory of the user; by default that of the environment.
    loopback : bool
        Whether to use ports of the loopback instead of Unix sockets. Links of one domain meet if they agree.

    Attributes
    ----------
    name : str
        The name of the link's file; empty unless it is open. A younger link has a greater one.
    key : bytes
        Known to those who may read the file; empty for Unix sockets, where the kernel tells who connects.
    """

    def __init__(self, domain: str, link: str, directory: str | None, loopback: bool) -> None:
        self._root = runtime_directory() if directory is None else Path(directory)
        kind = "loopback" if loopback else "unix"
        self._folder = self._root / blake2b(f"{kind} {domain}".encode(), digest_size=6).hexdigest()
        self._link = link
        self._loopback = loopback
        self.name = ""
        self.key = secrets.token_bytes(32) if loopback else b""
        self._changed = 0
        self._others: list[str] = []

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
        for attempts_left in (2, 1, 0):
            try:
                make_private(self._root, parents=True)
                make_private(self._folder, parents=False)
                return self._listen(self._folder / f".{self.name}")
            except FileNotFoundError:
                # The last link that left has removed the folder meanwhile, or somebody has removed all.
                if not attempts_left:
                    raise
        raise AssertionError

    def _listen(self, hidden: Path) -> socket.socket:
        if not self._loopback and len(os.fsencode(hidden)) > LONGEST_PATH:
            problem = (
                f"the path of a socket would be too long: set TFBUS_RUNTIME_DIR to a path shorter than {self._root}"
            )
            raise OSError(errno.ENAMETOOLONG, problem)
        hidden.unlink(missing_ok=True)
        listener = socket.socket(socket.AF_INET if self._loopback else socket.AF_UNIX)
        try:
            listener.setblocking(False)
            if self._loopback:
                listener.bind(("127.0.0.1", 0))
                with os.fdopen(os.open(hidden, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600), "w") as file:
                    file.write(f"{listener.getsockname()[1]} {self.key.hex()}")
            else:
                listener.bind(str(hidden))
                hidden.chmod(0o600)
            listener.listen(BACKLOG)
            hidden.replace(self._folder / self.name)
        except OSError:
            listener.close()
            with suppress(OSError):
                hidden.unlink()
            raise
        self._changed = 0
        return listener

    def others(self) -> list[str]:
        """The names of the other links; a single question to the system if none has changed.

        Raises
        ------
        FileNotFoundError
            If the link's own name has vanished.
        """
        changed = self._folder.stat().st_mtime_ns
        if changed != self._changed:
            now = time.time_ns()
            names = [path.name for path in self._folder.iterdir()]
            if self.name not in names:
                raise FileNotFoundError(errno.ENOENT, "the link's name has vanished", str(self._folder / self.name))
            self._others = [name for name in names if name != self.name and _NAME.fullmatch(name) and name[0] != "."]
            for name in names:
                if name[0] == "." and (found := _NAME.fullmatch(name)) and int(found[1], 16) < now - FORGOTTEN:
                    self.remove(name)
            self._changed = changed if now - changed > SETTLED else 0
        return self._others

    def dial(self, name: str) -> tuple[socket.socket, bytes, bool]:
        """Connect to a link without waiting.

        Returns
        -------
        socket
        key : bytes
        connected : bool
            Whether the connection is there; else the socket has room as soon as it is.

        Raises
        ------
        OSError
            If the link is not there or has no room. If its file has no listener, the file is removed.
        """
        path = self._folder / name
        key, connected = b"", True
        sock = socket.socket(socket.AF_INET if self._loopback else socket.AF_UNIX)
        try:
            sock.setblocking(False)
            if self._loopback:
                port, _, digits = path.read_text().partition(" ")
                key = bytes.fromhex(digits)
                try:
                    sock.connect(("127.0.0.1", int(port)))
                except BlockingIOError:
                    connected = False
            else:
                sock.connect(str(path))
            self.prepare(sock)
        except OSError as error:
            sock.close()
            if isinstance(error, ConnectionRefusedError):
                self.remove(name)
            raise
        except ValueError as error:
            sock.close()
            raise OSError(f"{path} has no port and key") from error
        return sock, key, connected

    def prepare(self, sock: socket.socket) -> None:
        """Make the socket of a new connection ready for use.

        Raises
        ------
        PermissionError
            If a process of another user has the other end.
        """
        sock.setblocking(False)
        if self._loopback:
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
            (self._folder / name).unlink()

    def close(self) -> None:
        """Remove the link's own file, and the folder with the last one."""
        if self.name:
            self.remove(self.name)
            self.name = ""
            with suppress(OSError):
                self._folder.rmdir()

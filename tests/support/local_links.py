"""The files of the links of one machine, and a peer of the tests that speaks their protocol itself."""

import secrets
import socket
import struct
from contextlib import suppress
from pathlib import Path
from typing import Self

import anyio
import anyio.abc

PATIENCE = 20.0


def files_in(directory: str) -> list[Path]:
    """The files of the links that meet in a directory, which are in folders of their domains."""
    return sorted(Path(directory).glob("*/*"))


class RawPeer:
    """A program that connects to a link, and does what it likes."""

    def __init__(self, stream: anyio.abc.ByteStream, key: bytes = bytes(32)) -> None:
        self.stream = stream
        self.link = secrets.token_hex(16)
        self._key = key
        self._read = b""

    @classmethod
    async def connect(cls, path: Path, receive_buffer: int | None = None) -> Self:
        """Connect to the link whose file is given, by either of the two ways."""
        if await anyio.Path(path).is_socket():
            return cls(await anyio.connect_unix(path))
        port, key = (await anyio.Path(path).read_text()).split()
        sock = socket.socket()
        if receive_buffer is not None:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
        sock.connect(("127.0.0.1", int(port)))
        return cls(await anyio.abc.SocketStream.from_socket(sock), bytes.fromhex(key))

    async def say(self, *messages: bytes) -> None:
        await self.stream.send(framed(*messages))

    async def hear(self) -> bytes:
        """The next frame; raises `anyio.EndOfStream` at the end."""
        while len(self._read) < 4 or len(self._read) < 4 + struct.unpack_from("<I", self._read)[0]:
            with anyio.fail_after(PATIENCE):
                self._read += await self.stream.receive()
        (length,) = struct.unpack_from("<I", self._read)
        message, self._read = self._read[4 : 4 + length], self._read[4 + length :]
        return message

    def hello(self, robot: str = "", hears: str = "* all") -> bytes:
        """A hello of this peer."""
        return b"tfbus local 3\n" + self.link.encode() + self._key[:16] + f"{robot}\n{hears}".encode()

    async def meet(self, robot: str = "", *, link: str = "") -> None:
        """Say hello, and hear the other's."""
        self.link = link or self.link
        await self.say(self.hello(robot))
        assert (await self.hear())[46:62] == self._key[16:]

    async def end(self) -> list[bytes]:
        """All frames that still come until the other side ends the connection."""
        heard = []
        with suppress(anyio.EndOfStream, anyio.BrokenResourceError):
            while True:
                heard.append(await self.hear())
        return heard


def framed(*messages: bytes) -> bytes:
    return b"".join(struct.pack("<I", len(message)) + message for message in messages)

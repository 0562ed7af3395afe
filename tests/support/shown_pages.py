"""The knowledge of a browser about a live page, from the messages of a session or of a websocket."""

import json
import struct
from collections.abc import AsyncIterator, Callable, Iterable
from contextlib import asynccontextmanager
from typing import Any, Self

import anyio
import numpy as np
import numpy.typing as npt

from tfbus._aio.websocket import WebSocket

Array = npt.NDArray[Any]
PATIENCE = 60.0
"""Seconds."""


class Shown:
    """The newest message of each type.

    Attributes
    ----------
    said : dict of str to dict
        The texts by their type.
    events : list of dict
    rows : array of shape (n, 7)
        The poses of the frames, and then of the clouds.
    points, trails : dict of str to array of shape (n, 3)
        By the name of the cloud, or of the frame.
    meshes : list of (array of shape (v, 3), array of shape (f, 3))
    solids : list of dict
    received : list of str
        The types of all messages so far.
    """

    def __init__(self) -> None:
        self.said: dict[str, dict[str, Any]] = {}
        self.events: list[dict[str, Any]] = []
        self.rows: Array = np.empty((0, 7))
        self.points: dict[str, Array] = {}
        self.trails: dict[str, Array] = {}
        self.meshes: list[tuple[Array, Array]] = []
        self.solids: list[dict[str, Any]] = []
        self.received: list[str] = []

    def take(self, messages: Iterable[str | bytes]) -> Self:
        """Read messages."""
        for message in messages:
            if isinstance(message, str):
                content = json.loads(message)
                self.said[content["type"]] = content
                self.events += content.get("events", ())
                self.received.append(content["type"])
                continue
            kind = message[0]
            self.received.append(f"kind {kind}")
            if kind == 1:
                self.rows = np.frombuffer(message, np.float32, offset=4).reshape(-1, 7)
                continue
            end = 8 + struct.unpack_from("<I", message, 4)[0]
            header, payload = json.loads(message[8:end]), memoryview(message)[end:]
            if kind == 2:
                numbers = 3 * header["count"]
                self.points[header["name"]] = np.frombuffer(payload, np.float32, numbers).reshape(-1, 3)
                self.said["points"] = header | {"bytes": bytes(payload[4 * numbers :])}
            elif kind == 3:
                lines = np.frombuffer(payload, np.float32).reshape(-1, 3)
                ends = np.cumsum([each["count"] for each in header["trails"]], dtype=int)
                parts = np.split(lines, ends)
                self.trails = {each["frame"]: part for each, part in zip(header["trails"], parts, strict=False)}
            else:
                self.solids = header["solids"]
                at = 0
                for mesh in header["meshes"]:
                    counts = 3 * mesh["vertices"], 3 * mesh["faces"]
                    vertices = np.frombuffer(payload, np.float32, counts[0], at).reshape(-1, 3)
                    faces = np.frombuffer(payload, np.uint32, counts[1], at + 4 * counts[0]).reshape(-1, 3)
                    self.meshes.append((vertices, faces))
                    at += 4 * sum(counts)
        return self

    @property
    def x(self) -> dict[str, float]:
        """The x of every frame that has a pose, and of every cloud that has one."""
        names = (*self.said["frames"]["names"], *self.said["clouds"]["names"])
        return {name: float(x) for name, x in zip(names, self.rows[:, 0], strict=True) if not np.isnan(x)}

    @property
    def states(self) -> dict[str, str]:
        """The state of every frame."""
        return dict(zip(self.said["frames"]["names"], self.said["states"]["states"], strict=True))

    @property
    def parents(self) -> dict[str, str | None]:
        """The parent of every frame."""
        names = self.said["frames"]["names"]
        above = self.said["frames"]["parents"]
        return {name: None if place < 0 else names[place] for name, place in zip(names, above, strict=True)}


class PageClient(Shown):
    """A websocket as that of a browser."""

    def __init__(self, socket: WebSocket) -> None:
        super().__init__()
        self.socket = socket

    @classmethod
    @asynccontextmanager
    async def open(cls, address: str) -> AsyncIterator[Self]:
        """Connect to the page at an address."""
        socket = await WebSocket.connect(f"{address.replace('http', 'ws')}/socket", 2**30, PATIENCE)
        try:
            yield cls(socket)
        finally:
            await socket.close()

    async def do(self, name: str, **values: Any) -> None:
        """Send an order."""
        await self.socket.send(json.dumps({"do": name, **values}))

    async def until(self, condition: Callable[[], object]) -> None:
        """Read messages until a condition holds; what it looks for may not have come yet."""
        with anyio.fail_after(PATIENCE):
            while not self._holds(condition):
                self.take([await self.socket.receive()])

    def _holds(self, condition: Callable[[], object]) -> bool:
        try:
            return bool(condition())
        except (LookupError, ValueError):
            return False

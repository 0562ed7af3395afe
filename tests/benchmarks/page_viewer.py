"""A viewer of a page without graphics: it receives what a browser would, and prints when each change arrives.

``python page_viewer.py PORT`` prints a line for each message with new poses: a monotonic time in ns, which all
processes of a machine share, and the x of the last frame in mm.
"""

import sys
import time
from typing import Any

import msgspec
import viser
import zstandard
from websockets.sync.client import connect
from websockets.typing import Subprotocol

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (0.0, 0.0, 5.0),
    "fov": 1.0,
    "near": 0.1,
    "far": 100.0,
    "image_height": 100,
    "image_width": 100,
    "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, 0.0, 1.0),
}


def positions(frame: bytes) -> list[float] | None:
    """The positions of all frames in a message of viser; None if it has none."""
    length, size = int.from_bytes(frame[:8], "little"), int.from_bytes(frame[8:16], "little")
    inner: Any = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(frame[16 : 16 + size], length))
    place = 16 + size
    starts = []
    for count in inner["binaryBufferLengths"]:
        place += -place % 8
        starts.append((place, count))
        place += count
    for message in inner["messages"]:
        updates = message.get("updates", {})
        if message.get("name") == "/axes" and "batched_positions" in updates:
            start, count = starts[updates["batched_positions"]["__binary_index"]]
            return [float(x) for x in memoryview(frame[start : start + count]).cast("f")]
    return None


def main() -> None:
    address = f"ws://127.0.0.1:{sys.argv[1]}"
    protocol = Subprotocol(f"viser-v{viser.__version__}")
    with connect(address, subprotocols=[protocol], proxy=None, max_size=None) as socket:
        socket.send(msgspec.msgpack.encode(CAMERA))
        for frame in socket:
            arrived = time.monotonic_ns()
            assert isinstance(frame, bytes)
            found = positions(frame)
            if found:
                print(arrived, round(found[-3] * 1_000), flush=True)


main()
